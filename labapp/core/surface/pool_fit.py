"""`fit_pool`: one smooth surface through all reflections; matching and the scheme fit use it.

An iterated linear least-squares fit. It begins with the work piece, z = 0, or with a surface that
is near. Each round

1. takes two slopes at each reflection point from the bisector of its ray and the direction to its
   dot (Eq. 4-3);
2. solves for the spline surface that best has these slopes, held smooth (`solver`);
3. shifts it to its level, which slopes leave open (`level`);
4. intersects the rays with it, which gives the next reflection points.

Slopes are weighted by the inverse of the covariance that the dots' places on the imaging plane give
them, so that it is the reflection residual there whose squares are least.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from labapp.core.geometry.optics import ProjectedRays, project_rays
from labapp.core.geometry.rig import Rig
from labapp.core.surface.level import Level, Rear, Witnesses, guess_level
from labapp.core.surface.solver import NormalEquations, Rounds, propagate_sigma
from labapp.core.surface.spline import SplineBasis, SplineSurface
from labapp.core.values import (
    BoolArray,
    CannotMeasure,
    FloatArray,
    IntArray,
    ReadOnlyArrays,
    median,
)

MARGIN_ROWS, LEAST_MARGIN_MM = 2.5, 2.0
"""How far beyond the outermost reflection points the splines go on: in rows of rays, and at least,
mm. Before the boundary is reached the torch may hide some, or dots miss the imaging plane: of a
dense pattern that is as wide a strip of the pool, and more rows."""

MOST_SPLINES = 3000
"""Rays that spread over more than these, 24 × 28 mm with knots 0.5 mm apart, are of no pool, but of
a laser set up ten times too far away. Time grows with the square, and hypotheses are many."""

CORRELATED_MM2 = 1.0
"""Area over which a pool's third derivatives are correlated, mm²."""

FIRST_REACH, LEVEL_REACH = 0.4, 0.3
"""Reach of the search for a level (`find_level`) near that of a surface nearby, and near that of
the round before."""

NEWTON_STEPS = 4
"""Steps from a reflection point to that on the surface of the next round."""


@dataclass(frozen=True)
class FitSettings:
    """Settings of the fit.

    Parameters
    ----------
    rounds
        Most rounds of the fit.
    knot_mm
        Spacing of the spline knots, mm.
    jerk
        Expected third derivatives of the surface, mm⁻²: the smaller, the smoother.
    floor_mm
        Added to the standard uncertainty of every dot on the imaging plane, in squares, mm.
    settled_mm
        The rounds end when no reflection point moves by more.
    """

    rounds: int = 12
    knot_mm: float = 0.7
    jerk: float = 0.05
    floor_mm: float = 0.01
    settled_mm: float = 1e-4


@dataclass(frozen=True)
class FittedPool(ReadOnlyArrays):
    """A fitted surface, where the n matched rays meet it, and how well it is known.

    Parameters
    ----------
    surface
        The surface, z = 0 at the boundary.
    factor
        Cholesky factor of the normal matrix (`solver.normal_factor`).
    level
        The level and its uncertainty.
    points_mm
        Reflection points, shape (n, 3), mm.
    residual_mm
        Computed minus captured dot on the imaging plane (X′, Z′), shape (n, 2), mm.
    unsettled_mm
        How far the reflection point that moved most moved in the last round, mm.
    """

    surface: SplineSurface
    factor: FloatArray
    level: Level
    points_mm: FloatArray
    residual_mm: FloatArray
    unsettled_mm: float

    @property
    def residual_rms_mm(self) -> float:
        """Root mean square distance of computed from captured dots, mm."""
        return float(np.sqrt(np.mean(np.sum(self.residual_mm**2, axis=-1))))

    @cached_property
    def mean_splines(self) -> FloatArray:
        """Mean value of each spline over the reflection points, shape (splines,)."""
        from labapp.core.surface.kernels import spline_kernels

        share = np.full(len(self.points_mm), 1 / len(self.points_mm))
        grid, count = self.surface.basis.grid, self.factor.shape[1]
        return spline_kernels.gradient_of_sum(grid, count, self.points_mm, share)

    def sigma_of(self, gradients: FloatArray) -> FloatArray:
        """Standard uncertainty of quantities, shape (m,), from their derivatives, shape (m, p)."""
        return propagate_sigma(self.factor, gradients, self.mean_splines, self.level.sigma_mm)

    def free_sigma_of(self, gradients: FloatArray) -> FloatArray:
        """The same without what the level adds."""
        return propagate_sigma(self.factor, gradients, self.mean_splines, 0.0)


def fit_pool(
    ray: IntArray,
    plane_mm: FloatArray,
    plane_covariance_mm2: FloatArray,
    witness: IntArray,
    rig: Rig,
    settings: FitSettings,
    initial: SplineSurface | None = None,
    missing: float = 0.0,
) -> FittedPool:
    """Fit the surface that turns each ray to its dot.

    Parameters
    ----------
    ray, plane_mm, plane_covariance_mm2, witness
        Of n matched pairs, see `Match`. Without a dark ray in ``witness`` the level is guessed.
    rig
        The bench.
    settings
        See `FitSettings`.
    initial
        A surface to begin with: fewer rounds are needed where it is near. None: z = 0.
    missing
        Probability that a ray that came back has no dot, for the level (`Match.missing`).

    Raises
    ------
    CannotMeasure
        ``no-surface`` if no surface can be fitted or it sends rays away from the plane.
    """
    from labapp.core.surface.kernels import solver_kernels

    rays, at = project_rays(rig.laser, rig.pattern), tuple(ray.T - 1)
    points = rays.landing_mm[at]
    basis = basis_around(points[:, :2], rays, settings.knot_mm)
    if basis.count > MOST_SPLINES:
        width, length = basis.high_mm - basis.low_mm
        raise CannotMeasure("no-surface", f"lit rays spread over {width:.0f} × {length:.0f} mm")
    equations = normal_equations(basis, rig, points, plane_mm, plane_covariance_mm2, settings)
    equations.reuse_mm = settings.floor_mm / 50
    if initial is not None:
        near = initial.basis.grid, initial.coefficients, rays.directions[at], points
        points, _ = solver_kernels.newton_along_rays(*near, NEWTON_STEPS)
    rounds = Rounds(equations, rays.directions[at], np.zeros(basis.count), points, np.inf)
    witnesses = Witnesses.of(rays, rig.head_sign, witness, basis, missing)
    outer = None if (witnesses.sign < 0).any() else _outer(rays.landing_mm[at][:, :2])
    until = settings.rounds, settings.settled_mm
    level = rounds_with_level(rounds, witnesses, *until, outer=outer)
    return fitted_pool(rounds, level, rig, plane_mm)


def normal_equations(
    basis: SplineBasis,
    rig: Rig,
    points_mm: FloatArray,
    plane_mm: FloatArray,
    plane_covariance_mm2: FloatArray,
    settings: FitSettings,
) -> NormalEquations:
    """Normal equations of n dots on the plane, shape (n, 2), whose rays meet the surface nearby.

    Points nearby have shape (n, 3); the others are as in `fit_pool`.
    """
    from labapp.core.surface.kernels import ray_kernels

    laser, plane = rig.laser.position_mm, rig.imaging_plane.pose_mm
    dots = rig.imaging_plane.to_universal(plane_mm)
    near = laser, plane, points_mm, dots
    weights = ray_kernels.slope_weights(*near, plane_covariance_mm2, settings.floor_mm)
    stiffness = basis.stiffness(CORRELATED_MM2 / settings.jerk**2)
    return NormalEquations(basis, stiffness, laser, plane, dots, weights)


def rounds_with_level(
    rounds: Rounds,
    witnesses: Witnesses,
    most: int,
    until_mm: float,
    near: Level | None = None,
    drop_is_free: bool = True,
    raised_mm: float = 0.0,
    outer: BoolArray | None = None,
) -> Level:
    """Run rounds of the fit, each with the level that the witnesses give; returns the last one.

    Parameters
    ----------
    rounds
        The fit, which is advanced.
    witnesses
        Rays that tell the level.
    most, until_mm
        See `Rounds.run`.
    near
        Level of a surface nearby, which the first search begins from. None: all are tried.
    drop_is_free
        Whether the drop of the rear is found along with the level, in the first half of the rounds.
        Held, it leaves the level as open as it was before.
    raised_mm
        After a shift of the surface by less the level is not looked for again.
    outer
        Which of the n reflection points lie far from their middle, shape (n,): the level is guessed
        from these, where no witness is dark (`guess_level`).

    Raises
    ------
    CannotMeasure
        ``no-surface`` if no surface has the slopes.
    """
    from labapp.core.surface.kernels import spline_kernels

    basis, level = rounds.equations.basis, near or Level(0.0, np.inf, 1, Rear(), 0.0)

    def shift(count: int) -> float:
        nonlocal level
        if count and abs(level.shift_mm) < raised_mm:
            return 0.0
        if outer is not None:
            height = spline_kernels.surface_at(basis.grid, rounds.coefficients, rounds.points_mm)[0]
            level = guess_level(height, outer)
            return level.shift_mm
        # The drop is held from half-way on, or the iteration may oscillate.
        is_held = not drop_is_free or 2 * count > most
        reach = LEVEL_REACH if count else FIRST_REACH
        found = witnesses.level(
            basis,
            rounds.coefficients,
            level.rear.drop_mm if is_held else None,
            (0.0, level.sign, reach) if count or near else None,
        )
        sigma = max(found.sigma_mm, level.sigma_mm) if is_held else found.sigma_mm
        level = replace(found, sigma_mm=sigma)
        return found.shift_mm

    rounds.run(most, until_mm, NEWTON_STEPS if near is None else 1, shift=shift)
    return level


def _outer(places_mm: FloatArray) -> BoolArray:
    """Which of n places, shape (n, 2), are farther from their middle than half of them."""
    from_middle = np.linalg.norm(places_mm - places_mm.mean(axis=0), axis=-1)
    return np.asarray(from_middle > median(from_middle))


def fitted_pool(rounds: Rounds, level: Level, rig: Rig, plane_mm: FloatArray) -> FittedPool:
    """Return what rounds with their level came to, for dots on the plane, shape (n, 2).

    Raises
    ------
    CannotMeasure
        ``no-surface`` if the surface sends rays away from the plane.
    """
    from labapp.core.surface.kernels import ray_kernels

    basis, plane = rounds.equations.basis, rig.imaging_plane.pose_mm
    at = basis.grid, rounds.coefficients, rounds.rays, rounds.points_mm
    points, _, computed = ray_kernels.intersect_and_reflect(*at, 1, plane)
    residual = computed - plane_mm
    if not np.isfinite(residual).all():
        raise CannotMeasure("no-surface", "the fitted surface sends rays away from the plane")
    assert rounds.equations.factor is not None
    surface = SplineSurface(basis, rounds.coefficients)
    return FittedPool(surface, rounds.equations.factor, level, points, residual, rounds.moved_mm)


def basis_around(places_mm: FloatArray, rays: ProjectedRays, knot_mm: float) -> SplineBasis:
    """Splines over places, shape (n, 2), mm, and as far beyond as a pool may go on.

    Parameters
    ----------
    places_mm
        Reflection points, and what else is to be covered.
    rays
        The rays, whose spacing the margin follows.
    knot_mm
        Spacing of the spline knots, mm.
    """
    margin = max(MARGIN_ROWS * rays.spacing_mm.max(), LEAST_MARGIN_MM)
    low, high = places_mm.min(axis=0) - margin, places_mm.max(axis=0) + margin
    return SplineBasis.over(low, high, knot_mm)
