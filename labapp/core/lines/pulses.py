"""Frames in which a welding pulse is on, from the light alone (§3.3, Fig. 3-20).

"When pulse is on the image is dominated by the arc light and when it is off the fluctuated laser
light reflected from molten weld pool surface is shown." A frame's brightness falls into two
classes; as pulses repeat, the frame's place in their period is a prior.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from labapp.core.images.dots import Image
from labapp.core.values import BoolArray, FloatArray, ReadOnlyArrays

EVERY_PX = 4
"""One pixel of so many along u and along v is enough for a frame's brightness."""

BINS = 25
"""Parts of the period in which the share of frames with a pulse is counted."""

LEAST_CONTRAST = 4.0
"""Two classes of brightness are this many of their widths apart, or there are no pulses."""


@dataclass(frozen=True)
class Pulses(ReadOnlyArrays):
    """Frames with and without a pulse.

    Parameters
    ----------
    on
        Whether the pulse is on, shape (n,).
    probability
        That it is on, shape (n,).
    frequency_hz
        Of the pulses; NaN where they do not repeat, or there are none.
    """

    on: BoolArray
    probability: FloatArray
    frequency_hz: float


def frame_brightness(frame: Image) -> float:
    """Median of a frame's pixels, grey levels: spatter, lines and small glare do not move it."""
    return float(np.median(np.asarray(frame[::EVERY_PX, ::EVERY_PX], np.float32)))


def classify_pulses(brightness: FloatArray, frame_rate_hz: float | None = None) -> Pulses:
    """Sort frames by pulse on and off.

    Parameters
    ----------
    brightness
        Of each frame in order (`frame_brightness`), shape (n,).
    frame_rate_hz
        Frames a second; None: unknown, and the period is no prior.
    """
    light = np.log(np.maximum(np.asarray(brightness, float), 0.5))
    threshold, contrast = _two_classes(light)
    off_all = np.zeros(len(light), bool)
    if contrast < LEAST_CONTRAST:
        return Pulses(off_all, np.zeros(len(light)), float("nan"))
    odds = _log_odds(light, light > threshold)
    frequency = float("nan") if frame_rate_hz is None else pulse_frequency(odds > 0, frame_rate_hz)
    if np.isfinite(frequency):
        assert frame_rate_hz is not None
        odds = odds + _prior_odds(odds > 0, frequency / frame_rate_hz)
    return Pulses(odds > 0, 1 / (1 + np.exp(-np.clip(odds, -50, 50))), frequency)


def _two_classes(light: FloatArray) -> tuple[float, float]:
    """Threshold between two classes of least spread (Otsu), and their distance in widths."""
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
    # Half-way in light, not in its logarithm: a pulse over half of an exposure is half as bright.
    levels = np.exp([np.median(first), np.median(second)])
    return float(np.log(levels.mean())), distance / width


def _spread(values: FloatArray) -> float:
    return 1.4826 * float(np.median(np.abs(values - np.median(values))))


def _log_odds(light: FloatArray, on: BoolArray) -> FloatArray:
    """Log odds of a pulse from brightness: Laplace's distributions about both medians."""
    level = np.exp(light)
    off_level, on_level = (float(np.median(level[part])) for part in (~on, on))
    step = on_level - off_level
    return np.asarray(20.0 * ((level - off_level) / step - 0.5))


def pulse_frequency(on: BoolArray, frame_rate_hz: float) -> float:
    """Frequency of the pulses, Hz; NaN where they do not repeat.

    Parameters
    ----------
    on
        Whether the pulse is on in each frame, shape (n,).
    frame_rate_hz
        Frames a second.
    """
    count = len(on)
    if count < 16:
        return float("nan")
    wave = (on - on.mean()) * np.hanning(count)
    power = np.abs(np.fft.rfft(wave, 8 * count)) ** 2
    first = 16  # two periods in the recording
    peak = first + int(np.argmax(power[first:]))
    if power[peak] < 0.2 * (count / 4) * np.sum(wave**2) / 4:
        return float("nan")
    return float(peak * frame_rate_hz / (8 * count))


def _prior_odds(on: BoolArray, per_frame: float) -> FloatArray:
    """Log odds of a pulse from the frame's place in the period."""
    best, sharpest = np.zeros(len(on)), -1.0
    frames = np.arange(len(on))
    # The period to so much that the phase is right at both ends.
    for rate in per_frame + np.linspace(-1, 1, 41) / (4 * len(on)):
        place = np.floor(frames * rate % 1.0 * BINS).astype(int)
        shares = (np.bincount(place, on, BINS) + 0.5) / (np.bincount(place, minlength=BINS) + 1.0)
        odds = np.log(shares / (1 - shares))
        sharp = float(np.abs(odds).mean())
        if sharp > sharpest:
            best, sharpest = odds[place], sharp
    return best
