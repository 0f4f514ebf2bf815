"""Trends of the pool's measures over a recording: series, statistics, spectrum."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import scipy

from labapp.core.sequence.mean import setup_sigma_of_mean, sigma_of_mean
from labapp.core.surface.measures import WITH_SIGMA, sigma_name
from labapp.core.values import BoolArray, FloatArray, IntArray, ReadOnlyArrays
from labapp.session.results.measured import Overview
from labapp.text import split_unit

NEIGHBOURS = 15
"""Number of frames in the running median with which a frame is compared."""

FEWEST = 8
"""Fewest frames for this comparison, and for a spectrum."""

FAR_SIGMA, FAR_PART = 6.0, 0.05
"""A frame is outlying if a size deviates from the median by more than both, in robust σ and as a
fraction of the median."""

FAR_ARE = 3.0
"""A frame is also outlying if its ARE exceeds the median by this factor: a wrong column increases
it by a factor of 5, a wrong orientation by 10."""

EVEN = 0.05
"""Largest relative difference of equal time steps."""


LABELS = {name: split_unit(name)[0].capitalize() for name in WITH_SIGMA} | {
    "are_mm": "ARE",
    "center_x_mm": "Centre X",
    "center_y_mm": "Centre Y",
    "peak_x_mm": "Peak X",
    "peak_y_mm": "Peak Y",
}
"""Measures that can be shown as trends, by their names in `Measures`, and their labels."""


@dataclass(frozen=True)
class Trend(ReadOnlyArrays):
    """A measure over the n frames that have it."""

    key: str
    """The measure, one of `LABELS`."""
    frame: IntArray
    """Numbers of the frames, ascending, shape (n,)."""
    at: FloatArray
    """Times, s, or if any is unknown, frame numbers, shape (n,)."""
    timed: bool
    """Whether ``at`` is in s."""
    place: IntArray
    """Indices among the session's frames, ascending, shape (n,)."""
    value: FloatArray
    sigma: FloatArray
    """Values and their σ, shape (n,), in the measure's unit; σ is NaN if unknown."""
    outlying: BoolArray
    stale: BoolArray
    corrected: BoolArray
    """Which are outlying (`outlying_frames`), stale, corrected manually, shape (n,)."""
    counts: BoolArray
    """Which are included in the statistics and the spectrum, shape (n,)."""
    measures: Mapping[str, FloatArray]
    """All measures of these frames by name, each of shape (n,)."""

    @property
    def label(self) -> str:
        """Label of the measure, without its unit."""
        return LABELS[self.key]

    @property
    def unit(self) -> str:
        """Unit of the measure; empty for a ratio."""
        return split_unit(self.key)[1]


@dataclass(frozen=True)
class Statistics:
    """Mean, standard deviation and range of a measure (Eq. 7-2 … 7-4)."""

    count: int
    mean: float
    deviation: float
    lowest: float
    highest: float
    """Statistics in the measure's unit; the standard deviation has the divisor n, as in the text.
    NaN without a frame.
    """
    mean_sigma: float = math.nan
    """Standard uncertainty of the mean (`sigma_of_mean`); NaN if the measure has none."""
    mean_setup_sigma: float = 0.0
    """Part of it from the set-up (`setup_sigma_of_mean`)."""


@dataclass(frozen=True)
class Spectrum(ReadOnlyArrays):
    """Amplitude spectrum of a measure."""

    frequency: FloatArray
    """Frequencies from one period in the series to half the frame rate, shape (k,), Hz, or 1/frame
    if times are unknown.
    """
    amplitude: FloatArray
    """Amplitude of a sine of that frequency, shape (k,), in the measure's unit."""
    first: int
    last: int
    """First and last frame of the series."""
    count: int
    """Number of frames of the series."""
    resolution: float
    """Frequency resolution: two frequency steps, half the width of the Hann window's main lobe."""

    @property
    def peak(self) -> tuple[float, float]:
        """Frequency and amplitude of the strongest oscillation; at the first one, of a drift."""
        strongest = int(np.argmax(self.amplitude))
        return float(self.frequency[strongest]), float(self.amplitude[strongest])


def trend(
    seen: Overview, key: str, without_outlying: bool = False, outlying: BoolArray | None = None
) -> Trend:
    """Return the trend of a measure.

    Parameters
    ----------
    key
        Name of the measure, one of `LABELS`.
    without_outlying
        Whether outlying frames are excluded from the statistics. Stale results always are.
    outlying
        Result of `outlying_frames`, if already known.
    """
    value = seen.measures[key]
    has = np.flatnonzero(np.isfinite(value))
    timed = bool(np.isfinite(seen.time_s).all())
    outlying = outlying_frames(seen) if outlying is None else outlying
    counts = ~seen.stale & ~(outlying & without_outlying)
    sigma = seen.measures.get(sigma_name(key), np.full(len(value), np.nan))
    return Trend(
        key=key,
        frame=seen.frame[has],
        at=(seen.time_s if timed else seen.frame.astype(float))[has],
        timed=timed,
        place=has.astype(np.int64),
        value=value[has],
        sigma=sigma[has],
        outlying=outlying[has],
        stale=seen.stale[has],
        corrected=seen.corrected[has],
        counts=counts[has],
        measures={name: values[has] for name, values in seen.measures.items()},
    )


def outlying_frames(seen: Overview) -> BoolArray:
    """Return which frames have a surface that deviates from the neighbouring ones, shape (n,).

    These have a width, length or height far from the median of the neighbours, or an ARE far above
    the median. They should be inspected, but need not be wrong.
    """
    outlying = np.zeros(len(seen.frame), bool)
    has = np.isfinite(seen.measures["height_mm"]) & ~seen.stale
    if has.sum() < FEWEST:
        return outlying
    are = seen.measures["are_mm"][has]
    out = are > FAR_ARE * np.nanmedian(are) if np.isfinite(are).any() else np.zeros(len(are), bool)
    for key in ("width_mm", "length_mm", "height_mm"):
        size = seen.measures[key][has]
        # With "mirror" an outlier at the end is not repeated in the window.
        usual = scipy.ndimage.median_filter(size, min(NEIGHBOURS, len(size)), mode="mirror")
        off = np.abs(size - usual)
        out |= off > np.maximum(
            FAR_SIGMA * 1.4826 * np.nanmedian(off), FAR_PART * np.abs(np.nanmedian(size))
        )
    outlying[has] = out
    return outlying


def statistics_of(course: Trend) -> Statistics:
    """Return mean, ±, standard deviation and range of the included frames (Eq. 7-2 … 7-4)."""
    value = course.value[course.counts]
    if not len(value):
        return Statistics(0, *(4 * (float("nan"),)))
    counted = {k: v[course.counts] for k, v in course.measures.items()}
    return Statistics(
        len(value),
        float(value.mean()),
        float(value.std()),
        float(value.min()),
        float(value.max()),
        sigma_of_mean(course.key, counted),
        setup_sigma_of_mean(course.key, counted),
    )


def spectrum(course: Trend) -> Spectrum:
    """Return the spectrum of the longest run of consecutive, evenly spaced, included frames.

    The linear trend is removed; the window is a Hann window.

    Raises
    ------
    ValueError
        If the run is too short, or all its values are the same.
    """
    members = _even_part(course)
    count = len(members)
    if count < FEWEST:
        raise ValueError(
            f"a spectrum needs {FEWEST} frames in a row, evenly spaced in time; "
            f"there are {count} at most",
        )
    if np.ptp(course.value[members]) == 0:
        raise ValueError("there is no oscillation: the value is the same in all frames")
    from scipy.signal import detrend  # a slow import, not needed at the app's start
    from scipy.signal.windows import hann

    window = hann(count, sym=False)
    step = float(course.at[members[-1]] - course.at[members[0]]) / (count - 1)
    value = detrend(course.value[members]) * window
    amplitude = 2 * np.abs(np.fft.rfft(value)) / window.sum()
    frequency = np.asarray(np.fft.rfftfreq(count, step), np.float64)
    return Spectrum(
        frequency=frequency[1:],
        amplitude=amplitude[1:],
        first=int(course.frame[members[0]]),
        last=int(course.frame[members[-1]]),
        count=count,
        resolution=2 / (count * step),
    )


def _even_part(course: Trend) -> IntArray:
    """Return the indices of the longest run of included, consecutive, evenly spaced frames."""
    kept = np.flatnonzero(course.counts)
    if len(kept) < 2:
        return kept.astype(np.int64)
    step = np.diff(course.at[kept])
    usual = float(np.median(step))
    joined = (np.diff(course.place[kept]) == 1) & (np.abs(step - usual) <= EVEN * usual)
    ends = np.flatnonzero(np.concatenate([[True], ~joined, [True]]))
    longest = int(np.argmax(np.diff(ends)))
    return np.asarray(kept[ends[longest] : ends[longest + 1]], np.int64)
