"""The 3-D view: a scene that can be turned, with read-out of surface points."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import numpy.typing as npt
from PySide6.QtCore import QEvent, QObject, QPoint, QPointF, Qt, Signal
from PySide6.QtGui import (
    QContextMenuEvent,
    QGuiApplication,
    QImage,
    QKeyEvent,
    QMouseEvent,
    QPainter,
    QPalette,
)
from PySide6.QtWidgets import QMenu

from labapp.core.values import FloatArray
from labapp.export.rendering.axes import view_matrix
from labapp.export.rendering.drawing import Camera, Direction, Drawing, build_scene, can_draw
from labapp.export.rendering.pick import point_over, seen_point
from labapp.export.rendering.scene import Scene
from labapp.gui.views.canvas import Drawn
from labapp.gui.widgets.buttons import add_action

LOOKS: dict[Direction, tuple[str, str]] = {
    "top": ("Top", "Look from the top (1 in the view)"),
    "side": ("Side", "Look from the side, along −X (2 in the view)"),
    "front": ("Front", "Look as the camera does, along Y (3 in the view)"),
    "free": ("Oblique", "Look obliquely from the camera's side (4 in the view)"),
}
"""Text and tooltip of the buttons for the directions of view."""

TURN_DEG = 10.0
"""Rotation by an arrow key."""

ZOOM = 1.15
"""Zoom factor of a step of the wheel, + or −."""

DEGREES_A_PIXEL = 0.4

ZOOM_PX = 12.0
"""Distance of a drag with the right button that zooms by `ZOOM`."""

KEYS: dict[Qt.Key, Direction] = {
    Qt.Key.Key_1: "top",
    Qt.Key.Key_2: "side",
    Qt.Key.Key_3: "front",
    Qt.Key.Key_4: "free",
}

TURNS = {
    Qt.Key.Key_Left: (-TURN_DEG, 0.0),
    Qt.Key.Key_Right: (TURN_DEG, 0.0),
    Qt.Key.Key_Up: (0.0, -TURN_DEG),
    Qt.Key.Key_Down: (0.0, TURN_DEG),
}

KEYS_TOLD = (
    "arrow keys turn, + and − zoom, 1 to 4 look from the top, side, front and obliquely, F shows "
    "all, P copies the point read off; drag to turn, with the middle button or Shift to move, with "
    "the right one or the wheel to zoom; click to read a point off"
)

NOTHING_HERE = "The 3-D view needs OpenGL, which is missing here. All figures are there."


class View3d(Drawn):
    """A scene that can be viewed from all sides; create it with `view3d_kinds.make_view3d`.

    The left button turns it, the middle one, or Shift, moves it, the right one and the wheel zoom.
    A click reads off a point; a click with the right button opens the menu, which also contains
    actions of the page.
    """

    camera_changed = Signal(object)
    """The direction of view changed: its `Camera`."""
    pointed = Signal(str)
    """Text of the surface point at the pointer; empty if there is none."""

    def __init__(self, name: str = "3-D view") -> None:
        super().__init__(name, KEYS_TOLD)
        self.setMinimumSize(160, 120)
        self._words = ""
        self.scene: Scene | None = None
        """The displayed scene."""
        self._drawing: Drawing | None = None
        self._wanted: Camera | Direction | None = None
        self._fits = True
        self._fitted_px: tuple[int, ...] = ()
        """Whether the scene is fitted to the view, and the last size of the view."""
        self._side: Direction = "free"
        self._at = self._pressed = QPointF()
        self._point_mm: tuple[float, float] | None = None
        self.sigma_at: Callable[[float, float], float] | None = None
        """Standard uncertainty of the height at (x, y), mm; None if unknown."""
        self.setMouseTracking(True)
        self._add_actions()
        self.follow_theme()

    def _add_actions(self) -> None:
        for words, key, tip, work in (
            ("Copy picture", "Ctrl+C", "Copy the 3-D picture to the clipboard", self.copy_picture),
            ("Copy point", "P", "Copy X, Y, Z ± of the point that was read off", self.copy_point),
            ("Clear point", "Esc", "Remove the mark of the point", self.forget_point),
            ("Show all", "F", "Bring all into view from the side chosen last", self.fit),
        ):
            add_action(self, words, work, key, tip)

    # --- what is shown -----------------------------------------------------------------------

    def show_scene(self, scene: Scene | None) -> None:
        """Show a scene in the colours of the theme; None: show nothing."""
        if scene is not None:
            palette = self.palette()
            scene = replace(
                scene,
                foreground=palette.color(QPalette.ColorRole.Text).name(),
                background=palette.color(QPalette.ColorRole.Base).name(),
            )
        self.scene = scene
        self._mark()
        self._refresh()

    def set_words(self, words: str) -> None:
        """Set the text that is shown without a scene and describes a scene."""
        self._words = words
        self.describe(words)
        self.update()

    def look(self, direction: Direction) -> None:
        """View the scene from the top, the side, the front, or obliquely (``free``)."""
        self._wanted = self._side = direction
        if self._drawing is not None:
            self._drawing.look(direction)
            self._turned()
        self._fits = True

    def _refit(self) -> None:
        """Fit the scene to a new size of the view, unless the operator moved it."""
        assert self._drawing is not None
        size = tuple(self._drawing.plotter.window_size)
        if self._fits and size != self._fitted_px:
            self._drawing.look(self._side)
        self._fitted_px = size

    def fit(self) -> None:
        """Show the whole scene from the last chosen direction."""
        self.look(self._side)

    @property
    def camera(self) -> Camera | None:
        """Current camera; None before the first drawing."""
        return None if self._drawing is None else self._drawing.camera

    def set_camera(self, camera: Camera) -> None:
        """Use the camera of another view without a signal."""
        self._fits = False
        if self._drawing is None:
            self._wanted = camera
        elif camera != self.camera:
            self._drawing.camera = camera
            self._refresh()

    def picture(self) -> npt.NDArray[np.uint8] | None:
        """The visible picture, shape (height, width, 3), R, G, B; None if there is none."""
        if self._drawing is None or self.scene is None:
            return None
        self._drawing.plotter.render()
        return np.ascontiguousarray(self._drawing.plotter.screenshot(return_img=True))

    def image(self) -> QImage | None:
        """The visible picture for the clipboard or a file."""
        picture = self.picture()
        return None if picture is None else as_image(picture)

    def copy_picture(self) -> None:
        """Copy the visible picture to the clipboard."""
        image = self.image()
        if image is not None:
            QGuiApplication.clipboard().setImage(image)

    def eventFilter(self, watched: QObject, event: QEvent) -> bool:
        """Release OpenGL before the window is destroyed."""
        if event.type() == QEvent.Type.Close:
            self.close_view()
        return super().eventFilter(watched, event)

    # --- points that are read off --------------------------------------------------------------

    def surface_point(self, at: QPointF) -> FloatArray | None:
        """Surface point visible at a position in the view, shape (3,), mm, or None."""
        if self.scene is None or self._drawing is None:
            return None
        across, up = 2 * at.x() / max(self.width(), 1) - 1, 1 - 2 * at.y() / max(self.height(), 1)
        return seen_point(self.scene, view_matrix(self._drawing.plotter.renderer), across, up)

    def point_words(self, point_mm: FloatArray) -> str:
        """Text of a surface point, with the ± of its height if known."""
        x, y, z = point_mm.tolist()
        sigma = np.nan if self.sigma_at is None else self.sigma_at(x, y)
        more = f" ± {sigma:.4f}" if np.isfinite(sigma) else ""
        return f"X {x:.3f}, Y {y:.3f}, Z {z:.4f}{more} mm".replace("-", "−")

    @property
    def read_off(self) -> str:
        """Text of the point that was read off; empty if there is none."""
        return "" if self.scene is None else self.scene.mark_words.replace("\n", " ")

    def read_point(self, at: QPointF) -> None:
        """Read off the point at a position in the view; off the surface, remove the mark."""
        point = self.surface_point(at)
        self._point_mm = None if point is None else (float(point[0]), float(point[1]))
        self._mark()
        self._refresh()

    def forget_point(self) -> None:
        """Remove the mark of the point."""
        self._point_mm = None
        self._mark()
        self._refresh()

    def copy_point(self) -> None:
        """Copy the point that was read off to the clipboard."""
        if self.read_off:
            QGuiApplication.clipboard().setText(self.read_off)

    def _mark(self) -> None:
        """Mark the point that was read off, at the same X and Y on the surface of another frame."""
        scene, words, mark = self.scene, "", np.empty((0, 3))
        if scene is None:
            return
        if self._point_mm is not None:
            hit = point_over(scene, *self._point_mm)
            if hit is not None:
                mark, words = hit[None], self.point_words(hit).replace(", Z", ",\nZ")
        self.scene = replace(scene, mark_mm=mark, mark_words=words)
        self.describe(self.read_off or self._words)

    def close_view(self) -> None:
        """Release OpenGL until the view is next shown."""
        if self._drawing is not None:
            self._wanted = self.camera
            self._drawing.plotter.close()
            self._drawing = None

    # --- drawing -----------------------------------------------------------------------------

    def _new_plotter(self) -> Any:
        """A `pyvista.Plotter` for this view."""
        raise NotImplementedError

    def _refresh(self) -> None:
        """Schedule a redraw."""
        raise NotImplementedError

    def _draw(self) -> bool:
        """Update the drawing to the scene; return False if there is nothing to show."""
        if self.scene is None or not can_draw():
            return False
        if self._drawing is None:
            self.window().installEventFilter(self)
            self._drawing = build_scene(self._new_plotter(), self.scene, steady=True)
            if self._wanted is not None:
                self._drawing.look(self._wanted)
        else:
            self._drawing.update(self.scene)
        return True

    def _pixels(self) -> tuple[int, int]:
        ratio = self.devicePixelRatioF()
        return max(int(self.width() * ratio), 8), max(int(self.height() * ratio), 8)

    # --- turning -----------------------------------------------------------------------------

    def _turned(self) -> None:
        self._fits = False
        self._refresh()
        self.camera_changed.emit(self.camera)

    def turn(self, azimuth_deg: float, elevation_deg: float, roll_deg: float = 0.0) -> None:
        """Turn the scene to the right, down, and anticlockwise."""
        if self._drawing is not None:
            camera = self._drawing.plotter.camera
            camera.Azimuth(-azimuth_deg)
            camera.Elevation(elevation_deg)
            camera.OrthogonalizeViewUp()
            camera.Roll(roll_deg)
            self._drawing.plotter.renderer.ResetCameraClippingRange()
            self._turned()

    def zoom(self, factor: float) -> None:
        """Zoom by a factor; above 1 enlarges."""
        if self._drawing is not None:
            self._drawing.plotter.camera.Zoom(factor)
            self._turned()

    def move_scene(self, way: QPointF) -> None:
        """Move the scene to the right and down, by logical pixels."""
        if self._drawing is None:
            return
        camera = self._drawing.plotter.camera
        ahead = np.subtract(camera.focal_point, camera.position)
        right = np.cross(ahead, camera.up)
        right, up = right / np.linalg.norm(right), np.asarray(camera.up)
        tall = 2 * camera.parallel_scale
        if not camera.parallel_projection:
            tall = 2 * np.linalg.norm(ahead) * np.tan(np.radians(camera.view_angle / 2))
        step = (-way.x() * right + way.y() * up) * tall / max(self.height(), 1)
        camera.position = tuple(np.add(camera.position, step))
        camera.focal_point = tuple(np.add(camera.focal_point, step))
        self._turned()

    def event(self, event: QEvent) -> bool:
        """Handle the view's keys before the window's actions."""
        if event.type() == QEvent.Type.ShortcutOverride:
            assert isinstance(event, QKeyEvent)
            if event.key() in TURNS or event.key() in KEYS:
                event.accept()
        return super().event(event)

    def mousePressEvent(self, event: QMouseEvent) -> None:
        """Begin to turn, move or zoom."""
        self._at = self._pressed = event.position()

    def mouseMoveEvent(self, event: QMouseEvent) -> None:
        """Turn, move or zoom; without a button show the surface point at the pointer."""
        way, self._at = event.position() - self._at, event.position()
        buttons, shift = event.buttons(), event.modifiers() & Qt.KeyboardModifier.ShiftModifier
        if not buttons:
            point = self.surface_point(event.position())
            self._show_pointed("" if point is None else self.point_words(point))
        elif shift or buttons & Qt.MouseButton.MiddleButton:
            self.move_scene(way)
        elif buttons & Qt.MouseButton.LeftButton:
            self.turn(way.x() * DEGREES_A_PIXEL, way.y() * DEGREES_A_PIXEL)
        elif buttons & Qt.MouseButton.RightButton:
            self.zoom(ZOOM ** (-way.y() / ZOOM_PX))

    def mouseReleaseEvent(self, event: QMouseEvent) -> None:
        """Read off a point or open the menu if the mouse was not moved."""
        if not self._is_click(event):
            return
        if event.button() == Qt.MouseButton.LeftButton:
            self.read_point(event.position())
        elif event.button() == Qt.MouseButton.RightButton:
            self.open_menu(event.globalPosition().toPoint())

    def _is_click(self, event: QMouseEvent) -> bool:
        way = event.position() - self._pressed
        return way.manhattanLength() < QGuiApplication.styleHints().startDragDistance()

    def contextMenuEvent(self, event: QContextMenuEvent) -> None:
        """Open the menu by its key; the mouse opens it when its button is released."""
        if event.reason() == QContextMenuEvent.Reason.Keyboard:
            self.open_menu(self.mapToGlobal(self.rect().center()))

    def open_menu(self, at: QPoint) -> None:
        """Open the menu with all actions of the view."""
        menu = QMenu(self)
        menu.setAttribute(Qt.WidgetAttribute.WA_DeleteOnClose)
        menu.setToolTipsVisible(True)
        for action in self.actions():
            if action.text() in ("Copy point", "Clear point"):
                action.setEnabled(bool(self.read_off))
        menu.addActions(self.actions())
        menu.addSeparator()
        for direction, (text, tip) in LOOKS.items():
            menu.addAction(text, partial(self.look, direction)).setToolTip(tip)
        menu.popup(at)

    def _show_pointed(self, words: str) -> None:
        self.pointed.emit(words)

    def leaveEvent(self, event: QEvent) -> None:
        """Hide the text of the point."""
        self._show_pointed("")
        super().leaveEvent(event)

    def keyPressEvent(self, event: QKeyEvent) -> None:
        """Turn, zoom, or view from one of four directions."""
        key = Qt.Key(event.key())
        if key in TURNS:
            self.turn(*TURNS[key])
        elif key in (Qt.Key.Key_Plus, Qt.Key.Key_Equal):
            self.zoom(ZOOM)
        elif key == Qt.Key.Key_Minus:
            self.zoom(1 / ZOOM)
        elif key in KEYS:
            self.look(KEYS[key])
        else:
            super().keyPressEvent(event)

    def take_colours(self) -> None:
        """Draw in the colours of the theme."""
        if self.scene is not None:
            self.show_scene(self.scene)

    def _paint_words(self, painter: QPainter, words: str) -> None:
        painter.setPen(self.palette().color(QPalette.ColorRole.Text))
        area = self.rect().adjusted(24, 24, -24, -24)
        painter.drawText(area, Qt.AlignmentFlag.AlignCenter | Qt.TextFlag.TextWordWrap, words)


def as_image(picture: npt.NDArray[np.uint8]) -> QImage:
    """Convert a picture, shape (height, width, 3), R, G, B, to a QImage; copies the array."""
    height, width, _ = picture.shape
    whole = np.ascontiguousarray(picture)
    return QImage(whole.data, width, height, 3 * width, QImage.Format.Format_RGB888).copy()
