"""What measures the frames of a run (`runner.Measurer`).

`ColdMeasurer` measures each frame as if it were the first, here or in a pool of processes.
`WarmMeasurer` measures each from the one before, here; `RecordingMeasurer` does so with stretches
of a recording in processes, which make the rows of the tables, too.

Stretches are of one length, however many processes there are, and begin with a cold frame each:
results do not depend on the machine.
"""

from __future__ import annotations

import functools
import multiprocessing
import os
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from concurrent.futures import Executor, Future, ProcessPoolExecutor
from contextlib import AbstractContextManager, ExitStack, closing, contextmanager
from dataclasses import dataclass, replace
from itertools import chain, islice
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import cv2
import numpy as np
from threadpoolctl import ThreadpoolController

from labapp.config.setup import Setup
from labapp.core.pipeline import ByHand, Measurement, Settings, measure, setup_status
from labapp.core.recording.residual_check import Residuals
from labapp.errors import InputError
from labapp.export.frame_result import FrameResult, without_surface
from labapp.export.tables import table_rows
from labapp.media import Frame, GreyImage, open_source
from labapp.simulation.parallel import NICE, start_worker

if TYPE_CHECKING:
    from labapp.core.recording.chain import WarmChain

T = TypeVar("T")

AHEAD = 8
"""Number of frames submitted to a pool of processes beyond the one whose result is awaited."""

VOTERS, WAITS = 3, 5
"""A frame is judged with two more that have a surface, so that of three that disagree two decide;
so many wait at most."""

OPEN_WAITS = 20
"""So many wait at most for a frame whose rows are open."""

FOLLOWED_AT_ONCE = 400
"""Frames whose pulses are told apart together: some tens of their periods."""

STRETCH = 1000
"""Frames of a stretch: a cold frame takes as long as some two hundred that follow."""

BY_THEMSELVES = frozenset({0, 1, 2, 500})
"""These frames of a stretch are measured by themselves, so that they can vote on its rows."""

BATCH = 20
"""Frames that a process returns at a time."""

Read = Callable[[int], Frame]
"""Reads a frame by its number; raises `InputError` if it cannot."""

Corrected = Callable[[int], ByHand | None]
"""The dots and rows, or lines, of a frame as they were corrected by hand; None: they were not."""


# --- each frame by itself -----------------------------------------------------------------------


@dataclass(frozen=True)
class ColdMeasurer:
    """Measures each frame as if it were the first."""

    read: Read
    """Reads frames; one that cannot be read gets the status ``unreadable``."""
    setup: Setup
    settings: Settings
    corrected: Corrected = lambda _: None
    """Gives the corrections by hand."""
    pool: Executor | None = None
    """Where to measure (`measuring_pool`), some frames ahead; None: here, one after the other."""

    def __call__(self, frames: Iterable[int]) -> Generator[FrameResult]:
        """Measure frames; see `runner.Measurer`."""
        measured = _results_in_order(map(self._submit, frames), AHEAD)
        return _agreeing(measured, self.setup, self.settings)

    def _submit(self, number: int) -> Future[FrameResult]:
        """Read a frame here, and have it measured in the pool, or here and now."""
        frame = _read(self.read, number, self.settings)
        if isinstance(frame, FrameResult):
            return _here(lambda: frame)
        submit = _here if self.pool is None else self.pool.submit
        return submit(_cold, number, frame, self.setup, self.settings, self.corrected(number))


def _agreeing(
    measured: Generator[FrameResult], setup: Setup, settings: Settings, warm: bool = False
) -> Generator[FrameResult]:
    """Results in their order, their rows decided together with those of the others (`RowVote`).

    A frame is judged when two more with a surface are there, or after the next few.

    Parameters
    ----------
    measured
        What was measured, in its order.
    warm
        Whether frames follow on those before, but for where the track was lost.
    """
    from labapp.core.recording.row_vote import Ballot, RowVote

    vote = RowVote(setup.rig, settings)
    waiting: deque[tuple[FrameResult, Ballot]] = deque()

    def is_due() -> bool:
        first, voters = waiting[0][1], sum(ballot.at is not None for _, ballot in waiting)
        if first.at is None and not first.is_open:
            return True
        return voters >= VOTERS or len(waiting) > (OPEN_WAITS if first.is_open else WAITS)

    def judged() -> FrameResult:
        result, ballot = waiting.popleft()
        return replace(result, measurement=vote.judged(ballot))

    with closing(measured):
        try:
            for result in measured:
                found = result.measurement
                followed = warm and result.track_lost is None and found.correction is None
                waiting.append((result, vote.add(found, followed)))
                while waiting and is_due():
                    yield judged()
        except (Exception, KeyboardInterrupt):
            while waiting:
                yield judged()
            raise
        while waiting:
            yield judged()


def _here(work: Callable[..., T], *given: Any) -> Future[T]:
    """Do some work at once, as a pool without processes would."""
    future: Future[T] = Future()
    future.set_result(work(*given))
    return future


def _read(read: Read, number: int, settings: Settings) -> Frame | FrameResult:
    """The frame; if it cannot be read, its result."""
    try:
        return read(number)
    except InputError as error:
        return FrameResult(number, None, Measurement("unreadable", str(error), settings.scheme))


def _cold(
    number: int, frame: Frame, setup: Setup, settings: Settings, correction: ByHand | None
) -> FrameResult:
    """Measure a frame by itself, with its dots and rows as they were corrected."""
    with _one_thread():
        found, _ = measure(frame.image, setup.bench, settings, None, correction)
    return FrameResult(number, frame.time_s, found)


def _one_thread() -> AbstractContextManager[object]:
    """Limit BLAS to one thread: the matrices are small, and more threads are slower."""
    limited: AbstractContextManager[object] = _threads().limit(limits=1, user_api="blas")
    return limited


@functools.cache
def _threads() -> ThreadpoolController:
    """Control of the BLAS libraries that are loaded; made once, as that takes milliseconds."""
    import scipy.linalg  # noqa: F401 - it has a BLAS of its own, which is else loaded later

    return ThreadpoolController()


def measuring_pool(workers: int) -> ProcessPoolExecutor:
    """Processes that measure: a window stays quick while they do."""
    spawn = multiprocessing.get_context("spawn")
    return ProcessPoolExecutor(workers, spawn, initializer=start_worker, initargs=(NICE,))


def _results_in_order(begun: Iterable[Future[T]], ahead: int) -> Generator[T]:
    """Results in their order, some begun ahead, which are cancelled if it is closed early."""
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


# --- one line, over all frames ------------------------------------------------------------------


@dataclass(frozen=True)
class LineFollower:
    """Follows the line of a pattern of one (§3.3) through frames in order, sorted by pulse."""

    read: Read
    setup: Setup
    settings: Settings
    """As of `ColdMeasurer`."""

    def __call__(self, frames: Iterable[int]) -> Generator[FrameResult]:
        """Measure frames; see `runner.Measurer`. Results come a stretch at a time."""
        from labapp.core.lines.frame import LineFrame
        from labapp.core.lines.track import LineTracker, track_line

        tracker, numbers = LineTracker(), iter(frames)
        while chosen := list(islice(numbers, FOLLOWED_AT_ONCE)):
            begun = [(number, _read(self.read, number, self.settings)) for number in chosen]
            seen = [frame for _, frame in begun if isinstance(frame, Frame)]
            steps = np.diff([np.nan if one.time_s is None else one.time_s for one in seen])
            step = float(np.median(steps)) if len(steps) else 0.0
            film = track_line((one.image for one in seen), 1 / step if step > 0 else None,
                              tracker=tracker)  # fmt: skip
            pulses = film.pulses
            followed = zip(film.lines, pulses.on.tolist(), pulses.probability.tolist(), strict=True)
            for number, frame in begun:
                if isinstance(frame, FrameResult):
                    yield frame
                    continue
                lines = LineFrame.of_track(*next(followed))
                found = Measurement(lines.status, lines.reason, self.settings.scheme, lines=lines)
                status = setup_status(self.setup.rig)
                yield FrameResult(number, frame.time_s, replace(found, setup_status=status))


# --- each frame from the one before -------------------------------------------------------------


@dataclass(frozen=True)
class WarmMeasurer:
    """Measures each frame from the one before, in stretches (`WarmChain`).

    A frame that was corrected by hand is measured by itself, as it was corrected. Such a frame, one
    that cannot be read and a change of the step between frames are gaps (`WarmChain.skip`).
    """

    read: Read
    setup: Setup
    settings: Settings
    corrected: Corrected = lambda _: None
    """As of `ColdMeasurer`."""
    pool: Executor | None = None
    """One process to measure in (`measuring_pool`); None: here."""

    def __call__(self, frames: Iterable[int]) -> Generator[FrameResult]:
        """Measure frames; see `runner.Measurer`."""
        rest = iter(frames)
        for first in rest:
            stretch = self._stretch(chain([first], islice(rest, STRETCH - 1)))
            yield from _agreeing(stretch, self.setup, self.settings, warm=True)

    def _stretch(self, frames: Iterable[int]) -> Generator[FrameResult]:
        last: int | None = None
        step: int | None = None
        for place, number in enumerate(frames):
            if place in BY_THEMSELVES:
                warm = self._chain()
            before = None if last is None else number - last
            if step is not None and before != step:
                warm.skip()
            last, step = number, before
            frame = _read(self.read, number, self.settings)
            if isinstance(frame, FrameResult):
                warm.skip()
                yield frame
            elif (correction := self.corrected(number)) is not None:
                warm.skip()
                yield _cold(number, frame, self.setup, self.settings, correction)
            else:
                with _one_thread():
                    found = warm.measure(frame.image)
                yield FrameResult(number, frame.time_s, found, warm.track_lost)

    def _chain(self) -> WarmChain | _ChainElsewhere:
        from labapp.core.recording.chain import WarmChain

        if self.pool is None:
            return WarmChain(self.setup.bench, self.settings)
        return _ChainElsewhere(self.pool, self.setup, self.settings)


class _ChainElsewhere:
    """A `WarmChain` in another process."""

    def __init__(self, pool: Executor, setup: Setup, settings: Settings) -> None:
        self.track_lost: str | None = None
        self._pool = pool
        pool.submit(_begin_chain, setup, settings)

    def skip(self) -> None:
        """Leave out a frame."""
        self._pool.submit(_skip_in_chain)

    def measure(self, image: GreyImage) -> Measurement:
        """Measure the next frame."""
        found, self.track_lost = self._pool.submit(_measure_in_chain, image).result()
        return found


_chain: WarmChain | None = None
"""The chain of this process, for `_ChainElsewhere`."""


def _begin_chain(setup: Setup, settings: Settings) -> None:
    global _chain  # noqa: PLW0603 - one chain at a time
    from labapp.core.recording.chain import WarmChain

    cv2.setNumThreads(1)
    _chain = WarmChain(setup.bench, settings)


def _skip_in_chain() -> None:
    assert _chain is not None
    _chain.skip()


def _measure_in_chain(image: GreyImage) -> tuple[Measurement, str | None]:
    assert _chain is not None
    with _one_thread():
        found = _chain.measure(image)
    return found, _chain.track_lost


@dataclass(frozen=True)
class RecordingMeasurer:
    """Measures each frame of a recording from the one before, many stretches at once.

    Each process opens the recording itself. Results have the rows of the tables (`FrameResult`).

    Raises
    ------
    InputError
        While frames are measured, if the recording cannot be opened.
    """

    path: Path
    index: bytes | None
    """The recording, and what opening it found out (`FrameSource.index`), where it was."""
    setup: Setup
    settings: Settings
    with_surfaces: bool = False
    """Whether results have dots, rays and surface, too: to pass them from process to process takes
    a twentieth of the time that it took to measure them.
    """
    sigma_parts: bool = False
    """Whether rows have the parts of standard uncertainties, too."""
    pools: Sequence[Executor] = ()
    """Where to measure (`stretch_pools`); none: in this process."""

    def __call__(self, frames: Iterable[int]) -> Generator[FrameResult]:
        """Measure frames; see `runner.Measurer`."""
        return self._in_processes(list(frames)) if self.pools else self._here(frames)

    def _here(self, frames: Iterable[int]) -> Generator[FrameResult]:
        with open_source(self.path, self.index) as source:
            for result in WarmMeasurer(source.frame, self.setup, self.settings)(frames):
                found = result.measurement
                yield replace(
                    result,
                    measurement=found if self.with_surfaces else without_surface(found),
                    residuals=None if self.with_surfaces else Residuals.of(found),
                    rows=table_rows(result, self.setup.calibration, self.sigma_parts),
                )

    def _in_processes(self, frames: Sequence[int]) -> Generator[FrameResult]:
        there = replace(self, pools=())
        if there.index is None:  # found out once, for all of them
            with open_source(self.path) as source:
                there = replace(there, index=source.index)

        def begun() -> Iterator[Future[list[FrameResult]]]:
            for k, at in enumerate(range(0, len(frames), STRETCH)):
                pool, stretch = self.pools[k % len(self.pools)], frames[at : at + STRETCH]
                yield pool.submit(_first_batch, there, stretch)
                for _ in range(BATCH, len(stretch), BATCH):
                    yield pool.submit(_next_batch)

        batches = -(-STRETCH // BATCH)
        for batch in _results_in_order(begun(), len(self.pools) * batches):
            yield from batch


_stretch: Generator[FrameResult] | None = None
"""The stretch that this process measures."""


def _first_batch(measurer: RecordingMeasurer, frames: Sequence[int]) -> list[FrameResult]:
    """Begin a stretch in this process, in place of the one before."""
    global _stretch  # noqa: PLW0603 - a stretch stays in the process that began it
    if _stretch is not None:
        _stretch.close()
    cv2.setNumThreads(1)
    _stretch = measurer(frames)
    return _next_batch()


def _next_batch() -> list[FrameResult]:
    assert _stretch is not None
    return list(islice(_stretch, BATCH))


@contextmanager
def stretch_pools(frames: int, workers: int | None = None) -> Iterator[list[Executor]]:
    """Start processes for a `RecordingMeasurer`; each loads its modules meanwhile.

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
            pool.submit(_load)
        yield pools


def await_loaded(pools: Sequence[Executor]) -> None:
    """Wait until `stretch_pools` have loaded their modules."""
    for loaded in [pool.submit(_load) for pool in pools]:
        loaded.result()


def _load() -> None:
    """Load in this process all that measures."""
    import labapp.core.matching.match_kernels
    import labapp.core.rows.lattice_kernels
    import labapp.core.sequence.following
    import labapp.export.fixed_point  # noqa: F401
