"""Charts of the surface page: reflected dots, the pool from above, its section."""

from __future__ import annotations

import numpy as np
import pyqtgraph as pg
from PySide6.QtCore import QPointF, QSignalBlocker, Qt, Signal

from labapp.core.surface.boundary import Boundary
from labapp.core.values import FloatArray
from labapp.export.rendering.heights import Profile
from labapp.gui.pages.surface.presenter import error_scale
from labapp.gui.theme import faint
from labapp.gui.views.chart import Chart
from labapp.text import HEIGHT_SIGMA_OF

BAND_ALPHA = 70


class DotsChart(Chart):
    """Captured dots as rings, computed dots as crosses, enlarged errors."""

    def __init__(self) -> None:
        super().__init__("Reflected dots on the imaging plane", "X′ (mm)", "Z′ (mm)", equal=True)
        self._captured = pg.ScatterPlotItem(size=9, symbol="o")
        self._computed = pg.ScatterPlotItem(size=7, symbol="+")
        self._errors = pg.PlotCurveItem(connect="pairs")
        for item in (self._errors, self._captured, self._computed):
            self.plot.addItem(item)
        self.follow_theme()

    def show_dots(
        self,
        dots: tuple[FloatArray, FloatArray] | None,
        without: str = "No reflected dots to compare",
    ) -> None:
        """Show captured and computed dots, each of shape (n, 2), mm; None: show the reason."""
        captured, computed = dots if dots is not None else (np.empty((0, 2)), np.empty((0, 2)))
        scale = error_scale(captured, computed)
        self._captured.setData(pos=captured)
        known = np.isfinite(computed).all(axis=1)
        captured, computed = captured[known], computed[known]
        self._computed.setData(pos=computed)
        ends = np.stack([captured, captured + scale * (computed - captured)], axis=1).reshape(-1, 2)
        self._errors.setData(ends[:, 0], ends[:, 1])
        message = f"○ captured, + computed; lines: errors × {scale:g}"
        self.say(message if dots is not None else without)
        self.plot.setVisible(dots is not None)
        self.plot.autoRange()

    def take_colours(self) -> None:
        """Take the window's colours."""
        super().take_colours()
        self._captured.setPen(pg.mkPen(self.text))
        self._captured.setBrush(pg.mkBrush(None))
        self._computed.setPen(pg.mkPen(self.accent, width=2))
        self._errors.setPen(pg.mkPen(self.accent, width=2))


class PlanChart(Chart):
    """The pool from above; both ends of the section line can be dragged, or the whole line."""

    dragged = Signal(float, float)
    """The line was moved: its angle, degrees, and offset, mm (see `profile`)."""

    def __init__(self) -> None:
        super().__init__("Section line", "X (mm)", "Y (mm)", equal=True)
        self._outline = pg.PlotCurveItem()
        self._line = pg.LineSegmentROI([[0.0, -1.0], [0.0, 1.0]])
        self._line.setAcceptedMouseButtons(Qt.MouseButton.LeftButton)
        self._line.sigRegionChanged.connect(self._moved)
        self._telling = False
        self.plot.addItem(self._outline)
        self.plot.addItem(self._line)
        self.follow_theme()

    def show_pool(self, boundary: Boundary | None, section: tuple[float, float] | None) -> None:
        """Show a boundary and the section line through it; None: do not show it."""
        points = np.empty((0, 3)) if boundary is None else boundary.points_mm
        closed = np.vstack([points, points[:1]])
        self._outline.setData(closed[:, 0], closed[:, 1])
        drawn = section is not None and boundary is not None
        self._line.setVisible(drawn)
        self.say("Section: drag the line or its ends" if drawn else "No section")
        if section is not None and boundary is not None and not self._telling:
            self._place(boundary, *section)
        if not self._telling:
            self.plot.autoRange()

    def _place(self, boundary: Boundary, angle_deg: float, offset_mm: float) -> None:
        angle = np.radians(angle_deg)
        way, aside = (np.cos(angle), np.sin(angle)), (-np.sin(angle), np.cos(angle))
        reach = boundary.points_mm[:, :2] @ np.array(way)
        ends = [
            QPointF(*(end * np.array(way) + offset_mm * np.array(aside)))
            for end in (reach.min() * 1.15, reach.max() * 1.15)
        ]
        with QSignalBlocker(self._line):
            self._line.setPos(0.0, 0.0, finish=False)
            for handle, end in zip(self._line.getHandles(), ends, strict=True):
                self._line.movePoint(handle, end, finish=False, coords="parent")

    def _moved(self) -> None:
        a, b = (self._line.mapToParent(handle.pos()) for handle in self._line.getHandles())
        way = np.array([b.x() - a.x(), b.y() - a.y()])
        length = float(np.hypot(*way))
        if length < 1e-6:
            return
        angle = float(np.degrees(np.arctan2(way[1], way[0])))
        offset = float((way[0] * a.y() - way[1] * a.x()) / length)
        self._telling = True
        self.dragged.emit(angle, offset)
        self._telling = False

    def take_colours(self) -> None:
        """Take the window's colours."""
        super().take_colours()
        self._outline.setPen(pg.mkPen(self.text, width=2))
        pen = pg.mkPen(self.accent, width=3)
        self._line.setPen(pen)
        for handle in self._line.getHandles():
            handle.pen = handle.currentPen = pen
            handle.update()


class ProfileChart(Chart):
    """Height along the section line with ± as a band and the boundary as diamonds."""

    def __init__(self) -> None:
        super().__init__("Height profile", "Along the section line (mm)", "Height (mm)", False)
        self._low, self._high = pg.PlotCurveItem(), pg.PlotCurveItem()
        self._band = pg.FillBetweenItem(self._low, self._high)
        self._height = pg.PlotCurveItem()
        self._edge = pg.ScatterPlotItem(size=10, symbol="d")
        for item in (self._band, self._low, self._high, self._height, self._edge):
            self.plot.addItem(item)
        self.follow_theme()

    def show_profile(self, cut: Profile | None, edge: str = "boundary") -> None:
        """Show a profile, which ends at an edge; None: show nothing."""
        if cut is None or not len(cut.edge_mm):
            for curve in (self._low, self._high, self._height):
                curve.setData([], [])
            self._edge.setData(pos=np.empty((0, 2)))
            self.say("The section line misses the pool" if cut is not None else "No section")
            return
        known = np.isfinite(cut.height_mm)
        along, height = cut.along_mm[known], cut.height_mm[known]
        sigma = np.nan_to_num(cut.sigma_mm[known])
        self._height.setData(along, height)
        self._low.setData(along, height - sigma)
        self._high.setData(along, height + sigma)
        self._edge.setData(pos=cut.edge_mm)
        band = f"; band: ±, {HEIGHT_SIGMA_OF}" if sigma.any() else "; this scheme gives no ±"
        self.say(f"Height along the section; ◆ {edge}{band}")
        self.plot.autoRange()

    def take_colours(self) -> None:
        """Take the window's colours."""
        super().take_colours()
        self._height.setPen(pg.mkPen(self.accent, width=2))
        pale = faint(self.accent, BAND_ALPHA)
        self._band.setBrush(pg.mkBrush(pale))
        for edge in (self._low, self._high):
            edge.setPen(pg.mkPen(pale))
        self._edge.setPen(pg.mkPen(self.text))
        self._edge.setBrush(pg.mkBrush(None))
