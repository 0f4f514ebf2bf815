"""Large figures of a live pool: its sizes, how they stand to their limits, and how old they are."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from PySide6.QtCore import Qt
from PySide6.QtGui import QAccessible, QAccessibleEvent, QPalette
from PySide6.QtWidgets import QFrame, QGridLayout, QLabel, QWidget

from labapp.gui.digits import NOTHING, plain
from labapp.gui.theme import RED, FollowsTheme, is_dark
from labapp.gui.widgets.buttons import button
from labapp.gui.widgets.labels import Message, plain_label, selectable_label
from labapp.gui.widgets.layouts import hbox, vbox
from labapp.run.alarms import Alarm
from labapp.run.limits import Limits, Size, Standing, sizes_of, standing
from labapp.run.live_measuring import LiveResult
from labapp.run.live_trend import Pace
from labapp.text import marked_setup_words, setup_words

DECIMALS = 3
"""Of live figures, mm."""

OLD_S = 2.0
"""A figure that is older is not of the pool that is seen: it is not in order, whatever it is."""

LARGE = 1.9
"""How much larger a figure is that is read from a distance."""

ACKNOWLEDGE_PX = 40
"""Least height of a button that is pressed in gloves."""

Look = Literal["plain", "alarm", "old"]

FIRST = "Measuring the first frame: this takes some seconds…"
NO_SETUP = "Sizes are shown here once the set-up is complete"


@dataclass(frozen=True)
class Figure:
    """A size as it is shown."""

    name: str
    value: str
    sigma: str
    """Texts; value and sigma in mm."""
    verdict: str = ""
    """How it stands to its limits, in words after a sign; empty where it has none."""
    look: Look = "plain"
    """Red or pale."""


def figures(
    result: LiveResult | None, limits: Limits | None = None, age_s: float = 0.0
) -> tuple[Figure, ...]:
    """Width, length and height, of a hollow pool the depth.

    All with the same number of decimals, whatever the ±: nothing jumps as they change.

    Parameters
    ----------
    result
        Of the frame measured last; None before one was.
    limits
        Of the sizes; None: there are none.
    age_s
        How old the frame is, s.
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
    """How a size stands, in a few words after a sign."""
    low, high = limits.of(name)
    if stands == "low":
        return f"▲ below {low:g}"
    if stands == "high":
        return f"▲ above {high:g}"
    return {
        "": "",
        "unknown": "? not known",
        "in order": "✓ within limits",
        "in doubt": "◆ at its limit",
    }[stands]


def pace_text(result: LiveResult | None, pace: Pace, came_hz: float | None, age_s: float) -> str:
    """How measuring keeps up, and why there is no figure where there is none."""
    if result is None:
        return FIRST
    parts = []
    found = result.measurement
    if found.measures is None:
        parts.append(f"▲ Not measured ({found.status}): {found.reason}.")
    elif pace.failed:
        parts.append(f"◆ {pace.failed} of the last {pace.tried} frames could not be measured.")
    if age_s > OLD_S:
        parts.append(f"▲ The figures are {age_s:.0f} s old.")
    came = f" of {came_hz:.1f}" if came_hz is not None else ""
    parts.append(f"{pace.measured_hz:.1f}{came} frames/s measured")
    if age_s <= OLD_S:
        parts[-1] += f"; {age_s:.2f} s old"
    return " ".join(parts)


def live_setup_words(result: LiveResult | None, checked: str) -> str:
    """How far the set-up can be relied on; ``checked``: when it was checked, ISO 8601."""
    if result is None or not (status := result.measurement.setup_status):
        return ""
    return marked_setup_words(status, setup_words(status, checked, result.setup_doubt))


class LiveFigures(FollowsTheme, QWidget):
    """Results in large figures, to be read from where the work is."""

    def __init__(self) -> None:
        super().__init__()
        self._grid = QGridLayout()
        self._grid.setColumnStretch(1, 1)
        self.words, self.setup_words = Message(3), Message(3)
        vbox(self._grid, self.words, self.setup_words, of=self)
        self._labels: dict[tuple[int, int], QLabel] = {}
        self._looks: dict[QLabel, tuple[Look, bool]] = {}
        self.follow_theme()

    def show_figures(self, shown: Sequence[Figure]) -> None:
        """Show figures, each in a row, and no others."""
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
                font = label.font()
                font.setPointSizeF(LARGE * font.pointSizeF())
                font.setBold(True)
                label.setFont(font)
            self._grid.addWidget(label, row, column)
        return self._labels[row, column]

    def _apply_look(self, label: QLabel, look: Look) -> None:
        """Colour a label, only where its colour changes: that is expensive."""
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
        """Colour the labels for the window's ground."""
        for label, (look, _) in list(self._looks.items()):
            self._apply_look(label, look)


class AlarmStrip(FollowsTheme, QFrame):
    """What the operator must see, below the picture, and the button that says it was seen."""

    def __init__(self, acknowledge: Callable[[], None]) -> None:
        super().__init__()
        self.setFrameShape(QFrame.Shape.Box)
        self.words = selectable_label()
        font = self.words.font()
        font.setBold(True)
        self.words.setFont(font)
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
        """Say it in the red of the window's ground."""
        colours = QPalette()
        colours.setColor(QPalette.ColorRole.WindowText, RED[is_dark(colours)])
        for widget in (self, self.words):
            widget.setPalette(colours)

    def show_alarms(self, alarms: Sequence[Alarm]) -> None:
        """Show alarms, after those that are kept; none hides it."""
        alarms = (*self._kept, *alarms)
        message = alarms_text(alarms)
        if message != self.words.text():
            self.words.setText(message)
            # A screen reader says it at once.
            alert = QAccessibleEvent(self.words, QAccessible.Event.Alert)
            QAccessible.updateAccessibility(alert)
        self.button.setEnabled(not all(alarm.acknowledged for alarm in alarms))
        self.setVisible(bool(alarms))
        self._alarms = alarms

    def keep_unacknowledged(self) -> None:
        """Keep what was not acknowledged until it is: the camera is watched no more."""
        unseen = (alarm for alarm in self._alarms if not alarm.acknowledged)
        self._kept = tuple(replace(alarm, holds=False) for alarm in unseen)
        self.show_alarms(())

    def clear(self) -> None:
        """Keep none any longer, and show none."""
        self._kept = ()
        self.show_alarms(())


def alarms_text(alarms: Sequence[Alarm]) -> str:
    """Alarms, a line each."""
    lines = []
    for alarm in alarms:
        sign = "▲ ALARM" if alarm.holds else "△ over"
        lines.append(f"{sign}: {alarm.description}{', acknowledged' * alarm.acknowledged}")
    return "\n".join(lines)
