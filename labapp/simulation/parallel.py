"""Parallel execution in worker processes."""

from __future__ import annotations

import atexit
import functools
import multiprocessing
import os
import threading
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import Executor, Future, ProcessPoolExecutor, wait
from contextlib import AbstractContextManager, contextmanager, nullcontext
from contextvars import ContextVar
from typing import Any, TypeVar

from threadpoolctl import ThreadpoolController, threadpool_limits

from labapp.system import ignore_interrupts, interrupts_blocked, lower_priority

T = TypeVar("T")
R = TypeVar("R")

POLL_S = 0.2
"""Interval between calls to ``progress`` while waiting for a task, s; a call may raise to stop."""

NICE = 10
"""Niceness of processes started by the graphical interface."""

_low = ContextVar("low", default=False)
"""Whether processes started now get a low priority."""

_shared: ContextVar[ProcessPoolExecutor | None] = ContextVar("shared", default=None)
"""The processes of `shared_processes`."""

ONE_THREAD = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS")
"""Variables that limit BLAS to one thread: more threads are slower for small matrices."""

Progress = Callable[[str, int, int], None]
"""Called with the name of the work, the steps done and the number of steps; may raise to stop."""


def one_thread() -> AbstractContextManager[object]:
    """Limit BLAS to one thread: the matrices are small, and more threads are slower.

    A worker process has this limit from its start: setting it takes a hundredth of a frame's time.
    """
    if all(os.environ.get(name) == "1" for name in ONE_THREAD):
        return nullcontext()
    limited: AbstractContextManager[object] = blas().limit(limits=1, user_api="blas")
    return limited


@functools.cache
def blas() -> ThreadpoolController:
    """Return the controller of the loaded BLAS libraries; cached, as it takes milliseconds."""
    import scipy.linalg  # noqa: F401 - loads SciPy's own BLAS

    return ThreadpoolController()


def in_parallel(
    function: Callable[[T], R],
    tasks: Iterable[T],
    what: str = "",
    progress: Progress | None = None,
    workers: int | None = None,
) -> list[R]:
    """Map a function over tasks in parallel; the results have the order of the tasks.

    Parameters
    ----------
    function
        A module-level function, so that another process can import it.
    what, progress
        Name of the work and the callback for it.
    workers
        Number of processes. None: one per core. With 1, everything runs in this process.

    Raises
    ------
    KeyboardInterrupt
        On Ctrl-C. This, and an exception of ``progress``, ends the running tasks.
    """
    tasks = list(tasks)
    report = progress or (lambda *_: None)
    report(what, 0, len(tasks))
    workers = workers or os.cpu_count() or 1
    results = []
    if workers <= 1 or not tasks:
        with threadpool_limits(1, "blas"):
            for task in tasks:
                results.append(function(task))
                report(what, len(results), len(tasks))
        return results
    shared = _shared.get()
    with nullcontext(shared) if shared else processes(min(workers, len(tasks))) as pool:
        with interrupts_blocked():
            futures = [pool.submit(function, task) for task in tasks]
        for future in futures:
            results.append(wait_for(future, lambda: report(what, len(results), len(tasks))))
            report(what, len(results), len(tasks))
    return results


@contextmanager
def shared_processes(workers: int | None = None) -> Iterator[None]:
    """Share processes between all `in_parallel` calls within: each takes seconds to start."""
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


def wait_for(future: Future[R], poll: Callable[[], None]) -> R:
    """Wait for the result of a task; ``poll`` is called meanwhile and may raise to stop."""
    while not wait([future], POLL_S).done:
        poll()
    return future.result()


def in_order(begun: Iterable[Future[T]], ahead: int) -> Generator[T]:
    """Yield results in order, with ``ahead`` futures begun, which are cancelled when closed."""
    waiting: deque[Future[T]] = deque()
    try:
        for future in begun:
            waiting.append(future)
            while waiting and (len(waiting) > ahead or waiting[0].done()):
                result = waiting[0].result()
                waiting.popleft()
                yield result
        while waiting:
            yield waiting[0].result()
            waiting.popleft()
    finally:
        for future in waiting:
            future.cancel()


class InlineExecutor(Executor):
    """Runs each task at once, in the calling thread."""

    def submit(self, work: Callable[..., Any], /, *given: Any, **named: Any) -> Future[Any]:
        """Call a function at once; the future has its result or its exception."""
        future: Future[Any] = Future()
        try:
            future.set_result(work(*given, **named))
        except Exception as error:
            future.set_exception(error)
        return future


def worker_pool(
    workers: int, nice: int = 0, initializer: Callable[..., None] | None = None, *given: object
) -> ProcessPoolExecutor:
    """Return a pool of worker processes, each begun by `start_worker`."""
    spawn = multiprocessing.get_context("spawn")
    begin = functools.partial(start_worker, nice, initializer, *given)
    return ProcessPoolExecutor(workers, spawn, initializer=begin)


@contextmanager
def processes(
    workers: int, initializer: Callable[..., None] | None = None, *given: object
) -> Iterator[ProcessPoolExecutor]:
    """Pool of worker processes that call ``initializer(*given)`` first; an exception ends them."""
    pool = worker_pool(workers, NICE if _low.get() else 0, initializer, *given)
    try:
        yield pool
    except BaseException:
        end_processes(pool)
        raise
    pool.shutdown()


def end_processes(pool: ProcessPoolExecutor, wait: bool = True) -> None:
    """Terminate the processes of a pool even if they are busy; it cannot be used afterwards."""
    # A process may be sending its result: the reading thread must see the end of the pipe. A pool
    # that has ended does not read any more.
    results = getattr(pool, "_result_queue", None)
    if results is not None:
        results._writer.close()
    for process in list((pool._processes or {}).values()):
        process.terminate()
    pool.shutdown(wait, cancel_futures=True)


def start_worker(
    nice: int = 0, initializer: Callable[..., None] | None = None, *given: object
) -> None:
    """Initialise a worker process: it calls ``initializer(*given)``, if any, such as `hold`.

    The niceness is raised by ``nice``, the process computes in one thread, and it ends when its
    parent ends, even if that is killed. There is no clean-up when it ends: functions registered
    earlier with `atexit` are not called.
    """
    ignore_interrupts()
    lower_priority(nice)
    os.environ.update(dict.fromkeys(ONE_THREAD, "1"))
    threadpool_limits(1)  # for the libraries that are already loaded
    parent = multiprocessing.parent_process()

    def follow() -> None:
        if parent is not None:
            parent.join()
            os._exit(1)

    threading.Thread(target=follow, name="parent", daemon=True).start()
    atexit.register(os._exit, 0)  # unloading the libraries would take half a second
    if initializer is not None:
        initializer(*given)


_held: Any = None
"""The object that this process holds."""


def hold(make: Callable[..., Any], *given: object) -> None:
    """Make the object that this worker process holds for later calls (`held`); one at a time."""
    global _held  # noqa: PLW0603 - processes share nothing, so that each has its own
    _held = make(*given)


def held() -> Any:
    """Return the object that this process holds; None if there is none."""
    return _held


@contextmanager
def low_priority() -> Iterator[None]:
    """Start this thread's processes with a low priority, so that the interface stays responsive."""
    former = _low.set(True)
    try:
        yield
    finally:
        _low.reset(former)
