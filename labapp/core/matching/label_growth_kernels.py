"""The step of label growth that labels the dots of a surface, compiled (docs/adr/0018)."""

from __future__ import annotations

import numpy as np
from numba import types

from labapp.core.compiled import BAND, FLOATS_1, FLOATS_2, FLOATS_3, INT, compiled
from labapp.core.images.band_pass_kernels import next_apart
from labapp.core.matching.match_kernels import sure_pairs, widened
from labapp.core.surface.kernels.ray_kernels import intersect_and_reflect
from labapp.core.surface.kernels.solver_kernels import covariance_of_dots, inverse_band
from labapp.core.values import BoolArray, FloatArray, IntArray

_labels = types.Array(INT, 2, "A", readonly=True)
_rays = types.Tuple((FLOATS_3, FLOATS_3, types.Array(types.boolean, 2, "A", readonly=True)))  # type: ignore[no-untyped-call]
_bench, _dots = types.Tuple((FLOATS_1, FLOATS_2)), types.Tuple((FLOATS_2, FLOATS_3))  # type: ignore[no-untyped-call]
_pool = types.Tuple((FLOATS_2, FLOATS_1, BAND))  # type: ignore[no-untyped-call]


@compiled(_labels, _rays, _bench, _pool, _dots, FLOATS_1)
def matched_labels(
    labels: IntArray,
    rays: tuple[FloatArray, FloatArray, BoolArray],
    bench: tuple[FloatArray, FloatArray],
    pool: tuple[FloatArray, FloatArray, FloatArray],
    dots: tuple[FloatArray, FloatArray],
    limits: FloatArray,
) -> IntArray:
    """Label the dots that are uniquely assigned to a ray (`label_growth.matched_labels`).

    Parameters
    ----------
    labels
        Index of each ray's dot, negative if it has none, shape (rows, columns).
    rays
        Directions and landing points of the rays, mm, shape (rows, columns, 3), and mask of the
        absent ones, shape (rows, columns).
    bench
        Laser and plane, as in `surface.kernels`.
    pool
        Grid and coefficients of the surface fitted to the labels, and the factor of its normal
        matrix (`solver_kernels.normal_factor`).
    dots
        Places of the dots on the plane, shape (d, 2), mm, and their covariance, shape (d, 2, 2),
        mm².
    limits
        Newton steps from the landing points to the surface; distance below which dots merge, mm;
        and the limits of `sure_pairs`.
    """
    (directions, landing, absent), (laser, plane), (grid, coefficients, factor) = rays, bench, pool
    is_lit, matched = labels >= 0, np.full(labels.shape, -1)
    row, column = np.nonzero(widened(is_lit, 2))
    own, points = np.empty((len(row), 3)), np.empty((len(row), 3))
    for n in range(len(row)):
        own[n], points[n] = directions[row[n], column[n]], landing[row[n], column[n]]
    met, _, computed = intersect_and_reflect(grid, coefficients, own, points, int(limits[0]), plane)
    known = np.flatnonzero(np.isfinite(computed[:, 0]))
    if len(known) == 0:
        return matched
    computed = computed[known]
    universal = plane[0] + computed[:, :1] * plane[1] + computed[:, 1:] * plane[2]
    covariance = covariance_of_dots(grid, inverse_band(factor), laser, plane, met[known], universal)
    dot, ray = sure_pairs(dots[0], dots[1], computed, covariance, limits[2:])
    spacing, near = next_apart(computed), widened(is_lit, 1)
    for k in range(len(dot)):
        i, j = row[known[ray[k]]], column[known[ray[k]]]
        # The positions of dots that merge are not those of either ray.
        if near[i, j] and not absent[i, j] and spacing[ray[k]] > limits[1]:
            matched[i, j] = dot[k]
    return matched
