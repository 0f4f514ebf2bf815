"""`labapp lines`: measure recordings of a line pattern (§3.2.1), or follow one line (§3.3)."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from labapp.cli.shared import (
    INTERRUPTED,
    NOTHING_MEASURED,
    FrameRange,
    Recording,
    finite,
    print_above,
    progress_bar,
    show_warnings,
    writable_folder,
)
from labapp.errors import InputError, os_errors_as_input
from labapp.export.owned_files import check_owned, write_owned
from labapp.text import csv_text

if TYPE_CHECKING:
    from labapp.config.setup import Setup
    from labapp.core.values import FloatArray
    from labapp.export.frame_result import FrameResult
    from labapp.media import FrameSource


def lines(
    source: Recording,
    setup: Annotated[Path, typer.Option(help='Setup file (TOML) with [pattern] kind = "lines".')],
    out: Annotated[
        Path, typer.Option(help="Folder for the tables. Earlier ones are replaced if unchanged.")
    ],
    frames: FrameRange = ":",
    follow: Annotated[
        bool,
        typer.Option(
            "--follow",
            help="Follow one line from frame to frame, as in pulsed GMAW; implied by one line.",
        ),
    ] = False,
    signals: Annotated[
        Path | None,
        typer.Option(
            help="Recorded weld current (CSV, TDMS, WAV), which shows the pulses as the light "
            "does; only with --follow or a pattern of one line."
        ),
    ] = None,
    start: Annotated[
        float,
        typer.Option(callback=finite, help="Time of the signals' start in the recording (s)."),
    ] = 0.0,
) -> None:
    """Measure recordings of a line pattern: lines, features, state and surface of the pool.

    For a line pattern: lines.csv, line_points.csv, features.csv with the state of each frame, and
    surface_NNNNNN.csv for each frame whose lines determine the surface. For one line that is
    followed: track.csv, with the pulses of the current.
    """
    from labapp.config.line_setup import read_line_setup
    from labapp.media import open_source
    from labapp.run.runner import select_frames

    bench = show_warnings(read_line_setup(setup))
    follow = follow or bench.rig.pattern.rows == 1
    current = None if signals is None else _current(signals, start, follow)
    with open_source(source) as recording:
        bench.require_size(recording.shape, str(source))
        chosen = select_frames(frames, len(recording))
        folder = writable_folder(out)
        check_owned(folder, "lines")
        with os_errors_as_input(folder, "results", "enough disk space"):
            done = _measured(recording, chosen, bench, follow, current)
            any_line, tables = _followed(done) if follow else _tables(done, bench)
            write_owned(folder, "lines", tables)
    typer.echo(f"Results are in {folder.absolute()}")
    if len(done) < len(chosen):
        raise typer.Exit(INTERRUPTED)
    if not any_line:
        raise typer.Exit(NOTHING_MEASURED)


def _current(path: Path, start: float, follow: bool) -> tuple[FloatArray, FloatArray]:
    """Return times in the recording, s, and weld current, A."""
    from labapp.session.signals import read_signals

    if not follow:
        raise InputError("labapp lines", "--signals", path, "a pattern of one line, or --follow")
    found = replace(read_signals(path), start_s=start).timed()
    if "current" not in found:
        raise InputError(path, "channels", ", ".join(found), "a current")
    return found["current"]


def _measured(
    source: FrameSource,
    frames: range,
    bench: Setup,
    follow: bool,
    current: tuple[FloatArray, FloatArray] | None,
) -> list[FrameResult]:
    """Return the results of the finished frames, with progress on stderr."""
    from labapp.core.pipeline import Settings
    from labapp.export.frame_result import FrameResult
    from labapp.run.line_measurer import LineMeasurer
    from labapp.run.measurers import ColdMeasurer
    from labapp.run.runner import run

    given = (source.frame, bench, Settings())
    measurer = LineMeasurer(*given, current) if follow else ColdMeasurer(*given)
    done = list[FrameResult]()
    with progress_bar() as progress:
        task = progress.add_task(source.name, total=len(frames))

        def shown(result: FrameResult) -> None:
            progress.advance(task)
            if result.measurement.lines is None:
                print_above(progress, f"frame {result.frame}: {result.measurement.reason}")

        try:
            for _ in run(frames, measurer, [done.append, shown]):
                pass
        except KeyboardInterrupt:
            print_above(progress, f"stopped: {len(done)} of {len(frames)} frames are finished")
    return done


def _tables(done: list[FrameResult], bench: Setup) -> tuple[bool, dict[str, bytes]]:
    """Whether any of the frames measured one by one has lines, and their tables, by file name."""
    from labapp.core.lines.states import LineSeries, line_changes, line_states
    from labapp.core.recording.residual_check import doubt_of_values, judged_status
    from labapp.export.line_results import line_tables, of_lines

    frames = of_lines(done)
    found = [one.lines for one in frames]
    status = judged_status(bench.rig, doubt_of_values(bench.rig))
    tables = line_tables(frames, bench.calibration, status)
    series = LineSeries.of(found)
    states = line_states(series)
    for name, counts in (("frames", [one.measurement.status for one in done]), ("states", states)):
        shown = ", ".join(f"{what} {n}" for what, n in Counter(counts).most_common())
        typer.echo(f"{name}: {shown}")
    for k, before, after in line_changes(series):
        typer.echo(f"frame {frames[k].frame}: from {before} lines to {after}")
    is_any = any(one.seen.lines for one in found)
    return is_any, {name: text.encode() for name, text in tables.items()}


def _followed(done: list[FrameResult]) -> tuple[bool, dict[str, bytes]]:
    """Whether a followed line was found in any frame, and its table, by file name."""
    import numpy as np

    from labapp.core.lines.pulses import pulse_frequency
    from labapp.core.lines.track import oscillation_frequency
    from labapp.export import line_results as tables

    frames = tables.of_lines(done)
    table = csv_text([tables.TRACK_COLUMNS, *tables.track_rows(frames)])
    found = [one.lines for one in frames]
    on = np.array([one.status == "pulse" for one in found], bool)
    shift = np.array([np.nan if one.track is None else one.track.shift_px for one in found])
    known = np.isfinite(shift)
    typer.echo(f"{(~on).sum()} of {len(done)} frames are without a pulse; line in {known.sum()}")
    time_s = np.array([np.nan if one.time_s is None else one.time_s for one in frames])
    step_s = float(np.median(np.diff(time_s))) if len(time_s) > 1 else float("nan")
    hertz = pulse_frequency(on, 1 / step_s) if step_s > 0 else float("nan")
    if np.isfinite(hertz):
        typer.echo(f"pulses: {hertz:.2f} Hz")
    known_time = known & np.isfinite(time_s)
    hertz, strength = oscillation_frequency(time_s[known_time], shift[known_time])
    if np.isfinite(hertz):
        typer.echo(f"strongest oscillation: {hertz:.2f} Hz, {strength:.0%} of the line's motion")
    return bool(known.any()), {"track.csv": table.encode()}
