"""How the pool changes over a recording: series of its measures, their spread, their spectrum."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import scipy

from labapp.core.sequence.mean import setup_sigma_of_mean, sigma_of_mean
from labapp.core.values import BoolArray, FloatArray, IntArray, ReadOnlyArrays
from labapp.session.measured import Overview

NEIGHBOURS = 15
"""Number of frames around a frame with whose median it is compared …"""

FEWEST = 8
"""… and with none where there are fewer in all."""

FAR_SIGMA, FAR_PART = 6.0, 0.05
"""It is in doubt if a size is farther from that than both, in robust σ and as a part of it …"""

FAR_ARE = 3.0
"""… or its ARE is so many times the usual one: a wrong column makes it 5 times, a wrong
orientation 10 times as large."""

EVEN = 0.05
"""Steps in time that differ by a smaller part are equal."""


@dataclass(frozen=True)
class Quantity:
    """A measure whose course can be shown."""

    key: str
    """Its name in `Measures`."""
    label: str
    unit: str
    sigma: str = ""
    """Name of its σ in `Measures`; empty where there is none."""


QUANTITIES = (
    Quantity("width_mm", "Width", "mm", "width_sigma_mm"),
    Quantity("length_mm", "Length", "mm", "length_sigma_mm"),
    Quantity("height_mm", "Height", "mm", "height_sigma_mm"),
    Quantity("depth_mm", "Depth", "mm", "depth_sigma_mm"),
    Quantity("area_mm2", "Area", "mm²", "area_sigma_mm2"),
    Quantity("volume_mm3", "Volume", "mm³", "volume_sigma_mm3"),
    Quantity("convexity_mm", "Convexity", "mm", "convexity_sigma_mm"),
    Quantity("asymmetry", "Asymmetry", "", "asymmetry_sigma"),
    Quantity("wetting_slope_deg", "Wetting slope", "°", "wetting_slope_sigma_deg"),
    Quantity("are_mm", "ARE", "mm"),
    Quantity("center_x_mm", "Centre X", "mm"),
    Quantity("center_y_mm", "Centre Y", "mm"),
    Quantity("peak_x_mm", "Peak X", "mm"),
    Quantity("peak_y_mm", "Peak Y", "mm"),
)
BY_KEY = {quantity.key: quantity for quantity in QUANTITIES}


@dataclass(frozen=True)
class Trend(ReadOnlyArrays):
    """One measure over the frames that have it; n frames."""

    quantity: Quantity
    frame: IntArray
    """Numbers of the frames, ascending, shape (n,)."""
    at: FloatArray
    """Their times, s, or where any is unknown, again their numbers, shape (n,)."""
    timed: bool
    """Whether ``at`` is in s."""
    place: IntArray
    """Their places among the session's frames, ascending, shape (n,)."""
    value: FloatArray
    sigma: FloatArray
    """Shape (n,), in the quantity's unit; σ is NaN where there is none."""
    doubtful: BoolArray
    stale: BoolArray
    corrected: BoolArray
    """Which stand out (`doubtful_frames`), no longer stand, were corrected by hand, shape (n,)."""
    counts: BoolArray
    """Which go into the statistics and the spectrum, shape (n,)."""
    measures: Mapping[str, FloatArray]
    """All measures of these frames by their names, each of shape (n,)."""


@dataclass(frozen=True)
class Spread:
    """Mean, standard deviation and range of a measure (Eq. 7-2 … 7-4)."""

    count: int
    mean: float
    deviation: float
    lowest: float
    highest: float
    """In the measure's unit; the deviation is the root of the mean square, divided by n as in the
    text. NaN without a frame.
    """
    mean_sigma: float = math.nan
    """Standard uncertainty of the mean (`sigma_of_mean`); NaN where the measure has none."""
    mean_setup_sigma: float = 0.0
    """The set-up's part of that (`setup_sigma_of_mean`)."""


@dataclass(frozen=True)
class Spectrum(ReadOnlyArrays):
    """Amplitudes of a measure's oscillation."""

    frequency: FloatArray
    """From the lowest that the series resolves to half the rate, shape (k,), Hz, or 1/frame where
    times are not known.
    """
    amplitude: FloatArray
    """Of a sine of that frequency, shape (k,), in the measure's unit."""
    timed: bool
    """Whether frequencies are in Hz."""
    first: int
    last: int
    """The frames it was computed from: all between them that the session uses."""
    count: int
    """How many they are."""
    resolution: float
    """Sines nearer to each other than this cannot be resolved: two steps of the frequency, the half
    width of the Hann window's main lobe.
    """

    @property
    def peak(self) -> tuple[float, float]:
        """Frequency and amplitude of the strongest oscillation."""
        strongest = int(np.argmax(self.amplitude))
        return float(self.frequency[strongest]), float(self.amplitude[strongest])


def trend(
    seen: Overview, key: str, without_doubtful: bool = False, doubtful: BoolArray | None = None
) -> Trend:
    """The course of a measure.

    Parameters
    ----------
    key
        Name of the measure, one of `BY_KEY`.
    without_doubtful
        Whether frames in doubt are left out of the statistics. What no longer stands always is.
    doubtful
        What `doubtful_frames` gives, if it is at hand.
    """
    quantity = BY_KEY[key]
    value = seen.measures[key]
    has = np.flatnonzero(np.isfinite(value))
    timed = bool(np.isfinite(seen.time_s).all())
    doubtful = doubtful_frames(seen) if doubtful is None else doubtful
    counts = ~seen.stale & ~(doubtful & without_doubtful)
    sigma = seen.measures[quantity.sigma] if quantity.sigma else np.full(len(value), np.nan)
    return Trend(
        quantity=quantity,
        frame=seen.frame[has],
        at=(seen.time_s if timed else seen.frame.astype(float))[has],
        timed=timed,
        place=has.astype(np.int64),
        value=value[has],
        sigma=sigma[has],
        doubtful=doubtful[has],
        stale=seen.stale[has],
        corrected=seen.corrected[has],
        counts=counts[has],
        measures={name: values[has] for name, values in seen.measures.items()},
    )


def doubtful_frames(seen: Overview) -> BoolArray:
    """Which frames have a surface that stands out from those around it, shape (n,).

    Width, length or height far from the median of the neighbours, or an ARE far above the usual
    one. It says "look at this frame", not that it is wrong.
    """
    doubtful = np.zeros(len(seen.frame), bool)
    has = np.isfinite(seen.measures["height_mm"]) & ~seen.stale
    if has.sum() < FEWEST:
        return doubtful
    are = seen.measures["are_mm"][has]
    out = are > FAR_ARE * np.nanmedian(are) if np.isfinite(are).any() else np.zeros(len(are), bool)
    for key in ("width_mm", "length_mm", "height_mm"):
        size = seen.measures[key][has]
        # Mirrored, an odd one at the end does not meet itself again.
        usual = scipy.ndimage.median_filter(size, min(NEIGHBOURS, len(size)), mode="mirror")
        off = np.abs(size - usual)
        out |= off > np.maximum(
            FAR_SIGMA * 1.4826 * np.nanmedian(off), FAR_PART * np.abs(np.nanmedian(size))
        )
    doubtful[has] = out
    return doubtful


def spread(course: Trend) -> Spread:
    """Mean, its ±, standard deviation and range of the frames that count (Eq. 7-2 … 7-4)."""
    value = course.value[course.counts]
    if not len(value):
        return Spread(0, *(4 * (float("nan"),)))
    key, counted = course.quantity.key, {k: v[course.counts] for k, v in course.measures.items()}
    return Spread(
        len(value),
        float(value.mean()),
        float(value.std()),
        float(value.min()),
        float(value.max()),
        sigma_of_mean(key, counted),
        setup_sigma_of_mean(key, counted),
    )


def spectrum(course: Trend) -> Spectrum:
    """Spectrum of the longest part whose frames all count and follow each other evenly.

    The straight line through it is taken off; the window is Hann's.

    Raises
    ------
    ValueError
        If that part is too short.
    """
    members = _even_part(course)
    count = len(members)
    if count < FEWEST:
        raise ValueError(
            f"a spectrum needs {FEWEST} frames in a row, evenly spaced in time; "
            f"there are {count} at most",
        )
    from scipy.signal import detrend  # a second, of which the app's start has no use
    from scipy.signal.windows import hann

    window = hann(count, sym=False)
    step = float(course.at[members[-1]] - course.at[members[0]]) / (count - 1)
    value = detrend(course.value[members]) * window
    amplitude = 2 * np.abs(np.fft.rfft(value)) / window.sum()
    frequency = np.asarray(np.fft.rfftfreq(count, step), np.float64)
    return Spectrum(
        frequency=frequency[1:],
        amplitude=amplitude[1:],
        timed=course.timed,
        first=int(course.frame[members[0]]),
        last=int(course.frame[members[-1]]),
        count=count,
        resolution=2 / (count * step),
    )


def _even_part(course: Trend) -> IntArray:
    """Indices of the longest run of frames that count, none missing, steps equal."""
    kept = np.flatnonzero(course.counts)
    if len(kept) < 2:
        return kept.astype(np.int64)
    step = np.diff(course.at[kept])
    usual = float(np.median(step))
    joined = (np.diff(course.place[kept]) == 1) & (np.abs(step - usual) <= EVEN * usual)
    ends = np.flatnonzero(np.concatenate([[True], ~joined, [True]]))
    longest = int(np.argmax(np.diff(ends)))
    return np.asarray(kept[ends[longest] : ends[longest + 1]], np.int64)
