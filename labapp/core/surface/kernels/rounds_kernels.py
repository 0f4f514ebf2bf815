"""The rounds of the fit with their level, compiled.

Arguments have the meanings that the package gives.
"""

from __future__ import annotations

import numpy as np
from numba import types

from labapp.core.compiled import BAND, BOOLS_1, FLOATS_1, FLOATS_2, FLOATS_3, INTS_1
from labapp.core.compiled import compiled as _compiled
from labapp.core.compiled import inner as _inner
from labapp.core.surface.kernels.level_kernels import find_level, guess_level
from labapp.core.surface.kernels.solver_kernels import fit_step, newton_along_rays, normal_factor
from labapp.core.surface.kernels.spline_kernels import surface_at
from labapp.core.values import BoolArray, FloatArray, IntArray

_fit = types.Tuple((BAND, FLOATS_2, FLOATS_3, FLOATS_1, FLOATS_2, FLOATS_2))  # type: ignore[no-untyped-call]
_state = types.Tuple((FLOATS_1, FLOATS_1, FLOATS_2, BAND))  # type: ignore[no-untyped-call]
_level_input = types.Tuple((BOOLS_1, FLOATS_2, INTS_1, FLOATS_1, FLOATS_1))  # type: ignore[no-untyped-call]

FIRST_REACH, LEVEL_REACH, REACH_SIGMAS = 0.4, 0.3, 6.0
"""Least reach of the search for the level (`find_level`) around that of a given surface, and around
that of the previous round; and the reach in σ of the level, if that is larger."""


@_inner
def _level_of_round(
    count: int,
    grid: FloatArray,
    coefficients: FloatArray,
    points: FloatArray,
    laser: FloatArray,
    level_input: tuple[BoolArray, FloatArray, IntArray, FloatArray, FloatArray],
    level: FloatArray,
    limits: FloatArray,
) -> FloatArray:
    """The level of a surface after a round, see `run_rounds`."""
    outer, landing, ray_states, sigma, spacing = level_input
    most, (head_sign, missing, drop_is_free, is_near) = limits[0], limits[5:9]
    if len(outer):
        shift, level_sigma, inner = guess_level(surface_at(grid, coefficients, points)[0], outer)
        pool_sign = 1.0 if inner + shift > 0.0 else -1.0
        return np.array([shift, level_sigma, pool_sign, 0.0, 0.0, -1.0, *np.zeros(5)])
    # The drop is fixed in the second half of the rounds, as the iteration may oscillate.
    is_held = drop_is_free == 0.0 or 2 * count > most
    there = surface_at(grid, coefficients, landing)
    height = np.empty((2, len(ray_states)))
    height[0], height[1] = there[0], sigma
    reach = LEVEL_REACH if count else FIRST_REACH
    if level[8] > 0.0:
        reach = min(max(reach, REACH_SIGMAS * level[1] / level[8]), 1.0)
    reach = reach if count or is_near != 0.0 else np.nan
    about = np.array([0.0, level[2], reach, level[3] if is_held else np.nan])
    bench = np.array([head_sign, laser[0], laser[1], laser[2]])
    seen = height, there[1:].T, landing, ray_states, spacing
    found = find_level(*seen, bench, about, missing)
    if is_held:
        if level[9] > 0.0:  # the part that is due to the uncertainty of the drop stays
            found[1] = np.hypot(found[1], level[10] / level[9])
        found[9:] = level[9:]
    return found


@_compiled(FLOATS_2, _fit, _state, _level_input, FLOATS_1, FLOATS_1)
def run_rounds(
    grid: FloatArray,
    fit: tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray, FloatArray],
    state: tuple[FloatArray, FloatArray, FloatArray, FloatArray],
    level_input: tuple[BoolArray, FloatArray, IntArray, FloatArray, FloatArray],
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
        Coefficients of the surface, and of the surface from which the roughness is counted
        (``smooth_about``), shape (p,); reflection points, shape (n, 3); factor of the normal
        matrix, of any value if not computed yet.
    level_input
        Mask of the outer points from which the level is guessed, shape (n,), or empty; landing
        points, shape (m, 3), +1 or −1, shape (m,), and uncertainty of the height there, shape (m,),
        of the known rays, and the spacing of all, shape (2,) (`level.KnownRays`). With neither an
        outer point nor a known ray the surface is not shifted.
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
    coefficients, smooth_about, points, factor = state
    most, until, steps, reuse, moved = limits[:5]
    is_new, with_level = 0.0, len(level_input[0]) + len(level_input[2]) > 0
    for count in range(int(most)):
        if not moved <= reuse:  # NaN, too
            made, has_one = normal_factor(grid, stiffness, points, weights)
            if not has_one:
                moved = np.nan
                break
            factor, is_new = made, 1.0
        from_smooth, bench = coefficients - smooth_about, (laser, plane)
        bands = stiffness, factor
        coefficients = fit_step(
            grid, bands, coefficients, from_smooth, points, weights, bench, dots
        )
        if with_level and not (count and abs(level[0]) < limits[9]):
            at = grid, coefficients, points, laser, level_input, level, limits
            level = _level_of_round(count, *at)
            coefficients += level[0]  # the splines add up to 1
        points, moved = newton_along_rays(grid, coefficients, rays, points, int(steps))
        if np.isnan(moved) or moved < until:
            break
    return coefficients, points, factor, level, np.array([moved, is_new])
