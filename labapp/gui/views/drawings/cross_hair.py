"""Drawing to scale of the laser and its cross hair, from the side and from above (Fig. A-1)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pyqtgraph as pg
from PySide6.QtCore import QMargins, QPointF, QRect, Qt
from PySide6.QtGui import QPalette, QResizeEvent

from labapp.core.calibration.laser_calibration import LaserCalibration
from labapp.gui.theme import RED, is_dark
from labapp.gui.views.axes import Sketch, draw_line, draw_text, make_plot, paint_axes, show_axes
from labapp.gui.views.drawings.dimension import DimensionBox
from labapp.gui.widgets.fields import NumberField
from labapp.gui.widgets.layouts import vbox

Lengths = tuple[float, float, float]

LOW_PX = 420
"""On a lower canvas the axes would leave no space for the cross."""


class CrossHairView(Sketch):
    """Diode, beam, fan edges, and the cross on the work piece with fields for l₁, l₂, l₃; mm."""

    def __init__(self, names: Sequence[str], fields: Sequence[NumberField]) -> None:
        self.plot = make_plot("Y, mm", "Z, mm")
        self.top = make_plot("from above: Y, mm", "X, mm")
        views = vbox((self.plot, 3), (self.top, 2))
        super().__init__("Drawing of the laser and its cross hair", (views, 1))
        self._plots = [self.plot, self.top]
        self.boxes = [
            DimensionBox(name, field, self.top) for name, field in zip(names, fields, strict=True)
        ]
        self._shown: tuple[LaserCalibration, Lengths, float] | None = None
        self.top.getViewBox().sigTransformChanged.connect(lambda _: self._place_fields())
        self.say("", False)
        self.follow_theme()

    def resizeEvent(self, event: QResizeEvent) -> None:
        """Hide the axes on a low canvas; the fields show the lengths."""
        super().resizeEvent(event)
        show_axes((self.plot, self.top), self.height() >= LOW_PX)

    def show_laser(
        self, found: LaserCalibration, lengths_mm: Lengths, fan_angle_deg: float, words: str
    ) -> None:
        """Draw a laser and its cross with text below."""
        self._shown = found, lengths_mm, fan_angle_deg
        self.say(words, True)
        self.take_colours()
        self._place_fields()

    def take_colours(self) -> None:
        """Draw in the colours of the theme."""
        ground = self.palette().color(QPalette.ColorRole.Base)
        ink = self.palette().color(QPalette.ColorRole.Text)
        for plot in (self.plot, self.top):
            plot.setBackground(ground)
            paint_axes(plot, ink, ink)
            plot.clear()
        if self._shown is None:
            return
        found, (l1, l2, l3), fan_deg = self._shown
        beam = RED[is_dark(self.palette())]
        solid, edge = (
            pg.mkPen(beam, width=1.6, style=style)
            for style in (Qt.PenStyle.SolidLine, Qt.PenStyle.DashLine)
        )
        diode = np.array([found.horizontal_mm, found.height_mm])
        right = max(diode[0], l1) * 1.1 + 2
        self._line(self.plot, [[-l2 - 4, 0], [right, 0]], pg.mkPen(ink, width=2.5))
        for end, pen in ((0.0, solid), (l1, edge), (-l2, edge)):
            self._line(self.plot, [diode, [end, 0.0]], pen)
        upright = pg.mkPen(ink, width=1, style=Qt.PenStyle.DotLine)
        self._line(self.plot, [diode, [diode[0], 0.0]], upright)
        ends = np.arctan2(-diode[1], np.array([-l2, l1]) - diode[0])
        turn = np.linspace(ends[0], ends[1], 20)
        arc = diode + 0.5 * found.distance_mm * np.stack([np.cos(turn), np.sin(turn)], axis=-1)
        self._line(self.plot, arc, pg.mkPen(ink, width=1.2))
        self._text(f"full fan angle {fan_deg:g}°", arc[0], (1.05, 1.0))
        self.plot.plot(*diode[:, None], pen=None, symbol="s", symbolSize=13, symbolBrush=ink)
        self._text("laser", diode, (0.5, 1.4))
        words = f"beam {found.distance_mm:.1f} mm\nat {found.angle_deg:.2f}°"
        for part, message in ((0.4, f"height {found.height_mm:.1f} mm"), (0.2, words)):
            self._text(message, (diode[0], diode[1] * part), (1.05, 0.5))
        self.plot.setRange(xRange=(-l2 - 4, right), yRange=(-1, diode[1] * 1.15))
        for line in ([[-l2, 0], [l1, 0]], [[0, -l3], [0, l3]]):
            self._line(self.top, line, pg.mkPen(beam, width=3))
        measure = pg.mkPen(ink, width=1.2)
        for line in _dimension_lines(l1, l2, l3):
            self._line(self.top, line, measure, symbol="o", symbolSize=4, symbolPen=measure)
        self.top.setRange(xRange=(-l2 - 4, right), yRange=(-2 * l3, 2 * l3))

    def _place_fields(self) -> None:
        """Place the fields at their lengths, and not over the cross."""
        if self._shown is not None:
            l1, l2, l3 = self._shown[1]
            view = self.top.getViewBox()
            ends = (view.mapViewToScene(QPointF(*end)) for end in ((-l2, l3), (l1, -l3)))
            upper, lower = (self.top.mapFromScene(end) for end in ends)
            ends_px = 4  # of the thick lines and the marks
            taken = [QRect(upper, lower).normalized() + QMargins(*[ends_px] * 4)]
            places = ((0.9 * l1, -1.5 * l3), (-0.9 * l2, -1.5 * l3), (4.5, 0.7 * l3))
            for box, place in zip(self.boxes, places, strict=True):
                box.put_at(np.array(place), taken)

    def _line(self, plot: pg.PlotWidget, points: object, pen: object, **symbol: object) -> None:
        draw_line(plot, np.array(points, float), pen, **symbol)

    def _text(self, words: str, place: object, anchor: tuple[float, float]) -> None:
        color = self.palette().color(QPalette.ColorRole.Text)
        draw_text(self.plot, words, np.asarray(place, float), color, anchor)


def _dimension_lines(l1: float, l2: float, l3: float) -> list[list[list[float]]]:
    """Dimension lines of l₁, l₂ and l₃ beside the cross, seen from above."""
    level, beside = -0.8 * l3, 0.6
    return [[[0, level], [l1, level]], [[-l2, level], [0, level]], [[beside, 0], [beside, l3]]]
