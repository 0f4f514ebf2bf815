"""Importing and measuring a long recording: watched, cancelled, gone on with, killed."""

from __future__ import annotations

import json
import subprocess
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pytestqt.qtbot import QtBot

from labapp.gui.shell.standing import FrameStatus
from labapp.gui.shell.window import MainWindow
from labapp.media.survey import Survey, survey
from labapp.session import frames as frames_module
from labapp.session.session import Session
from tests.gui.conftest import SAMPLES
from tests.waiting import PATIENCE_S

FRAMES = 120
STOPS_AT = 40
"""Long work waits there until the gate is opened."""

KILL = Path(__file__).with_name("kill.py")


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    """Dark frames, each of another grey: measured at once, as they hold no dots."""
    path = tmp_path / "dark.npy"
    np.save(path, np.arange(FRAMES, dtype=np.uint8)[:, None, None] + np.zeros((1, 64, 64), "u1"))
    return path


@pytest.fixture
def session(window: MainWindow, tmp_path: Path) -> Session:
    window.workspace.show(Session.create(tmp_path / "long.labsession"))
    made = window.workspace.session
    assert made is not None
    made.set_setup((SAMPLES / "gtaw" / "setup.toml").read_text("utf-8"))
    return made


def idle(window: MainWindow, qtbot: QtBot) -> None:
    qtbot.waitUntil(lambda: not window.workspace.tasks.active)


def test_an_import_is_watched_cancelled_and_done_again(
    window: MainWindow,
    session: Session,
    recording: Path,
    qtbot: QtBot,
    monkeypatch: pytest.MonkeyPatch,
):
    gate = threading.Event()

    def slow(source: Any, progress: Callable[[int, int], None]) -> Survey:
        def step(done: int, total: int) -> None:
            progress(done, total)
            if done == STOPS_AT:
                gate.wait(PATIENCE_S)

        return survey(source, step)

    monkeypatch.setattr(frames_module, "survey", slow)
    window.files.take(recording)
    page: Any = window.page
    qtbot.waitUntil(lambda: page.preview is not None and not window.workspace.tasks.active)
    page.import_chosen()
    line = window.status_line
    qtbot.waitUntil(lambda: line.bar.value() == STOPS_AT)
    assert line.title.text() == "Importing dark.npy"
    assert line.bar.maximum() > FRAMES  # some are read twice
    page.slider.setValue(7)  # it can be looked at meanwhile
    qtbot.waitUntil(lambda: page._seen is not None and page._seen[1] == 7)
    line.cancel_button.click()
    gate.set()
    idle(window, qtbot)
    assert not len(session.frames)
    assert session.recording is None
    assert session.problems() == []
    assert page.chosen.import_button.isEnabled()
    page.import_chosen()
    idle(window, qtbot)
    assert session.frames.tolist() == list(range(FRAMES))
    qtbot.waitUntil(lambda: len(window.timeline.scrubber.kinds) == FRAMES)


def test_measuring_is_watched_cancelled_and_gone_on_with(
    window: MainWindow,
    session: Session,
    recording: Path,
    qtbot: QtBot,
    monkeypatch: pytest.MonkeyPatch,
):
    session.import_recording(recording)
    window.workspace.changed.emit()
    gate, read = threading.Event(), list[int]()
    plainly = session.frame

    def slow(number: int) -> Any:
        if threading.current_thread().name == "Measuring":
            read.append(number)
            if number == STOPS_AT:
                gate.wait(PATIENCE_S)
        return plainly(number)

    monkeypatch.setattr(session, "frame", slow)
    window.show_step("trends")
    window.do("measure")
    line, kinds = window.status_line, window.timeline.scrubber
    qtbot.waitUntil(lambda: line.bar.value() > 0)
    qtbot.waitUntil(lambda: bool((kinds.kinds == FrameStatus.NOT_MEASURABLE).any()))
    assert line.bar.maximum() == FRAMES
    window.workspace.show_frame(STOPS_AT + 5)  # the window answers meanwhile
    assert window.timeline.scrubber.position == STOPS_AT + 5
    line.cancel_button.click()
    gate.set()
    idle(window, qtbot)
    status = session.overview().status
    kept = [number for number, word in enumerate(status) if word]
    assert 0 < len(kept) <= STOPS_AT
    assert kept == list(range(len(kept)))
    # What was kept is shown, though nothing follows it.
    qtbot.waitUntil(lambda: int((kinds.kinds != FrameStatus.NOT_MEASURED).sum()) == len(kept))
    read.clear()
    window.do("measure")
    idle(window, qtbot)
    assert read == list(range(len(kept), FRAMES))  # nothing is measured twice
    assert set(session.overview().status) == {"no-dots"}
    qtbot.waitUntil(lambda: int((kinds.kinds != FrameStatus.NOT_MEASURED).sum()) == FRAMES)
    assert session.problems() == []


@pytest.mark.soak
def test_killed_at_work_it_loses_no_frame_that_was_done(tmp_path: Path):
    answer = subprocess.run(
        [sys.executable, KILL, tmp_path, "4", "20261121"],
        capture_output=True,
        text=True,
        check=False,
    )
    assert answer.returncode == 0, answer.stderr
    told = json.loads(answer.stdout)
    assert told["kills"] == 4
    assert told["importing"] > 0
    assert told["measured"] >= told["measuring"] > 0
