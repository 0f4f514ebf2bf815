"""Dots of a frame like the one before: with size and noise known it takes a millisecond or two.

The peaks of `dots.band_pass_dots`: wide Gaussians are taken of a smaller picture, and what concerns
few pixels is worked out for these alone.
"""

from __future__ import annotations

import threading
from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np

from labapp.core.dots import (
    HOT,
    BandPassSettings,
    Dots,
    Grey,
    Image,
    Picture,
    band_noise,
    band_pass,
    described,
    estimate_size,
    hot_scale,
    local_noise,
    margin_of,
    peak_disc,
    typical,
    windows,
)
from labapp.core.values import BoolArray, CannotMeasure, IntArray, freeze

ROUND_PX2 = 0.25
"""Variance, px² of the smaller picture, that making a picture smaller and large again adds."""

LEAST_PX2 = 0.8
"""A blur of less, px² of the smaller picture, is not taken of it."""


class Pad:
    """Pictures to work on. Made anew for every frame they would cost as much as the work."""

    def __init__(self, shape: tuple[int, ...]) -> None:
        self.image, self.narrow, self.wide, self.band = (
            np.empty(shape, np.float32) for _ in range(4)
        )
        self.over = np.empty(shape, bool)
        self._small: dict[int, tuple[Grey, Grey]] = {}

    def blur(self, image: Picture, into: Grey, sigma: float) -> None:
        """Blur by a Gaussian (`dots.gauss`); of 8-bit pictures none is made in between."""
        kernel = _kernel(sigma)
        cv2.sepFilter2D(image, cv2.CV_32F, kernel, kernel, into, borderType=cv2.BORDER_REFLECT)

    def widen(self, image: Grey, into: Grey, variance_px2: float) -> Grey:
        """Blur by a Gaussian of some variance, px² of ``into``, by way of a smaller picture.

        Returns the smaller picture of the image; it can be given to be widened further. Where the
        blur is narrow, or the picture's sides cannot be divided, that is the image itself.
        """
        height, width = into.shape
        scale = 1
        while (
            variance_px2 / (2 * scale) ** 2 - ROUND_PX2 > LEAST_PX2
            and height % (2 * scale) == width % (2 * scale) == 0
        ):
            scale *= 2
        if scale == 1:
            self.blur(image, into, float(np.sqrt(variance_px2)))
            return image
        shape = height // scale, width // scale
        if scale not in self._small:
            self._small[scale] = np.empty(shape, np.float32), np.empty(shape, np.float32)
        small, blurred = self._small[scale]
        cv2.resize(image, shape[::-1], dst=small, interpolation=cv2.INTER_AREA)
        self.blur(small, blurred, float(np.sqrt(variance_px2 / scale**2 - ROUND_PX2)))
        cv2.resize(blurred, (width, height), dst=into)
        return small


WHOLE = 1.8
"""Centroids are taken over so much more of a dot than it is found by: over more of its grains of
speckle, which move it the less."""


MUCH = 0.3
"""Where the dots' surroundings are a larger share of the picture, the whole of it is blurred."""


@dataclass(frozen=True)
class Exposure:
    """What frames of one recording share as long as light and camera stay as they are.

    Parameters
    ----------
    size_px
        Standard deviation of a dot's light, px.
    noise
        Of the camera round each pixel, grey levels, shape (height, width).
    floor
        What a peak of the band-passed frame must exceed, shape (height, width).
    """

    size_px: float
    noise: Grey
    floor: Grey

    def __post_init__(self) -> None:
        freeze(self)

    @classmethod
    def of(cls, frame: Image, settings: BandPassSettings) -> Exposure:
        """Take it from a frame, as `band_pass_dots` does."""
        image = np.asarray(frame, np.float32)
        size = settings.size_px or estimate_size(image)
        noise = local_noise(image, size)
        floor = settings.threshold * band_noise(band_pass(image, size), noise, size)
        return cls(size, noise, np.asarray(floor, np.float32))


def quick_dots(frame: Image, exposure: Exposure, settings: BandPassSettings) -> Dots:
    """Find the dots of a frame whose exposure is known.

    Parameters
    ----------
    frame
        Grey image of the exposure's shape, any real type.
    exposure
        Of a frame before.
    settings
        See `BandPassSettings`; the size is the exposure's.

    Raises
    ------
    CannotMeasure
        ``no-dots`` if nothing stands out of the noise.
    ValueError
        If the frame has another size than that of the exposure.
    """
    from labapp.core import dot_kernels

    if frame.shape != exposure.noise.shape:
        raise ValueError(f"a frame of {frame.shape}, an exposure of {exposure.noise.shape}")
    pad, size = _pad(exposure.noise.shape), exposure.size_px
    narrow, wide, band = pad.narrow, pad.wide, pad.band
    image: Picture
    if frame.dtype == np.uint8:
        image = np.ascontiguousarray(frame, np.uint8)
    else:
        image = pad.image
        np.copyto(image, frame, casting="unsafe")
    pad.blur(image, narrow, 0.8 * size)
    small = pad.widen(narrow, wide, (1.6**2 - 0.8**2) * size**2)
    cv2.subtract(narrow, wide, dst=band)
    over = np.flatnonzero(np.greater(band, exposure.floor, out=pad.over))
    u, v = dot_kernels.peaks(band, peak_disc(size).astype(bool), over)
    keep = _not_hot(image, band, u, v, size)
    u, v = u[keep], v[keep]
    if len(u) == 0:
        raise CannotMeasure("no-dots", "no dot stands out of the frame's noise")
    bright = band[v, u].astype(float)
    keep = bright >= settings.contrast * typical(bright)
    u, v = u[keep], v[keep]
    first = dot_kernels.first_of_each(u, v, max(1.5, size))
    u, v = u[first], v[first]
    pad.widen(small, wide, ((3.0 * WHOLE) ** 2 - 0.8**2) * size**2)
    place, reach = np.stack([u, v], axis=1).astype(float), WHOLE * size
    width = windows(dot_kernels.two_nearest(place, place)[0][:, 1], reach)
    margin, taps = margin_of(reach), _kernel(0.5 * size)
    if len(u) * (2 * margin + 1) ** 2 > MUCH * image.size:
        pad.blur(image, narrow, 0.5 * size)
        image, taps = narrow, _kernel(0.0)
    found = dot_kernels.centroids(image, wide, taps, u, v, margin, width, reach)
    return described(band, exposure.noise, (u, v), size, settings.speckle_px, width, found)


_own = threading.local()


def _pad(shape: tuple[int, ...]) -> Pad:
    """What this thread works on: kept, for frames of one size follow on each other."""
    pad: Pad | None = getattr(_own, "pad", None)
    if pad is None or pad.band.shape != shape:
        pad = _own.pad = Pad(shape)
    return pad


def _not_hot(image: Picture, band: Grey, u: IntArray, v: IntArray, size: float) -> BoolArray:
    """Not a hot pixel (`dots._dot_like`): the finer band is worked out round the peaks alone."""
    from labapp.core import dot_kernels

    scale = hot_scale(size)
    taps = _taps(1.6 * scale)
    narrow, wide = (_nine(sigma, taps) for sigma in (0.8 * scale, 1.6 * scale))
    return np.asarray(dot_kernels.finest(image, u, v, narrow, wide) < HOT * band[v, u])


def _taps(sigma: float) -> int:
    """Length of a Gaussian's kernel, as OpenCV takes it."""
    return round(8 * sigma + 1) | 1


@lru_cache(maxsize=8)
def _kernel(sigma: float) -> Grey:
    """Gaussian weights of pixels on a line; kept, as a recording has one size of dot."""
    taps = cv2.getGaussianKernel(_taps(sigma), sigma, cv2.CV_32F)
    kernel = np.asarray(taps, np.float32).ravel()
    kernel.flags.writeable = False
    return kernel


@lru_cache(maxsize=8)
def _nine(sigma: float, taps: int) -> Grey:
    """Gaussian weights of a pixel and its two neighbours on a line, shape (3, taps + 2)."""
    kernel = np.pad(_kernel(sigma), (taps - _taps(sigma)) // 2)
    nine = np.stack([np.pad(kernel, (k, 2 - k)) for k in range(3)])
    nine.flags.writeable = False
    return np.asarray(nine)
