"""The rounds of the fit with their level, compiled (docs/adr/0018).

Arguments mean the same as in `solver_kernels`.
"""

from __future__ import annotations

import numpy as np
from numba import types

from labapp.core.compiled import compiled as _compiled
from labapp.core.compiled import inner as _inner
from labapp.core.surface.kernels.level_kernels import find_level, guess_level
from labapp.core.surface.kernels.solver_kernels import fit_step, newton_along_rays, normal_factor
from labapp.core.surface.kernels.spline_kernels import surface_at
from labapp.core.values import BoolArray, FloatArray, IntArray

_f, _i = types.float64, types.int64
_f1, _f2, _f3 = (types.Array(_f, n, "A", readonly=True) for n in (1, 2, 3))
_i1 = types.Array(_i, 1, "A", readonly=True)
_b1 = types.Array(types.boolean, 1, "A", readonly=True)
_lower = types.Array(_f, 2, "F", readonly=True)
_fit = types.Tuple((_lower, _f2, _f3, _f1, _f2, _f2))  # type: ignore[no-untyped-call]
_state = types.Tuple((_f1, _f1, _f2, _lower))  # type: ignore[no-untyped-call]
_witnesses = types.Tuple((_b1, _f2, _i1, _f1, _f1))  # type: ignore[no-untyped-call]

FIRST_REACH, LEVEL_REACH, REACH_SIGMAS = 0.4, 0.3, 6.0
"""Least reach of the search for the level (`find_level`) around that of a given surface, and around
that of the previous round; and the reach in σ of the level, if that is larger."""


@_inner
def _level_of_round(
    count: int,
    grid: FloatArray,
    coefficients: FloatArray,
    points: FloatArray,
    witnesses: tuple[BoolArray, FloatArray, IntArray, FloatArray, FloatArray],
    level: FloatArray,
    limits: FloatArray,
) -> FloatArray:
    """The level of a surface after a round, see `run_rounds`."""
    outer, landing, sign, sigma, spacing = witnesses
    most, (head_sign, missing, drop_is_free, is_near) = limits[0], limits[5:9]
    if len(outer):
        shift, level_sigma, inner = guess_level(surface_at(grid, coefficients, points)[0], outer)
        side = 1.0 if inner + shift > 0.0 else -1.0
        return np.array([shift, level_sigma, side, 0.0, 0.0, -1.0, *np.zeros(5)])
    # The drop is fixed in the second half of the rounds, as the iteration may oscillate.
    is_held = drop_is_free == 0.0 or 2 * count > most
    there = surface_at(grid, coefficients, landing)
    height = np.empty((2, len(sign)))
    height[0], height[1] = there[0], sigma
    reach = LEVEL_REACH if count else FIRST_REACH
    if level[8] > 0.0:
        reach = min(max(reach, REACH_SIGMAS * level[1] / level[8]), 1.0)
    about = np.array([0.0, level[2], reach if count or is_near != 0.0 else np.nan])
    rear = np.array([head_sign, level[3] if is_held else np.nan])
    seen = height, there[1:].T, landing[:, 1], sign, spacing
    found = find_level(*seen, rear, about, missing)
    if is_held:
        found[1], found[9:] = max(found[1], level[1]), level[9:]
    return found


@_compiled(_f2, _fit, _state, _witnesses, _f1, _f1)
def run_rounds(
    grid: FloatArray,
    fit: tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray, FloatArray],
    state: tuple[FloatArray, FloatArray, FloatArray, FloatArray],
    witnesses: tuple[BoolArray, FloatArray, IntArray, FloatArray, FloatArray],
    level: FloatArray,
    limits: FloatArray,
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]:
    """Rounds of a fit until no reflection point moves (`solver.Rounds.run`).

    Parameters
    ----------
    grid
        The p splines.
    fit
        Stiffness, lower band, rays, shape (n, 3), weights, shape (n, 2, 2), laser, plane, and dots,
        shape (n, 3).
    state
        Coefficients of the surface and of the one that it is held close to, shape (p,); reflection
        points, shape (n, 3); factor of the normal matrix, of any value if not computed yet.
    witnesses
        Mask of the outer points from which the level is guessed, shape (n,), or empty; landing
        points, shape (m, 3), signs, shape (m,), and uncertainty of the height there, shape (m,), of
        the witnesses, and the spacing of the rays, shape (2,) (`level.Witnesses`). With neither an
        outer point nor a witness the surface is not shifted.
    level
        Level before (`level_kernels.find_level`), shape (11,).
    limits
        Maximum number of rounds; displacement, mm, of the reflection points below which they end;
        Newton steps of a round; displacement up to which the factor is reused; the displacement in
        the last round, NaN without a factor; the side of the head, share of missing dots, whether
        the drop is found, and whether the level before is close; and the shift below which the
        level is not determined again.

    Returns
    -------
    coefficients, points, factor, level, moved
        The state after the rounds, and two values: the largest displacement in the last round, NaN
        without a surface, and 1 for a new factor.
    """
    stiffness, rays, weights, laser, plane, dots = fit
    coefficients, smooth, points, factor = state
    most, until, steps, reuse, moved = limits[:5]
    is_new, with_level = 0.0, len(witnesses[0]) + len(witnesses[2]) > 0
    for count in range(int(most)):
        if not moved <= reuse:  # NaN, too
            made, has_one = normal_factor(grid, stiffness, points, weights)
            if not has_one:
                moved = np.nan
                break
            factor, is_new = made, 1.0
        rough, bench = coefficients - smooth, (laser, plane)
        bands = stiffness, factor
        coefficients = fit_step(grid, bands, coefficients, rough, points, weights, bench, dots)
        if with_level and not (count and abs(level[0]) < limits[9]):
            at = grid, coefficients, points, witnesses, level, limits
            level = _level_of_round(count, *at)
            coefficients += level[0]  # the splines add up to 1
        points, moved = newton_along_rays(grid, coefficients, rays, points, int(steps))
        if np.isnan(moved) or moved < until:
            break
    return coefficients, points, factor, level, np.array([moved, is_new])
