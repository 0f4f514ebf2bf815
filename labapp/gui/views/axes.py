"""Plots with axis numbers in the labelled unit, and drawings to scale made of them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pyqtgraph as pg
from PySide6.QtCore import Qt
from PySide6.QtGui import QColor, QFontMetricsF, QGuiApplication
from PySide6.QtWidgets import QLayout, QWidget

from labapp.core.values import FloatArray
from labapp.gui.views.canvas import Drawn
from labapp.gui.widgets.labels import wrapping_label
from labapp.gui.widgets.layouts import hbox, vbox


class PlainAxis(pg.AxisItem):  # type: ignore[misc]
    """An axis that never scales its numbers, and leaves some out where they would overlap.

    pyqtgraph scales them by the visible range whenever a label is set, even if scaling is switched
    off: the numbers of an axis in mm would be in µm, but its label would still say mm. Along a
    short vertical axis it draws four numbers whatever their height, and cuts them off at its ends.
    """

    def __init__(self, side: str) -> None:
        super().__init__(side)
        self.setStyle(hideOverlappingLabels=True)

    def tickSpacing(self, low: float, high: float, length_px: float) -> list[tuple[float, float]]:
        """Spacings of ticks, widest first, and their offsets.

        Numbers of an upright axis are as far apart as a line of text, and two or more if possible.
        """
        levels: list[tuple[float, float]] = super().tickSpacing(low, high, length_px)
        if self.orientation not in {"left", "right"}:
            return levels
        spacing = levels[0][0]
        line = QFontMetricsF(QGuiApplication.font()).height() * (high - low) / length_px
        first, last = low + line / 2, high - line / 2  # others are cut off at the ends
        ten = 10 ** np.floor(np.log10(spacing))
        steps = [spacing, *(ten * np.array([0.1, 0.2, 0.25, 0.5, 1, 2, 2.5, 5, 10, 20, 50]))]
        readable = [step for step in steps if step >= line]
        several = [step for step in readable if last // step - -(-first // step) >= 1]
        step = next(iter(several or readable), spacing)
        return [(step, 0.0), *(level for level in levels if level[0] < step)]

    def tickStrings(self, values: Sequence[float], scale: float, spacing: float) -> list[str]:
        """Numbers at ticks, with the decimals of a spacing such as 2.5, which pyqtgraph rounds."""
        is_whole = np.isclose(spacing * 10 ** np.ceil(-np.log10(spacing)) % 1, [0, 1]).any()
        finer = spacing if is_whole else spacing / 10
        numbers: list[str] = super().tickStrings(values, scale, finer)
        return numbers

    def updateAutoSIPrefix(self) -> None:
        """Keep the numbers unscaled."""
        self._updateLabel()


def plain_axes() -> dict[str, PlainAxis]:
    """Axes for a new plot."""
    return {side: PlainAxis(side) for side in ("left", "bottom")}


def make_plot(x_label: str, y_label: str = "", equal: bool = True) -> pg.PlotWidget:
    """Create a plot that leaves keys and the right mouse button to its parent."""
    plot: Any = pg.PlotWidget(axisItems=plain_axes())
    plot.setFocusPolicy(Qt.FocusPolicy.NoFocus)
    plot.setMenuEnabled(False)
    plot.hideButtons()
    plot.setAspectLocked(equal)
    plot.setLabel("bottom", x_label)
    plot.setLabel("left", y_label)
    return plot


def show_axes(plots: Sequence[pg.PlotWidget], shown: bool) -> None:
    """Show or hide the axes of drawings to scale; hidden axes leave more space for the drawing."""
    for plot in plots:
        for side in ("left", "bottom"):
            plot.showAxis(side, shown)


def paint_axes(plot: pg.PlotWidget | pg.PlotItem, lines: QColor, text: QColor) -> None:
    """Set the colours of a plot's axes and ticks, and of their numbers and labels."""
    for side in ("left", "bottom"):
        axis = plot.getAxis(side)
        axis.setPen(lines)
        axis.setTextPen(text)  # after the pen, which also colours the label


class Sketch(Drawn):
    """A drawing to scale with text below it; without a drawing the text is centred."""

    def __init__(self, name: str, *plots: tuple[pg.PlotWidget | QLayout, int]) -> None:
        super().__init__(name)
        self._plots = [plot for plot, _ in plots if isinstance(plot, QWidget)]
        self.words = wrapping_label()
        self.words.setMargin(6)
        self._column = vbox(hbox(*plots), self.words, of=self)
        self._column.setSpacing(0)

    def say(self, words: str, drawn: bool) -> None:
        """Show text below the drawing or in its place, and describe the drawing with it."""
        self.words.setText(words)
        self.describe(words)
        for plot in self._plots:
            plot.setVisible(drawn)
        for place, wide in enumerate((drawn, not drawn)):
            self._column.setStretch(place, int(wide))
        center, left = Qt.AlignmentFlag.AlignCenter, Qt.AlignmentFlag.AlignLeft
        self.words.setAlignment(left if drawn else center)


def draw_line(
    plot: pg.PlotWidget, points: FloatArray, pen: object, **symbol: object
) -> pg.PlotDataItem:
    """Draw a line through points, shape (n, 2), in a plot; NaN interrupts the line."""
    return plot.plot(points[:, 0], points[:, 1], pen=pen, connect="finite", **symbol)


def draw_text(
    plot: pg.PlotWidget, words: str, place: FloatArray, color: QColor, anchor: tuple[float, float]
) -> None:
    """Draw text at a position, shape (2,), in front of all other items."""
    item = pg.TextItem(words, color=color, anchor=anchor)
    item.setZValue(10)
    item.setPos(float(place[0]), float(place[1]))
    plot.addItem(item, ignoreBounds=True)
