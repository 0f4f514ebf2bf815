"""Many independent simulations on all cores; and how a process begins that works for another."""

from __future__ import annotations

import atexit
import functools
import multiprocessing
import os
import threading
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ProcessPoolExecutor, wait
from contextlib import contextmanager, nullcontext
from contextvars import ContextVar
from typing import TypeVar

from threadpoolctl import threadpool_limits

from labapp.system import deaf, give_way, turn_deaf

T = TypeVar("T")
R = TypeVar("R")

POLL_S = 0.2
"""So often is told how far it is, done or not: who is told may end it."""

NICE = 10
"""So much a process that works behind a window gives way to it."""

_behind = ContextVar("behind", default=False)
"""Whether what begins processes now works behind a window."""

_shared: ContextVar[ProcessPoolExecutor | None] = ContextVar("shared", default=None)
"""The processes of `shared_processes`."""

ONE_THREAD = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS")
"""The matrices are small: more threads than one get in each other's way."""

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
    shared = _shared.get()
    with nullcontext(shared) if shared else processes(min(workers, len(tasks))) as pool:
        with deaf():
            futures = [pool.submit(function, task) for task in tasks]
        for future in futures:
            results.append(awaited(future, lambda: tell(what, len(results), len(tasks))))
            tell(what, len(results), len(tasks))
    return results


@contextmanager
def shared_processes(workers: int | None = None) -> Iterator[None]:
    """Let every `in_parallel` within this use the same processes: each takes seconds to begin.

    Parameters
    ----------
    workers
        See `in_parallel`.
    """
    workers = workers or os.cpu_count() or 1
    if workers <= 1:
        yield
        return
    with processes(workers) as pool:
        former = _shared.set(pool)
        try:
            yield
        finally:
            _shared.reset(former)


def awaited(future: Future[R], tell: Callable[[], None]) -> R:
    """Result of a task in another process; ``tell`` is called meanwhile, and may end the wait."""
    while not wait([future], POLL_S).done:
        tell()
    return future.result()


@contextmanager
def processes(
    workers: int, become: Callable[..., None] | None = None, *given: object
) -> Iterator[ProcessPoolExecutor]:
    """Processes that work for this one; an exception ends what they are at.

    Parameters
    ----------
    workers
        How many.
    become, given
        What each calls first, and with what.
    """
    spawn = multiprocessing.get_context("spawn")
    begin = functools.partial(begin_worker, NICE if _behind.get() else 0, become, *given)
    pool = ProcessPoolExecutor(workers, spawn, initializer=begin)
    try:
        yield pool
    except BaseException:
        end_processes(pool)
        raise
    pool.shutdown()


def end_processes(pool: ProcessPoolExecutor, wait: bool = True) -> None:
    """End processes whatever they are at, which can take a minute.

    Parameters
    ----------
    pool
        Their pool, of no more use then.
    wait
        Whether to return only when they are gone.
    """
    # One may be half through telling its result: who listens must see that nobody goes on. A pool
    # that has ended listens no more.
    results = getattr(pool, "_result_queue", None)
    if results is not None:
        results._writer.close()
    for process in list((pool._processes or {}).values()):
        process.terminate()
    pool.shutdown(wait, cancel_futures=True)


def begin_worker(nice: int = 0, become: Callable[..., None] | None = None, *given: object) -> None:
    """Begin a process that works for another one; see `processes`.

    It gives way by ``nice``, where the system knows of it, computes in one thread, and ends when
    the one that it works for is gone, killed even. At its own end nothing is taken down: what was
    registered with `atexit` before is not called.
    """
    turn_deaf()
    give_way(nice)
    os.environ.update(dict.fromkeys(ONE_THREAD, "1"))
    threadpool_limits(1)  # of what is loaded already
    parent = multiprocessing.parent_process()

    def follow() -> None:
        if parent is not None:
            parent.join()
            os._exit(1)

    threading.Thread(target=follow, name="parent", daemon=True).start()
    atexit.register(os._exit, 0)  # taking down all that is loaded would take half a second
    if become is not None:
        become(*given)


@contextmanager
def behind_a_window() -> Iterator[None]:
    """Have processes that are begun now, by this thread, give way to the window."""
    former = _behind.set(True)
    try:
        yield
    finally:
        _behind.reset(former)
