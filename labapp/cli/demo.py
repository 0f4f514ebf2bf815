"""`labapp samples` and `labapp demo`: copy the bundled samples, or measure one of them."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from labapp.cli.shared import NOTHING_MEASURED, FrameRange, choose_frames, measure_frames
from labapp.cli.window import show_in_app
from labapp.errors import InputError, os_errors_as_input

WRITABLE = "one that can be written"


def samples(
    folder: Annotated[Path, typer.Argument(help="Destination; created if missing.")],
) -> None:
    """Copy the sample runs, the scenarios to simulate and the targets to print into a folder.

    The examples of the documentation work in that folder. Nothing is replaced.
    """
    import shutil

    from labapp.bundled import bundled

    for name in ("sample_sessions", "resources"):
        if (folder / name).exists():
            raise InputError(folder, "folder", f"it has {name}", "a folder without it")
    for name in ("sample_sessions", "resources"):
        with os_errors_as_input(folder, "folder", WRITABLE):
            try:
                shutil.copytree(bundled(name), folder / name, ignore=shutil.ignore_patterns(".*"))
            except shutil.Error as error:  # of several files: (source, target, reason) of each
                raise InputError(folder, "folder", error.args[0][0][2], WRITABLE) from error
    typer.echo(f"sample_sessions and resources are in {folder}")


def demo(
    out: Annotated[Path, typer.Option(help="Folder for the results.")] = Path("demo_results"),
    frames: FrameRange = ":",
    window: Annotated[
        bool, typer.Option(help="Open the session in the app, where there is a display.")
    ] = True,
) -> None:
    """Measure the sample run in a new session, export its results and draw pictures."""
    from labapp.export.folder import ExportChoice
    from labapp.simulated.demo import draw_surface, open_demo

    out = out.absolute()
    with open_demo(out) as session:
        summary = measure_frames(session, choose_frames(session, frames))
        typer.echo(summary.text())
        pictures = frozenset({"frames", "trends"})
        session.export(out / "results", ExportChoice(hdf5=True, pictures=pictures), report=True)
        typer.echo(f"The session is {session.path}")
    typer.echo(f"Results are in {out / 'results'}: tables, surfaces, pictures, report.pdf")
    if summary.example is None:
        raise typer.Exit(NOTHING_MEASURED)
    surface = summary.example.measurement.reconstruction
    assert surface is not None
    picture = out / f"surface_{summary.example.frame:06d}.png"
    problem = draw_surface(surface, picture)
    typer.echo(f"No picture in 3-D: {problem}" if problem else f"In 3-D: {picture}")
    if window:
        show_in_app(session.path)
