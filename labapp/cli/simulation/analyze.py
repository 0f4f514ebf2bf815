"""`labapp analyze`: tables and figures of chapters 4, 6 and 8, by simulation."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal, TypeVar

import typer

from labapp.cli.shared import (
    NOTHING_MEASURED,
    command_group,
    progress_shown,
    results_folder,
    show_warnings,
    writable_folder,
)
from labapp.errors import InputError
from labapp.export.owned_files import add_owned, check_added
from labapp.studies import SCHEME_NAMES
from labapp.studies.analysis import (
    PARTS,
    TABLES,
    AnalysisOptions,
    AnalysisPart,
    analyze_budget,
    analyze_errors,
    drawn_files,
    expected_pool,
)

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from labapp.studies.tables import Table

T = TypeVar("T", bound=str)

app = command_group()

Out = Annotated[
    Path | None,
    typer.Option(
        help="Folder for tables (CSV, Markdown) and pictures. Earlier ones are replaced if "
        "unchanged."
    ),
]
Tables = Annotated[
    bool, typer.Option("--tables", help="Print the tables; without --out nothing is written.")
]
Format = Annotated[Literal["png", "svg"], typer.Option("--format", help="Format of the pictures.")]


@app.command()
def positioning(out: Out = None, tables: Tables = False, picture: Format = "png") -> None:
    """Tabulate rays blocked by the torch, L1, L2 and D1, and dots on the imaging plane (§4.2.1)."""
    from labapp.studies import positioning_tables as study

    placements = study.coverage()
    computed = (*study.blocking_tables(), study.clearance_table(), study.coverage_table(placements))

    def draw() -> dict[str, Figure]:
        from labapp.studies import pictures

        rig = study.positioning_rig(30.0)
        return {
            "figure_4_11_coverage": pictures.coverage_picture(placements),
            "figure_4_7_positioning": pictures.positioning_picture(rig, 6.0, 6.0, 0.3),
        }

    _write_tables(out, tables, computed, draw, picture)


@app.command()
def correspondence(out: Out = None, tables: Tables = False, picture: Format = "png") -> None:
    """Tabulate the order of reflected rows and columns by size and depth of the pool (§4.2.2)."""
    from labapp.studies import correspondence_table as study

    def draw() -> dict[str, Figure]:
        from labapp.studies import pictures

        return {
            name: pictures.correspondence_picture(study.cap_reflections(radius, depth), title)
            for name, title, radius, depth in study.EXAMPLES
        }

    _write_tables(out, tables, study.correspondence_tables(), draw, picture)


@app.command()
def errors(
    out: Annotated[
        Path,
        typer.Option(
            help="Folder for tables and pictures. Earlier ones are replaced if unchanged."
        ),
    ],
    part: Annotated[
        list[str] | None,
        typer.Option(
            metavar="PART",
            help=f"Part to compute: {', '.join(PARTS)}; repeat for more. CE, LE, ME are "
            "configuration, system limitation and methodology error. Default: all.",
        ),
    ] = None,
    scheme: Annotated[
        list[str] | None,
        typer.Option(
            metavar="SCHEME",
            help=f"Scheme to use: {', '.join(SCHEME_NAMES)}; repeat for more. Default: all.",
        ),
    ] = None,
    step: Annotated[
        float,
        typer.Option(
            min=0.25, max=10, help="Step between laser positions, degrees and mm (LE, ME)."
        ),
    ] = 2.0,
    frames: Annotated[
        int, typer.Option(min=1, max=1000, help="Frames rendered of each surface.")
    ] = 3,
    draws: Annotated[
        int, typer.Option(min=10, max=100_000, help="Monte Carlo samples of the calibration.")
    ] = 400,
    picture: Format = "png",
) -> None:
    """Compute the errors of chapter 8 for every scheme, and compare them with the text's.

    Each part is written before the next one begins. All parts together take long: see --part.
    """
    options = AnalysisOptions(
        _chosen("part", part, PARTS),
        _chosen("scheme", scheme, SCHEME_NAMES),
        step,
        frames,
        draws,
        picture,
    )
    folder = writable_folder(out)
    _check_tables(folder, *(name for each in options.parts for name in TABLES[each]))
    with progress_shown() as progress:
        for finished in analyze_errors(options, progress):
            _write(folder, finished)


@app.command()
def frame(
    source: Annotated[Path, typer.Argument(help="A recording, or one image.")],
    setup: Annotated[Path, typer.Option(help="Setup file (TOML).")],
    number: Annotated[int, typer.Option("--frame", min=0, help="Which frame.")] = 0,
    known_object: Annotated[
        tuple[float, float] | None,
        typer.Option(
            metavar="DIAMETER HEIGHT",
            help="Size of a spherical cap in the frame, such as a thumb tack (mm); the height of a "
            "concave one is negative. Gives the error of every scheme for a circular boundary "
            "(§8.2).",
        ),
    ] = None,
    out: Out = None,
    tables: Tables = False,
) -> None:
    """Compare algorithms, correspondences and base heights of IRS on a frame.

    The tables are those of Fig. 6-10, 6-13 and 6-16. The correspondence by the shape of the
    reflected rows (§7.1) is listed beside the measured one.

    Exit code 1: the correspondence of the frame is unknown.
    """
    from labapp.config.setup import read_setup
    from labapp.core.pipeline import Settings, measure
    from labapp.media import open_source
    from labapp.studies.frame_comparison import comparison_tables, shape_table
    from labapp.studies.known_object import known_cap, known_object_table

    known = show_warnings(read_setup(setup))
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
    computed = [shape_table(found.match), *comparison_tables(found.match, known.rig)]
    if cap is not None:
        computed.insert(0, known_object_table(found.match, known.rig, cap))
    _write_tables(out, tables, computed)


@app.command()
def budget(
    out: Out = None,
    setup: Annotated[
        Path | None,
        typer.Option(help="Setup file (TOML). Default: the set-up of §8.3.1 with a 4″ plane."),
    ] = None,
    width: Annotated[float, typer.Option(help="Width of the expected pool, X (mm).")] = 6.0,
    length: Annotated[float, typer.Option(help="Length of the expected pool, Y (mm).")] = 7.0,
    height: Annotated[
        float, typer.Option(help="Height of the expected pool, negative if concave (mm).")
    ] = 0.3,
) -> None:
    """Compute the error budget of a set-up for an expected pool, predicted and simulated.

    Uncertainties of the set-up are those in its file, or the assumed ones; those of §8.3.1 are
    0.1 mm, 0.1 degrees and 0.1 px. The uncertainty of a dot's position is 0.3 px.
    """
    from labapp.config.setup import read_setup

    read = None if setup is None else show_warnings(read_setup(setup))
    pool = expected_pool(width, length, height)
    folder = results_folder(out)
    _check_tables(folder, "error_budget")
    with progress_shown() as progress:
        _write(folder, analyze_budget(read, pool, progress))


def _chosen(option: str, requested: list[str] | None, known: tuple[T, ...]) -> tuple[T, ...]:
    """Return the requested names in the order of ``known``; all of them if none is given."""
    for name in requested or ():
        if name not in known:
            raise InputError(f"--{option}", option, name, f"one of {', '.join(known)}")
    return tuple(name for name in known if name in (requested or known))


def _check_tables(folder: Path | None, *names: str) -> None:
    """Check that tables may be written, before they are computed."""
    if folder is not None:
        check_added(
            folder, "analyze", [f"{name}.{kind}" for name in names for kind in ("csv", "md")]
        )


def _write_tables(
    out: Path | None,
    printed: bool,
    tables: Sequence[Table],
    draw: Callable[[], Mapping[str, Figure]] = dict,
    picture: str = "png",
) -> None:
    """Write tables and pictures, which are drawn only then; print the tables if requested."""
    folder = results_folder(out, printed)
    pictures = {} if folder is None else drawn_files(draw(), picture)
    _write(folder, AnalysisPart(tuple(tables), pictures, tuple(tables) if printed else ()))


def _write(folder: Path | None, part: AnalysisPart) -> None:
    """Write the results of a part, and print its short tables."""
    if folder is not None:
        add_owned(folder, "analyze", part.files)
    for table in part.printed:
        typer.echo(table.markdown())
