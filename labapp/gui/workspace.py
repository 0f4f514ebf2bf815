"""What is open in a window: a session and a frame; signals say when something changes."""

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
from labapp.simulation import parallel
from labapp.text import pluralize

if TYPE_CHECKING:
    from labapp.gui.foot_switches import FootSwitches
    from labapp.session.measured import Overview
    from labapp.session.session import Session

T = TypeVar("T")

MEASURING, MISSING = "Measuring", "Recording"
"""Causes of problems: see `Workspace.say_wrong`."""

MEASURED_S = 0.25
"""What is measured behind the operator's back is shown no more often."""


class Workspace(QObject):
    """The session that a window shows, the frame in view, and the work under way.

    Pages read the session through `session`, change it through `attempt`, and start long work
    through `tasks`. They show what the session holds whenever a signal says that it changed.
    """

    closing = Signal()
    """The session that is open will be closed: an edit under way can still be kept in it."""
    opened = Signal()
    """Another session is open, or none."""
    changed = Signal()
    """A document, the recording or a result changed; pages in view show the session again."""
    measured = Signal()
    """Frames that are not in view were measured; sent some times a second while more follow."""
    frame_changed = Signal(int)
    """Another frame is in view."""
    notified = Signal(str, bool)
    """Something for the operator to read: a sentence, and whether it is a problem."""
    settled = Signal(str)
    """A reported problem is solved: its words."""
    action_requested = Signal(str)
    """Run an action of the window's menus, by its name."""
    next_session_requested = Signal(object)
    """Begin a session like this one for a recording: its file."""
    analysed = Signal(object)
    """How the pool changes over time was analysed: a `Dynamics`."""
    foot_switches_changed = Signal(object)
    """The actions of the pedals are to be stored, as plain values."""

    def __init__(self, parent: QObject | None = None) -> None:
        super().__init__(parent)
        self.session: Session | None = None
        self.frame = 0
        self._pool: ProcessPoolExecutor | None = None
        self._warm_pool: ProcessPoolExecutor | None = None
        self._overview: Overview | None = None
        self._measuring: list[Task] = []
        # Connected first: the slots connected later see the frames as they are.
        self.opened.connect(self._forget)
        self.changed.connect(self._forget)
        self.tasks = Tasks(self)
        self.tasks.changed.connect(self._show_end)
        self._problems: dict[str, str] = {}
        self.tasks.failed.connect(lambda title, why, kind: self.say_wrong(kind, f"{title}: {why}"))
        self.tasks.settled.connect(self.settle)

    @cached_property
    def foot_switches(self) -> FootSwitches:
        """The foot switches in use; what they need is loaded on first use."""
        from labapp.gui.foot_switches import FootSwitches

        made = FootSwitches(self.tasks, self)
        made.pressed.connect(self.action_requested)
        made.notified.connect(self.notified)
        made.kept.connect(self.foot_switches_changed)
        return made

    @property
    def folder(self) -> Path:
        """Where a file dialog begins (`drafts.folder_of`); without a session the home folder."""
        return Path.home() if self.session is None else folder_of(self.session)

    def show(self, session: Session | None) -> None:
        """Show a session in place of the present one, which is closed."""
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
        """Stop all work and close the session: the window goes."""
        if "foot_switches" in vars(self):
            self.foot_switches.stop()
        self._stop_measuring()
        self.show(None)
        self.tasks.cancel_all()

    def _stop_measuring(self) -> None:
        """End the processes: a frame that is half measured is not kept, and could take seconds."""
        for task in self.tasks.active:
            if not task.is_lasting:
                task.cancel()  # or it would take the end of its processes for a fault
        pools, self._pool, self._warm_pool = (self._pool, self._warm_pool), None, None
        for pool in filter(None, pools):
            parallel.end_processes(pool)

    def say_wrong(self, cause: str, words: str) -> None:
        """Report a problem that lasts until its cause is settled or another session is opened."""
        self.settle(cause)
        self._problems[cause] = words
        self.notified.emit(words, True)

    def settle(self, cause: str) -> None:
        """Take it that a problem is over, if there was one."""
        words = self._problems.pop(cause, "")
        if words:
            self.settled.emit(words)

    def run_or_report(
        self, work: Callable[[], T], cause: str = "", beside: Callable[[str], object] | None = None
    ) -> T | None:
        """Run something short; report a refusal as a message, and return None.

        Parameters
        ----------
        cause
            What a refusal lasts as long as, see `say_wrong`; empty: until it was read.
        beside
            Shows a refusal beside what was pressed, too; called with nothing where all went well.
        """
        try:
            done = work()
        except Exception as error:
            words = error_text(error)
            if cause:
                self.say_wrong(cause, words)
            else:
                self.notified.emit(words, True)
            if beside is not None:
                beside(f"{PROBLEM} {words}")
            return None
        self.settle(cause)
        if beside is not None:
            beside("")
        return done

    def attempt(
        self,
        change: Callable[[Session], object],
        cause: str = "",
        beside: Callable[[str], object] | None = None,
    ) -> bool:
        """Change the session and emit `changed`; False if it was refused, which is reported."""
        session = self.session
        if session is None or self.run_or_report(lambda: (change(session),), cause, beside) is None:
            return False
        self.changed.emit()
        return True

    def undo(self) -> None:
        """Take back the last change."""
        self._step("undo", "Undone", "Nothing to undo")

    def redo(self) -> None:
        """Make the last change again that was taken back."""
        self._step("redo", "Redone", "Nothing to redo")

    def _step(self, name: str, done: str, nothing: str) -> None:
        session = self.session
        if session is None:
            return
        step = self.run_or_report(session.undo if name == "undo" else session.redo)
        self.notified.emit(nothing if step is None else f"{done}: {step.label}", False)
        if step is not None:
            frames = [frame for _, frame in step.keys if frame >= 0]
            if frames and self.frame not in frames:
                self.show_frame(frames[0])
            self.changed.emit()

    def overview(self) -> Overview | None:
        """All frames at a glance, looked up once after each change; None without a session.

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
        """The measuring under way; None if there is none."""
        return next((task for task in self.tasks.active if task.title == MEASURING), None)

    def measure(
        self,
        frames: Sequence[int] | None = None,
        *,
        warm: bool = False,
        beside: Callable[[str], object] | None = None,
    ) -> None:
        """Measure frames in the background; None: those not measured, or stale.

        Frames that are kept make `measured` go out; that in view, and the last, `changed`.

        Parameters
        ----------
        warm
            Whether each frame is measured from the one before, as fits a fast recording.
        beside
            Says beside what was pressed what came of it, too.
        """
        session = self.session
        if session is None:
            return
        pool = self._measuring_pool(warm)

        def work(control: Control) -> tuple[int, int]:
            done, failed, emitted_s = 0, 0, 0.0
            numbers = [int(k) for k in (session.stale_frames() if frames is None else frames)]
            try:
                for done, (number, made) in enumerate(
                    session.measure_each(numbers, pool, warm=warm), 1
                ):
                    failed += made.status != "ok"
                    control.progress(done, len(numbers))
                    if number == self.frame:
                        control.part(None)
                    elif time.monotonic() - emitted_s > MEASURED_S:
                        # Looked up here: the window would wait for results that are being saved.
                        control.part(session.overview())
                        emitted_s = time.monotonic()
            except (BrokenProcessPool, CancelledError) as error:
                control.check()  # ended on purpose
                self._pool = self._warm_pool = None
                raise ValueError(
                    "a process that measures has ended; what was measured is kept: measure again"
                ) from error
            return done, failed

        def finished(counts: tuple[int, int]) -> None:
            done, failed = counts
            words = f"{pluralize(done, 'frame')} measured"
            words += f", {failed} without a surface" if failed else ""
            self.notified.emit(words, False)
            if beside is not None:
                beside(f"{DONE} {words}")

        def kept(seen: Overview | None) -> None:
            if seen is None:
                self.changed.emit()
            else:
                self._overview = seen
                self.measured.emit()

        self._measuring.append(self.tasks.start(MEASURING, work, finished, kept, beside))

    def _measuring_pool(self, warm: bool) -> ProcessPoolExecutor:
        from labapp.run.measurers import measuring_pool

        if warm:
            self._warm_pool = self._warm_pool or measuring_pool(1)
            return self._warm_pool
        self._pool = self._pool or measuring_pool(max(1, (os.cpu_count() or 2) - 1))
        return self._pool

    def _show_end(self) -> None:
        """Have everything shown that was kept, however the measuring has ended."""
        ended = [task for task in self._measuring if task not in self.tasks.active]
        if ended:
            self._measuring = [task for task in self._measuring if task not in ended]
            self.changed.emit()
