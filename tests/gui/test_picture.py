"""The picture view: pixel coordinates, persistent zoom, contrast, points to drag."""

from __future__ import annotations

import numpy as np
import pyqtgraph as pg
import pytest
from PySide6.QtCore import QPoint, QPointF, QRectF, Qt
from PySide6.QtGui import QAction
from PySide6.QtTest import QTest
from PySide6.QtWidgets import QApplication, QMenu
from pytestqt.qtbot import QtBot

from labapp.gui.views.drag_point import DragPoint
from labapp.gui.views.picture import PictureView, Tool, auto_levels, level_at
from labapp.gui.views.picture_levels import LevelsDialog, profile
from tests.gui.conftest import KEPT, let_draw

GREY = (np.add.outer(np.arange(120), np.arange(160)) % 251).astype(np.uint8)


@pytest.fixture
def view(qtbot: QtBot) -> PictureView:
    view = PictureView()
    KEPT.append(view)
    view.resize(700, 560)
    view.show_picture(GREY)
    view.show()
    qtbot.waitExposed(view)
    let_draw()
    return view


def at(view: PictureView, u: float, v: float) -> QPoint:
    scene = view.box.mapViewToScene(QPointF(u, v))
    port: QPoint = view.canvas.mapFromScene(scene)
    return port


class RecordingTool(Tool):
    def __init__(self) -> None:
        self.events: list[tuple[str, float, float]] = []

    def click(self, u: float, v: float, modifiers: Qt.KeyboardModifier) -> None:
        self.events.append(("click", u, v))

    def begin(self, u: float, v: float, modifiers: Qt.KeyboardModifier) -> bool:
        self.events.append(("begin", u, v))
        return True

    def drag(self, u: float, v: float) -> None:
        self.events.append(("drag", u, v))

    def end(self, u: float, v: float) -> None:
        self.events.append(("end", u, v))


def drag(view: PictureView, start: QPoint, end: QPoint) -> None:
    port = view.canvas.viewport()
    QTest.mousePress(port, Qt.MouseButton.LeftButton, pos=start)
    for part in (0.3, 0.6, 1.0):
        QTest.mouseMove(port, start + (end - start) * part)
        let_draw()
    QTest.mouseRelease(port, Qt.MouseButton.LeftButton, pos=end)
    let_draw()


def test_tool_gets_clicks_and_drags_in_px_u_right_v_down(view: PictureView) -> None:
    view.tool = tool = RecordingTool()
    QTest.mouseClick(view.canvas.viewport(), Qt.MouseButton.LeftButton, pos=at(view, 40, 30))
    kind, u, v = tool.events[0]
    assert kind == "click"
    assert (u, v) == pytest.approx((40, 30), abs=0.3)
    drag(view, at(view, 20, 20), at(view, 60, 90))
    assert tool.events[1][0] == "begin"
    assert tool.events[1][1:] == pytest.approx((20, 20), abs=0.3)
    assert tool.events[-1][0] == "end"
    assert tool.events[-1][1:] == pytest.approx((60, 90), abs=0.3)


def test_pixel_centres_are_integers() -> None:
    assert level_at(GREY, 12.4, 7.4) == GREY[7, 12]
    assert level_at(GREY, 11.6, 6.6) == GREY[7, 12]
    assert level_at(GREY, -0.4, 119.4) == GREY[119, 0]
    assert level_at(GREY, 160, 3) is None
    assert level_at(GREY, 3, -0.6) is None
    assert level_at(None, 0, 0) is None


def test_view_is_centred_on_the_picture(view: PictureView) -> None:
    middle = view.box.viewRect().center()
    assert (middle.x(), middle.y()) == pytest.approx((79.5, 59.5), abs=0.01)


def test_zoom_is_kept_for_frames_of_the_same_size(view: PictureView) -> None:
    view.zoom(4)
    visible = view.box.viewRect()
    view.show_picture(GREY[::-1].copy())
    assert view.box.viewRect() == visible
    view.show_picture(GREY[:60])
    assert view.box.viewRect() != visible


def test_resizing_fits_the_picture_until_it_is_zoomed(view: PictureView) -> None:
    def all_visible() -> bool:
        return bool(view.box.viewRect().contains(QRectF(-0.5, -0.5, 160, 120)))

    def fills_the_view() -> bool:
        visible = view.box.viewRect()
        return bool(min(visible.width() / 160, visible.height() / 120) < 1.05)

    for size in ((300, 700), (1200, 400), (700, 560)):
        view.resize(*size)
        let_draw()
        assert all_visible()
        assert fills_the_view()
    drag(view, at(view, 80, 60), at(view, 100, 60))
    moved = view.box.viewRect().center()
    view.resize(600, 500)
    let_draw()
    assert view.box.viewRect().center().x() == pytest.approx(moved.x(), abs=0.5)
    view.fit()
    view.zoom(4)
    view.resize(700, 560)
    let_draw()
    assert not all_visible()


def test_keys_zoom_and_fit(view: PictureView) -> None:
    full_width = view.box.viewRect().width()
    QTest.keyClick(view, Qt.Key.Key_Plus)
    assert view.box.viewRect().width() == pytest.approx(full_width / 1.25)
    QTest.keyClick(view, Qt.Key.Key_Right)
    assert view.box.viewRect().center().x() == pytest.approx(
        79.5
    )  # the window uses this key for the next frame
    QTest.keyClick(view, Qt.Key.Key_Right, Qt.KeyboardModifier.ShiftModifier)
    assert view.box.viewRect().center().x() > 90
    QTest.keyClick(view, Qt.Key.Key_F)
    assert view.box.viewRect().width() == pytest.approx(full_width)


def test_contrast_follows_the_picture_without_flicker(view: PictureView) -> None:
    initial = auto_levels(GREY)
    view.show_picture((GREY * 0.9).astype(np.uint8))
    assert view._shown_levels() == initial
    dim = GREY.astype(np.uint16) * 200
    view.show_picture(dim)
    assert view._shown_levels() == auto_levels(dim)
    QTest.keyClick(view, Qt.Key.Key_BracketRight)
    assert view._shown_levels()[1] < auto_levels(dim)[1]
    QTest.keyClick(view, Qt.Key.Key_0)
    assert view._shown_levels() == auto_levels(dim)
    # Some TIFF stacks contain NaN, and a covered lens gives a single level.
    assert auto_levels(np.full((9, 9), np.nan)) == (0.0, 1.0)
    black, white = auto_levels(np.full((9, 9), 7))
    assert black == 7 < white


def test_points_are_dragged_and_nudged(view: PictureView, qtbot: QtBot) -> None:
    first, second = DragPoint("O′", 40, 40), DragPoint("X axis", 120, 40)
    for point in (first, second):
        view.add_point(point)
    let_draw()
    with qtbot.waitSignal(second.moved, check_params_cb=lambda u, v: u > 129) as signal:
        drag(view, at(view, 120, 40), at(view, 130, 60))
    assert signal.args == pytest.approx([130, 60], abs=0.5)
    u, v = second.place
    QTest.keyClick(view, Qt.Key.Key_Left)
    QTest.keyClick(view, Qt.Key.Key_Down, Qt.KeyboardModifier.ShiftModifier)
    assert second.place == pytest.approx((u - 0.1, v + 1))
    QTest.keyClick(view, Qt.Key.Key_P)
    QTest.keyClick(view, Qt.Key.Key_Right)
    assert first.place == pytest.approx((40.1, 40))
    with qtbot.assertNotEmitted(first.moved):
        first.set_place(10, 10)
    assert first.place == (10, 10)


def test_grabbed_picture_includes_overlays(view: PictureView) -> None:
    without_overlay = view.grab_picture()
    view.add(pg.ScatterPlotItem([80], [60], size=30, brush="r", pen=None))
    let_draw()
    picture = view.grab_picture()
    assert picture.size() == without_overlay.size()
    assert picture.pixelColor(at(view, 80, 60)).red() == 255


def test_missing_picture_shows_the_reason(view: PictureView) -> None:
    view.show_picture(None, "frame 3 cannot be read")
    assert view.picture is None
    assert view._empty.text() == "frame 3 cannot be read"
    view.show_picture(GREY)
    assert view._empty.text() == ""


def test_mouse_events_of_the_window_reach_the_picture(view: PictureView, qtbot: QtBot):
    positions: list[tuple[float, float]] = []
    view.pointed.connect(lambda u, v, _: positions.append((u, v)))
    view.tool = tool = RecordingTool()
    window, place = view.windowHandle(), view.canvas.mapTo(view, at(view, 80, 60))
    QTest.mouseMove(window, place - QPoint(20, 20))
    QTest.mouseMove(window, place)
    QTest.mouseClick(window, Qt.MouseButton.LeftButton, Qt.KeyboardModifier.NoModifier, place)
    qtbot.waitUntil(lambda: bool(tool.events))
    assert positions  # pyqtgraph limits the rate of move events
    assert tool.events[0] == ("click", pytest.approx(80, abs=1), pytest.approx(60, abs=1))


def test_pointer_position_fits_into_a_narrow_view(view: PictureView) -> None:
    before = view.minimumSizeHint().width()
    view.resize(300, 300)
    let_draw()
    view.box.scene().sigMouseMoved.emit(view.box.mapViewToScene(QPointF(100.0, 50.0)))
    assert "level" in view._place.text()
    assert view._place.isVisible()
    assert view._place.width() >= view._place.sizeHint().width()
    assert view.canvas.rect().contains(view._place.geometry())
    assert view.minimumSizeHint().width() == before


def test_context_menu_has_the_actions_of_the_page(
    view: PictureView, monkeypatch: pytest.MonkeyPatch
):
    pointed: list[tuple[float, float]] = []
    monkeypatch.setattr(view.tool, "point_out", lambda u, v: pointed.append((round(u), round(v))))
    action = QAction("Delete", view)
    view.menu_actions = [action]
    QTest.mouseClick(view.canvas.viewport(), Qt.MouseButton.RightButton, pos=at(view, 40, 30))
    let_draw()
    menu = QApplication.activePopupWidget()
    assert isinstance(menu, QMenu)
    assert menu.actions()[0] is action
    assert pointed == [(40, 30)]
    levels = next(each for each in menu.actions() if each.text().startswith("Histogram"))
    levels.trigger()
    menu.close()
    (dialog,) = view.findChildren(LevelsDialog)
    before = dialog.profile.plot.listDataItems()[0].yData.copy()
    view.show_picture(GREY // 2)
    assert dialog.profile.plot.listDataItems()[0].yData.max() < before.max()
    dialog.close()


def test_profile_has_the_levels_along_its_line():
    along, levels = profile(GREY, np.array([[10.0, 5.0], [20.0, 5.0]]))
    np.testing.assert_allclose(along, np.arange(11))
    np.testing.assert_allclose(levels, GREY[5, 10:21])
    slanted = profile(GREY, np.array([[3.0, 4.0], [6.0, 8.0]]))
    np.testing.assert_allclose(slanted[0], np.arange(6))
    np.testing.assert_allclose(slanted[1], 7 + 1.4 * np.arange(6))
    assert np.isnan(profile(GREY, np.array([[-5.0, 5.0], [-2.0, 5.0]]))[1]).all()
