"""The set-up's part of the uncertainty of sizes, by linear propagation (JCGM 100, 5.1.2).

The bench is perturbed by each column of a square root of its covariance, with the rays and the
known rays of the fit. A column is the standard uncertainty of a quantity or, if quantities are
correlated, one of the independent error components. The surface responds linearly: its coefficients
solve the normal equations, so that their change follows from that of the right-hand side (implicit
differentiation). The level and the drop of the rear depend on few rays and respond in steps: they
are determined again with the bench perturbed by plus and minus one standard uncertainty, and half
the difference is used.
"""

from __future__ import annotations

import numpy as np

from labapp.core.geometry.optics import project_rays
from labapp.core.geometry.perturbation import aimed_as, moved_dots, moved_rig
from labapp.core.geometry.rig import Rig
from labapp.core.match import Match, MatchedDots
from labapp.core.surface.pool_fit import FittedPool, normal_equations
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

REACH = 0.4
"""Reach of the search for the level (`find_level`) around that of the unperturbed surface."""


def setup_changes(match: Match, rig: Rig, pool: FittedPool, gradient: FloatArray) -> FloatArray:
    """Changes of sizes due to each independent error component of the bench.

    Parameters
    ----------
    match, rig
        Input of the fit.
    pool
        Result of the fit, with p splines.
    gradient
        Derivatives of m sizes by the spline coefficients and by the drop of the rear, shape
        (m, p + 1).

    Returns
    -------
    FloatArray
        Shape (m, q), in the units of the sizes, one column per column of `RigUncertainty.root`; q
        is 0 if the rig is known exactly.
    """
    from labapp.core.surface.kernels import setup_kernels

    uncertainty = rig.uncertainty
    if uncertainty is None:
        return np.zeros((len(gradient), 0))
    changes = np.zeros((len(gradient), len(uncertainty.root)))
    columns, benches = _benches(rig, match.plane_mm)
    equations = _factorised(match, rig, pool)
    change = _response(match.ray, equations, pool, benches) / SHARE
    basis, level, own = pool.surface.basis, pool.level, project_rays(rig.laser, rig.pattern)
    seen = (match.ray_states != 0) & basis.contains(own.landing_mm[..., 0], own.landing_mm[..., 1])
    landing, mean = own.landing_mm[seen], pool.mean_splines
    assert equations.factor is not None
    sigma = height_sigma(basis, equations.factor, equations.inverse, mean, landing)
    moved = [
        project_rays(bench.laser, bench.pattern).landing_mm[seen] - landing for bench, _ in benches
    ]
    raised, dropped = setup_kernels.level_changes(
        basis.grid,
        pool.surface.coefficients,
        change,
        (landing, match.ray_states[seen], sigma, own.spacing_mm),
        np.reshape(moved, (-1, *landing.shape)) / SHARE,
        np.array([rig.head_sign, *rig.laser.position_mm, level.pool_sign, REACH, match.missing]),
    ).T
    changes[:, columns] = gradient @ np.column_stack([change + raised[:, None], dropped]).T
    return changes


def fit_changes(
    match: Match | MatchedDots, rig: Rig, pool: FittedPool
) -> tuple[FloatArray, FloatArray]:
    """Changes of a fit due to each independent error component of the bench.

    The surface is refitted to the n matched pairs; the rig must have an uncertainty. Parameters are
    those of `setup_changes`.

    Returns
    -------
    residuals, coefficients
        Their changes, shapes (n, 2, q) and (p, q), mm, with one entry per column of
        `RigUncertainty.root`.
    """
    from labapp.core.surface.kernels import ray_kernels

    assert rig.uncertainty is not None
    at, surface = tuple(match.ray.T - 1), pool.surface
    columns, benches = _benches(rig, match.plane_mm)
    equations = _factorised(match, rig, pool)
    responses = _response(match.ray, equations, pool, benches)
    changes = np.zeros((*match.plane_mm.shape, len(rig.uncertainty.root)))
    of_coefficients = np.zeros((len(surface.coefficients), len(rig.uncertainty.root)))
    of_coefficients[:, columns] = responses.T / SHARE
    for k, change, (bench, plane_mm) in zip(columns, responses, benches, strict=True):
        rays, plane = project_rays(bench.laser, bench.pattern), bench.imaging_plane.pose_mm
        directions, landing = rays.directions[at], rays.landing_mm[at]
        coefficients = surface.coefficients + change
        _, _, computed = ray_kernels.intersect_and_reflect(
            surface.basis.grid, coefficients, directions, landing, NEWTON_STEPS, plane
        )
        off = computed - plane_mm - pool.residual_mm
        changes[..., k] = off / SHARE
    return changes, of_coefficients


def _benches(rig: Rig, plane_mm: FloatArray) -> tuple[IntArray, list[tuple[Rig, FloatArray]]]:
    """Perturb a rig with an uncertainty and the dots on its plane, shape (n, 2), mm.

    Returns
    -------
    columns, benches
        Columns of `RigUncertainty.root` that are not 0, shape (q,); for `SHARE` of each of them the
        perturbed rig and the dots on its plane, shape (n, 2), mm.
    """
    assert rig.uncertainty is not None
    root = SHARE * rig.uncertainty.root
    columns = np.flatnonzero(root.any(axis=0))
    return columns, [perturbed(rig, root[:, k], plane_mm) for k in columns]


def _factorised(match: Match | MatchedDots, rig: Rig, pool: FittedPool) -> NormalEquations:
    """Normal equations with a factor for the final reflection points (see `SHARE`)."""
    basis, points = pool.surface.basis, pool.points_mm
    own = normal_equations(
        basis, rig, points, match.plane_mm, match.plane_covariance_mm2, pool.settings
    )
    own.factor = normal_factor(basis, own.stiffness, points, own.weights)
    return own


def _response(
    ray: IntArray,
    own: NormalEquations,
    pool: FittedPool,
    benches: list[tuple[Rig, FloatArray]],
) -> FloatArray:
    """Changes of a fit's p coefficients for q slightly perturbed benches, shape (q, p), mm."""
    from labapp.core.surface.kernels import setup_kernels

    surface, at, factor = pool.surface, tuple(ray.T - 1), own.factor
    assert factor is not None
    if not benches:
        return np.zeros((0, len(surface.coefficients)))
    rigs = [rig for rig, _ in benches]
    moved = (
        np.array([rig.laser.position_mm for rig in rigs]),
        np.array([rig.imaging_plane.pose_mm for rig in rigs]),
        np.array([project_rays(rig.laser, rig.pattern).directions[at] for rig in rigs]),
        np.array([rig.imaging_plane.to_universal(plane_mm) for rig, plane_mm in benches]),
    )
    return setup_kernels.coefficient_changes(
        surface.basis.grid,
        surface.coefficients,
        factor,
        pool.points_mm,
        own.weights,
        (own.laser_mm, own.plane, own.dots_mm),
        moved,
        ROUNDS,
    )


def perturbed(rig: Rig, offset: FloatArray, plane_mm: FloatArray) -> tuple[Rig, FloatArray]:
    """Perturb the quantities of a rig by an offset, (q,), and the dots on its plane, (n, 2), mm."""
    assert rig.uncertainty is not None
    dots = moved_dots(plane_mm, rig, rig.uncertainty.axes, offset)
    return aimed_as(rig.laser, moved_rig(rig, offset)), dots


def setup_sigma(changes: FloatArray) -> FloatArray:
    """Standard uncertainty of sizes, shape (m,), from their `setup_changes`, shape (m, q)."""
    return np.asarray(np.sqrt(np.sum(changes**2, axis=1)))
