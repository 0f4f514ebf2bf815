"""The fit, our own scheme and the default: surface, boundary and their uncertainty (`pool_fit`)."""

from __future__ import annotations

import numpy as np

from labapp.core.boundary import Boundary
from labapp.core.correspondence import Match
from labapp.core.pool_fit import FitSettings, Level, Rear, fit_pool
from labapp.core.reconstruction import Reconstruction
from labapp.core.rig import Rig
from labapp.core.sizes import sizes_of
from labapp.core.spline import SplineSurface
from labapp.core.values import CannotMeasure, FloatArray

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
        match.ray, match.plane_mm, match.plane_covariance_mm2, match.witness, rig, settings
    )
    if pool.unsettled_mm > UNSETTLED_MM:
        raise CannotMeasure("no-surface", "the surface does not settle")
    x, y = pool.points_mm[:, 0], pool.points_mm[:, 1]
    center = (pool.points_mm[:, :2].min(axis=0) + pool.points_mm[:, :2].max(axis=0)) / 2
    boundary = contour(pool.surface, center, pool.level)
    surface, level, outline = pool.surface, pool.level, boundary.points_mm
    climb = surface.gradient(*outline[:, :2].T)
    climb[:, 1] -= level.rear.slope(outline[:, 1])
    sizes = sizes_of(surface.basis, surface.coefficients, level, boundary, climb)
    return Reconstruction(
        scheme="fit",
        surface=surface,
        boundary=boundary,
        ray=match.ray,
        points_mm=pool.points_mm,
        residual_mm=pool.residual_mm,
        sigma_mm=pool.sigma_of(surface.basis.matrix(x, y)),
        size_sigma=pool.sigma_of(sizes.gradient),
    )


def contour(
    surface: SplineSurface, center_mm: FloatArray, level: Level, count: int = 360
) -> Boundary:
    """The first place on the way out from the centre where the surface comes down to its rim.

    That is the work piece, z = 0, or a rear that lies below it.

    Raises
    ------
    CannotMeasure
        ``open-boundary`` if it does not in some direction, within the surface's rectangle.
    """
    theta = np.linspace(-np.pi, np.pi, count, endpoint=False)
    way = np.stack([np.cos(theta), np.sin(theta)], axis=-1)
    edge = np.where(way > 0, surface.basis.high_mm, surface.basis.low_mm) - center_mm
    limit = (np.abs(edge) / np.maximum(np.abs(way), 1e-9)).min(axis=-1) * (1 - 1e-9)
    fraction = np.linspace(0.0, 1.0, 64)
    reach = limit[:, None] * fraction
    x, y = np.moveaxis(center_mm + reach[..., None] * way[:, None], -1, 0)
    height = surface.height(x.ravel(), y.ravel()).reshape(reach.shape)
    inside = level.sign * (height - level.rear.height(y)) > 0
    # The centre of a dented pool may lie below the work piece: start where the pool is reached.
    entered = np.cumsum(inside, axis=1) > 0
    crossing = entered[:, :-1] & inside[:, :-1] & ~inside[:, 1:]
    if not crossing.any(axis=1).all():
        raise CannotMeasure(
            "open-boundary", "the surface does not come down to the work piece all round"
        )
    first = np.argmax(crossing, axis=1)
    radius = reach[np.arange(count), first] + 0.5 * limit * fraction[1]
    radius = _refine_radius(surface, level.rear, center_mm, way, radius, limit * fraction[1])
    return _boundary_of(level.rear, center_mm, way, radius)


def _boundary_of(
    rear: Rear, center_mm: FloatArray, way: FloatArray, radius: FloatArray
) -> Boundary:
    """Build a boundary of radii, shape (m,), along directions, shape (m, 2), from −180° on."""
    place = center_mm + radius[:, None] * way
    points = np.column_stack([place, rear.height(place[:, 1])])
    theta = np.degrees(np.arctan2(way[:, 1], way[:, 0]))
    theta[0] = -180.0  # arctan2 has it at either end
    return Boundary(np.asarray(center_mm, float), theta, points)


def _refine_radius(
    surface: SplineSurface,
    rear: Rear,
    center: FloatArray,
    way: FloatArray,
    radius: FloatArray,
    bound: FloatArray | float,
) -> FloatArray:
    """Newton steps along each direction to the rim, none longer than ``bound``."""
    for _ in range(4):
        x, y = (center + radius[:, None] * way).T
        outward = np.sum(surface.gradient(x, y) * way, axis=-1) - rear.slope(y) * way[:, 1]
        height = surface.height(x, y) - rear.height(y)
        safe = np.where(np.abs(outward) > 1e-6, outward, np.inf)
        radius = radius + np.clip(np.nan_to_num(-height / safe), -bound, bound)
    return radius
