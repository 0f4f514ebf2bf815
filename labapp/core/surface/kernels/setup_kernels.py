"""Response of a fitted surface and of its level to a perturbed bench, compiled.

Arguments have the meanings that the package gives.
"""

from __future__ import annotations

import numpy as np
from numba import types

from labapp.core.compiled import BAND, FLOATS_1, FLOATS_2, FLOATS_3, INT, INTS_1
from labapp.core.compiled import compiled as _compiled
from labapp.core.surface.kernels.level_kernels import BLURS, DROPS_MM, search_level, sunk_cost
from labapp.core.surface.kernels.solver_kernels import gradient_rhs, newton_along_rays, solve
from labapp.core.surface.kernels.spline_kernels import surface_at
from labapp.core.values import FloatArray, IntArray

_own = types.Tuple((FLOATS_1, FLOATS_2, FLOATS_2))  # type: ignore[no-untyped-call]
_moved = types.Tuple((FLOATS_2, FLOATS_3, FLOATS_3, FLOATS_3))  # type: ignore[no-untyped-call]
_known_rays = types.Tuple((FLOATS_2, INTS_1, FLOATS_1, FLOATS_1))  # type: ignore[no-untyped-call]

NEWTON_STEPS = 2
"""Newton steps from where the rays of a slightly perturbed bench pass at the height of the
unperturbed reflection points, which is very close to the surface."""

# Fewer drops and blurs than for the level itself (`find_level`): only their changes are needed.
FEW_DROPS_MM = np.concatenate([[0.0], DROPS_MM[2::2]])
FEW_SUNK_COST = sunk_cost(FEW_DROPS_MM)
FEW_BLURS = np.ascontiguousarray(BLURS[:, ::2])


@_compiled(FLOATS_2, FLOATS_1, BAND, FLOATS_2, FLOATS_3, _own, _moved, INT)
def coefficient_changes(
    grid: FloatArray,
    coefficients: FloatArray,
    lower: FloatArray,
    points: FloatArray,
    weights: FloatArray,
    own: tuple[FloatArray, FloatArray, FloatArray],
    moved: tuple[FloatArray, FloatArray, FloatArray, FloatArray],
    rounds: int,
) -> FloatArray:
    """Changes of a fit's p coefficients for q slightly perturbed benches, shape (q, p), mm.

    Parameters
    ----------
    grid, coefficients, points, weights
        The fit, see `solver_kernels.gradient_rhs`.
    lower
        Cholesky factor of its normal matrix, lower band, shape (width + 1, p).
    own
        The laser, the plane and the dots of the bench, shape (n, 3), UCS, mm.
    moved
        Lasers, shape (q, 3), planes, shape (q, 5, 3), rays, shape (q, n, 3), and dots, shape
        (q, n, 3), of the perturbed benches.
    rounds
        Rounds in which the reflection points follow the surface.
    """
    laser, plane, dots = own
    lasers, planes, rays, moved_dots = moved
    base = gradient_rhs(grid, coefficients, points, weights, laser, plane, dots)
    changes = np.zeros((len(lasers), len(coefficients)))
    there, rises, right = np.empty_like(rays), np.empty_like(rays), np.empty_like(changes)
    start = np.empty_like(points)
    for k in range(len(lasers)):
        for n in range(len(points)):
            along = (points[n, 2] - lasers[k, 2]) / rays[k, n, 2]
            start[n] = lasers[k] + along * rays[k, n]
        there[k], _ = newton_along_rays(grid, coefficients, rays[k], start, NEWTON_STEPS)
        _, slope_x, slope_y = surface_at(grid, coefficients, there[k])
        for n in range(len(points)):
            x, y, z = rays[k, n]
            rises[k, n] = rays[k, n] / (z - slope_x[n] * x - slope_y[n] * y)
    for _ in range(rounds):
        for k in range(len(lasers)):
            raised = surface_at(grid, changes[k], there[k])[0].copy().reshape(-1, 1)
            at = there[k] + raised * rises[k]
            seen = lasers[k], planes[k], moved_dots[k]
            right[k] = gradient_rhs(grid, coefficients, at, weights, *seen) - base
        changes = solve(lower, right)
        for k in range(len(lasers)):  # slopes do not determine the level
            changes[k] -= surface_at(grid, changes[k], there[k])[0].mean()
    return changes


@_compiled(FLOATS_2, FLOATS_1, FLOATS_2, _known_rays, FLOATS_3, FLOATS_1)
def level_changes(
    grid: FloatArray,
    coefficients: FloatArray,
    changes: FloatArray,
    known_rays: tuple[FloatArray, IntArray, FloatArray, FloatArray],
    aside: FloatArray,
    search: FloatArray,
) -> FloatArray:
    """Changes of the level and of the rear's drop for q perturbed benches, shape (q, 2), mm.

    They respond in steps: half the difference between the bench perturbed one way and the other is
    used.

    Parameters
    ----------
    grid, coefficients
        The surface.
    changes
        Changes of its coefficients (`coefficient_changes`), shape (q, p), mm.
    known_rays
        Landing points, shape (m, 3), +1 or −1, shape (m,), and uncertainty of the height there,
        shape (m,), of the known rays, and the spacing of all, shape (2,) (`level.KnownRays`).
    aside
        Displacements of the landing points on each bench, shape (q, m, 3), mm.
    search
        Side of the head, position of the laser, mm, sign of the pool, reach of the search in rises,
        and share of missing dots.
    """
    landing, ray_states, sigma, spacing = known_rays
    bench, (pool_sign, reach, missing) = search[:4], search[4:]
    drops = FEW_DROPS_MM.copy() if pool_sign > 0.0 else np.zeros(1)
    about = np.concatenate((bench, np.array([0.0, pool_sign, reach, missing, FEW_SUNK_COST])))
    height, levels = np.empty((2, len(ray_states))), np.empty((len(changes), 2))
    height[1] = sigma
    for k in range(len(changes)):
        found = np.empty((2, 11))
        for n in range(2):
            way = 1.0 - 2.0 * n
            places = landing + way * aside[k]
            there = surface_at(grid, coefficients + way * changes[k], places)
            height[0] = there[0]
            seen = height, there[1:].T, places, ray_states, spacing
            found[n] = search_level(*seen, about, drops, FEW_BLURS)[0]
        levels[k, 0] = (found[0, 0] - found[1, 0]) / 2.0
        levels[k, 1] = (found[0, 3] - found[1, 3]) / 2.0
    return levels
