"""The recording page: preview, importing, facts of the recording, a missing recording."""

from __future__ import annotations

import hashlib
import re
import shutil
import threading
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PySide6.QtWidgets import QAbstractButton, QLabel
from pytestqt.qtbot import QtBot

from labapp.core.images.exposure import judge_exposure
from labapp.core.images.find_dots import DotSettings
from labapp.errors import InputError
from labapp.gui import dialogs
from labapp.gui.pages.capture import page as capture_page_module
from labapp.gui.pages.capture.page import CapturePage
from labapp.gui.pages.capture.presenter import (
    Choice,
    Preview,
    choice_text,
    look,
    missing_text,
    recording_facts,
    refusal,
)
from labapp.gui.shell.steps import Mark, State, states
from labapp.gui.shell.window import MainWindow
from labapp.gui.widgets.exposure import BARS, bars
from labapp.gui.workspace import Workspace
from labapp.session.copies import next_session
from labapp.session.frame_size import calibrated_px, other_size
from labapp.session.record import Record
from labapp.session.session import Session
from labapp.text import format_bytes
from tests.gui.conftest import KEPT, CopySample
from tests.gui.hand import Hand
from tests.waiting import PATIENCE_S


@pytest.fixture
def stack(tmp_path: Path) -> Path:
    """Twelve small frames without a time base."""
    path = tmp_path / "stack.npy"
    np.save(path, np.random.default_rng(2).integers(0, 200, (12, 40, 50)).astype(np.uint8))
    return path


def test_preview_and_choice_of_frames(stack: Path, copy_sample) -> None:
    preview = Preview(stack)
    assert preview.frames == 12
    assert Choice(2, 9, 3).options["frames"] == "2:10:3"
    assert Choice(2, 9, 3).count == 3
    assert choice_text(preview, Choice(0, 11)) == (
        "12 of 12 frames; without a frame rate there are no times"
    )
    assert choice_text(preview, Choice(0, 11, 2, 100.0)).endswith("0.120 s at 100 frames/s")
    assert choice_text(preview, Choice(0, 11, 2, 1.0)).endswith("12.000 s at 1 frame/s")
    frame_view = preview.look(3, DotSettings())
    assert frame_view.image is not None
    assert frame_view.image.shape == (40, 50)
    assert "frame 3 (of 0 to 11)" in frame_view.title
    preview.close()
    with pytest.raises(InputError):
        Preview(stack.with_name("none.avi"))
    with Session.open(copy_sample("gtaw"), read_only=True) as session:
        assert "read-only" in refusal(session, Choice(0, 1), False)
    with Session.create(stack.with_name("a.labsession")) as session:
        assert refusal(None, None, False).startswith("Open or make")
        assert refusal(session, None, False).startswith("Choose a recording")
        assert refusal(session, Choice(3, 2), False).startswith("The last frame")
        assert refusal(session, Choice(0, 2), True).endswith("being imported")
        assert refusal(session, Choice(0, 2), False) == ""


def test_recording_facts(copy_sample) -> None:
    with Session.open(copy_sample("gtaw")) as session:
        recording = session.recording
        assert recording is not None
        facts = dict(recording_facts(recording))
        assert facts["Frames"] == "30 in the recording, used: all"
        assert re.fullmatch(r"\d{4}-\d\d-\d\d \d\d:\d\d", facts["Imported"])
        assert facts["Time base"] == "60 frames/s"
        assert facts["Seeking"] == "frame-exact"
        assert facts["SHA-256"] == recording.sha256
        assert facts["Size"] == "3.9 MB"
        other = replace(
            recording, selected=(2, 20, 3), rate_is_given=True, frame_exact=False, embedded=True
        )
        facts = dict(recording_facts(other))
        assert facts["Frames"] == "30 in the recording, used: 6, 2 to 19, every 3."
        assert facts["Time base"] == "60 frames/s (entered)"
        assert facts["Seeking"].startswith("not frame-exact")
        assert facts["Kept"] == "in the session itself"
        frame_view = look(session, 0)
        assert frame_view.exposure is not None
        assert frame_view.exposure.verdict == "good"
        assert len(bars(frame_view.exposure)) == len(BARS)
    assert [name for name, _ in BARS] == ["Exposure", "Saturation", "Contrast"]
    assert format_bytes(999) == "999 bytes"
    assert format_bytes(2_500_000_000) == "2.5 GB"
    blank = bars(judge_exposure(np.zeros((9, 9), np.uint8), None, 8))
    assert [part for part, _ in blank] == [0, 0, 0]


def test_exposure_of_lines_is_not_judged_as_that_of_dots(copy_sample) -> None:
    for name in ("five_lines", "gmaw"):
        with Session.open(copy_sample(name), read_only=True) as session:
            shown = look(session, 11)
        assert shown.image is not None
        assert shown.exposure is None


def test_exposure_of_dots_is_hidden_once_lines_are_open(copy_sample, qtbot: QtBot) -> None:
    workspace = Workspace()
    workspace.show(Session.open(copy_sample("gtaw"), read_only=True))
    page = make_page(workspace)
    qtbot.waitUntil(lambda: page.exposure.verdict.text().startswith("● Good."))
    recording = copy_sample("five_lines")
    workspace.show(Session.open(recording, read_only=True))
    page.refresh()
    qtbot.waitUntil(page.exposure.isHidden)
    qtbot.waitUntil(lambda: page.picture_view.picture is not None)
    qtbot.waitUntil(lambda: not workspace.tasks.active)
    page._judge()
    qtbot.waitUntil(lambda: not workspace.tasks.active)
    assert page.exposure.isHidden()
    page.take(recording.parent / "recording.avi")
    qtbot.waitUntil(lambda: page.preview is not None and not workspace.tasks.active)
    page._judge()
    qtbot.waitUntil(lambda: not workspace.tasks.active)
    assert page.exposure.isHidden()
    workspace.close()


def test_recording_replaced_by_another_can_be_located(
    copy_sample, tmp_path: Path, qtbot: QtBot
) -> None:
    path = copy_sample("gtaw")
    place = path.parent / "recording.avi"
    kept = place.rename(tmp_path / "kept.avi")
    place.write_bytes(b"another")
    workspace = Workspace()
    workspace.show(Session.open(path))
    page = make_page(workspace)
    session = session_of(page)
    assert session.missing_recording is None
    assert states(session)["capture"].mark is Mark.ATTENTION
    assert page.find_button.isVisibleTo(page.panel)
    page.relink(kept)
    qtbot.waitUntil(lambda: states(session)["capture"].mark is Mark.DONE)
    page.refresh()
    assert not page.find_button.isVisibleTo(page.panel)
    workspace.close()


def test_missing_recording_is_reported_by_frames(copy_sample) -> None:
    path = copy_sample("gtaw")
    (path.parent / "recording.avi").rename(path.parent / "moved.avi")
    with Session.open(path) as session:
        assert missing_text(session).startswith("recording.avi is missing")
        frame_view = look(session, 0)
        assert frame_view.image is None
        assert frame_view.words == "recording.avi is missing: locate it"


def make_page(workspace: Workspace) -> CapturePage:
    page = CapturePage(workspace)
    KEPT.extend((workspace, page))
    workspace.changed.connect(lambda: page.refresh() if workspace.session else None)
    workspace.frame_changed.connect(page.refresh)
    for widget in (page, page.panel):
        widget.resize(800, 600)
        widget.show()
    page.refresh()
    return page


NOTHING = State(Mark.READY, "No recording yet")


@pytest.fixture
def page(qtbot: QtBot, tmp_path: Path) -> CapturePage:
    workspace = Workspace()
    workspace.show(Session.create(tmp_path / "new.labsession"))
    yield make_page(workspace)
    workspace.close()


def session_of(page: CapturePage) -> Session:
    assert page.workspace.session is not None
    return page.workspace.session


def test_choosing_previewing_and_importing(page: CapturePage, stack: Path, qtbot: QtBot) -> None:
    assert page.picture_view.picture is None
    assert not page.chosen.isVisibleTo(page.panel)
    assert page.state(NOTHING) is NOTHING
    page.take(stack)
    qtbot.waitUntil(lambda: page.picture_view.picture is not None)
    assert session_of(page).recording is None
    assert "press Import" in page.state(NOTHING).why
    first = page.picture_view.picture
    page.slider.setValue(7)
    qtbot.waitUntil(lambda: "frame 7" in page.title.text())
    assert page.picture_view.picture is not first
    page.chosen.first.set_value(2)
    page.chosen.every.set_value(2)
    page.chosen.rate.set_value(50.0)
    page.chosen.rate.edited.emit(50.0)
    assert page.chosen.choice_words.text() == "5 of 12 frames, 0.200 s at 50 frames/s"
    page.chosen.import_button.click()
    assert not page.chosen.import_button.isEnabled()
    qtbot.waitUntil(lambda: session_of(page).recording is not None)
    qtbot.waitUntil(lambda: "of the session" in page.title.text())
    assert session_of(page).frames.tolist() == [2, 4, 6, 8, 10]
    assert page.workspace.frame == 2
    assert page.facts_group.isVisibleTo(page.panel)
    assert not page.chosen.isVisibleTo(page.panel)
    assert page.state(NOTHING) is NOTHING


def test_no_frame_after_the_last_can_be_chosen(
    page: CapturePage, stack: Path, qtbot: QtBot
) -> None:
    np.save(stack, np.zeros((1, 40, 50), np.uint8))
    page.take(stack)
    qtbot.waitUntil(lambda: page.preview is not None)
    for field, fewest in ((page.chosen.first, 0), (page.chosen.last, 0), (page.chosen.every, 1)):
        assert (field.lowest, field.highest) == (fewest, fewest)
    qtbot.waitUntil(lambda: not page.workspace.tasks.active)


def test_the_recording_chosen_last_is_previewed(
    page: CapturePage, stack: Path, qtbot: QtBot, monkeypatch: pytest.MonkeyPatch
) -> None:
    last, release = stack.with_name("last.npy"), threading.Event()
    shutil.copyfile(stack, last)

    def opened(path: Path) -> Preview:
        if path == stack:
            release.wait()
        return Preview(path)

    monkeypatch.setattr(capture_page_module, "Preview", opened)
    page.take(stack)
    page.take(last)
    qtbot.waitUntil(lambda: page.preview is not None)
    release.set()
    qtbot.waitUntil(lambda: not page.workspace.tasks.active)
    assert page.preview is not None
    assert page.preview.path == last


def test_cancelled_import_leaves_the_session_unchanged(
    page: CapturePage, stack: Path, qtbot: QtBot, monkeypatch
) -> None:
    page.take(stack)
    qtbot.waitUntil(lambda: page.preview is not None)
    started, resume = threading.Event(), threading.Event()
    progress = page.workspace.tasks.start.__globals__["Control"].progress

    def slow(control, done: int, total: int) -> None:
        started.set()
        resume.wait(PATIENCE_S)
        progress(control, done, total)

    monkeypatch.setattr("labapp.gui.tasks.Control.progress", slow)
    page.import_chosen()
    qtbot.waitUntil(started.is_set)
    assert page._importing is not None
    page._importing.cancel()
    resume.set()
    qtbot.waitUntil(lambda: not page.workspace.tasks.active)
    assert session_of(page).recording is None
    assert page.chosen.import_button.isEnabled()


def test_unreadable_recording_is_reported(page: CapturePage, tmp_path: Path, qtbot: QtBot) -> None:
    messages: list[tuple[str, bool]] = []
    page.workspace.notified.connect(lambda words, problem: messages.append((words, problem)))
    (tmp_path / "notes.txt").write_text("no video")
    page.take(tmp_path / "notes.txt")
    qtbot.waitUntil(lambda: bool(messages))
    assert messages[0][1]
    assert "notes.txt" in messages[0][0]
    assert page.preview is None


def test_cancelled_choice_restores_the_page(page: CapturePage, stack: Path, qtbot: QtBot) -> None:
    page.take(stack)
    qtbot.waitUntil(lambda: page.picture_view.picture is not None)
    page.cancel_choice()
    assert page.preview is None
    assert page.picture_view.picture is None
    assert session_of(page).recording is None


def test_missing_recording_can_be_located(copy_sample, tmp_path: Path, qtbot: QtBot) -> None:
    path = copy_sample("gtaw")
    moved = tmp_path / "elsewhere.avi"
    shutil.move(path.parent / "recording.avi", moved)
    workspace = Workspace()
    workspace.show(Session.open(path))
    page = make_page(workspace)
    messages: list[tuple[str, bool]] = []
    workspace.notified.connect(lambda words, problem: messages.append((words, problem)))
    assert page.find_button.isVisibleTo(page.panel)
    page.relink(path.parent / "calibration.png")
    qtbot.waitUntil(lambda: len(messages) == 1)
    assert messages[0][1]
    assert "another recording" in messages[0][0]
    page.relink(moved)
    qtbot.waitUntil(lambda: page.picture_view.picture is not None)
    assert not page.find_button.isVisibleTo(page.panel)
    qtbot.waitUntil(lambda: page.exposure.verdict.text().startswith("● Good."))
    workspace.close()


def test_every_button_has_a_tooltip(page: CapturePage) -> None:
    for button in page.panel.findChildren(QAbstractButton):
        if button.text():
            assert button.toolTip(), button.text()


# --- a second recording ---------------------------------------------------------------------------


def test_second_recording_needs_a_new_session(
    window: MainWindow, copy_sample: CopySample, tmp_path: Path, qtbot: QtBot
):
    first = copy_sample("thumb_tack")
    window.files.open(first)
    window.workspace.attempt(lambda session: session.set_record(Record(operator="A. Welder")))
    before = hashlib.sha256(first.read_bytes()).hexdigest()
    window.show_step("capture")
    window.activateWindow()
    qtbot.waitUntil(window.isActiveWindow)
    page, hand = window.page, Hand(window)
    previous, setup = window.workspace.session, window.workspace.session.setup_text
    assert not page.chosen.isVisible()
    page.take(first.parent / "recording.tif")
    qtbot.waitUntil(lambda: page.preview is not None)
    assert "needs its own session" in page.chosen.replace_words.text()
    assert page.chosen.replace_words.isVisible()
    assert not page.chosen.import_button.isEnabled()
    second = tmp_path / "second.labsession"
    hand.answer(second)
    hand.button("New session from this recording…")
    qtbot.waitUntil(lambda: window.workspace.session is not previous)
    session = window.workspace.session
    assert session.path == second
    qtbot.waitUntil(lambda: session.recording is not None)
    qtbot.waitUntil(lambda: not window.workspace.tasks.active)
    assert session.record.operator == "A. Welder"
    assert session.setup_text == setup
    assert not page.chosen.isVisible()
    assert window.page is page
    assert window.preferences.current.recent[0] == str(second)
    assert hashlib.sha256(first.read_bytes()).hexdigest() == before


def test_cancelled_new_session_changes_nothing(
    window: MainWindow, copy_sample: CopySample, qtbot: QtBot, monkeypatch: pytest.MonkeyPatch
):
    window.files.open(copy_sample("thumb_tack"))
    window.show_step("capture")
    page, previous = window.page, window.workspace.session
    page.take(previous.path.parent / "recording.tif")
    qtbot.waitUntil(lambda: page.preview is not None)
    monkeypatch.setattr(dialogs, "ask_new_session", lambda *_: None)
    page.chosen.next_button.click()
    assert window.workspace.session is previous
    assert page.preview is not None
    # An existing session is rejected and stays unchanged.
    monkeypatch.setattr(dialogs, "ask_new_session", lambda *_: previous.path)
    page.chosen.next_button.click()
    assert window.workspace.session is previous
    assert window.status_line.unread


# --- calibrated with another region ---------------------------------------------------------------


def test_frame_size_other_than_calibrated_is_reported(
    window: MainWindow, copy_sample: CopySample, tmp_path: Path, qtbot: QtBot
):
    first = copy_sample("thumb_tack")
    with Session.open(first) as measured:
        next_session(measured, tmp_path / "next.labsession").close()
    window.files.open(tmp_path / "next.labsession")
    window.show_step("capture")
    page, session = window.page, window.workspace.session
    assert calibrated_px(session) == (480, 460)
    session.import_recording(first.parent / "recording.tif")
    window.workspace.changed.emit()

    def facts() -> str:
        return " ".join(label.text() for label in page.facts_group.findChildren(QLabel))

    qtbot.waitUntil(lambda: "recording.tif" in facts())
    assert "calibrated with" not in facts()
    qtbot.waitUntil(lambda: not window.workspace.tasks.active)
    half = tmp_path / "half.npy"
    np.save(half, np.zeros((2, 240, 460), np.uint8))
    page.take(half)
    qtbot.waitUntil(lambda: page.preview is not None)
    page.import_chosen()
    qtbot.waitUntil(lambda: "frames have 460×240 px" in page.answer.text())
    qtbot.waitUntil(lambda: "a picture of 460×480 px, and frames have 460×240 px" in facts())
    # A calibration that is not in use is not compared.
    point = {"image_calibration": {"origin_px": [1.0, 2.0]}}
    window.workspace.attempt(lambda session: session.update_setup(point))
    assert calibrated_px(session) is None
    qtbot.waitUntil(lambda: "calibrated with" not in facts())
    qtbot.waitUntil(lambda: not window.workspace.tasks.active)
    assert other_size(None, (1, 2)) == other_size((1, 2), (1, 2)) == ""
