"""Long work outside the GUI thread: progress, cancelling, and reporting and logging of errors.

A worker thread holds no QObject: it puts events into a queue, which a timer of the GUI thread
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
from labapp.text import capitalized

POLL_MS = 10

DONE, PROBLEM = "✓", "▲"
"""Symbols before a result shown at the pressed button; they are clear without colour, too."""

PROGRESS_MS = 100
"""Shortest interval, ms, between reports of progress."""

STOP_S = 5.0
"""Longest time, s, to wait for a cancelled task."""


class Cancelled(Exception):
    """The operator cancelled the task; raised in its work at the next report of progress."""


@dataclass
class Control:
    """Interface of a task to its work."""

    events: queue.SimpleQueue[tuple[str, Any]] = field(default_factory=queue.SimpleQueue)
    """Queue of the events."""
    reached: tuple[int, int] = (0, 0)
    """Progress: amount done, and total."""
    stage: str = ""
    """Current stage of the work; empty if it has no stages."""
    cancelled: threading.Event = field(default_factory=threading.Event)

    def progress(self, done: int, total: int, stage: str = "") -> None:
        """Report the progress of the work.

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
    """A running task."""

    title: str
    """Name of the work for the operator: "Measuring"."""
    control: Control
    thread: threading.Thread
    on_part: Callable[[Any], None] | None
    on_done: Callable[[Any], None] | None
    show_answer: Callable[[str], object] | None
    """These are called on the GUI thread with parts, the result, and the reason of a failure."""
    kind: str
    """Tasks of the same kind share a failure: "Exporting" for any folder."""
    is_lasting: bool
    """Whether it continues when another session is opened."""
    asked_to_stop: bool = False
    """Whether the operator cancelled it: a message follows when it has stopped."""

    @property
    def done(self) -> int:
        """Amount of work done."""
        return self.control.reached[0]

    @property
    def total(self) -> int:
        """Total amount of work; 0 while it is unknown."""
        return self.control.reached[1]

    def cancel(self) -> None:
        """Request the work to stop; finished parts are kept."""
        self.control.cancelled.set()

    def stop(self) -> None:
        """Cancel it at the operator's request."""
        self.asked_to_stop = True
        self.cancel()


class Tasks(QObject):
    """The tasks of a window."""

    changed = Signal()
    """A task began or ended."""
    progressed = Signal()
    """The progress of a task changed."""
    failed = Signal(str, str, str)
    """A task failed: its title, the message for the operator, and its kind."""
    stopped = Signal(str)
    """A task that the operator cancelled has stopped: its title."""
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
        show_answer: Callable[[str], object] | None = None,
        kind: str = "",
        is_lasting: bool = False,
    ) -> Task:
        """Start work in a separate thread.

        Parameters
        ----------
        work
            Called with its `Control`; touches no widget.
        on_done, on_part
            Called on the GUI thread with what ``work`` returns, and with each `Control.part`.
            Not called after a failure, nor once the work has noticed a cancel. Work that completes
            before it notices one has changed its session or files, and ``on_done`` says so.
        show_answer
            Also shows the reason of a failure at the pressed button; called with "" at the start.
        kind
            A failure is cleared when work of its kind starts again; empty: its title.
        is_lasting
            Whether it continues when another session is opened.
        """
        if show_answer is not None:
            show_answer("")
        control = Control()
        thread = threading.Thread(target=_run, args=(work, control), name=title, daemon=True)
        task = Task(
            title, control, thread, on_part, on_done, show_answer, kind or title, is_lasting
        )
        self.active.append(task)
        self.settled.emit(task.kind)
        thread.start()
        self._timer.start()
        self.changed.emit()
        return task

    def cancel_all(self, lasting: bool = True) -> None:
        """Cancel all tasks, or all but the lasting ones, and wait until they have stopped.

        No callback is called afterwards.
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
            # Only the events present now: user input is handled before later ones.
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
            if task.show_answer is not None:
                task.show_answer(f"{PROBLEM} {capitalized(value)}")
        elif kind == "done" and task.on_done is not None:
            task.on_done(value)
        elif kind == "cancelled" and task.asked_to_stop:
            self.stopped.emit(task.title)
        self.changed.emit()


def _run(work: Work, control: Control) -> None:
    try:
        control.events.put(("done", work(control)))
    except Cancelled:
        control.events.put(("cancelled", None))
    except Exception as error:
        if control.cancelled.is_set():  # its session may have been closed meanwhile
            logging.getLogger(NAME).info("after a cancel", exc_info=error)
            control.events.put(("cancelled", None))
        else:
            control.events.put(("failed", error_text(error)))


def error_text(error: Exception) -> str:
    """Message for an error; its traceback is logged."""
    log = logging.getLogger(NAME)
    if isinstance(error, InputError | CannotMeasure | ValueError):
        log.error("refused", exc_info=error)
        return error.reason if isinstance(error, CannotMeasure) else str(error)
    log.error("fault", exc_info=error)
    return f"a fault in the program: {type(error).__name__}: {error}; details are in the log"
