"""The default detector: a band-pass at the dots' own size, which the frame itself tells.

One search serves the first frame and the frames that follow, with the `DetectorTuning` of the
first: dot size and noise. Wide Gaussians are taken of a smaller picture, and what concerns few
pixels is worked out for these alone.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from functools import cached_property, lru_cache

import cv2
import numpy as np
import scipy

from labapp.core.images.dot_size import (
    SLENDER,
    as_picture,
    blur,
    kernel,
    local_noise,
    mended,
    noise_gain,
    pairs,
    peak_disc,
    scratch,
    size_of,
    with_grain,
)
from labapp.core.images.dots import BandPassSettings, Dots, Grey, Image, Picture
from labapp.core.values import BoolArray, CannotMeasure, FloatArray, IntArray, ReadOnlyArrays

Part = tuple[slice, slice]
"""Rows and columns of a picture."""

HOT_RATIO = 1.6
"""What a cluster of hot pixels answers to a band of a third of the dots' size, over its answer to
theirs."""

REMAINS_SHARE = 0.5
"""A dot with mended pixels is at least this fraction of the typical dot; remains of hot pixels are
fainter."""

FAINT_SIGMA = 3.0
"""A peak that the operator points at stands this many noise σ above the background: half of what
any other must (`BandPassSettings.threshold`)."""

ROUND_PX2 = 0.25
"""Variance, px² of the smaller picture, that making a picture smaller and large again adds."""

LEAST_PX2 = 0.8
"""A blur of less, px² of the smaller picture, is not taken of it."""

CENTROID_WIDENING = 1.4
"""Centroids are taken over windows wider by this than a dot is found by: over more of its grains of
speckle, which then move it less."""

MOST_SURROUNDINGS = 0.3
"""Where the dots' surroundings are a larger share of the picture, all of it is blurred at once."""

HALVED_PX, NEARLY = 1.5, 0.75
"""Dots of this size are seen at half the size, too: where the band there is under so much of the
floor, no peak is over it."""

SURROUNDINGS = 10.0
"""How far beyond what may be dots a picture is looked at, in dots' sizes: farther off light moves
none."""

GRID_PX = 16
"""A part of a picture begins and ends at a multiple: smaller pictures of it are those of all."""

PEAK_GAIN = 1 / 1.64 - 1 / 3.56
"""What a Gaussian dot of the band's own size keeps of its height: 1/(1 + 0.8²) − 1/(1 + 1.6²)."""

WIDTH_KEPT = 0.8
"""What is left of a Gaussian dot's width when its surroundings are taken off."""


@dataclass(frozen=True)
class DetectorTuning(ReadOnlyArrays):
    """What the detector is set to by a frame: dot size and noise, good for the frames after it.

    It holds as long as light and camera stay as they are.

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

    @classmethod
    def of(cls, frame: Image, settings: BandPassSettings) -> DetectorTuning:
        """The tuning for a frame, shape (height, width), any real type, and those like it."""
        return _tuned(as_picture(frame), settings)[0]

    @cached_property
    def coarse(self) -> Grey:
        """What of every second pixel's floor its square's band is over if a peak may be there."""
        return np.asarray(np.float32(NEARLY) * self.floor[::2, ::2])

    def part(self, of: Part, inner: Part) -> DetectorTuning:
        """That of a part of the picture where peaks are asked for in an inner part alone.

        It stands until this thread asks for the next one.
        """
        own = self.floor[of]
        floor = scratch("floor", (own.shape[0], own.shape[1]))
        floor[:] = own
        for axis in range(2):
            lines = floor if axis == 0 else floor.T
            lines[: inner[axis].start - of[axis].start] = np.inf
            lines[inner[axis].stop - of[axis].start :] = np.inf
        return DetectorTuning(self.size_px, self.noise[of], floor)


def band_pass_dots(frame: Image, settings: BandPassSettings) -> Dots:
    """Find dots as peaks of a difference of Gaussians at the dots' own size.

    Parameters
    ----------
    frame
        Grey image, shape (height, width), any real type.
    settings
        See `BandPassSettings`.

    Raises
    ------
    CannotMeasure
        ``no-dots`` if nothing in the frame stands out of the noise.
    """
    picture = as_picture(np.asarray(frame))
    if picture.ndim != 2 or min(picture.shape) < 8 or not float(np.ptp(picture)) > 0:
        raise CannotMeasure("no-dots", "the frame is blank or too small to hold a dot")
    return quick_dots(frame, _tuned(picture, settings)[0], settings)


def quick_dots(frame: Image, tuning: DetectorTuning, settings: BandPassSettings) -> Dots:
    """Find the dots of a frame with the tuning of a frame before: `band_pass_dots` in less time.

    Parameters
    ----------
    frame
        Grey image of the tuning's shape, any real type.
    tuning
        Of a frame before.
    settings
        See `BandPassSettings`; the size is the tuning's.

    Raises
    ------
    CannotMeasure
        ``no-dots`` if nothing stands out of the noise.
    ValueError
        If the frame has another size than that of the tuning.
    """
    if frame.shape != tuning.noise.shape:
        raise ValueError(f"a frame of {frame.shape}, a tuning of {tuning.noise.shape}")
    picture = mended(as_picture(frame), tuning.noise, tuning.size_px)
    part, inner = _lit(picture, tuning)
    seen = _BandPassed(as_picture(picture[part]), tuning.size_px)
    dots = _found(tuning.part(part, inner), seen, settings)
    rows, columns = part
    return replace(dots, u_px=dots.u_px + columns.start, v_px=dots.v_px + rows.start)


def _lit(picture: Picture, tuning: DetectorTuning) -> tuple[Part, Part]:
    """Part of a picture that its dots are described in, and the part of that their peaks are in.

    Both are told by the picture at half its size.

    Raises
    ------
    CannotMeasure
        ``no-dots`` if nothing stands out of the noise.
    """
    (height, width), size = picture.shape, tuning.size_px
    whole = slice(0, height), slice(0, width)
    if size < HALVED_PX or height % 2 or width % 2:
        return whole, whole
    shape, lost = (height // 2, width // 2), (1 - 2**-2) / 12
    half = as_picture(cv2.resize(picture, shape[::-1], interpolation=cv2.INTER_AREA))
    narrow, wide = scratch("half", shape), scratch("half wide", shape)
    blur(half, float(np.sqrt((0.4 * size) ** 2 - lost)), narrow)
    widen(narrow, wide, (0.8**2 - 0.4**2) * size**2)
    lit = cv2.subtract(narrow, wide, dst=narrow) > tuning.coarse
    part, inner = [], []
    for axis, end in enumerate(picture.shape):
        at = np.flatnonzero(lit.any(axis=1 - axis))
        if len(at) == 0:
            raise CannotMeasure("no-dots", "no dot stands out of the frame's noise")
        first, last = 2 * int(at[0]) - 2, 2 * int(at[-1]) + 4
        inner.append(slice(max(first, 0), min(last, end)))
        away = int(np.ceil(SURROUNDINGS * size))
        first, last = (first - away) // GRID_PX * GRID_PX, -(-(last + away) // GRID_PX) * GRID_PX
        part.append(slice(max(first, 0), min(last, end)))
    return (part[0], part[1]), (inner[0], inner[1])


def dot_at(
    frame: Image, u_px: float, v_px: float, others: Dots, settings: BandPassSettings
) -> Dots:
    """Describe the one dot that is pointed at: the nearest peak there, or else the place itself.

    Parameters
    ----------
    frame
        Grey image, shape (height, width), any real type.
    u_px, v_px
        Place in the frame, px.
    others
        The dots there are; their peaks are not taken again and their light is kept out.
    settings
        See `BandPassSettings`.

    Returns
    -------
    Dots
        One dot, with centroid and uncertainty as `band_pass_dots` gives them. Where no peak of
        its own is within two dots' sizes it is at (u_px, v_px), uncertain by a dot's size.
    """
    size = settings.size_px or (float(np.median(others.size_px)) if len(others) else None)
    like = BandPassSettings(size, FAINT_SIGMA, 0.0, settings.speckle_px)
    tuning, seen = _tuned(as_picture(frame), like)
    size = tuning.size_px
    u, v = seen.peaks(tuning)
    away = np.hypot(u - u_px, v - v_px)
    taken = np.full(len(u), np.inf)
    if len(others) and len(u):
        taken = np.asarray(
            scipy.spatial.cKDTree(others.image_px).query(np.stack([u, v], axis=1))[0]
        )
    away[taken < max(1.5, size)] = np.inf
    if not (away <= 2.0 * size).any():
        at = round(v_px), round(u_px)
        peak = max(float(seen.band[at]), 0.0) / PEAK_GAIN
        snr = peak / max(float(tuning.noise[at]), 1e-3 * peak, 1e-9)
        unsure = max(size, 1.0)
        return Dots(*(np.array([x]) for x in (u_px, v_px, unsure, unsure, size, peak, snr)))
    k = int(np.argmin(away))
    limit = np.array(frame.shape[::-1]) - 1
    known = np.clip(np.rint(others.image_px), 0, limit).astype(np.int64)
    u, v = np.append(known[:, 0], u[k]), np.append(known[:, 1], v[k])
    every = _described(seen, u, v, tuning.noise, settings.speckle_px)
    return Dots(*(getattr(every, column.name)[-1:] for column in fields(every)))


def typical(brightness: FloatArray) -> float:
    """Half of all the light is in dots brighter than this: many faint specks do not move it."""
    order = np.sort(brightness)
    light = np.cumsum(order)
    return float(order[np.searchsorted(light, 0.5 * light[-1])])


def _tuned(picture: Picture, settings: BandPassSettings) -> tuple[DetectorTuning, _BandPassed]:
    """A picture's tuning, and the picture in the band, which it follows from."""
    noise = local_noise(picture)
    size = settings.size_px or size_of(picture, noise)
    seen = _BandPassed(mended(picture, noise, size), size)
    white = float(np.median(noise[::8, ::8])) / noise_gain(size)
    grain = with_grain(seen.band[::4, ::4], white) / max(white, 1e-9)
    least = 1e-3 * max(map(abs, cv2.minMaxLoc(seen.band)[:2])) + 1e-6
    floor = noise * np.float32(settings.threshold * grain / noise_gain(size))
    np.maximum(floor, np.float32(settings.threshold * least), out=floor)
    return DetectorTuning(size, noise, floor), seen


class _BandPassed:
    """A picture and its band at the dots' size, on this thread's scratch pictures."""

    def __init__(self, picture: Picture, size: float) -> None:
        self.picture, self.size = picture, size
        names = ("narrow", "wide", "band")
        self._narrow, self.wide, self.band = (scratch(name, picture.shape) for name in names)
        self._pass()

    def _pass(self) -> None:
        blur(self.picture, 0.8 * self.size, self._narrow)
        self._small = widen(self._narrow, self.wide, (1.6**2 - 0.8**2) * self.size**2)
        cv2.subtract(self._narrow, self.wide, dst=self.band)

    def peaks(self, tuning: DetectorTuning) -> tuple[IntArray, IntArray]:
        """Columns and rows of the peaks over the floor that may be dots'.

        Where some may not, for they are as sharp as hot pixels or as long as lines of them, these
        pixels are mended, as there may be a dot under them: one as bright as others are.
        """
        from labapp.core.images import dot_kernels

        disc = peak_disc(self.size)
        u, v = dot_kernels.peaks(self.band, tuning.floor, disc)
        good = self._dot_like(u, v)
        if good.all():
            return u, v
        suspects = u[~good], v[~good]
        whole = mended(self.picture, tuning.noise, self.size, suspects)
        if whole is not self.picture:
            usual = typical(self.band[v, u][good].astype(float)) if good.any() else 0.0
            self.picture = whole
            self._pass()
            u, v = dot_kernels.peaks(self.band, tuning.floor, disc)
            near = dot_kernels.two_nearest(pairs(u, v), pairs(*suspects))[0][:, 0]
            good = self._dot_like(u, v)
            good &= (near > 2.0 * self.size) | (self.band[v, u] >= REMAINS_SHARE * usual)
        return u[good], v[good]

    def _dot_like(self, u: IntArray, v: IntArray) -> BoolArray:
        """Whether peaks are round, and answer no more to a much finer band than to the dots'."""
        from labapp.core.images import dot_kernels

        scale = max(0.4, self.size / 3.0)
        narrow, wide = (_nine(sigma * scale, 1.6 * scale) for sigma in (0.8, 1.6))
        sharp = dot_kernels.finest(self.picture, u, v, narrow, wide) >= HOT_RATIO * self.band[v, u]
        return np.asarray(~sharp & ~dot_kernels.ridges(self.band, u, v, SLENDER))

    def light(
        self, u: IntArray, v: IntArray, width: FloatArray, reach: float
    ) -> tuple[FloatArray, FloatArray]:
        """Centroids and moments of the light over its surroundings (`dot_kernels.centroids`)."""
        from labapp.core.images import dot_kernels

        widen(self._small, self.wide, ((3.0 * CENTROID_WIDENING) ** 2 - 0.8**2) * self.size**2)
        margin, taps, picture = margin_of(reach), kernel(0.5 * self.size), self.picture
        if len(u) * (2 * margin + 1) ** 2 > MOST_SURROUNDINGS * picture.size:
            picture, taps = blur(picture, 0.5 * self.size, self._narrow), kernel(0.0)
        return dot_kernels.centroids(picture, self.wide, taps, u, v, margin, width, reach)


def widen(image: Grey, into: Grey, variance_px2: float) -> Grey:
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
        blur(image, float(np.sqrt(variance_px2)), into)
        return image
    shape = height // scale, width // scale
    small, blurred = (scratch(f"{name} {scale}", shape) for name in ("small", "small blurred"))
    cv2.resize(image, shape[::-1], dst=small, interpolation=cv2.INTER_AREA)
    blur(small, float(np.sqrt(variance_px2 / scale**2 - ROUND_PX2)), blurred)
    cv2.resize(blurred, (width, height), dst=into)
    return small


def _found(tuning: DetectorTuning, seen: _BandPassed, settings: BandPassSettings) -> Dots:
    from labapp.core.images import dot_kernels

    u, v = seen.peaks(tuning)
    if len(u) == 0:
        raise CannotMeasure("no-dots", "no dot stands out of the frame's noise")
    bright = seen.band[v, u].astype(float)
    keep = bright >= settings.contrast * typical(bright)
    u, v = u[keep], v[keep]
    first = dot_kernels.first_of_each(u, v, max(1.5, seen.size))  # the top of a dot may be flat
    return _described(seen, u[first], v[first], tuning.noise, settings.speckle_px)


@lru_cache(maxsize=8)
def _nine(sigma: float, widest: float) -> Grey:
    """Gaussian weights of a pixel and its two neighbours on a line, as long as the widest's."""
    own, side = kernel(sigma), len(kernel(widest))
    line = np.pad(own, (side - len(own)) // 2)
    nine = np.stack([np.pad(line, (k, 2 - k)) for k in range(3)])
    nine.flags.writeable = False
    return np.asarray(nine)


def window_widths(next_px: FloatArray, reach: float) -> FloatArray:
    """Widths of the Gaussian windows of dots so far from the next one, shape (n,), px.

    A window that ends half-way to the next dot keeps its light out.
    """
    return np.minimum(1.1 * reach, np.maximum(0.275 * next_px, 0.75))


def margin_of(reach: float) -> int:
    """So far from a peak, px, light is weighed."""
    return int(np.ceil(2.2 * reach)) + 1


def _described(seen: _BandPassed, u: IntArray, v: IntArray, noise: Grey, speckle_px: float) -> Dots:
    """Centroid, its uncertainty, size, peak and signal-to-noise of each peak."""
    from labapp.core.images import dot_kernels

    place, size = np.stack([u, v], axis=1).astype(float), seen.size
    width = window_widths(dot_kernels.two_nearest(place, place)[0][:, 1], CENTROID_WIDENING * size)
    offset, moment = seen.light(u, v, width, CENTROID_WIDENING * size)
    moment = np.clip(moment / 2, 1e-3, 0.95 * width**2)
    spread = (1 / (1 / moment - 1 / width**2) - (0.5 * size) ** 2) / WIDTH_KEPT**2
    peak = seen.band[v, u].astype(float) / PEAK_GAIN
    snr = peak / np.maximum(noise[v, u], 1e-3 * np.max(peak))
    sigma = np.hypot(0.8 / snr, speckle_px)
    return Dots(
        u_px=u + offset[0],
        v_px=v + offset[1],
        u_sigma_px=sigma,
        v_sigma_px=sigma.copy(),
        size_px=np.sqrt(np.clip(spread, (0.3 * size) ** 2, (3.0 * size) ** 2)),
        peak=peak,
        snr=snr,
    )
