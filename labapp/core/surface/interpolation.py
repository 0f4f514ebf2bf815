"""Two smooth surfaces through scattered points: step 3 of IRS and of ERS (Eq. 6-2, 7-2)."""

from __future__ import annotations

from typing import Protocol

import numpy as np
import scipy

from labapp.core.surface.boundary import Boundary
from labapp.core.surface.surface import Surface
from labapp.core.values import CannotMeasure, FloatArray

DIFFERENCE_MM = 1e-4
"""Step of the finite differences."""

INNER_SHARE = 0.95
"""Reflection points farther out than this share of the distance from centre to boundary are
omitted.
"""


class SurfaceThroughPoints(Surface, Protocol):
    """A surface that interpolates points, with its gradient at these."""

    @property
    def point_gradient(self) -> FloatArray:
        """(∂z/∂x, ∂z/∂y) at the points it passes through, shape (n, 2)."""
        ...


class CloughTocherSurface:
    """Triangle-based cubic interpolation: once differentiable, NaN outside the convex hull.

    The method [61] of §6.3.1. The gradients at the points minimise curvature; those on the hull,
    determined from one side only, are the least certain (Fig. 6-15).

    Parameters
    ----------
    points_mm
        Points to pass through, shape (n, 3), mm.

    Raises
    ------
    CannotMeasure
        ``no-surface`` if the points do not span an area.
    """

    def __init__(self, points_mm: FloatArray) -> None:
        from scipy.interpolate import CloughTocher2DInterpolator

        self.points_mm = points_mm = np.asarray(points_mm, float)
        try:
            self._cubic = CloughTocher2DInterpolator(points_mm[:, :2], points_mm[:, 2])
        except (scipy.spatial.QhullError, ValueError) as error:
            raise CannotMeasure(
                "no-surface", "the reflection points do not span an area"
            ) from error

    @property
    def point_gradient(self) -> FloatArray:
        """(∂z/∂x, ∂z/∂y) at the points it passes through, shape (n, 2)."""
        return np.asarray(self._cubic.grad, np.float64)[:, 0, :]

    def height(self, x_mm: FloatArray, y_mm: FloatArray) -> FloatArray:
        """Height z at (x, y), arrays of one shape, mm; NaN outside the hull of the points."""
        return np.asarray(self._cubic(x_mm, y_mm), np.float64)

    def gradient(self, x_mm: FloatArray, y_mm: FloatArray) -> FloatArray:
        """(∂z/∂x, ∂z/∂y) at (x, y), shape (…, 2), by differences; one-sided at the hull."""
        x, y = np.asarray(x_mm, float), np.asarray(y_mm, float)
        here = self.height(x, y)
        sides = []
        for dx, dy in ((DIFFERENCE_MM, 0.0), (0.0, DIFFERENCE_MM)):
            ahead, behind = self.height(x + dx, y + dy), self.height(x - dx, y - dy)
            one_sided = np.where(np.isnan(ahead), here - behind, ahead - here)
            both = (ahead - behind) / 2
            sides.append(np.where(np.isnan(both), one_sided, both) / DIFFERENCE_MM)
        return np.stack(sides, axis=-1)


class ThinPlateSurface:
    """Thin-plate spline: passes through the points with the least bending, and extrapolates.

    The method [64] of §7.1. ``z = a₀ + a₁x + a₂y + Σ wᵢ·rᵢ²·ln rᵢ²``, with Σwᵢ = Σwᵢxᵢ = Σwᵢyᵢ = 0;
    far from the points it becomes linear.

    Parameters
    ----------
    points_mm
        Points to pass through, shape (n, 3), mm.

    Raises
    ------
    CannotMeasure
        ``no-surface`` if the points do not span an area.
    """

    def __init__(self, points_mm: FloatArray) -> None:
        self.points_mm = points_mm = np.asarray(points_mm, float)
        self._center = points_mm[:, :2].mean(axis=0)
        self._nodes = points_mm[:, :2] - self._center
        if np.linalg.matrix_rank(self._nodes) < 2:
            raise CannotMeasure("no-surface", "the reflection points do not span an area")
        count = len(points_mm)
        offset, square, log = self._kernel(self._nodes)
        plane = np.column_stack([np.ones(count), self._nodes])
        system = np.zeros((count + 3, count + 3))
        system[:count, :count] = square * log
        system[:count, count:] = plane
        system[count:, :count] = plane.T
        solution = np.linalg.solve(system, np.append(points_mm[:, 2], np.zeros(3)))
        self._weight, self._plane = solution[:count], solution[count:]
        self._point_gradient = self._slope(offset, log)

    @property
    def point_gradient(self) -> FloatArray:
        """(∂z/∂x, ∂z/∂y) at the points it passes through, shape (n, 2)."""
        return self._point_gradient

    def height(self, x_mm: FloatArray, y_mm: FloatArray) -> FloatArray:
        """Height z at (x, y), arrays of one shape, mm."""
        at = np.stack([np.asarray(x_mm, float), np.asarray(y_mm, float)], axis=-1) - self._center
        _, square, log = self._kernel(at)
        return np.asarray((square * log) @ self._weight + self._plane[0] + at @ self._plane[1:])

    def gradient(self, x_mm: FloatArray, y_mm: FloatArray) -> FloatArray:
        """(∂z/∂x, ∂z/∂y) at (x, y), shape (…, 2)."""
        at = np.stack([np.asarray(x_mm, float), np.asarray(y_mm, float)], axis=-1) - self._center
        offset, _, log = self._kernel(at)
        return self._slope(offset, log)

    def _kernel(self, at: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Offsets from the nodes, shape (2, …, n), r² and ln r², shape (…, n)."""
        offset = np.stack([at[..., axis, None] - self._nodes[:, axis] for axis in range(2)])
        square = offset[0] ** 2 + offset[1] ** 2
        return offset, square, np.log(np.maximum(square, np.finfo(float).tiny))

    def _slope(self, offset: FloatArray, log: FloatArray) -> FloatArray:
        """Gradient of the sum: each term gives 2·(offset)·(ln r² + 1)."""
        bend = 2 * (log + 1) * self._weight
        return np.stack(
            [np.sum(offset[axis] * bend, axis=-1) + self._plane[1 + axis] for axis in range(2)],
            axis=-1,
        )


def whole_surface(points_mm: FloatArray, boundary: Boundary) -> CloughTocherSurface:
    """Interpolate through reflection points and boundary together (§6.4, step 5 of §7.1).

    The boundary model is independent of the surface, and a reflection point high above the work
    piece lies nearer to the laser than the landing point of its ray. A point close to the boundary
    or beyond it is omitted: two different heights at nearly the same place would form a cliff.

    Parameters
    ----------
    points_mm
        Reflection points, shape (n, 3), mm.
    boundary
        The boundary, its heights included.

    Raises
    ------
    CannotMeasure
        ``no-surface`` if no reflection point lies within the boundary.
    """
    x, y = (boundary.center_mm + (points_mm[:, :2] - boundary.center_mm) / INNER_SHARE).T
    inside = boundary.contains(x, y)
    if not inside.any():
        raise CannotMeasure("no-surface", "no reflection point lies within the boundary")
    return CloughTocherSurface(np.vstack([points_mm[inside], boundary.points_mm]))
