"""Data of the window of the pool's dynamics, or reasons why there are none. Without Qt."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from labapp.core.dynamics.oscillation import FEWEST
from labapp.core.surface.measures import WITH_SIGMA
from labapp.gui.curves import titled
from labapp.gui.pages.trends.presenter import SIGNALS
from labapp.session.results.trends import LABELS
from labapp.studies.tables import Table
from labapp.text import pluralize, split_unit, with_sigma

if TYPE_CHECKING:
    from labapp.core.dynamics.analysis import Dynamics
    from labapp.core.dynamics.modes import ModeCourse
    from labapp.core.values import FloatArray
    from labapp.session.results.measured import Overview
    from labapp.session.session import Session
    from labapp.session.signals import Signals


@dataclass(frozen=True)
class DrawnDynamics:
    """An analysis with its pictures (PNG)."""

    found: Dynamics
    spectrum: bytes
    series: bytes
    modes: tuple[bytes, ...]


@dataclass(frozen=True)
class Analysed:
    """What of a session is analysed."""

    seen: Overview
    signals: Signals | None

    @property
    def timed_signals(self) -> dict[str, tuple[FloatArray, FloatArray]]:
        """Name of a signal → its times in the recording, s, and its values."""
        return {} if self.signals is None else self.signals.timed()


SERIES = [(name, LABELS[name]) for name in WITH_SIGMA]

WIDE, HIGH, DPI = 4.9, 3.9, 120
"""Size of a picture, inches, and dots per inch: readable in a narrow window."""

FILM_TURNS = 16
"""Number of pictures in one period of a mode."""

RESPONSE = {
    "change": "Change",
    "delay_s": "Delay (s)",
    "time_constant_s": "Time constant (s)",
    "rise_time_s": "Rise from 10 to 90 % (s)",
    "overshoot": "Overshoot (share of the change)",
}

NO_STEPS = (
    "No response: {} The page Trends reads them from a table (Current and voltage), and a response "
    "is fitted to each of their steps, if there are at most eight."
)


def impossible(session: Session | None, seen: Overview | None) -> str:
    """Reason why a session's dynamics cannot be determined; empty if they can."""
    if session is None:
        return "No session is open."
    if seen is None:
        return "The results of the session cannot be read."
    if session.has_lines:
        return "Line patterns are not analysed here: step Trends shows how their lines change."
    if not np.isfinite(seen.time_s).all():
        return (
            "The frame rate is unknown, so there are no frequencies: import the recording with "
            "its frame rate (step Recording)."
        )
    count = int((np.isfinite(seen.measures["height_mm"]) & ~seen.stale).sum())
    if count < FEWEST:
        more = " Measure more of them (F5)." * (len(seen.frame) >= FEWEST)
        return (
            f"Too few frames: {count} of {len(seen.frame)} have a surface that is up to date, and "
            f"{FEWEST} are needed.{more}"
        )
    return ""


def same_results(one: Analysed | None, other: Analysed | None) -> bool:
    """Whether two analyses have the same times, measures, stale frames and signals."""
    if one is None or other is None:
        return one is other
    seen, then = one.seen, other.seen
    pairs = [(seen.time_s, then.time_s), (seen.stale, then.stale)]
    pairs += [(values, then.measures[name]) for name, values in seen.measures.items()]
    if one.signals is not other.signals:
        signals, before = one.timed_signals, other.timed_signals
        if list(signals) != list(before):
            return False
        pairs += [
            pair for name in signals for pair in zip(signals[name], before[name], strict=True)
        ]
    return all(np.array_equal(a.astype(float), b.astype(float), equal_nan=True) for a, b in pairs)


def range_text(seen: Overview) -> str:
    """Text of the oscillations that the frames can resolve."""
    there = np.isfinite(seen.measures["height_mm"]) & ~seen.stale
    time_s = seen.time_s[there]
    step = float(np.median(np.diff(time_s)))
    span = float(time_s[-1] - time_s[0]) + step
    missing = round(span / step) - len(time_s)
    gaps = f" {pluralize(missing, 'frame')} between them without one." * (missing > 0)
    return (
        f"{len(time_s)} frames with a surface in {span:.4g} s, {1 / step:.4g} frames/s: "
        f"oscillations from {2 / span:.2g} to {0.5 / step:.4g} Hz. Faster ones show as slower "
        f"ones.{gaps}"
    )


def peak_text(found: Dynamics) -> str:
    """The strongest oscillation over time in a sentence."""
    peak, gram = found.peak, found.spectrogram
    there = np.isfinite(peak.frequency_hz)
    segments = f"{pluralize(len(there), 'segment')} of {gram.segment_s:.3g} s ({gram.method})"
    if not there.any():
        return f"No oscillation exceeds the noise in {segments}."
    hertz, sigma = peak.frequency_hz[there], peak.frequency_sigma_hz[there]
    low, high = int(np.argmin(hertz)), int(np.argmax(hertz))
    ends = [f"{with_sigma(hertz[k], sigma[k])} Hz" for k in dict.fromkeys((low, high))]
    return f"Strongest oscillation {' to '.join(ends)} in {there.sum()} of {segments}."


def modes_table(found: Dynamics) -> Table:
    """Table with a row per mode: its strongest oscillation with ±."""
    names = ("frequency_hz", "amplitude_mm", "phase_deg", "damping_per_s")
    scales = (1.0, 1e3, 1.0, 1.0)
    rows = []
    for one in found.all_modes:
        figures = one.figures
        cells = [
            with_sigma(*(scale * x for x in figures[name])) if figures else "–"
            for name, scale in zip(names, scales, strict=True)
        ]
        share = f"{one.share:.0%}" if one.share >= 0.005 else "<1%"
        rows.append((one.name, share, *cells))
    columns = ("Mode", "Share", "Frequency (Hz)", "Amplitude (µm)", "Phase (°)", "Damping (1/s)")
    return Table("modes", "Modes and their strongest oscillation, with ±", columns, tuple(rows))


def events_table(found: Dynamics) -> tuple[Table, tuple[int, ...]]:
    """Table with a row per event in chronological order, and the frame nearest to each."""
    every = sorted(
        ((one, name) for name, events in found.events.items() for one in events),
        key=lambda pair: pair[0].time_s,
    )
    rows = tuple(
        (
            with_sigma(one.time_s, one.sigma_s),
            series_label(name),
            *(
                f"{x:+.3g}".replace("-", "−") if abs(x) > 1e-6 else "0"
                for x in (one.change, one.slope_change_per_s)
            ),
        )
        for one, name in every
    )
    time_s = found.surfaces.time_s
    frames = [found.surfaces.frame[np.argmin(np.abs(time_s - one.time_s))] for one, _ in every]
    columns = ("Time (s)", "Series", "Change", "Change of slope (1/s)")
    return Table("events", "Events", columns, rows), tuple(map(int, frames))


def responses_table(found: Dynamics) -> Table:
    """Table with a row per quantity of a response to a step of a signal."""
    rows = []
    for one in found.responses:
        value, sigma = one.response.value, one.response.sigma
        step = f"{one.signal} at {one.step.time_s:.3f} s"
        for name, words in RESPONSE.items():
            if name != "overshoot" or one.response.order == 2:
                known = with_sigma(value[name], sigma[name])
                rows.append((step, series_label(one.series), words, known))
    columns = ("Step", "Series", "Quantity", "Value")
    return Table("responses", "Responses to steps, with ±", columns, tuple(rows))


def no_responses(found: Dynamics, signals: bool) -> str:
    """Reason why there is no response."""
    steps = any(found.events.get(name) for name in ("current", "voltage", "wire"))
    if not signals:
        return NO_STEPS.format("no current, voltage or wire feed was imported.")
    if not steps:
        return NO_STEPS.format("the signals have no step while frames have a surface.")
    return NO_STEPS.format("no size changes beyond its noise after a step.")


def series_label(name: str) -> str:
    """Label of a series or signal with its unit."""
    if name in SIGNALS:
        return titled(*SIGNALS[name])
    return titled(LABELS[name], split_unit(name)[1])


# --- pictures ---------------------------------------------------------------------------------


def draw(found: Dynamics, check: Callable[[], None]) -> DrawnDynamics:
    """Draw an analysis; ``check`` is called in between and may raise to stop."""
    modes = []
    for one in found.all_modes:
        check()
        modes.append(mode_picture(found, one))
    check()
    return DrawnDynamics(found, spectrum_picture(found), series_picture(found), tuple(modes))


def spectrum_picture(found: Dynamics) -> bytes:
    """Spectrogram with the tracked peak, and the mean spectrum."""
    from labapp.export.dynamics import draw_spectrogram, draw_spectrum
    from labapp.studies.plotting import as_bytes, new_figure

    with new_figure(WIDE, HIGH) as figure:
        above, below = figure.subplots(2, 1)
        draw_spectrogram(above, found)
        draw_spectrum(below, found)
    return as_bytes(figure, dpi=DPI)


def series_picture(found: Dynamics) -> bytes:
    """Series with their events, steps of signals and responses."""
    from labapp.core.dynamics.analysis import RESPONDING
    from labapp.export.dynamics import draw_series
    from labapp.studies.plotting import as_bytes, new_figure

    with new_figure(WIDE, HIGH) as figure:
        plots = figure.subplots(len(RESPONDING), 1, sharex=True)
        for plot, name in zip(plots, RESPONDING, strict=True):
            draw_series(plot, found, name)
            plot.set(ylabel=series_label(name).replace(" (", "\n("))
            plot.label_outer()
    return as_bytes(figure, dpi=DPI)


def mode_picture(found: Dynamics, one: ModeCourse, turn: float = 0.0) -> bytes:
    """A mode from above at a phase of its period, and its coefficients over time."""
    from labapp.export.dynamics import draw_mode
    from labapp.studies.plotting import as_bytes, new_figure

    with new_figure(WIDE, 2.2) as figure:
        shape, course = figure.subplots(1, 2, width_ratios=(2, 3))
        draw_mode(shape, found, one, turn)
        labels = ("cos", "sin") if len(one.shape) > 1 else (None,)
        for values, label in zip(one.coefficient_mm.T, labels, strict=True):
            course.plot(found.surfaces.time_s, 1e3 * values, ".-", markersize=2, label=label)
        if len(one.shape) > 1:
            course.legend(loc="upper right", ncols=2)
        if one.oscillations:
            period_s = 1 / one.oscillations[0].frequency_hz
            course.axvline(found.surfaces.time_s[0] + turn * period_s, color="C3", linewidth=0.8)
        course.set(xlabel="time (s)", ylabel="coefficient (µm)")
    return as_bytes(figure, dpi=DPI)
