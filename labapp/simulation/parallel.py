"""Many independent simulations on all cores."""

from __future__ import annotations

import multiprocessing
import os
import signal
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from typing import TypeVar

from threadpoolctl import threadpool_limits

T = TypeVar("T")
R = TypeVar("R")

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
        On Ctrl-C, once the tasks being done are; the others are not begun.
    """
    tasks = list(tasks)
    tell = progress or (lambda *_: None)
    tell(what, 0, len(tasks))
    workers = min(workers or os.cpu_count() or 1, len(tasks))
    results = []
    if workers <= 1:
        with threadpool_limits(1, "blas"):
            for task in tasks:
                results.append(function(task))
                tell(what, len(results), len(tasks))
        return results
    pool = ProcessPoolExecutor(
        workers, multiprocessing.get_context("spawn"), initializer=threadpool_limits, initargs=(1,)
    )
    try:
        with deaf():
            futures = [pool.submit(function, task) for task in tasks]
        for future in futures:
            results.append(future.result())
            tell(what, len(results), len(tasks))
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
