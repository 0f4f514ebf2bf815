"""A 3-D controller turns the surface on the visible page, in the right direction."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from functools import partial

import numpy as np
import pytest
from pytestqt.qtbot import QtBot

from labapp.gui.shell.window import MainWindow
from labapp.gui.views import steering
from labapp.gui.views.steering import steer
from labapp.gui.views.view3d import View3d
from labapp.gui.views.view3d_kinds import make_view3d
from labapp.media.devices import hid
from labapp.media.devices.space_mouse import SixAxes, SpaceMouse
from tests.gui.conftest import KEPT, CopySample
from tests.gui.test_view3d import hill
from tests.media.pedals import AXES, MOUSE_3D, Bench, Device

pytestmark = pytest.mark.usefixtures("opengl")

THREAD = "reader of 3-D controller"


@pytest.fixture
def view(qtbot: QtBot) -> Iterator[View3d]:
    view3d = make_view3d("A hill")
    KEPT.append(view3d)
    view3d.resize(320, 240)
    view3d.show()
    view3d.show_scene(hill())
    view3d.grab()  # which paints it
    yield view3d
    view3d.close_view()
    view3d.close()


def place_px(view: View3d, point_mm: tuple[float, float, float]) -> np.ndarray:
    """The screen position (right, down) of a scene point from the centre, in view heights."""
    position, focus, up, angle_deg, scale, parallel, _ = view.camera
    ahead = np.subtract(focus, position)
    ahead = ahead / np.linalg.norm(ahead)
    right = np.cross(ahead, up)
    right /= np.linalg.norm(right)
    offset = np.subtract(point_mm, position)
    half_height = scale if parallel else offset @ ahead * np.tan(np.radians(angle_deg / 2))
    return np.array([offset @ right, -(offset @ np.cross(right, ahead))]) / (2 * half_height)


def moved_px(view: View3d, axes: SixAxes, point_mm: tuple[float, float, float]) -> np.ndarray:
    before = place_px(view, point_mm)
    steer(view, axes, 0.1)
    return place_px(view, point_mm) - before


FRONT, TOP, RIGHT, CENTRE = (0.0, -3.0, 0.0), (0.0, 0.0, 3.0), (3.0, 0.0, 0.0), (0.0, 0.0, 0.1)
"""Points towards the operator, above, at the right, and in the centre, mm."""


def test_view_follows_the_controller(view: View3d):
    view.look("front")
    before = place_px(view, CENTRE)
    steer(view, SixAxes(pitch=-0.0001, near=0.01), 1.0)  # within the dead zone
    assert place_px(view, CENTRE) == pytest.approx(before)
    right, down = moved_px(view, SixAxes(right=1.0), CENTRE)
    assert right > 0.05
    assert abs(down) < 1e-9
    right, down = moved_px(view, SixAxes(down=1.0), CENTRE)
    assert down > 0.05
    assert abs(right) < 1e-9
    # Turned clockwise, as seen from above, the side towards the operator goes to the left.
    view.look("front")
    assert moved_px(view, SixAxes(yaw=1.0), FRONT)[0] < -0.01
    # Tilted towards the operator, the top comes nearer and the front goes down.
    view.look("front")
    assert moved_px(view, SixAxes(pitch=1.0), FRONT)[1] > 0.01
    # Rolled counterclockwise, the right side goes up.
    view.look("front")
    right, down = moved_px(view, SixAxes(roll=1.0), RIGHT)
    assert down < -0.01
    before = np.linalg.norm(place_px(view, TOP) - place_px(view, CENTRE))
    steer(view, SixAxes(near=1.0), 0.1)
    assert np.linalg.norm(place_px(view, TOP) - place_px(view, CENTRE)) > 1.05 * before


def test_first_button_restores_the_oblique_view(view: View3d):
    view.look("free")
    oblique = view.camera
    for _ in range(20):
        steer(view, SixAxes(yaw=0.7, pitch=0.3, roll=1.0), 0.033)
    assert view.camera != oblique
    steer(view, SixAxes(buttons=frozenset({0})), 0.033)
    for now, then in zip(view.camera[:3], oblique[:3], strict=True):
        assert now == pytest.approx(then)


def test_controller_at_rest_triggers_no_redraw(view: View3d):
    drawn = []
    view.camera_changed.connect(drawn.append)
    steer(view, SixAxes(right=0.03, yaw=-0.03), 0.033)
    assert not drawn


def readers() -> int:
    return sum(thread.name == THREAD for thread in threading.enumerate())


def test_controller_turns_the_surface_page_while_visible(
    window: MainWindow, copy_sample: CopySample, qtbot: QtBot, monkeypatch: pytest.MonkeyPatch
):
    bench = Bench({MOUSE_3D: Device(AXES)})
    monkeypatch.setattr(hid, "RETRY_S", 0.02)
    monkeypatch.setattr("labapp.media.devices.space_mouse.RETRY_S", 0.02)
    make_controller = partial(SpaceMouse, find=bench.find, opener=bench.open)
    monkeypatch.setattr(steering, "SpaceMouse", make_controller)
    window.files.open(copy_sample("thumb_tack"))
    window.show_step("surface")
    qtbot.waitUntil(lambda: not window.workspace.tasks.active)
    view = window.page.view
    view.grab()
    qtbot.waitUntil(lambda: "3-D controller: connected" in "\n".join(window.log_panel.texts()))
    before = view.camera
    bench.press(MOUSE_3D, "01 0000 0000 0000 0000 0000 5e01")
    qtbot.waitUntil(lambda: view.camera != before)
    bench.press(MOUSE_3D, "01 0000 0000 0000 0000 0000 0000")
    qtbot.waitUntil(lambda: window.page.steering._held[-1] == SixAxes())
    window.show_step("trends")
    assert readers() == 0
    window.show_step("surface")
    qtbot.waitUntil(lambda: len(bench.readers) == 2)
    # Unplugged while deflected, it turns nothing; plugged in again, it works again.
    bench.press(MOUSE_3D, "01 0000 0000 0000 0000 0000 5e01")
    qtbot.waitUntil(lambda: window.page.steering._held[-1].yaw == 1)
    bench.devices[MOUSE_3D].plugged = False
    qtbot.waitUntil(lambda: window.page.steering._held[-1] == SixAxes())
    bench.devices[MOUSE_3D].plugged = True
    qtbot.waitUntil(lambda: len(bench.readers) == 3)
    log = "\n".join(window.log_panel.texts())
    assert log.count("3-D controller: connected\n") <= 1
    assert window.status_line.unread == []
    # In the comparison of two schemes, all views are turned together.
    window.page.comparing.click()
    qtbot.waitUntil(lambda: not window.workspace.tasks.active)
    for each in window.page.compare.views:
        each.grab()
    cameras = [each.camera for each in window.page.compare.views]
    bench.press(MOUSE_3D, "01 0000 0000 0000 0000 0000 5e01")
    qtbot.waitUntil(
        lambda: all(
            each.camera != camera
            for each, camera in zip(window.page.compare.views, cameras, strict=True)
        )
    )
    window.close()
    assert readers() == 0


def test_missing_controller_is_not_reported(
    window: MainWindow, copy_sample: CopySample, qtbot: QtBot, monkeypatch: pytest.MonkeyPatch
):
    searches = []
    make_controller = partial(SpaceMouse, find=lambda: searches.append(1) or [])
    monkeypatch.setattr(steering, "SpaceMouse", make_controller)
    window.files.open(copy_sample("thumb_tack"))
    window.show_step("surface")
    qtbot.waitUntil(lambda: bool(searches) and not window.workspace.tasks.active)
    assert not any("controller" in each for each in window.log_panel.texts())
