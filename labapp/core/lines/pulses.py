"""Detection of frames in which a welding pulse is on, from their brightness (§3.3, Fig. 3-20).

"When pulse is on the image is dominated by the arc light and when it is off the fluctuated laser
light reflected from molten weld pool surface is shown." The brightness of frames forms two
classes; a recorded current does so, too. As pulses are periodic, the phase of a frame in the period
is used as a prior.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from labapp.core.images.dots import Image
from labapp.core.values import BoolArray, FloatArray, ReadOnlyArrays, robust_sigma

EVERY_PX = 4
"""Pixel step along u and v for a frame's brightness."""

BINS = 25
"""Number of phase bins in which the share of frames with a pulse is counted."""

LEAST_CONTRAST = 4.0
"""Least distance between the two classes of brightness, in their widths; otherwise no pulses."""


@dataclass(frozen=True)
class Pulses(ReadOnlyArrays):
    """Frames with and without a pulse.

    Parameters
    ----------
    on
        Whether the pulse is on, shape (n,).
    probability
        Probability that the pulse is on, shape (n,).
    """

    on: BoolArray
    probability: FloatArray


def frame_brightness(frame: Image) -> float:
    """Median grey level of a frame: insensitive to spatter, lines and small areas of glare."""
    return float(np.median(np.asarray(frame[::EVERY_PX, ::EVERY_PX], np.float32)))


def classify_pulses(
    brightness: FloatArray,
    frame_rate_hz: float | None = None,
    current_a: FloatArray | None = None,
) -> Pulses:
    """Classify frames by whether the pulse is on.

    Parameters
    ----------
    brightness
        Brightness of each frame in order (`frame_brightness`), shape (n,).
    frame_rate_hz
        Frame rate, Hz; None: unknown, so the period is not used as a prior.
    current_a
        Weld current during each frame, A, shape (n,), NaN where unknown; None: not recorded.
    """
    given = [np.asarray(brightness, float)]
    given += [] if current_a is None else [np.asarray(current_a, float)]
    found = [odds for level in given if (odds := _class_odds(level)) is not None]
    if not found:
        off_all = np.zeros(len(given[0]), bool)
        return Pulses(off_all, np.zeros(len(off_all)))
    odds = np.sum(found, axis=0)
    frequency = float("nan") if frame_rate_hz is None else pulse_frequency(odds > 0, frame_rate_hz)
    if np.isfinite(frequency):
        assert frame_rate_hz is not None
        odds = odds + _prior_odds(odds > 0, frequency / frame_rate_hz)
    return Pulses(odds > 0, 1 / (1 + np.exp(-np.clip(odds, -50, 50))))


def _class_odds(level: FloatArray) -> FloatArray | None:
    """Log odds of a pulse from brightness or current; None if it does not form two classes."""
    odds, known = np.zeros(len(level)), np.isfinite(level)
    light = np.log(np.maximum(level[known], 0.5))
    if not len(light):
        return None
    threshold, contrast = _two_classes(light)
    if contrast < LEAST_CONTRAST:
        return None
    odds[known] = _log_odds(light, light > threshold)
    return odds


def _two_classes(light: FloatArray) -> tuple[float, float]:
    """Otsu's threshold between two classes, and their distance in widths."""
    ordered = np.sort(light)
    count = np.arange(1, len(ordered))
    below, total = np.cumsum(ordered)[:-1], ordered.sum()
    if not len(count):
        return float(light[0]) if len(light) else 0.0, 0.0
    low, high = below / count, (total - below) / (len(ordered) - count)
    between = count * (len(ordered) - count) * (high - low) ** 2
    cut = int(np.argmax(between))
    first, second = ordered[: cut + 1], ordered[cut + 1 :]
    width = max(_spread(first), _spread(second), 0.02)
    distance = float(np.median(second) - np.median(first))
    # Midpoint of the light, not of its logarithm: a pulse over half an exposure is half as bright.
    levels = np.exp([np.median(first), np.median(second)])
    return float(np.log(levels.mean())), distance / width


def _spread(values: FloatArray) -> float:
    return robust_sigma(values - np.median(values))


def _log_odds(light: FloatArray, on: BoolArray) -> FloatArray:
    """Log odds of a pulse from the brightness relative to both medians."""
    level = np.exp(light)
    off_level, on_level = (float(np.median(level[part])) for part in (~on, on))
    step = on_level - off_level
    return np.asarray(20.0 * ((level - off_level) / step - 0.5))


def pulse_frequency(on: BoolArray, frame_rate_hz: float) -> float:
    """Frequency of the pulses, Hz; NaN if they are not periodic, or all frames are alike.

    Parameters
    ----------
    on
        Whether the pulse is on in each frame, shape (n,).
    frame_rate_hz
        Frame rate, Hz.
    """
    count = len(on)
    if count < 16 or on.all() or not on.any():
        return float("nan")
    wave = (on - on.mean()) * np.hanning(count)
    power = np.abs(np.fft.rfft(wave, 8 * count)) ** 2
    first = 16  # two periods in the recording
    peak = first + int(np.argmax(power[first:]))
    if power[peak] < 0.2 * (count / 4) * np.sum(wave**2) / 4:
        return float("nan")
    return float(peak * frame_rate_hz / (8 * count))


def _prior_odds(on: BoolArray, per_frame: float) -> FloatArray:
    """Log odds of a pulse from the frame's phase in the period."""
    best, sharpest = np.zeros(len(on)), -1.0
    frames = np.arange(len(on))
    # Refine the period so that the phase is correct at both ends of the recording.
    for rate in per_frame + np.linspace(-1, 1, 41) / (4 * len(on)):
        place = np.floor(frames * rate % 1.0 * BINS).astype(int)
        shares = (np.bincount(place, on, BINS) + 0.5) / (np.bincount(place, minlength=BINS) + 1.0)
        odds = np.log(shares / (1 - shares))
        sharp = float(np.abs(odds).mean())
        if sharp > sharpest:
            best, sharpest = odds[place], sharp
    return best
