"""Splines and the surface that they make, compiled for the processor (docs/adr/0018).

Arguments mean the same in all of these modules, all in the UCS and mm:

* ``grid``: low end, high end, step and number of cells of the splines along x and along y, shape
  (2, 4) (`SplineBasis.grid`); with it ``coefficients`` of the splines, shape (p,).
* ``work``: memory to write on, which holds values and slopes of the four splines along x, then
  those along y, shape (4, 4).
"""

from __future__ import annotations

import numpy as np
from numba import types

from labapp.core.compiled import compiled as _compiled
from labapp.core.compiled import inner as _inner
from labapp.core.values import FloatArray, IntArray

_f, _i = types.float64, types.int64
_f1, _f2, _f3, _f4 = (types.Array(_f, n, "A", readonly=True) for n in (1, 2, 3, 4))


@_inner
def cubic_splines(axis: FloatArray, place: float, value: FloatArray, slope: FloatArray) -> int:
    """Values and slopes of the four cubic splines at a place; returns the number of the first one.

    The axis is a row of ``grid``; a place beyond its ends is moved to them.
    """
    low, high, step = axis[0], axis[1], axis[2]
    at = (min(max(place, low), high) - low) / step
    first = min(int(at), int(axis[3]) - 1) if at > 0.0 else 0
    t = at - first
    s = 1.0 - t
    value[0] = s * s * s / 6.0
    value[1] = ((3.0 * t - 6.0) * t * t + 4.0) / 6.0
    value[2] = ((3.0 * s - 6.0) * s * s + 4.0) / 6.0
    value[3] = t * t * t / 6.0
    slope[0] = -s * s / 2.0 / step
    slope[1] = (1.5 * t - 2.0) * t / step
    slope[2] = (2.0 - 1.5 * s) * s / step
    slope[3] = t * t / 2.0 / step
    return first


@_inner
def height_and_slopes(
    grid: FloatArray, coefficients: FloatArray, x: float, y: float, work: FloatArray
) -> tuple[float, float, float]:
    """Height and slopes of a surface; values and slopes of the splines there stay in ``work``."""
    first_x = cubic_splines(grid[0], x, work[0], work[1])
    first_y = cubic_splines(grid[1], y, work[2], work[3])
    many = int(grid[1, 3]) + 3
    z, slope_x, slope_y = 0.0, 0.0, 0.0
    for a in range(4):
        at = (first_x + a) * many + first_y
        value, slope = 0.0, 0.0
        for b in range(4):
            value += work[2, b] * coefficients[at + b]
            slope += work[3, b] * coefficients[at + b]
        z += work[0, a] * value
        slope_x += work[1, a] * value
        slope_y += work[0, a] * slope
    return z, slope_x, slope_y


@_compiled(_f2, _f2)
def splines_at(grid: FloatArray, place: FloatArray) -> tuple[IntArray, FloatArray]:
    """Splines that are not zero at places, shape (n, 2), held to the rectangle.

    Returns their numbers, shape (n, 16); value and derivatives by x and by y, shape (3, n, 16).
    """
    count, many = len(place), int(grid[1, 3]) + 3
    splines, values = np.empty((count, 16), np.int64), np.empty((3, count, 16))
    work = np.empty((4, 4))
    for k in range(count):
        first_x = cubic_splines(grid[0], place[k, 0], work[0], work[1])
        first_y = cubic_splines(grid[1], place[k, 1], work[2], work[3])
        for a in range(4):
            for b in range(4):
                splines[k, 4 * a + b] = (first_x + a) * many + first_y + b
                values[0, k, 4 * a + b] = work[0, a] * work[2, b]
                values[1, k, 4 * a + b] = work[1, a] * work[2, b]
                values[2, k, 4 * a + b] = work[0, a] * work[3, b]
    return splines, values


@_compiled(_f2, _f1, _f2)
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
    many = int(grid[1, 3]) + 3
    first_x = cubic_splines(grid[0], x, work[0], work[1])
    first_y = cubic_splines(grid[1], y, work[2], work[3])
    for a in range(4):
        for b in range(4):
            out[(first_x + a) * many + first_y + b] += share * work[0, a] * work[2, b]


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
    by the drop (`Rear.height`) is the last value of ``out``.
    """
    accumulate_splines(grid, x, y, share, work, out)
    part = max((rear[1] - y) / (rear[1] - rear[2]), 0.0)
    out[-1] += share * part * part


@_compiled(_f2, _i, _f2, _f1)
def gradient_of_sum(
    grid: FloatArray, count: int, place: FloatArray, share: FloatArray
) -> FloatArray:
    """Derivative of Σ share · height at places by so many coefficients, shape (p,)."""
    out, work = np.zeros(count), np.empty((4, 4))
    for k in range(len(place)):
        accumulate_splines(grid, place[k, 0], place[k, 1], share[k], work, out)
    return out
