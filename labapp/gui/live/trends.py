"""Sizes of the live pool over the last seconds, and fields for their limits."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np
from PySide6.QtCore import Qt
from PySide6.QtGui import QResizeEvent
from PySide6.QtWidgets import QBoxLayout, QGridLayout, QSizePolicy, QWidget

from labapp.errors import InputError
from labapp.gui.curves import PLAIN, Axis, Curve, Mark
from labapp.gui.views.plots import PlotStack
from labapp.gui.widgets.fields import FieldForm, NumberField, whole
from labapp.gui.widgets.labels import plain_label
from labapp.gui.widgets.layouts import scrolled, vbox
from labapp.gui.widgets.parts import PartsBar
from labapp.gui.workspace import Workspace
from labapp.run.limits import LARGEST_MM, NAMES, Ends, Limits
from labapp.run.live_trend import TREND_S, LiveSizes
from labapp.run.live_watch import LiveWatch
from labapp.text import SIGMA_OF

LAST_S = 30.0
"""Duration shown by default."""

GAP_S = 0.5
"""No line is drawn across longer gaps between frames."""

MARKS = PLAIN, Mark("▪", "beyond its limit")

LOW_PX = 460
"""On a lower canvas there is no space for both plots and fields."""

LIMITS = 1
"""Index of the part with the fields."""

LEAST_PX = 48
"""Least height of the plots, which scroll: on a small screen an alarm takes their room."""

ROOM_PX = 40
"""Space that must be left for all fields to be side by side."""

RULE = (
    f"An alarm is raised when a size is beyond its limit by more than 2 σ, twice its ± "
    f"({SIGMA_OF}), or when so many frames in a row cannot be measured. For a concave pool, height "
    "is its depth, which is negative."
)


def trend_curves(trend: LiveSizes, limits: Limits) -> tuple[Curve, ...]:
    """Width, length and height against the time from now, with their limits."""
    # A frame without values inside a gap keeps a line from crossing it.
    gap = np.flatnonzero(np.diff(trend.since_s) > GAP_S) + 1
    since_s = np.insert(trend.since_s, gap, trend.since_s[gap - 1] + GAP_S / 2)
    number = np.insert(trend.number, gap, trend.number[gap - 1] + 1)
    return tuple(
        Curve(
            name.capitalize(),
            "mm",
            since_s,
            np.insert(trend.value_mm[k], gap, np.nan),
            sigma=np.insert(trend.sigma_mm[k], gap, np.nan),
            key=number,
            mark=np.insert(trend.beyond[k].astype(int), gap, 0),
            marks=MARKS,
            limits=limits.of(name),
            quick=True,
        )
        for k, name in enumerate(trend.names)
    )


class LiveTrends(QWidget):
    """Plots of the last seconds, and below them fields for the limits."""

    def __init__(self, workspace: Workspace) -> None:
        super().__init__()
        self._workspace = workspace
        self.plots = PlotStack("Trends of the live pool")
        self.plots.area.setMinimumHeight(LEAST_PX)
        tip = "How much of the trend is shown"
        self.last = whole("Show the last", 2, tip, int(TREND_S), unit="s", step=10)
        self.last.set_value(LAST_S)
        tip = (
            "How many frames in a row that cannot be measured raise an alarm, where there is any "
            "limit"
        )
        self.unmeasured = whole("Alarm if not measured for", 1, tip, 10_000, unit="frames")
        self.unmeasured.edited.connect(lambda value: self._keep(unmeasured=int(value)))
        self.fields = {
            (name, end): NumberField(
                f"{name.capitalize()}, {'min.' if end == 0 else 'max.'}",
                lowest=-LARGEST_MM,
                highest=LARGEST_MM,
                decimals=3,
                step=0.1,
                optional=True,
                tooltip=f"{'Lowest' if end == 0 else 'Highest'} {name} allowed; empty: no limit. "
                f"{RULE}",
            )
            for name in NAMES
            for end in (0, 1)
        }
        for (name, end), field in self.fields.items():
            field.edited.connect(partial(self._enter, name, end))
        below = QWidget()
        self._below = QBoxLayout(QBoxLayout.Direction.TopToBottom, below)
        self._below.setContentsMargins(8, 0, 8, 0)
        limits, others = self._limits(), FieldForm(self.last, self.unmeasured)
        others.setMinimumWidth(others.minimumSizeHint().width())
        self._parts = limits, others
        self._below.addLayout(limits, 3)
        self._below.addWidget(others, 2, Qt.AlignmentFlag.AlignTop)
        self._fields = scrolled(below)
        self._fields.setSizePolicy(QSizePolicy.Policy.Preferred, QSizePolicy.Policy.Preferred)
        name = "What is seen of the trends"
        self.canvas_parts = PartsBar(name, {"Plots": (self.plots,), "Limits": (self._fields,)})
        vbox(self.canvas_parts, (self.plots, 1), self._fields, of=self)
        workspace.changed.connect(self.refresh)

    def _limits(self) -> QGridLayout:
        grid = QGridLayout()
        for column, words in enumerate(("Limits (mm)", "Min.", "Max.")):
            label = plain_label(words)
            label.setToolTip(RULE)
            grid.addWidget(label, 0, column)
            grid.setColumnStretch(column, int(column > 0))
        for row, name in enumerate(NAMES, 1):
            grid.addWidget(plain_label(name.capitalize()), row, 0)
            for end in (0, 1):
                grid.addWidget(self.fields[name, end], row, 1 + end)
        grid.setRowStretch(grid.rowCount(), 1)  # on a low canvas they have the room of the plots
        return grid

    def resizeEvent(self, event: QResizeEvent) -> None:
        """Place all fields side by side if they fit; on a low canvas show plots or fields."""
        super().resizeEvent(event)
        if self._fields.isAncestorOf(self.focusWidget()):
            self.canvas_parts.setCurrentIndex(LIMITS)  # an alarm must not hide the field in use
        self.canvas_parts.fit(self, LOW_PX)
        way = QBoxLayout.Direction
        is_wide = self.width() >= sum(part.minimumSize().width() for part in self._parts) + ROOM_PX
        self._below.setDirection(way.LeftToRight if is_wide else way.TopToBottom)

    # --- what it shows ------------------------------------------------------------------------

    def refresh(self) -> None:
        """Show the session's limits."""
        session = self._workspace.session
        if session is None:
            return
        limits = session.limits
        for (name, end), field in self.fields.items():
            field.set_value(limits.of(name)[end])
            field.setEnabled(not session.read_only)
        self.unmeasured.set_value(limits.unmeasured)
        self.unmeasured.setEnabled(not session.read_only)

    def show_trend(self, watch: LiveWatch) -> None:
        """Show the last measurements."""
        last_s = self.last.value() or LAST_S
        limits = watch.alarms.limits
        trend = watch.trend.over(last_s, limits)
        axis = Axis("From now", "s", decimals=1, span=(-last_s, 0.0))
        self.plots.show_curves(trend_curves(trend, limits), axis)

    # --- what is done -------------------------------------------------------------------------

    def _enter(self, name: str, end: int, value: float | None) -> None:
        session = self._workspace.session
        if session is None:
            return
        low, high = session.limits.of(name)
        ends: Ends = (value, high) if end == 0 else (low, value)
        self._keep(**{f"{name}_mm": ends}, field=(name, end))

    def _keep(self, field: tuple[str, int] | None = None, **changed: object) -> None:
        """Store limits in the session; impossible ones are refused below their field."""
        session = self._workspace.session
        if session is None:
            return
        try:
            limits = replace(session.limits, **changed)  # type: ignore[arg-type]
        except InputError as error:
            if field is not None:
                self.fields[field].set_value(session.limits.of(field[0])[field[1]])
                self.fields[field].refuse(f"Expected {error.expected}")
            return
        self._workspace.attempt(lambda session: session.set_limits(limits))
