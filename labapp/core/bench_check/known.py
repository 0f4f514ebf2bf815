"""A known mirror measured with the adjusted bench, as if its size were not known."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from labapp.core.bench_check.adjustment import Sighting, adjust
from labapp.core.bench_check.check import BenchCheck, CheckedPicture
from labapp.core.bench_check.mirrors import Ball, Cap, Mirror, Plate, sphere_radius
from labapp.core.geometry.bench import Bench
from labapp.core.matching.observation import Observation
from labapp.core.values import FloatArray

LOOSE = 0.5
"""Standard uncertainty of a size that is to be measured, over the size."""

LOOSE_PLATE_MM, LOOSE_TILT_DEG = 5.0, 1.0


@dataclass(frozen=True)
class MeasuredSize:
    """A size of a mirror, known and measured, mm.

    Parameters
    ----------
    name
        ``height`` or ``radius``.
    known_mm, measured_mm
        As it was given, and as the adjusted bench has it.
    sigma_mm
        Standard uncertainty of the latter by the noise of the dots.
    """

    name: str
    known_mm: float
    measured_mm: float
    sigma_mm: float


def measure_known(check: BenchCheck, picture: CheckedPicture) -> tuple[MeasuredSize, ...]:
    """Sizes of a picture's mirror that the adjusted bench measures: its height, and its radius.

    Parameters
    ----------
    check, picture
        The check, and one of its pictures.
    """
    knows, taken = check.rig.uncertainty, picture.picture
    assert knows is not None
    bench = Bench(check.rig, check.calibration)
    observed = Observation.of(taken.dots, bench, taken.frame_shape)
    exact = replace(
        check.rig, uncertainty=replace(knows, covariance=np.zeros_like(knows.covariance))
    )
    mirror = _loosened(taken.mirror)
    sighting = Sighting(
        mirror,
        picture.ray - 1,
        observed.plane_mm[picture.dot],
        observed.covariance_mm2[picture.dot],
    )
    made = adjust(exact, [sighting])
    pose, covariance = made.poses[0], made.pose_covariances[0]
    at = mirror.parameters.index("height_mm")
    height = MeasuredSize(
        "height", float(taken.mirror.pose[at]), float(pose[at]), float(np.sqrt(covariance[at, at]))
    )
    if isinstance(mirror, Plate):
        return (height,)
    slope = np.array([_radius(mirror, pose + step) for step in 1e-4 * np.eye(len(pose))])
    radius = _radius(mirror, pose)
    slope = (slope - radius) / 1e-4
    sigma = float(np.sqrt(slope @ covariance @ slope))
    return MeasuredSize("radius", _radius(mirror, taken.mirror.pose), radius, sigma), height


def _radius(mirror: Mirror, pose: FloatArray) -> float:
    _, _, height, diameter = pose
    return float(sphere_radius(diameter, height) if isinstance(mirror, Cap) else diameter / 2)


def _loosened(mirror: Mirror) -> Mirror:
    """The mirror, its sizes hardly known."""
    if isinstance(mirror, Plate):
        return replace(mirror, height_sigma_mm=LOOSE_PLATE_MM, tilt_sigma_deg=LOOSE_TILT_DEG)
    if isinstance(mirror, Cap):
        return replace(
            mirror,
            height_sigma_mm=LOOSE * mirror.height_mm,
            diameter_sigma_mm=LOOSE * mirror.diameter_mm,
        )
    assert isinstance(mirror, Ball)
    wide = LOOSE * mirror.diameter_mm
    return replace(mirror, top_sigma_mm=wide, diameter_sigma_mm=wide)
