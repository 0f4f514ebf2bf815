"""Fit of one smooth surface to all reflections, for the matching and for the scheme fit.

The fit is an iterated linear least-squares problem. It starts from the work piece, z = 0, or from a
given surface. Each round

1. computes two slopes at each reflection point from the bisector of its ray and the direction to
   its dot (Eq. 4-3);
2. solves for the smooth spline surface that fits these slopes best (`solver`);
3. shifts it to its level, which slopes do not determine (`level`);
4. intersects the rays with it, which gives the next reflection points.

Slopes are weighted by the inverse of their covariance, propagated from that of the dots on the
imaging plane, so that the sum of squared residuals on the imaging plane is minimised.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from labapp.core.geometry.optics import ProjectedRays, project_rays
from labapp.core.geometry.rig import Rig
from labapp.core.match import Match, MatchedDots
from labapp.core.surface.level import KnownRays, Level, LevelSearch
from labapp.core.surface.solver import (
    NEWTON_STEPS,
    NormalEquations,
    Rounds,
    height_sigma,
    inverse_of,
    mean_splines,
    propagate_sigma,
)
from labapp.core.surface.spline import DEGREE, SplineBasis, SplineSurface, cell_products
from labapp.core.values import CannotMeasure, FloatArray, IntArray, ReadOnlyArrays

MARGIN_ROWS, LEAST_MARGIN_MM = 2.5, 2.0
"""Margin of the splines beyond the outermost reflection points, in rows of rays, and its minimum,
mm. Between these points and the boundary the torch may hide dots, or dots may miss the imaging
plane; this strip of the pool has the same width for a dense pattern, but more rows."""

MOST_SPLINES = 3000
"""Maximum number of splines, 24 × 28 mm with knots 0.5 mm apart. Rays that spread over more are not
those of a pool, but of a laser set up ten times too far away. The time grows with the square of the
number, and there are many hypotheses."""

REUSE_FLOORS = 1 / 50
"""`NormalEquations.reuse_mm` of a fit over `FitSettings.floor_mm`, the least σ of the dots, on
which the largest harmless value depends."""

CORRELATED_MM2 = 1.0
"""Area over which a pool's third derivatives are correlated, mm²."""


@dataclass(frozen=True)
class FitSettings:
    """Settings of the fit.

    Parameters
    ----------
    rounds
        Maximum number of rounds of the fit.
    knot_mm
        Spacing of the spline knots, mm.
    jerk
        Expected third derivatives of the surface, mm⁻²: the smaller, the smoother.
    floor_mm
        Added in quadrature to the standard uncertainty of every dot on the imaging plane, mm.
    settled_mm
        The rounds end when no reflection point moves by more, mm.
    """

    rounds: int = 12
    knot_mm: float = 0.7
    jerk: float = 0.05
    floor_mm: float = 0.01
    settled_mm: float = 1e-4


@dataclass(frozen=True)
class FittedPool(ReadOnlyArrays):
    """A fitted surface, its n reflection points, and its uncertainty.

    Parameters
    ----------
    surface
        The surface, z = 0 at the boundary, except at a rear below the work piece (`Level.rear`).
    factor
        Cholesky factor of the normal matrix (`solver.normal_factor`).
    level
        The level and its uncertainty.
    points_mm
        Reflection points, shape (n, 3), mm.
    residual_mm
        Computed minus captured dot on the imaging plane (X′, Z′), shape (n, 2), mm.
    unsettled_mm
        Largest displacement of a reflection point in the last round, mm.
    inverse
        Covariance of the coefficients within the band (`solver.inverse_of`), if computed.
    """

    surface: SplineSurface
    factor: FloatArray
    level: Level
    points_mm: FloatArray
    residual_mm: FloatArray
    unsettled_mm: float
    inverse: FloatArray | None = None

    @cached_property
    def residual_rms_mm(self) -> float:
        """Root mean square distance of computed from captured dots, mm."""
        return float(np.sqrt(np.sum(self.residual_mm**2) / len(self.residual_mm)))

    @cached_property
    def mean_splines(self) -> FloatArray:
        """Mean value of each spline over the reflection points, shape (splines,)."""
        return mean_splines(self.surface.basis, self.points_mm)

    def sigma_of(self, gradients: FloatArray) -> FloatArray:
        """Standard uncertainty of quantities apart from the level (`propagate_sigma`)."""
        return propagate_sigma(self.factor, gradients, self.mean_splines)

    def height_sigma_mm(self, places_mm: FloatArray) -> FloatArray:
        """Standard uncertainty of the height at m places, apart from the level, shape (m,), mm."""
        inverse = inverse_of(self.factor) if self.inverse is None else self.inverse
        return height_sigma(self.surface.basis, self.factor, inverse, self.mean_splines, places_mm)


def fit_pool(
    match: Match | MatchedDots,
    rig: Rig,
    settings: FitSettings,
    initial: SplineSurface | None = None,
    *,
    weigh_by_height_sigma: bool = False,
) -> FittedPool:
    """Fit the surface that reflects each ray to its dot.

    Parameters
    ----------
    match
        The n matched pairs. Without a dark ray in its ``ray_states`` the level is guessed.
    initial
        A surface to start from: fewer rounds are needed if it is close. None: z = 0.
    weigh_by_height_sigma
        Whether rays count less for the level where the surface is uncertain, which takes longer.

    Raises
    ------
    CannotMeasure
        ``no-surface`` if no surface can be fitted or it sends rays away from the plane.
    """
    from labapp.core.surface.kernels import ray_kernels, solver_kernels

    rays = project_rays(rig.laser, rig.pattern)
    directions, points, is_outer = ray_kernels.rays_of_pairs(
        match.ray, rays.directions, rays.landing_mm
    )
    # Before the splines are made: labels that hardly fit may spread over kilometres.
    size_mm = np.ptp(points[:, :2], axis=0) + 2 * _margin_mm(rays)
    if not np.prod(np.ceil(size_mm / settings.knot_mm) + DEGREE) <= MOST_SPLINES:
        width, length = size_mm
        raise CannotMeasure("no-surface", f"lit rays spread over {width:.0f} × {length:.0f} mm")
    basis = basis_around(points[:, :2], rays, settings.knot_mm)
    equations = normal_equations(
        basis, rig, points, match.plane_mm, match.plane_covariance_mm2, settings
    )
    equations.reuse_mm = REUSE_FLOORS * settings.floor_mm
    if initial is not None:
        points, _ = solver_kernels.newton_along_rays(
            initial.basis.grid, initial.coefficients, directions, points, NEWTON_STEPS
        )
    rounds = Rounds(equations, directions, np.zeros(basis.count), points, np.inf)
    known_rays = KnownRays.of(rig, match.ray_states, basis, match.missing)
    outer = None if (known_rays.ray_states < 0).any() else is_outer
    most, until_mm = settings.rounds, settings.settled_mm
    level = rounds.run(most, until_mm, search=LevelSearch(known_rays, outer=outer))
    if weigh_by_height_sigma and outer is None:
        sigma = rounds.height_sigma_mm(known_rays.landing_mm)
        known_rays = replace(known_rays, height_sigma_mm=sigma)
        level = rounds.run(most, until_mm, search=LevelSearch(known_rays, level))
    return fitted_pool(rounds, level, rig, match.plane_mm)


def misfits(
    labelled: IntArray,
    plane_mm: FloatArray,
    plane_covariance_mm2: FloatArray,
    rig: Rig,
    settings: FitSettings,
    initial: SplineSurface | None = None,
    *,
    least: int,
) -> FloatArray:
    """Residuals of fits to many sets of labels, in less time than with `fit_pool`.

    Parameters
    ----------
    labelled
        For each set, the index of each ray's dot, negative if it has none, shape (k, rows,
        columns).
    plane_mm, plane_covariance_mm2
        The n dots on the plane, shape (n, 2), mm, and their covariance, shape (n, 2, 2), mm².
    rig, settings, initial
        See `fit_pool`. The level is guessed.
    least
        Minimum number of labelled dots.

    Returns
    -------
    FloatArray
        Root mean square distance of computed from captured dots, shape (k,), mm; infinite if a set
        has too few labels or no surface can be fitted.
    """
    from labapp.core.surface.kernels import fit_kernels

    rays, flat = project_rays(rig.laser, rig.pattern), (np.empty((2, 4)), np.empty(0))
    weight, reuse_mm = _roughness_weight(settings), REUSE_FLOORS * settings.floor_mm
    fit = MOST_SPLINES, _margin_mm(rays), settings.knot_mm, weight, settings.floor_mm
    rounds = settings.rounds, settings.settled_mm, NEWTON_STEPS, reuse_mm
    return fit_kernels.misfits(
        labelled,
        (rays.directions, rays.landing_mm),
        (plane_mm, plane_covariance_mm2),
        (rig.laser.position_mm, rig.imaging_plane.pose_mm),
        flat if initial is None else (initial.basis.grid, initial.coefficients),
        cell_products(),
        np.array([least, *fit, *rounds], float),
    )


def normal_equations(
    basis: SplineBasis,
    rig: Rig,
    points_mm: FloatArray,
    plane_mm: FloatArray,
    plane_covariance_mm2: FloatArray,
    settings: FitSettings,
) -> NormalEquations:
    """Normal equations of n dots on the plane, shape (n, 2), for approximate reflection points.

    These points have shape (n, 3); the other parameters are those of `fit_pool`.
    """
    from labapp.core.surface.kernels import ray_kernels

    laser, plane = rig.laser.position_mm, rig.imaging_plane.pose_mm
    dots = rig.imaging_plane.to_universal(plane_mm)
    weights = ray_kernels.slope_weights(
        laser, plane, points_mm, dots, plane_covariance_mm2, settings.floor_mm
    )
    stiffness = _roughness_weight(settings) * basis.roughness_matrix
    return NormalEquations(basis, stiffness, laser, plane, dots, weights)


def fitted_pool(rounds: Rounds, level: Level, rig: Rig, plane_mm: FloatArray) -> FittedPool:
    """Build the result of rounds with their level, for dots on the plane, shape (n, 2).

    Raises
    ------
    CannotMeasure
        ``no-surface`` if the surface sends rays away from the plane.
    """
    from labapp.core.surface.kernels import ray_kernels

    basis, plane = rounds.equations.basis, rig.imaging_plane.pose_mm
    points, _, computed = ray_kernels.intersect_and_reflect(
        basis.grid, rounds.coefficients, rounds.rays, rounds.points_mm, 1, plane
    )
    residual = computed - plane_mm
    if not np.isfinite(residual).all():
        raise CannotMeasure("no-surface", "the fitted surface sends rays away from the plane")
    assert rounds.equations.factor is not None
    return FittedPool(
        surface=SplineSurface(basis, rounds.coefficients),
        factor=rounds.equations.factor,
        level=level,
        points_mm=points,
        residual_mm=residual,
        unsettled_mm=rounds.moved_mm,
        inverse=rounds.equations.known_inverse,
    )


def basis_around(places_mm: FloatArray, rays: ProjectedRays, knot_mm: float) -> SplineBasis:
    """Splines over places, shape (n, 2), mm, with a margin for the rest of the pool.

    Parameters
    ----------
    places_mm
        Reflection points, and other places to be covered.
    rays
        The rays, whose spacing determines the margin.
    knot_mm
        Spacing of the spline knots, mm.
    """
    margin = _margin_mm(rays)
    low, high = places_mm.min(axis=0) - margin, places_mm.max(axis=0) + margin
    return SplineBasis.over(low, high, knot_mm)


def _margin_mm(rays: ProjectedRays) -> float:
    """Margin of the splines beyond the outermost reflection points, mm."""
    return max(MARGIN_ROWS * float(rays.spacing_mm.max()), LEAST_MARGIN_MM)


def _roughness_weight(settings: FitSettings) -> float:
    """Weight of the roughness of a surface, mm⁶."""
    return CORRELATED_MM2 / settings.jerk**2
