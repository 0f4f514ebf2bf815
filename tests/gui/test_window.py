from __future__ import annotations

import shutil
import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PySide6.QtCore import QMimeData, QPointF, Qt, QTimer, QUrl
from PySide6.QtGui import QDropEvent
from PySide6.QtWidgets import QApplication, QMessageBox
from pytestqt.qtbot import QtBot

from labapp.bundled import SAMPLE_TEXTS
from labapp.errors import InputError
from labapp.gui import app, dialogs
from labapp.gui.drafts import drafts, drafts_folder
from labapp.gui.pages.dots.presenter import NUMBERS, detector_value
from labapp.gui.pages.page import Page
from labapp.gui.preferences import Preferences, read_preferences
from labapp.gui.recent import look_at
from labapp.gui.shell import window as window_module
from labapp.gui.shell.commands import make_window
from labapp.gui.shell.files import title
from labapp.gui.shell.step_list import StepList, mark_icon
from labapp.gui.shell.steps import STEPS, Mark, Step, first_frame, first_step, states
from labapp.gui.shell.window import MainWindow
from labapp.gui.widgets.tables import table_text
from labapp.gui.workspace import Workspace
from labapp.log import log_file
from labapp.session.copies import copy_sample as copied_sample
from labapp.session.copies import copy_session
from labapp.session.record import Record
from labapp.session.session import Session
from tests.gui.conftest import KEPT, SAMPLES, CopySample, let_draw


class Plain(Page):
    """A page that counts the calls of the window."""

    def __init__(self, workspace: Workspace) -> None:
        super().__init__(workspace)
        self.refreshed, self.left = 0, 0
        self.taken: list[tuple[Path, bool]] = []

    def refresh(self) -> None:
        assert self.workspace.session is not None
        self.refreshed += 1

    def leave(self) -> None:
        self.left += 1

    def take(self, path: Path, at_once: bool = False) -> None:
        self.taken.append((path, at_once))


class Broken(Plain):
    key = "export"

    def refresh(self) -> None:
        raise RuntimeError("no export today")


class Capture(Plain):
    key = "capture"


class Surface(Plain):
    key = "surface"


class SetUp(Plain):
    key = "setup"


@pytest.fixture
def plain(
    qapp: QApplication, tmp_path: Path, state: Path, monkeypatch: pytest.MonkeyPatch
) -> Iterator[MainWindow]:
    """A window with the test pages above."""
    kinds = {kind.key: kind for kind in (SetUp, Capture, Surface, Broken)}

    def make(step: Step, workspace: Workspace) -> Plain:
        page = kinds.get(step.key, Plain)(workspace)
        page.key = step.key
        return page

    monkeypatch.setattr(window_module, "make_page", make)
    main_window = make_window(Preferences(theme="light"), tmp_path / "preferences.json")
    KEPT.append(main_window)
    main_window.show()
    yield main_window
    if main_window.isVisible():
        main_window.close()
    assert not main_window.workspace.tasks.active


def plain_page(window: MainWindow) -> Plain:
    assert isinstance(window.page, Plain)
    return window.page


def problems(window: MainWindow) -> list[str]:
    return [text for text in window.log_panel.texts() if "▲" in text]


def settle(window: MainWindow, qtbot: QtBot) -> None:
    qtbot.waitUntil(lambda: not window.workspace.tasks.active and not window._rest.isActive())


def test_first_window_shows_the_welcome_page(window: MainWindow):
    assert window.stack.currentWidget() is window.welcome
    assert window.welcome.nothing.isVisible()
    assert not any(window._docks[name].isVisible() for name in window._docks)
    assert window.windowTitle() == "labapp"


def test_opening_shows_results_and_closing_the_welcome_page(
    plain: MainWindow, copy_sample: CopySample, qtbot: QtBot
):
    path = copy_sample("gtaw")
    assert plain.files.open(path)
    page = plain_page(plain)
    assert page.key == "surface"
    assert page.refreshed >= 1
    assert plain.windowTitle() == "gtaw — labapp"
    assert plain.side_panel.title.text() == "Surface"
    assert "All 30 frames are measured" in plain.side_panel.state.text()
    assert plain.timeline.position_text.text().startswith("1 of 30")
    assert plain.preferences.current.recent == (str(path),)
    assert all(plain._docks[name].isVisible() for name in ("steps", "panel", "timeline"))
    plain.do("close")
    assert page.left == 1
    assert plain.workspace.session is None
    assert plain.stack.currentWidget() is plain.welcome
    qtbot.waitUntil(lambda: "30 frames, all measured" in plain.welcome.list.item(0).text())


@pytest.mark.parametrize(("key", "name"), [("laser", "fan"), ("export", "spacing")])
def test_edit_in_an_inactive_window_is_finished_when_the_session_closes(
    window: MainWindow, copy_sample: CopySample, qtbot: QtBot, key: str, name: str
):
    window.files.open(copy_sample("gtaw"))
    window.show_step(key)
    field = getattr(window.page, name)
    field.editor.selectAll()
    qtbot.keyClicks(field.editor, "0.5")  # without the focus, as in an inactive window
    assert field.value() != 0.5
    window.do("close")
    assert field.value() == 0.5


def test_only_the_visible_page_is_refreshed(
    plain: MainWindow, copy_sample: CopySample, qtbot: QtBot
):
    plain.files.open(copy_sample("thumb_tack"))
    surface = plain_page(plain)
    plain.show_step("setup")
    settle(plain, qtbot)
    setup, surface_count = plain_page(plain), surface.refreshed
    assert surface.left == 1
    count = setup.refreshed
    plain.workspace.attempt(lambda s: s.set_record(replace(s.record, title="Another")))
    assert setup.refreshed == count + 1
    settle(plain, qtbot)
    plain.workspace.show_frame(1)
    assert setup.refreshed == count + 2
    assert surface.refreshed == surface_count


def test_rapid_changes_are_refreshed_together(
    plain: MainWindow, copy_sample: CopySample, qtbot: QtBot
):
    plain.files.open(copy_sample("thumb_tack"))
    settle(plain, qtbot)
    page = plain_page(plain)
    page.refresh = lambda: (time.sleep(0.01), setattr(page, "refreshed", page.refreshed + 1))  # type: ignore[method-assign]
    before = page.refreshed
    for number in range(50):
        plain.workspace.attempt(lambda s, n=number: s.set_record(replace(s.record, title=f"{n}")))
    assert page.refreshed - before < 10
    settle(plain, qtbot)
    assert plain.menus.actions["undo"].text() == "&Undo experiment record"


def test_undo_and_redo_name_the_change(plain: MainWindow, copy_sample: CopySample, qtbot: QtBot):
    plain.files.open(copy_sample("thumb_tack"))
    plain.workspace.attempt(lambda s: s.set_record(replace(s.record, title="Another")))
    settle(plain, qtbot)
    actions = plain.menus.actions
    assert actions["undo"].text() == "&Undo experiment record"
    assert not actions["redo"].isEnabled()
    actions["undo"].trigger()
    settle(plain, qtbot)
    assert plain.workspace.session is not None
    assert plain.workspace.session.record.title == "Thumb tack of §8.2"
    assert actions["redo"].text() == "&Redo experiment record"
    actions["redo"].trigger()
    assert plain.workspace.session.record.title == "Another"
    assert "Redone: experiment record" in plain.status_line.message.text()


def test_keys_move_through_frames_and_steps(
    plain: MainWindow, copy_sample: CopySample, qtbot: QtBot
):
    plain.files.open(copy_sample("blocked_rows"))
    plain.activateWindow()
    plain_page(plain).setFocus()
    steps = [(Qt.Key.Key_Right, 1), (Qt.Key.Key_End, 5), (Qt.Key.Key_Left, 4), (Qt.Key.Key_Home, 0)]
    for key, frame in steps:
        qtbot.keyClick(plain, key)
        assert plain.workspace.frame == frame
    for name, frame in [
        ("next_doubtful", 3),
        ("next_doubtful", 4),
        ("previous_corrected", 2),
        ("previous_corrected", 2),
    ]:
        plain.do(name)
        assert plain.workspace.frame == frame
    assert "No frame before this one is corrected by hand" in plain.status_line.message.text()
    plain.do("previous_step")
    assert plain_page(plain).key == "dots"
    plain.do("step_setup")
    assert plain.step_list.currentRow() == 0
    plain.step_list.setCurrentRow(6)
    assert plain_page(plain).key == "surface"


def test_a_key_of_no_step_shows_nothing_new(plain: MainWindow, copy_sample: CopySample):
    plain.files.open(copy_sample("blocked_rows"))
    before = plain.page
    plain.show_step("")
    assert plain.page is before


def test_space_plays_and_arrow_keys_in_a_field_keep_the_frame(
    plain: MainWindow, copy_sample: CopySample, qtbot: QtBot
):
    plain.files.open(copy_sample("gtaw"))
    plain_page(plain).setFocus()
    qtbot.keyClick(plain, Qt.Key.Key_Space)
    assert plain.timeline.playing
    qtbot.waitUntil(lambda: plain.workspace.frame > 2)
    plain.say("The recording is gone", True)
    assert not plain.timeline.playing
    frame = plain.workspace.frame
    editor = plain.timeline.number.lineEdit()
    qtbot.keyClick(editor, Qt.Key.Key_Home)
    qtbot.keyClick(editor, Qt.Key.Key_Right)
    assert plain.workspace.frame == frame


def test_messages_end_with_the_session_but_problems_stay(
    plain: MainWindow, copy_sample: CopySample
):
    plain.files.open(copy_sample("thumb_tack"))
    plain.say("Undone: something")
    plain.files.close()
    assert plain.status_line.message.text() == ""
    plain.say("The disk is full", True)
    plain.files.open(copy_sample("gtaw"))
    assert "The disk is full" in plain.status_line.message.text()


def test_new_session_scrolls_panels_to_the_top(
    window: MainWindow, copy_sample: CopySample, qtbot: QtBot
):
    window.files.open(copy_sample("gtaw"))
    window.show_step("dots")
    bar = window.side_panel.stack.currentWidget().verticalScrollBar()
    qtbot.waitUntil(lambda: bar.maximum() > 0)
    bar.setValue(bar.maximum())
    window.files.open(copy_sample("blocked_rows"))
    window.show_step("dots")
    assert bar.value() == 0


def test_repeated_messages_are_counted_on_one_line(plain: MainWindow):
    before = plain.log_panel.count()
    for _ in range(3):
        plain.say("the camera was unplugged", True)
    plain.say("it is back")
    plain.say("the camera was unplugged", True)
    first, back, again = plain.log_panel.texts()[before:]
    assert "▲ the camera was unplugged (3 times since " in first
    assert back.endswith("  it is back")
    assert again.endswith("  ▲ the camera was unplugged")
    # The status line shows one problem, the last.
    assert plain.status_line.unread == ["the camera was unplugged"]
    plain.say("the disk is full", True)
    plain.say("the camera was unplugged", True)
    assert plain.status_line.unread == ["the disk is full", "the camera was unplugged"]
    assert plain.status_line.message.text() == "▲ the camera was unplugged (2 problems)"


def test_status_line_keeps_its_height_with_a_problem(plain: MainWindow):
    height = plain.status_line.minimumHeight()
    plain.say("The disk is full:\nnothing\ncan be\nwritten", True)
    assert plain.status_line.dismiss_button.isVisible()
    assert plain.status_line.sizeHint().height() <= height
    assert plain.status_line.message.minimumSizeHint().height() <= height


def test_tall_pages_do_not_enlarge_the_window(
    plain: MainWindow, copy_sample: CopySample, qtbot: QtBot
):
    plain.files.open(copy_sample("thumb_tack"))
    plain.resize(plain.width(), 512)  # 768 px at 150 %
    for key in ("setup", "surface"):
        plain.show_step(key)
        plain_page(plain).setMinimumHeight(2000)
    plain.do("log")
    settle(plain, qtbot)
    assert plain.log_panel.isVisible()
    assert plain.minimumSizeHint().height() <= 512
    assert plain.height() == 512


def test_failing_page_is_reported_and_the_window_stays_open(
    plain: MainWindow, copy_sample: CopySample, qtbot: QtBot
):
    plain.files.open(copy_sample("thumb_tack"))
    plain.show_step("export")
    assert "RuntimeError: no export today" in problems(plain)[0]
    assert "no export today" in plain.status_line.message.text()
    plain.show_step("surface")
    assert plain_page(plain).key == "surface"
    plain.status_line.show_button.click()
    assert plain.log_panel.isVisible()
    assert plain.status_line.unread == []
    plain.status_line.show_button.click()
    assert not plain.log_panel.isVisible()


def test_session_in_use_is_offered_read_only(
    plain: MainWindow, copy_sample: CopySample, qtbot: QtBot
):
    path = copy_sample("thumb_tack")

    def answer(accept: bool) -> None:
        box = QApplication.activeModalWidget()
        assert isinstance(box, QMessageBox)
        chosen = box.defaultButton() if accept else box.button(QMessageBox.StandardButton.Cancel)
        chosen.click()

    with Session.open(path):
        QTimer.singleShot(50, lambda: answer(False))
        assert not plain.files.open(path)
        assert plain.workspace.session is None
        QTimer.singleShot(50, lambda: answer(True))
        assert plain.files.open(path)
        assert plain.windowTitle() == "thumb_tack (read-only) — labapp"
        assert not plain.workspace.attempt(lambda s: s.set_record(Record()))
        assert "read-only" in problems(plain)[0]
        assert not plain.menus.actions["undo"].isEnabled()


def test_invalid_session_files_are_rejected(plain: MainWindow, tmp_path: Path):
    (tmp_path / "a.labsession").write_bytes(b"nonsense")
    assert not plain.files.open(tmp_path / "a.labsession")
    assert not plain.files.open(tmp_path / "gone.labsession")
    assert len(problems(plain)) == 2
    assert plain.stack.currentWidget() is plain.welcome
    assert "gone.labsession" in plain.welcome.refused.text()


def drop(window: MainWindow, qtbot: QtBot, *paths: Path) -> None:
    data = QMimeData()
    data.setUrls([QUrl.fromLocalFile(str(path)) for path in paths])
    window.dropEvent(
        QDropEvent(
            QPointF(50, 50),
            Qt.DropAction.CopyAction,
            data,
            Qt.MouseButton.LeftButton,
            Qt.KeyboardModifier.NoModifier,
        )
    )
    let_draw()


def test_dropped_files_are_opened_or_imported(
    plain: MainWindow,
    copy_sample: CopySample,
    tmp_path: Path,
    qtbot: QtBot,
    monkeypatch: pytest.MonkeyPatch,
):
    path = copy_sample("gtaw")
    monkeypatch.setattr(dialogs, "ask_new_session", lambda *_: pytest.fail("a name is asked for"))
    recording = path.parent / "recording.avi"
    drop(plain, qtbot, recording)
    settle(plain, qtbot)
    session = plain.workspace.session
    assert session is not None
    assert session.path == drafts_folder() / "recording.labsession"
    assert plain_page(plain).key == "capture"
    assert plain_page(plain).taken == [(recording, True)]
    drop(plain, qtbot, path.parent)
    assert plain_page(plain).taken[1:] == [(path.parent, False)]
    drop(plain, qtbot, path)
    assert plain.workspace.session.path == path
    drop(plain, qtbot, path, recording)
    assert "Drop one file" in problems(plain)[0]
    drop(plain, qtbot, tmp_path / "gone.avi")
    assert "does not exist" in problems(plain)[1]


def test_file_that_is_no_recording_creates_no_draft(
    plain: MainWindow, tmp_path: Path, qtbot: QtBot
):
    (tmp_path / "notes.txt").write_text("no recording")
    plain.files.take(tmp_path / "notes.txt")
    settle(plain, qtbot)
    assert plain.workspace.session is None
    assert drafts() == []
    assert "notes.txt" in plain.welcome.refused.text()


def test_copied_session_finds_its_recording(
    plain: MainWindow,
    copy_sample: CopySample,
    tmp_path: Path,
    qtbot: QtBot,
    monkeypatch: pytest.MonkeyPatch,
):
    plain.files.open(copy_sample("gtaw"))
    plain.workspace.attempt(lambda s: s.set_record(replace(s.record, title="Mine")))
    target = tmp_path / "elsewhere" / "copy.labsession"
    target.parent.mkdir()
    monkeypatch.setattr(dialogs, "ask_new_session", lambda *_: target)
    plain.do("copy")
    settle(plain, qtbot)
    assert f"A copy is in {target}" in plain.status_line.message.text()
    with Session.open(target) as copy:
        assert copy.record.title == "Mine"
        assert copy.missing_recording is None
        assert copy.frame(3).image.shape == (640, 480)
        assert copy.problems() == []
    assert sorted(p.name for p in target.parent.iterdir() if "lock" not in p.name) == [target.name]
    plain.do("copy")
    settle(plain, qtbot)
    assert "is there already" in problems(plain)[0]


def test_actions_are_of_the_present_state(plain: MainWindow, copy_sample: CopySample):
    plain.files.open(copy_sample("gtaw"))
    page = plain_page(plain)
    plain._rest.start(60_000)  # the display of a change is due later
    plain.workspace.changed.emit()
    before = page.refreshed
    plain.do("undo")
    assert page.refreshed == before
    plain.do("copy_picture")
    assert page.refreshed == before + 1


def test_copy_needs_a_valid_new_name(copy_sample: CopySample, tmp_path: Path):
    path = copy_sample("thumb_tack")
    for bad in (path, tmp_path / "copy.txt", tmp_path / "no" / "folder.labsession"):
        with pytest.raises(InputError) as refused:
            copy_session(path, bad)
        assert "Errno" not in str(refused.value)
    assert not (tmp_path / "no").exists()


def test_sample_copy_is_created_once_and_keeps_changes(tmp_path: Path):
    for name in ("gtaw", "concave"):
        path = copied_sample(name, tmp_path / name)
        with Session.open(path) as session:
            session.frame(0)
            session.set_record(replace(session.record, title="Mine"))
        assert copied_sample(name, tmp_path / name) == path
        with Session.open(path) as session:
            assert session.record.title == "Mine"
            assert session.problems() == []


@pytest.mark.parametrize("name", sorted(SAMPLE_TEXTS))
def test_sample_button_opens_a_copy(
    plain: MainWindow, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
):
    monkeypatch.setattr(Preferences, "samples_folder", tmp_path / "documents")
    plain.welcome.samples[name].click()
    session = plain.workspace.session
    assert session is not None
    assert session.path == tmp_path / "documents" / name / f"{name}.labsession"
    assert session.record.title == SAMPLE_TEXTS[name].title
    assert "copy of the sample" in plain.status_line.message.text()


def test_recent_sessions_are_shared_between_windows(
    window: MainWindow, tmp_path: Path, qtbot: QtBot
):
    file = tmp_path / "config" / "preferences.json"
    first, second = tmp_path / "own.labsession", tmp_path / "other.labsession"
    for path in (first, second):
        Session.create(path).close()
    window.files.open(first)
    window.do("close")
    other = make_window(read_preferences(file)[0], file)
    KEPT.append(other)
    other.show()
    other.activateWindow()
    qtbot.waitUntil(other.isActiveWindow)
    other.files.open(second)
    window.activateWindow()
    qtbot.waitUntil(lambda: window.welcome.list.count() == 2)
    settle(window, qtbot)
    assert [action.toolTip() for action in window.menus.recent.actions()] == [
        str(second),
        str(first),
    ]
    window.do("theme_light")
    other.close()
    window.close()
    preferences = read_preferences(file)[0]
    assert (preferences.recent, preferences.theme) == ((str(second), str(first)), "light")


def test_layout_and_theme_are_stored(plain: MainWindow, copy_sample: CopySample, tmp_path: Path):
    path = copy_sample("thumb_tack")
    plain.files.open(path)
    plain.resize(798, 555)
    plain.do("steps")
    plain.do("log")
    plain.do("theme_dark")
    plain.close()
    preferences, problem = read_preferences(tmp_path / "preferences.json")
    assert problem == ""
    assert (preferences.theme, preferences.recent) == ("dark", (str(path),))
    again = make_window(preferences, tmp_path / "preferences.json")
    KEPT.append(again)
    again.show()
    assert again.size().height() == 555
    again.files.open(path)
    assert not again._docks["steps"].isVisible()
    assert not again._docks["log"].isVisible()  # the earlier messages are not shown again
    again.do("reset_layout")
    assert again._docks["steps"].isVisible()
    again.close()


def test_invalid_layout_is_ignored(qapp: QApplication, tmp_path: Path):
    odd = Preferences(("/gone/x.labsession",), "dark", "ä no base64", "AAAAB3NzaC1yc2E=", "/gone")
    window = make_window(odd, tmp_path / "preferences.json")
    KEPT.append(window)
    window.show()
    assert window.isVisible()
    window.close()


def test_closing_stops_measuring_and_keeps_finished_frames(
    plain: MainWindow, copy_sample: CopySample, tmp_path: Path, qtbot: QtBot
):
    np.save(tmp_path / "dark.npy", np.zeros((2000, 48, 64), np.uint8))
    path = tmp_path / "dark.labsession"
    with Session.open(copy_sample("gtaw")) as sample, Session.create(path) as session:
        session.set_setup(sample.setup_text)
        session.update_setup({"image_calibration": {"frame_px": None}})
        session.import_recording(tmp_path / "dark.npy")
    plain.files.open(path)
    settle(plain, qtbot)
    plain.do("measure")
    task = plain.workspace.tasks.active[0]
    qtbot.waitUntil(lambda: task.done >= 5)
    assert plain.status_line.bar.isVisible()
    plain.do("measure_frame")
    assert "being measured already" in plain.status_line.message.text()
    plain.close()
    assert not task.thread.is_alive()
    with Session.open(path) as session:
        assert 5 <= 2000 - len(session.stale_frames()) < 2000
        assert session.problems() == []


def test_incomplete_setup_is_reported_before_measuring(plain: MainWindow, copy_sample: CopySample):
    plain.files.open(copy_sample("thumb_tack"))
    plain.workspace.attempt(lambda s: s.update_setup({"laser": {"distance_mm": None}}))
    plain.do("measure_frame")
    assert "distance of the laser" in problems(plain)[0]
    assert plain.workspace.tasks.active == []


def test_missing_recording_is_reported_on_opening(plain: MainWindow, copy_sample: CopySample):
    path = copy_sample("gtaw")
    (path.parent / "recording.avi").unlink()
    assert plain.files.open(path)
    assert "recording.avi" in problems(plain)[0]


def test_replaced_recording_is_reported_on_opening(plain: MainWindow, copy_sample: CopySample):
    path = copy_sample("gtaw")
    (path.parent / "recording.avi").write_bytes(b"another")
    assert plain.files.open(path)
    assert "recording.avi" in problems(plain)[0]


def test_copying_a_picture_and_a_table(plain: MainWindow, copy_sample: CopySample):
    from PySide6.QtWidgets import QTableWidget, QTableWidgetItem

    plain.files.open(copy_sample("thumb_tack"))
    plain.do("copy_table")
    assert plain.status_line.message.text() == "This step has no table"
    table = QTableWidget(2, 2)
    table.setHorizontalHeaderLabels(["Quantity", "mm"])
    for row, cells in enumerate([("Width", "6.66"), ("Height", "0.294")]):
        for column, text in enumerate(cells):
            table.setItem(row, column, QTableWidgetItem(text))
    plain_page(plain).panel_layout.addWidget(table)
    table.show()
    plain.do("copy_table")
    assert QApplication.clipboard().text() == "Quantity\tmm\nWidth\t6.66\nHeight\t0.294"
    assert table_text(table) == QApplication.clipboard().text()
    plain.do("copy_picture")
    assert QApplication.clipboard().pixmap().width() == plain_page(plain).width()


def test_first_step_and_first_frame(copy_sample: CopySample, tmp_path: Path):
    with Session.create(tmp_path / "new.labsession") as session:
        assert first_step(session) == "setup"
        assert title(session) == "new — labapp"
    with Session.open(copy_sample("gtaw")) as session:
        assert first_step(session) == "surface"
        (tmp_path / "setup.toml").write_text(session.setup_text, "utf-8")
        with Session.create(tmp_path / "other.labsession") as other:
            other.set_setup(session.setup_text)
            assert first_step(other) == "capture"
            assert first_frame(other) is None
        assert first_frame(session) == 0


def test_session_opens_at_the_first_measured_frame(plain: MainWindow, copy_sample: CopySample):
    plain.files.open(copy_sample("five_lines"))
    session = plain.workspace.session
    assert session.result(0).measurement.status != "ok"
    assert plain.page.key == "surface"
    assert session.result(plain.workspace.frame).measurement.status == "ok"
    plain.files.open(copy_sample("gmaw"))
    assert first_step(plain.workspace.session) == "trends"  # one line gives no surface


def test_marks_of_steps_differ_in_words_and_shape(
    qapp: QApplication, copy_sample: CopySample, qtbot: QtBot
):
    step_list = StepList(STEPS)
    qtbot.addWidget(step_list)
    with Session.open(copy_sample("blocked_rows")) as session:
        step_states = states(session)
        step_list.show_states(step_states)
    for row, step in enumerate(STEPS):
        item = step_list.item(row)
        assert step_states[step.key].why in item.toolTip()
        assert step_states[step.key].mark.value in item.data(Qt.ItemDataRole.AccessibleTextRole)
    shapes = set()
    for mark in Mark:
        image = mark_icon(mark, False).pixmap(54, 54).toImage()
        alpha = [image.pixelColor(x, y).alpha() > 99 for x in range(54) for y in range(54)]
        shapes.add(tuple(alpha))
    assert len(shapes) == len(Mark)


def test_preview_of_a_session_does_not_change_it(copy_sample: CopySample, tmp_path: Path):
    path = copy_sample("concave")
    content = path.read_bytes()
    preview = look_at(path)
    assert preview.title == "A concave pool"
    assert "6 frames, all measured" in preview.about
    assert preview.thumbnail is not None
    assert np.ptp(preview.thumbnail) == 255
    assert path.read_bytes() == content
    shutil.rmtree(path.parent / "recording")
    without_recording = look_at(path)
    assert without_recording.there
    assert without_recording.thumbnail is None
    path.write_bytes(content[:5000])
    assert not look_at(path).there
    assert not look_at(tmp_path / "gone.labsession").there
    with Session.create(tmp_path / "new.labsession"):
        pass
    assert "no recording yet" in look_at(tmp_path / "new.labsession").about


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("gmaw", "96 frames, 58 measured, 38 pulses"),
        ("blocked_rows", "6 frames, 3 measured, 3 failed"),
    ],
)
def test_preview_counts_measured_and_failed_frames(name: str, words: str):
    assert look_at(SAMPLES / name / f"{name}.labsession").about.endswith(f" · {words}")


def test_uncaught_errors_are_logged_and_reported(plain: MainWindow, qtbot: QtBot):
    reporter = app.ErrorReporter(plain.say, plain)
    try:
        raise ZeroDivisionError("in a slot")
    except ZeroDivisionError as error:
        reporter.take(type(error), error, error.__traceback__)
    assert "ZeroDivisionError: in a slot" in problems(plain)[0]

    def fail_in_thread() -> None:
        try:
            raise ValueError("in a thread")
        except ValueError as error:
            reporter.take(type(error), error, error.__traceback__)

    thread = threading.Thread(target=fail_in_thread)
    thread.start()
    thread.join()
    qtbot.waitUntil(lambda: len(problems(plain)) == 2)
    log = log_file().read_text("utf-8")
    assert "Traceback" in log
    assert "in a thread" in log
    assert plain.isVisible()


def test_missing_display_or_file_is_reported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, state: Path
):
    with pytest.raises(InputError, match="does not exist"):
        app.main([str(tmp_path / "gone.avi")])
    for name in ("DISPLAY", "WAYLAND_DISPLAY", "QT_QPA_PLATFORM"):
        monkeypatch.delenv(name, raising=False)
    with pytest.raises(InputError, match="display"):
        app.main([])


def test_app_starts_opens_a_session_and_ends(
    qapp: QApplication,
    copy_sample: CopySample,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    state: Path,
):
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "config"))
    (tmp_path / "config" / "labapp").mkdir(parents=True)
    (tmp_path / "config" / "labapp" / "preferences.json").write_text("{broken")
    path = copy_sample("thumb_tack")
    shown: dict[str, object] = {}

    before = set(QApplication.topLevelWidgets())

    def look() -> None:
        for window in set(QApplication.topLevelWidgets()) - before:
            if isinstance(window, MainWindow):
                KEPT.append(window)
                shown["title"] = window.windowTitle()
                shown["problems"] = problems(window)
                window.close()

    QTimer.singleShot(500, look)
    assert app.main([str(path)]) == 0
    assert shown["title"] == "thumb_tack — labapp"
    assert "preferences file is damaged" in str(shown["problems"])


@pytest.mark.parametrize("way", ["close", "another session", "quit"])
def test_number_being_typed_is_stored_on_closing(
    window: MainWindow, copy_sample: CopySample, qtbot: QtBot, way: str
):
    path, other = copy_sample("thumb_tack"), copy_sample("blocked_rows")
    window.activateWindow()
    qtbot.waitUntil(window.isActiveWindow)
    for key, number in (("setup", "41.5"), ("dots", "5")):
        assert window.files.open(path)
        window.show_step(key)
        if key == "setup":
            field = window.pages[key].record_fields["voltage_v"]  # type: ignore[attr-defined]
        else:
            field = window.pages[key].dots_panel.numbers[0]  # type: ignore[attr-defined]
        field.editor.setFocus()
        qtbot.keyClick(field.editor, Qt.Key.Key_A, Qt.KeyboardModifier.ControlModifier)
        qtbot.keyClicks(field.editor, number)
        if way == "close":
            window.do("close")
        elif way == "another session":
            assert window.files.open(other)
        else:
            window.close()
        with Session.open(path, read_only=True) as session:
            stored = session.record.voltage_v, detector_value(session.settings, NUMBERS[0])
        assert stored[key == "dots"] == float(number)
        if way == "quit":
            return


def test_page_that_replaces_an_empty_one_gets_the_focus(
    window: MainWindow, copy_sample: CopySample, qtbot: QtBot
):
    """Otherwise the next key, such as Space to play, would go to an arbitrary field."""
    assert window.files.open(copy_sample("thumb_tack"))
    window.activateWindow()
    qtbot.waitUntil(window.isActiveWindow)
    window.show_step("surface")
    page = window.page
    assert page is not None
    window.stack.setCurrentWidget(window.empty)
    window.empty.setFocus()
    window._show_lead()
    assert window.stack.currentWidget() is page
    assert QApplication.focusWidget() is page


def test_window_fits_1024_px_at_150_percent(window: MainWindow, copy_sample: CopySample):
    assert window.files.open(copy_sample("thumb_tack"))
    for step in STEPS:
        window.show_step(step.key)
        minimum = window.minimumSizeHint()
        assert minimum.width() <= 1024 / 1.5
        assert minimum.height() <= 700 / 1.5
    window.resize(window.minimumSizeHint())
    let_draw()
    assert window.step_list.item(0).text() == "1"
    assert "Set-up" in window.step_list.item(0).toolTip()
    window.resize(1280, 800)
    let_draw()
    assert window.step_list.item(0).text() == "1  Set-up"
