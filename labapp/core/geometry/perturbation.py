"""Perturbed benches: quantities (`uncertainty.QUANTITIES`) that differ from their nominal values.

An offset is a vector over the quantities, in their units: the true value is the nominal one plus
the offset. The correspondence of rays and dots does not change.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from labapp.core.geometry.coordinates import ImageCalibration, with_ones
from labapp.core.geometry.rig import POSE, ImagingPlane, Laser, Rig
from labapp.core.geometry.uncertainty import INDEX, POINTS, QUANTITIES, AxisPoints
from labapp.core.values import FloatArray, ReadOnlyArrays

_LASER, _PATTERN, _PLANE = (
    [(key.partition(".")[2], k) for key, k in INDEX.items() if key.startswith(f"{section}.")]
    for section in ("laser", "pattern", "imaging_plane")
)
_AXES = [INDEX[f"image_calibration.{axis}_axis_mm"] for axis in "xz"]
_DISTORTION = INDEX["camera_lens.distortion_percent"]
_PICTURE = [*POINTS, *_AXES, _DISTORTION]

OF_PICTURE = np.isin(np.arange(len(INDEX)), _PICTURE)
"""Mask of the quantities of the picture, which move captured dots (`moved_dots`); the others, of
the rig, move computed dots."""

OF_PLANE = np.isin(np.arange(len(INDEX)), [k for _, k in _PLANE])
"""Mask of the quantities of the imaging plane, which do not change the reflected rays."""


@dataclass(frozen=True)
class Direction(ReadOnlyArrays):
    """A possible error of a bench.

    Parameters
    ----------
    key
        Key of the quantity (`Quantity.key`), or ``picture.u``, ``picture.v``, ``picture.scale`` for
        the image calibration as a whole.
    vector
        Offset of the quantities per unit, shape (q,).
    """

    key: str
    name: str
    unit: str
    vector: FloatArray


def directions(rig: Rig) -> tuple[Direction, ...]:
    """Possible errors of a bench: of each quantity, and of the picture as a whole."""
    single = [
        Direction(one.key, one.name, one.unit, np.eye(len(QUANTITIES))[k])
        for k, one in enumerate(QUANTITIES)
    ]
    points = quantity_values(rig)[POINTS].reshape(3, 2)
    whole = []
    for key, name, unit, shift in (
        ("picture.u", "picture, shifted along u", "px", np.array([1.0, 0.0])),
        ("picture.v", "picture, shifted along v", "px", np.array([0.0, 1.0])),
        ("picture.scale", "image calibration, scale", "%", (points - points[0]) / 100.0),
    ):
        vector = np.zeros(len(QUANTITIES))
        vector[POINTS] = np.broadcast_to(shift, (3, 2)).ravel()
        whole.append(Direction(key, name, unit, vector))
    return *single, *whole


def moved_rig(rig: Rig, offset: FloatArray) -> Rig:
    """Rig with an offset added to its quantities, shape (q,)."""
    if not offset[~OF_PICTURE].any():
        return rig
    laser, pattern = rig.laser, rig.pattern
    if any(offset[k] for _, k in _LASER):
        laser = replace(laser, **{name: getattr(laser, name) + offset[k] for name, k in _LASER})
    if any(offset[k] for _, k in _PATTERN):
        moved = {name: getattr(pattern, name) + offset[k] for name, k in _PATTERN}
        pattern = replace(pattern, **moved)
    plane = moved_plane(rig.imaging_plane, offset)
    return replace(rig, laser=laser, pattern=pattern, imaging_plane=plane)


def moved_plane(plane: ImagingPlane, offset: FloatArray) -> ImagingPlane:
    """Imaging plane with an offset added to its quantities, shape (q,)."""
    by = {name: offset[k] for name, k in _PLANE}
    if not any(by.values()):
        return plane
    moved = plane.with_pose(plane.pose + [by[name] for name in POSE])
    glass = plane.glass_mm + by["glass_mm"], plane.glass_index + by["glass_index"]
    return replace(moved, glass_mm=glass[0], glass_index=glass[1])


def aimed_as(laser: Laser, rig: Rig) -> Rig:
    """Translate a rig along the work piece so that its laser aims where another does.

    The pool's dimensions do not change, and the surface stays within the domain of its spline.
    """
    aside = np.array([rig.laser.aim_x_mm - laser.aim_x_mm, rig.laser.aim_y_mm - laser.aim_y_mm, 0])
    if not aside.any():
        return rig
    back = replace(rig.laser, aim_x_mm=laser.aim_x_mm, aim_y_mm=laser.aim_y_mm)
    plane = replace(rig.imaging_plane, origin_mm=rig.imaging_plane.origin_mm - aside)
    return replace(rig, laser=back, imaging_plane=plane)


def moved_dots(plane_mm: FloatArray, rig: Rig, axes: AxisPoints, offset: FloatArray) -> FloatArray:
    """Dots on the plane, shape (n, 2), mm, for an offset of the picture's quantities, (q,).

    The dots do not move in the picture, but `moved_calibration` maps them to other points of the
    plane. The calibrated camera lens is part of both mappings and cancels.
    """
    if not offset[_PICTURE].any():
        return plane_mm
    return dots_on_moved_plane(dots_in_picture(plane_mm, rig, axes), rig, axes, offset)


def dots_in_picture(plane_mm: FloatArray, rig: Rig, axes: AxisPoints) -> FloatArray:
    """Dots on the plane, (n, 2), mm, in the picture of a camera without a lens of its own, px."""
    return _lensless(axes.calibration, rig.imaging_plane).to_image(plane_mm)


def dots_on_moved_plane(
    image_px: FloatArray, rig: Rig, axes: AxisPoints, offset: FloatArray
) -> FloatArray:
    """Points `dots_in_picture`, (n, 2), px, on the plane for an offset, mm, see `moved_dots`."""
    plane = rig.imaging_plane
    return _lensless(moved_calibration(axes, plane, offset), plane).to_plane(image_px)


def _lensless(calibration: ImageCalibration, plane: ImagingPlane) -> ImageCalibration:
    """Calibration with its distortion on the plane, but without the camera's lens."""
    if calibration.plain_lens is None:
        return calibration
    percent = calibration.distortion_percent
    return ImageCalibration.distorted(calibration.matrix, None, percent, _half_mm(plane))


def moved_calibration(
    axes: AxisPoints, plane: ImagingPlane, offset: FloatArray
) -> ImageCalibration:
    """Image calibration with an offset of its points and its distortion on the plane, (q,).

    The moved points take the plane positions of the original ones, whose positions along the axes
    may also have an offset. The camera lens and its centre do not change.
    """
    calibration = axes.calibration
    base = calibration.undistorted
    percent = calibration.distortion_percent + float(offset[_DISTORTION])
    points_px = base.to_image(_axis_points_mm(axes))
    true = with_ones(base.ideal_px(points_px))
    moved = base.ideal_px(points_px + offset[POINTS].reshape(3, 2))
    back = np.linalg.solve(with_ones(moved), true).T
    stretch = np.diag([*(1.0 + offset[_AXES] / [axes.x_mm, axes.z_mm]), 1.0])
    return ImageCalibration.distorted(
        np.asarray(stretch @ base.matrix @ back),
        calibration.plain_lens,
        percent,
        _half_mm(plane),
    )


def moved_bench(rig: Rig, offset: FloatArray) -> tuple[Rig, ImageCalibration]:
    """Rig and image calibration with an offset added to the quantities, shape (q,).

    The rig's uncertainty has the new calibration and the original covariance.
    """
    assert rig.uncertainty is not None
    axes = rig.uncertainty.axes
    calibration = moved_calibration(axes, rig.imaging_plane, offset)
    x_mm, z_mm = np.add([axes.x_mm, axes.z_mm], offset[_AXES]).tolist()
    uncertainty = replace(rig.uncertainty, axes=AxisPoints(calibration, x_mm, z_mm))
    return replace(moved_rig(rig, offset), uncertainty=uncertainty), calibration


def quantity_values(rig: Rig) -> FloatArray:
    """Values of `QUANTITIES` of a rig with uncertainty, shape (q,), in their units."""
    assert rig.uncertainty is not None
    axes, plane = rig.uncertainty.axes, rig.imaging_plane
    at = dict(zip(POSE, plane.pose.tolist(), strict=True))
    at |= {"glass_mm": plane.glass_mm, "glass_index": plane.glass_index}
    values = np.zeros(len(INDEX))
    for part, names in ((rig.laser, _LASER), (rig.pattern, _PATTERN)):
        for name, k in names:
            values[k] = getattr(part, name)
    for name, k in _PLANE:
        values[k] = at[name]
    values[POINTS] = axes.calibration.undistorted.to_image(_axis_points_mm(axes)).ravel()
    values[_AXES] = axes.x_mm, axes.z_mm
    values[_DISTORTION] = axes.calibration.distortion_percent
    return values


def _axis_points_mm(axes: AxisPoints) -> FloatArray:
    return np.array([[0.0, 0.0], [axes.x_mm, 0.0], [0.0, axes.z_mm]])


def _half_mm(plane: ImagingPlane) -> FloatArray:
    return np.array([plane.width_mm, plane.height_mm]) / 2
