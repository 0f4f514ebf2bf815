"""Many independent simulations on all cores."""

from __future__ import annotations

import multiprocessing
import os
import signal
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor, wait
from contextlib import contextmanager
from typing import TypeVar

from threadpoolctl import threadpool_limits

T = TypeVar("T")
R = TypeVar("R")

POLL_S = 0.2
"""So often is told how far it is, done or not: who is told may end it."""

Progress = Callable[[str, int, int], None]
"""Told what is being done, how many steps of it are done and how many there are."""


def in_parallel(
    function: Callable[[T], R],
    tasks: Iterable[T],
    what: str = "",
    progress: Progress | None = None,
    workers: int | None = None,
) -> list[R]:
    """Call a function for every task; results in the order of the tasks.

    Parameters
    ----------
    function
        Of a module, so that another process finds it.
    tasks
        What it is called with, each on its own.
    what, progress
        What is being done, and who is told of it.
    workers
        How many processes; None: one a core. With 1 all is done here.

    Raises
    ------
    KeyboardInterrupt
        On Ctrl-C. This, and what ``progress`` raises, ends the tasks being done.
    """
    tasks = list(tasks)
    tell = progress or (lambda *_: None)
    tell(what, 0, len(tasks))
    workers = workers or os.cpu_count() or 1
    results = []
    if workers <= 1 or not tasks:
        with threadpool_limits(1, "blas"):
            for task in tasks:
                results.append(function(task))
                tell(what, len(results), len(tasks))
        return results
    pool = ProcessPoolExecutor(
        min(workers, len(tasks)),
        multiprocessing.get_context("spawn"),
        initializer=threadpool_limits,
        initargs=(1,),
    )
    try:
        with deaf():
            futures = [pool.submit(function, task) for task in tasks]
        for future in futures:
            while not wait([future], POLL_S).done:
                tell(what, len(results), len(tasks))
            results.append(future.result())
            tell(what, len(results), len(tasks))
    except BaseException:
        for process in list((pool._processes or {}).values()):
            process.terminate()  # a task can take a minute
        raise
    finally:
        pool.shutdown(cancel_futures=True)
    return results


@contextmanager
def deaf() -> Iterator[None]:
    """Hold Ctrl-C back: processes that are started now never hear it; this one does afterwards."""
    former = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, former)
