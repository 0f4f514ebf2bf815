"""Fits of many sets of labels, compiled.

Arguments have the meanings that the package gives.
"""

from __future__ import annotations

import numpy as np
from numba import types

from labapp.core.compiled import FLOATS_1, FLOATS_2, FLOATS_3, INT
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

_ints_3 = types.Array(INT, 3, "A", readonly=True)
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
    rays
        Directions and landing points of the rays, shape (rows, columns, 3).
    seen
        Dots on the plane, shape (n, 2), mm, and their covariance, shape (n, 2, 2), mm².
    bench
        Laser and plane.
    near
        Grid and coefficients of the surface to start from; without coefficients: z = 0.
    products
        See `solver_kernels.roughness_band`.
    limits
        Least number of labels; most splines; margin and spacing of their knots, mm; weight of the
        roughness; least uncertainty of a dot, mm; and the first four limits of `run_rounds`.
    """
    least, most_splines, margin, knot, weight, floor = limits[:6]
    (directions, landing), (plane_mm, covariance), (laser, plane) = rays, seen, bench
    found = np.full(len(labelled), np.inf)
    none, no_level = np.empty(0), np.zeros(11)
    known_rays = np.empty((0, 3)), np.empty(0, np.int64), none, np.ones(2)
    run_limits = np.array([*limits[6:10], np.nan, 1.0, 0.0, 1.0, 0.0, 0.0])
    for k in range(len(labelled)):
        row, column = np.nonzero(labelled[k] >= 0)
        if len(row) < least:
            continue
        pairs, dot = np.stack((row + 1, column + 1), axis=1), np.empty(len(row), np.int64)
        for n in range(len(row)):
            dot[n] = labelled[k, row[n], column[n]]
        own, points, outer = rays_of_pairs(pairs, directions, landing)
        grid = _grid_around(points, margin, knot)
        if not (grid[0, 3] + 3.0) * (grid[1, 3] + 3.0) <= most_splines:  # NaN, too
            continue
        on_plane = plane_mm[dot]
        dots = plane[0] + on_plane[:, :1] * plane[1] + on_plane[:, 1:] * plane[2]
        weights = slope_weights(laser, plane, points, dots, covariance[dot], floor)
        stiffness = (weight * roughness_band(products, grid).T).T
        if len(near[1]):
            points, _ = newton_along_rays(near[0], near[1], own, points, int(limits[8]))
        zero = np.zeros(stiffness.shape[1])
        coefficients, points, _, _, moved = run_rounds(
            grid,
            (stiffness, own, weights, laser, plane, dots),
            (zero, zero, points, stiffness),
            (outer, *known_rays),
            no_level,
            run_limits,
        )
        if not np.isnan(moved[0]):
            computed = intersect_and_reflect(grid, coefficients, own, points, 1, plane)[2]
            square = np.mean(np.sum((computed - on_plane) ** 2, axis=1))
            found[k] = np.sqrt(square) if np.isfinite(square) else np.inf
    return found
