"""State of a window: the open session and the frame in view; signals report changes."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Sequence
from concurrent.futures import CancelledError, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

from PySide6.QtCore import QObject, Signal

from labapp.gui.drafts import folder_of
from labapp.gui.tasks import DONE, PROBLEM, Control, Task, Tasks, error_text
from labapp.session.results.statuses import is_failed
from labapp.simulation import parallel
from labapp.text import capitalized, pluralize

if TYPE_CHECKING:
    from labapp.gui.foot_switches import FootSwitches
    from labapp.session.results.measured import Overview
    from labapp.session.session import Session

T = TypeVar("T")

MEASURING, MISSING, EDITING, SIZE = "Measuring", "Recording", "Editing", "Frame size"
"""Causes of problems, see `Workspace.say_wrong`."""

MEASURED_S = 0.25
"""Shortest interval, s, between updates for frames measured in the background."""


class Workspace(QObject):
    """The session of a window, the frame in view, and the running tasks.

    Pages read the session through `session`, change it through `attempt`, and start long work
    through `tasks`. They are updated whenever a signal reports a change of the session.
    """

    closing = Signal()
    """The open session is about to be closed; an edit in progress can still be stored in it."""
    opened = Signal()
    """Another session is open, or none."""
    changed = Signal()
    """A document, the recording or a result changed; visible pages are updated."""
    stepped = Signal()
    """A change was undone or redone; emitted before `changed`."""
    measured = Signal()
    """Frames not in view were measured; emitted a few times per second while more follow."""
    frame_changed = Signal(int)
    """Another frame is in view."""
    notified = Signal(str, bool)
    """A message for the operator: its text, and whether it is a problem."""
    urgent = Signal(str)
    """Data are lost by the problem that is notified next: its text. Others come after it."""
    settled = Signal(str)
    """A reported problem is solved: its text."""
    action_requested = Signal(str)
    """Run an action of the window's menus: its name."""
    next_session_requested = Signal(object)
    """Create a session like this one for a recording: its file."""
    analysed = Signal(object)
    """The change of the pool over time was analysed: a `Dynamics`."""
    foot_switches_changed = Signal(object)
    """The actions of the pedals are to be stored: plain values."""

    def __init__(self, parent: QObject | None = None) -> None:
        super().__init__(parent)
        self.session: Session | None = None
        self.frame = 0
        self._pool: ProcessPoolExecutor | None = None
        self._warm_pool: ProcessPoolExecutor | None = None
        self._overview: Overview | None = None
        self._measuring: list[Task] = []
        # Connected first, so that slots connected later get an up-to-date overview.
        self.opened.connect(self._forget)
        self.changed.connect(self._forget)
        self.changed.connect(self._settle_size)
        self.tasks = Tasks(self)
        self.tasks.changed.connect(self._show_end)
        self._problems: dict[str, str] = {}
        self.tasks.failed.connect(lambda title, why, kind: self.say_wrong(kind, f"{title}: {why}"))
        self.tasks.settled.connect(self.settle)

    @cached_property
    def foot_switches(self) -> FootSwitches:
        """The foot switches in use; their modules are loaded on first use."""
        from labapp.gui.foot_switches import FootSwitches

        made = FootSwitches(self.tasks, self)
        made.pressed.connect(self.action_requested)
        made.notified.connect(self.notified)
        made.kept.connect(self.foot_switches_changed)
        return made

    @property
    def folder(self) -> Path:
        """Initial folder of a file dialog (`drafts.folder_of`); home folder without a session."""
        return Path.home() if self.session is None else folder_of(self.session)

    def show(self, session: Session | None) -> None:
        """Close the current session and show another one, or none."""
        for cause in list(self._problems):
            self.settle(cause)
        if self.session is not None:
            self.closing.emit()
        if self.tasks.active:
            self._stop_measuring()
        self._measuring.clear()
        self.tasks.cancel_all(lasting=False)
        if self.session is not None:
            self.session.close()
        self.session = session
        frames = [] if session is None else session.frames.tolist()
        self.frame = frames[0] if frames else 0
        self.opened.emit()
        self.changed.emit()

    def close(self) -> None:
        """Stop all tasks and close the session before the window closes."""
        if "foot_switches" in vars(self):
            self.foot_switches.stop()
        self._stop_measuring()
        self.show(None)
        self.tasks.cancel_all()

    def _stop_measuring(self) -> None:
        """End the processes: a partly measured frame is not kept, and could take seconds."""
        for task in self.tasks.active:
            if not task.is_lasting:
                task.cancel()  # otherwise the end of its processes would be a failure
        pools, self._pool, self._warm_pool = (self._pool, self._warm_pool), None, None
        for pool in filter(None, pools):
            parallel.end_processes(pool)

    def say_wrong(self, cause: str, words: str) -> None:
        """Report a problem, which lasts until its cause is settled or another session is opened."""
        self.settle(cause)
        self._problems[cause] = words
        self.notified.emit(words, True)

    def settle(self, cause: str) -> None:
        """Mark the problem of a cause as solved, if there is one."""
        words = self._problems.pop(cause, "")
        if words:
            self.settled.emit(words)

    def check_size(self) -> str:
        """Report a set-up that does not match the size of the frames; return the words, or ""."""
        words = self._size_warning()
        if words:
            self.say_wrong(SIZE, words)
        return words

    def _size_warning(self) -> str:
        from labapp.session.frame_size import size_warning

        session = self.session
        if session is None or session.recording is None:
            return ""
        return size_warning(session, session.recording)

    def _settle_size(self) -> None:
        if SIZE in self._problems and not self._size_warning():
            self.settle(SIZE)

    def run_or_report(
        self,
        work: Callable[[], T],
        cause: str = "",
        show_answer: Callable[[str], object] | None = None,
    ) -> T | None:
        """Run a short operation; report an error as a message, and return None.

        Parameters
        ----------
        cause
            Error shown until this cause is settled, see `say_wrong`; empty: until it is read.
        show_answer
            Also shows the error at the pressed button; called with an empty text on success.
        """
        try:
            done = work()
        except Exception as error:
            words = capitalized(error_text(error))
            if cause:
                self.say_wrong(cause, words)
            else:
                self.notified.emit(words, True)
            if show_answer is not None:
                show_answer(f"{PROBLEM} {words}")
            return None
        self.settle(cause)
        if show_answer is not None:
            show_answer("")
        return done

    def attempt(
        self,
        change: Callable[[Session], object],
        cause: str = EDITING,
        show_answer: Callable[[str], object] | None = None,
    ) -> bool:
        """Change the session; report an error and return False if it fails.

        A refused change is reported until the next one is stored.
        `changed` is emitted either way: fields must not go on showing what was refused.
        """
        session = self.session
        if session is None:
            return False
        done = self.run_or_report(lambda: (change(session),), cause, show_answer) is not None
        if done:
            self.settle(EDITING)
        self.changed.emit()
        return done

    def undo(self) -> None:
        """Undo the last change."""
        self._step("undo", "Undone", "Nothing to undo")

    def redo(self) -> None:
        """Redo the last undone change."""
        self._step("redo", "Redone", "Nothing to redo")

    def _step(self, name: str, done: str, nothing: str) -> None:
        session = self.session
        if session is None:
            return
        step = self.run_or_report(session.undo if name == "undo" else session.redo, EDITING)
        self.notified.emit(nothing if step is None else f"{done}: {step.label}", False)
        if step is not None:
            frames = [frame for _, frame in step.keys if frame >= 0]
            if frames and self.frame not in frames:
                self.show_frame(frames[0])
            self.stepped.emit()
            self.changed.emit()
            if any(name == "setup" for name, _ in step.keys):
                self.check_size()

    def overview(self) -> Overview | None:
        """Overview of all frames, read once after each change; None without a session.

        Raises
        ------
        InputError
            If the session is damaged.
        """
        if self._overview is None and self.session is not None:
            self._overview = self.session.overview()
        return self._overview

    def _forget(self) -> None:
        self._overview = None

    def show_frame(self, number: int) -> None:
        """Bring a frame of the session into view."""
        if self.session is not None and number != self.frame:
            self.frame = number
            self.frame_changed.emit(number)

    @property
    def measuring(self) -> Task | None:
        """The running measurement; None if there is none."""
        return next((task for task in self.tasks.active if task.title == MEASURING), None)

    def measure(
        self,
        frames: Sequence[int] | None = None,
        *,
        warm: bool = False,
        show_answer: Callable[[str], object] | None = None,
    ) -> None:
        """Measure frames in the background; None: those that are not measured, or stale.

        Stored frames emit `measured`; the frame in view, and the end of the task, emit `changed`.

        Parameters
        ----------
        warm
            Whether each frame starts from the previous one, as suits a fast recording.
        show_answer
            Also shows the outcome at the pressed button.
        """
        from labapp.session.results.measured import scheme_name

        session = self.session
        if session is None:
            return
        pool = self._measuring_pool(warm)

        def work(control: Control) -> tuple[int, int, int, str]:
            done, failed, emitted_s = 0, 0, 0.0
            scheme = scheme_name(session.settings)
            numbers = [int(k) for k in (session.stale_frames() if frames is None else frames)]
            try:
                for done, (number, made) in enumerate(
                    session.measure_each(numbers, pool, warm=warm), 1
                ):
                    failed += is_failed(made.status)
                    control.progress(done, len(numbers))
                    if number == self.frame:
                        control.part(None)
                    elif time.monotonic() - emitted_s > MEASURED_S:
                        # Read in this thread: the window would wait while results are saved.
                        control.part(session.overview())
                        emitted_s = time.monotonic()
            except (BrokenProcessPool, CancelledError) as error:
                control.check()  # raises if it was ended on purpose
                self._pool = self._warm_pool = None
                raise ValueError(
                    "a process that measures has ended; what was measured is kept: measure again"
                ) from error
            return done, failed, _count_stale(session, numbers, scheme), scheme

        def finished(counts: tuple[int, int, int, str]) -> None:
            done, failed, stale, scheme = counts
            changed = scheme != scheme_name(session.settings)
            words = measured_text(done, failed, stale, scheme if changed else "")
            self.notified.emit(words, False)
            if show_answer is not None:
                show_answer(f"{PROBLEM if failed or stale else DONE} {words}")

        def kept(seen: Overview | None) -> None:
            if seen is None:
                self.changed.emit()
            else:
                self._overview = seen
                self.measured.emit()

        self._measuring.append(self.tasks.start(MEASURING, work, finished, kept, show_answer))

    def _measuring_pool(self, warm: bool) -> ProcessPoolExecutor:
        from labapp.run.measurers import measuring_pool

        if warm:
            self._warm_pool = self._warm_pool or measuring_pool(1)
            return self._warm_pool
        self._pool = self._pool or measuring_pool(max(1, (os.cpu_count() or 2) - 1))
        return self._pool

    def _show_end(self) -> None:
        """Update the window with all stored results when a measurement has ended."""
        ended = [task for task in self._measuring if task not in self.tasks.active]
        if ended:
            self._measuring = [task for task in self._measuring if task not in ended]
            self.changed.emit()


def measured_text(done: int, failed: int, stale: int, scheme: str = "") -> str:
    """Text of how many of the frames done have a surface, have none, and are out of date.

    ``scheme`` is named if it is no longer that of the settings.
    """
    from labapp.core.schemes import scheme_words

    by = f" by {scheme_words()[scheme].title}" if scheme else ""
    words = f"{pluralize(done - failed, 'frame')} measured{by}"
    words += f", {failed} could not be" if failed else ""
    if stale:
        words += f", {stale} already out of date by a change meanwhile: measure again (F5)"
    return words


def _count_stale(session: Session, numbers: Sequence[int], scheme: str) -> int:
    """Number of these frames whose results by a scheme are out of date."""
    seen, wanted = session.overview(scheme), set(numbers)
    pairs = zip(seen.frame.tolist(), seen.stale.tolist(), strict=True)
    return sum(stale and frame in wanted for frame, stale in pairs)
