"""Power spectral densities over time with confidence intervals, and tracking of the peak.

Evenly spaced frames: segments with Hann's window and 50 % overlap (Welch 1967; `scipy.signal`). If
frames are missing, none are interpolated: each segment uses the Lomb–Scargle periodogram, with the
same window as weights (Scargle 1982; `scipy.signal.lombscargle`).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy import signal, stats

from labapp.core.dynamics.oscillation import FEWEST, fit_oscillations
from labapp.core.values import FloatArray, ReadOnlyArrays

EVEN = 0.05
"""Largest relative deviation of time steps that are treated as equal."""

SEGMENTS = 8
"""Default number of segments of a recording, not counting the overlapping ones between."""

LEAST_FILLED = 0.5
"""Least share of a segment's frames that must be present for a spectrum."""

OVERLAP_SHARE = 1 / 36
"""Squared correlation of the powers of neighbouring segments, Hann's window, 50 % overlap (Welch
1967)."""


@dataclass(frozen=True)
class Spectrum(ReadOnlyArrays):
    """One-sided power spectral density of a series; f frequencies.

    Parameters
    ----------
    frequency_hz, density
        Frequencies and densities, shape (f,), Hz and unit²/Hz.
    low, high
        Confidence interval of the density (χ²), shape (f,).
    """

    frequency_hz: FloatArray
    density: FloatArray
    low: FloatArray
    high: FloatArray


@dataclass(frozen=True)
class Spectrogram(ReadOnlyArrays):
    """Power spectral densities of s segments; NaN if too many frames are missing.

    Parameters
    ----------
    time_s
        Middle of each segment, shape (s,), s.
    frequency_hz
        Shape (f,), Hz.
    density
        Shape (s, f), unit²/Hz; each has two degrees of freedom.
    segment_s
        Duration of a segment, s.
    """

    time_s: FloatArray
    frequency_hz: FloatArray
    density: FloatArray
    method: Literal["Welch", "Lomb-Scargle"]
    segment_s: float

    def mean(self, confidence: float = 0.95) -> Spectrum:
        """Mean density of all segments, with its confidence interval."""
        there = np.isfinite(self.density[:, 0])
        count = int(there.sum())
        density = self.density[there].mean(axis=0) if count else self.density.sum(axis=0)
        freedom = 2 * count / (1 + 2 * OVERLAP_SHARE * max(count - 1, 0) / max(count, 1))
        low, high = freedom / stats.chi2.ppf([(1 + confidence) / 2, (1 - confidence) / 2], freedom)
        return Spectrum(self.frequency_hz, density, density * low, density * high)


@dataclass(frozen=True)
class PeakTrack(ReadOnlyArrays):
    """Strongest oscillation of each segment; NaN if none is significant.

    Parameters
    ----------
    time_s, frequency_hz, frequency_sigma_hz, amplitude
        Shape (s,); s, Hz, Hz, the unit of the series.
    """

    time_s: FloatArray
    frequency_hz: FloatArray
    frequency_sigma_hz: FloatArray
    amplitude: FloatArray


def spectrogram(
    time_s: FloatArray, values: FloatArray, segment_s: float | None = None
) -> Spectrogram:
    """Power spectral density of a series over time.

    Parameters
    ----------
    time_s, values
        Times, ascending, s, and values, shape (n,). Missing frames are omitted from both.
    segment_s
        Duration of a segment; None: an eighth of the series.

    Raises
    ------
    ValueError
        If a segment would have fewer than `FEWEST` frames.
    """
    step, length = _step_and_length(time_s, segment_s)
    if np.all(np.abs(np.diff(time_s) - step) <= EVEN * step):
        frequency, middle, density = signal.spectrogram(
            values, 1 / step, "hann", length, length // 2, detrend="linear"
        )
        middle = time_s[0] + middle - step / 2  # SciPy counts from half a frame before the first
        return Spectrogram(middle, frequency[1:], density.T[:, 1:], "Welch", length * step)
    frequency = np.asarray(np.fft.rfftfreq(length, step)[1:], float)
    begins = _begins(time_s, step, length)
    density = np.full((len(begins), len(frequency)), np.nan)
    for row, begin in zip(density, begins, strict=True):
        within = _within(time_s, begin, step, length)
        if within.sum() >= LEAST_FILLED * length:
            row[:] = _lomb_scargle(time_s[within] - begin, values[within], frequency, step, length)
    return Spectrogram(
        begins + length * step / 2, frequency, density, "Lomb-Scargle", length * step
    )


def track_peak(
    time_s: FloatArray,
    values: FloatArray,
    segment_s: float | None = None,
    band_hz: tuple[float, float] | None = None,
) -> PeakTrack:
    """Frequency of the strongest oscillation of each segment, by `fit_oscillations`.

    Segments and parameters as in `spectrogram`; ``band_hz`` as in `fit_oscillations`. If the
    frequency changes within a segment, the result is that at its middle.
    """
    step, length = _step_and_length(time_s, segment_s)
    begins = _begins(time_s, step, length)
    found = np.full((3, len(begins)), np.nan)
    for column, begin in zip(found.T, begins, strict=True):
        within = _within(time_s, begin, step, length)
        if within.sum() < max(FEWEST, LEAST_FILLED * length):
            continue
        for one in fit_oscillations(time_s[within], values[within], 1, band_hz):
            at = begin + length * step / 2 - time_s[within][0]
            size = float(abs(one.amplitude[0]) * np.exp(-one.damping_per_s * at))
            column[:] = one.frequency_hz, one.frequency_sigma_hz, size
    frequency, sigma, amplitude = found
    return PeakTrack(begins + length * step / 2, frequency, sigma, amplitude)


def _step_and_length(time_s: FloatArray, segment_s: float | None) -> tuple[float, int]:
    """Time between frames, s, and frames in a segment."""
    if len(time_s) < FEWEST:
        raise ValueError(f"a spectrum needs {FEWEST} frames; there are {len(time_s)}")
    step = float(np.median(np.diff(time_s)))
    frames = (time_s[-1] - time_s[0]) / step + 1
    wanted = frames / SEGMENTS if segment_s is None else segment_s / step
    length = round(min(max(wanted, 4 * FEWEST if segment_s is None else 0), frames))
    if length < FEWEST:
        raise ValueError(f"a segment of {segment_s} s has fewer than {FEWEST} frames")
    return step, length


def _begins(time_s: FloatArray, step: float, length: int) -> FloatArray:
    """Begin of each segment, half a frame before its first frame, shape (s,), s."""
    frames = round((time_s[-1] - time_s[0]) / step) + 1
    first = np.arange(0, frames - length + 1, length - length // 2)
    return np.asarray(time_s[0] + (first - 0.5) * step)


def _within(time_s: FloatArray, begin: float, step: float, length: int) -> np.ndarray:
    return (time_s > begin) & (time_s < begin + length * step)


def _lomb_scargle(
    time: FloatArray, value: FloatArray, frequency: FloatArray, step: float, length: int
) -> FloatArray:
    """Density of a segment, scaled so that white noise gives that of a segment without gaps."""
    window = np.sin(np.pi * time / (length * step)) ** 2
    trend = np.polynomial.Polynomial.fit(time, value, 1, w=np.sqrt(window + 1e-6))
    rest = value - trend(time)
    at = 2 * np.pi * frequency
    power = signal.lombscargle(time, rest, at, weights=window) * 4 / len(time)  # amplitude²
    return np.asarray(power * step / 2 * window.sum() ** 2 / np.sum(window**2))
