"""Fits to pairs of ray and dot, compiled.

Arguments have the meanings that the package gives.
"""

from __future__ import annotations

import numpy as np
from numba import types

from labapp.core.compiled import BAND, FLOATS_1, FLOATS_2, FLOATS_3, INT
from labapp.core.compiled import compiled as _compiled
from labapp.core.compiled import inner as _inner
from labapp.core.surface.kernels.ray_kernels import (
    intersect_and_reflect,
    rays_of_pairs,
    slope_weights,
)
from labapp.core.surface.kernels.rounds_kernels import run_rounds
from labapp.core.surface.kernels.solver_kernels import newton_along_rays, roughness_band
from labapp.core.values import FloatArray, IntArray

_ints_2, _ints_3 = (types.Array(INT, n, "A", readonly=True) for n in (2, 3))
_splines = types.Tuple((FLOATS_2, BAND))  # type: ignore[no-untyped-call]
_rays, _seen = types.UniTuple(FLOATS_3, 2), types.Tuple((FLOATS_2, FLOATS_3))  # type: ignore[no-untyped-call]
_bench, _near = types.Tuple((FLOATS_1, FLOATS_2)), types.Tuple((FLOATS_2, FLOATS_1))  # type: ignore[no-untyped-call]


@_inner
def _grid_around(points: FloatArray, margin: float, knot: float) -> FloatArray:
    """Splines over points with a margin (`pool_fit.basis_around`)."""
    grid = np.empty((2, 4))
    for axis in range(2):
        low, high = points[:, axis].min() - margin, points[:, axis].max() + margin
        cells = max(2.0, np.ceil((high - low) / knot))
        grid[axis] = np.array([low, high, (high - low) / cells, cells])
    return grid


@_inner
def _known_rays(
    ray_states: IntArray, landing: FloatArray, grid: FloatArray
) -> tuple[FloatArray, IntArray]:
    """Landing points, shape (m, 3), and states of the known rays over the splines.

    Both are empty if none of them is dark: the level is then guessed.
    """
    places, states = np.empty((ray_states.size, 3)), np.empty(ray_states.size, np.int64)
    count, darkest = 0, 0
    for i in range(len(ray_states)):
        for j in range(ray_states.shape[1]):
            x, y = landing[i, j, 0], landing[i, j, 1]
            is_over = grid[0, 0] <= x <= grid[0, 1] and grid[1, 0] <= y <= grid[1, 1]
            if ray_states[i, j] != 0 and is_over:
                places[count], states[count] = landing[i, j], ray_states[i, j]
                darkest = min(darkest, states[count])
                count += 1
    count = count if darkest < 0 else 0
    return places[:count], states[:count]


@_compiled(_splines, _ints_2, _rays, _seen, _bench, _near, _ints_2, FLOATS_1)
def fit_pairs(
    splines: tuple[FloatArray, FloatArray],
    pairs: IntArray,
    rays: tuple[FloatArray, FloatArray],
    seen: tuple[FloatArray, FloatArray],
    bench: tuple[FloatArray, FloatArray],
    near: tuple[FloatArray, FloatArray],
    ray_states: IntArray,
    limits: FloatArray,
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray, float]:
    """Fit a surface to n pairs of ray and dot (`pool_fit.fit_pool`).

    Parameters
    ----------
    splines
        Their grid, and their roughness (`solver_kernels.roughness_band`).
    pairs
        Row and column of each pair's ray, counted from 1, shape (n, 2).
    rays
        Directions and landing points of all rays, shape (rows, columns, 3).
    seen
        Dots of the pairs on the plane, shape (n, 2), mm, and their covariance, shape (n, 2, 2),
        mm².
    bench
        Laser and plane.
    near
        Grid and coefficients of the surface to start from; without coefficients: z = 0.
    ray_states
        See `Match.ray_states`.
    limits
        Weight of the roughness; least uncertainty of a dot, mm; spacing of the rays along X and
        along Y, mm; and the limits of `run_rounds`, of which the fifth must be NaN.

    Returns
    -------
    coefficients, points, factor, level, residual, moved
        See `run_rounds`; the residuals are those of `FittedPool`. The last is NaN without a
        surface.
    """
    (grid, roughness), (laser, plane), (plane_mm, covariance) = splines, bench, seen
    own, points, outer = rays_of_pairs(pairs, rays[0], rays[1])
    dots = plane[0] + plane_mm[:, :1] * plane[1] + plane_mm[:, 1:] * plane[2]
    weights = slope_weights(laser, plane, points, dots, covariance, limits[1])
    stiffness = (limits[0] * roughness.T).T
    if len(near[1]):
        points, _ = newton_along_rays(near[0], near[1], own, points, int(limits[6]))
    places, states = _known_rays(ray_states, rays[1], grid)
    level_input = outer[: 0 if len(states) else len(outer)], places, states
    zero = np.zeros(stiffness.shape[1])
    coefficients, points, factor, level, moved = run_rounds(
        grid,
        (stiffness, own, weights, laser, plane, dots),
        (zero, zero, points, stiffness),
        (*level_input, np.zeros(len(states)), limits[2:4]),
        np.array([0.0, np.inf, 1.0, *np.zeros(8)]),
        limits[4:],
    )
    points, _, computed = intersect_and_reflect(grid, coefficients, own, points, 1, plane)
    return coefficients, points, factor, level, computed - plane_mm, moved[0]


@_compiled(_ints_3, _rays, _seen, _bench, _near, FLOATS_3, FLOATS_1)
def misfits(
    labelled: IntArray,
    rays: tuple[FloatArray, FloatArray],
    seen: tuple[FloatArray, FloatArray],
    bench: tuple[FloatArray, FloatArray],
    near: tuple[FloatArray, FloatArray],
    products: FloatArray,
    limits: FloatArray,
) -> FloatArray:
    """Root mean square residuals of fits to sets of labels, shape (k,), mm (`pool_fit.misfits`).

    Parameters
    ----------
    labelled
        Index of each ray's dot, negative if it has none, shape (k, rows, columns).
    rays, bench, near
        See `fit_pairs`.
    seen
        Dots on the plane, shape (n, 2), mm, and their covariance, shape (n, 2, 2), mm².
    products
        See `solver_kernels.roughness_band`.
    limits
        Least number of labels; most splines; margin and spacing of their knots, mm; and the limits
        of `fit_pairs`.
    """
    least, most_splines, margin, knot = limits[:4]
    found, unknown = np.full(len(labelled), np.inf), np.zeros(labelled.shape[1:], np.int64)
    for k in range(len(labelled)):
        row, column = np.nonzero(labelled[k] >= 0)
        if len(row) < least:
            continue
        pairs, dot = np.stack((row + 1, column + 1), axis=1), np.empty(len(row), np.int64)
        for n in range(len(row)):
            dot[n] = labelled[k, row[n], column[n]]
        grid = _grid_around(rays_of_pairs(pairs, rays[0], rays[1])[1], margin, knot)
        if not (grid[0, 3] + 3.0) * (grid[1, 3] + 3.0) <= most_splines:  # NaN, too
            continue
        splines, own = (grid, roughness_band(products, grid)), (seen[0][dot], seen[1][dot])
        made = fit_pairs(splines, pairs, rays, own, bench, near, unknown, limits[4:])
        if not np.isnan(made[5]):
            square = np.mean(np.sum(made[4] ** 2, axis=1))
            found[k] = np.sqrt(square) if np.isfinite(square) else np.inf
    return found
