"""The fit, our own scheme and the default: surface, boundary and their uncertainty (`pool_fit`)."""

from __future__ import annotations

import numpy as np

from labapp.core.geometry.rig import Rig
from labapp.core.match import Match
from labapp.core.surface.boundary_trace import trace_boundary
from labapp.core.surface.pool_fit import FitSettings, fit_pool
from labapp.core.surface.reconstruction import Reconstruction
from labapp.core.surface.setup_uncertainty import Fitted, setup_sigma
from labapp.core.surface.sizes import sizes_and_gradients
from labapp.core.values import CannotMeasure

LEAST_DOTS = 9
"""A surface from fewer reflections is a guess."""

UNSETTLED_MM = 0.02
"""A reflection point that still moves as far in the last round has not been found."""


def reconstruct(match: Match, rig: Rig, settings: FitSettings) -> Reconstruction:
    """Fit one smooth surface to all reflections (`fit_pool`), and follow it to its boundary.

    Raises
    ------
    CannotMeasure
        ``too-few-dots`` for fewer than nine matched dots; ``no-surface`` if the rays cannot be
        met with a surface; ``open-boundary`` if the surface does not come down to the work piece
        all round, or no ray tells where it does.
    """
    if len(match.ray) < LEAST_DOTS:
        raise CannotMeasure(
            "too-few-dots", f"{len(match.ray)} dots have a ray, a surface needs {LEAST_DOTS}"
        )
    if not (match.witness < 0).any():
        raise CannotMeasure(
            "open-boundary", "no ray that would show stayed away: where the pool ends is not seen"
        )
    pool = fit_pool(
        *(match.ray, match.plane_mm, match.plane_covariance_mm2, match.witness, rig, settings),
        missing=match.missing,
    )
    if pool.unsettled_mm > UNSETTLED_MM:
        raise CannotMeasure("no-surface", "the surface does not settle")
    x, y = pool.points_mm[:, 0], pool.points_mm[:, 1]
    center = (pool.points_mm[:, :2].min(axis=0) + pool.points_mm[:, :2].max(axis=0)) / 2
    surface, level = pool.surface, pool.level
    boundary, boundary_slope = trace_boundary(surface.basis, surface.coefficients, level, center)
    sizes = sizes_and_gradients(
        surface.basis, surface.coefficients, level, boundary, boundary_slope
    )
    fitted = Fitted(match, rig, settings, surface, pool.points_mm, level)
    by_setup = setup_sigma(fitted.setup_changes(sizes.gradient))
    return Reconstruction(
        scheme="fit",
        surface=surface,
        boundary=boundary,
        ray=match.ray,
        points_mm=pool.points_mm,
        residual_mm=pool.residual_mm,
        sigma_mm=pool.sigma_of(surface.basis.matrix(x, y)),
        size_sigma=np.hypot(pool.sigma_of(sizes.gradient), by_setup),
        size_sigma_level=np.abs(sizes.by_level) * level.sigma_mm,
        size_sigma_setup=by_setup,
    )
