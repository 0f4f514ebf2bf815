"""`labapp calibrate laser`: angle, distance and height from the cross-hair (Appendix I)."""

from __future__ import annotations

from typing import Annotated

import typer

from labapp.cli.calibrate.setup_file import SetupToChange, write_values


def calibrate_laser(
    l1: Annotated[
        list[float],
        typer.Option(help="Half length of the cross on the laser's side (mm); repeat for more."),
    ],
    l2: Annotated[
        list[float], typer.Option(help="Half length on the far side (mm); repeat for more.")
    ],
    l3: Annotated[list[float], typer.Option(help="Half length across (mm); repeat for more.")],
    fan_angle: Annotated[
        float, typer.Option(help="Fan angle of the cross-hair lens (degrees).")
    ] = 10.0,
    fan_angle_sigma: Annotated[
        float,
        typer.Option(min=0, max=10, help="Its standard uncertainty (degrees)."),
    ] = 0.1,
    resolution: Annotated[
        float, typer.Option(min=0, max=10, help="Smallest step of the callipers (mm).")
    ] = 0.05,
    setup: SetupToChange = None,
) -> None:
    """Determine the laser's angle, distance and height from its cross-hair (Appendix I).

    Read every length at least three times: the ± is computed from the scatter of the readings,
    with Student's factor. Values, standard uncertainties and correlation are written to --setup.
    """
    from labapp.core.calibration import laser_calibration as core

    settings = core.LaserCalibrationSettings(
        resolution_mm=resolution, fan_angle_sigma_deg=fan_angle_sigma
    )
    try:
        found = core.calibrate_laser(l1, l2, l3, fan_angle, settings)
    except ValueError as error:
        raise typer.BadParameter(str(error)) from error
    typer.echo(f"projection angle {found.angle_deg:.3f} ± {found.angle_sigma_deg:.3f} degrees")
    typer.echo(f"distance         {found.distance_mm:.3f} ± {found.distance_sigma_mm:.3f} mm")
    typer.echo(f"height           {found.height_mm:.3f} ± {found.height_sigma_mm:.3f} mm")
    typer.echo(f"correlation      {found.correlation:+.2f} of angle and distance")
    for warning in found.warnings:
        typer.echo(f"warning: {warning}", err=True)
    write_values(setup, {"laser": found.setup_keys})
