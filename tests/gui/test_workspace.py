"""Measuring that is cancelled because another session is opened is not an error."""

from __future__ import annotations

import logging
import threading
from collections.abc import Iterator
from concurrent.futures import Executor, Future
from dataclasses import replace
from typing import Any

import pytest
from PySide6.QtWidgets import QApplication
from pytestqt.qtbot import QtBot

from labapp.gui.tasks import DONE, PROBLEM
from labapp.gui.workspace import Workspace, measured_text
from labapp.log import NAME
from labapp.run import measurers
from labapp.session.session import Session
from labapp.simulation import parallel
from tests.gui.conftest import CopySample
from tests.gui.watching import FaultHandler
from tests.waiting import PATIENCE_S


class Stuck(Executor):
    """Never measures anything; its futures are cancelled when it is ended."""

    def __init__(self) -> None:
        self.begun: list[Future[Any]] = []

    def submit(self, *_: object, **__: object) -> Future[Any]:
        self.begun.append(Future())
        return self.begun[-1]

    def end(self) -> None:
        for future in self.begun:
            future.cancel()


def test_followed_frames_and_pulses_are_no_failures(
    qapp: QApplication, state: object, copy_sample: CopySample, qtbot: QtBot
) -> None:
    workspace = Workspace()
    messages: list[str] = []
    workspace.notified.connect(lambda words, _: messages.append(words))
    workspace.show(Session.open(copy_sample("gmaw")))
    answers: list[str] = []
    with qtbot.waitSignal(workspace.notified):
        workspace.measure(range(12), show_answer=answers.append)
    assert messages == ["12 frames measured"]
    assert answers[-1] == f"{DONE} 12 frames measured"
    workspace.close()


@pytest.mark.parametrize(
    ("change", "words", "mark"),
    [
        ({"correspondence": "S/S"}, measured_text(1, 0, 1), PROBLEM),
        ({"scheme": "ers"}, measured_text(1, 0, 0, "fit"), DONE),
    ],
)
def test_change_of_the_settings_while_measuring_is_reported(
    qapp: QApplication, state: object, copy_sample: CopySample, qtbot: QtBot,
    monkeypatch: pytest.MonkeyPatch, change: dict[str, str], words: str, mark: str,
) -> None:  # fmt: skip
    workspace, begun, changed = Workspace(), threading.Event(), threading.Event()
    workspace.show(Session.open(copy_sample("thumb_tack")))
    session = workspace.session
    measure_each = session.measure_each

    def held(numbers: list[int], pool: object, *, warm: bool) -> Iterator[tuple[int, Any]]:
        for each in measure_each(numbers):
            begun.set()
            changed.wait(PATIENCE_S)
            yield each

    monkeypatch.setattr(session, "measure_each", held)
    answers: list[str] = []
    workspace.measure([0], show_answer=answers.append)
    qtbot.waitUntil(begun.is_set)
    assert workspace.attempt(lambda own: own.set_settings(replace(own.settings, **change)))
    with qtbot.waitSignal(workspace.notified) as told:
        changed.set()
    assert told.args[0] == words != measured_text(1, 0, 0)
    assert answers[-1].startswith(mark)
    workspace.close()


def test_frames_without_a_surface_do_not_count_as_measured():
    assert measured_text(3, 0, 0).startswith("3 frames")
    assert measured_text(3, 2, 0).startswith("1 frame ")


def test_reason_of_a_refused_change_begins_with_a_capital_letter(
    qapp: QApplication, state: object, copy_sample: CopySample, qtbot: QtBot
) -> None:
    def refuse(_: Session) -> None:
        raise ValueError("rows cross")

    workspace = Workspace()
    workspace.show(Session.open(copy_sample("thumb_tack")))
    with qtbot.waitSignal(workspace.notified) as told:
        assert not workspace.attempt(refuse)
    assert told.args[0] == "Rows cross"
    workspace.close()


def test_measuring_cancelled_by_another_session_is_no_fault(
    qapp: QApplication, state: object, copy_sample: CopySample, qtbot: QtBot,
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    faults: list[str] = []
    stuck, handler, log = Stuck(), FaultHandler(faults), logging.getLogger(NAME)
    monkeypatch.setattr(measurers, "measuring_pool", lambda _: stuck)
    monkeypatch.setattr(parallel, "end_processes", Stuck.end)
    log.addHandler(handler)
    workspace = Workspace()
    messages: list[str] = []
    workspace.notified.connect(lambda words, _: messages.append(words))
    workspace.show(Session.open(copy_sample("blocked_rows")))
    workspace.measure([0, 1, 2])
    task = workspace.measuring
    assert task is not None
    qtbot.waitUntil(lambda: bool(stuck.begun))
    workspace.show(None)
    task.thread.join()
    log.removeHandler(handler)
    assert faults == []
    assert messages == []
    assert task.control.cancelled.is_set()
