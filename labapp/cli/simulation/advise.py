"""`labapp advise`: the best positions of laser and imaging plane for the expected pools."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from labapp.cli.shared import NOTHING_MEASURED, progress_shown, writable_folder
from labapp.errors import InputError
from labapp.export.owned_files import check_owned, write_owned

if TYPE_CHECKING:
    from labapp.studies.adviser.bench_limits import BenchLimits
    from labapp.studies.adviser.expected_pools import ExpectedPools


def _range(text: str) -> Any:
    return typer.Option(metavar="A:B", help=text)


def advise(
    *,
    out: Annotated[
        Path,
        typer.Option(help="Folder for the advice. An earlier one in it is replaced if unchanged."),
    ],
    question: Annotated[
        Path | None,
        typer.Argument(metavar="FILE.toml", help="Pools and bench (TOML): docs/adviser.md."),
    ] = None,
    width: Annotated[str | None, _range("Width of the pools (X), from A to B (mm).")] = None,
    length: Annotated[str | None, _range("Length of the pools (Y) (mm).")] = None,
    height: Annotated[str | None, _range("Height of the pools, a magnitude (mm).")] = None,
    convex: Annotated[
        bool | None,
        typer.Option("--convex/--concave", help="Kind of the pools. Default: convex."),
    ] = None,
    angle: Annotated[str | None, _range("Range of the laser's angle (degrees).")] = None,
    distance: Annotated[str | None, _range("Range of the laser's distance (mm).")] = None,
    plane: Annotated[str | None, _range("Distance of the imaging plane (mm).")] = None,
    quick: Annotated[
        bool, typer.Option("--quick", help="Search more coarsely, in a tenth of the time.")
    ] = False,
    check: Annotated[
        bool, typer.Option("--check", help="Check the advice against 50 other pools and a grid.")
    ] = False,
    seed: Annotated[
        int,
        typer.Option(min=0, max=2**31 - 1, help="Random seed."),
    ] = 4,
) -> None:
    """Recommend positions of laser and imaging plane for the expected pools.

    Options override values in FILE.toml. The written setup.toml has no image calibration; this
    must be measured on the bench: labapp calibrate plane.
    """
    from labapp.studies.adviser.keys import parse_request, read_request

    values = read_request(question) if question else {}
    kind = None if convex is None else "convex" if convex else "concave"
    _replace(
        values,
        ("pools", "kind", kind),
        ("pools", "width_mm", _span("--width", width)),
        ("pools", "length_mm", _span("--length", length)),
        ("pools", "height_mm", _span("--height", height)),
        ("bench", "projection_angle_deg", _span("--angle", angle)),
        ("bench", "distance_mm", _span("--distance", distance)),
        ("bench", "plane_distance_mm", _span("--plane", plane)),
    )
    expected, limits = parse_request(values, question or "labapp advise")
    if not _advised(expected, limits, out, quick, check, seed):
        raise typer.Exit(NOTHING_MEASURED)


def _replace(values: dict[str, Any], *options: tuple[str, str, object]) -> None:
    """Override values of a file by the given options, (table, key, value)."""
    for table, key, value in options:
        if value is not None and isinstance(values.setdefault(table, {}), dict):
            values[table][key] = value


def _advised(
    expected: ExpectedPools, limits: BenchLimits, out: Path, quick: bool, check: bool, seed: int
) -> bool:
    """Search for set-ups, print and write the advice; returns whether any set-up is possible."""
    from labapp.studies.adviser import check as adviser_check
    from labapp.studies.adviser import search as adviser
    from labapp.studies.adviser.files import FILES, advice_files, patterns_of
    from labapp.studies.adviser.report import advice_text, cost_table

    folder = writable_folder(out)
    check_owned(folder, "advise", FILES)
    effort = adviser.QUICK if quick else adviser.Effort()
    with progress_shown() as progress:
        advice = adviser.advise(expected, limits, effort, seed, progress)
        typer.echo(advice_text(advice))
        files = advice_files(advice)
        write_owned(folder, "advise", files)
        if advice.possible:
            typer.echo("\n" + cost_table(advice).markdown())
            typer.echo(patterns_of(advice).markdown())
        if check and advice.possible:
            message = adviser_check.check_text(adviser_check.check(advice, progress=progress))
            write_owned(folder, "advise", {**files, "check.txt": message.encode() + b"\n"})
            typer.echo(message)
    typer.echo(f"Tables and picture are in {folder.absolute()}")
    return advice.possible


def _span(option: str, text: str | None) -> list[float] | None:
    """Parse ``A:B``, or ``A`` for a range of one value."""
    if text is None:
        return None
    try:
        low, _, high = text.partition(":")
        return [float(low), float(high or low)]
    except ValueError as error:
        expected = "two numbers A:B, from the smaller to the larger"
        raise InputError(option, "range", text, expected) from error
