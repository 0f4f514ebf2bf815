"""`labapp analyze`: the tables and pictures of chapters 4 and 8, from simulation."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal, cast

import typer

from labapp.cli.shared import progress_told, results_folder, write_figure, write_file
from labapp.errors import InputError

if TYPE_CHECKING:
    from labapp.core.reconstruction import Scheme
    from labapp.simulation.error_analysis import ErrorSurvey
    from labapp.simulation.parallel import Progress
    from labapp.simulation.pools import Pool
    from labapp.simulation.setup_budget import Bench
    from labapp.simulation.tables import Table

PARTS = ("CE", "LE", "ME", "measurement", "images", "parameters")
"""What `labapp analyze errors` can work out."""

SCHEMES = ("irs", "ers", "fit")

app = typer.Typer(
    no_args_is_help=True,
    help="Reproduce the tables and figures of chapters 4 and 8, and the error budget of a set-up.",
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
    from labapp.simulation import positioning_tables as found

    placements = found.coverage()
    made = (*found.blocking_tables(), found.clearance_table(), found.coverage_table(placements))
    folder = results_folder(out, tables)
    _give(folder, made, tables)
    if folder is not None:
        from labapp.simulation import pictures

        write_figure(folder, "figure_4_11_coverage", pictures.coverage_picture(placements), picture)
        rig = found.positioning_rig(30.0)
        side = pictures.positioning_picture(rig, 6.0, 6.0, 0.3)
        write_figure(folder, "figure_4_7_positioning", side, picture)


@app.command()
def correspondence(out: Out = None, tables: Tables = False, picture: Format = "png") -> None:
    """Which way the reflected rows and columns run, by size and depth of the pool (§4.2.2)."""
    from labapp.simulation import correspondence_table as found

    made = found.correspondence_tables()
    folder = results_folder(out, tables)
    _give(folder, made, tables)
    if folder is not None:
        from labapp.simulation import pictures

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
        typer.Option(help=f"{', '.join(SCHEMES)}; repeat for more. Default: all three."),
    ] = None,
    step: Annotated[
        float,
        typer.Option(min=0.25, max=10, help="Between the laser's places, degrees and mm (LE, ME)."),
    ] = 2.0,
    frames: Annotated[
        int, typer.Option(min=1, max=1000, help="Frames that are rendered of each surface.")
    ] = 3,
    draws: Annotated[
        int, typer.Option(min=10, max=100_000, help="Monte Carlo draws of the calibration.")
    ] = 400,
    picture: Format = "png",
) -> None:
    """Work out the errors of chapter 8 by every scheme, beside the text's.

    What is done is written before the next part begins. All of it takes long: see --part.
    """
    asked = _chosen("part", part, PARTS)
    schemes = cast("tuple[Scheme, ...]", _chosen("scheme", scheme, SCHEMES))
    folder = results_folder(out)
    assert folder is not None
    with progress_told() as progress:
        kinds = [kind for kind in ("CE", "LE", "ME") if kind in asked]
        _surveys(folder, kinds, schemes, step, progress, picture)
        if "measurement" in asked:
            _measurement(folder, schemes, frames, progress, picture)
        if "images" in asked:
            _images(folder, schemes, frames, progress)
        if "parameters" in asked:
            _parameters(folder, schemes, draws, progress, picture)


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

    The calibration is taken to be known to 0.1 mm, 0.1 degrees and 0.1 px, a dot to 0.3 px.
    """
    from labapp.simulation.setup_budget import budget_table, setup_budget

    bench, pool = _bench(setup), _pool(width, length, height)
    folder = results_folder(out)
    with progress_told() as progress:
        _give(folder, [budget_table(setup_budget(bench, pool, progress))], True)


def _chosen(name: str, asked: list[str] | None, known: tuple[str, ...]) -> tuple[str, ...]:
    """What was asked for, in the usual order; all of it if nothing was."""
    for one in asked or ():
        if one not in known:
            raise InputError(f"--{name}", name, one, f"one of {', '.join(known)}")
    return tuple(one for one in known if one in (asked or known))


def _surveys(
    folder: Path,
    kinds: Sequence[str],
    schemes: tuple[Scheme, ...],
    step: float,
    progress: Progress,
    picture: str,
) -> None:
    """CE, LE and ME: their tables grow with each."""
    from labapp.simulation import error_analysis, pictures

    done: list[ErrorSurvey] = []
    for kind, error, are in zip(("CE", "LE", "ME"), (6, 8, 10), (7, 9, 11), strict=True):
        if kind not in kinds:
            continue
        done.append(error_analysis.survey(kind, schemes, step, progress=progress))
        tables = [make(done) for make in (error_analysis.error_table, error_analysis.are_table)]
        _give(folder, [*tables, error_analysis.cap_table(done)])
        write_figure(folder, f"figure_8_{error}_{kind}", pictures.error_picture(done[-1]), picture)
        write_figure(folder, f"figure_8_{are}_{kind}_are", pictures.are_picture(done[-1]), picture)
    if done:
        _print(tables)


def _measurement(
    folder: Path, schemes: tuple[Scheme, ...], frames: int, progress: Progress, picture: str
) -> None:
    from labapp.simulation import image_error, pictures

    found = image_error.frame_errors(
        [image_error.TACK], image_error.TACK_RIG, frames, schemes=schemes, progress=progress
    )
    _give(folder, [image_error.thumb_tack_table(found[0], schemes)], True)
    frame = image_error.rendered(image_error.TACK, image_error.TACK_RIG, 0)
    write_figure(folder, "figure_8_2_thumb_tack", pictures.frame_picture(frame), picture)


def _images(folder: Path, schemes: tuple[Scheme, ...], frames: int, progress: Progress) -> None:
    from labapp.simulation import image_error
    from labapp.simulation.pools import caps_8_3_1

    caps = caps_8_3_1()
    found = image_error.frame_errors(
        caps, image_error.BENCH, frames, schemes=schemes, progress=progress
    )
    _give(folder, [image_error.image_error_table(caps, found, schemes)], True)


def _parameters(
    folder: Path, schemes: tuple[Scheme, ...], draws: int, progress: Progress, picture: str
) -> None:
    from labapp.simulation import image_error, pictures
    from labapp.simulation import parameter_deviation as deviation
    from labapp.simulation.pools import spherical_cap

    found = {}
    for surface, height in (("convex", 0.3), ("concave", -0.3)):
        known = image_error.exactly_seen(spherical_cap(6.0, height), image_error.BENCH)
        for scheme in schemes:
            found[surface, scheme] = deviation.parameter_deviation(
                known, scheme, draws=draws, progress=progress
            )
        names = [quantity.name for quantity in deviation.QUANTITIES]
        values = {str(one): 100 * found[surface, one].contribution[:, 0] for one in schemes}
        label = f"standard uncertainty of the height, {surface} 6 mm × 0.3 mm (%)"
        drawn = pictures.bars_picture(names, values, label)
        write_figure(folder, f"parameter_deviation_{surface}", drawn, picture)
    _give(folder, [deviation.deviation_table(found)], True)


def _bench(setup: Path | None) -> Bench:
    from labapp.session.setup import read_setup
    from labapp.simulation.image_error import BENCH, VIEW, axes_of
    from labapp.simulation.parameter_deviation import AxisPoints
    from labapp.simulation.setup_budget import Bench

    if setup is None:
        return Bench(BENCH, axes_of(VIEW))
    read = read_setup(setup)
    plane = read.rig.imaging_plane
    return Bench(read.rig, AxisPoints(read.calibration, plane.width_mm / 2, plane.height_mm / 2))


def _pool(width: float, length: float, height: float) -> Pool:
    from labapp.simulation.pools import ellipsoidal_cap

    for name, value, low in (("width", width, 1), ("length", length, 1), ("height", height, 0.01)):
        if not low <= abs(value) <= 30 or (low == 1 and value < 0):
            expected = f"{low} to 30 mm" + " or the same below 0" * (name == "height")
            raise InputError(f"--{name}", name, value, expected)
    try:
        return ellipsoidal_cap(width, length, height)
    except ValueError as error:
        raise InputError("--height", "height", height, f"a pool that can be: {error}") from error


def _give(folder: Path | None, tables: Iterable[Table], shown: bool = False) -> None:
    """Write tables, and print them."""
    tables = list(tables)
    for table in tables:
        if folder is not None:
            write_file(folder / f"{table.name}.csv", table.csv().encode())
            write_file(folder / f"{table.name}.md", table.markdown().encode())
    if shown:
        _print(tables)


def _print(tables: Iterable[Table]) -> None:
    for table in tables:
        typer.echo(table.markdown())
