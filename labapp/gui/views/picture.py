"""A picture with what pages lay over it: zoom, pan, contrast, places in px, points to drag.

Places are (u, v) in px as everywhere: u right, v down, the first pixel's centre at (0, 0).
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
from labapp.gui.widgets.labels import plain_label, wrapping_label
from labapp.media import GreyImage

pg.setConfigOptions(imageAxisOrder="row-major", antialias=True)

ZOOM_STEP = 1.25
MOST_ZOOM_PX = 4.0
"""No fewer pixels than this fill the view."""

DARKEST, BRIGHTEST = 1.0, 99.7
"""Percentiles of the levels that are drawn black and white."""

CONTRAST_STEPS = 25
"""Number of steps of the contrast slider that halve or double the range of levels."""

KEYS = (
    "Zoom with the wheel, + and −; F fits; drag with the middle button, or Shift and arrow keys, "
    "to move; [ and ] change the contrast"
)


class Tool:
    """What the left button does in a picture; this one leaves all to the picture, which pans."""

    def click(self, u: float, v: float, modifiers: Qt.KeyboardModifier) -> None:
        """The left button was pressed and released at a place."""

    def point_out(self, u: float, v: float) -> None:
        """The right button was clicked: choose what is there, for the menu."""

    def double_click(self, u: float, v: float) -> None:
        """It was pressed twice."""

    def begin(self, u: float, v: float, modifiers: Qt.KeyboardModifier) -> bool:
        """Begin a drag at a place; False leaves it to the picture."""
        return False

    def drag(self, u: float, v: float) -> None:
        """Continue the drag."""

    def end(self, u: float, v: float) -> None:
        """End the drag."""

    def takes(self, event: QKeyEvent) -> bool:
        """Whether a key is the tool's; the others go to the picture and to the window."""
        return False

    def key(self, event: QKeyEvent) -> None:
        """A key that the tool takes was pressed, or repeats while it is held."""

    def release(self) -> None:
        """The key was released, or the picture lost the focus."""


class PictureView(Drawn):
    """A grey picture; overlays are pyqtgraph items that `add` puts over it, in px."""

    pointed = Signal(float, float, object)
    """Where the pointer is and the level there: u, v, level (None outside the picture)."""
    changed = Signal()
    """Another picture is shown, or none."""

    def __init__(self, name: str = "Picture") -> None:
        super().__init__(name, KEYS)
        self.tool = Tool()
        """What the left button does."""
        self.points: list[DragPoint] = []
        """The points to drag."""
        self.menu_actions: Sequence[QAction] = ()
        """What the page does with what is right-clicked, above the view's own actions."""
        self._image: GreyImage | None = None
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
        self._place = plain_label()
        # Or the window would grow as the pointer comes.
        self._place.setSizePolicy(QSizePolicy.Policy.Ignored, QSizePolicy.Policy.Preferred)
        self._empty = wrapping_label("", self.canvas)
        self._empty.setAlignment(Qt.AlignmentFlag.AlignCenter)
        # It lies over the whole canvas, which takes the mouse.
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
        """Show a picture, shape (rows, columns), or none and why in words.

        Zoom and contrast stay where the picture is of the same size and about as bright.
        """
        former, self._image = self._image, grey
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
            side = max(rows, columns)  # all of it also fits a narrow view
            u, v = columns + side, rows + side
            self.box.setLimits(xMin=-side, xMax=u, yMin=-side, yMax=v, minXRange=MOST_ZOOM_PX)
            self.fit()

    @property
    def picture(self) -> GreyImage | None:
        """What is shown."""
        return self._image

    def add(self, item: QGraphicsItem) -> None:
        """Put an overlay over the picture."""
        self.box.addItem(item, ignoreBounds=True)

    def remove(self, item: QGraphicsItem) -> None:
        """Take an overlay away."""
        self.box.removeItem(item)

    def add_point(self, point: DragPoint) -> None:
        """Put a point to drag over the picture."""
        self.add(point)
        self.points.append(point)
        point.moved.connect(lambda *_: self.choose_point(point))
        self.choose_point(self._current or point)

    def choose_point(self, point: DragPoint) -> None:
        """Let the arrow keys move a point."""
        self._current = point
        for each in self.points:
            each.show_chosen(each is point)

    def grab_picture(self) -> QImage:
        """Return what is seen, overlays and all."""
        picture: QImage = self.canvas.grab().toImage()
        return picture

    def show_levels(self) -> None:
        """Show histogram and line profile beside the picture."""
        from labapp.gui.views.picture_levels import LevelsDialog

        LevelsDialog(self, self).show()

    def open_menu(self, at: QPoint) -> None:
        """Open the menu at a place of the screen."""
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
        """Open the menu by its key; of the mouse the canvas tells clicks from drags."""
        if event.reason() == QContextMenuEvent.Reason.Keyboard:
            self.open_menu(self.mapToGlobal(self.rect().center()))

    # --- zoom and contrast --------------------------------------------------------------------

    def fit(self) -> None:
        """Fit the picture into the view, also when the view is resized."""
        self._fits, self._region = True, None
        self._refit()

    def show_region(self, low: tuple[float, float], high: tuple[float, float]) -> None:
        """Fit what lies between two places (u, v), px, into the view, with a margin."""
        (u, v), (right, down) = low, high
        self._fits, self._region = True, QRectF(u, v, right - u, down - v)
        self._refit()

    def zoom(self, factor: float) -> None:
        """Zoom about the middle; more than 1 makes it larger."""
        self._stop_fitting()
        self.box.scaleBy((1 / factor, 1 / factor))

    def pan(self, right: float, down: float) -> None:
        """Move what is seen by shares of the view."""
        self._stop_fitting()
        seen = self.box.viewRect()
        self.box.translateBy(x=right * seen.width(), y=down * seen.height())

    def _stop_fitting(self) -> None:
        """Stop fitting: the operator has zoomed or moved."""
        self._fits = False

    def _refit(self) -> None:
        if not self._fits or self._image is None:
            return
        rows, columns = self._image.shape
        if self._region is None:
            self.box.setRange(QRectF(-0.5, -0.5, columns, rows), padding=0.01)
        else:
            self.box.setRange(self._region, padding=0.12)

    @property
    def px_per_point(self) -> float:
        """Picture px that one point of the screen covers."""
        return float(abs(self.box.viewPixelSize()[0]))

    def auto_contrast(self) -> None:
        """Fit black and white to the picture."""
        if self._image is not None:
            self._levels = auto_levels(self._image)
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
        bar.addWidget(self._place, 1)
        return bar

    def _moved(self, at: QPointF) -> None:
        place = self.box.mapSceneToView(at)
        u, v = float(place.x()), float(place.y())
        level = level_at(self._image, u, v)
        self._place.setText("" if level is None else f"u {u:.1f}, v {v:.1f} px, level {level:g}")
        self.pointed.emit(u, v, level)

    def take_colours(self) -> None:
        """Take the ground from the window's."""
        self.canvas.setBackground(self.palette().color(QPalette.ColorRole.Window).darker(120))

    def event(self, event: QEvent) -> bool:
        """Keep keys that the tool or a point takes from the window's shortcuts."""
        if event.type() == QEvent.Type.ShortcutOverride:
            assert isinstance(event, QKeyEvent)
            if self.tool.takes(event) or self._step(event) is not None:
                event.accept()
                return True
        return super().event(event)

    def keyPressEvent(self, event: QKeyEvent) -> None:
        """Give a key to the tool, to the point chosen, or to zoom and contrast."""
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
        """Notify the tool."""
        if not event.isAutoRepeat():
            self.tool.release()
        super().keyReleaseEvent(event)

    def focusOutEvent(self, event: QFocusEvent) -> None:
        """Notify the tool: the key may be released elsewhere."""
        self.tool.release()
        super().focusOutEvent(event)

    def _step(self, event: QKeyEvent) -> tuple[float, float] | None:
        """Where an arrow key leads a point; without points Shift and an arrow lead the view."""
        if self._current is None and not event.modifiers() & SHIFT:
            return None
        return arrow_step(event)

    def _next_point(self) -> None:
        if self.points:
            place = -1 if self._current is None else self.points.index(self._current)
            self.choose_point(self.points[(place + 1) % len(self.points)])


class _Box(pg.ViewBox):  # type: ignore[misc]
    """The view's own coordinates are px; its mouse is the tool's, then the picture's."""

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


def auto_levels(grey: GreyImage) -> tuple[float, float]:
    """Levels to draw black and white, by percentiles of a part of the pixels."""
    thin = max(1, min(grey.shape) // 256)
    part = grey[::thin, ::thin]
    finite: BoolArray = np.isfinite(part)
    if not finite.any():
        return 0.0, 1.0
    black, white = np.percentile(part[finite], (DARKEST, BRIGHTEST))
    return float(black), float(max(white, black + 1e-9 + 1e-6 * abs(black)))


def level_at(grey: GreyImage | None, u: float, v: float) -> float | None:
    """Level of the pixel at a place; None outside the picture."""
    if grey is None or not (np.isfinite(u) and np.isfinite(v)):
        return None
    row, column = round(v), round(u)
    rows, columns = grey.shape
    return float(grey[row, column]) if 0 <= row < rows and 0 <= column < columns else None


def _alike(one: tuple[float, float], other: tuple[float, float]) -> bool:
    """Whether two ranges of levels are near enough for a film not to flicker."""
    span = max(one[1] - one[0], other[1] - other[0])
    return max(abs(one[0] - other[0]), abs(one[1] - other[1])) < 0.3 * span
