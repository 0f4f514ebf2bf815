"""What a test leaves behind: threads, processes, running timers, open files."""

from __future__ import annotations

import multiprocessing
import os
import threading
import time
import traceback
import weakref
from pathlib import Path

import pytest
import shiboken6
from PySide6.QtCore import QThreadPool, QTimer
from PySide6.QtWidgets import QApplication

GRACE_S = 60.0
"""Time for what ends by itself, such as a terminated process."""

FILES = Path("/proc/self/fd")


class LeakCheck:
    """Compares threads, processes, timers and open files after a test with those before it.

    Parameters
    ----------
    folder
        Only files within it are checked.
    """

    def __init__(self, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        self._folder = folder.resolve()
        self._threads = set(threading.enumerate())
        self._processes = set(multiprocessing.active_children())
        self._files = self._open_files()
        self._timers: list[tuple[weakref.ref[QTimer], str]] = []
        started = QTimer.start

        def start(timer: QTimer, *args: int) -> None:
            caller = traceback.extract_stack(limit=2)[0]
            self._timers.append((weakref.ref(timer), f"{caller.filename}:{caller.lineno}"))
            started(timer, *args)

        monkeypatch.setattr(QTimer, "start", start)

    def leaks(self) -> list[str]:
        """Describe what is left; checked again until nothing is, or `GRACE_S` is over."""
        end = time.monotonic() + GRACE_S
        while (left := self._now()) and time.monotonic() < end:
            QApplication.processEvents()
            time.sleep(0.01)
        return left

    def _now(self) -> list[str]:
        threads = (
            f"thread {thread.name}"
            for thread in set(threading.enumerate()) - self._threads
            if not isinstance(thread, threading._DummyThread)
        )
        processes = (
            f"process {process.name}"
            for process in set(multiprocessing.active_children()) - self._processes
        )
        files = (f"open file {name}" for name in self._open_files() - self._files)
        pool = QThreadPool.globalInstance().activeThreadCount()
        return [*threads, *processes, *self._ticking(), *files, *["Qt's pool at work"][:pool]]

    def _ticking(self) -> list[str]:
        timers = ((reference(), where) for reference, where in self._timers)
        return [
            f"timer started at {where}"
            for timer, where in {timer: where for timer, where in timers if timer}.items()
            if shiboken6.isValid(timer) and timer.isActive()
        ]

    def _open_files(self) -> set[str]:
        names = set()
        for descriptor in os.listdir(FILES):
            try:
                name = os.readlink(FILES / descriptor)
            except FileNotFoundError:  # the descriptor of the listing itself
                continue
            if Path(name).is_relative_to(self._folder):
                names.add(name)
        return names
