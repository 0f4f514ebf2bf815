from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from PySide6.QtCore import QEvent, QPoint, QPointF, Qt
from PySide6.QtGui import QColor, QMouseEvent, QPalette, QWheelEvent
from PySide6.QtTest import QTest
from PySide6.QtWidgets import QApplication, QMenu
from pytestqt.qtbot import QtBot

from labapp.export.rendering.scene import Scene
from labapp.gui.views import view3d, view3d_kinds
from labapp.gui.views.view3d import NOTHING_HERE, View3d
from labapp.gui.views.view3d_kinds import OffscreenView, make_view3d
from tests.gui.conftest import KEPT
from tests.screen import screen
from tests.waiting import PATIENCE_S

pytestmark = pytest.mark.usefixtures("opengl")


def hill(height_mm: float = 0.3) -> Scene:
    x, y = (grid.ravel() for grid in np.meshgrid(np.arange(-3.0, 4.0), np.arange(-3.0, 4.0)))
    z = height_mm * (1 - (x**2 + y**2) / 18)
    a = (np.arange(6)[:, None] * 7 + np.arange(6)).ravel()
    triangles = np.vstack([np.column_stack([a, a + 1, a + 8]), np.column_stack([a, a + 8, a + 7])])
    return Scene(np.column_stack([x, y, z]), triangles, z, "height (mm)", (0.0, height_mm))


@pytest.fixture
def view(qtbot: QtBot) -> View3d:
    view3d_widget = make_view3d("A hill")
    KEPT.append(view3d_widget)
    view3d_widget.resize(320, 240)
    view3d_widget.show()
    view3d_widget.show_scene(hill())
    view3d_widget.grab()  # which paints it
    yield view3d_widget
    view3d_widget.close_view()
    view3d_widget.close()


def colours(view: View3d) -> int:
    """Number of visible colours: a surface has many, text has few."""
    image = view.grab().toImage()
    return len({image.pixel(x, y) for x in range(0, 320, 4) for y in range(0, 240, 4)})


def test_view_draws_off_screen_without_a_display(view: View3d) -> None:
    assert isinstance(view, OffscreenView)
    assert colours(view) > 60


def test_hidden_view_draws_nothing(qtbot: QtBot) -> None:
    hidden = make_view3d()
    KEPT.append(hidden)
    hidden.show_scene(hill())
    assert hidden.camera is None
    assert hidden.image() is None


def test_mouse_turns_moves_and_zooms_the_view(view: View3d, qtbot: QtBot) -> None:
    def distance() -> float:
        return float(np.linalg.norm(np.subtract(view.camera[0], view.camera[1])))

    first, far = view.camera, distance()
    centre = QPoint(160, 120)
    with qtbot.waitSignal(view.camera_changed):
        drag(view, centre, centre + QPoint(50, 0))
    turned = view.camera
    assert turned[0] != first[0]
    assert turned[1] == first[1]
    assert distance() == pytest.approx(far)
    drag(view, centre, centre + QPoint(30, 10), Qt.KeyboardModifier.ShiftModifier)
    moved = view.camera
    np.testing.assert_allclose(
        np.subtract(moved[0], turned[0]), np.subtract(moved[1], turned[1]), atol=1e-9
    )
    assert np.linalg.norm(np.subtract(moved[1], turned[1])) > 0.1
    before = view.grab().toImage()
    wheel = QWheelEvent(
        *(QPointF(centre), QPointF(centre), QPoint(), QPoint(0, 120)),
        *(Qt.MouseButton.NoButton, Qt.KeyboardModifier.NoModifier),
        *(Qt.ScrollPhase.NoScrollPhase, False),
    )
    QApplication.sendEvent(view, wheel)
    assert view.grab().toImage() != before


def drag(
    view: View3d,
    start: QPoint,
    end: QPoint,
    keys: Qt.KeyboardModifier = Qt.KeyboardModifier.NoModifier,
) -> None:
    left, none = Qt.MouseButton.LeftButton, Qt.MouseButton.NoButton
    for kind, at, button, buttons in (
        (QEvent.Type.MouseButtonPress, start, left, left),
        (QEvent.Type.MouseMove, end, none, left),
        (QEvent.Type.MouseButtonRelease, end, left, none),
    ):
        event = QMouseEvent(kind, QPointF(at), QPointF(at), button, buttons, keys)
        QApplication.sendEvent(view, event)


def test_right_button_drag_zooms(view: View3d, qtbot: QtBot) -> None:
    before = view.camera
    right, none = Qt.MouseButton.RightButton, Qt.MouseButton.NoButton
    at, end = QPointF(160, 120), QPointF(160, 60)
    for kind, place, button, buttons in (
        (QEvent.Type.MouseButtonPress, at, right, right),
        (QEvent.Type.MouseMove, end, none, right),
        (QEvent.Type.MouseButtonRelease, end, right, none),
    ):
        event = QMouseEvent(kind, place, place, button, buttons, Qt.KeyboardModifier.NoModifier)
        QApplication.sendEvent(view, event)
    assert view.camera[3] < before[3]  # a narrower angle of view
    assert not view.findChildren(QMenu)  # a click opens it


def click(view: View3d, at: QPoint, button: Qt.MouseButton = Qt.MouseButton.LeftButton) -> None:
    QTest.mouseClick(view, button, pos=at)


def test_click_reads_a_point(view: View3d, qtbot: QtBot) -> None:
    view.sigma_at = lambda x, y: 0.0021
    view.look("top")
    view.grab()
    at = view._drawing.overlay.project(np.array([[1.0, -0.5, 0.0]]))[0]
    centre = view._drawing.overlay.project(np.zeros((1, 3)))[0]
    assert np.hypot(*(at - centre)) > 10
    click(view, QPoint(round(at[0]), round(view.height() - at[1])))
    (x, y, z), words = view.scene.mark_mm[0], view.read_off
    assert (x, y) == (pytest.approx(1.0, abs=0.05), pytest.approx(-0.5, abs=0.05))
    assert z == pytest.approx(0.3 * (1 - (x**2 + y**2) / 18), abs=0.02)  # the triangles are flat
    assert words == f"X {x:.3f}, Y {y:.3f}, Z {z:.4f} ± 0.0021 mm".replace("-", "−")
    QTest.keyClick(view, Qt.Key.Key_P)
    assert QApplication.clipboard().text() == words
    view.grab()
    assert words.replace(", Z", ",\nZ") in view._drawing.overlay.words
    view.show_scene(hill(0.15))  # another frame, at the same place
    assert view.scene.mark_mm[0] == pytest.approx([x, y, z / 2], abs=1e-6)
    QTest.keyClick(view, Qt.Key.Key_Escape)
    assert view.read_off == ""
    assert len(view.scene.mark_mm) == 0


def test_pointer_reports_the_point_below_it(view: View3d, qtbot: QtBot) -> None:
    texts: list[str] = []
    view.pointed.connect(texts.append)
    view.look("top")
    view.grab()
    centre = view._drawing.overlay.project(np.zeros((1, 3)))[0]
    QTest.mouseMove(view, QPoint(round(centre[0]), round(view.height() - centre[1])))
    QTest.mouseMove(view, QPoint(2, 2))
    assert texts[-2].endswith("mm")
    assert float(texts[-2].split("Z ")[1].split()[0]) == pytest.approx(0.3, abs=0.01)
    assert texts[-1] == ""


def test_right_click_opens_the_menu(view: View3d, qtbot: QtBot) -> None:
    click(view, QPoint(160, 120), Qt.MouseButton.RightButton)
    (menu,) = view.findChildren(QMenu)
    actions = {action.text(): action for action in menu.actions() if action.text()}
    assert {"Copy picture", "Copy point", "Show all", "Top", "Oblique"} <= set(actions)
    assert not actions["Copy point"].isEnabled()  # no point was read
    actions["Top"].trigger()
    assert view.camera[5]
    menu.close()


def test_f_restores_the_last_chosen_view(view: View3d) -> None:
    QTest.keyClick(view, Qt.Key.Key_2)
    side = view.camera
    view.turn(20, 10)
    view.zoom(2)
    QTest.keyClick(view, Qt.Key.Key_F)
    for now, expected in zip(view.camera, side, strict=True):
        assert now == pytest.approx(expected)


@pytest.mark.parametrize(
    "key",
    [Qt.Key.Key_Left, Qt.Key.Key_Right, Qt.Key.Key_Up, Qt.Key.Key_Down, Qt.Key.Key_Plus],
)
def test_keys_turn_and_zoom_the_view(view: View3d, key: Qt.Key) -> None:
    before = view.grab().toImage()
    QTest.keyClick(view, key)
    assert view.grab().toImage() != before


@pytest.mark.parametrize(
    ("key", "axis", "sign"),
    [(Qt.Key.Key_1, 2, 1), (Qt.Key.Key_2, 0, 1), (Qt.Key.Key_3, 1, -1)],
)
def test_keys_select_top_side_and_front_views(
    view: View3d, key: Qt.Key, axis: int, sign: int
) -> None:
    QTest.keyClick(view, key)
    direction = np.subtract(view.camera[0], view.camera[1])
    assert np.argmax(np.abs(direction)) == axis
    assert direction[axis] * sign > 0
    assert np.abs(np.delete(direction, axis)).max() < 1e-6 * abs(direction[axis])
    assert view.camera[5]  # without perspective


def test_camera_of_another_view_can_be_set(view: View3d, qtbot: QtBot) -> None:
    other = make_view3d("Another")
    KEPT.append(other)
    other.set_camera(view.camera)  # before it is drawn
    other.resize(320, 240)
    other.show()
    other.show_scene(hill())
    other.grab()
    assert other.camera == view.camera
    changes = []
    other.camera_changed.connect(changes.append)
    view.turn(30, 10)
    other.set_camera(view.camera)
    assert other.camera == view.camera
    assert not changes  # two linked views would otherwise update each other forever
    other.close_view()


def test_new_scene_keeps_the_camera(view: View3d) -> None:
    view.turn(30, 10)
    camera, before = view.camera, view.grab().toImage()
    view.show_scene(hill(0.2))
    assert view.grab().toImage() != before
    assert view.camera == camera


def test_resizing_fits_the_scene_unless_the_view_was_changed(view: View3d) -> None:
    small = view.camera
    view.resize(800, 600)
    view.grab()
    assert view.camera[3] < small[3]  # a smaller angle: nearer
    view.zoom(1.5)
    moved = view.camera
    view.resize(320, 240)
    view.grab()
    assert view.camera == moved
    view.fit()
    view.grab()
    assert view.camera[3] == pytest.approx(small[3])


def test_view_follows_the_dark_palette(view: View3d) -> None:
    dark = QPalette()
    dark.setColor(QPalette.ColorRole.Base, QColor("#101418"))
    dark.setColor(QPalette.ColorRole.Text, QColor("#e0e0e0"))
    view.setPalette(dark)
    image = view.grab().toImage()
    assert QColor(image.pixel(20, 200)).lightness() < 40


def test_picture_equals_the_displayed_image(view: View3d) -> None:
    image = view.image()
    assert (image.width(), image.height()) == (320, 240)
    picture = view.picture()
    assert picture is not None
    at = QColor(image.pixel(160, 120))
    assert (at.red(), at.green(), at.blue()) == tuple(picture[120, 160])


def test_text_is_shown_without_a_scene(view: View3d) -> None:
    view.show_scene(None)
    blank = view.grab().toImage()
    view.set_words("Frame 3 is not measured yet.")
    assert view.grab().toImage() != blank
    assert view.accessibleDescription().startswith("Frame 3 is not measured yet. arrow keys turn")
    assert view.image() is None
    view.show_scene(hill())
    assert colours(view) > 60


def test_text_is_shown_if_drawing_is_impossible(
    qtbot: QtBot, monkeypatch: pytest.MonkeyPatch
) -> None:
    painted = []
    monkeypatch.setattr(view3d, "can_draw", lambda: False)
    without = make_view3d()
    KEPT.append(without)
    monkeypatch.setattr(without, "_paint_words", lambda _, words: painted.append(words))
    without.show()
    without.show_scene(hill())
    without.grab()
    assert painted[-1] == NOTHING_HERE
    without.look("top")
    QTest.keyClick(without, Qt.Key.Key_Left)
    assert without.camera is None


def test_closed_view_can_be_used_again(view: View3d) -> None:
    view.look("side")
    camera = view.camera
    view.close_view()
    view.close_view()
    assert view.camera is None
    view.update()
    view.show_scene(hill())
    assert colours(view) > 60
    assert view.camera == camera


@pytest.mark.parametrize(
    ("renderer", "card"),
    [
        ("", False),
        ("llvmpipe (LLVM 15.0.6, 256 bits)", False),
        ("softpipe", False),
        ("GDI Generic", False),
        ("Mesa Intel(R) UHD Graphics 620 (KBL GT2)", True),
        ("NVIDIA GeForce RTX 3060/PCIe/SSE2", True),
        ("ANGLE (Microsoft Basic Render Driver)", False),
    ],
)
def test_interactive_view_needs_a_graphics_card(renderer: str, card: bool) -> None:
    assert view3d_kinds.has_card(renderer) is card


def test_scene_is_rendered_once_per_paint(view: View3d) -> None:
    renders: list[object] = []
    window = view._drawing.plotter.render_window
    window.AddObserver("StartEvent", lambda *_: renders.append(None))
    for height in (0.1, 0.2, 0.3):
        view.show_scene(hill(height))
    assert renders == []
    view.grab()
    view.grab()
    assert len(renders) == 1


REAL = """
import sys
import numpy as np
from PySide6.QtCore import QDeadlineTimer, Qt
from PySide6.QtTest import QTest
from PySide6.QtWidgets import QApplication
from labapp.gui.views.view3d_kinds import InteractiveView, OffscreenView, make_view3d
from tests.gui.conftest import let_draw
from tests.gui.test_view3d import hill
from tests.waiting import PATIENCE_S

def wait(reached):
    until = QDeadlineTimer(round(1000 * PATIENCE_S))
    while not reached():
        assert not until.hasExpired(), "it did not happen"
        let_draw()

app = QApplication([])
made = make_view3d()
assert isinstance(made, OffscreenView), type(made)  # Mesa draws here, on the processor
view, told = InteractiveView(), []
view.resize(400, 300)
view.camera_changed.connect(told.append)
view.show_scene(hill())
assert view.camera is None
view.show()
wait(lambda: view.picture() is not None and view.picture().std() > 20)
picture = view.picture()
camera = view.camera
plotter = view._drawing.plotter
QTest.mousePress(plotter, Qt.MouseButton.LeftButton, pos=view.rect().center())
QTest.mouseMove(plotter, view.rect().center() / 2)
QTest.mouseRelease(plotter, Qt.MouseButton.LeftButton, pos=view.rect().center() / 2)
wait(lambda: view.camera != camera and told)
for key in (Qt.Key.Key_Q, Qt.Key.Key_1, Qt.Key.Key_Left):
    QTest.keyClick(view, key)
wait(lambda: (view.picture() != picture).any())
view.show_scene(None)
let_draw()
view.show_scene(hill(0.1))
wait(lambda: view.picture() is not None and view.picture().std() > 20)
view.close()
assert view.camera is None
view.show()
wait(lambda: view.camera is not None)
view.close()
print("well")
"""


@pytest.mark.xvfb
def test_view_draws_in_the_window_with_a_display() -> None:
    """The interactive view under Xvfb, in a child process: Qt has one platform per process."""
    environment = {**os.environ, "QT_QPA_PLATFORM": "xcb", "LIBGL_ALWAYS_SOFTWARE": "1"}
    environment.pop("VTK_DEFAULT_OPENGL_WINDOW", None)
    with screen(1000, 800) as display:
        process = subprocess.run(
            [sys.executable, "-c", REAL],
            cwd=Path(__file__).parents[2],
            env={**environment, "DISPLAY": display},
            capture_output=True,
            text=True,
            timeout=PATIENCE_S,
            check=False,
        )
    assert (process.returncode, process.stdout.strip()[-4:]) == (0, "well"), process.stderr[-3000:]


def test_painter_ends_although_an_error_keeps_its_frame(
    view: View3d, qtbot: QtBot, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The text renderer stores caught exceptions, whose tracebacks keep the calling frames."""
    errors: list[Exception] = []

    def render(_view: View3d) -> None:
        try:
            raise ValueError
        except ValueError as error:
            errors.append(error)

    monkeypatch.setattr(OffscreenView, "_render", render)
    view.show_scene(hill(0.2))
    qtbot.waitUntil(lambda: bool(errors))
    frame = errors[0].__traceback__.tb_frame.f_back
    assert not frame.f_locals["painter"].isActive()
