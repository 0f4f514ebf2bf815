"""Samples for the shape parameters of a pool, and their derivatives, compiled.

Arguments have the meanings that the package gives.
"""

from __future__ import annotations

import numpy as np
from numba import types

from labapp.core.compiled import FLOAT, FLOATS_1, FLOATS_2, FLOATS_3
from labapp.core.compiled import compiled as _compiled
from labapp.core.compiled import inner as _inner
from labapp.core.surface.kernels.spline_kernels import (
    accumulate_at_boundary,
    accumulate_splines,
    height_and_slopes,
)
from labapp.core.values import FloatArray, IntArray

_spokes = types.Tuple((FLOATS_1, FLOATS_1, FLOATS_3, FLOATS_2))  # type: ignore[no-untyped-call]
_rims = types.Tuple((FLOATS_1, FLOATS_2, FLOATS_2, FLOATS_1))  # type: ignore[no-untyped-call]

SPOKES, RINGS = 48, 8
"""Directions from the middle of the boundary, the first along −Y, a multiple of 4; and samples
along each."""

_NODE, _WEIGHT = np.polynomial.legendre.leggauss(RINGS)
FRACTION, HALVED_WEIGHT = (_NODE + 1) / 2, _WEIGHT / 2
"""Fractions of the way outwards at which the surface is sampled, and their Gauss–Legendre weights,
halved for the interval 0 … 1."""

PHI = -np.pi / 2 + 2 * np.pi * np.arange(SPOKES) / SPOKES
WAY = np.column_stack([np.cos(PHI), np.sin(PHI)])
ENDS = np.array([0, SPOKES // 2])
"""Spokes along the longitudinal section: towards −Y and +Y."""

RIGHT = (1 + np.sign(np.round(WAY[:, 0], 9))) / 2
"""Share of each spoke that is right of that section."""

STEP_MM = 0.01
"""Step of the finite differences of slopes."""


@_inner
def _angles(outline: FloatArray, middle: FloatArray) -> tuple[FloatArray, IntArray]:
    """Angles of the boundary points about a middle, and their order, both of shape (m,)."""
    angle = np.arctan2(outline[:, 1] - middle[1], outline[:, 0] - middle[0])
    return angle, np.argsort(angle)


@_inner
def _around(angle: FloatArray, order: IntArray, values: FloatArray, phi: float) -> float:
    """Interpolate values at boundary points to an angle from −π to 2π."""
    count = len(order)
    at = phi if phi < np.pi else phi - 2 * np.pi
    low, high = 0, count  # points before low lie before the angle, those from high on do not
    while low < high:
        half = (low + high) // 2
        if angle[order[half]] <= at:
            low = half + 1
        else:
            high = half
    before, after = order[low - 1], order[low % count]
    whole = (angle[after] - angle[before]) % (2 * np.pi)
    share = ((at - angle[before]) % (2 * np.pi)) / whole if whole > 0.0 else 0.0
    return float(values[before] + share * (values[after] - values[before]))


@_compiled(FLOATS_2, FLOATS_1, FLOAT)
def sample_places(
    outline: FloatArray, center: FloatArray, edge: float
) -> tuple[tuple[FloatArray, FloatArray, FloatArray], tuple[FloatArray, FloatArray, FloatArray]]:
    """Places on spokes from the middle of the boundary, and at or beside the boundary.

    ``edge`` is the fraction of the way from centre to boundary at which the slope is evaluated.

    Returns
    -------
    spokes, rim
        Middle of the boundary, shape (2,), length of each of s spokes, shape (s,), and the places,
        shape (s, r, 2), mm. At each boundary point: the length of boundary that it represents,
        shape (m,), mm; the inward normal and the place towards the centre, shape (2,), at which the
        slope is evaluated, shape (m, 2).
    """
    count = len(outline)
    middle = np.empty(2)
    for axis in range(2):
        middle[axis] = (outline[:, axis].min() + outline[:, axis].max()) / 2
    distance = np.hypot(outline[:, 0] - middle[0], outline[:, 1] - middle[1])
    angle, order = _angles(outline, middle)
    reach, place = np.empty(SPOKES), np.empty((SPOKES, RINGS, 2))
    for s in range(SPOKES):
        reach[s] = _around(angle, order, distance, PHI[s])
        for r in range(RINGS):
            along = reach[s] * (1 - 1e-9) * FRACTION[r]
            place[s, r, 0], place[s, r, 1] = (
                middle[0] + along * WAY[s, 0],
                middle[1] + along * WAY[s, 1],
            )
    length, inward, rim = np.empty(count), np.empty((count, 2)), np.empty((count, 2))
    for k in range(count):
        before, after = outline[k - 1], outline[(k + 1) % count]
        x, y = (after[0] - before[0]) / 2, (after[1] - before[1]) / 2
        length[k] = np.hypot(x, y)
        inward[k, 0], inward[k, 1] = -y / length[k], x / length[k]
        for axis in range(2):
            rim[k, axis] = center[axis] + edge * (outline[k, axis] - center[axis])
    return (middle, reach, place), (length, inward, rim)


@_compiled(_spokes, _rims)
def shape_parameters(
    spokes: tuple[FloatArray, FloatArray, FloatArray, FloatArray],
    rim: tuple[FloatArray, FloatArray, FloatArray, FloatArray],
) -> FloatArray:
    """Convexity, asymmetry and wetting slope (`shape.shape_of`), shape (3,).

    ``spokes`` and ``rim`` are those of `shape_gradients`.
    """
    (_, reach, _, height), (length, _, _, rise) = spokes, rim
    section, along, right, left = 0.0, 0.0, 0.0, 0.0
    for e in ENDS:
        for r in range(RINGS):
            section += reach[e] * HALVED_WEIGHT[r] * height[e, r]
            along += reach[e] * HALVED_WEIGHT[r]
    for s in range(SPOKES):
        for r in range(RINGS):
            area = reach[s] ** 2 * HALVED_WEIGHT[r] * FRACTION[r] * 2 * np.pi / SPOKES
            right += RIGHT[s] * area * abs(height[s, r])
            left += (1 - RIGHT[s]) * area * abs(height[s, r])
    wetting = np.sum(np.degrees(np.arctan(rise)) * length) / np.sum(length)
    return np.array([section / along, (right - left) / max(right + left, 1e-30), wetting])


@_inner
def _convexity(
    grid: FloatArray,
    coefficients: FloatArray,
    outline: FloatArray,
    boundary_slope: FloatArray,
    rear: FloatArray,
    spokes: tuple[FloatArray, FloatArray, FloatArray, FloatArray],
    convexity: float,
    out: FloatArray,
) -> float:
    """Add the derivatives of the convexity; returns that by X of the boundary's middle.

    The ends of the section stay on the boundary as the middle moves.
    """
    middle, reach, place, _ = spokes
    angle, order = _angles(outline, middle)
    length, aside, work = reach[ENDS[0]] + reach[ENDS[1]], 0.0, np.empty((4, 4))
    for e in ENDS:
        for r in range(RINGS):
            x, y = place[e, r]
            _, slope_x, _ = height_and_slopes(grid, coefficients, x, y, work)
            share = reach[e] * HALVED_WEIGHT[r] / length
            aside += share * slope_x
            accumulate_splines(grid, x, y, share, work, out)
        slope_x = _around(angle, order, boundary_slope[:, 0], PHI[e])
        slope_y = _around(angle, order, boundary_slope[:, 1], PHI[e])
        height = _around(angle, order, outline[:, 2], PHI[e])
        outwards = WAY[e, 1] * (height - convexity) / length
        aside -= outwards * slope_x / slope_y
        x, y = middle[0] + reach[e] * WAY[e, 0], middle[1] + reach[e] * WAY[e, 1]
        accumulate_at_boundary(grid, rear, x, y, -outwards / slope_y, work, out)
    return aside


@_inner
def _asymmetry(
    grid: FloatArray,
    outline: FloatArray,
    boundary_slope: FloatArray,
    rear: FloatArray,
    spokes: tuple[FloatArray, FloatArray, FloatArray, FloatArray],
    rim: tuple[FloatArray, FloatArray, FloatArray, FloatArray],
    asymmetry: float,
    out: FloatArray,
) -> float:
    """Add the derivatives of the asymmetry; returns that by X of the boundary's middle.

    The section that divides the volume moves with the middle.
    """
    (middle, reach, place, height), (length, inward, _, _) = spokes, rim
    area, total, across = np.empty((SPOKES, RINGS)), 0.0, 0.0
    for s in range(SPOKES):
        for r in range(RINGS):
            area[s, r] = reach[s] ** 2 * HALVED_WEIGHT[r] * FRACTION[r] * 2 * np.pi / SPOKES
            total += area[s, r] * abs(height[s, r])
    for e in ENDS:
        for r in range(RINGS):
            across += reach[e] * HALVED_WEIGHT[r] * abs(height[e, r])
    # The weight of the right side is 1 − asymmetry, that of the left −(1 + asymmetry).
    work = np.empty((4, 4))
    for s in range(SPOKES):
        for r in range(RINGS):
            x, y = place[s, r]
            side = (2 * RIGHT[s] - 1 - asymmetry) * np.sign(height[s, r])
            accumulate_splines(grid, x, y, side * area[s, r] / total, work, out)
    for k in range(len(outline)):
        x, y, z = outline[k]
        a, b = boundary_slope[k]
        outwards = (inward[k, 0] * a + inward[k, 1] * b) / (a * a + b * b) * abs(z) * length[k]
        share = (np.sign(x - middle[0]) - asymmetry) * outwards / total
        accumulate_at_boundary(grid, rear, x, y, share, work, out)
    return -2 * across / total


@_inner
def _wetting(
    grid: FloatArray,
    coefficients: FloatArray,
    outline: FloatArray,
    boundary_slope: FloatArray,
    rear: FloatArray,
    rim: tuple[FloatArray, FloatArray, FloatArray, FloatArray],
    wetting_deg: float,
    out: FloatArray,
) -> float:
    """Add the derivatives of the wetting slope: tilt of the surface, and moves of the boundary.

    Returns that by X of the boundary's middle, 0.
    """
    length, inward, place, rise = rim
    count, whole, work = len(outline), length.sum(), np.empty((4, 4))
    pull, bend = np.empty((count, 2)), np.empty(2)
    for k in range(count):
        over = (np.degrees(np.arctan(rise[k])) - wetting_deg) / whole
        pull[k, 0], pull[k, 1] = over * inward[k, 1], -over * inward[k, 0]
    for k in range(count):
        turned = np.degrees(length[k] / (1 + rise[k] ** 2) / whole)
        a, b = boundary_slope[k]
        by_move = 0.0
        bend[:] = 0.0
        for way in (1.0, -1.0):
            x = place[k, 0] + way * STEP_MM * inward[k, 0]
            y = place[k, 1] + way * STEP_MM * inward[k, 1]
            _, slope_x, slope_y = height_and_slopes(grid, coefficients, x, y, work)
            bend[0] += way * slope_x / (2 * STEP_MM)
            bend[1] += way * slope_y / (2 * STEP_MM)
            accumulate_splines(grid, x, y, way * turned / (2 * STEP_MM), work, out)
        for axis in range(2):
            grown = (pull[k - 1, axis] - pull[(k + 1) % count, axis]) / 2
            moved = -boundary_slope[k, axis] / (a * a + b * b)
            by_move += (turned * bend[axis] + grown) * moved
        accumulate_at_boundary(grid, rear, outline[k, 0], outline[k, 1], by_move, work, out)
    return 0.0


@_compiled(FLOATS_2, FLOATS_1, FLOATS_2, FLOATS_2, FLOATS_1, _spokes, _rims, FLOATS_1)
def shape_gradients(
    grid: FloatArray,
    coefficients: FloatArray,
    outline: FloatArray,
    boundary_slope: FloatArray,
    rear: FloatArray,
    spokes: tuple[FloatArray, FloatArray, FloatArray, FloatArray],
    rim: tuple[FloatArray, FloatArray, FloatArray, FloatArray],
    shape_parameters: FloatArray,
) -> FloatArray:
    """Derivatives of the shape parameters by the p spline coefficients and the drop of the rear.

    The boundary moves with the surface. They have shape (3, p + 1).

    Parameters
    ----------
    grid, coefficients, outline, boundary_slope, rear
        See the package.
    spokes, rim
        Results of `sample_places`, with the heights of the surface on the spokes, shape (s, r), and
        its slopes inwards at the rim, shape (m,).
    shape_parameters
        Their values, shape (3,).
    """
    out = np.zeros((3, len(coefficients) + 1))
    low, high = np.argmin(outline[:, 0]), np.argmax(outline[:, 0])
    edge = outline, boundary_slope, rear
    by_middle = (
        _convexity(grid, coefficients, *edge, spokes, shape_parameters[0], out[0]),
        _asymmetry(grid, *edge, spokes, rim, shape_parameters[1], out[1]),
        _wetting(grid, coefficients, *edge, rim, shape_parameters[2], out[2]),
    )
    work = np.empty((4, 4))
    for parameter in range(3):
        for end in (low, high):  # the middle moves by half the displacement of each side
            share = -0.5 * by_middle[parameter] / boundary_slope[end, 0]
            x, y = outline[end, 0], outline[end, 1]
            accumulate_at_boundary(grid, rear, x, y, share, work, out[parameter])
    return out
