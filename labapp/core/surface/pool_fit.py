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
    NO_SURFACE,
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

ROUGHNESS_FREEDOM = 100.0
"""Degrees of freedom with which the expected size of a surface's third derivatives is known."""


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
        Expected third derivatives of the surface, mm⁻²: the smaller, the smoother. Scheme fit
        takes larger ones for a surface that is rougher than expected.
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
    settings
        Settings of the fit.
    inverse
        Covariance of the coefficients within the band (`solver.inverse_of`), if computed.
    """

    surface: SplineSurface
    factor: FloatArray
    level: Level
    points_mm: FloatArray
    residual_mm: FloatArray
    unsettled_mm: float
    settings: FitSettings
    inverse: FloatArray | None = None

    @cached_property
    def residual_rms_mm(self) -> float:
        """Root mean square distance of computed from captured dots, mm."""
        return float(np.sqrt(np.sum(self.residual_mm**2) / len(self.residual_mm)))

    @cached_property
    def roughness_ratio(self) -> float:
        """Integral of the squared third derivatives over the expected one (`ROUGHNESS_FREEDOM`)."""
        return _roughness_weight(self.settings) * self.surface.roughness() / ROUGHNESS_FREEDOM

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
    from labapp.core.surface.kernels import fit_kernels

    rays = project_rays(rig.laser, rig.pattern)
    places = rays.landing_mm[tuple(match.ray.T - 1)][:, :2]
    # Before the splines are made: labels that hardly fit may spread over kilometres.
    low, high = _ends_around(places, rays)
    if not (np.ceil((high - low) / settings.knot_mm) + DEGREE).prod() <= MOST_SPLINES:
        width, length = high - low
        raise CannotMeasure("no-surface", f"lit rays spread over {width:.0f} × {length:.0f} mm")
    basis = SplineBasis.over(low, high, settings.knot_mm)
    coefficients, points, factor, found, residual, moved = fit_kernels.fit_pairs(
        (basis.grid, basis.roughness_matrix),
        match.ray,
        (rays.directions, rays.landing_mm),
        (match.plane_mm, match.plane_covariance_mm2),
        (rig.laser.position_mm, rig.imaging_plane.pose_mm),
        _near(initial),
        match.ray_states,
        _limits(settings, rays, rig.head_sign, match.missing),
    )
    if np.isnan(moved):
        raise CannotMeasure("no-surface", NO_SURFACE)
    surface, level = SplineSurface(basis, coefficients), Level.of(found)
    pool = FittedPool(surface, factor, level, points, residual, moved, settings)
    return _weighed(pool, match, rig, settings) if weigh_by_height_sigma else _on_plane(pool)


def _weighed(
    pool: FittedPool, match: Match | MatchedDots, rig: Rig, settings: FitSettings
) -> FittedPool:
    """Continue a fit, with less weight for the level of rays where the surface is uncertain."""
    rays, at, basis = project_rays(rig.laser, rig.pattern), match.ray.T - 1, pool.surface.basis
    known_rays = KnownRays.of(rig, match.ray_states, basis, match.missing)
    if not (known_rays.ray_states < 0).any():
        return _on_plane(pool)
    landing, directions = rays.landing_mm[tuple(at)], rays.directions[tuple(at)]
    seen = match.plane_mm, match.plane_covariance_mm2
    equations = normal_equations(basis, rig, landing, *seen, settings)
    equations.factor, equations.reuse_mm = pool.factor, REUSE_FLOORS * settings.floor_mm
    state = pool.surface.coefficients, pool.points_mm, pool.unsettled_mm
    rounds = Rounds(equations, directions, *state)
    sigma = rounds.height_sigma_mm(known_rays.landing_mm)
    search = LevelSearch(replace(known_rays, height_sigma_mm=sigma), pool.level)
    level = rounds.run(settings.rounds, settings.settled_mm, search=search)
    return fitted_pool(rounds, level, rig, match.plane_mm, settings)


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

    rays = project_rays(rig.laser, rig.pattern)
    sizes = least, MOST_SPLINES, _margin_mm(rays), settings.knot_mm
    return fit_kernels.misfits(
        labelled,
        (rays.directions, rays.landing_mm),
        (plane_mm, plane_covariance_mm2),
        (rig.laser.position_mm, rig.imaging_plane.pose_mm),
        _near(initial),
        cell_products(),
        np.array([*sizes, *_limits(settings, rays, rig.head_sign)]),
    )


def _near(initial: SplineSurface | None) -> tuple[FloatArray, FloatArray]:
    """Grid and coefficients of the surface to start from; no coefficients for z = 0."""
    if initial is None:
        return np.empty((2, 4)), np.empty(0)
    return initial.basis.grid, initial.coefficients


def _limits(
    settings: FitSettings, rays: ProjectedRays, head_sign: int, missing: float = 0.0
) -> FloatArray:
    """Limits of `fit_kernels.fit_pairs`."""
    fit = _roughness_weight(settings), settings.floor_mm, *rays.spacing_mm.tolist()
    rounds = (
        settings.rounds,
        settings.settled_mm,
        NEWTON_STEPS,
        REUSE_FLOORS * settings.floor_mm,
        np.nan,
    )
    return np.array([*fit, *rounds, head_sign, missing, 1.0, 0.0, 0.0])


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


def fitted_pool(
    rounds: Rounds, level: Level, rig: Rig, plane_mm: FloatArray, settings: FitSettings
) -> FittedPool:
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
    assert rounds.equations.factor is not None
    return _on_plane(
        FittedPool(
            surface=SplineSurface(basis, rounds.coefficients),
            factor=rounds.equations.factor,
            level=level,
            points_mm=points,
            residual_mm=computed - plane_mm,
            unsettled_mm=rounds.moved_mm,
            settings=settings,
            inverse=rounds.equations.known_inverse,
        )
    )


def _on_plane(pool: FittedPool) -> FittedPool:
    """Return a fit that sends all its rays to the plane; raise ``no-surface`` if it does not."""
    if not np.isfinite(pool.residual_mm).all():
        raise CannotMeasure("no-surface", "the fitted surface sends rays away from the plane")
    return pool


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
    return SplineBasis.over(*_ends_around(places_mm, rays), knot_mm)


def _ends_around(places_mm: FloatArray, rays: ProjectedRays) -> tuple[FloatArray, FloatArray]:
    """Low and high ends of the splines over places, shape (n, 2), with a margin; shape (2,), mm."""
    margin = _margin_mm(rays)
    return places_mm.min(axis=0) - margin, places_mm.max(axis=0) + margin


def _margin_mm(rays: ProjectedRays) -> float:
    """Margin of the splines beyond the outermost reflection points, mm."""
    return max(MARGIN_ROWS * float(rays.spacing_mm.max()), LEAST_MARGIN_MM)


def _roughness_weight(settings: FitSettings) -> float:
    """Weight of the roughness of a surface, mm⁶."""
    return CORRELATED_MM2 / settings.jerk**2
