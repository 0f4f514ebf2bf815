"""A surface fitted to reflected lines, with its height, width and curvature and their ±."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from labapp.core.surface.spline import SplineSurface
from labapp.core.values import FloatArray, IntArray, ReadOnlyArrays


@dataclass(frozen=True)
class LineSurface(ReadOnlyArrays):
    """A surface fitted to the reflected lines, and its uncertainty.

    Parameters
    ----------
    surface
        The surface, z = 0 at the boundary.
    covariance
        Covariance of its coefficients, shape (p, p), mm². It includes the differences from the
        surfaces of other widths that agree as well with the lines, and the error of the width from
        the expected smoothness (`fit.WIDTH_ERROR`).
    numbers
        Number of each line in the pattern, from the lowest in the picture up, shape (k,).
    point_mm
        Points of the surface met by the rays of the points and ends that agree with it, shape
        (n, 3), mm.
    misfit
        χ² of points and ends over its degrees of freedom.
    margin
        Additional cost of the next best sign or height; infinite if there is none.
    status
        ``ok``, or ``profile`` if the lines do not fully determine the surface: its heights are then
        not a measurement, although slopes along the lines may be.
    width_sigma_mm
        Standard uncertainty of `width_mm`, mm.
    renumbered
        Differences of the coefficients with other numbers of the lines, which fit as well and give
        the same height, shape (q, p), mm; empty if the numbers are certain.
    renumbered_height_mm
        Root mean square of the differences of the height, mm.
    """

    surface: SplineSurface
    covariance: FloatArray
    numbers: IntArray
    point_mm: FloatArray
    misfit: float
    margin: float
    status: str
    width_sigma_mm: float = float("nan")
    renumbered: FloatArray = field(default_factory=lambda: np.zeros((0, 0)))
    renumbered_height_mm: float = 0.0

    @property
    def numbered(self) -> bool:
        """Whether the numbers are certain; if not, the surface may lie elsewhere along Y."""
        return not len(self.renumbered)

    @cached_property
    def peak_mm(self) -> FloatArray:
        """(x, y, z) of the highest point under the lines, or of the lowest of a hollow, mm."""
        low, high = self.point_mm[:, :2].min(axis=0), self.point_mm[:, :2].max(axis=0)
        x, y = (np.linspace(*ends, 81) for ends in zip(low, high, strict=True))
        x, y = (each.ravel() for each in np.meshgrid(x, y))
        z = self.surface.height(x, y)
        best = int(np.argmax(np.nan_to_num(np.abs(z))))
        return np.array([x[best], y[best], z[best]])

    @property
    def height_mm(self) -> float:
        """Height of the highest point, or negative depth of the lowest one, mm."""
        return float(self.peak_mm[2])

    @cached_property
    def height_sigma_mm(self) -> float:
        """Standard uncertainty of `height_mm`, mm."""
        row = self.surface.basis.matrix(*self.peak_mm[:2, None])[0]
        return float(np.hypot(np.sqrt(row @ self.covariance @ row), self.renumbered_height_mm))

    def sigma_mm(self, x_mm: FloatArray, y_mm: FloatArray) -> FloatArray:
        """Standard uncertainty of the height at points, each shape (n,), mm."""
        rows = self.surface.basis.matrix(x_mm, y_mm)
        return np.asarray(np.sqrt(np.maximum(np.vecdot(rows @ self._whole, rows), 0.0)))

    @cached_property
    def _whole(self) -> FloatArray:
        """Covariance of the coefficients with the differences of other numbers, (p, p), mm²."""
        if self.numbered:
            return self.covariance
        return self.covariance + self.renumbered.T @ self.renumbered / len(self.renumbered)

    @property
    def bulges(self) -> bool:
        """Whether height and curvature agree: convex above the work piece, concave below it."""
        return self.height_mm * self.curvature_per_mm > 0

    @property
    def width_mm(self) -> float:
        """Width of the pool along X, between the ends of the lines, mm."""
        return float(np.ptp(self.point_mm[:, 0]))

    @property
    def curvature_per_mm(self) -> float:
        """Mean curvature of the least-squares quadric of the surface, 1/mm; positive if convex."""
        return float(self._curvature @ self.surface.coefficients)

    @property
    def curvature_sigma_per_mm(self) -> float:
        """Standard uncertainty of `curvature_per_mm`, 1/mm."""
        return float(np.sqrt(self._curvature @ self._whole @ self._curvature))

    @cached_property
    def _curvature(self) -> FloatArray:
        """Derivatives of the mean curvature w.r.t. the coefficients, shape (p,), mm⁻²."""
        x, y = self.point_mm[:, :2].T
        known = np.isfinite(self.surface.height(x, y))  # a ray may leave the splines' domain
        x, y = x[known], y[known]
        quadric = np.linalg.pinv(quadric_terms(x - x.mean(), y - y.mean()))
        return np.asarray(-(quadric[3] + quadric[5]) @ self.surface.basis.matrix(x, y))


def quadric_terms(x: FloatArray, y: FloatArray) -> FloatArray:
    """Values of 1, x, y, x², xy, y² at points, each of x and y of shape (n,), shape (n, 6)."""
    return np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=-1)
