"""The fit, our own scheme and the default: one smooth surface under all reflections at once.

Round by round from z = 0, every matched ray is met with the surface, the bisector of the incoming
ray and the direction to its dot gives two slopes there (Eq. 4-3), and the smooth surface that best
has all these slopes replaces the last. Slopes leave the level open. It comes, with the boundary,
from which rays came back and which did not: a lit ray landed inside the contour z = 0, a dark one
outside.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from labapp.core.boundary import Boundary
from labapp.core.correspondence import Match
from labapp.core.optics import (
    bisecting_gradient,
    meet_level,
    meet_plane,
    ray_directions,
    reflect,
    surface_normal,
)
from labapp.core.reconstruction import Reconstruction
from labapp.core.rig import Rig
from labapp.core.spline import SlopeFit, SplineBasis, SplineSurface, fit_slopes
from labapp.core.values import BoolArray, CannotMeasure, FloatArray, IntArray, freeze

LEAST_DOTS = 9
"""A surface from fewer reflections is a guess."""


@dataclass(frozen=True)
class FitSettings:
    """How the fit decides.

    Parameters
    ----------
    rounds
        Most rounds of meeting rays, taking slopes and fitting.
    knot_mm
        Spacing of the spline knots, mm.
    jerk
        Third derivatives of the surface that are to be expected, mm⁻².
    floor_mm
        Least uncertainty of a dot on the imaging plane, mm.
    settled_mm
        The rounds end when no reflection point moves by more.
    """

    rounds: int = 12
    knot_mm: float = 1.0
    jerk: float = 0.05
    floor_mm: float = 0.01
    settled_mm: float = 1e-4


@dataclass(frozen=True)
class Level:
    """Where z = 0 lies on a surface that is known up to its level.

    Parameters
    ----------
    shift_mm
        What to add to the surface's height, mm.
    sigma_mm
        Its standard uncertainty, mm.
    sign
        +1 for a pool that stands above the work piece inside its boundary, −1 for one below.
    disagreement
        Mean surprise of the rays near the boundary, bits: 0 where every lit ray is inside and
        every dark one outside.
    """

    shift_mm: float
    sigma_mm: float
    sign: int
    disagreement: float


@dataclass(frozen=True)
class FittedPool:
    """One solution: the surface, where the matched rays meet it, and how well it is known.

    Parameters
    ----------
    surface
        The surface, z = 0 at the boundary.
    covariance
        Of the spline coefficients, the level left out, shape (splines, splines), mm².
    level
        The level and its uncertainty.
    points_mm
        Reflection points, shape (n, 3), mm.
    residual_mm
        Computed minus captured dot on the imaging plane (X′, Z′), shape (n, 2), mm.
    """

    surface: SplineSurface
    covariance: FloatArray
    level: Level
    points_mm: FloatArray
    residual_mm: FloatArray

    def __post_init__(self) -> None:
        freeze(self)


def reconstruct(match: Match, rig: Rig, settings: FitSettings) -> Reconstruction:
    """Fit one smooth surface to all reflections (see the head of this file).

    Raises
    ------
    CannotMeasure
        ``too-few-dots`` for fewer than nine matched dots; ``no-surface`` if the rays cannot be
        met with a surface; ``open-boundary`` if the surface does not come down to the work piece
        all round.
    """
    pool = fit_pool(match.ray, match.plane_mm, match.plane_covariance_mm2, match.witness, rig, settings)
    x, y = pool.points_mm[:, 0], pool.points_mm[:, 1]
    center = (pool.points_mm[:, :2].min(axis=0) + pool.points_mm[:, :2].max(axis=0)) / 2
    boundary = zero_contour(pool.surface, center, pool.level.sign)
    at_points = pool.surface.basis.matrix(x, y)
    # Level and slopes are known independently of each other, so their variances add.
    ones = np.ones(at_points.shape[1])
    covariance = pool.covariance + pool.level.sigma_mm**2 * np.outer(ones, ones)
    spread = at_points @ covariance @ at_points.T
    return Reconstruction(
        scheme="fit",
        surface=pool.surface,
        boundary=boundary,
        ray=match.ray,
        points_mm=pool.points_mm,
        residual_mm=pool.residual_mm,
        sigma_mm=np.sqrt(np.diag(spread)),
        variants=_variants(pool.surface, boundary, covariance, at_points, spread),
    )


def fit_pool(
    ray: IntArray,
    plane_mm: FloatArray,
    plane_covariance_mm2: FloatArray,
    witness: IntArray,
    rig: Rig,
    settings: FitSettings,
) -> FittedPool:
    """Solve for the surface that turns each ray (i, j), shape (n, 2), to its dot.

    Parameters are those of `Match`. Raises `CannotMeasure` as `reconstruct` does.
    """
    if len(ray) < LEAST_DOTS:
        raise CannotMeasure(
            "too-few-dots", f"{len(ray)} dots have a ray, a surface needs {LEAST_DOTS}"
        )
    laser = rig.laser.position_mm
    pattern = ray_directions(rig.laser, rig.pattern)
    rays = pattern[ray[:, 0] - 1, ray[:, 1] - 1]
    dots = rig.imaging_plane.to_universal(plane_mm)
    points = meet_level(laser, rays)
    ground = meet_level(laser, pattern)[..., :2]
    spacing = np.abs([np.median(np.diff(ground[..., 0], axis=1)), np.median(np.diff(ground[..., 1], axis=0))])
    margin = 1.5 * spacing.max()
    basis = SplineBasis.over(
        points[:, :2].min(axis=0) - margin, points[:, :2].max(axis=0) + margin, settings.knot_mm
    )
    told = (witness != 0) & basis.contains(ground[..., 0], ground[..., 1])
    weights = _slope_weights(points, dots, plane_covariance_mm2, rig, settings.floor_mm)
    stiffness = 1 / (settings.jerk * settings.knot_mm) ** 2
    for _ in range(settings.rounds):
        slopes = bisecting_gradient(points - laser, dots - points)
        fitted = fit_slopes(basis, points[:, :2], slopes, weights, stiffness)
        level = find_level(fitted.surface, ground[told], witness[told], spacing)
        surface = fitted.surface.raised(level.shift_mm)
        met = meet_surface(surface, rays, points)
        moved = float(np.max(np.abs(met - points)))
        points = met
        if moved < settings.settled_mm:
            break
    residual = predict_dots(surface, points, rays, rig) - plane_mm
    if not np.isfinite(residual).all():
        raise CannotMeasure("no-surface", "the fitted surface sends rays away from the plane")
    return FittedPool(surface, fitted.covariance, level, points, residual)


def _slope_weights(
    points: FloatArray, dots: FloatArray, covariance: FloatArray, rig: Rig, floor: float
) -> FloatArray:
    """Inverse covariance of the slopes that dots of the given covariance give, shape (n, 2, 2)."""
    laser, step = rig.laser.position_mm, 1e-3
    base = bisecting_gradient(points - laser, dots - points)
    jacobian = np.stack(
        [
            (bisecting_gradient(points - laser, dots + step * axis - points) - base) / step
            for axis in (rig.imaging_plane.x_axis, rig.imaging_plane.z_axis)
        ],
        axis=-1,
    )
    floored = covariance + floor**2 * np.eye(2)
    return np.asarray(np.linalg.inv(jacobian @ floored @ np.swapaxes(jacobian, -1, -2)))


def meet_surface(surface: SplineSurface, rays: FloatArray, points: FloatArray) -> FloatArray:
    """Where rays meet the surface, by bounded Newton steps from points on them; shapes (n, 3).

    Rays that leave the surface's rectangle stay at its edge.
    """
    low, high = surface.basis.low_mm + 1e-9, surface.basis.high_mm - 1e-9
    for _ in range(4):
        x, y = np.clip(points[:, :2], low, high).T
        gap = points[:, 2] - surface.height(x, y)
        descent = rays[:, 2] - np.sum(surface.gradient(x, y) * rays[:, :2], axis=-1)
        step = np.clip(gap / np.maximum(-descent, 0.05), -0.5, 0.5)
        points = points + step[:, None] * rays
    return points


def predict_dots(
    surface: SplineSurface, points: FloatArray, rays: FloatArray, rig: Rig
) -> FloatArray:
    """Dots that the surface makes of rays meeting it at points, IPCS, shape (n, 2), mm."""
    x, y = np.clip(points[:, :2], surface.basis.low_mm, surface.basis.high_mm).T
    normal = surface_normal(surface.gradient(x, y))
    return meet_plane(points, reflect(rays, normal), rig.imaging_plane)


# Width of the step from inside to outside, in dot spacings: from a boundary that is known as
# sharply as the surface is to one that half the neighbouring rays contradict.
_BLURS = np.geomspace(1 / 48, 1 / 2, 10)


def find_level(
    surface: SplineSurface, landing_mm: FloatArray, witness: IntArray, spacing_mm: FloatArray
) -> Level:
    """Place z = 0 so that lit rays land inside the contour and dark ones outside.

    A ray that lands a distance d inside the contour came back with probability
    1/(1 + exp(−d/s)). The blur s is found along with the level: both are weighed on a grid, and
    the level's mean and spread are taken over it.

    Parameters
    ----------
    surface
        Known up to its level.
    landing_mm
        Where the witnesses would land on z = 0, shape (m, 2), mm.
    witness
        +1 lit, −1 dark, shape (m,).
    spacing_mm
        Distance between neighbouring landing points along X and along Y, mm.
    """
    height = surface.height(*landing_mm.T)
    slope = surface.gradient(*landing_mm.T)
    # Height by which the surface changes from one ray to the next, straight across the contour.
    rise = np.linalg.norm(slope * spacing_mm, axis=-1) + 1e-6
    rise = np.maximum(rise, np.median(rise) / 4)
    scan = np.linspace((-height).min(), (-height).max(), 300)
    best_loss, shift, sign = np.inf, 0.0, 1
    for trial in (1, -1):
        inside = trial * witness[:, None] * (height[:, None] + scan) / rise[:, None]
        loss = np.logaddexp(0.0, -4.0 * inside).sum(axis=0)
        if loss.min() < best_loss:
            best_loss, shift, sign = loss.min(), scan[np.argmin(loss)], trial
    near = np.abs(height + shift) < 3.0 * rise
    shifts = shift + np.linspace(-1.0, 1.0, 161) * np.median(rise)
    inside = sign * witness[near, None] * (height[near, None] + shifts) / rise[near, None]
    log_likelihood = np.stack([-np.logaddexp(0.0, -inside / s).sum(axis=0) for s in _BLURS])
    posterior = np.exp(log_likelihood - log_likelihood.max())
    weight = posterior.sum(axis=0) / posterior.sum()
    mean = float(weight @ shifts)
    sigma = float(np.sqrt(weight @ (shifts - mean) ** 2))
    surprise = -log_likelihood.max() / np.log(2) / max(int(near.sum()), 1)
    return Level(mean, sigma, sign, float(surprise))


def zero_contour(
    surface: SplineSurface, center_mm: FloatArray, sign: int, count: int = 360
) -> Boundary:
    """The first contour z = 0 met on the way out from the centre, in polar coordinates.

    Raises
    ------
    CannotMeasure
        ``open-boundary`` if there is none in some direction, within the surface's rectangle.
    """
    theta = np.linspace(-np.pi, np.pi, count, endpoint=False)
    way = np.stack([np.cos(theta), np.sin(theta)], axis=-1)
    edge = np.where(way > 0, surface.basis.high_mm, surface.basis.low_mm) - center_mm
    limit = (np.abs(edge) / np.maximum(np.abs(way), 1e-9)).min(axis=-1) * (1 - 1e-9)
    fraction = np.linspace(0.0, 1.0, 64)
    reach = limit[:, None] * fraction
    at = center_mm + reach[..., None] * way[:, None]
    inside = sign * surface.height(at[..., 0].ravel(), at[..., 1].ravel()).reshape(reach.shape) > 0
    # The centre of a dented pool may lie below the work piece: start where the pool is reached.
    entered = np.cumsum(inside, axis=1) > 0
    crossing = entered[:, :-1] & inside[:, :-1] & ~inside[:, 1:]
    if not crossing.any(axis=1).all():
        raise CannotMeasure(
            "open-boundary", "the surface does not come down to the work piece all round"
        )
    first = np.argmax(crossing, axis=1)
    radius = reach[np.arange(count), first] + 0.5 * limit * fraction[1]
    radius = _refine_radius(surface, center_mm, way, radius, limit * fraction[1])
    points = np.column_stack([center_mm + radius[:, None] * way, np.zeros(count)])
    return Boundary(np.asarray(center_mm, float), np.degrees(theta), points)


def _refine_radius(
    surface: SplineSurface,
    center: FloatArray,
    way: FloatArray,
    radius: FloatArray,
    bound: FloatArray | float,
) -> FloatArray:
    """Newton steps along each direction to z = 0, none longer than ``bound``."""
    for _ in range(4):
        at = center + radius[:, None] * way
        outward = np.sum(surface.gradient(at[:, 0], at[:, 1]) * way, axis=-1)
        height = surface.height(at[:, 0], at[:, 1])
        safe = np.where(np.abs(outward) > 1e-6, outward, np.inf)
        radius = radius + np.clip(np.nan_to_num(-height / safe), -bound, bound)
    return radius


def _variants(
    surface: SplineSurface,
    boundary: Boundary,
    covariance: FloatArray,
    at_points: FloatArray,
    spread: FloatArray,
    modes: int = 6,
) -> tuple[tuple[SplineSurface, Boundary], ...]:
    """Surfaces one σ away along the principal directions of the heights' covariance."""
    variance, direction = np.linalg.eigh(spread)
    variants = []
    radius = np.linalg.norm(boundary.points_mm[:, :2] - boundary.center_mm, axis=-1)
    theta = np.radians(boundary.theta_deg)
    way = np.stack([np.cos(theta), np.sin(theta)], axis=-1)
    for k in range(1, min(modes, len(variance)) + 1):
        if variance[-k] < 1e-4 * variance[-1]:
            break
        mode = covariance @ at_points.T @ direction[:, -k] / np.sqrt(variance[-k])
        for step in (mode, -mode):
            moved = SplineSurface(surface.basis, surface.coefficients + step)
            out = _refine_radius(moved, boundary.center_mm, way, radius, 0.3)
            points = np.column_stack([boundary.center_mm + out[:, None] * way, np.zeros(len(out))])
            variants.append((moved, Boundary(boundary.center_mm, boundary.theta_deg, points)))
    return tuple(variants)
