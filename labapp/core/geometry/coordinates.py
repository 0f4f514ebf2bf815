"""Image ↔ imaging plane (Eq. 4-6 … 4-13); imaging plane ↔ universal is `rig.ImagingPlane`."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from labapp.core.values import FloatArray, ReadOnlyArrays


@dataclass(frozen=True)
class ImageCalibration(ReadOnlyArrays):
    """Pixel ↔ imaging plane as a homography; the three-point calibration is its affine case.

    Parameters
    ----------
    matrix
        Shape (3, 3): homogeneous (u, v, 1) in px to (X′, Z′, 1) in mm.

    Raises
    ------
    ValueError
        If the matrix cannot be inverted.
    """

    matrix: FloatArray

    def __post_init__(self) -> None:
        matrix = np.array(self.matrix, float)
        if matrix.shape != (3, 3) or not np.isfinite(matrix).all():
            raise ValueError("an image calibration is a 3 × 3 matrix of finite numbers")
        if np.linalg.cond(matrix) > 1e12:
            raise ValueError("the image calibration cannot be inverted: its axes coincide")
        object.__setattr__(self, "matrix", matrix)
        super().__post_init__()

    @classmethod
    def from_three_points(
        cls,
        origin_px: tuple[float, float],
        x_axis_px: tuple[float, float],
        x_axis_mm: float,
        z_axis_px: tuple[float, float],
        z_axis_mm: float,
    ) -> ImageCalibration:
        """Build from O′ and one point on each axis (§5.1.2, Eq. 4-6 … 4-13).

        Drawing parallels to the axes through P and dividing by the unit lengths, as
        Eq. 4-7 … 4-13 do, is the inverse of (u, v) = O′ + X′·e_x + Z′·e_z.

        Parameters
        ----------
        origin_px, x_axis_px, z_axis_px
            (u, v) of O′, of a point on O′X′ and of a point on O′Z′, px.
        x_axis_mm, z_axis_mm
            X′ of the former, Z′ of the latter, mm.

        Raises
        ------
        ValueError
            If the three points lie on one line.
        """
        origin = np.asarray(origin_px, float)
        to_image = np.eye(3)
        to_image[:2, 0] = (np.asarray(x_axis_px, float) - origin) / x_axis_mm
        to_image[:2, 1] = (np.asarray(z_axis_px, float) - origin) / z_axis_mm
        to_image[:2, 2] = origin
        if abs(np.linalg.det(to_image)) < 1e-9:
            raise ValueError("O′ and the points on O′X′ and O′Z′ lie on one line")
        return cls(_inverse(to_image))

    def to_plane(self, image_px: FloatArray) -> FloatArray:
        """(u, v), shape (…, 2), px, to IPCS (X′, Z′), shape (…, 2), mm."""
        return _apply(self.matrix, image_px)

    def to_image(self, plane_mm: FloatArray) -> FloatArray:
        """IPCS (X′, Z′), shape (…, 2), mm, to (u, v), shape (…, 2), px."""
        return _apply(self.from_plane, plane_mm)

    @cached_property
    def from_plane(self) -> FloatArray:
        """Homography from the plane to the image, shape (3, 3)."""
        return _inverse(self.matrix)

    def jacobian(self, image_px: FloatArray) -> FloatArray:
        """∂(X′, Z′)/∂(u, v) at (u, v), shape (…, 2, 2), mm/px."""
        image_px = np.asarray(image_px, float)
        plane = self.to_plane(image_px)
        w = image_px @ self.matrix[2, :2] + self.matrix[2, 2]
        return np.asarray(
            (self.matrix[:2, :2] - plane[..., :, None] * self.matrix[2, :2]) / w[..., None, None]
        )


def _inverse(matrix: FloatArray) -> FloatArray:
    return np.asarray(np.linalg.inv(matrix), np.float64)


def _apply(matrix: FloatArray, points: FloatArray) -> FloatArray:
    points = np.asarray(points, float)
    projected = points @ matrix[:, :2].T + matrix[:, 2]
    return np.asarray(projected[..., :2] / projected[..., 2:])
