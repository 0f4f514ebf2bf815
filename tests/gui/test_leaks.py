"""The check of what a test leaves behind."""

from __future__ import annotations

import multiprocessing
import re
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from PySide6.QtCore import QTimer

from labapp.session.session import Session
from tests.gui import leaks
from tests.gui.leaks import LeakCheck


@contextmanager
def thread(_: Path) -> Iterator[None]:
    end = threading.Event()
    left = threading.Thread(target=end.wait, name="left over")
    left.start()
    yield
    end.set()
    left.join()


@contextmanager
def process(_: Path) -> Iterator[None]:
    left = multiprocessing.get_context("spawn").Process(target=time.sleep, args=(60,))
    left.start()
    yield
    left.terminate()
    left.join()


@contextmanager
def timer(_: Path) -> Iterator[None]:
    left = QTimer()
    left.start(10)
    yield
    left.stop()


@contextmanager
def session(folder: Path) -> Iterator[None]:
    with Session.create(folder / "left.labsession"):
        yield


@pytest.mark.parametrize(
    ("leave", "words"),
    [
        (thread, "thread left over"),
        (process, "process SpawnProcess"),
        (timer, "timer started at .*test_leaks.py:"),
        (session, "open file .*left.labsession"),
    ],
)
def test_leftovers_are_found(
    leave, words: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(leaks, "GRACE_S", 0.05)
    check = LeakCheck(tmp_path, monkeypatch)
    assert check.leaks() == []
    with leave(tmp_path):
        assert any(re.match(words, leak) for leak in check.leaks())
    assert check.leaks() == []
