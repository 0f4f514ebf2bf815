"""The bench from the side, to scale: laser, torch, pool, imaging plane and the central rays."""

from __future__ import annotations

import numpy as np
import pyqtgraph as pg
from PySide6.QtCore import Qt
from PySide6.QtGui import QColor, QPalette

from labapp.core.values import FloatArray
from labapp.gui.views.axes import Sketch, draw_line, draw_text, make_plot, paint_axes
from labapp.simulation.positioning import Fate, SideView

RED, BLUE = {True: "#ff6b5e", False: "#c62828"}, {True: "#6cb6ff", False: "#1565c0"}
"""By whether the background is dark."""

TORCH_MM, SHOULDER_MM = 14.0, 3.5
"""How far up the torch is drawn, and the radius of its electrode."""


class BenchView(Sketch):
    """Side view of the bench along −X: Y to the right, Z up, mm.

    The fates of the rays differ by line as well as by colour: solid, dashed, dotted.
    """

    def __init__(self) -> None:
        self._view: SideView | None = None
        self.whole = make_plot("Y, along the weld, mm", "Z, mm")
        self.near = make_plot("enlarged, mm")
        super().__init__("Side view of the bench", (self.whole, 3), (self.near, 2))
        self.follow_theme()

    def show_bench(self, view: SideView | None, words: str) -> None:
        """Draw a bench, or none; the words stand below and are what a screen reader says."""
        former, self._view = self._view, view
        self.say(words, view is not None)
        self._draw()
        if view is not None and (former is None or _extent(view) != _extent(former)):
            self.fit()

    def fit(self) -> None:
        """Show the whole bench."""
        if self._view is not None:
            left, right, top = _extent(self._view)
            self.whole.setRange(xRange=(left, right), yRange=(-2.0, top), padding=0.04)
            left, right = _near(self._view)
            self.near.setRange(xRange=(-left, right), yRange=(-0.4 * right, right), padding=0)

    def take_colours(self) -> None:
        """Draw in the window's colours."""
        palette = self.palette()
        self._ground = palette.color(QPalette.ColorRole.Base)
        self._ink = palette.color(QPalette.ColorRole.Text)
        self._dark = self._ground.lightness() < 128
        for plot in (self.whole, self.near):
            plot.setBackground(self._ground)
            paint_axes(plot, self._faint(0.5), self._ink)
        self._draw()

    def _faint(self, share: float) -> QColor:
        """The text's colour, mixed with the background."""
        mixed = [
            round(share * ink + (1 - share) * ground)
            for ink, ground in zip(
                self._ink.getRgb()[:3],  # type: ignore[index]
                self._ground.getRgb()[:3],  # type: ignore[index]
                strict=True,
            )
        ]
        return QColor(*mixed)

    def _pens(self) -> dict[Fate, object]:
        style = Qt.PenStyle
        return {
            Fate.CAUGHT: pg.mkPen(BLUE[self._dark], width=1.4),
            Fate.PAST: pg.mkPen(self._faint(0.6), width=1.4, style=style.DotLine),
            Fate.BLOCKED: pg.mkPen(RED[self._dark], width=1.8, style=style.DashLine),
            Fate.UNUSED: pg.mkPen(self._faint(0.25), width=1.0),
        }

    def _draw(self) -> None:
        for plot in (self.whole, self.near):
            plot.clear()
            if self._view is not None:
                self._draw_bench(plot, self._view)
        if self._view is not None:
            self._draw_labels(self._view)

    def _draw_bench(self, plot: pg.PlotWidget, view: SideView) -> None:
        pens = self._pens()
        for fate in (Fate.UNUSED, Fate.PAST, Fate.CAUGHT, Fate.BLOCKED):
            paths = [ray.path_mm for ray in view.rays if ray.fate is fate]
            if paths:
                draw_line(plot, _broken(paths), pens[fate])
        thick = pg.mkPen(self._ink, width=2.5)
        draw_line(plot, view.plane_mm, pg.mkPen(self._ink, width=4))
        left, right, _ = _extent(view)
        half = view.pool_mm[-1, 0]
        for start, end in ((left, -half), (half, right)):
            draw_line(plot, np.array([[start, 0.0], [end, 0.0]]), thick)
        draw_line(plot, view.pool_mm, pg.mkPen(RED[self._dark], width=3.5))
        tip = view.tip_mm[1]
        shoulder = tip + 1.6 * SHOULDER_MM
        y = SHOULDER_MM * np.array([-1, -1, 0, 1, 1])
        z = np.array([tip + TORCH_MM, shoulder, tip, shoulder, tip + TORCH_MM])
        torch = draw_line(plot, np.stack([y, z], axis=-1), thick)
        torch.setFillLevel(tip + TORCH_MM)
        torch.setBrush(self._faint(0.2))
        torch.setZValue(5)
        laser = view.laser_mm
        plot.plot(*laser[:, None], pen=None, symbol="s", symbolSize=13, symbolBrush=self._ink)

    def _draw_labels(self, view: SideView) -> None:
        """Names, and L1 and L2 as measured lengths under the work piece."""
        torch = view.tip_mm + np.array([0.0, TORCH_MM])
        draw_text(self.whole, "torch", torch, self._ink, (0.5, 1.0))
        draw_text(self.whole, "laser", view.laser_mm, self._ink, (0.5, 1.5))
        top = np.minimum(view.plane_mm[1], [np.inf, _extent(view)[2]])
        draw_text(self.whole, "imaging plane", top, self._ink, (-0.1, 0.0))
        left, right = _near(view)
        lengths = (
            ("L1", -view.clearance.l1_mm, -left / 2),
            ("L2", view.clearance.l2_mm, right / 2),
        )
        level = -0.15 * right
        for name, length, middle in lengths:
            if not np.isfinite(length) or length == 0:
                continue
            ends = np.array([[0.0, level], [length, level]])
            pen = pg.mkPen(self._ink, width=1.2)
            draw_line(self.near, ends, pen, symbol="|", symbolSize=10, symbolPen=pen)
            words = f"{name}\n{abs(length):.1f} mm"
            draw_text(self.near, words, np.array([middle, level]), self._ink, (0.5, 0.0))


def _near(view: SideView) -> tuple[float, float]:
    """How far from the electrode the enlarged part goes, to the left and to the right, mm."""
    right = 1.3 * float(max(view.pool_mm[-1, 0], view.clearance.l2_mm, 3.0))
    l1_mm = view.clearance.l1_mm
    return max(right, min(1.1 * l1_mm, 3 * right) if np.isfinite(l1_mm) else 0.0), right


def _broken(paths: list[FloatArray]) -> FloatArray:
    """Paths end to end, NaN between them: one item draws them all."""
    gap = np.full((1, 2), np.nan)
    return np.concatenate([part for path in paths for part in (path, gap)])


def _extent(view: SideView) -> tuple[float, float, float]:
    """Left, right and upper end of what is drawn, mm."""
    left = min(float(view.plane_mm[:, 0].min()), -10.0) - 4
    right = max(float(view.laser_mm[0]), 10.0) + 6
    caught = [ray.path_mm[-1, 1] for ray in view.rays if ray.fate is Fate.CAUGHT]
    top = max([float(view.laser_mm[1]), float(view.tip_mm[1]) + TORCH_MM, *caught]) + 4
    return left, right, min(top, max(float(view.plane_mm[:, 1].max()), 40.0) + 4)
