"""Inner loops of `quadric_search`, compiled (docs/adr/0018)."""

from __future__ import annotations

import numpy as np
from numba import types

from labapp.core.compiled import compiled, part
from labapp.core.values import BoolArray, FloatArray, IntArray

_f1, _f2, _f4 = (types.Array(types.float64, n, "A", readonly=True) for n in (1, 2, 4))
_mask = types.Array(types.boolean, 2, "A", readonly=True)


@part
def _at(quadric: FloatArray, x: float, y: float) -> tuple[float, float, float]:
    """Height and slopes of a quadric at a place from its centre: g_x, g_y, κ_x, κ_xy, κ_y."""
    along_x = quadric[0] + quadric[2] * x + quadric[3] * y
    along_y = quadric[1] + quadric[3] * x + quadric[4] * y
    return ((quadric[0] + along_x) * x + (quadric[1] + along_y) * y) / 2.0, along_x, along_y


@compiled(_f1, _f2, _f2, _f1, _f2)
def meet(
    center: FloatArray, quadrics: FloatArray, rays: FloatArray, laser: FloatArray, plane: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Where rays meet quadrics, and the dots that these make of them on a plane.

    Parameters
    ----------
    center, quadrics
        Shape (2,), mm; slopes and curvatures of each (`_at`), shape (m, 5).
    rays, laser
        Shapes (n, 3) and (3,), mm.
    plane
        Its origin, its axes along X′ and Z′ and its normal, shape (4, 3).

    Returns
    -------
    points, dots
        Shape (m, n, 3), mm, and IPCS, shape (m, n, 2), mm; NaN where a ray runs away.
    """
    points = np.empty((len(quadrics), len(rays), 3))
    dots = np.full((len(quadrics), len(rays), 2), np.nan)
    for q in range(len(quadrics)):
        for k in range(len(rays)):
            ray, point = rays[k], points[q, k]
            for axis in range(3):
                point[axis] = laser[axis] - laser[2] / ray[2] * ray[axis]
            for _ in range(3):
                z, slope_x, slope_y = _at(quadrics[q], point[0] - center[0], point[1] - center[1])
                descent = slope_x * ray[0] + slope_y * ray[1] - ray[2]
                step = min(max((point[2] - z) / max(descent, 0.05), -1.0), 1.0)
                for axis in range(3):
                    point[axis] += step * ray[axis]
            _, slope_x, slope_y = _at(quadrics[q], point[0] - center[0], point[1] - center[1])
            twice = 2.0 * (ray[2] - slope_x * ray[0] - slope_y * ray[1])
            twice /= slope_x * slope_x + slope_y * slope_y + 1.0
            away = ray[0] + twice * slope_x, ray[1] + twice * slope_y, ray[2] - twice
            gap, along = 0.0, 0.0
            for axis in range(3):
                gap += (plane[0, axis] - point[axis]) * plane[3, axis]
                along += away[axis] * plane[3, axis]
            if along == 0.0 or not 0.0 < gap / along < np.inf:
                continue
            dots[q, k, 0] = dots[q, k, 1] = 0.0
            for axis in range(3):
                at = point[axis] + gap / along * away[axis] - plane[0, axis]
                dots[q, k, 0] += at * plane[1, axis]
                dots[q, k, 1] += at * plane[2, axis]
    return points, dots


@part
def _apart(one: FloatArray, other: FloatArray) -> float:
    """Distance of two dots; infinite where there is none."""
    distance = np.hypot(one[0] - other[0], one[1] - other[1])
    return distance if np.isfinite(distance) else np.inf


@compiled(_f4, _f2, _mask, types.float64)
def hits(
    pattern: FloatArray, places: FloatArray, absent: BoolArray, gate: float
) -> tuple[BoolArray, IntArray, FloatArray]:
    """Which predicted dots fall on which of some places: see `quadric_search._Window.hits`."""
    count, rows, columns = pattern.shape[:3]
    hit = np.zeros((count, rows, columns), np.bool_)
    dot = np.zeros((count, rows, columns), np.int64)
    off = np.full((count, rows, columns), np.inf)
    for p in range(count):
        for i in range(rows):
            for j in range(columns):
                own = pattern[p, i, j]
                if not (np.isfinite(own[0]) and np.isfinite(own[1])):
                    continue
                spacing = np.inf
                if i > 0:
                    spacing = min(spacing, _apart(own, pattern[p, i - 1, j]))
                if i < rows - 1:
                    spacing = min(spacing, _apart(own, pattern[p, i + 1, j]))
                if j > 0:
                    spacing = min(spacing, _apart(own, pattern[p, i, j - 1]))
                if j < columns - 1:
                    spacing = min(spacing, _apart(own, pattern[p, i, j + 1]))
                least = np.inf
                for k in range(len(places)):
                    x, y = own[0] - places[k, 0], own[1] - places[k, 1]
                    if x * x + y * y < least:
                        least = x * x + y * y
                        dot[p, i, j] = k
                off[p, i, j] = np.sqrt(least) / max(gate * spacing, 1e-9)
                hit[p, i, j] = off[p, i, j] < 1.0 and not absent[i, j]
    return hit, dot, off
