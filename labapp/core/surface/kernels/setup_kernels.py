"""Response of a fitted surface to a slightly perturbed bench, compiled (docs/adr/0018).

Arguments mean the same as in `solver_kernels`.
"""

from __future__ import annotations

import numpy as np
from numba import types

from labapp.core.compiled import compiled as _compiled
from labapp.core.surface.kernels.solver_kernels import gradient_rhs, newton_along_rays, solve
from labapp.core.surface.kernels.spline_kernels import surface_at
from labapp.core.values import FloatArray

_f, _i = types.float64, types.int64
_f1, _f2, _f3 = (types.Array(_f, n, "A", readonly=True) for n in (1, 2, 3))
_lower = types.Array(_f, 2, "F", readonly=True)
_own = types.Tuple((_f1, _f2, _f2))  # type: ignore[no-untyped-call]
_moved = types.Tuple((_f2, _f3, _f3, _f3))  # type: ignore[no-untyped-call]


@_compiled(_f2, _f1, _lower, _f2, _f3, _own, _moved, _i)
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
    start, rises = np.empty_like(points), np.empty_like(points)
    for k in range(len(lasers)):
        for n in range(len(points)):
            along = (points[n, 2] - lasers[k, 2]) / rays[k, n, 2]
            start[n] = lasers[k] + along * rays[k, n]
        there, _ = newton_along_rays(grid, coefficients, rays[k], start, 2)
        _, slope_x, slope_y = surface_at(grid, coefficients, there)
        for n in range(len(points)):
            x, y, z = rays[k, n]
            rises[n] = rays[k, n] / (z - slope_x[n] * x - slope_y[n] * y)
        seen = lasers[k], planes[k], moved_dots[k]
        for _ in range(rounds):
            raised = surface_at(grid, changes[k], there)[0].copy().reshape(-1, 1)
            at = there + raised * rises
            asked = gradient_rhs(grid, coefficients, at, weights, *seen)
            change = solve(lower, (asked - base).reshape(1, -1))[0]
            # Slopes do not determine the level.
            changes[k] = change - surface_at(grid, change, there)[0].mean()
    return changes
