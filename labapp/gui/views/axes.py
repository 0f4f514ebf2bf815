"""Plots whose numbers are in the unit of the axis' label: no SI prefix scales them."""

from __future__ import annotations

from typing import Any

import pyqtgraph as pg
from PySide6.QtCore import Qt
from PySide6.QtGui import QColor


class PlainAxis(pg.AxisItem):  # type: ignore[misc]
    """An axis that never scales its numbers.

    pyqtgraph scales them by the range in view whenever a label is set, and even when scaling is
    switched off once more: an axis in mm would read in µm and still say mm.
    """

    def updateAutoSIPrefix(self) -> None:
        """Leave the numbers as they are."""
        self._updateLabel()


def plain_axes() -> dict[str, PlainAxis]:
    """Axes for a new plot."""
    return {side: PlainAxis(side) for side in ("left", "bottom")}


def make_plot(x_label: str, y_label: str = "", equal: bool = True) -> pg.PlotWidget:
    """Make a plot that leaves keys and the right button to its parent.

    Parameters
    ----------
    x_label, y_label
        What the axes are, with units; empty: no label.
    equal
        Whether a millimetre is as long on both axes.
    """
    plot: Any = pg.PlotWidget(axisItems=plain_axes())
    plot.setFocusPolicy(Qt.FocusPolicy.NoFocus)
    plot.setMenuEnabled(False)
    plot.hideButtons()
    plot.setAspectLocked(equal)
    plot.setLabel("bottom", x_label)
    plot.setLabel("left", y_label)
    return plot


def paint_axes(plot: pg.PlotWidget | pg.PlotItem, lines: QColor, text: QColor) -> None:
    """Draw a plot's axes and ticks, and their numbers and labels, in these colours."""
    for side in ("left", "bottom"):
        axis = plot.getAxis(side)
        axis.setPen(lines)
        axis.setTextPen(text)  # after the pen, which would colour the label too
