"""Drawing to scale of the bench, from the side and from above, with fields for its dimensions."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import Any

import numpy as np
import pyqtgraph as pg
from PySide6.QtCore import QPointF, QRect, QRectF, Qt
from PySide6.QtGui import QColor, QPalette, QResizeEvent
from PySide6.QtWidgets import QAbstractSpinBox, QBoxLayout, QGridLayout, QWidget

from labapp.core.geometry.rig import Rig
from labapp.core.values import FloatArray
from labapp.gui.theme import RED
from labapp.gui.views.axes import Sketch, draw_line, draw_text, make_plot, paint_axes, show_axes
from labapp.gui.views.drawings.dimension import DimensionBox
from labapp.gui.widgets.fields import NumberField
from labapp.gui.widgets.labels import plain_tip
from labapp.gui.widgets.layouts import vbox
from labapp.simulation.positioning import Fate, SideView

BLUE = {True: "#6cb6ff", False: "#1565c0"}
"""Colours by whether the background is dark."""

TORCH_MM, SHOULDER_MM = 14.0, 3.5
"""Drawn height of the torch, and radius of its electrode."""


DRAWN = {
    "laser.projection_angle_deg": "α",
    "laser.distance_mm": "d",
    "electrode.height_mm": "tip",
    "imaging_plane.distance_mm": "D",
    "imaging_plane.h_mm": "h",
    "imaging_plane.height_mm": "height",
    "imaging_plane.s_mm": "s",
    "imaging_plane.width_mm": "width",
}
"""Dimensions with a field in the drawing, and their labels."""

IN_TOP_VIEW = ("imaging_plane.s_mm", "imaging_plane.width_mm")

BESIDE, BESIDE_PX = 3, 400
"""Fields per row below the drawing, and the canvas width below which there is one less."""

NARROW_PX = 760
"""On a narrower canvas there is no space for the enlarged view."""

SMALL_PX = (480, 400)
"""On a narrower or lower canvas the fields would hide the drawing."""

CLICK_PX = 22
"""Largest distance, px, of a click from the letter of a dimension to select it."""


class BenchView(Sketch):
    """Views of the bench along −X (Y to the right, Z up) and from above (X downwards), mm.

    The fates of the rays differ in line style (solid, dashed, dotted) as well as in colour. The
    fields of the dimensions have the keys of `DRAWN`.
    """

    def __init__(self, fields: Mapping[str, NumberField]) -> None:
        self._view: SideView | None = None
        self._rig: Rig | None = None
        self.whole = make_plot("Y, along the weld, mm", "Z, mm")
        self.top = make_plot("from above: Y, mm", "X, mm")
        self.top.invertY(True)
        self.near = make_plot("enlarged, mm")
        self._views = vbox((self.whole, 3), (self.top, 2))
        super().__init__(
            "Drawing of the bench from the side and from above", (self._views, 3), (self.near, 2)
        )
        self._plots = [self.whole, self.top, self.near]  # shown and hidden together
        self._said = ""
        self._is_small = False
        self.boxes = {
            key: DimensionBox(DRAWN[key], field, self.top if key in IN_TOP_VIEW else self.whole)
            for key, field in fields.items()
        }
        self._beside = 0
        self._strip = QWidget()
        self._grid = QGridLayout(self._strip)
        self._grid.setContentsMargins(4, 2, 4, 0)
        self._column.insertWidget(1, self._strip)
        for plot in (self.whole, self.top):
            plot.getViewBox().sigTransformChanged.connect(lambda _: self._place_fields())
            plot.scene().sigMouseClicked.connect(partial(self._choose, plot))
        self._arrange()
        self.follow_theme()

    def show_bench(self, rig: Rig | None, view: SideView | None, words: str) -> None:
        """Draw a bench, or none, with text below that also describes it to a screen reader."""
        former, self._view, self._rig, self._said = self._view, view, rig, words
        self._arrange()
        self._draw()
        if view is not None and (former is None or _extent(view) != _extent(former)):
            self.fit()
        self._place_fields()

    def fit(self) -> None:
        """Show the whole bench."""
        if self._view is not None and self._rig is not None:
            left, right, top = _extent(self._view)
            self.whole.setRange(xRange=(left, right), yRange=(-12.0, top), padding=0.02)
            first, last = _across(self._rig)
            self.top.setRange(xRange=(left, right), yRange=(first, last), padding=0.08)
            left, right = _near(self._view)
            self.near.setRange(xRange=(-left, right), yRange=(-0.4 * right, right), padding=0)

    def resizeEvent(self, event: QResizeEvent) -> None:
        """Hide the parts for which there is no space."""
        super().resizeEvent(event)
        self._arrange()

    def _arrange(self) -> None:
        """On a small canvas place the views side by side and the fields below them."""
        is_drawn = self._view is not None
        width, height = SMALL_PX
        is_small = self.width() < width or self.height() < height
        first, _, rest = self._said.partition(". ")
        short = f"{first}. …" if rest else self._said
        self.say(short if is_small and is_drawn else self._said, is_drawn)
        self.words.setToolTip(plain_tip(self._said))
        self.describe(self._said)
        self.near.setVisible(is_drawn and not is_small and self.width() >= NARROW_PX)
        self._strip.setVisible(is_drawn and is_small)
        beside = (BESIDE if self.width() >= BESIDE_PX else BESIDE - 1) if is_small else 0
        if beside != self._beside:
            self._beside = beside
            self._move_fields()
        if is_small != self._is_small:
            self._is_small = is_small
            way = QBoxLayout.Direction
            self._views.setDirection(way.LeftToRight if is_small else way.TopToBottom)
            show_axes((self.whole, self.top), not is_small)
            self._draw()
            self.fit()

    def _move_fields(self) -> None:
        """Place the fields in rows below the drawing, or on it."""
        for k, box in enumerate(self.boxes.values()):
            self._grid.removeWidget(box)
            if self._beside:
                self._grid.addWidget(box, k // self._beside, k % self._beside)
            else:
                box.setParent(box.plot)
                box.show()

    def _place_fields(self) -> None:
        """Place the fields at their dimensions, without overlapping each other or obstacles."""
        if self._rig is None or self._view is None or self._is_small:
            return
        taken = {plot: self.obstacles(plot) for plot in (self.whole, self.top)}
        for key, (_, place) in _dimensions(self._rig, self._view).items():
            box = self.boxes[key]
            box.put_at(place, taken[box.plot])

    def obstacles(self, plot: pg.PlotWidget) -> list[QRect]:
        """Rectangles of names, torch and axes, which no field may cover, in pixels."""
        plot.getViewBox().updateMatrix()
        items = [each for each in plot.items() if isinstance(each, pg.TextItem)]
        for name in items:
            name.updateTransform()  # it would follow the view only when it is painted
        items += [plot.getAxis(side) for side in ("left", "bottom")]
        found = [plot.mapFromScene(each.sceneBoundingRect()).boundingRect() for each in items]
        if plot is self.whole and self._view is not None:
            box = plot.getViewBox()
            low = self._view.tip_mm - np.array([SHOULDER_MM, 0.0])
            high = self._view.tip_mm + np.array([SHOULDER_MM, TORCH_MM])
            corners = [box.mapViewToScene(QPointF(*each.tolist())) for each in (low, high)]
            found.append(plot.mapFromScene(QRectF(*corners).normalized()).boundingRect())
        return found

    def _choose(self, plot: pg.PlotWidget, event: Any) -> None:
        """Focus the field of a dimension whose letter was clicked."""
        if self._rig is None or self._view is None or not self._is_small:
            return
        box, at = plot.getViewBox(), event.scenePos()
        for key, (_, place) in _dimensions(self._rig, self._view).items():
            there = box.mapViewToScene(QPointF(*place.tolist()))
            if self.boxes[key].plot is plot and (there - at).manhattanLength() < CLICK_PX:
                editor = self.boxes[key].field.editor
                assert isinstance(editor, QAbstractSpinBox)
                editor.setFocus()
                editor.selectAll()

    def take_colours(self) -> None:
        """Draw in the colours of the theme."""
        palette = self.palette()
        self._ground = palette.color(QPalette.ColorRole.Base)
        self._ink = palette.color(QPalette.ColorRole.Text)
        self._dark = self._ground.lightness() < 128
        for plot in (self.whole, self.top, self.near):
            plot.setBackground(self._ground)
            paint_axes(plot, self._faint(0.5), self._ink)
        self._draw()

    def _faint(self, share: float) -> QColor:
        """Text colour mixed with the background."""
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
        for plot in (self.whole, self.top, self.near):
            plot.clear()
        if self._view is None or self._rig is None:
            return
        for plot in (self.whole, self.near):
            self._draw_bench(plot, self._view)
        self._draw_from_above(self._rig, self._view)
        self._draw_labels(self._view)
        pen = pg.mkPen(self._faint(0.75), width=1.2)
        for key, (line, place) in _dimensions(self._rig, self._view).items():
            mark = {"symbol": "o", "symbolSize": 4, "symbolPen": pen, "symbolBrush": None}
            draw_line(self.boxes[key].plot, line, pen, **({} if len(line) > 2 else mark))
            if self._is_small:
                beside = place[0] > line[:, 0].max()
                anchor = (0.0 if beside else 0.5, 0.5)
                draw_text(self.boxes[key].plot, DRAWN[key], place, self._ink, anchor)

    def _draw_from_above(self, rig: Rig, view: SideView) -> None:
        """Draw plane, pool, weld axis, laser and fan edges from above, (y, x)."""
        plane, half = rig.imaging_plane, float(view.pool_mm[-1, 0])
        ends = np.array([[0.0, 0.0], [plane.width_mm, 0.0]])
        draw_line(self.top, plane.to_universal(ends)[:, [1, 0]], pg.mkPen(self._ink, width=4))
        left, right, _ = _extent(view)
        axis = np.array([[left, 0.0], [right, 0.0]])
        draw_line(self.top, axis, pg.mkPen(self._faint(0.4), style=Qt.PenStyle.DashDotLine))
        turn = np.linspace(0, 2 * np.pi, 49)
        round_ = np.stack([half * np.cos(turn), 0.8 * half * np.sin(turn)], axis=-1)
        draw_line(self.top, round_, pg.mkPen(RED[self._dark], width=2))
        laser = rig.laser.position_mm[[1, 0]]
        fan_deg = _fan_deg(rig)
        reach = rig.laser.distance_mm * np.tan(np.radians(fan_deg / 2))
        fan = np.array([[0.0, -reach], laser, [0.0, reach]])
        draw_line(self.top, fan, pg.mkPen(BLUE[self._dark], width=1.4))
        self.top.plot(*laser[:, None], pen=None, symbol="s", symbolSize=13, symbolBrush=self._ink)
        anchor = (1.0 if self._is_small else 0.5, -0.4)
        draw_text(self.top, f"full fan {fan_deg:.1f}°", laser, self._ink, anchor)
        origin = plane.to_universal(ends)[0, [1, 0]]
        draw_text(self.top, "O′", origin, self._ink, (-0.3, 0.5))

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
        """Draw names, and L1 and L2 as dimensions below the work piece."""
        torch = view.tip_mm + np.array([0.0, TORCH_MM])
        draw_text(self.whole, "torch", torch, self._ink, (0.5, 1.0))
        draw_text(self.whole, "laser", view.laser_mm, self._ink, (0.5, 1.5))
        top = np.minimum(view.plane_mm[1], [np.inf, _extent(view)[2]])
        draw_text(self.whole, "imaging plane", top, self._ink, (-0.1, 0.0))
        draw_text(self.whole, "O′", view.plane_mm[0], self._ink, (-0.3, 0.8))
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
    """Extent of the enlarged part to the left and right of the electrode, mm."""
    right = 1.3 * float(max(view.pool_mm[-1, 0], view.clearance.l2_mm, 3.0))
    l1_mm = view.clearance.l1_mm
    return max(right, min(1.1 * l1_mm, 3 * right) if np.isfinite(l1_mm) else 0.0), right


def _across(rig: Rig) -> tuple[float, float]:
    """Lowest and highest X in the view from above, mm."""
    x = rig.imaging_plane.to_universal(np.array([[0.0, 0.0], [rig.imaging_plane.width_mm, 0.0]]))
    return float(min(x[:, 0].min(), -10.0)), float(max(x[:, 0].max(), 10.0))


def _fan_deg(rig: Rig) -> float:
    """Angle between the outermost columns of the pattern, or the ends of a line, degrees."""
    tangents = rig.pattern.tangents[..., 0]
    lowest, highest = np.arctan([np.nanmin(tangents), np.nanmax(tangents)])
    return float(np.degrees(highest - lowest))


def _dimensions(rig: Rig, view: SideView) -> dict[str, tuple[FloatArray, FloatArray]]:
    """Line of each dimension, shape (n, 2), and centre of its field, shape (2,), mm."""
    laser, alpha = view.laser_mm, np.radians(rig.laser.projection_angle_deg)
    lower, upper = view.plane_mm
    outside = lower[0] - 3
    _, _, highest = _extent(view)
    turn = np.linspace(0, alpha, 20)
    arc = 0.62 * np.hypot(*laser) * np.stack([np.cos(turn), np.sin(turn)], axis=-1)
    tip = view.tip_mm[1]
    top_mm = min(upper[1], highest)
    corners = rig.imaging_plane.to_universal(
        np.array([[0.0, 0.0], [rig.imaging_plane.width_mm, 0.0]])
    )[:, [1, 0]]
    start, end = corners
    lines = {
        "laser.projection_angle_deg": (arc, arc[8] + [6.0, 0.0]),
        "laser.distance_mm": ([[0.0, 0.0], laser], 0.6 * laser + [-2.0, 8.0]),
        "electrode.height_mm": ([[8.0, 0.0], [8.0, tip]], [12.0, -6.0]),
        "imaging_plane.distance_mm": ([[lower[0], -5.0], [0.0, -5.0]], [lower[0] / 2, -6.0]),
        "imaging_plane.h_mm": ([[outside, 0.0], [outside, lower[1]]], [outside, -4.0]),
        "imaging_plane.height_mm": (
            [[outside, lower[1]], [outside, top_mm]],
            [lower[0] + 8, lower[1] + 0.3 * (top_mm - lower[1])],
        ),
        "imaging_plane.s_mm": ([[outside, 0.0], start - [3, 0]], [start[0] + 10, start[1] / 2]),
        "imaging_plane.width_mm": (corners + np.array([2.0, 0.0]), [end[0] + 10, end[1] * 0.7]),
    }
    return {key: (np.array(line), np.array(place)) for key, (line, place) in lines.items()}


def _broken(paths: list[FloatArray]) -> FloatArray:
    """Paths concatenated with NaN between them, so that one item draws them all."""
    gap = np.full((1, 2), np.nan)
    return np.concatenate([part for path in paths for part in (path, gap)])


def _extent(view: SideView) -> tuple[float, float, float]:
    """Left, right and upper limit of the drawing, mm."""
    left = min(float(view.plane_mm[:, 0].min()), -10.0) - 4
    right = max(float(view.laser_mm[0]), 10.0) + 6
    caught = [ray.path_mm[-1, 1] for ray in view.rays if ray.fate is Fate.CAUGHT]
    top = max([float(view.laser_mm[1]), float(view.tip_mm[1]) + TORCH_MM, *caught]) + 4
    return left, right, min(top, max(float(view.plane_mm[:, 1].max()), 40.0) + 4)
