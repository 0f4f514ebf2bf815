"""How far a pool's size is off by what its rig and calibration are not exactly known to be."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from labapp.core.coordinates import ImageCalibration
from labapp.core.correspondence import Match
from labapp.core.laser_calibration import LaserCalibration
from labapp.core.measures import Measures, measure
from labapp.core.pipeline import Measurement, Settings, reconstruct
from labapp.core.plane_calibration import PlaneCalibration
from labapp.core.rig import Rig
from labapp.core.values import CannotMeasure, FloatArray, freeze
from labapp.session.setup import Setup

SIZES = ("width_mm", "length_mm", "height_mm", "depth_mm", "area_mm2", "volume_mm3")

NOMINAL_MM, NOMINAL_DEG, NOMINAL_PX = 0.1, 0.1, 0.1
"""The ± of what nobody told a ± of."""


@dataclass(frozen=True)
class Contribution:
    """What one quantity's ± does to the sizes.

    Parameters
    ----------
    name
        The quantity.
    sigma, unit
        Its standard uncertainty.
    nominal
        Whether that is assumed, for want of a calibration that tells it.
    change
        What each of `SIZES` changes by, shape (6,), ≥ 0; NaN where there is then no surface.
    """

    name: str
    sigma: float
    unit: str
    nominal: bool
    change: FloatArray

    def __post_init__(self) -> None:
        freeze(self)


def calibration_budget(
    measurement: Measurement,
    setup: Setup,
    settings: Settings,
    laser: LaserCalibration | None,
    plane: PlaneCalibration | None,
) -> tuple[Contribution, ...]:
    """Reconstruct a measured frame anew with each calibrated quantity moved by its own ±.

    Which ray made which dot stays as it was found.

    Parameters
    ----------
    measurement
        A frame with a surface.
    setup, settings
        What it was measured with.
    laser, plane
        The calibrations; None, or of other values than the setup's: nominal ± are taken.
    """
    match, base = measurement.match, measurement.measures
    if match is None or base is None:
        raise ValueError("the frame has no surface")

    def change(match: Match, rig: Rig) -> FloatArray:
        try:
            size = measure(reconstruct(match, rig, settings), match, rig)
        except CannotMeasure:
            return np.full(len(SIZES), np.nan)
        return np.abs(_sizes(size) - _sizes(base))

    found = [
        Contribution(name, sigma, unit, nominal, change(match, rig))
        for name, sigma, unit, nominal, rig in _moved_rigs(setup.rig, laser)
    ]
    points = [
        Contribution(name, sigma, "px", nominal, _together([change(m, setup.rig) for m in moved]))
        for name, sigma, nominal, moved in _moved_points(match, setup, plane)
    ]
    return (*found, *points)


def together(*contributions: FloatArray) -> FloatArray:
    """Root of the sum of squares of independent contributions, shapes (6,); NaN counts as 0."""
    return np.asarray(np.sqrt(np.nansum(np.square(contributions), axis=0)))


def laser_in_use(laser: LaserCalibration | None, rig: Rig) -> bool:
    """Whether the rig's laser is where this calibration found it."""
    return laser is not None and bool(
        np.allclose(
            [laser.angle_deg, laser.distance_mm],
            [rig.laser.projection_angle_deg, rig.laser.distance_mm],
            rtol=1e-6,
        )
    )


def plane_in_use(plane: PlaneCalibration | None, calibration: ImageCalibration) -> bool:
    """Whether the image calibration is the one that was found in the picture."""
    return plane is not None and bool(
        np.allclose(plane.image_calibration.matrix, calibration.matrix, rtol=1e-6, atol=1e-9)
    )


def _sizes(measures: Measures) -> FloatArray:
    return np.array([getattr(measures, name) for name in SIZES])


def _together(changes: list[FloatArray]) -> FloatArray:
    return np.asarray(np.sqrt(np.sum(np.square(changes), axis=0)))


def _moved_rigs(
    rig: Rig, laser: LaserCalibration | None
) -> Iterator[tuple[str, float, str, bool, Rig]]:
    """Name, ±, unit, whether it is nominal, and the rig with that one quantity moved."""
    angle, distance, nominal = NOMINAL_DEG, NOMINAL_MM, True
    if laser is not None and laser_in_use(laser, rig):
        angle, distance, nominal = laser.angle_sigma_deg, laser.distance_sigma_mm, False
    now = rig.laser
    turned = replace(now, projection_angle_deg=now.projection_angle_deg + angle)
    yield "laser, projection angle", angle, "°", nominal, replace(rig, laser=turned)
    farther = replace(now, distance_mm=now.distance_mm + distance)
    yield "laser, distance", distance, "mm", nominal, replace(rig, laser=farther)
    for name, axis in (("distance", 1), ("s", 0), ("h", 2)):
        origin = rig.imaging_plane.origin_mm + NOMINAL_MM * np.eye(3)[axis]
        plane = replace(rig.imaging_plane, origin_mm=origin)
        yield f"imaging plane, {name}", NOMINAL_MM, "mm", True, replace(rig, imaging_plane=plane)


def _moved_points(
    match: Match, setup: Setup, plane: PlaneCalibration | None
) -> Iterator[tuple[str, float, bool, list[Match]]]:
    """Name, ±, whether it is nominal, and the match with O′ or an axis point moved along u and v.

    The dots stay where they are in the picture; their places on the plane follow the points.
    """
    calibration = setup.calibration
    x_mm, z_mm = setup.rig.imaging_plane.width_mm / 2, setup.rig.imaging_plane.height_mm / 2
    sigma, nominal = (NOMINAL_PX, NOMINAL_PX, NOMINAL_PX), True
    if plane is not None and plane_in_use(plane, calibration):
        x_mm, z_mm, sigma, nominal = plane.x_axis_mm, plane.z_axis_mm, plane.sigma_px, False
    points = calibration.to_image(np.array([[0.0, 0.0], [x_mm, 0.0], [0.0, z_mm]]))
    dots = _with_ones(calibration.to_image(match.plane_mm))
    for k, name in enumerate(("O′", "point on O′X′", "point on O′Z′")):
        moved = []
        for step in np.eye(2):
            seen = points.copy()
            seen[k] += sigma[k] * step
            # What was taken for the moved points is where the true ones are.
            share = np.linalg.solve(_with_ones(seen).T, dots.T)
            moved.append(replace(match, plane_mm=calibration.to_plane(share.T @ points)))
        yield f"image calibration, {name}", sigma[k], nominal, moved


def _with_ones(points: FloatArray) -> FloatArray:
    return np.column_stack([points, np.ones(len(points))])
