"""Large figures of a live pool: its sizes, their comparison with the limits, and their age."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from PySide6.QtCore import Qt
from PySide6.QtGui import QAccessible, QAccessibleEvent, QPalette
from PySide6.QtWidgets import QFrame, QGridLayout, QLabel, QWidget

from labapp.gui.shell.steps import setup_to_do
from labapp.gui.theme import RED, FollowsTheme, is_dark
from labapp.gui.widgets.buttons import button
from labapp.gui.widgets.labels import Message, plain_label, selectable_label, set_font
from labapp.gui.widgets.layouts import hbox, vbox
from labapp.run.alarms import Alarm
from labapp.run.limits import Limits, Size, Standing, sizes_of, standing
from labapp.run.live_measuring import LiveResult
from labapp.run.live_trend import Pace
from labapp.session.session import Session
from labapp.text import NOTHING, marked_setup_words, plain, pluralize, setup_words

DECIMALS = 3
"""Number of decimals of live figures in mm."""

OLD_S = 2.0
"""A figure older than this no longer describes the visible pool and is never in order."""

LARGE = 1.9
"""Scale of figures that are read from a distance."""

ACKNOWLEDGE_PX = 40
"""Minimum height of a button that is pressed with gloves."""

Look = Literal["plain", "alarm", "old"]

FIRST = "Measuring the first frame: this takes some seconds…"
NO_FRAMES = "No frames arrive at present; measuring the first one takes some seconds"
NO_SETUP = "No sizes without a complete set-up"
LINES = "Lines are not measured live: record them, and measure the recording"


@dataclass(frozen=True)
class Figure:
    """The display of a size."""

    name: str
    value: str
    sigma: str
    """Texts; value and sigma in mm."""
    verdict: str = ""
    """Comparison with the limits as text after a sign; empty without limits."""
    look: Look = "plain"
    """Appearance, such as red or pale."""


def figures(
    result: LiveResult | None, limits: Limits | None = None, age_s: float = 0.0
) -> tuple[Figure, ...]:
    """Width, length and height, or the depth of a concave pool.

    All have the same number of decimals regardless of the ±, so that nothing moves on changes.

    Parameters
    ----------
    result
        Result for the last measured frame; None before the first one.
    limits
        Limits of the sizes; None if there are none.
    age_s
        Age of the frame, s.
    """
    sizes = sizes_of(None if result is None else result.measurement.measures)
    return tuple(_figure(size, limits or Limits(), age_s > OLD_S) for size in sizes)


def _figure(size: Size, limits: Limits, is_old: bool) -> Figure:
    known = np.isfinite(size.value_mm)
    stands = standing(size, limits.of(size.name))
    if stands and is_old:
        stands = "unknown"
    return Figure(
        size.name.capitalize(),
        plain(size.value_mm, DECIMALS) if known else NOTHING,
        f"± {plain(size.sigma_mm, DECIMALS)}" if np.isfinite(size.sigma_mm) else "",
        standing_text(stands, limits, size.name),
        "alarm" if stands in ("low", "high") else "old" if is_old else "plain",
    )


def standing_text(stands: Standing, limits: Limits, name: str) -> str:
    """Short text, after a sign, that compares a size with its limits."""
    low, high = limits.of(name)
    if stands == "low":
        return f"▲ below {low:g} mm"
    if stands == "high":
        return f"▲ above {high:g} mm"
    return {
        "": "",
        "unknown": "? not known",
        "in order": "✓ within limits",
        "in doubt": "◆ at its limit",
    }[stands]


def why_unmeasured(session: Session) -> str:
    """Text of the reason why the frames of a camera are not measured."""
    return LINES if session.has_lines else f"{NO_SETUP}. {setup_to_do(session.setup_problems)}"


def pace_text(
    result: LiveResult | None, pace: Pace, came_hz: float | None, age_s: float, skipped: int
) -> str:
    """Text of the rate of measurement, and the reason if there is no figure.

    ``skipped`` frames were not measured because a newer one was waiting.
    """
    if result is None:
        return FIRST if came_hz != 0 else NO_FRAMES
    parts = []
    found = result.measurement
    if found.measures is None:
        parts.append(f"▲ Not measured ({found.status}): {found.reason}.")
    elif pace.failed:
        parts.append(f"◆ {pace.failed} of the last {pace.tried} frames could not be measured.")
    if age_s > OLD_S:
        parts.append(f"▲ The figures are {age_s:.0f} s old.")
    came = f" of {came_hz:.1f}" if came_hz is not None else ""
    rate = f"{pace.measured_hz:.1f}{came} frames/s"
    if age_s <= OLD_S:
        parts.append(f"{rate} measured; {age_s:.2f} s old")
    elif pace.measured_hz:
        parts.append(f"Measuring lags behind the camera: {rate}")
    elif came_hz == 0:
        parts.append("No frames arrive at present")
    else:
        parts.append(f"None{came} frames/s measured" if came else "No frame was measured since")
    if skipped:
        parts[-1] += f"; {pluralize(skipped, 'frame')} skipped to keep up"
    return " ".join(parts)


def live_setup_words(result: LiveResult | None, checked: str) -> str:
    """Text of the set-up's reliability; ``checked`` is the date of its check, ISO 8601."""
    if result is None or not (status := result.measurement.setup_status):
        return ""
    return marked_setup_words(status, setup_words(status, checked, result.setup_doubt))


class LiveFigures(FollowsTheme, QWidget):
    """Results in large figures that can be read from the workplace."""

    def __init__(self) -> None:
        super().__init__()
        self._grid = QGridLayout()
        self._grid.setColumnStretch(1, 1)
        self.words, self.setup_words = Message(3), Message(4)
        vbox(self._grid, self.words, self.setup_words, of=self)
        self._labels: dict[tuple[int, int], QLabel] = {}
        self._looks: dict[QLabel, tuple[Look, bool]] = {}
        self.follow_theme()

    def show_figures(self, shown: Sequence[Figure]) -> None:
        """Show exactly these figures, one per row."""
        for (row, _), label in self._labels.items():
            label.setVisible(row < len(shown))
        for row, figure in enumerate(shown):
            name = f"{figure.name}\n{figure.verdict}" if figure.verdict else figure.name
            texts = (name, figure.value, figure.sigma, "mm")
            for column, text in enumerate(texts):
                label = self._label(row, column)
                label.setText(text)
                self._apply_look(label, figure.look)

    def _label(self, row: int, column: int) -> QLabel:
        if (row, column) not in self._labels:
            label = self._labels[row, column] = plain_label()
            if column in (1, 2):
                label.setAlignment(Qt.AlignmentFlag.AlignRight | Qt.AlignmentFlag.AlignVCenter)
            if column == 1:
                set_font(label, scale=LARGE)
            self._grid.addWidget(label, row, column)
        return self._labels[row, column]

    def _apply_look(self, label: QLabel, look: Look) -> None:
        """Colour a label, but only if its colour changes, because that is slow."""
        dark = is_dark(self.palette())
        if self._looks.get(label, ("plain", dark)) == (look, dark):
            return
        self._looks[label] = look, dark
        colours = QPalette()
        if look == "alarm":
            colours.setColor(QPalette.ColorRole.WindowText, RED[dark])
        elif look == "old":
            pale = self.palette().color(QPalette.ColorRole.PlaceholderText)
            colours.setColor(QPalette.ColorRole.WindowText, pale)
        label.setPalette(colours)

    def take_colours(self) -> None:
        """Colour the labels for the window's background."""
        for label, (look, _) in list(self._looks.items()):
            self._apply_look(label, look)


class AlarmStrip(FollowsTheme, QFrame):
    """Alarms for the operator, below the picture, and the button to acknowledge them."""

    def __init__(self, acknowledge: Callable[[], None]) -> None:
        super().__init__()
        self.setFrameShape(QFrame.Shape.Box)
        self.words = selectable_label()
        set_font(self.words)
        self.button = button(
            "Acknowledge", "Confirm that the alarms were seen (A); active ones stay", acknowledge
        )
        self.button.setMinimumHeight(ACKNOWLEDGE_PX)
        hbox((self.words, 1), self.button, of=self).setContentsMargins(6, 2, 6, 2)
        self._alarms: tuple[Alarm, ...] = ()
        self._kept: tuple[Alarm, ...] = ()
        self.follow_theme()
        self.hide()

    def take_colours(self) -> None:
        """Use the red for the window's background."""
        colours = QPalette()
        colours.setColor(QPalette.ColorRole.WindowText, RED[is_dark(colours)])
        for widget in (self, self.words):
            widget.setPalette(colours)

    def show_alarms(self, alarms: Sequence[Alarm]) -> None:
        """Show alarms after the kept ones; without alarms the strip is hidden."""
        alarms = (*self._kept, *alarms)
        message = alarms_text(alarms)
        if message != self.words.text():
            self.words.setText(message)
            # A screen reader announces it immediately.
            alert = QAccessibleEvent(self.words, QAccessible.Event.Alert)
            QAccessible.updateAccessibility(alert)
        self.button.setEnabled(not all(alarm.acknowledged for alarm in alarms))
        self.setVisible(bool(alarms))
        self._alarms = alarms

    def keep_unacknowledged(self) -> None:
        """Keep unacknowledged alarms after the camera is no longer watched."""
        unseen = (alarm for alarm in self._alarms if not alarm.acknowledged)
        self._kept = tuple(replace(alarm, holds=False) for alarm in unseen)
        self.show_alarms(())

    def clear(self) -> None:
        """Remove all alarms."""
        self._kept = ()
        self.show_alarms(())


def alarms_text(alarms: Sequence[Alarm]) -> str:
    """Text of alarms, one line each."""
    lines = []
    for alarm in alarms:
        sign = "▲ ALARM" if alarm.holds else "△ over"
        lines.append(f"{sign}: {alarm.description}{', acknowledged' * alarm.acknowledged}")
    return "\n".join(lines)
