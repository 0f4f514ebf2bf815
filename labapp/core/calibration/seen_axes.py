"""Scales and angle, with their ±, from O′ and a point on each axis in a calibration picture."""

from __future__ import annotations

from abc import abstractmethod

import numpy as np

from labapp.core.geometry.uncertainty import point_sigma_px
from labapp.core.values import FloatArray

POINTS = ("origin_px", "x_axis_px", "z_axis_px")
"""Keys of the points in a setup file."""


class SeenAxes:
    """Quantities derived from three points in a picture and their covariance."""

    x_axis_mm: float
    z_axis_mm: float

    @property
    @abstractmethod
    def points_px(self) -> FloatArray:
        """(u, v) of O′ and of the points on O′X′ and O′Z′, shape (3, 2)."""

    @property
    @abstractmethod
    def points_covariance_px2(self) -> FloatArray:
        """Covariance of these points, shape (6, 6), px²."""

    @property
    def points_sigma_px(self) -> tuple[float, float, float]:
        """Standard uncertainty of each of these points along either direction, px."""
        origin, on_x, on_z = point_sigma_px(self.points_covariance_px2).tolist()
        return origin, on_x, on_z

    @property
    def affine_covariance_px2(self) -> FloatArray:
        """Covariance of these points under an affine change of the picture, shape (6, 6), px².

        A set-up perturbs its image calibration through these three points alone. For a map with
        more than six parameters, this is the least-squares affine approximation over the region of
        the dots.
        """
        return self.points_covariance_px2

    def _affine_covariance_px2(
        self, plane_mm: FloatArray, covariance_px2: FloatArray
    ) -> FloatArray:
        """The same, from the covariance of the image positions of (X′, Z′), shape (n, 2), mm."""
        x, z = (plane_mm / [self.x_axis_mm, self.z_axis_mm]).T
        shares = np.stack([1.0 - x - z, x, z], axis=-1)  # barycentric coordinates
        nearest = np.kron(np.linalg.pinv(shares), np.eye(2))
        return np.asarray(nearest @ covariance_px2 @ nearest.T)

    @property
    def setup_uncertainty(self) -> dict[str, object]:
        """Keys of ``[image_calibration]``: ± of each point, and their joint covariance."""
        covariance = self.affine_covariance_px2
        keys = {
            f"{name}_sigma": sigma
            for name, sigma in zip(POINTS, point_sigma_px(covariance).tolist(), strict=True)
        }
        return {**keys, "points_covariance_px2": covariance.tolist()}

    @property
    def px_per_mm(self) -> tuple[float, float]:
        """Scale from O′ to the point on O′X′ and to that on O′Z′ (Eq. 4-6), px/mm."""
        along_x, along_z, _ = self._scales_and_angle(self.points_px)
        return float(along_x), float(along_z)

    @property
    def angle_deg(self) -> float:
        """Angle from O′X′ to O′Z′ in the picture, anticlockwise, degrees."""
        return float(self._scales_and_angle(self.points_px)[2])

    @property
    def scales_and_angle_sigma(self) -> FloatArray:
        """± of both scales, px/mm, and of the angle, degrees, shape (3,)."""
        points, step = self.points_px, 1e-3
        base = self._scales_and_angle(points)
        change = [
            (self._scales_and_angle(points + step * one.reshape(3, 2)) - base) / step
            for one in np.eye(6)
        ]
        squares = np.einsum("pk,pq,qk->k", change, self.points_covariance_px2, change)
        return np.asarray(np.sqrt(squares))

    @property
    def _points_mm(self) -> FloatArray:
        return np.array([[0.0, 0.0], [self.x_axis_mm, 0.0], [0.0, self.z_axis_mm]])

    def _scales_and_angle(self, points_px: FloatArray) -> FloatArray:
        return scales_and_angle(points_px, self.x_axis_mm, self.z_axis_mm)


def scales_and_angle(points_px: FloatArray, x_mm: float, z_mm: float) -> FloatArray:
    """Scales along O′X′ and O′Z′, px/mm, and the angle between them, degrees, shape (3,).

    Parameters
    ----------
    points_px, x_mm, z_mm
        (u, v) of O′ and of a point on each axis, shape (3, 2), and their X′ and Z′.
    """
    x_arm, z_arm = points_px[1:] - points_px[0]
    turn = np.arctan2(-z_arm[1], z_arm[0]) - np.arctan2(-x_arm[1], x_arm[0])
    return np.array([np.hypot(*x_arm) / x_mm, np.hypot(*z_arm) / z_mm, np.degrees(turn) % 360.0])
