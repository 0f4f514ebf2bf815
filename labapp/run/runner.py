"""A run: frames of a source, each measured and written, one after the other."""

from __future__ import annotations

import dataclasses
import multiprocessing
import os
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Executor, Future, ProcessPoolExecutor
from pathlib import Path
from typing import Any

from threadpoolctl import ThreadpoolController

from labapp.config.setup import Setup
from labapp.core.pipeline import Measurement, Settings, measure
from labapp.core.rows.correction import Correction
from labapp.errors import InputError
from labapp.export.results import ResultsWriter
from labapp.media import Frame, FrameSource
from labapp.simulation.parallel import NICE, begin_worker

AHEAD = 8
"""So many frames are given to a pool before the first of them must be done."""

SOME_FRAMES = "A:B:STEP, frames A to before B (from 0), every STEP-th; each may be left out"


def select_frames(text: str, count: int) -> range:
    """Frames that ``A:B:STEP`` selects from ``count``, as a Python slice does; ``A`` is one frame.

    Raises
    ------
    InputError
        If it is not of that form, or selects nothing.
    """
    try:
        first, *others = (int(part) if part.strip() else None for part in text.split(":"))
        if first is not None and not others:
            others = [first + 1 or None]
        selected = range(count)[slice(first, *others)]
    except (TypeError, ValueError) as error:  # TypeError: no number at all, or four
        raise InputError("--frames", "frames", text, SOME_FRAMES) from error
    if selected.step < 0:
        raise InputError("--frames", "frames", text, SOME_FRAMES)
    if not selected:
        raise InputError("--frames", "frames", text, f"some of the frames 0 to {count - 1}")
    return selected


def provenance(
    source: FrameSource,
    source_path: str | os.PathLike[str],
    setup_path: str | os.PathLike[str],
    setup: Setup,
    settings: Settings,
    frames: range,
    warm: bool = False,
) -> dict[str, object]:
    """What `run.json` tells of where results come from."""
    return {
        "source": {
            "path": str(Path(source_path).absolute()),
            "frames": len(source),
            "frame_rate_hz": source.frame_rate_hz,
            "rows": source.shape[0],
            "columns": source.shape[1],
            "warnings": list(source.warnings),
        },
        "frames": {"start": frames.start, "stop": frames.stop, "step": frames.step},
        "settings": dataclasses.asdict(settings),
        "warm": warm,
        "setup": {"path": str(Path(setup_path).absolute()), "toml": setup.text},
    }


def measure_each(
    frames: Iterable[int],
    read: Callable[[int], Frame],
    setup: Setup,
    settings: Settings,
    correction: Callable[[int], Correction | None] = lambda _: None,
    pool: Executor | None = None,
) -> Iterator[tuple[int, float | None, Measurement]]:
    """Measure frames; yields (frame, time in s, measurement) in their order.

    Parameters
    ----------
    frames
        Their numbers.
    read
        Reads a frame; one that raises `InputError` gets the status ``unreadable``.
    setup, settings
        What they are measured with.
    correction
        The dots and rows of a frame as they were corrected by hand, or None.
    pool
        Where to measure (`measuring_pool`), some frames ahead; None: here, one after the other.
    """
    waiting: deque[tuple[int, float | None, Future[Measurement]]] = deque()
    try:
        for number in frames:
            try:
                frame = read(number)
            except InputError as error:
                future: Future[Measurement] = Future()
                future.set_result(Measurement("unreadable", str(error), settings.scheme))
                waiting.append((number, None, future))
            else:
                given = (frame.image, setup.rig, setup.calibration, settings, correction(number))
                waiting.append((number, frame.time_s, _begun(pool, given)))
            while waiting and (pool is None or len(waiting) > AHEAD or waiting[0][2].done()):
                first, time_s, future = waiting.popleft()
                yield first, time_s, future.result()
        for later, time_s, future in waiting:
            yield later, time_s, future.result()
    finally:
        for _, _, future in waiting:
            future.cancel()


def measuring_pool(workers: int) -> ProcessPoolExecutor:
    """Processes that measure: a window stays quick while they do."""
    spawn = multiprocessing.get_context("spawn")
    return ProcessPoolExecutor(workers, spawn, initializer=begin_worker, initargs=(NICE,))


def _begun(pool: Executor | None, given: tuple[Any, ...]) -> Future[Measurement]:
    if pool is not None:
        return pool.submit(_measured, *given)
    future: Future[Measurement] = Future()
    future.set_result(_measured(*given))
    return future


def _measured(*given: Any) -> Measurement:
    # The matrices are small: more threads than one get in each other's way.
    with ThreadpoolController().limit(limits=1, user_api="blas"):
        return measure(*given)


def measure_frames(
    source: FrameSource,
    frames: Iterable[int],
    setup: Setup,
    settings: Settings,
    results: ResultsWriter,
) -> Iterator[tuple[int, float | None, Measurement]]:
    """Measure frames of a source and write each; yields as `measure_each` does, once written.

    Raises
    ------
    InputError
        If a frame's results cannot be written.
    """
    for number, time_s, measurement in measure_each(frames, source.frame, setup, settings):
        results.write(number, time_s, measurement)
        yield number, time_s, measurement
