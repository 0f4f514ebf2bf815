"""Plots of curves below each other over a common axis: zoom, read-out, selection, copies.

The wheel and dragging act along the common axis; the vertical axes always fit the visible part.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import pyqtgraph as pg
from PySide6.QtCore import QPointF, Qt, Signal
from PySide6.QtGui import (
    QFontMetricsF,
    QGuiApplication,
    QKeyEvent,
    QPalette,
)
from PySide6.QtWidgets import QGraphicsItem, QSizePolicy, QVBoxLayout

from labapp.core.values import IntArray
from labapp.gui.curves import Axis, Curve, as_table, nearest, next_key, point_text
from labapp.gui.theme import RED, faint, is_dark
from labapp.gui.views.axes import paint_axes, plain_axes
from labapp.gui.views.canvas import Plotted
from labapp.gui.views.picture_files import save_plot
from labapp.gui.widgets.buttons import add_menu
from labapp.gui.widgets.labels import plain_tip, wrapping_label
from labapp.gui.widgets.layouts import fill, scrolled

pg.setConfigOptions(imageAxisOrder="row-major", antialias=True)

MOST_POINTS = 1500
"""If more points are visible, only the line and points with a special mark are drawn."""

NEAR = 18.0
"""Largest distance, screen pixels, of a click from a point to select it."""

AXIS_WIDTH = 60
TITLE_HEIGHT = 18
NUMBER_LINES = 1.3
"""Height of a number at an axis, as a multiple of the line height of its font."""

LEAST_HEIGHT = 76
"""Minimum height of a plot; plots that do not fit can be scrolled."""

SYMBOLS = {"●": "o", "○": "o", "■": "s", "▪": "s", "×": "x"}
KEYS = "← → step through the points, Home End to the first and last, + − zoom, F shows all"
Role = QPalette.ColorRole


class PlotStack(Plotted):
    """Plots below each other."""

    chosen = Signal(int)
    """The operator selected a point with the pointer or the keys: its key."""

    def __init__(self, name: str = "Plots") -> None:
        super().__init__(name, KEYS)
        self.curves: tuple[Curve, ...] = ()
        self.axis = Axis("", "")
        self._plots: list[_Plot] = []
        self._current: int | None = None
        self._place: float | None = None
        self._without = ""
        self.setToolTip(f"Click a point to go to its frame; wheel or drag along the axis. {KEYS}")
        self.canvas = pg.GraphicsLayoutWidget()
        self.canvas.setFocusPolicy(Qt.FocusPolicy.NoFocus)
        self.canvas.setSizePolicy(QSizePolicy.Policy.Expanding, QSizePolicy.Policy.Expanding)
        self.area = scrolled(self.canvas)
        self.area.setMinimumSize(240, 110)
        self.legend = wrapping_label()
        self.legend.setContentsMargins(8, 0, 8, 0)
        self.read_out = wrapping_label(" ")
        self.read_out.setContentsMargins(8, 0, 8, 4)
        self.read_out.setAlignment(Qt.AlignmentFlag.AlignTop)
        self.read_out.setSizePolicy(QSizePolicy.Policy.Ignored, QSizePolicy.Policy.Fixed)
        layout = QVBoxLayout(self)
        layout.setContentsMargins(1, 1, 1, 1)
        layout.setSpacing(2)
        fill(layout, (self.area, 1), self.legend, self.read_out)
        scene = self.canvas.scene()
        scene.sigMouseClicked.connect(self._clicked)
        scene.sigMouseMoved.connect(self._moved)
        add_menu(
            self,
            ("Copy picture", self.copy_picture),
            ("Save picture…", save_plot(self, self.canvas, "trends")),
            ("Copy values as table", self.copy_table),
            ("Show all", self.fit),
        )
        self.follow_theme()

    # --- what it shows ------------------------------------------------------------------------

    def show_curves(self, curves: Sequence[Curve], axis: Axis) -> None:
        """Show each curve in a separate plot; keep the visible range for the same curves."""
        titles = [curve.title for curve in curves]
        same = titles == [curve.title for curve in self.curves] and axis == self.axis
        self.curves, self.axis = tuple(curves), axis
        if not same:
            self._lay_out()
        for plot, curve in zip(self._plots, curves, strict=True):
            plot.show_curve(curve)
        if not same:
            self.fit()
        self._show_legend()
        if not (same and self._current is None and self._place is None):
            self.set_current(
                self._current, self._place, self._without
            )  # otherwise the value under the pointer stays visible

    def set_current(self, key: int | None, place: float | None = None, without: str = "") -> None:
        """Mark the point with a key in every plot; if no curve has it, a position, with a text."""
        self._current, self._place, self._without = key, place, without
        found = [(curve, _index_of(curve, key)) for curve in self.curves]
        points = [(curve, index) for curve, index in found if index is not None]
        if points:
            place = float(points[0][0].x[points[0][1]])
        for plot in self._plots:
            _put(plot.current, place)
        words = [point_text(curve, index, self.axis) for curve, index in points]
        self._show_read_out(_joined(words) if words else without)

    def fit(self) -> None:
        """Show the whole axis."""
        ends = [(float(c.x[0]), float(c.x[-1])) for c in self.curves if len(c.x)]
        ends += [self.axis.span] if self.axis.span else []
        if ends and self._plots:
            low, high = min(low for low, _ in ends), max(high for _, high in ends)
            room = 0.02 * (high - low) or 0.5
            self._plots[0].setXRange(low - room, high + room, padding=0)

    def zoom(self, factor: float) -> None:
        """Zoom about the centre of the axis; a factor above 1 enlarges."""
        if self._plots:
            self._plots[0].getViewBox().scaleBy(x=1 / factor)

    # --- copies -------------------------------------------------------------------------------

    def copy_table(self) -> None:
        """Copy the points of all curves to the clipboard, tab-separated."""
        QGuiApplication.clipboard().setText(as_table(self.curves, self.axis))

    # --- within -------------------------------------------------------------------------------

    def _lay_out(self) -> None:
        for plot in self._plots:
            plot.hide()  # a plot that is only removed may still be drawn
        self.canvas.clear()
        self._plots = []
        for row in range(len(self.curves)):
            plot = _Plot(self._plots[0] if self._plots else None)
            self.canvas.addItem(plot, row=row, col=0)
            plot.getAxis("bottom").setStyle(showValues=row == len(self.curves) - 1)
            self._plots.append(plot)
        if self._plots:
            self._plots[-1].setLabel("bottom", self.axis.title)
        self.canvas.setMinimumHeight(LEAST_HEIGHT * len(self._plots) + 40)
        lines = 2 if sum(len(curve.key) > 0 for curve in self.curves) > 1 else 1
        self.read_out.setFixedHeight(lines * self.fontMetrics().lineSpacing() + 6)
        self.take_colours()

    def take_colours(self) -> None:
        """Draw in the colours of the theme."""
        look = self.palette()
        self.canvas.setBackground(look.color(Role.Base))
        for plot, curve in zip(self._plots, self.curves, strict=True):
            plot.apply_palette(curve, look)
            plot.show_curve(curve)

    def _show_legend(self) -> None:
        marks = {
            curve.marks[number]: None for curve in self.curves for number in np.unique(curve.mark)
        }
        words = [f"{m.sign} {m.words}" for m in marks if m.words]
        has_events = any(len(curve.events) for curve in self.curves)
        self.legend.setText("    ".join(words + ["┊ change"] * has_events))
        is_usual = not any(curve.mark.any() for curve in self.curves)  # the first mark only
        self.legend.setVisible(len(marks) > 1 or has_events or not is_usual)

    def _show_read_out(self, words: str) -> None:
        self.read_out.setText(words or " ")
        # It grows if a line wraps and never shrinks, so that the plots above do not jump.
        height = self.read_out.heightForWidth(self.read_out.width())
        self.read_out.setFixedHeight(max(self.read_out.minimumHeight(), height))
        self.read_out.setToolTip(plain_tip(words))
        self.describe(words)

    def _under(self, at: QPointF) -> tuple[_Plot, Curve] | None:
        for plot, curve in zip(self._plots, self.curves, strict=True):
            if plot.sceneBoundingRect().contains(at):
                return plot, curve
        return None

    def _moved(self, at: QPointF) -> None:
        found = self._under(at)
        if found is None:
            for plot in self._plots:
                _put(plot.cross, None)
            return
        plot, curve = found
        x = float(plot.getViewBox().mapSceneToView(at).x())
        for each in self._plots:
            _put(each.cross, x)
        index = nearest(curve, x)
        if index is not None:
            self._show_read_out(point_text(curve, index, self.axis))

    def _clicked(self, event: pg.GraphicsScene.mouseEvents.MouseClickEvent) -> None:
        self.setFocus(Qt.FocusReason.MouseFocusReason)
        found = self._under(event.scenePos())
        if found is None or event.button() != Qt.MouseButton.LeftButton:
            return
        plot, curve = found
        if not len(curve.key):
            return
        box = plot.getViewBox()
        places = np.column_stack([curve.x, curve.y]) / np.array(box.viewPixelSize())
        here = box.mapSceneToView(event.scenePos())
        here_px = np.array([here.x(), here.y()]) / np.array(box.viewPixelSize())
        distance = np.hypot(*(places - here_px).T)
        if len(distance) and np.nanmin(distance) <= NEAR:
            self.chosen.emit(int(curve.key[int(np.nanargmin(distance))]))

    def keyPressEvent(self, event: QKeyEvent) -> None:
        """Step through the points; zoom."""
        steps = {Qt.Key.Key_Left: -1, Qt.Key.Key_Right: 1, Qt.Key.Key_Home: -(10**9)}
        steps[Qt.Key.Key_End] = 10**9
        key = Qt.Key(event.key())
        if key in steps:
            there = next_key(
                self.curves, -1 if self._current is None else self._current, steps[key]
            )
            if there is not None:
                self.chosen.emit(there)
        else:
            super().keyPressEvent(event)


class _Plot(pg.PlotItem):  # type: ignore[misc]
    """One curve with its axes: line, error bars, points, level, and two vertical lines."""

    def __init__(self, over: _Plot | None) -> None:
        super().__init__(axisItems=plain_axes())
        self._curve: Curve | None = None
        self._look = QPalette()
        self.hideButtons()
        self.setMenuEnabled(False)
        box = self.getViewBox()
        box.setMouseEnabled(x=True, y=False)
        box.setAutoVisible(y=True)
        box.enableAutoRange(x=False, y=True)
        if over is not None:
            self.setXLink(over)
        for side in ("left", "bottom"):
            # The grid takes half of the drawing time, and stepping moves only the vertical line.
            self.getAxis(side).setCacheMode(QGraphicsItem.CacheMode.DeviceCoordinateCache)
        self.getAxis("left").setWidth(AXIS_WIDTH)
        box.sigResized.connect(lambda *_: self._thin_out())
        # Above the plot: beside a low plot the name would be cut off.
        self.titleLabel.setVisible(True)
        self.titleLabel.setMaximumHeight(TITLE_HEIGHT)
        self.layout.setRowFixedHeight(0, TITLE_HEIGHT)
        self.line = pg.PlotDataItem(connect="finite", autoDownsample=True, clipToView=True)
        self.line.setDownsampling(auto=True, method="peak")
        self.bars = pg.PlotCurveItem(connect="pairs")
        self.points = pg.ScatterPlotItem(pxMode=True)
        self.level = pg.InfiniteLine(angle=0)
        self.limits = pg.InfiniteLine(angle=0), pg.InfiniteLine(angle=0)
        self.current = pg.InfiniteLine(angle=90)
        self.cross = pg.InfiniteLine(angle=90)
        self.events: list[pg.InfiniteLine] = []
        for item in (self.bars, self.line, self.points):
            self.addItem(item)
        for item in (self.level, self.current, self.cross):
            self.addItem(item, ignoreBounds=True)
            item.hide()
        for item in self.limits:
            self.addItem(item)
            item.hide()
        box.sigXRangeChanged.connect(lambda *_: self._show_points())

    def apply_palette(self, curve: Curve, look: QPalette) -> None:
        """Use a palette's colours and a curve's title; this redraws the axes, which is slow."""
        self._look = look
        accent, text = look.color(Role.Accent), look.color(Role.Text)
        paint_axes(self, look.color(Role.Mid), text)
        size = f"{QGuiApplication.font().pointSizeF():g}pt"
        look_of = {"color": text.name(), "bold": True, "justify": "left", "size": size}
        self.titleLabel.setText(curve.title, **look_of)
        self.showGrid(x=True, y=True, alpha=0.18)
        line = faint(accent, 110) if len(curve.key) else accent
        self.line.setPen(pg.mkPen(line, width=1))
        self.bars.setPen(pg.mkPen(faint(accent, 150), width=1))
        self.level.setPen(pg.mkPen(faint(text, 150), width=1, style=Qt.PenStyle.DashLine))
        for line in self.limits:
            line.setPen(pg.mkPen(RED[is_dark(look)], width=1.5, style=Qt.PenStyle.DashLine))
        self.current.setPen(pg.mkPen(accent, width=1.5))
        self.cross.setPen(pg.mkPen(faint(text, 90), width=1))
        if curve.from_zero:
            self.getViewBox().setLimits(yMin=0)

    def _thin_out(self) -> None:
        """Limit the numbers at the vertical axis to the available height and font size."""
        height = max(self.getViewBox().height(), 1.0)
        room = height / (NUMBER_LINES * QFontMetricsF(QGuiApplication.font()).height())
        self.getAxis("left").setTickDensity(min(1.0, room / max(math.log(height), 2.0)))

    def show_curve(self, curve: Curve) -> None:
        """Show a curve."""
        self._curve = curve
        self.line.setData(*curve.line)
        _put(self.level, curve.level if np.isfinite(curve.level) else None)
        for item, limit in zip(self.limits, curve.limits, strict=True):
            _put(item, limit)
        self._show_events(curve)
        self._show_points()

    def _show_events(self, curve: Curve) -> None:
        for line in self.events:
            self.removeItem(line)
        pen = pg.mkPen(self._look.color(Role.Text), width=1.5, style=Qt.PenStyle.DotLine)
        self.events = [pg.InfiniteLine(x, angle=90, pen=pen) for x in curve.events.tolist()]
        for line in self.events:
            self.addItem(line, ignoreBounds=True)

    def _show_points(self) -> None:
        """Draw the visible points and error bars, unless there are too many to distinguish."""
        curve = self._curve
        if curve is None or not len(curve.key):
            self.points.clear()
            self.bars.clear()
            return
        low, high = self.getViewBox().viewRange()[0]
        first, end = np.searchsorted(curve.x, [low, high]).tolist()
        seen = np.arange(max(first - 1, 0), min(end + 1, len(curve.x)))
        many = curve.quick or len(seen) > MOST_POINTS
        drawn = seen[curve.mark[seen] > 0][:MOST_POINTS] if many else seen
        looks = [self._brushed(curve.marks[number].sign) for number in range(len(curve.marks))]
        marks = curve.mark[drawn].tolist()
        self.points.setData(
            x=curve.x[drawn],
            y=curve.y[drawn],
            symbol=[looks[k][0] for k in marks],
            size=[looks[k][1] for k in marks],
            pen=[looks[k][2] for k in marks],
            brush=[looks[k][3] for k in marks],
        )
        self._show_bars(curve, seen if curve.quick or not many else seen[:0])

    def _show_bars(self, curve: Curve, seen: IntArray) -> None:
        if not len(curve.sigma) or not len(seen):
            self.bars.clear()
            return
        with_bar = seen[np.isfinite(curve.sigma[seen])]
        x = np.repeat(curve.x[with_bar], 2)
        up = np.column_stack([-curve.sigma[with_bar], curve.sigma[with_bar]])
        self.bars.setData(x, (curve.y[with_bar, None] + up).ravel())

    def _brushed(self, sign: str) -> tuple[str, int, pg.QtGui.QPen, pg.QtGui.QBrush]:
        """Symbol, size, pen and brush of a mark."""
        look = self._look
        accent, text, base = (look.color(role) for role in (Role.Accent, Role.Text, Role.Base))
        if sign == "○":
            return SYMBOLS[sign], 11, pg.mkPen(text, width=1.8), pg.mkBrush(base)
        if sign == "■":
            return SYMBOLS[sign], 9, pg.mkPen(base, width=0.5), pg.mkBrush(text)
        if sign == "▪":
            return SYMBOLS[sign], 4, pg.mkPen(None), pg.mkBrush(RED[is_dark(look)])
        if sign == "×":
            return SYMBOLS[sign], 9, pg.mkPen(None), pg.mkBrush(look.color(Role.PlaceholderText))
        return SYMBOLS[sign], 7, pg.mkPen(base, width=0.5), pg.mkBrush(accent)


def _put(line: pg.InfiniteLine, at: float | None) -> None:
    """Show a line at a position; None: hide it."""
    line.setVisible(at is not None)
    if at is not None:
        line.setValue(at)


def _index_of(curve: Curve, key: int | None) -> int | None:
    if key is None or not len(curve.key):
        return None
    index = int(np.searchsorted(curve.key, key))
    return index if index < len(curve.key) and curve.key[index] == key else None


def _joined(texts: Sequence[str]) -> str:
    """Texts of the points of one frame, joined so that their position appears only once."""
    if not texts:
        return ""
    where = texts[0].partition(": ")[0]
    return f"{where}: " + ";  ".join(words.partition(": ")[2] for words in texts)
