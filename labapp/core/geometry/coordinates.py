"""Transformation between image and imaging plane (Eq. 4-6 … 4-13).

`rig.ImagingPlane` transforms between imaging plane and universal coordinates.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from labapp.core.values import FloatArray, ReadOnlyArrays

RADIAL_STEPS = 6
"""Newton steps for the inverse of a radial distortion."""

UNDISTORTED_PX = 1e-6
"""Tolerance of undistortion, px."""


@dataclass(frozen=True)
class Lens:
    """Lens distortion: OpenCV's model with five coefficients.

    Parameters
    ----------
    focal_px
        Focal length along u and v, px.
    center_px
        (u, v) of the principal point, px.
    distortion
        k₁, k₂, p₁, p₂, k₃.
    """

    focal_px: tuple[float, float]
    center_px: tuple[float, float]
    distortion: tuple[float, float, float, float, float]

    def distorted(self, ideal_px: FloatArray) -> FloatArray:
        """Distort ideal (pinhole) image points (u, v), shape (…, 2), px."""
        x, y = np.moveaxis((np.asarray(ideal_px, float) - self.center_px) / self.focal_px, -1, 0)
        k1, k2, p1, p2, k3 = self.distortion
        square = x * x + y * y
        radial = 1.0 + square * (k1 + square * (k2 + square * k3))
        bent = np.stack(
            [
                x * radial + 2.0 * p1 * x * y + p2 * (square + 2.0 * x * x),
                y * radial + p1 * (square + 2.0 * y * y) + 2.0 * p2 * x * y,
            ],
            axis=-1,
        )
        return np.asarray(bent * self.focal_px + self.center_px)

    def ideal(self, image_px: FloatArray) -> FloatArray:
        """Undistort image points (u, v) to those of a pinhole camera, shape (…, 2), px."""
        import cv2

        image_px = np.asarray(image_px, float)
        if not image_px.size:
            return image_px
        (fu, fv), (u, v) = self.focal_px, self.center_px
        camera = np.array([[fu, 0.0, u], [0.0, fv, v], [0.0, 0.0, 1.0]])
        until = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, UNDISTORTED_PX)
        flat = image_px.reshape(-1, 1, 2)
        bent = np.array(self.distortion)
        found = cv2.undistortPoints(flat, camera, bent, None, np.eye(3), camera, until)
        return np.asarray(found, np.float64).reshape(image_px.shape)


@dataclass(frozen=True)
class RadialDistortion(ReadOnlyArrays):
    """Radial distortion defined on the imaging plane.

    A point p of the calibration without it is at ``p + percent/100·(|p − m|/c)²·(p − m)``, where m
    is the centre of the plane and c half its diagonal.

    Parameters
    ----------
    matrix, lens
        Those of the image calibration without it (`ImageCalibration`).
    half_mm
        Half the plane's width and height: its centre, shape (2,), mm.
    percent
        Shift of a dot in the plane's corner, in percent of its distance from the centre.
    """

    matrix: FloatArray
    lens: Lens | None
    half_mm: FloatArray
    percent: float

    def ideal(self, image_px: FloatArray) -> FloatArray:
        """Undistort image points (u, v), shape (…, 2), px."""
        return _apply(_inverse(self.matrix), self.to_plane(image_px))

    def to_plane(self, image_px: FloatArray) -> FloatArray:
        """Transform image points (u, v), shape (…, 2), px, to undistorted IPCS (X′, Z′), mm."""
        image_px = image_px if self.lens is None else self.lens.ideal(image_px)
        out = _apply(self.matrix, image_px) - self.half_mm
        strength = self.percent / 100 / np.sum(self.half_mm**2)
        share = strength * (out[..., 0] ** 2 + out[..., 1] ** 2)
        return np.asarray(self.half_mm + (1 + share[..., None]) * out)

    def distorted(self, ideal_px: FloatArray) -> FloatArray:
        """Inverse of `ideal`."""
        far = _apply(self.matrix, np.asarray(ideal_px, float)) - self.half_mm
        strength = self.percent / 100 / np.sum(self.half_mm**2)
        length = np.linalg.norm(far, axis=-1, keepdims=True)
        near = length.copy()
        for _ in range(RADIAL_STEPS):
            near -= (near + strength * near**3 - length) / (1 + 3 * strength * near**2)
        out = far * np.where(length > 0, near / np.where(length > 0, length, 1.0), 1.0)
        seen = _apply(_inverse(self.matrix), self.half_mm + out)
        return seen if self.lens is None else self.lens.distorted(seen)


@dataclass(frozen=True)
class ImageCalibration(ReadOnlyArrays):
    """Pixel ↔ imaging plane as a homography; the three-point calibration is its affine case.

    Parameters
    ----------
    matrix
        Shape (3, 3): undistorted homogeneous (u, v, 1) in px to (X′, Z′, 1) in mm.
    lens
        Distortion of the lens; None if there is none.

    Raises
    ------
    ValueError
        If the matrix is not finite, not of this shape, or singular.
    """

    matrix: FloatArray
    lens: Lens | RadialDistortion | None = None

    def __post_init__(self) -> None:
        matrix = np.array(self.matrix, float)
        if matrix.shape != (3, 3) or not np.isfinite(matrix).all():
            raise ValueError("an image calibration is a 3 × 3 matrix of finite numbers")
        stretches = np.linalg.svd(matrix, compute_uv=False)
        if not stretches[0] <= 1e12 * stretches[-1]:
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
        lens: Lens | None = None,
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
        lens
            Distortion of the picture in which the points were located.

        Raises
        ------
        ValueError
            If the three points are collinear.
        """
        seen = np.array([origin_px, x_axis_px, z_axis_px], float)
        origin, on_x, on_z = seen if lens is None else lens.ideal(seen)
        to_image = np.eye(3)
        to_image[:2, 0] = (on_x - origin) / x_axis_mm
        to_image[:2, 1] = (on_z - origin) / z_axis_mm
        to_image[:2, 2] = origin
        if abs(np.linalg.det(to_image)) < 1e-9:
            raise ValueError("O′ and the points on O′X′ and O′Z′ lie on one line")
        return cls(_inverse(to_image), lens)

    def with_distortion(self, percent: float, half_mm: FloatArray) -> ImageCalibration:
        """Return a calibration with another radial distortion (`RadialDistortion`)."""
        return ImageCalibration.distorted(self.matrix, self.plain_lens, percent, half_mm)

    @classmethod
    def distorted(
        cls, matrix: FloatArray, lens: Lens | None, percent: float, half_mm: FloatArray
    ) -> ImageCalibration:
        """Build from a homography, a lens and a radial distortion (`RadialDistortion`)."""
        return cls(matrix, RadialDistortion(matrix, lens, half_mm, percent) if percent else lens)

    @cached_property
    def undistorted(self) -> ImageCalibration:
        """The calibration without a `RadialDistortion`."""
        return ImageCalibration(self.matrix, self.plain_lens)

    @property
    def plain_lens(self) -> Lens | None:
        """The lens without a `RadialDistortion`."""
        return self.lens.lens if isinstance(self.lens, RadialDistortion) else self.lens

    @property
    def distortion_percent(self) -> float:
        """Radial distortion at the plane's corner, percent (`RadialDistortion`)."""
        return self.lens.percent if isinstance(self.lens, RadialDistortion) else 0.0

    def ideal_px(self, image_px: FloatArray) -> FloatArray:
        """Undistort image points (u, v), shape (…, 2), px."""
        return image_px if self.lens is None else self.lens.ideal(image_px)

    def to_plane(self, image_px: FloatArray) -> FloatArray:
        """Transform (u, v), shape (…, 2), px, to IPCS (X′, Z′), shape (…, 2), mm."""
        if isinstance(self.lens, RadialDistortion):
            return self.lens.to_plane(image_px)
        return _apply(self.matrix, self.ideal_px(image_px))

    def to_image(self, plane_mm: FloatArray) -> FloatArray:
        """Transform IPCS (X′, Z′), shape (…, 2), mm, to (u, v), shape (…, 2), px."""
        ideal = _apply(self.from_plane, plane_mm)
        return ideal if self.lens is None else self.lens.distorted(ideal)

    @cached_property
    def from_plane(self) -> FloatArray:
        """Homography from the plane to the undistorted image, shape (3, 3)."""
        return _inverse(self.matrix)

    def jacobian(self, image_px: FloatArray) -> FloatArray:
        """∂(X′, Z′)/∂(u, v) at (u, v), shape (…, 2, 2), mm/px, neglecting the distortion."""
        image_px = np.asarray(image_px, float)
        plane = self.to_plane(image_px)
        image_px = self.ideal_px(image_px)
        w = image_px @ self.matrix[2, :2] + self.matrix[2, 2]
        return np.asarray(
            (self.matrix[:2, :2] - plane[..., :, None] * self.matrix[2, :2]) / w[..., None, None]
        )


def _inverse(matrix: FloatArray) -> FloatArray:
    return np.asarray(np.linalg.inv(matrix), np.float64)


def _apply(matrix: FloatArray, points: FloatArray) -> FloatArray:
    # Coordinate by coordinate: NumPy is slow along an axis of length 2.
    points = np.asarray(points, float)
    first, second, made = points[..., 0], points[..., 1], np.empty(points.shape)
    (a, b, c), (d, e, f), (g, h, k) = matrix.tolist()
    scale = g * first + h * second + k
    made[..., 0] = (a * first + b * second + c) / scale
    made[..., 1] = (d * first + e * second + f) / scale
    return made


def with_ones(points: FloatArray) -> FloatArray:
    """Homogeneous coordinates of points, shape (n, 2): another column of ones."""
    return np.column_stack([points, np.ones(len(points))])
