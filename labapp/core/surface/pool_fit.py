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

from labapp.core.geometry.optics import intersect_level, ray_directions
from labapp.core.geometry.rig import Rig
from labapp.core.surface.level import Level, Rear, find_level, guess_level
from labapp.core.surface.solver import NormalEquations, propagate_sigma
from labapp.core.surface.spline import SplineBasis, SplineSurface
from labapp.core.values import CannotMeasure, FloatArray, IntArray, ReadOnlyArrays, median

MARGIN_ROWS = 2.5
"""How far beyond the outermost reflection points the splines go on, in rows of rays: the torch may
hide some before the boundary is reached."""

CORRELATED_MM2 = 1.0
"""Area over which a pool's third derivatives are correlated, mm²."""

LEVEL_REACH = 0.3
"""Reach of the search for a level (`find_level`) near that of the round before."""

NEWTON_STEPS = 4
"""Steps from a reflection point to that on the surface of the next round."""


@dataclass(frozen=True)
class FitSettings:
    """How the fit decides.

    Parameters
    ----------
    rounds
        Most rounds of the fit.
    knot_mm
        Spacing of the spline knots, mm.
    jerk
        Third derivatives of the surface that are to be expected, mm⁻²: the smaller, the smoother.
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
        from labapp.core.surface import kernels

        share = np.full(len(self.points_mm), 1 / len(self.points_mm))
        grid, count = self.surface.basis.grid, self.factor.shape[1]
        return kernels.gradient_of_sum(grid, count, self.points_mm, share)

    def sigma_of(self, gradients: FloatArray) -> FloatArray:
        """Standard uncertainty of quantities, shape (m,), from their derivatives, shape (m, p)."""
        return propagate_sigma(self.factor, gradients, self.mean_splines, self.level.sigma_mm)


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
    from labapp.core.surface import kernels

    laser, plane = rig.laser.position_mm, rig.imaging_plane.pose_mm
    pattern = ray_directions(rig.laser, rig.pattern)
    ground = intersect_level(laser, pattern)
    rays, points = pattern[tuple(ray.T - 1)], ground[tuple(ray.T - 1)]
    spacing = landing_spacing(ground)
    basis = _basis_around(points[:, :2], MARGIN_ROWS * spacing.max(), settings.knot_mm)
    grid, covariance = basis.grid, plane_covariance_mm2
    witnesses = (witness != 0) & basis.contains(ground[..., 0], ground[..., 1])
    stiffness = CORRELATED_MM2 / settings.jerk**2 * basis.roughness
    dots = rig.imaging_plane.to_universal(plane_mm)
    weights = kernels.slope_weights(laser, plane, points, dots, covariance, settings.floor_mm)
    reuse = settings.floor_mm / 50
    equations = NormalEquations(basis, stiffness, laser, plane, dots, weights, reuse_mm=reuse)
    from_middle = np.linalg.norm(points[:, :2] - points[:, :2].mean(axis=0), axis=-1)
    outer = from_middle > median(from_middle)
    coefficients, moved = np.zeros(basis.count), np.inf
    if initial is not None:
        at = initial.basis.grid, initial.coefficients, rays, points
        points, _ = kernels.newton_along_rays(*at, NEWTON_STEPS)
    level = Level(0.0, np.inf, 1, Rear(), 0.0)
    for count in range(settings.rounds):
        coefficients = equations.step(coefficients, points, moved)
        if not (witness[witnesses] < 0).any():
            level = guess_level(kernels.surface_at(grid, coefficients, points)[0], outer)
        else:
            # The drop of the rear is held from half-way on, or the rounds might go to and fro.
            drop = None if 2 * count <= settings.rounds else level.rear.drop_mm
            height, *slope = kernels.surface_at(grid, coefficients, ground[witnesses])
            about = (0.0, level.sign, LEVEL_REACH) if count else None
            before = level
            seen = np.array(slope).T, ground[witnesses, 1], witness[witnesses], spacing
            level = find_level(height, *seen, (rig.head_sign, drop), about, missing)
            if drop is not None:  # a drop that is held leaves the level as open as a free one
                level = replace(level, sigma_mm=max(level.sigma_mm, before.sigma_mm))
        coefficients += level.shift_mm  # the splines add up to 1
        if not np.isfinite(coefficients).all():
            raise CannotMeasure("no-surface", "no surface has the slopes that the dots ask for")
        met, _ = kernels.newton_along_rays(grid, coefficients, rays, points, NEWTON_STEPS)
        moved, points = float(np.max(np.abs(met - points))), met
        if moved < settings.settled_mm:
            break
    points, _, computed = kernels.intersect_and_reflect(grid, coefficients, rays, points, 1, plane)
    residual = computed - plane_mm
    if not np.isfinite(residual).all():
        raise CannotMeasure("no-surface", "the fitted surface sends rays away from the plane")
    surface = SplineSurface(basis, coefficients)
    assert equations.factor is not None
    return FittedPool(surface, equations.factor, level, points, residual, moved)


def _basis_around(places_mm: FloatArray, margin_mm: float, knot_mm: float) -> SplineBasis:
    """Splines over places, shape (n, 2), mm, and a margin round them."""
    low, high = places_mm.min(axis=0) - margin_mm, places_mm.max(axis=0) + margin_mm
    return SplineBasis.over(low, high, knot_mm)


def landing_spacing(landing_mm: FloatArray) -> FloatArray:
    """Distance between neighbours of a grid of landing points along X and along Y, (2,), mm."""
    across = np.median(np.diff(landing_mm[..., 0], axis=1))
    along = np.median(np.diff(landing_mm[..., 1], axis=0))
    return np.asarray(np.abs([across, along]), float)
