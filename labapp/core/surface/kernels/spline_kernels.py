"""Splines and the surface that they make, compiled.

Arguments have the meanings that the package gives.
"""

from __future__ import annotations

import numpy as np

from labapp.core.compiled import FLOATS_1, FLOATS_2, INT
from labapp.core.compiled import compiled as _compiled
from labapp.core.compiled import inner as _inner
from labapp.core.values import FloatArray


@_inner
def cubic_splines(axis: FloatArray, place: float, value: FloatArray, slope: FloatArray) -> int:
    """Values and slopes of the four cubic splines at a place; returns the number of the first one.

    The axis is a row of ``grid``; a place beyond its ends is moved to them.
    """
    low, high, per_mm = axis[0], axis[1], 1.0 / axis[2]  # one division, and no other in a loop
    at = (min(max(place, low), high) - low) * per_mm
    first = min(int(at), int(axis[3]) - 1) if at > 0.0 else 0
    t = at - first
    s = 1.0 - t
    value[0] = s * s * s / 6.0
    value[1] = (0.5 * t - 1.0) * t * t + 2.0 / 3.0
    value[2] = (0.5 * s - 1.0) * s * s + 2.0 / 3.0
    value[3] = t * t * t / 6.0
    slope[0] = -0.5 * s * s * per_mm
    slope[1] = (1.5 * t - 2.0) * t * per_mm
    slope[2] = (2.0 - 1.5 * s) * s * per_mm
    slope[3] = 0.5 * t * t * per_mm
    return first


@_inner
def height_and_slopes(
    grid: FloatArray, coefficients: FloatArray, x: float, y: float, work: FloatArray
) -> tuple[float, float, float]:
    """Height and slopes of a surface; values and slopes of the splines there stay in ``work``."""
    first_x = cubic_splines(grid[0], x, work[0], work[1])
    first_y = cubic_splines(grid[1], y, work[2], work[3])
    y_count = int(grid[1, 3]) + 3
    z, slope_x, slope_y = 0.0, 0.0, 0.0
    for a in range(4):
        at = (first_x + a) * y_count + first_y
        value, slope = 0.0, 0.0
        for b in range(4):
            value += work[2, b] * coefficients[at + b]
            slope += work[3, b] * coefficients[at + b]
        z += work[0, a] * value
        slope_x += work[1, a] * value
        slope_y += work[0, a] * slope
    return z, slope_x, slope_y


@_compiled(FLOATS_2, FLOATS_1, FLOATS_2)
def surface_at(grid: FloatArray, coefficients: FloatArray, place: FloatArray) -> FloatArray:
    """Height, mm, and slopes by x and by y of a surface at places, shape (n, 2): shape (3, n)."""
    out, work = np.empty((3, len(place))), np.empty((4, 4))
    for k in range(len(place)):
        z, slope_x, slope_y = height_and_slopes(grid, coefficients, place[k, 0], place[k, 1], work)
        out[0, k], out[1, k], out[2, k] = z, slope_x, slope_y
    return out


@_inner
def accumulate_splines(
    grid: FloatArray, x: float, y: float, share: float, work: FloatArray, out: FloatArray
) -> None:
    """Add to ``out`` the value of every spline at a place, times a share."""
    y_count = int(grid[1, 3]) + 3
    first_x = cubic_splines(grid[0], x, work[0], work[1])
    first_y = cubic_splines(grid[1], y, work[2], work[3])
    for a in range(4):
        for b in range(4):
            out[(first_x + a) * y_count + first_y + b] += share * work[0, a] * work[2, b]


@_inner
def drop_share(rear: FloatArray, y: float) -> tuple[float, float]:
    """Share of the rear's drop by which the boundary lies lower at Y, and its derivative by Y.

    It is 0 up to the start and increases as a parabola to 1 at the end, on whichever side.
    """
    per_mm = 1.0 / (rear[1] - rear[2])
    part = max((rear[1] - y) * per_mm, 0.0)
    return part * part, -2.0 * part * per_mm


@_compiled(FLOATS_1, FLOATS_1)
def rear_heights(rear: FloatArray, y: FloatArray) -> FloatArray:
    """Heights of the boundary at places Y (`level.Rear.height`), shape (n,), mm."""
    height = np.empty(len(y))
    for k in range(len(y)):
        height[k] = -rear[0] * drop_share(rear, y[k])[0]
    return height


@_inner
def accumulate_at_boundary(
    grid: FloatArray,
    rear: FloatArray,
    x: float,
    y: float,
    share: float,
    work: FloatArray,
    out: FloatArray,
) -> None:
    """`accumulate_splines` at a boundary point, and for the drop of the rear.

    Where the boundary lies lower by dz it moves as if the surface were higher by dz. The derivative
    by the drop is the last value of ``out``.
    """
    if share == 0.0:  # what moves with the boundary's height is 0 except at a rear that lies lower
        return
    accumulate_splines(grid, x, y, share, work, out)
    out[-1] += share * drop_share(rear, y)[0]


@_compiled(FLOATS_2, INT, FLOATS_2, FLOATS_1)
def gradient_of_sum(
    grid: FloatArray, count: int, place: FloatArray, share: FloatArray
) -> FloatArray:
    """Derivative of Σ share · height at places by p = ``count`` coefficients, shape (p,)."""
    out, work = np.zeros(count), np.empty((4, 4))
    for k in range(len(place)):
        accumulate_splines(grid, place[k, 0], place[k, 1], share[k], work, out)
    return out
