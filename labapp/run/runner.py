"""The loop that measures frames: `run`, for the command line, sessions and the benchmark.

They differ in what measures (a `Measurer`, see `measurers`) and in where results go (`Sink`). A
live camera has a loop of its own (`live_watch`): how long a frame took says which is next.
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

Measurer = Callable[[Iterable[int]], Generator[FrameResult]]
"""Measures the frames of these numbers, in their order. Closed early, it cancels what it began."""

Sink = Callable[[FrameResult], object]
"""Takes each result in turn. What it raises ends the run."""

SOME_FRAMES = "A:B:STEP, frames A to before B (from 0), every STEP-th; each may be left out"


def run(frames: Iterable[int], measurer: Measurer, sinks: Sequence[Sink]) -> Generator[FrameResult]:
    """Measure frames and pass each result to every sink; yields it once all have it.

    To stop, close the generator, or raise in a sink: frames that were begun are cancelled.

    Parameters
    ----------
    frames
        Their numbers, in the order in which they are measured.
    sinks
        Where results go, in this order.
    """
    with closing(measurer(frames)) as results:
        for result in results:
            for sink in sinks:
                sink(result)
            yield result


def with_setup_check(measurer: Measurer, record: ResidualRecord) -> Measurer:
    """A measurer whose results have what the frames so far say of the set-up."""

    def measure(frames: Iterable[int]) -> Generator[FrameResult]:
        with closing(measurer(frames)) as results:
            for result in results:
                measurement = record.judged(result.measurement, result.residuals)
                yield replace(result, measurement=measurement, setup_doubt=record.doubt)

    return measure


def select_frames(text: str, count: int, source: str = "--frames") -> range:
    """Frames that ``A:B:STEP`` selects from ``count``, as a Python slice does; ``A`` is one frame.

    Parameters
    ----------
    text, count
        What is selected, and from how many frames.
    source
        Where the text comes from, for the error.

    Raises
    ------
    InputError
        If it is not of that form, or selects nothing.
    """
    require(text, str, source, "frames", f'text such as "0:100:5": {SOME_FRAMES}')
    try:
        first, *others = (int(part) if part.strip() else None for part in text.split(":"))
        if first is not None and not others:
            others = [first + 1 or None]
        selected = range(count)[slice(first, *others)]
    except (TypeError, ValueError) as error:  # TypeError: no number at all, or four
        raise InputError(source, "frames", text, SOME_FRAMES) from error
    if selected.step < 0:
        raise InputError(source, "frames", text, SOME_FRAMES)
    if not selected:
        raise InputError(source, "frames", text, f"some of the frames 0 to {count - 1}")
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
    """Origin of the results, for `run.json`."""
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
