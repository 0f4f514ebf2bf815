"""A bench whose quantities (`uncertainty.QUANTITIES`) differ from their nominal values.

An offset is a vector over the quantities, in their units: the true value is the nominal one plus
the offset. Which ray made which dot stays.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from labapp.core.geometry.coordinates import ImageCalibration
from labapp.core.geometry.rig import ImagingPlane, Laser, Rig
from labapp.core.geometry.uncertainty import INDEX, QUANTITIES, AxisPoints
from labapp.core.values import FloatArray, ReadOnlyArrays

_LASER, _PATTERN, _PLANE = (
    [(key.partition(".")[2], k) for key, k in INDEX.items() if key.startswith(f"{section}.")]
    for section in ("laser", "pattern", "imaging_plane")
)
_POINTS = [k for key, k in INDEX.items() if key.startswith("image_calibration.")]
_DISTORTION = INDEX["camera_lens.distortion_percent"]


@dataclass(frozen=True)
class Direction(ReadOnlyArrays):
    """A way in which a bench may be off.

    Parameters
    ----------
    key
        Key of the quantity (`Quantity.key`), or ``picture.u``, ``picture.v``, ``picture.scale`` for
        the whole of the image calibration.
    name, unit
        What it is called, and what it is measured in.
    vector
        Offset of the quantities for one unit of it, shape (q,).
    """

    key: str
    name: str
    unit: str
    vector: FloatArray


def directions(rig: Rig) -> tuple[Direction, ...]:
    """Ways in which a bench may be off: by each quantity, and by its whole picture."""
    single = [
        Direction(one.key, one.name, one.unit, np.eye(len(QUANTITIES))[k])
        for k, one in enumerate(QUANTITIES)
    ]
    points = quantity_values(rig)[_POINTS].reshape(3, 2)
    whole = []
    for key, name, unit, shift in (
        ("picture.u", "picture, shifted along u", "px", np.array([1.0, 0.0])),
        ("picture.v", "picture, shifted along v", "px", np.array([0.0, 1.0])),
        ("picture.scale", "image calibration, scale", "%", (points - points[0]) / 100.0),
    ):
        vector = np.zeros(len(QUANTITIES))
        vector[_POINTS] = np.broadcast_to(shift, (3, 2)).ravel()
        whole.append(Direction(key, name, unit, vector))
    return *single, *whole


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
    calibration = axes.calibration
    base = ImageCalibration(calibration.matrix, calibration.plain_lens)
    plane_mm = _axis_points_mm(axes)
    true = _with_ones(base.ideal_px(base.to_image(plane_mm)))
    moved = base.ideal_px(base.to_image(plane_mm) + offset[_POINTS].reshape(3, 2))
    back = np.linalg.solve(_with_ones(moved), true).T
    return ImageCalibration(base.matrix @ back, base.lens)


def moved_bench(rig: Rig, offset: FloatArray) -> tuple[Rig, ImageCalibration]:
    """Rig and image calibration, with the quantities off by an offset, shape (q,).

    The rig's uncertainty has the new calibration and the covariance that there was.
    """
    assert rig.uncertainty is not None
    axes, plane = rig.uncertainty.axes, rig.imaging_plane
    percent = axes.calibration.distortion_percent + float(offset[_DISTORTION])
    half = np.array([plane.width_mm, plane.height_mm]) / 2
    calibration = moved_calibration(axes, offset).with_distortion(percent, half)
    uncertainty = replace(rig.uncertainty, axes=replace(axes, calibration=calibration))
    return replace(moved_rig(rig, offset), uncertainty=uncertainty), calibration


def quantity_values(rig: Rig) -> FloatArray:
    """Values of `QUANTITIES` that a rig with its uncertainty has, shape (q,), in their units."""
    assert rig.uncertainty is not None
    axes, plane = rig.uncertainty.axes, rig.imaging_plane
    x_mm, y_mm, z_mm = plane.origin_mm.tolist()
    at = {"distance_mm": -y_mm, "s_mm": -x_mm, "h_mm": z_mm}
    at |= dict(zip(("pitch_deg", "yaw_deg", "roll_deg"), plane.angles_deg, strict=True))
    values = np.zeros(len(INDEX))
    for part, names in ((rig.laser, _LASER), (rig.pattern, _PATTERN)):
        for name, k in names:
            values[k] = getattr(part, name)
    for name, k in _PLANE:
        values[k] = at[name]
    base = ImageCalibration(axes.calibration.matrix, axes.calibration.plain_lens)
    values[_POINTS] = base.to_image(_axis_points_mm(axes)).ravel()
    values[_DISTORTION] = axes.calibration.distortion_percent
    return values


def _axis_points_mm(axes: AxisPoints) -> FloatArray:
    return np.array([[0.0, 0.0], [axes.x_mm, 0.0], [0.0, axes.z_mm]])


def _with_ones(points: FloatArray) -> FloatArray:
    return np.column_stack([points, np.ones(len(points))])
