"""A run: frames of a source, each measured and written, one after the other."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

from threadpoolctl import ThreadpoolController

from labapp.core.correction import Correction
from labapp.core.pipeline import Measurement, Settings, measure
from labapp.errors import InputError
from labapp.media import Frame, FrameSource
from labapp.session.results import ResultsWriter
from labapp.session.setup import Setup

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
        "setup": {"path": str(Path(setup_path).absolute()), "toml": setup.text},
    }


def measure_each(
    frames: Iterable[int],
    read: Callable[[int], Frame],
    setup: Setup,
    settings: Settings,
    correction: Callable[[int], Correction | None] = lambda _: None,
) -> Iterator[tuple[int, float | None, Measurement]]:
    """Measure frames one after the other; yields (frame, time in s, measurement).

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
    """
    threads = ThreadpoolController()
    for number in frames:
        try:
            frame = read(number)
        except InputError as error:
            yield number, None, Measurement("unreadable", str(error), settings.scheme)
            continue
        # The matrices are small: more threads than one get in each other's way.
        with threads.limit(limits=1, user_api="blas"):
            measurement = measure(
                frame.image, setup.rig, setup.calibration, settings, correction(number)
            )
        yield number, frame.time_s, measurement


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
