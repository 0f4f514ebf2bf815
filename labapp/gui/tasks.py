"""Long work off the GUI thread: progress, cancel, and errors in words and in the log.

A worker thread holds no QObject: it puts what happens into a queue, which a timer of the GUI thread
empties.
"""

from __future__ import annotations

import logging
import queue
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from PySide6.QtCore import QObject, QTimer, Signal

from labapp.core.values import CannotMeasure
from labapp.errors import InputError
from labapp.log import NAME

POLL_MS = 10

DONE, PROBLEM = "✓", "▲"
"""Before what came of work, beside what was pressed: shape says it as well as colour."""

PROGRESS_MS = 100
"""Progress is reported no more often."""

STOP_S = 5.0
"""Time, s, that a cancelled task is waited for."""


class Cancelled(Exception):
    """The operator has cancelled the task; raised in its work at the next report of progress."""


@dataclass
class Control:
    """What a task's work talks to."""

    events: queue.SimpleQueue[tuple[str, Any]] = field(default_factory=queue.SimpleQueue)
    """Receives its events."""
    reached: tuple[int, int] = (0, 0)
    """How far the work is: done, and in all."""
    stage: str = ""
    """What of it is being done; empty where it has no parts."""
    cancelled: threading.Event = field(default_factory=threading.Event)

    def progress(self, done: int, total: int, stage: str = "") -> None:
        """Say how far the work is.

        Raises
        ------
        Cancelled
            If the operator has cancelled it.
        """
        self.check()
        self.reached, self.stage = (done, total), stage

    def part(self, value: object) -> None:
        """Pass a part of the result to ``on_part``, on the GUI thread."""
        self.check()
        self.events.put(("part", value))

    def check(self) -> None:
        """Raise `Cancelled` if the operator has cancelled the task."""
        if self.cancelled.is_set():
            raise Cancelled


Work = Callable[[Control], Any]


@dataclass
class Task:
    """One piece of work under way."""

    title: str
    """What it does, for the operator: "Measuring"."""
    control: Control
    thread: threading.Thread
    on_part: Callable[[Any], None] | None
    on_done: Callable[[Any], None] | None
    beside: Callable[[str], object] | None
    """Called on the GUI thread with parts, with the result, and with why it failed."""
    kind: str
    """Tasks of one kind share a failure: "Exporting", whatever the folder."""
    is_lasting: bool
    """Whether it continues when another session is opened."""

    @property
    def done(self) -> int:
        """How much is done."""
        return self.control.reached[0]

    @property
    def total(self) -> int:
        """How much there is to do; 0 while that is not known."""
        return self.control.reached[1]

    def cancel(self) -> None:
        """Ask the work to stop; what it has finished stays."""
        self.control.cancelled.set()


class Tasks(QObject):
    """The tasks of a window."""

    changed = Signal()
    """A task began or ended."""
    progressed = Signal()
    """The progress of a task changed."""
    failed = Signal(str, str, str)
    """A task failed: its title, the message for the operator, and its kind."""
    settled = Signal(str)
    """Work of a kind begins again: an earlier failure no longer counts."""

    def __init__(self, parent: QObject | None = None) -> None:
        super().__init__(parent)
        self.active: list[Task] = []
        self._timer = QTimer(self, interval=POLL_MS)
        self._timer.timeout.connect(self._poll)
        self._reported: tuple[float, list[tuple[int, int]]] = (0.0, [])

    def start(
        self,
        title: str,
        work: Work,
        on_done: Callable[[Any], None] | None = None,
        on_part: Callable[[Any], None] | None = None,
        beside: Callable[[str], object] | None = None,
        kind: str = "",
        is_lasting: bool = False,
    ) -> Task:
        """Begin work in a thread of its own.

        Parameters
        ----------
        work
            Called with its `Control`; touches no widget.
        on_done, on_part
            Called on the GUI thread with what ``work`` returns, and with each `Control.part`.
            Not called after a cancel or a failure.
        beside
            Shows why it failed beside what was pressed, too; called with nothing at the beginning.
        kind
            A failure is forgotten when work of its kind begins again; empty: its title.
        is_lasting
            Whether it continues when another session is opened.
        """
        if beside is not None:
            beside("")
        control = Control()
        thread = threading.Thread(target=_run, args=(work, control), name=title, daemon=True)
        task = Task(title, control, thread, on_part, on_done, beside, kind or title, is_lasting)
        self.active.append(task)
        self.settled.emit(task.kind)
        thread.start()
        self._timer.start()
        self.changed.emit()
        return task

    def cancel_all(self, lasting: bool = True) -> None:
        """Cancel everything and wait until it has stopped; nothing is called afterwards.

        Parameters
        ----------
        lasting
            Whether tasks that are lasting are cancelled, too.
        """
        ended = [task for task in self.active if lasting or not task.is_lasting]
        for task in ended:
            task.cancel()
        for task in ended:
            task.thread.join(STOP_S)
            self.active.remove(task)
        if not self.active:
            self._timer.stop()
        self.changed.emit()

    def _poll(self) -> None:
        for task in list(self.active):
            # No more than there are now: what comes meanwhile waits for the hands.
            for _ in range(task.control.events.qsize()):
                if task in self.active:
                    self._take(task, *task.control.events.get_nowait())
        self._report_progress()
        if not self.active:
            self._timer.stop()

    def _report_progress(self) -> None:
        now, reached = time.monotonic(), [task.control.reached for task in self.active]
        if reached != self._reported[1] and (now - self._reported[0]) * 1000 >= PROGRESS_MS:
            self._reported = now, reached
            self.progressed.emit()

    def _take(self, task: Task, kind: str, value: Any) -> None:
        if kind == "part":
            if task.on_part is not None and not task.control.cancelled.is_set():
                task.on_part(value)
            return
        self.active.remove(task)
        if kind == "failed":
            self.failed.emit(task.title, value, task.kind)
            if task.beside is not None:
                task.beside(f"{PROBLEM} {value}")
        elif kind == "done" and task.on_done is not None:
            task.on_done(value)
        self.changed.emit()


def _run(work: Work, control: Control) -> None:
    try:
        control.events.put(("done", work(control)))
    except Cancelled:
        control.events.put(("cancelled", None))
    except Exception as error:
        if control.cancelled.is_set():  # what it worked on may have been closed under it
            logging.getLogger(NAME).info("after a cancel", exc_info=error)
            control.events.put(("cancelled", None))
        else:
            control.events.put(("failed", error_text(error)))


def error_text(error: Exception) -> str:
    """The message for an error; the log gets its traceback."""
    log = logging.getLogger(NAME)
    if isinstance(error, InputError | CannotMeasure | ValueError):
        log.error("refused", exc_info=error)
        return error.reason if isinstance(error, CannotMeasure) else str(error)
    log.error("fault", exc_info=error)
    return f"a fault in the program: {type(error).__name__}: {error}; details are in the log"
