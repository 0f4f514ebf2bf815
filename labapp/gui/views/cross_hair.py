"""The laser over its cross hair from the side, to scale (Fig. A-1)."""

from __future__ import annotations

import numpy as np
import pyqtgraph as pg
from PySide6.QtCore import Qt
from PySide6.QtGui import QPalette

from labapp.core.calibration.laser_calibration import LaserCalibration
from labapp.gui.views.axes import Sketch, draw_line, draw_text, make_plot, paint_axes


class CrossHairView(Sketch):
    """Diode, beam, the fan's two edges, and l₁ and l₂ on the work piece; mm."""

    def __init__(self) -> None:
        self.plot = make_plot("Y, mm", "Z, mm")
        super().__init__("Drawing of the laser and its cross hair", (self.plot, 1))
        self._shown: tuple[LaserCalibration | None, float, float] = (None, 0.0, 0.0)
        self.say("", False)
        self.follow_theme()

    def show_laser(
        self, found: LaserCalibration | None, l1_mm: float, l2_mm: float, words: str
    ) -> None:
        """Draw a laser and the lengths that were read, or say in words why there is none."""
        self._shown = (found, l1_mm, l2_mm)
        self.say(words, found is not None)
        self.take_colours()

    def take_colours(self) -> None:
        """Draw in the window's colours."""
        ground = self.palette().color(QPalette.ColorRole.Base)
        ink = self.palette().color(QPalette.ColorRole.Text)
        beam = "#ff6b5e" if ground.lightness() < 128 else "#c62828"
        self.plot.setBackground(ground)
        paint_axes(self.plot, ink, ink)
        self.plot.clear()
        found, l1, l2 = self._shown
        if found is None:
            return
        diode = np.array([found.horizontal_mm, found.height_mm])
        right = max(diode[0], l1) * 1.1 + 2
        self._line([[-l2 - 4, 0], [right, 0]], pg.mkPen(ink, width=2.5))
        for end, style in (
            (0.0, Qt.PenStyle.SolidLine),
            (l1, Qt.PenStyle.DashLine),
            (-l2, Qt.PenStyle.DashLine),
        ):
            self._line([diode, [end, 0.0]], pg.mkPen(beam, width=1.6, style=style))
        self._line([diode, [diode[0], 0.0]], pg.mkPen(ink, width=1, style=Qt.PenStyle.DotLine))
        level = -0.06 * max(right + l2, diode[1])
        # Away from each other: a small window brings their middles together.
        for name, end, anchor in (("l₁", l1, (-0.05, 0.0)), ("l₂", -l2, (1.05, 0.0))):
            pen = pg.mkPen(ink, width=1.2)
            self._line([[0.0, level], [end, level]], pen, symbol="|", symbolPen=pen)
            self._text(f"{name} {abs(end):.2f} mm", (0.0, level), anchor)
        self.plot.plot(*diode[:, None], pen=None, symbol="s", symbolSize=13, symbolBrush=ink)
        self._text("laser", diode, (0.5, 1.4))
        words = f"beam {found.distance_mm:.1f} mm at {found.angle_deg:.2f}°"
        for part, message in ((0.4, f"height {found.height_mm:.1f} mm"), (0.2, words)):
            self._text(message, (diode[0], diode[1] * part), (1.05, 0.5))
        self.plot.setRange(xRange=(-l2 - 4, right), yRange=(2 * level, diode[1] * 1.15))

    def _line(self, points: object, pen: object, **symbol: object) -> None:
        draw_line(self.plot, np.array(points, float), pen, **symbol)

    def _text(self, words: str, place: object, anchor: tuple[float, float]) -> None:
        color = self.palette().color(QPalette.ColorRole.Text)
        draw_text(self.plot, words, np.asarray(place, float), color, anchor)
