"""Where a pool ends: its surface followed to the work piece, or to a rear that lies below it."""

from __future__ import annotations

import numpy as np

from labapp.core.surface.boundary import Boundary
from labapp.core.surface.pool_fit import Level, Rear
from labapp.core.surface.spline import SplineBasis, SplineSurface
from labapp.core.values import CannotMeasure, FloatArray

STEPS = 4
"""Newton steps from the boundary of the frame before, at most."""

LAST_MM = 3e-3
"""After a step of no more the next one would be of some nanometres."""

ON_RIM_MM = 1e-3
"""Before the last step boundary points are on the rim's height to within this, or the boundary is
looked for anew."""


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


def follow_rim(
    basis: SplineBasis,
    coefficients: FloatArray,
    level: Level,
    center_mm: FloatArray,
    before: Boundary,
) -> tuple[Boundary, FloatArray]:
    """Move a boundary onto a surface that is near its own.

    Returns
    -------
    boundary, climb
        The boundary of m points, and the gradient there of the surface's height over the rim's,
        shape (m, 2).

    Raises
    ------
    CannotMeasure
        ``open-boundary`` if there is none.
    """
    from labapp.core.surface import kernels

    radius = np.linalg.norm(before.points_mm[:, :2] - before.center_mm, axis=-1)
    theta = np.radians(before.theta_deg)
    way = np.stack([np.cos(theta), np.sin(theta)], axis=-1)
    for attempt in range(2):
        radius, climb, over = kernels.follow_rim(
            basis.grid,
            coefficients,
            level.rear.numbers,
            center_mm,
            way,
            radius,
            STEPS,
            LAST_MM,
        )
        place = center_mm + radius[:, None] * way
        inside = bool(basis.contains(*place.T).all() and (radius > 0).all())
        if inside and np.abs(over).max() < ON_RIM_MM:
            break
        found = contour(SplineSurface(basis, coefficients), center_mm, level)
        if attempt:
            break
        radius = np.linalg.norm(found.points_mm[:, :2] - center_mm, axis=-1)
    height = level.rear.height(place[:, 1])
    return Boundary(center_mm, before.theta_deg, np.column_stack([place, height])), climb
