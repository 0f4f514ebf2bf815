"""`labapp calibrate bench`: a check of the set-up with pictures of known mirrors."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from labapp.cli.shared import NOTHING_MEASURED, check_distinct, check_target, show_warnings
from labapp.errors import InputError
from labapp.files import write_file
from labapp.text import csv_text, pluralize

if TYPE_CHECKING:
    from labapp.config.setup import Setup
    from labapp.core.bench_check.check import BenchCheck
    from labapp.core.bench_check.labelling import MirrorDots
    from labapp.core.bench_check.mirrors import Mirror
    from labapp.core.geometry.rig import Rig


def calibrate_bench(
    *,
    setup: Annotated[Path, typer.Option(help="Setup file (TOML).")],
    pictures: Annotated[list[Path] | None, typer.Argument(help="Pictures of mirrors.")] = None,
    mirror: Annotated[
        list[str] | None,
        typer.Option(
            metavar="MIRROR",
            help="The mirror of each picture, in the same order: plate:HEIGHT, "
            "cap:DIAMETER:HEIGHT, ball:DIAMETER:TOP (mm, above the work piece); a standard "
            "uncertainty may follow, as in 2+-0.01; plate:HEIGHT:LEVEL gives the ± of its level "
            "(degrees). Repeat for more pictures.",
        ),
    ] = None,
    free: Annotated[
        list[str] | None,
        typer.Option(
            metavar="KEY",
            help="Quantity to adjust without its prior, such as laser.distance_mm or picture.u; "
            "repeat for more.",
        ),
    ] = None,
    predict: Annotated[
        bool,
        typer.Option(
            "--predict", help="Only predict which pictures would be most useful; needs none."
        ),
    ] = False,
    use: Annotated[
        bool, typer.Option("--use", help="Write the adjusted set-up into the setup file.")
    ] = False,
    out: Annotated[
        Path | None, typer.Option(help="CSV file for the residual of every dot.")
    ] = None,
) -> None:
    """Check the set-up with pictures of known mirrors, and adjust it.

    Exit code 1: the set-up cannot be adjusted to the pictures, and is not changed.
    """
    from labapp.config.mirror_text import parse_mirror
    from labapp.config.setup import parse_setup, read_setup_text, unchecked_setup

    text = read_setup_text(setup)
    parse_setup(text, setup)
    before = unchecked_setup(text, setup)
    known = show_warnings(parse_setup(before, setup))
    mirrors = [parse_mirror(one) for one in mirror or []]
    if predict:
        if pictures or free or use or out is not None:
            right = "no pictures, --free, --use or --out: nothing is adjusted"
            raise InputError("--predict", "options", "with others", right)
        _print_forecast(known.rig, mirrors)
        return
    if out is not None:
        check_target(out, ".csv")
    check = _checked(setup, known, pictures or [], mirrors, free or [])
    _print_check(check)
    if out is not None:
        write_file(out, _residuals(check).encode())
    if check.status != "ok":
        raise typer.Exit(NOTHING_MEASURED)
    if use:
        _write(setup, text, before, check)


def _checked(
    setup: Path, known: Setup, pictures: list[Path], mirrors: list[Mirror], free: list[str]
) -> BenchCheck:
    from labapp.core.bench_check.check import check_bench
    from labapp.core.bench_check.suspects import suspect_keys
    from labapp.core.values import CannotMeasure

    if not pictures:
        raise InputError("PICTURE", "pictures", "none", "one or more, or --predict")
    check_distinct(pictures)
    if len(mirrors) != len(pictures):
        counts = f"{len(mirrors)} for {pluralize(len(pictures), 'picture')}"
        raise InputError("--mirror", "mirrors", counts, "one for each picture, in their order")
    for key in free:
        if key not in suspect_keys():
            raise InputError("--free", "key", key, f"one of {', '.join(suspect_keys())}")
    try:
        found = [mirror_picture(path, one) for path, one in zip(pictures, mirrors, strict=True)]
        return check_bench(found, known.bench, free)
    except CannotMeasure as answer:
        typer.echo(f"{setup}: {answer}", err=True)
        raise typer.Exit(NOTHING_MEASURED) from answer


def mirror_picture(path: Path, mirror: Mirror) -> MirrorDots:
    """Find the dots in a picture of a mirror."""
    from labapp.core.bench_check.labelling import MirrorDots
    from labapp.core.images.find_dots import DotSettings, find_mirror_dots
    from labapp.media import read_picture

    image = read_picture(path)
    height, width = image.shape
    return MirrorDots(path.name, mirror, find_mirror_dots(image, DotSettings()), (height, width))


def _print_forecast(rig: Rig, mirrors: list[Mirror]) -> None:
    """Print the predicted ± of a typical pool's height after a check with various pictures."""
    from labapp.core.bench_check.forecast import CANDIDATES, EXPECTED, forecast

    every = dict(CANDIDATES)
    if mirrors:
        every[", ".join(one.name for one in mirrors)] = tuple(mirrors)
    typer.echo(f"± of the height of a pool like a {EXPECTED.name} (mm)")
    typer.echo(f"{'pictures':40} {'set-up':>8} {'total':>8}")
    predicted = forecast(rig, every)
    for one in predicted:
        typer.echo(f"{one.name:40} {one.setup_sigma_mm:8.4f} {one.total_sigma_mm:8.4f}")
    for name in sorted(every.keys() - {one.name for one in predicted}):
        typer.echo(f"not predicted: {name}: no dot of it, or of one of them, would be on the plane")


def _print_check(check: BenchCheck) -> None:
    from labapp.core.bench_check.forecast import EXPECTED, blind_spots, height_sigma
    from labapp.core.values import CannotMeasure

    typer.echo(f"{'quantity':40} {'before':>10} {'±':>8} {'after':>10} {'±':>8}")
    for one in check.changes:
        name = ", ".join(filter(None, (one.name, one.unit)))
        typer.echo(
            f"{name:40} {one.before:10.4f} {one.before_sigma:8.4f} "
            f"{one.after:10.4f} {one.after_sigma:8.4f}"
        )
    if check.undetermined:
        names = "; ".join(one.name for one in check.undetermined)
        typer.echo(f"not determined by these pictures: {names}")
    for picture in check.pictures:
        typer.echo(
            f"{picture.picture.name}: {picture.picture.mirror.name}, {len(picture.ray)} dots of "
            f"{len(picture.picture.dots)} with a ray, residual {1000 * picture.rms_mm:.0f} µm RMS"
        )
        for size in picture.sizes:
            typer.echo(
                f"  {size.name}: known {size.known_mm:.3f} ± {size.known_sigma_mm:.3f} mm; "
                f"measured without that {size.independent_mm:.3f} ± "
                f"{size.independent_sigma_mm:.3f} mm; with the new set-up, which has it in it, "
                f"{size.measured_mm:.3f} mm"
            )
    typer.echo(f"residuals: {check.verdict}")
    try:
        was, now = height_sigma(check.before), height_sigma(check.rig)
        blind = blind_spots(check)
    except CannotMeasure:
        pass
    else:
        typer.echo(
            f"± of the height of a pool like a {EXPECTED.name}: "
            f"{was.total_sigma_mm:.4f} → {now.total_sigma_mm:.4f} mm"
        )
        for spot in blind:
            typer.echo(
                f"not noticed: an error of the height in {spot.picture} below "
                f"{spot.noticed_mm:.2g} mm; it puts that pool's height off by up to "
                f"{spot.pool_mm:.2g} mm. Measure it, or add another mirror"
            )
    if check.status != "ok":
        typer.echo(f"{check.status}: {check.reason}", err=True)
        for suspect in check.suspects:
            typer.echo(f"to adjust with it free: --free {suspect.key}", err=True)


def _residuals(check: BenchCheck) -> str:
    """Return the residual of every dot as CSV."""
    rows: list[list[object]] = [
        ["picture", "ray_row", "ray_column", "plane_x_mm", "plane_z_mm", "residual_x_mm",
         "residual_z_mm"]
    ]  # fmt: skip
    for one in check.pictures:
        columns = one.ray.tolist(), one.plane_mm.tolist(), one.residual_mm.tolist()
        for ray, place, residual in zip(*columns, strict=True):
            cells = [f"{value:.6f}" for value in (*place, *residual)]
            rows.append([one.picture.name, *ray, *cells])
    return csv_text(rows)


def _write(setup: Path, text: str, before: str, check: BenchCheck) -> None:
    """Write the adjusted set-up, unless the file was changed in the meantime."""
    from labapp.config.setup import checked_setup, read_setup_text
    from labapp.text import now

    if read_setup_text(setup) != text:
        found = "changed while the pictures were checked"
        raise InputError(
            setup, "file", found, "the file as it was: check again, nothing is written"
        )
    write_file(setup, checked_setup(before, setup, check, now()).encode())
    typer.echo(f"The adjusted set-up is in {setup.absolute()}")
