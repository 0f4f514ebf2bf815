"""`labapp calibrate fold`: the imaging plane behind a flat folding mirror (§9.2)."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated

import typer

from labapp.cli.shared import finite, show_warnings
from labapp.errors import InputError

Vector = tuple[float, float, float]


def calibrate_fold(
    *,
    setup: Annotated[
        Path, typer.Option(help="Setup file (TOML), with the true pose of the imaging plane.")
    ],
    point: Annotated[
        Vector, typer.Option(metavar="X Y Z", help="A point of the mirror's face (mm).")
    ],
    normal: Annotated[
        Vector, typer.Option(metavar="X Y Z", help="Its normal, of any length and sign.")
    ],
    position_sigma: Annotated[
        float,
        typer.Option(
            min=0, max=100, callback=finite, help="± of its position along the normal (mm)."
        ),
    ] = 0.5,
    tilt_sigma: Annotated[
        float, typer.Option(min=0, max=45, callback=finite, help="± of its tilt (degrees).")
    ] = 0.5,
    use: Annotated[
        bool, typer.Option("--use", help="Write the mirror image's pose into the setup file.")
    ] = False,
) -> None:
    """Compute the pose of the mirror image of an imaging plane behind a flat folding mirror.

    Rays meet the plane where they would meet its mirror image, so the set-up has the image's pose.
    Applied twice, the command returns the pose of the plane itself.
    """
    import numpy as np

    from labapp.config.setup import read_setup, update_setup
    from labapp.core.geometry.folding import FoldingMirror, image_sigma
    from labapp.core.geometry.rig import POSE
    from labapp.core.geometry.uncertainty import INDEX

    if not all(map(math.isfinite, point)):
        raise InputError("--point", "point", point, "three numbers (mm)")
    if not (all(map(math.isfinite, normal)) and any(normal)):
        raise InputError("--normal", "normal", normal, "three numbers that are not all 0")
    rig = show_warnings(read_setup(setup)).rig
    assert rig.uncertainty is not None
    mirror = FoldingMirror(np.array(point), np.array(normal))
    pose = mirror.image_of(rig.imaging_plane).pose
    if abs(pose[3]) > STEEPEST_DEG:
        expected = f"an image that is not level: pitch below {STEEPEST_DEG:g} degrees"
        raise InputError("--normal", "image's pitch", f"{pose[3]:.4g} degrees", expected)
    if pose[0] <= 0:
        expected = "a mirror whose image of O′ lies on the far side of the torch, at Y below 0"
        raise InputError("--point", "image", f"O′ at Y = {-pose[0]:g} mm", expected)
    keys = [f"imaging_plane.{name}" for name in POSE]
    plane_sigma = rig.uncertainty.sigma[[INDEX[key] for key in keys]]
    mirror_sigma = np.array([position_sigma, tilt_sigma, tilt_sigma])
    sigma = image_sigma(rig.imaging_plane, mirror, plane_sigma, mirror_sigma)
    for name, value, one in zip(POSE, pose, sigma, strict=True):
        typer.echo(f"{name:12} {value:10.4f} ± {one:.4f}")
    if use:
        values = {name: round(float(value), 9) for name, value in zip(POSE, pose, strict=True)}
        sigmas = {
            f"{name}_sigma": round(float(one), 9) for name, one in zip(POSE, sigma, strict=True)
        }
        update_setup(setup, {"imaging_plane": values | sigmas}, complete=True)
        typer.echo(f"They are the imaging plane of {setup.absolute()}")


STEEPEST_DEG = 85.0
"""Largest pitch: near 90 degrees, yaw and roll rotate about nearly the same axis."""
