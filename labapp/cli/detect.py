"""`labapp detect`: dots, rows and columns of one image, without a set-up."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from labapp.cli.shared import NOTHING_MEASURED, Detector, Rows, check_target
from labapp.errors import InputError


def detect(
    image: Annotated[
        Path, typer.Argument(help="An image; of a video or a folder, the first frame is taken.")
    ],
    out: Annotated[
        Path, typer.Option(help="CSV file for the dots: px, reflected row and column, SNR.")
    ],
    size: Annotated[
        float | None,
        typer.Option(
            min=0.5,
            max=20.0,
            metavar="PX",
            help="Standard deviation of a dot's light (px), about a quarter of its visible "
            "diameter. Default: estimated from the image. For the band-pass detector only.",
        ),
    ] = None,
    detector: Detector = "band-pass",
    rows: Rows = "grow",
) -> None:
    """Find the dots of one image and their rows and columns, without a set-up.

    Rows are counted from the bottom up, columns from left to right.

    The cells of a dot in doubt are empty. Exit code 1: no dot has a row and a column.
    """
    from labapp.core.images.dots import BandPassSettings
    from labapp.core.images.find_dots import DotSettings
    from labapp.core.rows.find_lattice import LatticeSettings
    from labapp.run.detect import detect_dots, write_detected

    if size is not None and detector != "band-pass":
        raise InputError("--size", "size", size, "--detector band-pass, which alone has it")
    how = DotSettings(detector, BandPassSettings(size_px=size)), LatticeSettings(rows)
    check_target(out, ".csv", inputs=[image])
    dots, lattice, doubt = detect_dots(image, *how)
    write_detected(out, dots, lattice)
    if doubt:
        typer.echo(f"{image}: {doubt}", err=True)
    placed = 0 if lattice is None else int((lattice.row > 0).sum())
    message = placed or "none"
    typer.echo(f"{len(dots)} dots, {message} with a row and a column, in {out.absolute()}")
    if not placed:
        raise typer.Exit(NOTHING_MEASURED)
