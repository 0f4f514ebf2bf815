"""The default detector: a band-pass filter at the dots' size, which is estimated from the frame.

The first frame and the following frames are searched in the same way, with the dot size and noise
of the first (`DetectorTuning`). Wide Gaussian blurs are computed on a downsampled picture, and
quantities that are needed at few pixels are computed only there.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from functools import cached_property, lru_cache

import cv2
import numpy as np
import scipy

from labapp.core.images.dot_fit import WINDOW_SHARE, fit_dots
from labapp.core.images.dot_size import (
    SLENDER,
    as_picture,
    band_noise,
    estimate_size,
    local_noise,
)
from labapp.core.images.dots import BandPassSettings, Dots, Grey, Image, Picture
from labapp.core.images.filters import (
    LEAST_NOISE,
    NARROW,
    WIDE,
    blur,
    kernel,
    noise_gain,
    pairs,
    peak_disc,
    scratch,
    smaller_blurred,
    widen,
    without_spikes,
)
from labapp.core.values import BoolArray, CannotMeasure, FloatArray, IntArray, ReadOnlyArrays

Peaks = tuple[IntArray, IntArray, FloatArray]
"""Columns and rows of pixels, and the value of the band-passed picture there."""

HOT_RATIO = 1.6
"""Lowest ratio of a hot-pixel cluster's response to a band at a third of the dot size and its
response to the band at the dot size."""

REMAINS_SHARE = 0.5
"""A peak near repaired pixels is a dot if it has at least this fraction of the typical dot's
brightness; residues of hot pixels are fainter."""

FAINT_SIGMA = 3.0
"""Threshold, in noise σ above the background, for a peak that the operator points at: half of that
for other peaks (`BandPassSettings.threshold`)."""

CENTROID_WIDENING = 1.4
"""Width of the window for centroids over that for detection. A wider window averages over more
speckle grains, which then move the centroid less."""

LIGHT_BLUR = 0.5
"""Blur of the light before centroids are computed, in dot sizes."""

WIDEST_WINDOW, LEAST_WINDOW_PX = 1.1, 0.75
"""Largest width of a window, over the reach of its centre; and the least, px."""

LEAST_MOMENT_PX2, MOST_MOMENT = 1e-3, 0.95
"""Least variance of the light in a window, and the largest, as a share of the window's. Uniform
light has that of the window, which gives no size."""

SIGMA_TIMES_SNR = 0.8
"""Standard uncertainty of a centroid due to the camera's noise, px, times the signal-to-noise
ratio."""

MOST_SURROUNDINGS = 0.3
"""If the dots' windows cover a larger share of the picture, all of it is blurred at once."""

HALVED_PX, NEARLY = 1.5, 0.75
"""Dots of at least this size are searched for at half resolution, where a peak above the threshold
has a pixel above this fraction of it."""

PEAK_GAIN = 1 / (1 + NARROW**2) - 1 / (1 + WIDE**2)
"""Peak height of a Gaussian dot of the band's size after the band-pass, over its height before."""

WIDTH_KEPT = 0.8
"""Width of a Gaussian dot after its background is subtracted, over its width before."""

AROUND_SIZES = 4.2
"""Standard deviation of the blur that gives the background of the dots, in dot sizes."""

AROUND_PX2 = 3.0
"""Least variance of that blur in the joint fit, px² of the downsampled picture, so that its samples
resolve it."""

LEAST_SIDE_PX, NO_ROOM = 8, "the frame is blank or too small to hold a dot"
"""Least height and width of a frame that can hold a dot, px; reason if it is smaller or blank."""

LEAST_SIGMA_PX = 0.02
"""Added in quadrature to the position uncertainty of jointly fitted dots, px."""


@dataclass(frozen=True)
class DetectorTuning(ReadOnlyArrays):
    """Dot size and noise estimated from a frame, for use with the following frames.

    Valid as long as illumination and camera settings do not change.

    Parameters
    ----------
    size_px
        Standard deviation of a dot's light, px.
    noise
        Local standard deviation of the camera's noise, grey levels, shape (height, width).
    over_noise, least
        Threshold for peaks of the band, as a multiple of the noise; its minimum, grey levels.
    """

    size_px: float
    noise: Grey
    over_noise: float
    least: float

    @classmethod
    def of(cls, frame: Image, settings: BandPassSettings) -> DetectorTuning:
        """Estimate the tuning from a frame, shape (height, width), of any real type.

        Raises
        ------
        CannotMeasure
            ``no-dots`` if the frame is too small to hold a dot.
        """
        return _tuned(as_picture(frame), settings)[0]

    def floor(self, noise: Grey) -> Grey:
        """Threshold for peaks where the noise has given values, of any shape."""
        return np.asarray(np.maximum(np.float32(self.over_noise) * noise, np.float32(self.least)))

    @cached_property
    def coarse(self) -> Grey:
        """Threshold for pixels of the half-resolution band that may contain a peak."""
        return np.float32(NEARLY) * self.floor(self.noise[::2, ::2])


def band_pass_dots(frame: Image, settings: BandPassSettings) -> Dots:
    """Find dots as peaks of a difference of Gaussians at the dots' size.

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
    return tuned_dots(frame, settings)[0]


def tuned_dots(frame: Image, settings: BandPassSettings) -> tuple[Dots, DetectorTuning]:
    """Find the dots of a frame (`band_pass_dots`) and the tuning for the following frames."""
    picture = as_picture(np.asarray(frame))
    if picture.size and not float(np.ptp(picture)) > 0:
        raise CannotMeasure("no-dots", NO_ROOM)
    tuning, seen = _tuned(picture, settings)
    return _found(tuning, seen, settings), tuning


def quick_dots(frame: Image, tuning: DetectorTuning, settings: BandPassSettings) -> Dots:
    """Find the dots of a frame with the tuning of a previous frame; faster than `band_pass_dots`.

    Parameters
    ----------
    frame
        Grey image of the tuning's shape, any real type.
    tuning
        The tuning of a previous frame.
    settings
        See `BandPassSettings`; its size is ignored in favour of the tuning's.

    Raises
    ------
    CannotMeasure
        ``no-dots`` if nothing stands out of the noise.
    ValueError
        If the frame and the tuning differ in shape.
    """
    if frame.shape != tuning.noise.shape:
        raise ValueError(f"a frame of {frame.shape}, a tuning of {tuning.noise.shape}")
    picture = without_spikes(as_picture(frame), tuning.noise, tuning.size_px)
    return _found(tuning, _BandPassed(picture, tuning.size_px), settings)


def crowded_dots(frame: Image, settings: BandPassSettings) -> Dots:
    """Find overlapping dots, such as those of a flat mirror, by a joint fit.

    Light of neighbouring dots shifts centroids of such dots by half a pixel. The joint fit takes
    several times as long and is therefore not used for the frames of a recording.

    Raises
    ------
    CannotMeasure
        ``no-dots`` if nothing stands out of the noise, or the frame is too small to hold a dot.
    """
    tuning, seen = _tuned(as_picture(frame), settings)
    return _top_to_bottom(_fitted(seen, _kept(tuning, seen, settings), tuning.noise))


def dot_at(
    frame: Image, u_px: float, v_px: float, others: Dots, settings: BandPassSettings
) -> Dots:
    """Find the dot at a position: the nearest peak, or the position itself if there is none.

    Parameters
    ----------
    frame
        Grey image, shape (height, width), any real type.
    u_px, v_px
        Position in the frame, px.
    others
        The dots found so far; their peaks are excluded and their light is masked.
    settings
        See `BandPassSettings`.

    Returns
    -------
    Dots
        One dot, with centroid and uncertainty as from `band_pass_dots`. Without another peak
        within two dot sizes, it is at (u_px, v_px) with the dot size as its uncertainty.

    Raises
    ------
    ValueError
        If the frame is too small to hold a dot.
    """
    size = settings.size_px or (float(np.median(others.size_px)) if len(others) else None)
    like = BandPassSettings(size, FAINT_SIGMA, 0.0, settings.speckle_px)
    try:
        tuning, seen = _tuned(as_picture(frame), like)
    except CannotMeasure as why:
        raise ValueError(why.reason) from why
    size = tuning.size_px
    u, v, _ = seen.peaks(tuning)
    away = np.hypot(u - u_px, v - v_px)
    taken = np.full(len(u), np.inf)
    if len(others) and len(u):
        taken = np.asarray(
            scipy.spatial.cKDTree(others.image_px).query(np.stack([u, v], axis=1))[0]
        )
    away[taken < max(1.5, size)] = np.inf
    if not (away <= 2.0 * size).any():
        at = round(v_px), round(u_px)
        peak = max(float(seen.band[at[0] // seen.step, at[1] // seen.step]), 0.0) / PEAK_GAIN
        snr = peak / max(float(tuning.noise[at]), LEAST_NOISE * peak, 1e-9)
        unsure = max(size, 1.0)
        return Dots(*(np.array([x]) for x in (u_px, v_px, unsure, unsure, size, peak, snr)))
    k = int(np.argmin(away))
    limit = np.array(frame.shape[::-1]) - 1
    known = np.clip(np.rint(others.image_px), 0, limit).astype(np.int64)
    u, v = np.append(known[:, 0], u[k]), np.append(known[:, 1], v[k])
    bright = seen.band[v // seen.step, u // seen.step].astype(float)
    every = _described(seen, (u, v, bright), tuning.noise, settings.speckle_px)
    return Dots(*(getattr(every, column.name)[-1:] for column in fields(every)))


def typical(brightness: FloatArray) -> float:
    """Return the light-weighted median brightness, which is insensitive to many faint specks."""
    order = np.sort(brightness)
    light = np.cumsum(order)
    return float(order[np.searchsorted(light, 0.5 * light[-1])])


def _tuned(picture: Picture, settings: BandPassSettings) -> tuple[DetectorTuning, _BandPassed]:
    """Return a picture's tuning and its band-passed picture.

    Raises
    ------
    CannotMeasure
        ``no-dots`` if the picture is too small to hold a dot.
    """
    if picture.ndim != 2 or min(picture.shape) < LEAST_SIDE_PX:
        raise CannotMeasure("no-dots", NO_ROOM)
    noise = local_noise(picture)
    size = settings.size_px or estimate_size(picture, noise)
    seen = _BandPassed(without_spikes(picture, noise, size), size)
    every, white = 4 // seen.step, float(np.median(noise[::8, ::8])) * noise_gain(size)
    grain = band_noise(seen.band[::every, ::every], white) / max(white, 1e-9)
    least = LEAST_NOISE * max(map(abs, cv2.minMaxLoc(seen.band)[:2])) + 1e-6
    over_noise = settings.threshold * grain * noise_gain(size)
    return DetectorTuning(size, noise, over_noise, settings.threshold * least), seen


class _BandPassed:
    """A picture and its band-pass at the dot size, in this thread's scratch memory.

    The band is at half resolution if the dots are large enough; ``step`` is the factor.
    """

    def __init__(self, picture: Picture, size: float) -> None:
        (height, width), self.picture, self.size = picture.shape, picture, size
        self.step = 2 if size >= HALVED_PX and height % 2 == width % 2 == 0 else 1
        shape = height // self.step, width // self.step
        self._narrow, self._wide, self.band = (scratch(f"{k} band", shape) for k in range(3))
        self._pass()

    def _pass(self) -> None:
        from labapp.core.images import band_pass_kernels

        size, lost = self.size / self.step, (1 - self.step**-2) / 12
        seen = band_pass_kernels.halved(self.picture) if self.step == 2 else self.picture
        blur(seen, float(np.sqrt((NARROW * size) ** 2 - lost)), self._narrow)
        widen(self._narrow, self._wide, (WIDE**2 - NARROW**2) * size**2)
        cv2.subtract(self._narrow, self._wide, dst=self.band)

    def peaks(self, tuning: DetectorTuning) -> Peaks:
        """Return the peaks above the threshold that may be dots.

        Peaks as sharp as hot pixels or as elongated as lines of them are suspect. Their pixels
        are repaired, since a dot of usual brightness may lie beneath them.
        """
        from labapp.core.images import band_pass_kernels

        u, v, bright = self._over(tuning)
        good = self._dot_like(u, v, bright)
        if good.all():
            return u, v, bright
        suspects = u[~good], v[~good]
        repaired = without_spikes(self.picture, tuning.noise, self.size, suspects)
        if repaired is not self.picture:
            typical_brightness = typical(bright[good]) if good.any() else 0.0
            self.picture = repaired
            self._pass()
            u, v, bright = self._over(tuning)
            near = band_pass_kernels.two_nearest(pairs(u, v), pairs(*suspects))[0][:, 0]
            good = self._dot_like(u, v, bright)
            good &= (near > 2.0 * self.size) | (bright >= REMAINS_SHARE * typical_brightness)
        return u[good], v[good], bright[good]

    def _over(self, tuning: DetectorTuning) -> Peaks:
        """Return the peaks above the threshold."""
        from labapp.core.images import band_pass_kernels

        band, disc = self.band, peak_disc(self.size)
        if self.step == 1:
            u, v = band_pass_kernels.peaks(band, tuning.floor(tuning.noise), disc)
            return u, v, band[v, u].astype(float)
        (u, v), bright = band_pass_kernels.upsampled_peaks(band, tuning.coarse, disc)
        over = bright > tuning.floor(tuning.noise[v, u])
        return u[over], v[over], bright[over]

    def _dot_like(self, u: IntArray, v: IntArray, bright: FloatArray) -> BoolArray:
        """Whether peaks are round and do not respond more strongly to a much finer band."""
        from labapp.core.images import band_pass_kernels, centroid_kernels

        scale = max(0.4, self.size / 3.0)
        narrow, wide = (_shifted_gaussians(sigma * scale, WIDE * scale) for sigma in (NARROW, WIDE))
        fine = centroid_kernels.largest_fine_response(self.picture, u, v, narrow, wide)
        sharp = fine >= HOT_RATIO * bright
        ridges = band_pass_kernels.ridges(self.band, u // self.step, v // self.step, SLENDER)
        return np.asarray(~sharp & ~ridges)

    def light(
        self, u: IntArray, v: IntArray, width: FloatArray, reach: float
    ) -> tuple[FloatArray, FloatArray]:
        """Return centroids and second moments of the background-subtracted light.

        Centroids (u, v) have shape (2, n), px; moments, the sum of the second central moments along
        u and v, shape (n,), px².

        Windows are moved a few times only; otherwise they would drift to a brighter neighbour.
        """
        from labapp.core.images import centroid_kernels

        variance = (AROUND_SIZES**2 - NARROW**2) * (self.size / self.step) ** 2
        around = smaller_blurred(self._narrow, variance)
        margin, taps, picture = margin_of(reach), kernel(LIGHT_BLUR * self.size), self.picture
        if len(u) * (2 * margin + 1) ** 2 > MOST_SURROUNDINGS * picture.size:
            into = scratch("picture", picture.shape)
            picture, taps = blur(picture, LIGHT_BLUR * self.size, into), kernel(0.0)
        (x, y), moment = centroid_kernels.centroids(
            picture, around, taps, u, v, margin, width, reach
        )
        return np.array([u + x, v + y]), moment

    def around(self) -> tuple[Grey, float]:
        """Return the downsampled, blurred picture and the blur's standard deviation, px."""
        image, (height, width), scale = self._narrow, self._narrow.shape, 1
        variance = (AROUND_SIZES**2 - NARROW**2) * (self.size / self.step) ** 2
        while (
            variance / (2 * scale) ** 2 > AROUND_PX2
            and height % (2 * scale) == width % (2 * scale) == 0
        ):
            scale *= 2
        shape = height // scale, width // scale
        if scale > 1:
            into = scratch(f"around {scale}", shape)
            image = np.asarray(
                cv2.resize(image, shape[::-1], into, 0, 0, cv2.INTER_AREA), np.float32
            )
        left = variance / scale**2 - (1 - scale**-2) / 12
        blurred = blur(image, float(np.sqrt(left)), scratch(f"around {scale} blurred", shape))
        return blurred, AROUND_SIZES * self.size


def _found(tuning: DetectorTuning, seen: _BandPassed, settings: BandPassSettings) -> Dots:
    u, v, bright = _kept(tuning, seen, settings)
    dots = _described(seen, (u, v, bright), tuning.noise, settings.speckle_px)
    return _top_to_bottom(dots)


def _kept(tuning: DetectorTuning, seen: _BandPassed, settings: BandPassSettings) -> Peaks:
    """Return the peaks that are bright enough, without duplicates."""
    from labapp.core.images import band_pass_kernels

    u, v, bright = seen.peaks(tuning)
    if len(u) == 0:
        raise CannotMeasure("no-dots", "no dot is brighter than the frame's noise")
    keep = np.flatnonzero(bright >= settings.contrast * typical(bright))
    # A dot with a flat top has several peaks.
    keep = keep[band_pass_kernels.first_of_each(u[keep], v[keep], max(1.5, seen.size))]
    return u[keep], v[keep], bright[keep]


def _top_to_bottom(dots: Dots) -> Dots:
    order = np.argsort(dots.v_px)
    return Dots(*(values[order] for values in vars(dots).values()))


@lru_cache(maxsize=8)
def _shifted_gaussians(sigma: float, widest: float) -> Grey:
    """Gaussian weights centred on a pixel and its two neighbours, shape (3, side).

    They are padded to the length of the widest kernel and by a pixel on either side.
    """
    weights, side = kernel(sigma), len(kernel(widest))
    shifted, before = np.zeros((3, side + 2), np.float32), (side - len(weights)) // 2
    for k in range(3):
        shifted[k, before + k : before + k + len(weights)] = weights
    shifted.flags.writeable = False
    return shifted


def window_widths(next_px: FloatArray, reach: float) -> FloatArray:
    """Return window widths from the distances to the nearest dots, shape (n,), px.

    A window that ends half-way to the nearest dot excludes its light.
    """
    return np.minimum(WIDEST_WINDOW * reach, np.maximum(WINDOW_SHARE * next_px, LEAST_WINDOW_PX))


def margin_of(reach: float) -> int:
    """Half side of the square about a peak in which light is integrated, px.

    It is twice the width of the widest window.
    """
    return int(np.ceil(2 * WIDEST_WINDOW * reach)) + 1


def _described(seen: _BandPassed, peaks: Peaks, noise: Grey, speckle_px: float) -> Dots:
    """Compute position, uncertainty, size, height and signal-to-noise ratio of each peak."""
    from labapp.core.images import band_pass_kernels

    (u, v, bright), size = peaks, seen.size
    width = window_widths(band_pass_kernels.next_apart(pairs(u, v)), CENTROID_WIDENING * size)
    (u_px, v_px), moment = seen.light(u, v, width, CENTROID_WIDENING * size)
    moment = np.minimum(np.maximum(moment / 2, LEAST_MOMENT_PX2), MOST_MOMENT * width**2)
    # Undo window, blur and background.
    spread = (1 / (1 / moment - 1 / width**2) - (LIGHT_BLUR * size) ** 2) / WIDTH_KEPT**2
    peak = bright / PEAK_GAIN
    snr = peak / np.maximum(noise[v, u], LEAST_NOISE * np.max(peak))
    sigma = np.hypot(SIGMA_TIMES_SNR / snr, speckle_px)
    return Dots(
        u_px=u_px,
        v_px=v_px,
        u_sigma_px=sigma,
        v_sigma_px=sigma.copy(),
        size_px=np.sqrt(np.minimum(np.maximum(spread, (0.3 * size) ** 2), (3.0 * size) ** 2)),
        peak=peak,
        snr=snr,
    )


def _fitted(seen: _BandPassed, peaks: Peaks, noise: Grey) -> Dots:
    """Compute the same for overlapping dots by a joint fit (`fit_dots`)."""
    (u, v, bright), size = peaks, seen.size
    peak = bright / PEAK_GAIN
    dot_noise = np.maximum(noise[v, u], LEAST_NOISE * np.max(peak)).astype(np.float64)
    start = np.stack([u, v, peak, np.full(len(u), size)], axis=1).astype(np.float64)
    fitted = fit_dots(seen.picture, seen.around(), start, dot_noise)
    return Dots(
        u_px=fitted.u_px,
        v_px=fitted.v_px,
        u_sigma_px=np.hypot(fitted.u_sigma_px, LEAST_SIGMA_PX),
        v_sigma_px=np.hypot(fitted.v_sigma_px, LEAST_SIGMA_PX),
        size_px=np.clip(fitted.size_px, 0.3 * size, 3.0 * size),
        peak=peak,
        snr=peak / dot_noise,
    )
