"""Data of the trends page, computed from a session: curves, their spread, a spectrum."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import TYPE_CHECKING

import numpy as np

from labapp.core.lines.track import oscillation_frequency
from labapp.core.schemes import scheme_words
from labapp.core.values import FloatArray, IntArray
from labapp.gui.curves import Axis, Curve, Mark
from labapp.gui.digits import ResultRow
from labapp.session.results.line_trends import (
    FEWEST,
    LINE_QUANTITIES,
    TRACK_QUANTITIES,
    line_trend,
)
from labapp.session.results.measured import Overview, scheme_name
from labapp.session.results.trends import (
    LABELS,
    Trend,
    outlying_frames,
    spectrum,
    statistics_of,
    trend,
)
from labapp.session.session import Session
from labapp.session.signals import Signals
from labapp.text import SIGMA_OF, capitalized, marked_setup_words, pluralize, rounded

if TYPE_CHECKING:
    from labapp.core.dynamics.steps import Event

MARKS = (
    Mark("●", "measured"),
    Mark("■", "corrected by hand"),
    Mark("○", "stands out, in doubt"),
    Mark("×", "out of date"),
)
MEASURED, CORRECTED, DOUBTFUL, STALE = range(4)

NO_HEIGHT_MM = 0.0005
"""Heights and depths below it are displayed as zero."""

NO_STATES = f"The pool's states are read from {FEWEST} frames or more, measured without a gap."

SIGNALS = {
    "current": ("Current", "A"),
    "voltage": ("Voltage", "V"),
    "wire": ("Wire feed", "m/min"),
}
"""Channels of `Signals`: name and unit."""


@dataclass(frozen=True)
class TrendOptions:
    """Options chosen by the operator."""

    shown: tuple[str, ...] | None = None
    """Displayed measures and channels of `SIGNALS`; None: those of `first_shown`."""
    without_doubtful: bool = False
    """Whether statistics and spectrum exclude doubtful frames."""
    spectrum_of: str = ""
    """A measure; empty for no spectrum."""


@dataclass(frozen=True)
class TrendsState:
    """Data shown by the page."""

    curves: tuple[Curve, ...]
    axis: Axis
    """Curves over time, and their axis, which covers all frames."""
    places: dict[int, float]
    """Position of every frame on the axis, by its number."""
    rows: tuple[ResultRow, ...]
    """Rows for each measure: mean ± standard deviation, range, and ± of the mean if known."""
    words: str
    """Scheme, number of frames included, and reasons why others are not."""
    setup_words: str
    """Text of the reliability of the set-up; empty if it is incomplete."""
    spectrum: tuple[Curve, ...]
    spectrum_axis: Axis
    """Spectrum of the chosen measure, and its axis; no curve if there is none."""
    spectrum_words: str
    """Text of the strongest oscillation, or the reason why there is no spectrum."""
    signals_words: str
    """Text about current and voltage."""
    without: Mapping[int, str] = field(default_factory=dict)
    """Text of each frame without a surface, by its number."""


def first_shown(seen: Overview) -> tuple[str, ...]:
    """Keys displayed at first; the depth in place of a height that is zero in all frames."""
    height, depth = (
        (np.abs(seen.measures[key]) >= NO_HEIGHT_MM).any() for key in ("height_mm", "depth_mm")
    )
    size = "depth_mm" if depth and not height else "height_mm"
    return ("width_mm", "length_mm", size, "are_mm", *SIGNALS)


def show(
    session: Session,
    options: TrendOptions,
    seen: Overview | None = None,
    events: Mapping[str, tuple[Event, ...]] = MappingProxyType({}),
) -> TrendsState:
    """Data to show for a session.

    Parameters
    ----------
    seen
        Overview of the session if already available.
    events
        Last determined events by measure and signal, s.
    """
    seen, signals = seen or session.overview(), session.signals
    chosen = first_shown(seen) if options.shown is None else options.shown
    if session.has_lines:
        return _show_lines(session, chosen, seen)
    doubtful = outlying_frames(seen)

    def course_of(key: str) -> Trend:
        return trend(seen, key, options.without_doubtful, doubtful)

    courses = [course_of(key) for key in LABELS if key in chosen]
    timed, axis, places = _axis(seen)
    curves = [_curve(course, events.get(course.key, ())) for course in courses if len(course.frame)]
    if signals is not None and timed:
        curves += _signal_curves(signals, seen, chosen, events)
    of = course_of(options.spectrum_of) if options.spectrum_of in LABELS else None
    found, spectrum_axis, message = _spectrum(of, timed)
    return TrendsState(
        curves=tuple(curves),
        axis=axis,
        places=places,
        rows=tuple(row for course in courses for row in _rows(course)),
        words=_counted(session, seen, course_of("height_mm")) + _without_shape(courses),
        setup_words=marked_setup_words(session.setup_status, session.setup_words),
        spectrum=found,
        spectrum_axis=spectrum_axis,
        spectrum_words=message,
        signals_words=_told_signals(signals, seen, timed),
        without={
            frame: f"Frame {frame}: {f'no surface ({status})' if status else 'not measured yet'}"
            for frame, status in zip(seen.frame.tolist(), seen.status, strict=True)
            if status != "ok"
        },
    )


def _axis(seen: Overview) -> tuple[bool, Axis, dict[int, float]]:
    """Whether all frames have times, the axis over them, and the place of each frame on it."""
    timed = bool(np.isfinite(seen.time_s).all()) and len(seen.time_s) > 0
    at = seen.time_s if timed else seen.frame.astype(float)
    span = (float(at.min()), float(at.max())) if len(at) else None
    axis = Axis("Time", "s", span=span) if timed else Axis("Frame", "", 0, span=span)
    return timed, axis, dict(zip(seen.frame.tolist(), at.tolist(), strict=True))


def _show_lines(session: Session, chosen: Sequence[str], seen: Overview) -> TrendsState:
    """Data of a line pattern over the recording; no choice of measures, no spectrum."""
    found = line_trend(session)
    timed, axis, places = _axis(seen)
    x = np.array([places[frame] for frame in found.frame.tolist()], float)
    mark = np.where(found.stale, STALE, MEASURED).astype(np.int64)
    none = np.full(len(x), np.nan)
    curves = [
        Curve(
            name=words,
            unit=unit,
            x=x[known],
            y=values[known],
            sigma=(found.height_sigma_mm if name == "pool_height_mm" else none)[known],
            key=found.frame[known],
            mark=mark[known],
            marks=MARKS,
            decimals=0 if name == "count" else 3,
        )
        for name, words, unit in LINE_QUANTITIES + TRACK_QUANTITIES
        if name in found.values and (known := np.isfinite(values := found.values[name])).any()
    ]
    if session.signals is not None and timed:
        curves += _signal_curves(session.signals, seen, chosen, {})
    states = ", ".join(
        f"{state} {first}–{last}" if last > first else f"{state} {first}"
        for state, first, last in found.stretches()
    )
    words = f"States by frame: {states}." if states else NO_STATES
    if "shift_px" in found.values:
        words = _followed(x, found.values["shift_px"], timed)
    return TrendsState(
        curves=tuple(curves),
        axis=axis,
        places=places,
        rows=(),
        words=words,
        setup_words=session.setup_words,
        spectrum=(),
        spectrum_axis=Axis("Frequency", "Hz" if timed else "1/frame", 2 if timed else 4),
        spectrum_words="",
        signals_words=_told_signals(session.signals, seen, timed),
    )


def _followed(x: FloatArray, shift_px: FloatArray, timed: bool) -> str:
    """Text of the number of frames in which a line was tracked, and its strongest oscillation."""
    known = np.isfinite(shift_px)
    words = f"The line is followed in {known.sum()} of {len(x)} frames."
    hertz, strength = oscillation_frequency(x[known], shift_px[known]) if timed else (np.nan, 0.0)
    if np.isfinite(hertz):
        words += f" Strongest oscillation of its shift: {hertz:.1f} Hz, {strength:.0%} of it."
    return words


def _curve(course: Trend, events: Sequence[Event]) -> Curve:
    mark = np.full(len(course.frame), MEASURED)
    mark[course.corrected] = CORRECTED
    mark[course.outlying] = DOUBTFUL
    mark[course.stale] = STALE
    return Curve(
        name=course.label,
        unit=course.unit,
        x=course.at,
        y=course.value,
        sigma=course.sigma,
        key=course.frame,
        mark=np.asarray(mark, np.int64),
        marks=MARKS,
        level=statistics_of(course).mean,
        events=np.array([one.time_s for one in events if course.timed]),
        decimals=4 if course.key == "are_mm" else 3,
    )


def _rows(course: Trend) -> tuple[ResultRow, ...]:
    found = statistics_of(course)
    place, sure_place = (
        len(rounded(found.mean, sigma)[0].partition(".")[2])
        for sigma in (found.deviation, found.mean_sigma)
    )
    ends = [f"{end:.{place}f}" for end in (found.lowest, found.highest)]
    frames = pluralize(found.count, "frame")
    note = f"Mean and standard deviation (divided by n, Eq. 7-2 … 7-4) of {frames}"
    sure = (
        f"± of the mean, {SIGMA_OF}: frames with the same outline share the error of the level, "
        f"all frames that of the set-up ({found.mean_setup_sigma:.2g} {course.unit})"
    )
    unknown = None if not found.count else " … ".join(ends).replace("-", "−")
    return (
        ResultRow(course.label, found.mean, found.deviation, course.unit, note=note),
        ResultRow("range", unknown, unit=course.unit, note=f"Smallest and largest of {frames}"),
        *(
            [ResultRow("± of the mean", found.mean_sigma, None, course.unit, sure_place, sure)]
            if math.isfinite(found.mean_sigma)
            else []
        ),
    )


def _counted(session: Session, seen: Overview, course: Trend) -> str:
    total, has = len(seen.frame), len(course.frame)
    scheme = scheme_words()[scheme_name(session.settings)].title
    parts = [f"{scheme}: {int(course.counts.sum())} of {total} frames count"]
    unmeasured = seen.status.count("")
    reasons = (
        (unmeasured, "not measured yet"),
        (total - has - unmeasured, "without a surface"),
        (int(course.stale.sum()), "out of date"),
        (int(course.outlying.sum()), "stand out"),
    )
    parts += [f"{count} {words}" for count, words in reasons if count]
    return ", ".join(parts)


def _without_shape(courses: Sequence[Trend]) -> str:
    """Text of the displayed measures that are missing in results of earlier versions."""
    names = [one.label for one in courses if not len(one.frame)]
    if not names or all(not len(one.frame) for one in courses):
        return ""
    return f". {', '.join(names)}: not in results of an earlier version"


def _spectrum(course: Trend | None, timed: bool) -> tuple[tuple[Curve, ...], Axis, str]:
    axis = Axis("Frequency", "Hz" if timed else "1/frame", 2 if timed else 4)
    if course is None:
        return (), axis, ""
    try:
        found = spectrum(course)
    except ValueError as error:
        return (), axis, capitalized(str(error))
    curve = Curve(
        f"Amplitude, {course.label.lower()}" if course.label != "ARE" else "Amplitude, ARE",
        course.unit,
        found.frequency,
        found.amplitude,
        decimals=4,
        from_zero=True,
    )
    frequency, amplitude = found.peak
    place = max(0, 1 - int(np.floor(np.log10(found.resolution))))
    nearest = f"{found.resolution:.2g} {axis.unit}"
    if frequency == found.frequency[0]:  # one period in the series: perhaps a drift
        strongest = f"No oscillation stands out: the value changes mostly below {nearest}"
    else:
        strongest = f"Strongest at {frequency:.{place}f} {axis.unit}: {amplitude:.2g} {course.unit}"
    return (
        (curve,),
        axis,
        f"{strongest}. Frames {found.first} to {found.last} ({found.count}), Hann window; "
        f"oscillations nearer than {nearest} are not resolved.",
    )


def _signal_curves(
    signals: Signals,
    seen: Overview,
    shown: Sequence[str],
    events: Mapping[str, tuple[Event, ...]],
) -> list[Curve]:
    """Curves of the signals during the recording, and shortly before and after."""
    time_s = signals.time_s + signals.start_s
    low, high = float(seen.time_s.min()), float(seen.time_s.max())
    room = 0.05 * (high - low) or 0.5
    within: IntArray = np.flatnonzero((time_s >= low - room) & (time_s <= high + room))
    curves = []
    for key, values in signals.channels.items():
        if key in shown and np.isfinite(values[within]).any():
            found = np.array([one.time_s for one in events.get(key, ())])
            curves.append(Curve(*SIGNALS[key], time_s[within], values[within], events=found))
    return curves


def _told_signals(signals: Signals | None, seen: Overview, timed: bool) -> str:
    if signals is None:
        return (
            "None. A table (CSV, TDMS) with a time and a current, a voltage or a wire feed can be "
            "shown along."
        )
    ends = signals.time_s[[0, -1]] + signals.start_s
    count = pluralize(len(signals.time_s), "sample")
    message = f"{signals.file}: {count}, {ends[0]:.3f} … {ends[1]:.3f} s"
    if not timed:
        return f"{message}. Not shown: the recording has no time base; import it with a frame rate."
    low, high = float(seen.time_s.min()), float(seen.time_s.max())
    if ends[1] < low or ends[0] > high:
        return (
            f"{message}. None of it falls into the recording's {low:.3f} … {high:.3f} s: "
            "enter when it starts."
        )
    return message
