"""Pool surface z = f(x, y), and its intersection with rays (Eq. 4-1, 6-2)."""

from __future__ import annotations

from typing import Protocol

import numpy as np

from labapp.core.values import FloatArray

TOLERANCE_MM = 1e-9
"""Tolerance of the height of an intersection."""

STEP_MM = 0.5
"""Longest Newton step along a ray: a grazing ray would otherwise jump off the pool."""

REACH_MM = 2.0
"""Intersections are searched for at |z| up to this."""

NEWTON_STEPS = 12
SCAN_LEVELS = 81
HALVINGS = 50


class Surface(Protocol):
    """Height above the work piece; NaN where it is undefined."""

    def height(self, x_mm: FloatArray, y_mm: FloatArray) -> FloatArray:
        """Height z at (x, y), arrays of one shape, mm."""
        ...

    def gradient(self, x_mm: FloatArray, y_mm: FloatArray) -> FloatArray:
        """(∂z/∂x, ∂z/∂y) at (x, y), shape (…, 2)."""
        ...


class FlatSurface:
    """Horizontal plane z = level: a kind of surface that session files may contain."""

    def __init__(self, level_mm: float = 0.0) -> None:
        self.level_mm = level_mm

    def height(self, x_mm: FloatArray, y_mm: FloatArray) -> FloatArray:
        """Height z at (x, y), arrays of one shape, mm."""
        return np.full(np.shape(x_mm), self.level_mm)

    def gradient(self, x_mm: FloatArray, y_mm: FloatArray) -> FloatArray:
        """(∂z/∂x, ∂z/∂y) at (x, y), shape (…, 2)."""
        return np.zeros((*np.shape(x_mm), 2))


def intersect(
    surface: Surface,
    origin_mm: FloatArray,
    directions: FloatArray,
) -> FloatArray:
    """Intersect rays from one point with a surface.

    Bounded Newton steps from z = 0. Rays for which these do not converge (grazing, or starting
    outside the domain of the surface) are sampled from z = `REACH_MM` down to −`REACH_MM`, and the
    first interval in which the ray passes below the surface is bisected.

    Parameters
    ----------
    origin_mm
        Common origin of the rays, above the surface, shape (3,), mm.
    directions
        Their directions, of any length but not zero, shape (n, 3).

    Returns
    -------
    FloatArray
        Intersections, shape (n, 3), mm; NaN if the ray does not descend or misses the domain of
        the surface.
    """
    origin = np.asarray(origin_mm, float)
    direction = np.asarray(directions, float)
    direction = direction / np.linalg.norm(direction, axis=-1, keepdims=True)
    distance = np.full(len(direction), np.nan)
    falls = np.flatnonzero(direction[:, 2] < 0)
    distance[falls] = _newton(surface, origin, direction[falls])
    missed = falls[np.isnan(distance[falls])]
    if len(missed):
        distance[missed] = _walk(surface, origin, direction[missed])
    return np.asarray(origin + distance[:, None] * direction)


def _newton(surface: Surface, origin: FloatArray, direction: FloatArray) -> FloatArray:
    """Distance to the surface along each ray, shape (n,); NaN if the steps do not converge."""
    distance = -origin[2] / direction[:, 2]
    above = np.full(len(direction), np.nan)
    for _ in range(NEWTON_STEPS):
        point = origin + distance[:, None] * direction
        above = point[:, 2] - surface.height(point[:, 0], point[:, 1])
        open_ = np.abs(above) > TOLERANCE_MM
        if not open_.any():
            break
        slope = surface.gradient(point[:, 0], point[:, 1])
        descent = direction[:, 2] - np.sum(slope * direction[:, :2], axis=-1)
        with np.errstate(divide="ignore", invalid="ignore"):
            step = np.clip(-above / descent, -STEP_MM, STEP_MM)
        # Where descent ≥ 0, a Newton step would go in the wrong direction.
        distance = np.where(open_ & (descent < 0), distance + step, distance)
    low = np.abs(origin[2] + distance * direction[:, 2]) <= REACH_MM
    return np.where((np.abs(above) <= TOLERANCE_MM) & low, distance, np.nan)


def _walk(surface: Surface, origin: FloatArray, direction: FloatArray) -> FloatArray:
    """Distance to the first crossing from above, by sampling and bisection, shape (n,)."""
    levels = np.linspace(REACH_MM, -REACH_MM, SCAN_LEVELS)
    distances = (levels[:, None] - origin[2]) / direction[:, 2]

    def above(distance: FloatArray) -> FloatArray:
        point = origin + distance[..., None] * direction
        return np.asarray(point[..., 2] - surface.height(point[..., 0], point[..., 1]))

    height = above(distances)
    crosses = (height[:-1] > 0) & (height[1:] <= 0)
    first = np.argmax(crosses, axis=0)
    column = np.arange(len(direction))
    near, far = distances[first, column], distances[first + 1, column]
    for _ in range(HALVINGS):
        middle = (near + far) / 2
        under = above(middle) <= 0
        near, far = np.where(under, near, middle), np.where(under, middle, far)
    return np.where(crosses.any(axis=0) & (np.abs(above(far)) <= 1e-6), far, np.nan)
