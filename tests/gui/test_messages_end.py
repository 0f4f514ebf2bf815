"""A message disappears with its cause, and a failure is shown beside the pressed button."""

from __future__ import annotations

import errno
from pathlib import Path

import pytest
from PySide6.QtCore import QPoint, QRect, Qt
from PySide6.QtWidgets import QAbstractButton, QLabel
from pytestqt.qtbot import QtBot

from labapp.errors import InputError
from labapp.gui.pages.export import page as export_page
from labapp.gui.pages.setup.page import BENCH_TAB
from labapp.gui.shell.window import MainWindow
from labapp.session.session import Session
from tests.gui.conftest import CopySample, let_draw
from tests.gui.hand import Hand

BESIDE_PX = 90
"""Largest distance of a message from its button."""


@pytest.fixture
def opened(window: MainWindow, copy_sample: CopySample, qtbot: QtBot) -> MainWindow:
    assert window.files.open(copy_sample("thumb_tack"))
    window.activateWindow()
    qtbot.waitUntil(window.isActiveWindow)
    return window


def stands_beside(label: QLabel, button: QAbstractButton) -> bool:
    """Whether a message is visible and close to a button."""
    let_draw()
    if not (label.isVisible() and button.isVisible()):
        return False
    one, other = (
        QRect(each.mapTo(each.window(), QPoint()), each.size()) for each in (label, button)
    )
    return other.adjusted(-BESIDE_PX, -BESIDE_PX, BESIDE_PX, BESIDE_PX).intersects(one)


def test_full_disk_message_ends_with_a_successful_export(
    opened: MainWindow, tmp_path: Path, qtbot: QtBot, monkeypatch: pytest.MonkeyPatch
):
    opened.show_step("export")
    page, write = opened.page, export_page.write
    for box in page._boxes.values():
        box.setChecked(False)
    page._boxes["tables:measures"].setChecked(True)
    page.folder.set_value(str(tmp_path / "first"))

    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(export_page, "write", full)
    page.export()
    qtbot.waitUntil(lambda: "No space left" in opened.status_line.message.text())
    assert "No space left" in page.answer.text()
    assert stands_beside(page.answer, page.export_button)
    assert page.export_button.isEnabled()
    monkeypatch.setattr(export_page, "write", write)
    page.folder.set_value(str(tmp_path / "second"))
    page.export()
    assert not page.open_button.isEnabled()
    qtbot.waitUntil(lambda: page.written is not None)
    assert str(tmp_path / "second") in page.answer.text()
    assert page.answer.text().startswith("✓")
    assert page.open_button.isEnabled()
    assert opened.status_line.unread == []
    assert "No space left" not in opened.status_line.message.text()
    assert "No space left" not in page.answer.text()
    assert any("No space left" in line for line in opened.log_panel.texts())


def test_full_disk_message_of_a_change_ends_with_the_next_stored_change(
    opened: MainWindow, monkeypatch: pytest.MonkeyPatch
):
    def full(*_: object) -> None:
        raise InputError("a.labsession", "file", "No space left on device", "enough of it")

    opened.show_step("setup")
    record = opened.page.record_fields
    for change_again in (
        lambda: record["operator"].edited.emit("K. Ito"),
        lambda: opened.do("undo"),
    ):
        with monkeypatch.context() as patched:
            patched.setattr(Session, "set_record", full)
            record["title"].edited.emit("Refused")
        assert len(opened.status_line.unread) == 1
        assert "No space left" in opened.status_line.message.text()
        change_again()
        assert opened.status_line.unread == []
    assert any("No space left" in line for line in opened.log_panel.texts())


def test_problems_of_a_session_end_with_it(
    opened: MainWindow, copy_sample: CopySample, tmp_path: Path, qtbot: QtBot
):
    missing = opened.workspace.session.path.parent / "recording.tif"
    moved = missing.rename(tmp_path / "moved.tif")
    path = opened.workspace.session.path
    opened.files.close()
    opened.files.open(path)
    assert "recording is missing" in opened.status_line.message.text()
    opened.files.open(copy_sample("gtaw"))
    assert opened.status_line.unread == []
    # Once it is found again, the message disappears.
    opened.files.open(path)
    opened.show_step("capture")
    assert "recording is missing" in opened.status_line.message.text()
    opened.page.relink(moved)
    qtbot.waitUntil(lambda: opened.workspace.session.missing_recording is None)
    qtbot.waitUntil(lambda: opened.status_line.unread == [])


def test_missing_selection_is_reported_until_the_next_edit(
    opened: MainWindow, qtbot: QtBot
) -> None:
    opened.show_step("dots")
    page = opened.page
    qtbot.waitUntil(lambda: page.editor.correction is not None)
    page.choose(page.editor.choose_none)
    hand = Hand(opened)
    hand.press(Qt.Key.Key_B)
    assert "Select a row first" in opened.status_line.message.text()
    page.choose(page.editor.choose_rows, [3])
    hand.press(Qt.Key.Key_B)
    assert opened.status_line.unread == []


def test_pending_click_ends_with_the_session(
    opened: MainWindow, copy_sample: CopySample, qtbot: QtBot
):
    opened.show_step("dots")
    page = opened.page
    qtbot.waitUntil(lambda: not opened.workspace.tasks.active)
    page._at_pointer(page.add_at, "Click where the dot is")
    assert "Click where" in page.dots_panel.chosen.text()
    opened.files.open(copy_sample("gtaw"))
    opened.show_step("dots")
    qtbot.waitUntil(lambda: not opened.workspace.tasks.active)
    assert "Click where" not in page.dots_panel.chosen.text()
    assert not page.dot_tool.busy


def test_incomplete_setup_message_ends_after_measuring(opened: MainWindow, tmp_path: Path):
    sample = opened.workspace.session
    complete, recording = sample.setup_text, sample.path.parent / "recording.tif"
    opened.workspace.show(Session.create(tmp_path / "new.labsession"))
    assert opened.workspace.attempt(lambda session: session.import_recording(recording))
    opened.do("measure_frame")
    assert "not complete" in opened.status_line.message.text()
    assert opened.workspace.attempt(lambda session: session.set_setup(complete))
    opened.do("measure_frame")
    assert opened.status_line.unread == []
    opened.files.close()  # the duration of measuring does not matter here


def test_undo_ends_what_was_said_about_a_loaded_setup(
    window: MainWindow, copy_sample: CopySample, tmp_path: Path
):
    assert window.files.open(copy_sample("concave"))
    larger = copy_sample("gtaw").parent / "setup.toml"
    window.show_step("setup")
    page = window.page
    page.take(larger)
    assert page.answer.text().startswith("▲")
    assert len(window.status_line.unread) == 1
    window.do("undo")
    assert page.answer.text() == ""
    assert window.status_line.unread == []
    window.do("redo")
    assert len(window.status_line.unread) == 1
    fitting = window.workspace.session.path.parent / "setup.toml"
    assert window.workspace.attempt(lambda session: session.set_setup(fitting.read_text("utf-8")))
    assert window.status_line.unread == []


def test_measuring_is_not_reported_for_another_scheme(opened: MainWindow, qtbot: QtBot):
    opened.show_step("surface")
    page = opened.page
    page.side.this_one()
    qtbot.waitUntil(lambda: page.answer.text().startswith("✓"))
    page.side.scheme.edited.emit("zonal")
    qtbot.waitUntil(lambda: opened.stack.currentWidget() is opened.empty)
    assert page.answer.text() == ""
    opened.do("measure_frame")
    qtbot.waitUntil(lambda: not opened.workspace.tasks.active)
    assert opened.stack.currentWidget() is page
    page.side.scheme.edited.emit("modal")
    qtbot.waitUntil(lambda: opened.stack.currentWidget() is opened.empty)
    assert opened.empty.answer.text() == ""


def test_rejected_files_are_reported_beside_their_buttons(
    opened: MainWindow, tmp_path: Path, qtbot: QtBot
):
    hand, wrong = Hand(opened), tmp_path / "wrong.toml"
    wrong.write_text("nonsense")
    opened.show_step("setup")
    page = opened.page
    page.tabs.setCurrentIndex(BENCH_TAB)
    page.load(wrong)
    assert "wrong.toml" in page.answer.text()
    assert stands_beside(page.answer, hand.find("Load…"))
    page.save(tmp_path / "right.toml")
    assert page.answer.text() == f"✓ Set-up saved in {tmp_path / 'right.toml'}"
    assert stands_beside(page.answer, hand.find("Save…"))
    page.load(tmp_path / "right.toml")
    assert opened.status_line.unread == []
    opened.show_step("capture")
    page = opened.page
    page.take(wrong)
    qtbot.waitUntil(lambda: "wrong.toml" in page.answer.text())
    assert stands_beside(page.answer, hand.find("Choose file…"))
    opened.show_step("plane")
    page = opened.page
    page.load(wrong)
    qtbot.waitUntil(lambda: bool(page.answer.text()))
    assert stands_beside(page.answer, hand.find("Find O′ and the axes"))


def test_measuring_is_reported_beside_the_button_of_each_page(opened: MainWindow, qtbot: QtBot):
    hand = Hand(opened)
    for key, words in (("surface", "This frame"), ("dots", "Measure this frame")):
        opened.show_step(key)
        page, pressed = opened.page, hand.find(words)
        assert page.answer.text() == ""
        pressed.click()
        qtbot.waitUntil(lambda page=page: page.answer.text().startswith("✓ 1 frame"))
        assert stands_beside(page.answer, pressed)


def test_saving_a_picture_is_reported_beside_its_button(opened: MainWindow, tmp_path: Path):
    opened.show_step("surface")
    page = opened.page
    page.write_picture(tmp_path / "pool.png")
    assert page.saved.text() == f"✓ Saved in {tmp_path / 'pool.png'}"
    assert stands_beside(page.saved, page.save)
    page.write_picture(tmp_path / "nowhere" / "pool.png")
    assert page.saved.text().startswith("▲")
    assert opened.status_line.unread


def test_startup_problems_outlast_the_session(window: MainWindow, copy_sample: CopySample):
    first, second = copy_sample("gtaw"), copy_sample("thumb_tack")
    window.say("Preferences", True)
    assert window.files.open(first)
    assert window.status_line.unread == ["Preferences"]
    window.say("of the first session", True)
    assert window.files.open(second)
    assert window.status_line.unread == []
    assert "of the first session" in window.log_panel.texts()[-1]
