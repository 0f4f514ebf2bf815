"""`labapp analyze`: the tables and pictures of chapters 4 and 8, from simulation."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal, TypeVar

import typer

from labapp.cli.shared import (
    NOTHING_MEASURED,
    Commands,
    progress_shown,
    results_folder,
    warned,
    writable_folder,
    write_figure,
)
from labapp.errors import InputError
from labapp.files import write_file
from labapp.studies import SCHEMES
from labapp.studies.analysis import (
    PARTS,
    AnalysisOptions,
    AnalysisPart,
    analyze_budget,
    analyze_errors,
    expected_pool,
)

if TYPE_CHECKING:
    from labapp.studies.tables import Table

T = TypeVar("T", bound=str)

app = typer.Typer(
    cls=Commands,
    no_args_is_help=True,
    help="Reproduce tables and figures of chapters 4, 6 and 8; the error budget of a set-up.",
)

Out = Annotated[
    Path | None,
    typer.Option(help="Folder for tables (CSV, Markdown) and pictures; files in it are replaced."),
]
Tables = Annotated[
    bool, typer.Option("--tables", help="Print the tables; without --out nothing else is made.")
]
Format = Annotated[Literal["png", "svg"], typer.Option("--format", help="Of the pictures.")]


@app.command()
def positioning(out: Out = None, tables: Tables = False, picture: Format = "png") -> None:
    """Which rays the torch blocks, L1, L2 and D1, and dots on and off the plane (§4.2.1)."""
    from labapp.studies import positioning_tables as found

    placements = found.coverage()
    made = (*found.blocking_tables(), found.clearance_table(), found.coverage_table(placements))
    folder = results_folder(out, tables)
    _keep(folder, AnalysisPart(made, {}, made if tables else ()))
    if folder is not None:
        from labapp.studies import pictures

        write_figure(folder, "figure_4_11_coverage", pictures.coverage_picture(placements), picture)
        rig = found.positioning_rig(30.0)
        side = pictures.positioning_picture(rig, 6.0, 6.0, 0.3)
        write_figure(folder, "figure_4_7_positioning", side, picture)


@app.command()
def correspondence(out: Out = None, tables: Tables = False, picture: Format = "png") -> None:
    """Which way the reflected rows and columns run, by size and depth of the pool (§4.2.2)."""
    from labapp.studies import correspondence_table as found

    made = found.correspondence_tables()
    folder = results_folder(out, tables)
    _keep(folder, AnalysisPart(made, {}, made if tables else ()))
    if folder is not None:
        from labapp.studies import pictures

        for name, title, radius, depth in found.EXAMPLES:
            seen = found.cap_reflections(radius, depth)
            write_figure(folder, name, pictures.correspondence_picture(seen, title), picture)


@app.command()
def errors(
    out: Annotated[
        Path, typer.Option(help="Folder for tables and pictures; files in it are replaced.")
    ],
    part: Annotated[
        list[str] | None,
        typer.Option(
            help=f"{', '.join(PARTS)}: what to work out; repeat for more. CE, LE, ME are "
            "configuration, system limitation and methodology error. Default: all."
        ),
    ] = None,
    scheme: Annotated[
        list[str] | None,
        typer.Option(help=f"{', '.join(SCHEMES)}; repeat for more. Default: all."),
    ] = None,
    step: Annotated[
        float,
        typer.Option(min=0.25, max=10, help="Between the laser's places, degrees and mm (LE, ME)."),
    ] = 2.0,
    frames: Annotated[
        int, typer.Option(min=1, max=1000, help="Frames that are rendered of each surface.")
    ] = 3,
    draws: Annotated[
        int, typer.Option(min=10, max=100_000, help="Monte Carlo samples of the calibration.")
    ] = 400,
    picture: Format = "png",
) -> None:
    """Work out the errors of chapter 8 by every scheme, beside the text's.

    Each part is written before the next one begins. All of them take long: see --part.
    """
    options = AnalysisOptions(
        _chosen("part", part, PARTS),
        _chosen("scheme", scheme, SCHEMES),
        step,
        frames,
        draws,
        picture,
    )
    folder = writable_folder(out)
    with progress_shown() as progress:
        for made in analyze_errors(options, progress):
            _keep(folder, made)


@app.command()
def frame(
    source: Annotated[Path, typer.Argument(help="A recording, or one image.")],
    setup: Annotated[Path, typer.Option(help="Setup file (TOML).")],
    number: Annotated[int, typer.Option("--frame", min=0, help="Which frame.")] = 0,
    known_object: Annotated[
        tuple[float, float] | None,
        typer.Option(
            metavar="DIAMETER HEIGHT",
            help="The frame shows a cap of this size, such as a thumb tack (mm); the height of a "
            "hollow is below 0. The error of every scheme, with a circle as boundary (§8.2).",
        ),
    ] = None,
    out: Out = None,
    tables: Tables = False,
) -> None:
    """Compare algorithms, correspondences and base heights of IRS on a frame (Fig. 6-10, 6-13).

    The correspondence by the shape of the reflected rows (§7.1) stands beside the one that was
    found.

    Exit code 1: the frame's dots have no rays.
    """
    from labapp.config.setup import read_setup
    from labapp.core.pipeline import Settings, measure
    from labapp.media import open_source
    from labapp.studies.frame_comparison import comparison_tables, shape_table
    from labapp.studies.known_object import known_cap, known_object_table

    known = warned(read_setup(setup))
    cap = None if known_object is None else known_cap(*known_object)
    with open_source(source) as recording:
        if number >= len(recording):
            allowed = f"frames 0 to {len(recording) - 1} of {source}"
            raise InputError("--frame", "frame", number, allowed)
        image = recording.frame(number).image
    found = measure(image, known.bench, Settings())[0]
    if found.match is None:
        typer.echo(f"{source}: {found.status}: {found.reason}", err=True)
        raise typer.Exit(NOTHING_MEASURED)
    made: tuple[Table, ...] = (shape_table(found.match), *comparison_tables(found.match, known.rig))
    if cap is not None:
        made = (known_object_table(found.match, known.rig, cap), *made)
    _keep(results_folder(out, tables), AnalysisPart(made, {}, made if tables else ()))


@app.command()
def budget(
    out: Out = None,
    setup: Annotated[
        Path | None,
        typer.Option(help="Setup file (TOML). Default: the set-up of §8.3.1 with a 4″ plane."),
    ] = None,
    width: Annotated[float, typer.Option(help="Of the expected pool, along X (mm).")] = 6.0,
    length: Annotated[float, typer.Option(help="Of the expected pool, along Y (mm).")] = 7.0,
    height: Annotated[
        float, typer.Option(help="Of the expected pool; below 0 for a concave one (mm).")
    ] = 0.3,
) -> None:
    """Work out the error budget of a set-up for a kind of pool: predicted and simulated.

    The set-up is known as its file says, or as is assumed; that of §8.3.1 to 0.1 mm, 0.1 degrees
    and 0.1 px. A dot is known to 0.3 px.
    """
    from labapp.config.setup import read_setup

    read = None if setup is None else warned(read_setup(setup))
    pool = expected_pool(width, length, height)
    folder = results_folder(out)
    with progress_shown() as progress:
        _keep(folder, analyze_budget(read, pool, progress))


def _chosen(name: str, asked: list[str] | None, known: tuple[T, ...]) -> tuple[T, ...]:
    """The requested names, in their usual order; all of them if none was given."""
    for one in asked or ():
        if one not in known:
            raise InputError(f"--{name}", name, one, f"one of {', '.join(known)}")
    return tuple(one for one in known if one in (asked or known))


def _keep(folder: Path | None, made: AnalysisPart) -> None:
    """Write the results of a part, and print its short tables."""
    if folder is not None:
        for name, content in made.files.items():
            write_file(folder / name, content)
    for table in made.printed:
        typer.echo(table.markdown())
