"""The loop that measures frames: `run`, for the command line, sessions and the benchmark.

Callers choose how frames are measured (a `Measurer`, see `measurers`) and where results go
(`Sink`). A live camera has another loop (`live_watch`), in which the measuring time determines the
next frame.
"""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Callable, Generator, Iterable, Sequence
from contextlib import closing
from dataclasses import replace
from pathlib import Path

from labapp.config.setup import Setup
from labapp.core.pipeline import Settings
from labapp.core.recording.residual_check import ResidualRecord
from labapp.errors import InputError, require
from labapp.export.frame_result import FrameResult
from labapp.media import FrameSource
from labapp.simulation.parallel import one_thread

Measurer = Callable[[Iterable[int]], Generator[FrameResult]]
"""Measures frames, given by their numbers, in order. Closing it cancels frames in progress."""

Sink = Callable[[FrameResult], object]
"""Receives each result in turn. An exception ends the run."""

SOME_FRAMES = (
    "A:B:STEP, frames A up to but not including B (from 0), every STEP-th; parts may be omitted"
)


def run(frames: Iterable[int], measurer: Measurer, sinks: Sequence[Sink]) -> Generator[FrameResult]:
    """Measure frames in this order, pass each result to every sink in turn, then yield it.

    To stop, close the generator or raise in a sink: frames in progress are cancelled.
    """
    with closing(measurer(frames)) as results:
        for result in results:
            for sink in sinks:
                sink(result)
            yield result


def with_setup_check(measurer: Measurer, record: ResidualRecord) -> Measurer:
    """Return a measurer whose results include the check of the set-up by the frames so far."""

    def measure(frames: Iterable[int]) -> Generator[FrameResult]:
        # More threads would also take the processors from the measuring processes.
        with one_thread(), closing(measurer(frames)) as results:
            for result in results:
                measurement = record.add_and_judge(result.measurement, result.residuals)
                yield replace(result, measurement=measurement, setup_doubt=record.doubt)

    return measure


def select_frames(text: str, count: int, option: str = "--frames") -> range:
    """Return those of ``count`` frames that ``A:B:STEP`` selects, as a Python slice does.

    ``A`` alone is one frame.

    Raises
    ------
    InputError
        If the text is not of that form, or selects no frame; it names ``option``.
    """
    require(text, str, option, "frames", f'text such as "0:100:5": {SOME_FRAMES}')
    try:
        first, *others = (int(part) if part.strip() else None for part in text.split(":"))
        if first is not None and not others:
            others = [first + 1 or None]  # -1 is the last: up to the end, not up to 0
        selected = range(count)[slice(first, *others)]
    except (TypeError, ValueError) as error:  # TypeError: empty, or four numbers
        raise InputError(option, "frames", text, SOME_FRAMES) from error
    if selected.step < 0:
        raise InputError(option, "frames", text, SOME_FRAMES)
    if not selected:
        raise InputError(option, "frames", text, f"some of the frames 0 to {count - 1}")
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
    """Return the provenance of the results, for `run.json`."""
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
