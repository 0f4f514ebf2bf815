"""Benches that deviate from their set-up within its uncertainties."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from labapp.core.geometry.rig import ImagingPlane, Rig
from labapp.simulation.camera import CameraView, Lens

FOCAL_PX = 2000.0
"""Focal length of a distant camera, px."""


@dataclass(frozen=True)
class BenchErrors:
    """Size of the deviations of a bench from its set-up.

    Parameters
    ----------
    angle_deg, length_mm, rotation_deg, inter_beam_angle_deg, point_px
        Standard deviation of each angle of laser and plane, of each length, of the pattern's
        rotation and inter-beam angle, and of the image calibration's points along u and v.
    distortion
        Largest radial distortion in the plane's corner, either way, as a fraction.
    axis_mm, glass_mm, glass_index
        Standard deviation of the positions of the image calibration's points on the axes, and of
        thickness and refractive index of the glass on the plane.
    """

    angle_deg: float = 0.5
    length_mm: float = 0.5
    rotation_deg: float = 1.0
    inter_beam_angle_deg: float = 0.004
    point_px: float = 0.3
    distortion: float = 0.01
    axis_mm: float = 0.0
    glass_mm: float = 0.0
    glass_index: float = 0.0


@dataclass(frozen=True)
class SimulatedBench:
    """The true bench and its camera's true view of the plane."""

    rig: Rig
    view: CameraView


def draw_bench(
    rig: Rig, view: CameraView, errors: BenchErrors, rng: np.random.Generator
) -> SimulatedBench:
    """Draw a bench whose recorded set-up is the given rig and a view without lens.

    Parameters
    ----------
    rig, view
        The set-up: the true bench differs from it by the errors and by a lens centred on the
        picture.
    errors
        Size of the deviations.
    rng
        Source of the errors.
    """
    angle, length = rng.normal(0, errors.angle_deg, 5), rng.normal(0, errors.length_mm, 6)
    by_angle, by_length = angle.tolist(), length.tolist()
    laser, plane = rig.laser, rig.imaging_plane
    true_laser = replace(
        laser,
        projection_angle_deg=laser.projection_angle_deg + by_angle[0],
        azimuth_deg=laser.azimuth_deg + by_angle[1],
        distance_mm=laser.distance_mm + by_length[0],
        aim_x_mm=laser.aim_x_mm + by_length[1],
        aim_y_mm=laser.aim_y_mm + by_length[2],
    )
    pitch, yaw, roll = np.add(plane.angles_deg, by_angle[2:]).tolist()
    # From a separate generator, so that the other draws do not depend on these.
    by_axis, by_glass = np.split(rng.spawn(1)[0].normal(size=4), 2)
    by_glass = by_glass * [errors.glass_mm, errors.glass_index]
    posed = ImagingPlane.of_angles(
        plane.origin_mm + length[3:], (pitch, yaw, roll), plane.width_mm, plane.height_mm
    )
    true_plane = replace(
        posed,
        glass_mm=plane.glass_mm + float(by_glass[0]),
        glass_index=plane.glass_index + float(by_glass[1]),
    )
    step = rng.normal(0, errors.inter_beam_angle_deg)
    true_pattern = replace(
        rig.pattern,
        inter_beam_angle_deg=rig.pattern.inter_beam_angle_deg + step,
        rotation_deg=rig.pattern.rotation_deg + rng.normal(0, errors.rotation_deg),
    )
    corner_px = (
        np.hypot(plane.width_mm, plane.height_mm) / 2 * np.sqrt(abs(np.linalg.det(view.px_per_mm)))
    )
    k1 = rng.uniform(-errors.distortion, errors.distortion) / (corner_px / FOCAL_PX) ** 2
    true_rig = replace(
        rig, laser=true_laser, pattern=true_pattern, imaging_plane=true_plane, uncertainty=None
    )
    seen = np.array([view.origin_px, view.x_axis_px, view.z_axis_px])
    origin, on_x, on_z = (seen + rng.normal(0, errors.point_px, (3, 2))).tolist()
    x_mm, z_mm = ([view.x_axis_mm, view.z_axis_mm] + errors.axis_mm * by_axis).tolist()
    true_view = replace(
        view,
        origin_px=tuple(origin),
        x_axis_px=tuple(on_x),
        x_axis_mm=x_mm,
        z_axis_px=tuple(on_z),
        z_axis_mm=z_mm,
        lens=Lens(FOCAL_PX, float(k1)),
    )
    return SimulatedBench(true_rig, true_view)
