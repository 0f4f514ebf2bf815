"""The set-up's part of the uncertainty of sizes, by linear propagation (JCGM 100, 5.1.2).

The bench is perturbed by each column of a square root of its covariance, with the rays and the
witnesses of the fit. A column is the standard uncertainty of a quantity or, if quantities are
correlated, one of the independent error components. The surface responds linearly: its coefficients
solve the normal equations, so that their change follows from that of the right-hand side (implicit
differentiation). The level depends on few rays and responds in steps: it is determined again with
the bench perturbed by plus and minus one standard uncertainty, and half the difference is used.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from labapp.core.geometry.optics import intersect_level, project_rays
from labapp.core.geometry.perturbation import aimed_as, moved_dots, moved_rig
from labapp.core.geometry.rig import Rig
from labapp.core.match import Match
from labapp.core.surface.level import Witnesses
from labapp.core.surface.pool_fit import FitSettings, FittedPool, normal_equations
from labapp.core.surface.solver import NormalEquations, height_sigma, normal_factor
from labapp.core.values import FloatArray, IntArray

ROUNDS = 3
"""Rounds in which the reflection points follow the surface: the remaining error is 0.1 %."""

SHARE = 1e-4
"""Share of a column by which the bench is perturbed for the change of the right-hand side: if
reflection points move far from those of the factor, weakly determined modes diverge. For the same
reason the factor of the fit is not used, which followed frames reuse while points hardly move."""

NEWTON_STEPS = 8
"""Newton steps from the landing point of a ray on the work piece to the surface."""

Perturbed = tuple[Rig, FloatArray]
"""A rig, and the dots on its imaging plane, shape (n, 2), mm."""

REACH = 0.6
"""Reach of the search for the level (`find_level`) around that of the unperturbed surface."""


def setup_changes(
    match: Match, rig: Rig, settings: FitSettings, pool: FittedPool, gradient: FloatArray
) -> FloatArray:
    """Changes of sizes due to each independent error component of the bench.

    Parameters
    ----------
    match, rig, settings
        Input of the fit.
    pool
        Result of the fit, with p splines.
    gradient
        Derivatives of m sizes by the spline coefficients, shape (m, p).

    Returns
    -------
    FloatArray
        Shape (m, q), in the units of the sizes, one column per column of `RigUncertainty.root`; q
        is 0 if the rig is known exactly.
    """
    known = rig.uncertainty
    if known is None:
        return np.zeros((len(gradient), 0))
    changes = np.zeros((len(gradient), len(known.root)))
    off = np.flatnonzero(known.root.any(axis=0)).tolist()
    dots = match.plane_mm, match.plane_covariance_mm2
    benches = [perturbed(rig, SHARE * known.root[:, k], match.plane_mm) for k in off]
    equations = _factorised(*dots, rig, settings, pool)
    change = _response(match.ray, equations, pool, benches) / SHARE
    basis, about = pool.surface.basis, (0.0, pool.level.sign, REACH)
    own = project_rays(rig.laser, rig.pattern)
    x, y = own.landing_mm[..., 0], own.landing_mm[..., 1]
    seen = (match.witness != 0) & basis.contains(x, y)
    landing, sign = own.landing_mm[seen], match.witness[seen]
    assert equations.factor is not None
    solved = equations.factor, equations.inverse, pool.mean_splines
    sigma, limits = height_sigma(basis, *solved, landing), (rig.head_sign, match.missing)
    for k, by, (moved, _) in zip(off, change.T, benches, strict=True):
        aside = (project_rays(moved.laser, moved.pattern).landing_mm[seen] - landing) / SHARE
        more, less = (
            Witnesses(landing + way * aside, sign, own.spacing_mm, *limits, sigma)
            .level(basis, pool.surface.coefficients + way * by, pool.level.rear.drop_mm, about)
            .shift_mm
            for way in (1.0, -1.0)
        )
        changes[:, k] = gradient @ (by + (more - less) / 2)
    return changes


def residual_changes(
    ray: IntArray,
    plane_mm: FloatArray,
    plane_covariance_mm2: FloatArray,
    rig: Rig,
    settings: FitSettings,
    pool: FittedPool,
) -> FloatArray:
    """Changes of a fit's residuals due to each independent error component of the bench.

    The surface is refitted. Rays, dots and covariance are those of n pairs, see `Match`; the rig
    must have an uncertainty.

    Returns
    -------
    FloatArray
        Shape (n, 2, q), mm, with one entry per column of `RigUncertainty.root`.
    """
    from labapp.core.surface.kernels import ray_kernels

    assert rig.uncertainty is not None
    root, at, surface = rig.uncertainty.root, tuple(ray.T - 1), pool.surface
    off = np.flatnonzero(root.any(axis=0)).tolist()
    benches = [perturbed(rig, SHARE * root[:, k], plane_mm) for k in off]
    equations = _factorised(plane_mm, plane_covariance_mm2, rig, settings, pool)
    change = _response(ray, equations, pool, benches)
    changes = np.zeros((*plane_mm.shape, len(root)))
    for k, by, (moved, dots_mm) in zip(off, change.T, benches, strict=True):
        rays, plane = project_rays(moved.laser, moved.pattern), moved.imaging_plane.pose_mm
        met = rays.directions[at], rays.landing_mm[at], NEWTON_STEPS, plane
        coefficients = surface.coefficients + by
        computed = ray_kernels.intersect_and_reflect(surface.basis.grid, coefficients, *met)[2]
        changes[..., k] = (computed - dots_mm - pool.residual_mm) / SHARE
    return changes


def _factorised(
    plane_mm: FloatArray,
    plane_covariance_mm2: FloatArray,
    rig: Rig,
    settings: FitSettings,
    pool: FittedPool,
) -> NormalEquations:
    """Normal equations with a factor for the final reflection points (see `SHARE`)."""
    basis, points = pool.surface.basis, pool.points_mm
    own = normal_equations(basis, rig, points, plane_mm, plane_covariance_mm2, settings)
    own.factor = normal_factor(basis, own.stiffness, points, own.weights)
    return own


def _response(
    ray: IntArray, own: NormalEquations, pool: FittedPool, benches: Sequence[Perturbed]
) -> FloatArray:
    """Changes of a fit's p coefficients for q slightly perturbed benches, shape (p, q), mm."""
    from labapp.core.surface.kernels import solver_kernels, spline_kernels

    points, surface = pool.points_mm, pool.surface
    grid, coefficients, at = surface.basis.grid, surface.coefficients, tuple(ray.T - 1)
    factor = own.factor
    assert factor is not None

    def right_side(
        points_mm: FloatArray, laser_mm: FloatArray, plane: FloatArray, dots_mm: FloatArray
    ) -> FloatArray:
        """Right-hand side of the equations for the given surface, shape (p,)."""
        at = grid, coefficients, points_mm, own.weights
        return solver_kernels.gradient_rhs(*at, laser_mm, plane, dots_mm)

    base = right_side(points, own.laser_mm, own.plane, own.dots_mm)
    changes = np.zeros((len(benches), len(coefficients)))
    for k, (moved, dots_mm) in enumerate(benches):
        laser_mm, plane = moved.laser.position_mm, moved.imaging_plane
        rays = project_rays(moved.laser, moved.pattern).directions[at]
        start = intersect_level(laser_mm, rays, points[:, 2:])
        there, _ = solver_kernels.newton_along_rays(grid, coefficients, rays, start, 2)
        seen = laser_mm, plane.pose_mm, plane.to_universal(dots_mm)
        _, *slopes = spline_kernels.surface_at(grid, coefficients, there)
        rises = rays / (rays[:, 2] - np.vecdot(np.transpose(slopes), rays[:, :2]))[:, None]
        for _ in range(ROUNDS):
            raised = spline_kernels.surface_at(grid, changes[k], there)[0][:, None]
            change = right_side(there + raised * rises, *seen) - base
            changes[k] = solver_kernels.solve(factor, change[None])[0]
            # Slopes do not determine the level.
            changes[k] -= spline_kernels.surface_at(grid, changes[k], there)[0].mean()
    return changes.T


def perturbed(rig: Rig, offset: FloatArray, plane_mm: FloatArray) -> Perturbed:
    """Perturb the quantities of a rig by an offset, shape (q,), and the dots on its plane, mm."""
    assert rig.uncertainty is not None
    dots = moved_dots(plane_mm, rig, rig.uncertainty.axes, offset)
    return aimed_as(rig.laser, moved_rig(rig, offset)), dots


def setup_sigma(changes: FloatArray) -> FloatArray:
    """Standard uncertainty of sizes, shape (m,), from their `setup_changes`, shape (m, q)."""
    return np.asarray(np.sqrt(np.sum(changes**2, axis=1)))
