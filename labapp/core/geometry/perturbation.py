"""A bench whose quantities (`uncertainty.QUANTITIES`) are off from what they are taken for.

An offset is a vector over the quantities, in their units. Which ray made which dot stays.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from labapp.core.geometry.coordinates import ImageCalibration
from labapp.core.geometry.rig import ImagingPlane, Laser, Rig
from labapp.core.geometry.uncertainty import INDEX, AxisPoints
from labapp.core.values import FloatArray

_LASER, _PATTERN, _PLANE = (
    [(key.partition(".")[2], k) for key, k in INDEX.items() if key.startswith(f"{section}.")]
    for section in ("laser", "pattern", "imaging_plane")
)
_POINTS = [k for key, k in INDEX.items() if key.startswith("image_calibration.")]
_DISTORTION = INDEX["camera_lens.distortion_percent"]


def moved_rig(rig: Rig, offset: FloatArray) -> Rig:
    """Rig with its quantities off by an offset, shape (q,)."""
    laser = {name: getattr(rig.laser, name) + offset[k] for name, k in _LASER}
    pattern = {name: getattr(rig.pattern, name) + offset[k] for name, k in _PATTERN}
    plane, by = rig.imaging_plane, {name: offset[k] for name, k in _PLANE}
    if any(by.values()):
        origin = plane.origin_mm + np.array([-by["s_mm"], -by["distance_mm"], by["h_mm"]])
        turned = [by["pitch_deg"], by["yaw_deg"], by["roll_deg"]]
        pitch, yaw, roll = np.add(plane.angles_deg, turned).tolist()
        posed = ImagingPlane.of_angles(origin, (pitch, yaw, roll))
        axes = posed.x_axis, posed.z_axis
        plane = replace(plane, origin_mm=origin, x_axis=axes[0], z_axis=axes[1])
    return replace(
        rig,
        laser=replace(rig.laser, **laser),
        pattern=replace(rig.pattern, **pattern),
        imaging_plane=plane,
    )


def aimed_as(laser: Laser, rig: Rig) -> Rig:
    """The rig moved along the work piece until its laser aims where another does.

    No size changes by that, and the surface stays where its splines are.
    """
    aside = np.array([rig.laser.aim_x_mm - laser.aim_x_mm, rig.laser.aim_y_mm - laser.aim_y_mm, 0])
    back = replace(rig.laser, aim_x_mm=laser.aim_x_mm, aim_y_mm=laser.aim_y_mm)
    plane = replace(rig.imaging_plane, origin_mm=rig.imaging_plane.origin_mm - aside)
    return replace(rig, laser=back, imaging_plane=plane)


def moved_dots(plane_mm: FloatArray, rig: Rig, axes: AxisPoints, offset: FloatArray) -> FloatArray:
    """Dots on the plane, shape (n, 2), mm, with its picture's quantities off by an offset, (q,).

    The dots stay where they are in the picture: their places on the plane follow the axis points
    and the lens. Its distortion grows with the cube of the distance from the plane's centre.
    """
    points = offset[_POINTS].reshape(3, 2)
    if points.any():
        # What was taken for the moved points is where the true ones are.
        calibration = axes.calibration
        true = calibration.to_image(_axis_points_mm(axes))
        dots = _with_ones(calibration.to_image(plane_mm))
        share = np.linalg.solve(_with_ones(true + points).T, dots.T)
        plane_mm = calibration.to_plane(share.T @ true)
    if offset[_DISTORTION]:
        corner = np.array([rig.imaging_plane.width_mm, rig.imaging_plane.height_mm]) / 2
        out = plane_mm - corner
        share = np.sum(out**2, axis=-1, keepdims=True) / np.sum(corner**2)
        plane_mm = plane_mm + offset[_DISTORTION] / 100 * share * out
    return plane_mm


def moved_calibration(axes: AxisPoints, offset: FloatArray) -> ImageCalibration:
    """Image calibration whose three points are off by an offset, shape (q,), lens as it is."""
    plane_mm = _axis_points_mm(axes)
    seen = axes.calibration.to_image(plane_mm) + offset[_POINTS].reshape(3, 2)
    origin, on_x, on_z = (tuple(point) for point in seen.tolist())
    lens = axes.calibration.lens
    return ImageCalibration.from_three_points(origin, on_x, axes.x_mm, on_z, axes.z_mm, lens)


def _axis_points_mm(axes: AxisPoints) -> FloatArray:
    return np.array([[0.0, 0.0], [axes.x_mm, 0.0], [0.0, axes.z_mm]])


def _with_ones(points: FloatArray) -> FloatArray:
    return np.column_stack([points, np.ones(len(points))])
