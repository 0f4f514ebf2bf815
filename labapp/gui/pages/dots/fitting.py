"""Refit after an edit: one at a time, and only the last edit counts."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Executor, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from typing import Any

from PySide6.QtCore import QTimer

from labapp.core.pipeline import Settings
from labapp.gui.shell.steps import why_not_measurable
from labapp.gui.tasks import Cancelled, Control, Task
from labapp.gui.workspace import Workspace
from labapp.run.measurers import measuring_pool
from labapp.simulation.parallel import end_processes

WARM_MS = 1500
"""Delay, ms, of the start of the processes after the page is shown."""

AGAIN_MS = 50
"""Interval, ms, of attempts to replace the previous fit after an edit."""


class Processes:
    """A process for fits, and a warm spare one that replaces it when it is killed."""

    def __init__(self) -> None:
        self._pools: list[tuple[ProcessPoolExecutor, Future[Settings]]] = []

    def begin(self) -> None:
        """Start missing processes, so that a spare one is always available."""
        while len(self._pools) < 2:
            pool = measuring_pool(1)
            # Creating settings imports all modules of the measurement.
            self._pools.append((pool, pool.submit(Settings)))

    @property
    def begun(self) -> bool:
        """Whether the processes were started."""
        return bool(self._pools)

    @property
    def first(self) -> ProcessPoolExecutor:
        """The process for fits."""
        self.begin()
        return self._pools[0][0]

    @property
    def ready(self) -> bool:
        """Whether the spare process is ready."""
        return len(self._pools) == 2 and self._pools[1][1].done()

    def replace(self) -> None:
        """Kill the first process, and replace it by the spare one."""
        end_processes(self._pools.pop(0)[0], wait=False)
        self.begin()

    def end(self) -> None:
        """End both processes."""
        while self._pools:
            end_processes(self._pools.pop()[0], wait=False)


class Refit:
    """Measures a frame again whenever its dots or rows were changed by hand.

    One fit runs at a time, in a separate process, so that a long measurement does not delay it. An
    edit during a fit ends it immediately and starts another one with the new correction.
    """

    def __init__(self, workspace: Workspace) -> None:
        self._space = workspace
        self._task: Task | None = None
        self._begun: tuple[int, object] | None = None
        self._seen: tuple[int, bool] | None = None
        self.processes = Processes()
        """Processes for the fits."""
        self._warm, self._again = QTimer(workspace), QTimer(workspace)
        for timer, rest_ms, work in (
            (self._warm, WARM_MS, self.processes.begin),
            (self._again, AGAIN_MS, self._once_more),
        ):
            timer.setSingleShot(True)
            timer.setInterval(rest_ms)
            timer.timeout.connect(work)
        workspace.opened.connect(self._forget)

    @property
    def pending(self) -> bool:
        """Whether a fit is running."""
        return self._task in self._space.tasks.active

    def want(self, frame: int, due: bool) -> None:
        """Fit a frame if it is due because its dots or rows were changed by hand."""
        session = self._space.session
        if session is None or why_not_measurable(session):
            return
        self._seen = frame, due
        if not self.processes.begun and not self._warm.isActive():
            self._warm.start()
        # A refused or cancelled fit is not repeated until something else changes.
        state = (frame, session.history)
        if state == self._begun:
            return
        if self.pending and not self._give_up(frame):
            return
        if due:
            self._begun = state
            self._fit(frame)

    def _once_more(self) -> None:
        if self._seen is not None:
            self.want(*self._seen)

    def _give_up(self, frame: int) -> bool:
        """End the running fit if it is of this frame; False if it continues."""
        assert self._task is not None
        if self._begun is None or self._begun[0] != frame:
            return False
        if not self.processes.ready:
            self._again.start()
            return False
        self._task.cancel()
        self._task = None
        self.processes.replace()
        return True

    def _fit(self, frame: int) -> None:
        space, session, pool = self._space, self._space.session, self.processes.first
        assert session is not None

        def work(control: Control) -> None:
            try:
                for _ in session.measure_each([frame], _CancellablePool(pool, control)):
                    control.check()
            except BrokenProcessPool as error:
                control.check()  # raises if it was ended on purpose
                raise ValueError("the process that fits has ended: measure the frame") from error

        self._task = space.tasks.start("Fitting", work, lambda _: space.changed.emit())

    def _forget(self) -> None:
        """Discard requests after another session was opened."""
        self._warm.stop()
        self._again.stop()
        self._task = self._begun = self._seen = None
        self.processes.end()


class _CancellablePool(Executor):
    """A pool whose results are waited for only until the task is cancelled."""

    def __init__(self, pool: Executor, control: Control) -> None:
        self._pool, self._control = pool, control

    def submit(self, work: Callable[..., Any], /, *given: Any, **named: Any) -> Future[Any]:
        future = self._pool.submit(work, *given, **named)
        while not wait([future], timeout=0.02).done:
            if self._control.cancelled.is_set():
                future.cancel()
                raise Cancelled
        return future
