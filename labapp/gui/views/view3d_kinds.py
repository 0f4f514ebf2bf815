"""Kinds of 3-D views: drawn with the window's OpenGL, or off-screen.

If Qt has no OpenGL for VTK (no display, or Wayland), the scene is drawn off-screen and shown as a
picture. The same applies to rendering without a graphics card: a window that contains OpenGL is
composed as a whole for every picture, which takes longer than drawing the scene. If drawing is
impossible, a text says so.
"""

from __future__ import annotations

import functools
from typing import Any

from PySide6.QtCore import QEvent, QObject, Qt, QTimer
from PySide6.QtGui import (
    QGuiApplication,
    QImage,
    QMouseEvent,
    QOffscreenSurface,
    QOpenGLContext,
    QPainter,
    QPaintEvent,
    QPalette,
    QResizeEvent,
    QShowEvent,
    QWheelEvent,
)
from PySide6.QtWidgets import QVBoxLayout, QWidget

from labapp.export.rendering.axes import USUAL_DPI
from labapp.export.rendering.drawing import can_draw
from labapp.gui.views.view3d import NOTHING_HERE, ZOOM, View3d, as_image

GL_RENDERER = 0x1F01

SHARED = ("xcb", "windows", "cocoa")
"""Qt platforms on which VTK can use Qt's OpenGL."""

ON_THE_PROCESSOR = (
    *("llvmpipe", "softpipe", "software", "swiftshader", "swrast"),
    *("gdi generic", "basic render"),
)
"""Parts of the names of OpenGL renderers that use no graphics card."""


class OffscreenView(View3d):
    """Draws the scene off-screen when it is painted, and shows the picture."""

    def __init__(self, name: str = "3-D view") -> None:
        super().__init__(name)
        self._picture: QImage | None = None
        self._pointed_at = ""

    def _new_plotter(self) -> Any:
        # Not `pyvista.Plotter`, which may be incomplete while another thread imports it.
        from pyvista.plotting import Plotter

        plotter: Any = Plotter(off_screen=True, window_size=list(self._pixels()))
        plotter.render_window.SetDPI(round(USUAL_DPI * self.devicePixelRatioF()))
        plotter.disable_anti_aliasing()
        plotter.render_window.SetMultiSamples(0)
        return plotter

    def _refresh(self) -> None:
        self._picture = None
        self.update()

    def _render(self) -> None:
        picture = None
        if self._draw():
            assert self._drawing is not None
            if tuple(self._drawing.plotter.window_size) != self._pixels():
                self._drawing.plotter.window_size = list(self._pixels())
            self._refit()
            picture = self.picture()
        self._picture = None if picture is None else as_image(picture)
        if self._picture is not None:
            self._picture.setDevicePixelRatio(self.devicePixelRatioF())

    def resizeEvent(self, event: QResizeEvent) -> None:
        """Redraw at the new size."""
        super().resizeEvent(event)
        self._refresh()

    def paintEvent(self, event: QPaintEvent) -> None:
        """Show the scene, or say why there is none."""
        if self._picture is None and self.scene is not None:
            self._render()
        with QPainter(self) as painter:
            painter.fillRect(self.rect(), self.palette().color(QPalette.ColorRole.Base))
            if self._picture is not None:
                painter.drawImage(0, 0, self._picture)
                self._paint_pointed(painter)
            else:
                self._paint_words(painter, self._words if self.scene is None else NOTHING_HERE)
            if self.hasFocus():
                self.paint_frame(painter)

    def wheelEvent(self, event: QWheelEvent) -> None:
        """Zoom."""
        self.zoom(ZOOM ** (event.angleDelta().y() / 120))

    def _show_pointed(self, words: str) -> None:
        super()._show_pointed(words)
        if words != self._pointed_at:
            self._pointed_at = words
            self.update()

    def _paint_pointed(self, painter: QPainter) -> None:
        painter.setPen(self.palette().color(QPalette.ColorRole.Text))
        area = self.rect().adjusted(6, 6, -6, -6)
        corner = Qt.AlignmentFlag.AlignBottom | Qt.AlignmentFlag.AlignLeft
        painter.drawText(area, corner, self._pointed_at)


class InteractiveView(View3d):
    """Contains a `pyvistaqt.QtInteractor`, created when the view is first shown."""

    def __init__(self, name: str = "3-D view") -> None:
        super().__init__(name)
        self._layout = QVBoxLayout(self)
        self._layout.setContentsMargins(1, 1, 1, 1)
        self._late = QTimer(self, singleShot=True, interval=0)
        self._late.timeout.connect(self._render)

    def _new_plotter(self) -> Any:
        from pyvistaqt import QtInteractor

        plotter: Any = QtInteractor(
            self, auto_update=False, multi_samples=1, line_smoothing=False, point_smoothing=False
        )
        # This view handles the keys: with VTK's bindings q would end the program.
        plotter.setFocusPolicy(Qt.FocusPolicy.NoFocus)
        plotter.render_window.SetDPI(round(USUAL_DPI * self.devicePixelRatioF()))
        plotter.disable_anti_aliasing()
        for event in ("InteractionEvent", "EndInteractionEvent", "MouseWheelForwardEvent"):
            plotter.iren.add_observer(event, self._interacted)
        plotter.iren.add_observer("MouseWheelBackwardEvent", self._interacted)
        self._layout.addWidget(plotter)
        plotter.setMouseTracking(True)
        plotter.installEventFilter(self)
        plotter.show()
        return plotter

    def eventFilter(self, watched: QObject, event: QEvent) -> bool:
        """Read off points and open the menu; VTK itself turns, moves and zooms."""
        if event.type() == QEvent.Type.Resize:
            self._refresh()  # when it has its new size
        if isinstance(event, QMouseEvent) and self._drawing is not None:
            if event.type() == QEvent.Type.MouseButtonPress:
                self._pressed = event.position()
                self.setFocus(Qt.FocusReason.MouseFocusReason)
            elif event.type() == QEvent.Type.MouseButtonRelease:
                self.mouseReleaseEvent(event)
            elif event.type() == QEvent.Type.MouseMove and not event.buttons():
                self.mouseMoveEvent(event)
        return super().eventFilter(watched, event)

    def _show_pointed(self, words: str) -> None:
        super()._show_pointed(words)
        if self._drawing is not None and self._drawing.show_pointed(words):
            QWidget.update(self._drawing.plotter)

    def _interacted(self, *_: object) -> None:
        self._fits = False
        self.camera_changed.emit(self.camera)

    def _refresh(self) -> None:
        # Several changes during one event need only one picture.
        self._late.start()

    def _render(self) -> None:
        if not self.isVisible():
            return
        if self._draw():
            assert self._drawing is not None
            self._drawing.plotter.setVisible(True)
            self._refit()
            QWidget.update(self._drawing.plotter)  # which renders once
        elif self._drawing is not None:
            self._drawing.plotter.setVisible(False)

    def showEvent(self, event: QShowEvent) -> None:
        """Draw the current scene."""
        super().showEvent(event)
        self._refresh()

    def paintEvent(self, event: QPaintEvent) -> None:
        """Show the scene, or say why there is none."""
        with QPainter(self) as painter:
            painter.fillRect(self.rect(), self.palette().color(QPalette.ColorRole.Base))
            if self.scene is None:
                self._paint_words(painter, self._words)
            elif not can_draw():
                self._paint_words(painter, NOTHING_HERE)
            if self.hasFocus():
                self.paint_frame(painter)

    def close_view(self) -> None:
        """Release OpenGL until the view is next shown."""
        self._late.stop()
        super().close_view()


def make_view3d(name: str = "3-D view") -> View3d:
    """View with the window's OpenGL if a graphics card draws for Qt and VTK, else off-screen."""
    if QGuiApplication.platformName() in SHARED and has_card(_renderer()):
        return InteractiveView(name)
    return OffscreenView(name)


def has_card(renderer: str) -> bool:
    """Whether the OpenGL renderer of this name (empty: none) is a graphics card."""
    return bool(renderer) and not any(part in renderer.lower() for part in ON_THE_PROCESSOR)


@functools.cache
def _renderer() -> str:
    """Name of Qt's OpenGL renderer; empty if there is none."""
    context, surface = QOpenGLContext(), QOffscreenSurface()
    surface.create()
    if not (context.create() and context.makeCurrent(surface)):
        return ""
    name = context.functions().glGetString(GL_RENDERER)
    context.doneCurrent()
    return str(name or "")
