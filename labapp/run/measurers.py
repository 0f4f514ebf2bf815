"""Measurers of the frames of a run (`runner.Measurer`).

`ColdMeasurer` measures each frame without a prior; neighbouring frames then vote on its rows.
`WarmMeasurer` tracks each frame from the previous one. `RecordingMeasurer` tracks
stretches of a recording in several processes, which also compute the rows of the tables.

Stretches have the same length, however many processes there are, and each begins with three
frames measured without tracking (`COLD_AT_START`), so that results do not depend on the machine.
"""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from concurrent.futures import Executor, Future, ProcessPoolExecutor
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass, replace
from itertools import chain, islice
from pathlib import Path
from typing import TYPE_CHECKING

import cv2

from labapp.config.setup import Setup
from labapp.core.pipeline import FrameCorrection, Measurement, Settings, measure
from labapp.core.recording.residual_check import Residuals
from labapp.errors import InputError
from labapp.export.frame_result import FrameResult, without_surface
from labapp.export.tables import table_rows
from labapp.media import Frame, GreyImage, open_source
from labapp.simulation.parallel import (
    NICE,
    InlineExecutor,
    blas,
    held,
    hold,
    in_order,
    one_thread,
    worker_pool,
)

if TYPE_CHECKING:
    from labapp.core.recording.chain import WarmChain
    from labapp.core.recording.row_vote import Ballot, RowVote

AHEAD = 8
"""Number of frames submitted to a pool of processes beyond the one whose result is awaited."""

VOTERS = 3
"""Frames with a surface that vote on the rows of a frame, itself included: there is a majority."""

MOST_WAITING = 5
"""The most frames that wait for them."""

MOST_WAITING_FOR_OPEN = 20
"""The most frames that wait for votes on a frame whose rows are ambiguous."""

STRETCH = 500
"""Frames of a stretch. A frame measured without tracking takes as long as ten to twenty tracked
ones."""

COLD_AT_START = frozenset({0, 1, 2})
"""Frames of a stretch that are measured without tracking, to vote independently on its rows."""

BATCH, READ_AT_ONCE = 20, 8
"""Frames that a process returns at once, and tracked frames that are read at once."""

Read = Callable[[int], Frame]
"""Reads a frame by its number; raises `InputError` if it cannot."""

Corrected = Callable[[int], FrameCorrection | None]
"""Returns a frame's manually corrected dots and rows, or lines; None if there are none."""


# --- each frame by itself -----------------------------------------------------------------------


@dataclass(frozen=True)
class ColdMeasurer:
    """Measures each frame without a prior; its neighbours vote on its rows (`_with_rows_voted`)."""

    read: Read
    """Reads frames; one that cannot be read gets the status ``unreadable``."""
    setup: Setup
    settings: Settings
    corrected: Corrected = lambda _: None
    """Returns manual corrections."""
    pool: Executor | None = None
    """Pool of processes (`measuring_pool`), used some frames ahead; None: this process."""

    def __call__(self, frames: Iterable[int]) -> Generator[FrameResult]:
        """Measure frames; see `runner.Measurer`."""
        measured = in_order(map(self._submit, frames), AHEAD)
        return _with_rows_voted(measured, _new_vote(self.setup, self.settings))

    def _submit(self, number: int) -> Future[FrameResult]:
        """Read a frame in this process, and measure it in the pool, or at once if there is none."""
        frame = read_frame(self.read, number, self.setup, self.settings)
        if isinstance(frame, FrameResult):
            return InlineExecutor().submit(lambda: frame)
        pool = self.pool or InlineExecutor()
        return pool.submit(_cold, number, frame, self.setup, self.settings, self.corrected(number))


def _new_vote(setup: Setup, settings: Settings) -> RowVote:
    from labapp.core.recording.row_vote import RowVote

    return RowVote(setup.rig, settings)


def _with_rows_voted(
    measured: Generator[FrameResult], vote: RowVote, warm: bool = False
) -> Generator[FrameResult]:
    """Yield results in order, with rows decided by a vote among neighbouring frames (`RowVote`).

    A frame is judged as soon as `VOTERS` frames with a surface are known, or after
    `MOST_WAITING` frames. ``warm``: frames are tracked, except where the track was lost.
    """
    waiting: deque[tuple[FrameResult, Ballot]] = deque()

    def is_due() -> bool:
        first, voters = waiting[0][1], sum(ballot.shift is not None for _, ballot in waiting)
        if first.shift is None and not first.is_open:
            return True
        most = MOST_WAITING_FOR_OPEN if first.is_open else MOST_WAITING
        return voters >= VOTERS or len(waiting) > most

    def judged() -> FrameResult:
        result, ballot = waiting.popleft()
        return replace(result, measurement=vote.judged(ballot))

    with closing(measured):
        try:
            for result in measured:
                found = result.measurement
                tracked = warm and result.track_lost is None and found.correction is None
                waiting.append((result, vote.add(found, tracked)))
                while waiting and is_due():
                    yield judged()
        except (Exception, KeyboardInterrupt):
            while waiting:
                yield judged()
            raise
        while waiting:
            yield judged()


def read_frame(read: Read, number: int, setup: Setup, settings: Settings) -> Frame | FrameResult:
    """Return the frame, or its result if it cannot be read.

    Raises
    ------
    InputError
        If its size is not that of the picture with which the set-up was calibrated.
    """
    try:
        frame = read(number)
    except InputError as error:
        return FrameResult(number, None, Measurement("unreadable", str(error), settings.scheme))
    setup.require_size(frame.image.shape, f"frame {number}")
    return frame


def _cold(
    number: int, frame: Frame, setup: Setup, settings: Settings, correction: FrameCorrection | None
) -> FrameResult:
    """Measure a frame independently, with its manual correction, if any."""
    with one_thread():
        found, _ = measure(frame.image, setup.bench, settings, None, correction)
    return FrameResult(number, frame.time_s, found)


def measuring_pool(workers: int) -> ProcessPoolExecutor:
    """Return a pool of measuring processes, which have low priority."""
    return worker_pool(workers, NICE)


# --- tracking from frame to frame ---------------------------------------------------------------


@dataclass(frozen=True)
class WarmMeasurer:
    """Tracks each frame from the previous one, in stretches (`WarmChain`).

    After a frame whose rows are outvoted the next is measured without tracking, and votes: if the
    pool has moved by the spacing of the rays, the vote turns. A manually corrected frame is
    measured independently. Corrected frames, unreadable frames and changes of the step between
    frames are gaps for the track (`WarmChain.skip`).
    """

    read: Read
    setup: Setup
    settings: Settings
    corrected: Corrected = lambda _: None
    """As for `ColdMeasurer`."""
    pool: Executor | None = None
    """Pool of one process (`measuring_pool`); None: this process."""

    def __call__(self, frames: Iterable[int]) -> Generator[FrameResult]:
        """Measure frames; see `runner.Measurer`."""
        rest = iter(frames)
        for first in rest:
            vote = _new_vote(self.setup, self.settings)
            stretch = self._stretch(chain([first], islice(rest, STRETCH - 1)), vote)
            yield from _with_rows_voted(stretch, vote, warm=True)

    def _stretch(self, frames: Iterable[int], vote: RowVote) -> Generator[FrameResult]:
        warm, place = self._chain(), 0
        last: int | None = None
        step: int | None = None
        for read in self._read_ahead(frames):
            warm.look_ahead(frame.image for _, frame in read if isinstance(frame, Frame))
            for number, frame in read:
                if place in COLD_AT_START or vote.is_outvoted:
                    warm = self._chain()
                before = None if last is None else number - last
                if step is not None and before != step:
                    warm.skip()
                place, last, step = place + 1, number, before
                if isinstance(frame, FrameResult):
                    warm.skip()
                    yield frame
                elif (correction := self.corrected(number)) is not None:
                    warm.skip()
                    yield _cold(number, frame, self.setup, self.settings, correction)
                else:
                    with one_thread():
                        found = warm.measure(frame.image)
                    yield FrameResult(number, frame.time_s, found, warm.track_lost)

    def _read_ahead(self, frames: Iterable[int]) -> Iterator[list[tuple[int, Frame | FrameResult]]]:
        """Yield numbers and frames (`read_frame`), some at once, see `_next_batch`."""
        numbers = iter(frames)
        while chosen := list(islice(numbers, READ_AT_ONCE)):
            read: list[tuple[int, Frame | FrameResult]] = []
            try:
                for number in chosen:
                    read.append((number, read_frame(self.read, number, self.setup, self.settings)))
            except InputError:  # after the frames before it
                yield read
                raise
            yield read

    def _chain(self) -> WarmChain | _ChainInProcess:
        from labapp.core.recording.chain import WarmChain

        if self.pool is None:
            return WarmChain(self.setup.bench, self.settings)
        return _ChainInProcess(self.pool, self.setup, self.settings)


class _ChainInProcess:
    """A `WarmChain` in another process."""

    def __init__(self, pool: Executor, setup: Setup, settings: Settings) -> None:
        self.track_lost: str | None = None
        self._pool = pool
        pool.submit(hold, _new_chain, setup, settings)

    def look_ahead(self, images: Iterable[GreyImage]) -> None:
        """Do nothing, as each frame is passed by itself."""

    def skip(self) -> None:
        """Skip a frame."""
        self._pool.submit(_skip_in_chain)

    def measure(self, image: GreyImage) -> Measurement:
        """Measure the next frame."""
        found, self.track_lost = self._pool.submit(_measure_in_chain, image).result()
        return found


def _new_chain(setup: Setup, settings: Settings) -> WarmChain:
    from labapp.core.recording.chain import WarmChain

    cv2.setNumThreads(1)
    return WarmChain(setup.bench, settings)


def _skip_in_chain() -> None:
    held().skip()


def _measure_in_chain(image: GreyImage) -> tuple[Measurement, str | None]:
    warm: WarmChain = held()
    with one_thread():
        found = warm.measure(image)
    return found, warm.track_lost


@dataclass(frozen=True)
class RecordingMeasurer:
    """Tracks the frames of a recording, many stretches at once.

    Each process opens the recording itself. Results have the rows of the tables (`FrameResult`).

    Raises
    ------
    InputError
        During iteration, if the recording cannot be opened.
    """

    path: Path
    index: bytes | None
    """The recording, and its index if known (`FrameSource.index`)."""
    setup: Setup
    settings: Settings
    with_surfaces: bool = False
    """Whether results also have dots, rays and surface. Passing these between processes takes a
    twentieth of the measuring time.
    """
    sigma_parts: bool = False
    """Whether rows also have the parts of standard uncertainties."""
    pools: Sequence[Executor] = ()
    """Pools of one process each (`stretch_pools`); empty: this process."""

    def __call__(self, frames: Iterable[int]) -> Generator[FrameResult]:
        """Measure frames; see `runner.Measurer`."""
        if self.pools:
            return self._in_processes(list(frames))
        return (self.with_rows(result) for result in self.measured(frames))

    def measured(self, frames: Iterable[int]) -> Generator[FrameResult]:
        """Measure frames in this process, without the rows of the tables."""
        with open_source(self.path, self.index) as source:
            yield from WarmMeasurer(source.frame, self.setup, self.settings)(frames)

    def with_rows(self, result: FrameResult) -> FrameResult:
        """Add the rows of the tables to a result, and omit what they replace."""
        found = result.measurement
        return replace(
            result,
            measurement=found if self.with_surfaces else without_surface(found),
            residuals=None if self.with_surfaces else Residuals.of(found),
            rows=table_rows(result, self.setup.calibration, self.sigma_parts),
        )

    def _in_processes(self, frames: Sequence[int]) -> Generator[FrameResult]:
        there = replace(self, pools=())
        if there.index is None:  # determine it once for all processes
            with open_source(self.path) as source:
                there = replace(there, index=source.index)

        def begun() -> Iterator[Future[list[FrameResult]]]:
            for k, at in enumerate(range(0, len(frames), STRETCH)):
                pool, stretch = self.pools[k % len(self.pools)], frames[at : at + STRETCH]
                yield pool.submit(_first_batch, there, stretch)
                for _ in range(BATCH, len(stretch), BATCH):
                    yield pool.submit(_next_batch)

        batches = -(-STRETCH // BATCH)
        for batch in in_order(begun(), len(self.pools) * batches):
            yield from batch


def _first_batch(measurer: RecordingMeasurer, frames: Sequence[int]) -> list[FrameResult]:
    """Begin a stretch in this process, and end the previous one."""
    if held() is not None:
        held()[1].close()
    cv2.setNumThreads(1)
    hold(lambda: (measurer, measurer.measured(frames)))
    return _next_batch()


def _next_batch() -> list[FrameResult]:
    """Return the next results of the stretch that this process holds.

    All frames come before all rows: the processor's caches hold the code and data of one task.
    """
    measurer, results = held()
    return list(map(measurer.with_rows, list(islice(results, BATCH))))


@contextmanager
def stretch_pools(frames: int, workers: int | None = None) -> Iterator[list[Executor]]:
    """Start processes for a `RecordingMeasurer`, which load their modules in the background.

    Parameters
    ----------
    frames
        Number of frames to be measured; there are no more processes than stretches.
    workers
        Number of processes; None: one per core; 0: none.
    """
    stretches = -(-frames // STRETCH)
    with ExitStack() as at_end:
        pools: list[Executor] = []
        for _ in range(min(os.cpu_count() or 1 if workers is None else workers, stretches)):
            pools.append(pool := measuring_pool(1))
            at_end.callback(pool.shutdown, cancel_futures=True)
            pool.submit(load_all)
        yield pools


def await_loaded(pools: Sequence[Executor]) -> None:
    """Wait until `stretch_pools` have loaded their modules."""
    for loaded in [pool.submit(load_all) for pool in pools]:
        loaded.result()


def load_all() -> None:
    """Import all modules for measuring a video in this process: it takes longer than 100 frames."""
    import scipy.spatial  # noqa: F401 - otherwise loaded when it is first used

    import labapp.core.images.centroid_kernels
    import labapp.core.images.prominence_kernels
    import labapp.core.images.size_kernels
    import labapp.core.matching.initial.quadric_kernels
    import labapp.core.matching.label_growth_kernels
    import labapp.core.matching.match_kernels
    import labapp.core.recording.chain
    import labapp.core.recording.row_vote
    import labapp.core.rows.jump_kernels
    import labapp.core.rows.lattice_kernels
    import labapp.core.surface.kernels.boundary_kernels
    import labapp.core.surface.kernels.fit_kernels
    import labapp.core.surface.kernels.setup_kernels
    import labapp.core.surface.kernels.shape_kernels
    import labapp.export.fixed_point
    import labapp.media.formats.video  # noqa: F401

    blas()
