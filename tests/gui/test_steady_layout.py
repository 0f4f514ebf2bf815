"""What there is to say moves no button: a second click at the same place meets the same button."""

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

from labapp.gui.pages import PAGES
from labapp.gui.pages.dots import DotsPage
from labapp.gui.pages.setup.view import BENCH_TAB, SAFETY_TAB
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
    """The window with a session that is measured, high enough for whole panels."""
    window.resize(1280, 1000)
    assert window.files.open(copy_sample("thumb_tack"))
    window.activateWindow()
    qtbot.waitUntil(window.isActiveWindow)
    return window


@contextmanager
def told_labels() -> Iterator[set[QLabel]]:
    """The labels that are told something meanwhile."""
    found: set[QLabel] = set()
    with pytest.MonkeyPatch.context() as patched:
        for kind in (QLabel, Message):
            own = kind.setText

            def told(label: QLabel, words: str, own=own) -> None:
                found.add(label)
                own(label, words)

            patched.setattr(kind, "setText", told)
        yield found


def places(window: MainWindow) -> dict[QAbstractButton, QPoint]:
    """Where the buttons in view are, in the window."""
    return {
        each: each.mapTo(window, QPoint())
        for each in window.findChildren(QAbstractButton)
        if each.isVisible() and each.text()
    }


def is_of_a_field(label: QLabel) -> bool:
    """Whether it tells what is wrong with a field: right below it, when the mouse is let go."""
    parent = label.parentWidget()
    return isinstance(parent, Field) and label is parent.problem


@pytest.mark.parametrize("key", PAGES)
def test_no_message_of_a_page_moves_its_buttons(opened: MainWindow, key: str, qtbot: QtBot):
    opened.show_step(key)
    page = opened.page
    if key == "setup":
        page.tabs.setCurrentIndex(BENCH_TAB)
    qtbot.waitUntil(lambda: not opened.workspace.tasks.active)
    with told_labels() as told:
        opened.workspace.changed.emit()
        opened.apply_theme()
        qtbot.waitUntil(lambda: not opened.workspace.tasks.active)
    inside = [each for each in told if page.panel.isAncestorOf(each) or page.isAncestorOf(each)]
    # That a recording is missing is known when the session is opened, before there is a pointer.
    known = {getattr(page, "missing", None)}
    messages = [each for each in inside if not (is_of_a_field(each) or each in known)]
    messages.append(opened.side_panel.state)
    let_draw()
    before = places(opened)
    assert len(before) >= 5
    for label in messages:
        shown, words = label.isVisibleTo(page.panel), label.text()
        for said in (LONG, ""):
            label.setText(said)
            label.setVisible(bool(said) or isinstance(label, Message))
            let_draw()
            after = places(opened)
            moved = {
                each.text() for each in before if after.get(each, before[each]) != before[each]
            }
            assert not moved, (label, label.parentWidget(), words, said)
        label.setText(words)
        label.setVisible(shown)


def press_at(window: MainWindow, place: QPoint) -> None:
    """Click where the pointer rests, whatever is there, with time between press and release."""
    handle = window.windowHandle()
    QTest.mousePress(handle, LEFT, NONE, place)
    let_draw()
    QTest.mouseRelease(handle, LEFT, NONE, place)
    let_draw()


def test_seven_clicks_tick_the_seven_lines_of_the_safety_list(
    window: MainWindow, tmp_path, qtbot: QtBot
):
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
    seen = area.viewport()
    ticked = 0
    places = [box.mapTo(window, QPoint(9, box.height() // 2)) for box in page.ticks.values()]
    bottom = seen.mapTo(window, QPoint(0, seen.height())).y()
    for place in places:
        if place.y() < bottom:
            press_at(window, place)
            ticked += 1
    assert ticked == len(SAFETY)
    assert len(window.workspace.session.record.safety) == ticked
    for place in places:
        press_at(window, place)
    assert window.workspace.session.record.safety == ()


def test_export_counts_though_the_film_s_speed_is_still_being_typed(
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


def test_a_message_that_is_too_long_ends_in_dots_and_its_tip_has_it_all(qtbot: QtBot):
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
def test_primary_buttons_are_in_view_on_a_small_screen(
    opened: MainWindow, qtbot: QtBot, key: str, words: str
) -> None:
    opened.resize(1024, 700)
    opened.show_step(key)
    let_draw()
    assert opened.page is not None
    found = [
        each
        for each in opened.page.panel.findChildren(QAbstractButton)
        if each.text().replace("&", "") == words and each.isVisible()
    ]
    assert [each.visibleRegion().boundingRect() for each in found] == [found[0].rect()]


def test_choosing_a_dot_brings_the_buttons_that_correct_it_into_view(
    opened: MainWindow, qtbot: QtBot
) -> None:
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


def test_a_panel_stays_where_it_is_when_a_clicked_button_is_disabled(qtbot: QtBot) -> None:
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
