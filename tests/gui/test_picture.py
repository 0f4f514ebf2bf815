"""The picture: places in px, zoom that stays, contrast, points to drag."""

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


class Noting(Tool):
    def __init__(self) -> None:
        self.seen: list[tuple[str, float, float]] = []

    def click(self, u: float, v: float, modifiers: Qt.KeyboardModifier) -> None:
        self.seen.append(("click", u, v))

    def begin(self, u: float, v: float, modifiers: Qt.KeyboardModifier) -> bool:
        self.seen.append(("begin", u, v))
        return True

    def drag(self, u: float, v: float) -> None:
        self.seen.append(("drag", u, v))

    def end(self, u: float, v: float) -> None:
        self.seen.append(("end", u, v))


def drag(view: PictureView, start: QPoint, end: QPoint) -> None:
    port = view.canvas.viewport()
    QTest.mousePress(port, Qt.MouseButton.LeftButton, pos=start)
    for part in (0.3, 0.6, 1.0):
        QTest.mouseMove(port, start + (end - start) * part)
        let_draw()
    QTest.mouseRelease(port, Qt.MouseButton.LeftButton, pos=end)
    let_draw()


def test_the_tool_hears_of_clicks_and_drags_in_px_u_right_v_down(view: PictureView) -> None:
    view.tool = tool = Noting()
    QTest.mouseClick(view.canvas.viewport(), Qt.MouseButton.LeftButton, pos=at(view, 40, 30))
    kind, u, v = tool.seen[0]
    assert kind == "click"
    assert (u, v) == pytest.approx((40, 30), abs=0.3)
    drag(view, at(view, 20, 20), at(view, 60, 90))
    assert tool.seen[1][0] == "begin"
    assert tool.seen[1][1:] == pytest.approx((20, 20), abs=0.3)
    assert tool.seen[-1][0] == "end"
    assert tool.seen[-1][1:] == pytest.approx((60, 90), abs=0.3)


def test_pixel_centres_are_whole_numbers() -> None:
    assert level_at(GREY, 12.4, 7.4) == GREY[7, 12]
    assert level_at(GREY, 11.6, 6.6) == GREY[7, 12]
    assert level_at(GREY, -0.4, 119.4) == GREY[119, 0]
    assert level_at(GREY, 160, 3) is None
    assert level_at(GREY, 3, -0.6) is None
    assert level_at(None, 0, 0) is None


def test_the_middle_of_what_is_seen_is_the_middle_of_the_picture(view: PictureView) -> None:
    middle = view.box.viewRect().center()
    assert (middle.x(), middle.y()) == pytest.approx((79.5, 59.5), abs=0.01)


def test_zoom_stays_for_the_next_frame_and_is_new_for_another_size(view: PictureView) -> None:
    view.zoom(4)
    seen = view.box.viewRect()
    view.show_picture(GREY[::-1].copy())
    assert view.box.viewRect() == seen
    view.show_picture(GREY[:60])
    assert view.box.viewRect() != seen


def test_it_fits_again_in_another_size_until_the_hand_has_zoomed(view: PictureView) -> None:
    def all_seen() -> bool:
        return bool(view.box.viewRect().contains(QRectF(-0.5, -0.5, 160, 120)))

    def as_large_as_can_be() -> bool:
        seen = view.box.viewRect()
        return bool(min(seen.width() / 160, seen.height() / 120) < 1.05)

    for size in ((300, 700), (1200, 400), (700, 560)):
        view.resize(*size)
        let_draw()
        assert all_seen()
        assert as_large_as_can_be()
    drag(view, at(view, 80, 60), at(view, 100, 60))
    moved = view.box.viewRect().center()
    view.resize(600, 500)
    let_draw()
    assert view.box.viewRect().center().x() == pytest.approx(moved.x(), abs=0.5)
    view.fit()
    view.zoom(4)
    view.resize(700, 560)
    let_draw()
    assert not all_seen()


def test_keys_zoom_and_fit(view: PictureView) -> None:
    whole = view.box.viewRect().width()
    QTest.keyClick(view, Qt.Key.Key_Plus)
    assert view.box.viewRect().width() == pytest.approx(whole / 1.25)
    QTest.keyClick(view, Qt.Key.Key_Right)
    assert view.box.viewRect().center().x() == pytest.approx(79.5)  # the window's: next frame
    QTest.keyClick(view, Qt.Key.Key_Right, Qt.KeyboardModifier.ShiftModifier)
    assert view.box.viewRect().center().x() > 90
    QTest.keyClick(view, Qt.Key.Key_F)
    assert view.box.viewRect().width() == pytest.approx(whole)


def test_contrast_follows_the_picture_but_does_not_flicker(view: PictureView) -> None:
    held = auto_levels(GREY)
    view.show_picture((GREY * 0.9).astype(np.uint8))
    assert view._shown_levels() == held
    dim = GREY.astype(np.uint16) * 200
    view.show_picture(dim)
    assert view._shown_levels() == auto_levels(dim)
    QTest.keyClick(view, Qt.Key.Key_BracketRight)
    assert view._shown_levels()[1] < auto_levels(dim)[1]
    QTest.keyClick(view, Qt.Key.Key_0)
    assert view._shown_levels() == auto_levels(dim)
    # Some tiff stacks hold NaN, and a capped lens gives one level alone.
    assert auto_levels(np.full((9, 9), np.nan)) == (0.0, 1.0)
    black, white = auto_levels(np.full((9, 9), 7))
    assert black == 7 < white


def test_a_point_is_dragged_and_nudged(view: PictureView, qtbot: QtBot) -> None:
    first, second = DragPoint("O′", 40, 40), DragPoint("X axis", 120, 40)
    for point in (first, second):
        view.add_point(point)
    let_draw()
    with qtbot.waitSignal(second.moved, check_params_cb=lambda u, v: u > 129) as told:
        drag(view, at(view, 120, 40), at(view, 130, 60))
    assert told.args == pytest.approx([130, 60], abs=0.5)
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


def test_what_is_seen_can_be_copied_overlays_and_all(view: PictureView) -> None:
    bare = view.grab_picture()
    view.add(pg.ScatterPlotItem([80], [60], size=30, brush="r", pen=None))
    let_draw()
    picture = view.grab_picture()
    assert picture.size() == bare.size()
    assert picture.pixelColor(at(view, 80, 60)).red() == 255


def test_without_a_picture_it_says_why(view: PictureView) -> None:
    view.show_picture(None, "frame 3 cannot be read")
    assert view.picture is None
    assert view._empty.text() == "frame 3 cannot be read"
    view.show_picture(GREY)
    assert view._empty.text() == ""


def test_the_mouse_reaches_the_picture_as_the_desktop_sends_it(view: PictureView, qtbot: QtBot):
    seen: list[tuple[float, float]] = []
    view.pointed.connect(lambda u, v, _: seen.append((u, v)))
    view.tool = noting = Noting()
    window, there = view.windowHandle(), view.canvas.mapTo(view, at(view, 80, 60))
    QTest.mouseMove(window, there - QPoint(20, 20))
    QTest.mouseMove(window, there)
    QTest.mouseClick(window, Qt.MouseButton.LeftButton, Qt.KeyboardModifier.NoModifier, there)
    qtbot.waitUntil(lambda: bool(noting.seen))
    assert seen  # pyqtgraph passes on so many moves a second, and no more
    assert noting.seen[0] == ("click", pytest.approx(80, abs=1), pytest.approx(60, abs=1))


def test_the_pointers_place_is_seen_whole_in_a_narrow_view(view: PictureView) -> None:
    before = view.minimumSizeHint().width()
    view.resize(300, 300)
    let_draw()
    view.box.scene().sigMouseMoved.emit(view.box.mapViewToScene(QPointF(100.0, 50.0)))
    assert "level" in view._place.text()
    assert view._place.isVisible()
    assert view._place.width() >= view._place.sizeHint().width()
    assert view.canvas.rect().contains(view._place.geometry())
    assert view.minimumSizeHint().width() == before


def test_the_right_button_opens_a_menu_with_the_page_s_actions_for_what_is_there(
    view: PictureView, monkeypatch: pytest.MonkeyPatch
):
    pointed: list[tuple[float, float]] = []
    monkeypatch.setattr(view.tool, "point_out", lambda u, v: pointed.append((round(u), round(v))))
    own = QAction("Delete", view)
    view.menu_actions = [own]
    QTest.mouseClick(view.canvas.viewport(), Qt.MouseButton.RightButton, pos=at(view, 40, 30))
    let_draw()
    menu = QApplication.activePopupWidget()
    assert isinstance(menu, QMenu)
    assert menu.actions()[0] is own
    assert pointed == [(40, 30)]
    levels = next(each for each in menu.actions() if each.text().startswith("Histogram"))
    levels.trigger()
    menu.close()
    (dialog,) = view.findChildren(LevelsDialog)
    before = dialog.profile.plot.listDataItems()[0].yData.copy()
    view.show_picture(GREY // 2)
    assert dialog.profile.plot.listDataItems()[0].yData.max() < before.max()
    dialog.close()


def test_a_profile_has_the_levels_along_its_line_and_none_outside():
    along, levels = profile(GREY, np.array([[10.0, 5.0], [20.0, 5.0]]))
    np.testing.assert_allclose(along, np.arange(11))
    np.testing.assert_allclose(levels, GREY[5, 10:21])
    slanted = profile(GREY, np.array([[3.0, 4.0], [6.0, 8.0]]))
    np.testing.assert_allclose(slanted[0], np.arange(6))
    np.testing.assert_allclose(slanted[1], 7 + 1.4 * np.arange(6))
    assert np.isnan(profile(GREY, np.array([[-5.0, 5.0], [-2.0, 5.0]]))[1]).all()
