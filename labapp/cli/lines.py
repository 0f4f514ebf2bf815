"""`labapp lines`: measure recordings of a line pattern (§3.2.1), or follow one line (§3.3)."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from labapp.cli.shared import (
    FRAMES_HELP,
    FRAMES_METAVAR,
    NOTHING_MEASURED,
    RECORDING_HELP,
    progress_shown,
    warned,
    writable_folder,
)
from labapp.errors import os_errors_as_input
from labapp.files import write_file
from labapp.text import csv_text

if TYPE_CHECKING:
    import numpy.typing as npt

    from labapp.config.setup import Setup
    from labapp.media import FrameSource


def lines(
    source: Annotated[Path, typer.Argument(help=RECORDING_HELP)],
    setup: Annotated[Path, typer.Option(help='Setup file (TOML) with [pattern] kind = "lines".')],
    out: Annotated[Path, typer.Option(help="Folder for the tables; made if missing.")],
    frames: Annotated[str, typer.Option(metavar=FRAMES_METAVAR, help=FRAMES_HELP)] = ":",
    follow: Annotated[
        bool,
        typer.Option(
            "--follow",
            help="Follow one line from frame to frame, as in pulsed GMAW; so is a pattern of one.",
        ),
    ] = False,
) -> None:
    """Find the lines of frames, what they show, the pool's state, its surface where determined.

    Of a line pattern: lines.csv, line_points.csv, features.csv with the state of each frame, and
    surface_NNNNNN.csv of each frame whose lines determine the surface. Of one line that is
    followed: track.csv, with the pulses of the current.
    """
    from labapp.config.line_setup import read_line_setup
    from labapp.media import open_source
    from labapp.run.runner import select_frames

    bench = warned(read_line_setup(setup))
    with open_source(source) as recording:
        chosen = select_frames(frames, len(recording))
        folder = writable_folder(out)
        with os_errors_as_input(folder, "results", "room on its disk"):
            if follow or bench.rig.pattern.rows == 1:
                done = _follow(recording, chosen, folder)
            else:
                done = _measure(recording, chosen, folder, bench)
    typer.echo(f"Results are in {folder.absolute()}")
    if not done:
        raise typer.Exit(NOTHING_MEASURED)


def _measure(source: FrameSource, frames: range, folder: Path, bench: Setup) -> bool:
    """Measure frames one by one; whether any has lines."""
    from labapp.core.lines.frame import LineFrame
    from labapp.core.lines.states import LineSeries, line_changes, line_states
    from labapp.core.pipeline import Settings, measure
    from labapp.core.recording.residual_check import doubt_of_values, judged_status
    from labapp.export.line_results import line_tables

    found, times_s = list[LineFrame](), list[float | None]()
    try:
        with progress_shown("stopped: the frames that were finished are kept") as progress:
            for k, number in enumerate(frames):
                frame = source.frame(number)
                one = measure(frame.image, bench.bench, Settings())[0].lines
                assert one is not None
                found.append(one)
                times_s.append(frame.time_s)
                progress(source.name, k + 1, len(frames))
    finally:
        done, status = frames[: len(found)], judged_status(bench.rig, doubt_of_values(bench.rig))
        for name, text in line_tables(done, times_s, found, bench.calibration, status).items():
            write_file(folder / name, text.encode())
    series = LineSeries.of(found)
    states = line_states(series)
    for name, counts in (("frames", [one.status for one in found]), ("states", states)):
        shown = ", ".join(f"{what} {n}" for what, n in Counter(counts).most_common())
        typer.echo(f"{name}: {shown}")
    for k, before, after in line_changes(series):
        typer.echo(f"frame {frames[k]}: from {before} lines to {after}")
    return any(one.seen.lines for one in found)


def _follow(source: FrameSource, frames: range, folder: Path) -> bool:
    """Follow one line; whether it was followed in any frame."""
    from labapp.core.lines.frame import LineFrame
    from labapp.core.lines.track import track_line
    from labapp.export import line_results as tables

    rate = source.frame_rate_hz
    rate = None if rate is None else rate / frames.step
    times_s: list[float | None] = []
    with progress_shown("stopped: nothing is kept of a line that is not followed to the end") as on:

        def images() -> Iterator[npt.NDArray[Any]]:
            for k, number in enumerate(frames):
                frame = source.frame(number)
                times_s.append(frame.time_s)
                on(source.name, k + 1, len(frames))
                yield frame.image

        film = track_line(images(), rate)
    pulses = zip(film.lines, film.pulses.on.tolist(), film.pulses.probability.tolist(), strict=True)
    found = [LineFrame.of_track(*one) for one in pulses]
    rows = tables.track_rows(frames, times_s, found)
    write_file(folder / "track.csv", csv_text([tables.TRACK_COLUMNS, *rows]).encode())
    off = [one for one in found if one.status != "pulse"]
    followed = sum(one.track is not None for one in off)
    typer.echo(f"{len(off)} of {len(frames)} frames are without a pulse; line in {followed}")
    if film.pulses.on.any():
        typer.echo(f"pulses: {film.pulses.frequency_hz:.2f} Hz")
    if followed:
        typer.echo(
            f"strongest oscillation: {film.frequency_hz:.2f} Hz,"
            f" {film.strength:.0%} of the line's motion"
        )
    return bool(followed)
