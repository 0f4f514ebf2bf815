"""What is open: measuring that ends because another session is wanted is no fault."""

from __future__ import annotations

import logging
from concurrent.futures import Executor, Future
from typing import Any

import pytest
from PySide6.QtWidgets import QApplication
from pytestqt.qtbot import QtBot

from labapp.gui.workspace import Workspace
from labapp.log import NAME
from labapp.run import measurers
from labapp.session.session import Session
from labapp.simulation import parallel
from tests.gui.conftest import CopySample
from tests.gui.watching import Noting


class Stuck(Executor):
    """Never measures anything; what waits for it is let go when it is ended."""

    def __init__(self) -> None:
        self.begun: list[Future[Any]] = []

    def submit(self, *_: object, **__: object) -> Future[Any]:
        self.begun.append(Future())
        return self.begun[-1]

    def end(self) -> None:
        for future in self.begun:
            future.cancel()


def test_measuring_that_is_left_for_another_session_is_no_fault(
    qapp: QApplication, state: object, copy_sample: CopySample, qtbot: QtBot,
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    faults: list[str] = []
    stuck, noting, log = Stuck(), Noting(faults), logging.getLogger(NAME)
    monkeypatch.setattr(measurers, "measuring_pool", lambda _: stuck)
    monkeypatch.setattr(parallel, "end_processes", Stuck.end)
    log.addHandler(noting)
    space = Workspace()
    said: list[str] = []
    space.notified.connect(lambda words, _: said.append(words))
    space.show(Session.open(copy_sample("blocked_rows")))
    space.measure([0, 1, 2])
    task = space.measuring
    assert task is not None
    qtbot.waitUntil(lambda: bool(stuck.begun))
    space.show(None)
    task.thread.join()
    log.removeHandler(noting)
    assert faults == []
    assert said == []
    assert task.control.cancelled.is_set()
