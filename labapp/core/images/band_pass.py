"""The default detector: a band-pass filter at the dots' size, which is estimated from the frame.

The first frame and the following frames are searched in the same way, with the dot size and noise
of the first (`DetectorTuning`).
"""

from __future__ import annotations

from dataclasses import fields

import cv2
import numpy as np
import scipy

from labapp.core.images.dot_fit import WINDOW_SHARE, fit_dots
from labapp.core.images.dot_size import (
    as_picture,
    band_noise,
    estimate_size,
    local_noise,
)
from labapp.core.images.dots import BandPassSettings, Dots, Grey, Image, Picture
from labapp.core.images.filters import (
    LEAST_NOISE,
    noise_gain,
    pairs,
    without_spikes,
)
from labapp.core.images.peaks import (
    LIGHT_BLUR,
    PEAK_GAIN,
    WIDEST_WINDOW,
    BandPassed,
    DetectorTuning,
    Peaks,
    typical,
)
from labapp.core.values import CannotMeasure, FloatArray

FAINT_SIGMA = 3.0
"""Threshold, in noise σ above the background, for a peak that the operator points at: half of that
for other peaks (`BandPassSettings.threshold`)."""

CENTROID_WIDENING = 1.4
"""Width of the window for centroids over that for detection. A wider window averages over more
speckle grains, which then move the centroid less."""

LEAST_WINDOW_PX = 0.75
"""Least width of a window, px; the largest is `WIDEST_WINDOW`."""

LEAST_MOMENT_PX2, MOST_MOMENT = 1e-3, 0.95
"""Least variance of the light in a window, and the largest, as a share of the window's. Uniform
light has that of the window, which gives no size."""

SIGMA_TIMES_SNR = 0.8
"""Standard uncertainty of a centroid due to the camera's noise, px, times the signal-to-noise
ratio."""

WIDTH_KEPT = 0.8
"""Width of a Gaussian dot after its background is subtracted, over its width before."""

LEAST_SIDE_PX, NO_ROOM = 8, "the frame is blank or too small to hold a dot"
"""Least height and width of a frame that can hold a dot, px; reason if it is smaller or blank."""

LEAST_SIGMA_PX = 0.02
"""Added in quadrature to the position uncertainty of jointly fitted dots, px."""


def tuning_of(frame: Image, settings: BandPassSettings) -> DetectorTuning:
    """Estimate the tuning from a frame, shape (height, width), of any real type.

    Raises
    ------
    CannotMeasure
        ``no-dots`` if the frame is too small to hold a dot.
    """
    return _tuned(as_picture(frame), settings)[0]


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
    return _found(tuning, BandPassed(picture, tuning.size_px), settings)


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
    return _top_to_bottom(
        _fitted(seen, _kept(tuning, seen, settings, are_crowded=True), tuning.noise)
    )


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


def _tuned(picture: Picture, settings: BandPassSettings) -> tuple[DetectorTuning, BandPassed]:
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
    seen = BandPassed(without_spikes(picture, noise, size), size)
    every, white = 4 // seen.step, float(np.median(noise[::8, ::8])) * noise_gain(size)
    grain = band_noise(seen.band[::every, ::every], white) / max(white, 1e-9)
    least = LEAST_NOISE * max(map(abs, cv2.minMaxLoc(seen.band)[:2])) + 1e-6
    over_noise = settings.threshold * grain * noise_gain(size)
    return DetectorTuning(size, noise, over_noise, settings.threshold * least), seen


def _found(tuning: DetectorTuning, seen: BandPassed, settings: BandPassSettings) -> Dots:
    u, v, bright = _kept(tuning, seen, settings)
    dots = _described(seen, (u, v, bright), tuning.noise, settings.speckle_px)
    return _top_to_bottom(dots)


def _kept(
    tuning: DetectorTuning, seen: BandPassed, settings: BandPassSettings, are_crowded: bool = False
) -> Peaks:
    """Return the peaks that are bright enough, without duplicates."""
    from labapp.core.images import band_pass_kernels

    u, v, bright = seen.peaks(tuning, are_crowded)
    if len(u) == 0:
        raise CannotMeasure("no-dots", "no dot is brighter than the frame's noise")
    keep = np.flatnonzero(bright >= settings.contrast * typical(bright))
    # A dot with a flat top has several peaks.
    keep = keep[band_pass_kernels.first_of_each(u[keep], v[keep], max(1.5, seen.size))]
    return u[keep], v[keep], bright[keep]


def _top_to_bottom(dots: Dots) -> Dots:
    order = np.argsort(dots.v_px)
    return Dots(*(values[order] for values in vars(dots).values()))


def window_widths(next_px: FloatArray, reach: float) -> FloatArray:
    """Return window widths from the distances to the nearest dots, shape (n,), px.

    A window that ends half-way to the nearest dot excludes its light.
    """
    return np.minimum(WIDEST_WINDOW * reach, np.maximum(WINDOW_SHARE * next_px, LEAST_WINDOW_PX))


def _described(seen: BandPassed, peaks: Peaks, noise: Grey, speckle_px: float) -> Dots:
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


def _fitted(seen: BandPassed, peaks: Peaks, noise: Grey) -> Dots:
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
