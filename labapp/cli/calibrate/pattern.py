"""`labapp calibrate pattern`: ray directions of a lens from pictures of flat mirrors."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from labapp.cli.calibrate.bench import mirror_picture
from labapp.cli.shared import NOTHING_MEASURED, check_distinct, check_target, show_warnings
from labapp.errors import InputError
from labapp.files import write_file
from labapp.text import pluralize

CONTRADICTING = 3.0
"""Ratio of the pictures' disagreement to that expected from dot noise which is an error."""

HIGHEST_MM = 1000.0
"""Largest height of a mirror above the work piece."""


def calibrate_pattern(
    *,
    setup: Annotated[Path, typer.Option(help="Setup file (TOML).")],
    pictures: Annotated[list[Path], typer.Argument(help="Pictures of a flat mirror.")],
    height: Annotated[
        list[float],
        typer.Option(
            help="Height of the mirror above the work piece in each picture, in the same order "
            "(mm). Repeat for each picture; at least two different heights."
        ),
    ],
    out: Annotated[Path, typer.Option(help="Table of rays (CSV), beside the setup file.")],
    use: Annotated[
        bool, typer.Option("--use", help="Make the table the pattern of the setup file.")
    ] = False,
) -> None:
    """Measure the direction of every ray from pictures of a flat mirror at known heights.

    Laser, imaging plane and camera are taken from the setup file: check the bench first.
    Exit code 1: the rays cannot be identified, or the heights contradict each other.
    """
    import numpy as np

    from labapp.config.ray_file import ray_table
    from labapp.config.setup import read_setup, update_setup
    from labapp.core.bench_check.mirrors import Plate
    from labapp.core.bench_check.pattern_calibration import calibrate_pattern as calibrated
    from labapp.core.geometry.patterns import MEASURED
    from labapp.core.values import CannotMeasure

    known = show_warnings(read_setup(setup))
    _check_options(setup, pictures, height, out, use)
    check_target(out, ".csv")
    try:
        found = calibrated(
            [mirror_picture(path, Plate(z)) for path, z in zip(pictures, height, strict=True)],
            known.bench,
        )
    except CannotMeasure as answer:
        typer.echo(f"{setup}: {answer}", err=True)
        raise typer.Exit(NOTHING_MEASURED) from answer
    sigma_deg = np.degrees(np.median(found.sigma))
    typer.echo(f"{len(found.ray)} rays, ± {sigma_deg:.4f}° (median, from the dots' noise)")
    typer.echo(f"off from the set-up's: {found.off_deg:.4f}° RMS")
    typer.echo(f"heights differ by {found.disagreement:.1f} times what the noise allows")
    if not found.disagreement <= CONTRADICTING:
        typer.echo(
            "the heights contradict each other: is the mirror level, and at the heights given? "
            "Is the imaging plane upright? labapp calibrate bench checks the set-up",
            err=True,
        )
        raise typer.Exit(NOTHING_MEASURED)
    write_file(out, ray_table(found.ray, found.tangents).encode())
    typer.echo(f"The rays are in {out.absolute()}")
    if use:
        left = dict.fromkeys(("rays", "absent", "rotation_deg"))
        values = {"kind": MEASURED, "file": out.name, **left}
        update_setup(setup, {"pattern": values}, complete=True)
        typer.echo(f"They are the pattern of {setup.absolute()}")


def _check_options(
    setup: Path, pictures: list[Path], height: list[float], out: Path, use: bool
) -> None:
    from labapp.core.bench_check.pattern_calibration import LEAST_PICTURES

    check_distinct(pictures)
    if len(height) != len(pictures) or len(set(height)) < LEAST_PICTURES:
        counts = f"{len(set(height))} for {pluralize(len(pictures), 'picture')}"
        raise InputError("--height", "heights", counts, "one for each picture, two that differ")
    if not all(abs(one) <= HIGHEST_MM for one in height):
        raise InputError("--height", "height", height, f"heights to {HIGHEST_MM:g} mm")
    if use and out.absolute().parent != setup.absolute().parent:
        raise InputError("--out", "folder", out, f"that of {setup}, which is to name the table")
