"""Importing and measuring a long recording: progress, cancelling, resuming, killing."""

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

from labapp.gui.shell.frame_status import FrameStatus
from labapp.gui.shell.window import MainWindow
from labapp.media.survey import Survey, survey
from labapp.session import frames as frames_module
from labapp.session.session import Session
from tests.gui.conftest import SAMPLES
from tests.waiting import PATIENCE_S

FRAMES = 120
STOPS_AT = 40
"""The frame at which the task waits until the gate is opened."""

KILL = Path(__file__).with_name("kill.py")


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    """Dark frames of different grey levels: measured fast, as they have no dots."""
    path = tmp_path / "dark.npy"
    np.save(path, np.arange(FRAMES, dtype=np.uint8)[:, None, None] + np.zeros((1, 64, 64), "u1"))
    return path


@pytest.fixture
def session(window: MainWindow, tmp_path: Path) -> Session:
    window.workspace.show(Session.create(tmp_path / "long.labsession"))
    current = window.workspace.session
    assert current is not None
    current.set_setup((SAMPLES / "gtaw" / "setup.toml").read_text("utf-8"))
    return current


def idle(window: MainWindow, qtbot: QtBot) -> None:
    qtbot.waitUntil(lambda: not window.workspace.tasks.active)


def test_import_shows_progress_and_can_be_cancelled_and_repeated(
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
    page.slider.setValue(7)  # frames can be viewed meanwhile
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


def test_measuring_shows_progress_and_resumes_after_a_cancel(
    window: MainWindow,
    session: Session,
    recording: Path,
    qtbot: QtBot,
    monkeypatch: pytest.MonkeyPatch,
):
    session.import_recording(recording)
    window.workspace.changed.emit()
    gate, read = threading.Event(), list[int]()
    read_frame = session.frame

    def slow(number: int) -> Any:
        if threading.current_thread().name == "Measuring":
            read.append(number)
            if number == STOPS_AT:
                gate.wait(PATIENCE_S)
        return read_frame(number)

    monkeypatch.setattr(session, "frame", slow)
    window.show_step("trends")
    window.do("measure")
    line, kinds = window.status_line, window.timeline.scrubber
    qtbot.waitUntil(lambda: line.bar.value() > 0)
    qtbot.waitUntil(lambda: bool((kinds.kinds == FrameStatus.NOT_MEASURABLE).any()))
    assert line.bar.maximum() == FRAMES
    window.workspace.show_frame(STOPS_AT + 5)  # the window responds meanwhile
    assert window.timeline.scrubber.position == STOPS_AT + 5
    line.cancel_button.click()
    gate.set()
    idle(window, qtbot)
    status = session.overview().status
    measured = [number for number, word in enumerate(status) if word]
    assert 0 < len(measured) <= STOPS_AT
    assert measured == list(range(len(measured)))
    # The stored results are shown, though nothing follows them.
    qtbot.waitUntil(lambda: int((kinds.kinds != FrameStatus.NOT_MEASURED).sum()) == len(measured))
    read.clear()
    window.do("measure")
    idle(window, qtbot)
    assert read == list(range(len(measured), FRAMES))  # nothing is measured twice
    assert set(session.overview().status) == {"no-dots"}
    qtbot.waitUntil(lambda: int((kinds.kinds != FrameStatus.NOT_MEASURED).sum()) == FRAMES)
    assert session.problems() == []


@pytest.mark.soak
def test_killed_app_loses_no_finished_frame(tmp_path: Path):
    process = subprocess.run(
        [sys.executable, KILL, tmp_path, "4", "20261121"],
        capture_output=True,
        text=True,
        check=False,
    )
    assert process.returncode == 0, process.stderr
    summary = json.loads(process.stdout)
    assert summary["kills"] == 4
    assert summary["importing"] > 0
    assert summary["measured"] >= summary["measuring"] > 0
