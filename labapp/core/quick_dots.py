"""Dots of a frame like the one before: with size and noise known it takes a millisecond or two.

The peaks of `dots.band_pass_dots`: wide Gaussians are taken of a smaller picture, and what concerns
few pixels is worked out for these alone.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import cv2
import numpy as np

from labapp.core.dots import (
    HOT,
    BandPassSettings,
    Dots,
    Grey,
    Image,
    band_noise,
    band_pass,
    describe,
    estimate_size,
    first_of_each,
    gauss,
    hot_scale,
    local_noise,
    peak_disc,
    typical,
)
from labapp.core.values import BoolArray, CannotMeasure, FloatArray, IntArray, freeze

ROUND_PX2 = 0.25
"""Variance, px² of the smaller picture, that making a picture smaller and large again adds."""

LEAST_PX2 = 0.8
"""A blur of less, px² of the smaller picture, is not taken of it."""


WHOLE = 1.8
"""Centroids are taken over so much more of a dot than it is found by: over more of its grains of
speckle, which move it the less."""


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
    """
    image = np.asarray(frame, np.float32)
    size = exposure.size_px
    fine = gauss(image, 0.5 * size)
    narrow = gauss(fine, float(np.sqrt(0.8**2 - 0.5**2)) * size)
    band = narrow - _widened(narrow, (1.6**2 - 0.8**2) * size**2)
    u, v = _peaks(band, exposure.floor, size)
    keep = _not_hot(image, band, u, v, size)
    u, v = u[keep], v[keep]
    if len(u) == 0:
        raise CannotMeasure("no-dots", "no dot stands out of the frame's noise")
    bright = band[v, u].astype(float)
    keep = bright >= settings.contrast * typical(bright)
    keep[keep] = first_of_each(u[keep], v[keep], size)
    u, v = u[keep], v[keep]
    light = fine - _widened(narrow, ((3.0 * WHOLE) ** 2 - 0.8**2) * size**2)
    np.maximum(light, 0.0, out=light)
    return describe(light, band, exposure.noise, u, v, size, settings.speckle_px, WHOLE)


def _widened(image: Grey, variance_px2: float) -> Grey:
    """Blur by a Gaussian of the given variance, by way of a smaller picture where it is wide."""
    height, width = image.shape
    small, scale = image, 1
    while (
        variance_px2 / (2 * scale) ** 2 - ROUND_PX2 > LEAST_PX2
        and height % (2 * scale) == width % (2 * scale) == 0
    ):
        scale *= 2
        smaller = cv2.resize(image, (width // scale, height // scale), interpolation=cv2.INTER_AREA)
        small = np.asarray(smaller, np.float32)
    if scale == 1:
        return gauss(image, float(np.sqrt(variance_px2)))
    small = gauss(small, float(np.sqrt(variance_px2 / scale**2 - ROUND_PX2)))
    return np.asarray(cv2.resize(small, (width, height)), np.float32)


def _peaks(band: Grey, floor: Grey, size: float) -> tuple[IntArray, IntArray]:
    """Columns and rows of the local maxima (`dots.local_maxima`): first among 3 × 3 pixels."""
    highest = cv2.max(cv2.dilate(band, np.ones((3, 3), np.uint8)), floor)
    peak = cv2.compare(band, highest, cv2.CMP_GE)
    if not cv2.countNonZero(peak):
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    u, v = np.asarray(cv2.findNonZero(peak)).reshape(-1, 2).T.astype(np.int64)
    disc = peak_disc(size).astype(bool)
    around = _patches(band, u, v, disc.shape[0] // 2)[:, disc]
    keep = (band[v, u] >= around.max(axis=1)) & (band[v, u] > floor[v, u])
    return u[keep], v[keep]


def _patches(image: Grey, u: IntArray, v: IntArray, reach: int) -> Grey:
    """Squares round pixels, shape (n, 2·reach + 1, 2·reach + 1), mirrored at the picture's rim."""
    height, width = image.shape
    step = np.arange(-reach, reach + 1)
    rows, columns = _mirrored(v[:, None] + step, height), _mirrored(u[:, None] + step, width)
    return np.asarray(image[rows[:, :, None], columns[:, None, :]])


def _mirrored(place: IntArray, count: int) -> IntArray:
    inside = np.where(place < 0, -1 - place, place)
    return np.where(inside >= count, 2 * count - 1 - inside, inside)


def _not_hot(image: Grey, band: Grey, u: IntArray, v: IntArray, size: float) -> BoolArray:
    """Not a hot pixel (`dots._dot_like`): the finer band is worked out round the peaks alone."""
    scale = hot_scale(size)
    narrow, wide = (_nine(sigma) for sigma in (0.8 * scale, 1.6 * scale))
    reach = wide.shape[1] // 2
    patch = _patches(image, u, v, reach)
    narrow = np.pad(narrow, ((0, 0), (reach - narrow.shape[1] // 2,) * 2))
    fine = narrow @ patch @ narrow.T - wide @ patch @ wide.T
    return np.asarray(fine.max(axis=(1, 2)) < HOT * band[v, u])


@cache
def _nine(sigma: float) -> FloatArray:
    """Gaussian weights of a pixel and its two neighbours on a line, shape (3, taps + 2).

    Kept, as a recording has one size of dot.
    """
    taps = round(8 * sigma + 1) | 1
    kernel = np.asarray(cv2.getGaussianKernel(taps, sigma, cv2.CV_32F), np.float32).ravel()
    return np.stack([np.pad(kernel, (k, 2 - k)) for k in range(3)])
