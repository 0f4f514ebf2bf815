"""A recording measured frame from frame (`core.sequence.warm`), long stretches of it at once.

Stretches are of one length, however many processes there are, and begin with a cold frame each:
results do not depend on the machine. A process opens the recording itself, and gives back what it
measured together with the rows of its tables.
"""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Executor, Future
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path

import cv2
from threadpoolctl import ThreadpoolController

from labapp.config.setup import Setup
from labapp.core.pipeline import Measurement, Settings, measure
from labapp.core.rows.correction import Correction
from labapp.errors import InputError
from labapp.export.results import ResultsWriter
from labapp.media import Frame, FrameSource, open_source
from labapp.run.runner import measuring_pool

STRETCH = 1000
"""Frames of a stretch: a cold frame takes as long as some two hundred that follow."""

BATCH = 20
"""Frames that a process gives back at a time."""


@dataclass(frozen=True)
class Told:
    """What one frame gave.

    Parameters
    ----------
    frame, time_s
        Its number, and its time where it has one.
    measurement
        What was measured: all of it, or the status, the reason and the measures (`Job.whole`).
    broke
        Why it was not measured from the frame before; None if it was.
    rows
        Its rows of each table, as CSV text.
    """

    frame: int
    time_s: float | None
    measurement: Measurement
    broke: str | None
    rows: dict[str, str]


@dataclass(frozen=True)
class Job:
    """What is measured, and with what.

    Parameters
    ----------
    path, index
        The recording, and what opening it found out (`FrameSource.index`), where it was.
    setup, settings
        What it is measured with.
    whole
        Whether dots, rays and surface are handed over besides the rows: that takes a twentieth of
        the time that it took to measure them.
    """

    path: Path
    index: bytes | None
    setup: Setup
    settings: Settings
    whole: bool = False


@contextmanager
def followers(frames: int, workers: int | None = None) -> Iterator[list[Executor]]:
    """Begin processes that measure stretches, one each; they load meanwhile what they need.

    Parameters
    ----------
    frames
        How many are to be measured: there are no more processes than stretches.
    workers
        How many processes; None: one a core; 0: none.
    """
    stretches = -(-frames // STRETCH)
    with ExitStack() as at_end:
        pools: list[Executor] = []
        for _ in range(min(os.cpu_count() or 1 if workers is None else workers, stretches)):
            pools.append(pool := measuring_pool(1))
            at_end.callback(pool.shutdown, cancel_futures=True)
            pool.submit(_ready)
        yield pools


def await_ready(pools: Sequence[Executor]) -> None:
    """Wait until `followers` have loaded what they need."""
    for told in [pool.submit(_ready) for pool in pools]:
        told.result()


def measure_sequence(job: Job, frames: Sequence[int], pools: Sequence[Executor]) -> Iterator[Told]:
    """Measure frames in their order, each from the one before.

    Parameters
    ----------
    job
        What to measure.
    frames
        Numbers of the frames, as they follow on each other.
    pools
        Where to measure (`followers`); none: here.

    Raises
    ------
    InputError
        If the recording cannot be opened.
    """
    stretches = [frames[at : at + STRETCH] for at in range(0, len(frames), STRETCH)]
    if not pools:
        for stretch in stretches:
            with closing(Following(job)) as following:
                for at in range(0, len(stretch), BATCH):
                    yield from following.measure_all(stretch[at : at + BATCH])
        return
    if job.index is None:  # found out once, for all of them
        with open_source(job.path) as source:
            job = replace(job, index=source.index)
    begun: deque[deque[Future[list[Told]]]] = deque()
    waiting = iter(enumerate(stretches))
    begun += (_begun(pools[k % len(pools)], job, s) for k, s in islice(waiting, len(pools)))
    try:
        while begun:
            while begun[0]:
                yield from begun[0].popleft().result()
            begun.popleft()
            begun += (_begun(pools[k % len(pools)], job, s) for k, s in islice(waiting, 1))
    finally:
        for batches in begun:
            for future in batches:
                future.cancel()


def follow_frames(
    path: Path,
    index: bytes | None,
    frames: Sequence[int],
    setup: Setup,
    settings: Settings,
    results: ResultsWriter,
) -> Iterator[tuple[int, float | None, Measurement]]:
    """Measure frames of a recording by `measure_sequence` and write each, as `run.measure_frames`.

    Without surface files the measurements are not whole (`Job`).

    Raises
    ------
    InputError
        If the recording cannot be opened, or a frame's results cannot be written.
    """
    with followers(len(frames)) as pools:
        job = Job(path, index, setup, settings, whole=results.surfaces)
        for told in measure_sequence(job, frames, pools):
            results.write(told.frame, told.time_s, told.measurement, told.rows)
            yield told.frame, told.time_s, told.measurement


def follow_each(
    frames: Iterable[int],
    read: Callable[[int], Frame],
    setup: Setup,
    settings: Settings,
    correction: Callable[[int], Correction | None],
) -> Iterator[tuple[int, float | None, Measurement]]:
    """Measure frames as `run.measure_each` does, but each from the one before, and here.

    A frame that was corrected by hand is measured as it was corrected.
    """
    from labapp.core.sequence.warm import WarmChain

    threads, chain = ThreadpoolController(), WarmChain(setup.rig, setup.calibration, settings)
    for place, number in enumerate(frames):
        if place % STRETCH == 0:
            chain = WarmChain(setup.rig, setup.calibration, settings)
        try:
            frame = read(number)
        except InputError as error:
            yield number, None, Measurement("unreadable", str(error), settings.scheme)
            continue
        corrected = correction(number)
        with threads.limit(limits=1, user_api="blas"):
            if corrected is None:
                measurement = chain.measure(frame.image)
            else:
                bench = (setup.rig, setup.calibration, settings)
                measurement = measure(frame.image, *bench, corrected)
        yield number, frame.time_s, measurement


def _begun(pool: Executor, job: Job, stretch: Sequence[int]) -> deque[Future[list[Told]]]:
    """Give a stretch to a process, batch by batch."""
    return deque(
        pool.submit(_measured, job if at == 0 else None, stretch[at : at + BATCH])
        for at in range(0, len(stretch), BATCH)
    )


def _ready() -> None:
    """Have a process start, and load what it measures with."""
    import labapp.core.matching.match_kernels
    import labapp.core.rows.lattice_kernels
    import labapp.core.sequence.warm
    import labapp.export.fixed_point  # noqa: F401


class Following:
    """Measures one stretch of a recording."""

    def __init__(self, job: Job) -> None:
        from labapp.core.sequence.warm import WarmChain
        from labapp.export.tables import table_rows

        self._job, self._rows = job, table_rows
        self._source: FrameSource = open_source(job.path, job.index)
        self._threads = ThreadpoolController()
        self._chain = WarmChain(job.setup.rig, job.setup.calibration, job.settings)

    def measure(self, number: int) -> Told:
        """Measure the next frame."""
        time_s, broke = None, None
        try:
            frame = self._source.frame(number)
        except InputError as error:
            measurement = Measurement("unreadable", str(error), self._job.settings.scheme)
        else:
            time_s = frame.time_s
            measurement = self._chain.measure(frame.image)
            broke = self._chain.broke
        rows = self._rows(number, time_s, measurement, self._job.setup.calibration)
        if not self._job.whole:
            measurement = replace(
                measurement, dots=None, lattice=None, match=None, reconstruction=None
            )
        return Told(number, time_s, measurement, broke, rows)

    def measure_all(self, numbers: Sequence[int]) -> list[Told]:
        """Measure the next frames."""
        # Matrices are small: more threads than one get in each other's way.
        with self._threads.limit(limits=1, user_api="blas"):
            return [self.measure(number) for number in numbers]

    def close(self) -> None:
        """Let go of the recording."""
        self._source.close()


_following: Following | None = None
"""The stretch that this process is at."""


def _measured(job: Job | None, numbers: Sequence[int]) -> list[Told]:
    global _following  # noqa: PLW0603 - a stretch stays in the process that began it
    if job is not None:
        if _following is not None:
            _following.close()
        cv2.setNumThreads(1)
        _following = Following(job)
    assert _following is not None
    return _following.measure_all(numbers)
