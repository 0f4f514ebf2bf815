"""`labapp calibrate plane`: the imaging plane from a picture of a target or a board (§5.1)."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from labapp.cli.calibrate.setup_file import SetupToChange, write_values
from labapp.cli.shared import NOTHING_MEASURED, check_distinct
from labapp.errors import InputError

if TYPE_CHECKING:
    from labapp.core.calibration.imaging_plane import Calibration
    from labapp.core.calibration.plane_calibration import PlaneCalibration


def calibrate_plane(
    images: Annotated[
        list[Path],
        typer.Argument(
            help="Picture of the target or a board in the imaging plane; of a board, more pictures "
            "of it in other poses may follow."
        ),
    ],
    unit_mm: Annotated[
        float | None,
        typer.Option(
            min=0.001,
            max=1000,
            help="Unit of the target's axes, the distance between flags of a bar (mm): measure it "
            "on the print. Default: 6.35, as on labapp's printed target and in its sample run.",
        ),
    ] = None,
    board: Annotated[
        str | None,
        typer.Option(
            metavar="BOARD",
            help="The board: a name (charuco_4_inch, …) or KIND:COLUMNSxROWS:SQUARE_MM. Default: "
            "boards printed by labapp are recognised.",
        ),
    ] = None,
    square_mm: Annotated[
        float | None,
        typer.Option(
            min=0.1,
            max=1000,
            help="Edge of the board's squares as measured on the print (mm). "
            "Default: that of the board.",
        ),
    ] = None,
    setup: SetupToChange = None,
) -> None:
    """Calibrate the imaging plane, and with a board the lens, from pictures (§5.1)."""
    from labapp.core.calibration.plane_calibration import UNIT_MM, PlaneCalibration

    unit = UNIT_MM if unit_mm is None else unit_mm
    found, (height, width) = _calibrated(images, unit, board, setup)
    _refuse_other_length(found, unit_mm, square_mm)
    if isinstance(found, PlaneCalibration):
        _show_target(found, unit)
    elif square_mm is not None:
        found = found.with_square(square_mm)
    (x_scale, z_scale), angle = found.px_per_mm, found.angle_deg
    x_sigma, z_sigma, angle_sigma = found.scales_and_angle_sigma
    typer.echo(
        f"scale      {x_scale:.4f} ± {x_sigma:.4f} px/mm along X′, "
        f"{z_scale:.4f} ± {z_sigma:.4f} px/mm along Z′, "
        f"{angle:.2f} ± {angle_sigma:.2f} degrees between them"
    )
    for line in found.fit_lines():
        typer.echo(line)
    keys = found.setup_keys
    keys["image_calibration"]["frame_px"] = [width, height]
    write_values(setup, keys)


def _calibrated(
    images: Sequence[Path], unit_mm: float, board: str | None, setup: Path | None
) -> tuple[Calibration, tuple[int, ...]]:
    """Calibrate from pictures, for those of the target with the lens in the setup file.

    Also returns (rows, columns) of the first picture.
    """
    from labapp.config.setup import A_SETUP
    from labapp.config.setup_text import check_lens, lens_of
    from labapp.config.toml_keys import read_text
    from labapp.core.calibration.boards import A_BOARD, parse_board
    from labapp.core.calibration.imaging_plane import calibrate_imaging_plane
    from labapp.core.values import CannotMeasure
    from labapp.media import read_picture

    check_distinct(images)
    pictures = [read_picture(path) for path in images]
    try:
        named = None if board is None else parse_board(board)
    except ValueError as error:
        raise InputError("--board", "board", f"{board} ({error})", A_BOARD) from error
    lens = None
    if setup is not None and setup.is_file():
        text = read_text(setup, A_SETUP)
        check_lens(text, setup)
        lens = lens_of(text)
    try:
        return calibrate_imaging_plane(pictures, unit_mm, named, lens), pictures[0].shape
    except CannotMeasure as answer:
        if answer.status != "no-target":
            shown = f"a picture in which the board is seen, flat and sharp. {answer.reason}"
            raise InputError(images[0], "board", answer.status, shown) from answer
        typer.echo(f"{images[0]}: {answer}", err=True)
        raise typer.Exit(NOTHING_MEASURED) from answer


def _refuse_other_length(
    found: Calibration, unit_mm: float | None, square_mm: float | None
) -> None:
    """Raise `InputError` if the length given is not of what the picture shows."""
    from labapp.core.calibration.plane_calibration import PlaneCalibration

    if isinstance(found, PlaneCalibration):
        if square_mm is not None:
            right = "--unit-mm, the unit of the axes: the picture shows the target, not a board"
            raise InputError("--square-mm", "length", f"{square_mm:g}", right)
    elif unit_mm is not None:
        right = f"--square-mm, the edge of a square: the picture shows {found.board.name}"
        raise InputError("--unit-mm", "length", f"{unit_mm:g}", right)


def _show_target(found: PlaneCalibration, unit_mm: float) -> None:
    """Print the target's three points as in a setup file.

    Their ± are those of the map where the dots are: O′ itself is known better.
    """
    known = found.setup_uncertainty
    lengths = {"x_axis_mm": found.x_axis_mm, "z_axis_mm": found.z_axis_mm}
    for name, (u, v) in zip(("origin_px", "x_axis_px", "z_axis_px"), found.points_px, strict=True):
        typer.echo(f"{name}  {u:.3f}, {v:.3f} ± {known[f'{name}_sigma']:.3f} px")
    for name, length in lengths.items():
        typer.echo(f"{name}  {length:.4f} mm")
    typer.echo(f"unit       {unit_mm:g} mm between flags (--unit-mm)")
