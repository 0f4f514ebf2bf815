"""A flat folding mirror between pool and imaging plane (§9.2), replaced by the plane's image.

Rays reflected by a flat mirror onto a plane are equivalent to rays that reach the plane's mirror
image behind it: the rig has that image as its imaging plane, and no mirror. The camera may see
either side of the paper: the image calibration determines which.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from labapp.core.geometry.rig import ImagingPlane
from labapp.core.values import FloatArray, ReadOnlyArrays

STEP = 1e-4
"""Step of finite differences, mm and degrees."""


@dataclass(frozen=True)
class FoldingMirror(ReadOnlyArrays):
    """A flat mirror.

    Parameters
    ----------
    point_mm
        A point of its surface, UCS, shape (3,), mm.
    normal
        Normal of its surface, of any length and either sign, shape (3,).
    """

    point_mm: FloatArray
    normal: FloatArray

    @property
    def unit_normal(self) -> FloatArray:
        """Normal of length 1, shape (3,)."""
        largest_1 = self.normal / np.abs(self.normal).max()  # tiny or huge squares are 0 or inf
        return np.asarray(largest_1 / np.linalg.norm(largest_1))

    def image_of(self, plane: ImagingPlane) -> ImagingPlane:
        """Mirror image of a plane, as it appears from the pool."""
        unit = self.unit_normal
        turn = np.eye(3) - 2.0 * np.outer(unit, unit)
        origin = self.point_mm + turn @ (plane.origin_mm - self.point_mm)
        return replace(
            plane, origin_mm=origin, x_axis=turn @ plane.x_axis, z_axis=turn @ plane.z_axis
        )

    def moved(self, offset_mm: float, tilt_deg: tuple[float, float]) -> FoldingMirror:
        """Return the mirror shifted along its normal and tilted about two axes in its surface."""
        unit = self.unit_normal
        first = np.cross(unit, np.eye(3)[np.argmin(np.abs(unit))])
        first /= np.linalg.norm(first)
        tilt = np.tan(np.radians(tilt_deg))
        normal = unit + tilt[0] * first + tilt[1] * np.cross(unit, first)
        return FoldingMirror(self.point_mm + offset_mm * unit, normal)


def image_sigma(
    plane: ImagingPlane, mirror: FoldingMirror, sigma: FloatArray, mirror_sigma: FloatArray
) -> FloatArray:
    """Standard uncertainty of the pose of a plane's mirror image, shape (6,), to first order.

    A tilt of the mirror rotates the image by twice that angle. Correlations are neglected.

    Parameters
    ----------
    sigma
        Standard uncertainty of the plane's pose (`ImagingPlane.pose`), shape (6,).
    mirror_sigma
        Standard uncertainty of the mirror's position along its normal, mm, and of its tilt about
        both axes, degrees, shape (3,).
    """
    image = mirror.image_of(plane).pose
    columns = []
    for k, one in enumerate(sigma):
        off = plane.with_pose(plane.pose + STEP * np.eye(6)[k])
        columns.append(one * _change(mirror.image_of(off).pose, image))
    for k, one in enumerate(mirror_sigma):
        offset, *tilt = (STEP * np.eye(3)[k]).tolist()
        moved = mirror.moved(offset, (tilt[0], tilt[1]))
        columns.append(one * _change(moved.image_of(plane).pose, image))
    return np.asarray(np.linalg.norm(columns, axis=0))


def _change(after: FloatArray, before: FloatArray) -> FloatArray:
    """Change of a pose per unit step; angles are wrapped at 180°."""
    change = after - before
    change[3:] = (change[3:] + 180.0) % 360.0 - 180.0
    return change / STEP
