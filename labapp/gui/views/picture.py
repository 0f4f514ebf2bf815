"""View of a picture with overlays of pages: zoom, pan, contrast, read-out, points to drag.

Positions are (u, v) in px: u right, v down, the centre of the first pixel at (0, 0).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import pyqtgraph as pg
from PySide6.QtCore import QEvent, QPoint, QPointF, QRectF, Qt, Signal
from PySide6.QtGui import (
    QAction,
    QContextMenuEvent,
    QFocusEvent,
    QGuiApplication,
    QImage,
    QKeyEvent,
    QPalette,
)
from PySide6.QtWidgets import (
    QGraphicsItem,
    QGridLayout,
    QHBoxLayout,
    QMenu,
    QSizePolicy,
    QSlider,
    QToolButton,
    QVBoxLayout,
)

from labapp.core.values import BoolArray
from labapp.gui.views.canvas import Drawn
from labapp.gui.views.drag_point import ALT, CONTROL, SHIFT, DragPoint, arrow_step
from labapp.gui.views.picture_files import save_picture
from labapp.gui.widgets.labels import plain_label, show_words, wrapping_label
from labapp.media import GreyImage

pg.setConfigOptions(imageAxisOrder="row-major", antialias=True)

ZOOM_STEP = 1.25
MOST_ZOOM_PX = 4.0
"""Smallest number of pixels across the view."""

DARKEST, BRIGHTEST = 1.0, 99.7
"""Percentiles of the grey levels that are drawn black and white."""

CONTRAST_STEPS = 25
"""Number of steps of the contrast slider that halve or double the range of levels."""

RING, RING_PX = "#2fd39b", 15
"""Rings around dots: a colour of the dots page; diameter in points of the screen."""

KEYS = (
    "Zoom with the wheel, + and −; F fits; drag with the middle button, or Shift and arrow keys, "
    "to move; [ and ] change the contrast"
)


class Tool:
    """Actions of the mouse in a picture; this base class does nothing, so that drags pan."""

    def click(self, u: float, v: float, modifiers: Qt.KeyboardModifier) -> None:
        """Handle a click with the left button at (u, v)."""

    def point_out(self, u: float, v: float) -> None:
        """Handle a click with the right button: select the object there for the menu."""

    def double_click(self, u: float, v: float) -> None:
        """Handle a double click with the left button."""

    def begin(self, u: float, v: float, modifiers: Qt.KeyboardModifier) -> bool:
        """Begin a drag at (u, v); return False to leave it to the picture."""
        return False

    def drag(self, u: float, v: float) -> None:
        """Continue the drag."""

    def end(self, u: float, v: float) -> None:
        """End the drag."""

    def takes(self, event: QKeyEvent) -> bool:
        """Whether the tool handles a key; others go to the picture and to the window."""
        return False

    def key(self, event: QKeyEvent) -> None:
        """Handle a key of the tool; called repeatedly while it is held down."""

    def release(self) -> None:
        """Handle the release of the key, or the loss of the focus."""


class PictureView(Drawn):
    """A grey picture with overlays: pyqtgraph items in px, see `add`."""

    pointed = Signal(float, float, object)
    """Position of the pointer and the grey level there: u, v, level (None outside the picture)."""
    changed = Signal()
    """Another picture is shown, or none."""

    def __init__(self, name: str = "Picture") -> None:
        super().__init__(name, KEYS)
        self.tool = Tool()
        """What the left button does."""
        self.points: list[DragPoint] = []
        """Points that can be dragged."""
        self.menu_actions: Sequence[QAction] = ()
        """Actions of the page for the object clicked, listed above the view's actions."""
        self.picture: GreyImage | None = None
        """The displayed picture."""
        self._levels = (0.0, 1.0)
        self._fits = True
        self._region: QRectF | None = None
        self._current: DragPoint | None = None
        self.canvas = pg.GraphicsView()
        self.canvas.setFocusPolicy(Qt.FocusPolicy.NoFocus)
        self.canvas.setSizePolicy(QSizePolicy.Policy.Expanding, QSizePolicy.Policy.Expanding)
        self.canvas.setMinimumSize(160, 120)
        self.box = _Box(self)
        self.canvas.setCentralItem(self.box)
        self._item = pg.ImageItem()
        self._item.setZValue(-100)
        self.box.addItem(self._item)
        # On the picture: below it there is no room in a narrow view.
        self._place = plain_label("", self.canvas)
        self._place.setAutoFillBackground(True)
        self._place.setAttribute(Qt.WidgetAttribute.WA_TransparentForMouseEvents)
        self._place.hide()
        self._empty = wrapping_label("", self.canvas)
        self._empty.setAlignment(Qt.AlignmentFlag.AlignCenter)
        # It covers the canvas, which must get the mouse events.
        self._empty.setAttribute(Qt.WidgetAttribute.WA_TransparentForMouseEvents)
        layout = QVBoxLayout(self)
        layout.setContentsMargins(1, 1, 1, 1)
        layout.setSpacing(0)
        over = QGridLayout(self.canvas)
        over.addWidget(self._empty)
        layout.addWidget(self.canvas, 1)
        layout.addLayout(self._bar())
        self.canvas.scene().sigMouseMoved.connect(self._moved)
        self.box.sigRangeChangedManually.connect(lambda *_: self._stop_fitting())
        self.box.sigResized.connect(lambda *_: self._refit())
        self.follow_theme()

    # --- the picture --------------------------------------------------------------------------

    def show_picture(self, grey: GreyImage | None, why_not: str = "") -> None:
        """Show a picture, shape (rows, columns), or the reason why there is none.

        Zoom is kept if the size is the same; contrast is kept if also the brightness is similar.
        """
        former, self.picture = self.picture, grey
        self.changed.emit()
        self._empty.setText(why_not if grey is None else "")
        self._item.setVisible(grey is not None)
        if grey is None:
            self.describe(why_not)
            return
        same = former is not None and former.shape == grey.shape
        levels = auto_levels(grey)
        if not (same and _alike(levels, self._levels)):
            self._levels = levels
        self._item.setImage(grey, autoLevels=False, levels=self._shown_levels())
        rows, columns = grey.shape
        self.describe(f"{columns} by {rows} px")
        self._item.setRect(QRectF(-0.5, -0.5, columns, rows))
        if not same:
            side = max(rows, columns)  # the whole picture also fits into a narrow view
            u, v = columns + side, rows + side
            self.box.setLimits(xMin=-side, xMax=u, yMin=-side, yMax=v, minXRange=MOST_ZOOM_PX)
            self.fit()

    def add(self, item: QGraphicsItem) -> None:
        """Add an overlay."""
        self.box.addItem(item, ignoreBounds=True)

    def remove(self, item: QGraphicsItem) -> None:
        """Remove an overlay."""
        self.box.removeItem(item)

    def add_point(self, point: DragPoint) -> None:
        """Add a point that can be dragged."""
        self.add(point)
        self.points.append(point)
        point.moved.connect(lambda *_: self.choose_point(point))
        self.choose_point(self._current or point)

    def choose_point(self, point: DragPoint) -> None:
        """Select the point that the arrow keys move."""
        self._current = point
        for each in self.points:
            each.show_chosen(each is point)

    def grab_picture(self) -> QImage:
        """The visible picture with its overlays."""
        picture: QImage = self.canvas.grab().toImage()
        return picture

    def show_levels(self) -> None:
        """Show the histogram and line profile in a dialog."""
        from labapp.gui.views.picture_levels import LevelsDialog

        LevelsDialog(self, self).show()

    def open_menu(self, at: QPoint) -> None:
        """Open the menu at a position on the screen."""
        menu = QMenu(self)
        menu.setAttribute(Qt.WidgetAttribute.WA_DeleteOnClose)
        menu.addActions(self.menu_actions)
        menu.addSeparator()
        for words, work in (
            ("Copy picture", lambda: QGuiApplication.clipboard().setImage(self.grab_picture())),
            ("Save picture…", lambda: save_picture(self, self.grab_picture())),
            ("Histogram and line profile…", self.show_levels),
            ("Fit", self.fit),
        ):
            menu.addAction(words).triggered.connect(lambda *_, do=work: do())
        menu.popup(at)

    def contextMenuEvent(self, event: QContextMenuEvent) -> None:
        """Open the menu by its key; for the mouse the canvas distinguishes clicks and drags."""
        if event.reason() == QContextMenuEvent.Reason.Keyboard:
            self.open_menu(self.mapToGlobal(self.rect().center()))

    # --- zoom and contrast --------------------------------------------------------------------

    def fit(self) -> None:
        """Fit the picture into the view, now and whenever the view is resized."""
        self._fits, self._region = True, None
        self._refit()

    def show_region(self, low: tuple[float, float], high: tuple[float, float]) -> None:
        """Fit the region between two corners (u, v), px, into the view, with a margin."""
        (u, v), (right, down) = low, high
        self._fits, self._region = True, QRectF(u, v, right - u, down - v)
        self._refit()

    def zoom(self, factor: float) -> None:
        """Zoom about the centre; a factor above 1 enlarges."""
        self._stop_fitting()
        self.box.scaleBy((1 / factor, 1 / factor))

    def pan(self, right: float, down: float) -> None:
        """Move the visible region by fractions of its size."""
        self._stop_fitting()
        seen = self.box.viewRect()
        self.box.translateBy(x=right * seen.width(), y=down * seen.height())

    def _stop_fitting(self) -> None:
        """Stop fitting after the operator zoomed or moved the picture."""
        self._fits = False

    def _refit(self) -> None:
        if not self._fits or self.picture is None:
            return
        rows, columns = self.picture.shape
        if self._region is None:
            self.box.setRange(QRectF(-0.5, -0.5, columns, rows), padding=0.01)
        else:
            self.box.setRange(self._region, padding=0.12)

    @property
    def px_per_point(self) -> float:
        """Number of picture px per point of the screen."""
        return float(abs(self.box.viewPixelSize()[0]))

    def auto_contrast(self) -> None:
        """Adjust the levels of black and white to the picture."""
        if self.picture is not None:
            self._levels = auto_levels(self.picture)
        self._contrast.setValue(0)
        self._item.setLevels(self._shown_levels())

    def _shown_levels(self) -> tuple[float, float]:
        black, white = self._levels
        return black, black + (white - black) * 2 ** (-self._contrast.value() / CONTRAST_STEPS)

    # --- within -------------------------------------------------------------------------------

    def _bar(self) -> QHBoxLayout:
        bar = QHBoxLayout()
        bar.setContentsMargins(6, 2, 6, 2)
        bar.setSpacing(4)

        def button(text: str, name: str, tip: str, do: Callable[[], object]) -> None:
            one = QToolButton()
            one.setText(text)
            one.setAccessibleName(name)
            one.setToolTip(tip)
            one.setAutoRaise(True)
            one.clicked.connect(lambda _: do())
            bar.addWidget(one)

        button("Fit", "Fit picture", "Fit the picture (F)", self.fit)
        button("−", "Zoom out", "Zoom out (−)", lambda: self.zoom(1 / ZOOM_STEP))
        button("+", "Zoom in", "Zoom in (+)", lambda: self.zoom(ZOOM_STEP))
        bar.addSpacing(8)
        label = plain_label("Contrast")
        bar.addWidget(label)
        self._contrast = QSlider(Qt.Orientation.Horizontal)
        self._contrast.setRange(-3 * CONTRAST_STEPS, 5 * CONTRAST_STEPS)
        self._contrast.setFixedWidth(72)
        self._contrast.setAccessibleName("Contrast")
        self._contrast.setToolTip("Makes faint dots brighter, or bright ones darker ([ and ])")
        self._contrast.valueChanged.connect(lambda _: self._item.setLevels(self._shown_levels()))
        label.setBuddy(self._contrast)
        bar.addWidget(self._contrast)
        button("Auto", "Automatic contrast", "Fit contrast to the picture (0)", self.auto_contrast)
        bar.addStretch(1)
        return bar

    def _moved(self, at: QPointF) -> None:
        place = self.box.mapSceneToView(at)
        u, v = float(place.x()), float(place.y())
        level = level_at(self.picture, u, v)
        words = "" if level is None else f"u {u:.1f}, v {v:.1f} px, level {level:g}"
        show_words(self._place, words)
        self._place.adjustSize()
        room = self.canvas.height() - self._place.height()
        self._place.move(0, 0 if at.y() > self.canvas.height() / 2 else room)
        self.pointed.emit(u, v, level)

    def take_colours(self) -> None:
        """Use a darker shade of the window's background."""
        self.canvas.setBackground(self.palette().color(QPalette.ColorRole.Window).darker(120))

    def event(self, event: QEvent) -> bool:
        """Let the tool or a point handle its keys before the window's shortcuts."""
        if event.type() == QEvent.Type.ShortcutOverride:
            assert isinstance(event, QKeyEvent)
            if self.tool.takes(event) or self._step(event) is not None:
                event.accept()
                return True
        return super().event(event)

    def keyPressEvent(self, event: QKeyEvent) -> None:
        """Handle a key by the tool, by the selected point, or as zoom or contrast."""
        step, key = self._step(event), event.key()
        simple: dict[int, Callable[[], object]] = {
            Qt.Key.Key_Plus: lambda: self.zoom(ZOOM_STEP),
            Qt.Key.Key_Equal: lambda: self.zoom(ZOOM_STEP),
            Qt.Key.Key_Minus: lambda: self.zoom(1 / ZOOM_STEP),
            Qt.Key.Key_F: self.fit,
            Qt.Key.Key_0: self.auto_contrast,
            Qt.Key.Key_BracketLeft: lambda: self._contrast.setValue(self._contrast.value() - 5),
            Qt.Key.Key_BracketRight: lambda: self._contrast.setValue(self._contrast.value() + 5),
            Qt.Key.Key_P: self._next_point,
        }
        if self.tool.takes(event):
            self.tool.key(event)
        elif step is not None:
            if self._current is None:
                self.pan(0.1 * step[0], 0.1 * step[1])
            else:
                self._current.nudge(*step)
        elif key in simple and not event.modifiers() & (CONTROL | ALT):
            simple[key]()
        else:
            super().keyPressEvent(event)

    def keyReleaseEvent(self, event: QKeyEvent) -> None:
        """Notify the tool and the selected point."""
        if not event.isAutoRepeat():
            self._release()
        super().keyReleaseEvent(event)

    def focusOutEvent(self, event: QFocusEvent) -> None:
        """Notify the tool and the selected point: the key may be released elsewhere."""
        self._release()
        super().focusOutEvent(event)

    def _release(self) -> None:
        self.tool.release()
        if self._current is not None:
            self._current.release()

    def _step(self, event: QKeyEvent) -> tuple[float, float] | None:
        """Step of an arrow key, px; without a selected point only with Shift, which pans."""
        if self._current is None and not event.modifiers() & SHIFT:
            return None
        return arrow_step(event)

    def _next_point(self) -> None:
        if self.points:
            place = -1 if self._current is None else self.points.index(self._current)
            self.choose_point(self.points[(place + 1) % len(self.points)])


class _Box(pg.ViewBox):  # type: ignore[misc]
    """View box with coordinates in px; mouse events go to the tool first, then to the picture."""

    def __init__(self, view: PictureView) -> None:
        super().__init__(lockAspect=True, invertY=True, enableMenu=False, defaultPadding=0)
        self._view = view
        self._tool_drags = False

    def mouseClickEvent(self, event: Any) -> None:
        right = event.button() == Qt.MouseButton.RightButton
        if not right and event.button() != Qt.MouseButton.LeftButton:
            return
        event.accept()
        self._view.setFocus(Qt.FocusReason.MouseFocusReason)
        place = self.mapSceneToView(event.scenePos())
        if right:
            if self._view.menu_actions:
                self._view.tool.point_out(place.x(), place.y())
            self._view.open_menu(event.screenPos().toPoint())
        elif event.double():
            self._view.tool.double_click(place.x(), place.y())
        else:
            self._view.tool.click(place.x(), place.y(), event.modifiers())

    def mouseDragEvent(self, event: Any, axis: int | None = None) -> None:
        tool = self._view.tool
        if event.isStart():
            self._view.setFocus(Qt.FocusReason.MouseFocusReason)
            start = self.mapSceneToView(event.buttonDownScenePos())
            left = event.button() == Qt.MouseButton.LeftButton
            self._tool_drags = left and tool.begin(start.x(), start.y(), event.modifiers())
        event.accept()
        if self._tool_drags:
            place = self.mapSceneToView(event.scenePos())
            (tool.end if event.isFinish() else tool.drag)(place.x(), place.y())
            self._tool_drags = not event.isFinish()
            return
        there, before = (self.mapSceneToView(p) for p in (event.scenePos(), event.lastScenePos()))
        self.translateBy(x=before.x() - there.x(), y=before.y() - there.y())
        self.sigRangeChangedManually.emit(self.state["mouseEnabled"])


def rings() -> pg.ScatterPlotItem:
    """Rings around dots, without dots yet."""
    return pg.ScatterPlotItem(size=RING_PX, pxMode=True, pen=pg.mkPen(RING, width=1.2), brush=None)


def auto_levels(grey: GreyImage) -> tuple[float, float]:
    """Levels to draw black and white: percentiles of a subset of the pixels."""
    thin = max(1, min(grey.shape) // 256)
    part = grey[::thin, ::thin]
    finite: BoolArray = np.isfinite(part)
    if not finite.any():
        return 0.0, 1.0
    black, white = np.percentile(part[finite], (DARKEST, BRIGHTEST))
    return float(black), float(max(white, black + 1e-9 + 1e-6 * abs(black)))


def level_at(grey: GreyImage | None, u: float, v: float) -> float | None:
    """Level of the pixel at (u, v); None outside the picture."""
    if grey is None or not (np.isfinite(u) and np.isfinite(v)):
        return None
    row, column = round(v), round(u)
    rows, columns = grey.shape
    return float(grey[row, column]) if 0 <= row < rows and 0 <= column < columns else None


def _alike(one: tuple[float, float], other: tuple[float, float]) -> bool:
    """Whether two ranges of levels are so similar that keeping one avoids flicker in a film."""
    span = max(one[1] - one[0], other[1] - other[0])
    return max(abs(one[0] - other[0]), abs(one[1] - other[1])) < 0.3 * span
