"""Run a study's tasks in processes of this machine, or on workers of a Dask cluster.

Both are a `concurrent.futures.Executor`, to which `run_jobs` submits tasks.
"""

from __future__ import annotations

import logging
import os
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import (
    FIRST_COMPLETED,
    BrokenExecutor,
    Executor,
    Future,
    ProcessPoolExecutor,
    wait,
)
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any

from labapp.errors import InputError
from labapp.run.measurers import load_all, measuring_pool
from labapp.simulation.parallel import POLL_S, InlineExecutor, end_processes
from labapp.system import interrupts_blocked

ATTEMPTS = 4
"""Most attempts at a task: the process or the machine that runs it may die."""

TIMEOUT_S = 10
"""Longest wait for a scheduler's answer."""

A_SCHEDULER = "the address of a running Dask scheduler, such as tcp://127.0.0.1:8786"


@dataclass(frozen=True)
class Job:
    """A task for one of the workers."""

    about: int
    """Index of its recording."""
    work: Callable[..., None]
    given: tuple[Any, ...]
    """A module-level function, and its arguments."""
    attempt: int = 1


@dataclass(frozen=True)
class Workers:
    """An executor of tasks."""

    executor: Executor
    slots: Callable[[], int]
    """How many tasks to submit at once."""
    dashboard: str = ""
    """Address of the dashboard; empty if there is none."""
    warning: str = ""
    """Warning for the user; empty if none."""


def run_jobs(
    jobs: Iterator[Job],
    workers: Workers,
    finished: Callable[[Job, Exception | None], Iterable[Job]],
    poll: Callable[[], object],
) -> None:
    """Run jobs, several at once; jobs that follow from a finished one go before the others.

    Parameters
    ----------
    jobs
        The jobs; read as workers become free.
    finished
        Called in this process with each finished job, and the error if its last attempt failed;
        returns the jobs that follow from it.
    poll
        Called regularly; may raise to stop.

    Raises
    ------
    InputError
        If the connection to the scheduler is lost.
    """
    ready: deque[Job] = deque()
    pending: dict[Future[None], Job] = {}
    try:
        while True:
            while len(pending) < workers.slots():
                job = ready.popleft() if ready else next(jobs, None)
                if job is None:
                    break
                pending[workers.executor.submit(job.work, *job.given)] = job
            if not pending:
                return
            for future in wait(pending, POLL_S, FIRST_COMPLETED).done:
                job = pending.pop(future)
                error = _error_of(future)
                if error is None or isinstance(error, InputError) or job.attempt == ATTEMPTS:
                    ready.extend(finished(job, error))
                else:
                    ready.append(replace(job, attempt=job.attempt + 1))
            poll()
    finally:
        for future in pending:
            future.cancel()


def _error_of(future: Future[None]) -> Exception | None:
    if future.cancelled():
        raise InputError("Dask", "connection", "lost", f"{A_SCHEDULER}; then run again")
    error = future.exception()
    if error is not None and not isinstance(error, Exception):
        raise error
    return error


# --- here ---------------------------------------------------------------------------------------


class _Processes(Executor):
    """Processes with a pool each: if one dies, tasks of the others go on."""

    def __init__(self, count: int, tasks: int) -> None:
        self._lock = threading.Lock()
        self._pools: set[ProcessPoolExecutor] = set()
        soon = min(count, tasks)
        self._idle: list[ProcessPoolExecutor | None] = [None] * (count - soon)
        self._idle += [self._start() for _ in range(soon)]

    def _start(self) -> ProcessPoolExecutor:
        """Start a process, which loads its modules in the background."""
        pool = measuring_pool(1)
        self._pools.add(pool)
        with interrupts_blocked():
            pool.submit(load_all)
        return pool

    def submit(self, work: Callable[..., Any], /, *given: Any, **named: Any) -> Future[Any]:
        """Start a task in an idle process; there must be one."""
        with self._lock:
            pool = self._idle.pop() or self._start()
        with interrupts_blocked():
            try:
                future = pool.submit(work, *given, **named)
            except BrokenExecutor:  # it died while idle
                pool.shutdown(wait=False)
                with self._lock:
                    self._pools.discard(pool)
                    pool = self._start()
                future = pool.submit(work, *given, **named)
        future.add_done_callback(lambda done: self._free(pool, done))
        return future

    def _free(self, pool: ProcessPoolExecutor, done: Future[Any]) -> None:
        """Mark a process as idle, or replace it if it has died."""
        died = not done.cancelled() and isinstance(done.exception(), BrokenExecutor)
        with self._lock:
            if died:
                self._pools.discard(pool)
            self._idle.append(None if died else pool)
        if died:
            pool.shutdown(wait=False)

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """End the processes; results of unfinished tasks are lost."""
        for pool in list(self._pools):
            end_processes(pool, wait)


@contextmanager
def local_workers(count: int | None, tasks: int) -> Iterator[Workers]:
    """Start processes of this machine.

    Parameters
    ----------
    count
        Number of processes; None: one per core; 0: tasks run in this process.
    tasks
        Number of tasks to expect: not more processes start at once, but when they are needed.
    """
    count = (os.cpu_count() or 1) if count is None else count
    executor = _Processes(count, tasks) if count else InlineExecutor()
    try:
        yield Workers(executor, lambda: max(count, 1))
    finally:
        executor.shutdown()


# --- a cluster ----------------------------------------------------------------------------------


@contextmanager
def dask_workers(address: str) -> Iterator[Workers]:
    """Connect to a Dask scheduler at ``tcp://HOST:PORT``.

    Needs dask[distributed], which the extra ``study`` installs.

    Raises
    ------
    InputError
        If Dask is not installed, or the scheduler does not answer.
    """
    try:
        from distributed import Client
    except ImportError as error:
        expected = "dask: pip install 'labapp[study]'"
        raise InputError("Dask", "package", "is not installed", expected) from error
    logging.getLogger("distributed").setLevel(logging.CRITICAL)
    try:
        client = Client(address, timeout=TIMEOUT_S, set_as_default=False)
    except (OSError, ValueError, TimeoutError) as error:
        raise InputError("Dask", "scheduler", address, A_SCHEDULER) from error
    try:
        threads = client.nthreads()
        several = sum(each > 1 for each in threads.values())
        warning = (
            f"{several} of {len(threads)} workers have several threads, of which one measures: "
            "start them with --nthreads 1"
        )
        executor = client.get_executor(pure=False, retries=0)
        try:
            dashboard = str(client.dashboard_link or "")
            yield Workers(executor, _Slots(client), dashboard, warning if several else "")
        finally:
            executor.shutdown(wait=False)
    finally:
        client.close(timeout=TIMEOUT_S)


class _Slots:
    """Number of tasks: twice the number of threads, so that none is idle; varies over time."""

    def __init__(self, client: Any) -> None:
        self._client, self._at, self._count = client, -1.0, 1

    def __call__(self) -> int:
        now = time.monotonic()
        if now - self._at > 1.0:
            try:
                self._count = 2 * max(1, sum(self._client.nthreads().values()))
            except (OSError, TimeoutError) as error:
                raise InputError("Dask", "connection", "lost", A_SCHEDULER) from error
            self._at = now
        return self._count
