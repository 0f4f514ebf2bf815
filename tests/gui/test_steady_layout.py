"""Messages move no button: a second click at the same place hits the same button."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import pytest
from PySide6.QtCore import QPoint, Qt
from PySide6.QtTest import QTest
from PySide6.QtWidgets import (
    QAbstractButton,
    QApplication,
    QLabel,
    QPushButton,
    QScrollArea,
    QWidget,
)
from pytestqt.qtbot import QtBot

from labapp.gui.pages.dots.page import DotsPage
from labapp.gui.pages.setup.page import BENCH_TAB, SAFETY_TAB
from labapp.gui.pages.surface.page import SurfacePage
from labapp.gui.shell.step_list import SidePanel
from labapp.gui.shell.steps import STEPS
from labapp.gui.shell.window import MainWindow
from labapp.gui.widgets.fields import Field
from labapp.gui.widgets.labels import Message
from labapp.gui.widgets.layouts import scrolled
from labapp.session.checklist import SAFETY
from labapp.session.session import Session
from tests.gui.conftest import KEPT, CopySample, let_draw

LONG = "words that need more room than there is on a line, and on the next one, too; " * 4

LEFT, NONE = Qt.MouseButton.LeftButton, Qt.KeyboardModifier.NoModifier


@pytest.fixture
def opened(window: MainWindow, copy_sample: CopySample, qtbot: QtBot) -> MainWindow:
    """The window with a measured session, tall enough for complete panels."""
    window.resize(1280, 1000)
    assert window.files.open(copy_sample("thumb_tack"))
    window.activateWindow()
    qtbot.waitUntil(window.isActiveWindow)
    return window


@contextmanager
def updated_labels() -> Iterator[set[QLabel]]:
    """Collect the labels whose text is set meanwhile."""
    labels: set[QLabel] = set()
    with pytest.MonkeyPatch.context() as patched:
        for kind in (QLabel, Message):
            set_text = kind.setText

            def record(label: QLabel, words: str, set_text=set_text) -> None:
                labels.add(label)
                set_text(label, words)

            patched.setattr(kind, "setText", record)
        yield labels


def places(window: MainWindow) -> dict[QAbstractButton, QPoint]:
    """Positions of the visible buttons in the window."""
    return {
        each: each.mapTo(window, QPoint())
        for each in window.findChildren(QAbstractButton)
        if each.isVisible() and each.text()
    }


def is_problem_of_a_field(label: QLabel) -> bool:
    """Whether it is the problem label of a field, which appears when the mouse is released."""
    parent = label.parentWidget()
    return isinstance(parent, Field) and label is parent.problem


@pytest.mark.parametrize("key", [step.key for step in STEPS])
def test_messages_do_not_move_the_buttons_of_a_page(opened: MainWindow, key: str, qtbot: QtBot):
    opened.show_step(key)
    page = opened.page
    if key == "setup":
        page.tabs.setCurrentIndex(BENCH_TAB)
    qtbot.waitUntil(lambda: not opened.workspace.tasks.active)
    with updated_labels() as updated:
        opened.workspace.changed.emit()
        opened.apply_theme()
        qtbot.waitUntil(lambda: not opened.workspace.tasks.active)
    inside = [each for each in updated if page.panel.isAncestorOf(each) or page.isAncestorOf(each)]
    # A missing recording is reported when the session is opened, before a button can be clicked.
    known = {getattr(page, "missing", None)}
    messages = [each for each in inside if not (is_problem_of_a_field(each) or each in known)]
    messages.append(opened.side_panel.state)
    let_draw()
    before = places(opened)
    assert len(before) >= 5
    for label in messages:
        shown, original = label.isVisibleTo(page.panel), label.text()
        for text in (LONG, ""):
            label.setText(text)
            label.setVisible(bool(text) or isinstance(label, Message))
            let_draw()
            after = places(opened)
            moved = {
                each.text() for each in before if after.get(each, before[each]) != before[each]
            }
            assert not moved, (label, label.parentWidget(), original, text)
        label.setText(original)
        label.setVisible(shown)


def press_at(window: MainWindow, place: QPoint) -> None:
    """Click at a place, whatever is there, with some time between press and release."""
    handle = window.windowHandle()
    QTest.mousePress(handle, LEFT, NONE, place)
    let_draw()
    QTest.mouseRelease(handle, LEFT, NONE, place)
    let_draw()


def test_each_click_checks_one_line_of_the_safety_list(window: MainWindow, tmp_path, qtbot: QtBot):
    window.resize(1280, 1000)
    window.workspace.show(Session.create(tmp_path / "new.labsession"))
    window.show_step("setup")
    window.activateWindow()
    qtbot.waitUntil(window.isActiveWindow)
    page = window.page
    page.tabs.setCurrentIndex(SAFETY_TAB)
    let_draw()
    area = page.panel
    while not isinstance(area, QScrollArea):
        area = area.parentWidget()
    viewport = area.viewport()
    ticked = 0
    places = [box.mapTo(window, QPoint(9, box.height() // 2)) for box in page.ticks.values()]
    bottom = viewport.mapTo(window, QPoint(0, viewport.height())).y()
    for place in places:
        if place.y() < bottom:
            press_at(window, place)
            ticked += 1
    assert ticked == len(SAFETY)
    assert len(window.workspace.session.record.safety) == ticked
    for place in places:
        press_at(window, place)
    assert window.workspace.session.record.safety == ()


def test_click_on_export_counts_while_a_field_is_being_edited(
    opened: MainWindow, tmp_path, qtbot: QtBot, monkeypatch: pytest.MonkeyPatch
):
    opened.show_step("export")
    page = opened.page
    pressed: list[str] = []
    monkeypatch.setattr(page, "export", lambda: pressed.append("export"))
    page.export_button.clicked.disconnect()
    page.export_button.clicked.connect(lambda _: page.export())
    page._boxes["pictures:film"].setChecked(True)
    let_draw()
    place = page.export_button.mapTo(opened, page.export_button.rect().center())
    for speed in ("2", "", "abc", "500"):
        page.rate.editor.setFocus()
        page.rate.editor.selectAll()
        QTest.keyClicks(page.rate.editor, speed or "\b")
        press_at(opened, place)
        is_right = speed != "abc"
        qtbot.waitUntil(lambda is_right=is_right: page.rate.problem.isHidden() == is_right)
        let_draw()
        place = page.export_button.mapTo(opened, page.export_button.rect().center())
    assert len(pressed) == 4


def test_long_message_is_elided_and_complete_in_its_tooltip(qtbot: QtBot):
    label = Message(2)
    qtbot.addWidget(label)
    label.resize(200, label.sizeHint().height())
    label.setText("short")
    assert (label.shown(), label.toolTip()) == (["short"], "")
    height = label.sizeHint().height()
    label.setText(LONG)
    assert label.sizeHint().height() == label.minimumSizeHint().height() == height
    lines = label.shown()
    assert len(lines) == 2
    assert lines[1].endswith("…")
    assert label.toolTip() == label.text() == LONG
    assert all(label.fontMetrics().horizontalAdvance(line) <= 200 for line in lines)
    label.setText("first\nsecond\nthird")
    assert label.shown() == ["first", "second third"]


@pytest.mark.parametrize(
    ("key", "words"),
    [
        ("laser", "Apply"),
        ("plane", "Apply"),
        ("bench_check", "Check"),
        ("capture", "Start"),
        ("dots", "Measure all frames"),
        ("surface", "Not measured"),
        ("export", "Export"),
    ],
)
def test_primary_buttons_are_visible_on_a_small_screen(
    opened: MainWindow, qtbot: QtBot, key: str, words: str
) -> None:
    opened.resize(1024, 700)
    opened.show_step(key)
    let_draw()
    assert opened.page is not None
    buttons = [
        each
        for each in opened.page.panel.findChildren(QAbstractButton)
        if each.text().replace("&", "") == words and each.isVisible()
    ]
    assert [each.visibleRegion().boundingRect() for each in buttons] == [buttons[0].rect()]


def test_surface_and_its_sizes_are_visible_on_a_small_screen(
    opened: MainWindow, qtbot: QtBot
) -> None:
    """As on a screen of 1366 × 768 px at 150 %: nothing has to be scrolled for the height."""
    opened.resize(911, 512)
    opened.show_step("surface")
    page = opened.page
    assert isinstance(page, SurfacePage)
    qtbot.waitUntil(lambda: page.side.sizes.rowCount() > 0 and not opened.workspace.tasks.active)
    let_draw()
    sizes = page.side.sizes
    (height,) = (k for k in range(sizes.rowCount()) if sizes.item(k, 0).text() == "Height")
    row = sizes.visualItemRect(sizes.item(height, 0))
    assert sizes.viewport().visibleRegion().contains(row.center())
    assert page.view.height() > page.height() / 2
    lines = {each.mapTo(page, QPoint(0, 0)).y() for each in (page.colour, page.save, page.film)}
    assert len(lines) <= 2


def test_selected_dot_scrolls_its_buttons_into_view(opened: MainWindow, qtbot: QtBot) -> None:
    """As on a screen of 1024 × 700 px at 150 %; a choice in the panel leaves it where it is."""
    opened.resize(683, 467)
    opened.show_step("dots")
    page = opened.page
    assert isinstance(page, DotsPage)
    qtbot.waitUntil(lambda: len(page.editor.dots_px) > 1)
    panel = page.dots_panel

    def in_view() -> list[bool]:
        let_draw()
        buttons = [panel.buttons[words] for words in ("Delete", "In doubt", "Blocked")]
        return [each.visibleRegion().boundingRect() == each.rect() for each in buttons]

    assert not all(in_view())
    panel.rows.setFocus()
    panel.rows.selectRow(0)
    assert page.editor.selection.size
    assert not all(in_view())
    page.setFocus()
    QTest.keyClick(page.view, Qt.Key.Key_Period)
    assert all(in_view())


def test_panel_does_not_scroll_when_a_clicked_button_is_disabled(qtbot: QtBot) -> None:
    inner = QWidget()
    clicked, beyond = QPushButton("Apply", inner), QPushButton("beyond", inner)
    inner.setMinimumSize(100, 900)
    beyond.move(0, 800)
    area = scrolled(inner)
    KEPT.append(area)
    area.resize(200, 200)
    area.show()
    area.activateWindow()
    qtbot.waitUntil(area.isActiveWindow)
    clicked.clicked.connect(lambda: clicked.setEnabled(False))
    QTest.mouseClick(clicked, LEFT)
    assert QApplication.focusWidget() is not clicked
    assert area.verticalScrollBar().value() == 0
    clicked.setEnabled(True)
    clicked.setFocus()
    QTest.keyClick(clicked, Qt.Key.Key_Tab)
    assert beyond.hasFocus()
    assert area.verticalScrollBar().value() > 0


def test_side_panel_is_wider_with_a_larger_font(qtbot: QtBot) -> None:
    panel = SidePanel()
    KEPT.append(panel)
    before, font = panel.sizeHint().width(), panel.font()
    font.setPointSizeF(1.5 * font.pointSizeF())
    panel.setFont(font)
    assert panel.sizeHint().width() > 1.2 * before
