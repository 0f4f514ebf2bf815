"""How far a pool's size is off by what its rig and calibration are not exactly known to be."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from labapp.config.setup import Setup
from labapp.core.calibration.laser_calibration import LaserCalibration
from labapp.core.calibration.plane_calibration import PlaneCalibration
from labapp.core.geometry.coordinates import ImageCalibration
from labapp.core.geometry.rig import Rig
from labapp.core.match import Match
from labapp.core.pipeline import Measurement, Settings, reconstruct
from labapp.core.surface.measures import Measures, measure_surface
from labapp.core.values import CannotMeasure, FloatArray, ReadOnlyArrays
from labapp.studies.parameter_deviation import NOMINAL, OFFSETS, QUANTITIES, AxisPoints, move

SIZES = ("width_mm", "length_mm", "height_mm", "depth_mm", "area_mm2", "volume_mm3")


@dataclass(frozen=True)
class Contribution(ReadOnlyArrays):
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
            size = measure_surface(reconstruct(match, rig, settings), match, rig)
        except CannotMeasure:
            return np.full(len(SIZES), np.nan)
        return np.abs(_sizes(size) - _sizes(base))

    axes, sigmas, nominal = _known(setup, laser, plane)
    found = []
    for quantity, sigma, assumed in zip(QUANTITIES, sigmas, nominal, strict=True):
        steps = sigma * np.eye(OFFSETS)[list(quantity.parts)]
        changes = [change(*move(match, setup.rig, axes, step)) for step in steps]
        each = np.sqrt(np.sum(np.square(changes), axis=0))
        found.append(Contribution(quantity.name, sigma, quantity.unit, assumed, each))
    return tuple(found)


def root_sum_of_squares(*contributions: FloatArray) -> FloatArray:
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


def _known(
    setup: Setup, laser: LaserCalibration | None, plane: PlaneCalibration | None
) -> tuple[AxisPoints, list[float], list[bool]]:
    """The axis points, the ± of each of `QUANTITIES`, and which of these are nominal."""
    size = setup.rig.imaging_plane
    axes = AxisPoints(setup.calibration, size.width_mm / 2, size.height_mm / 2)
    sigma, nominal = list(NOMINAL), [True] * len(NOMINAL)
    if laser is not None and laser_in_use(laser, setup.rig):
        sigma[:2], nominal[:2] = [laser.angle_sigma_deg, laser.distance_sigma_mm], [False] * 2
    if plane is not None and plane_in_use(plane, setup.calibration):
        axes = AxisPoints(setup.calibration, plane.x_axis_mm, plane.z_axis_mm)
        sigma[5:], nominal[5:] = plane.points_sigma_px, [False] * 3
    return axes, sigma, nominal
