"""Where a pool ends: its surface followed to the work piece, or to a rear that lies below it."""

from __future__ import annotations

import numpy as np

from labapp.core.surface.boundary import Boundary
from labapp.core.surface.pool_fit import Level, Rear
from labapp.core.surface.spline import SplineBasis
from labapp.core.values import CannotMeasure, FloatArray

LONGEST_MM, LAST_MM = 0.3, 3e-3
"""How long a Newton step may be where the boundary is near; and after one of how much the next
would be of some nanometres."""

ON_RIM_MM = 1e-3
"""Before the last step boundary points are on the rim's height to within this, or the boundary is
looked for anew."""

DIRECTIONS, CELLS = 360, 63
"""Boundary points, and cells on the way out in which the first crossing is looked for."""


def find_rim(
    basis: SplineBasis, coefficients: FloatArray, level: Level, center_mm: FloatArray
) -> tuple[Boundary, FloatArray]:
    """The first place on the way out from the centre where a surface comes down to its rim.

    That is the work piece, z = 0, or a rear that lies below it.

    Returns
    -------
    boundary, climb
        The boundary of m points, and the gradient there of the surface's height over the rim's,
        shape (m, 2).

    Raises
    ------
    CannotMeasure
        ``open-boundary`` if it does not in some direction, within the surface's rectangle.
    """
    from labapp.core.surface import kernels

    theta = np.linspace(-np.pi, np.pi, DIRECTIONS, endpoint=False)
    way = np.stack([np.cos(theta), np.sin(theta)], axis=-1)
    edge = np.where(way > 0, basis.high_mm, basis.low_mm) - center_mm
    limit = (np.abs(edge) / np.maximum(np.abs(way), 1e-9)).min(axis=-1) * (1 - 1e-9)
    reach = limit[:, None] * np.linspace(0.0, 1.0, CELLS + 1)
    place = center_mm + reach[..., None] * way[:, None]
    height = kernels.surface_at(basis.grid, coefficients, place.reshape(-1, 2))[0]
    inside = level.sign * (height.reshape(reach.shape) - level.rear.height(place[..., 1])) > 0
    # The centre of a dented pool may lie below the work piece: start where the pool is reached.
    entered = np.cumsum(inside, axis=1) > 0
    crossing = entered[:, :-1] & inside[:, :-1] & ~inside[:, 1:]
    if not crossing.any(axis=1).all():
        raise CannotMeasure(
            "open-boundary", "the surface does not come down to the work piece all round"
        )
    cell = limit / CELLS
    radius = reach[np.arange(DIRECTIONS), np.argmax(crossing, axis=1)] + 0.5 * cell
    rear = level.rear.numbers
    radius, climb, _ = kernels.follow_rim(
        basis.grid, coefficients, rear, center_mm, way, radius, cell, LAST_MM
    )
    return _boundary_of(level.rear, center_mm, np.degrees(theta), way, radius), climb


def follow_rim(
    basis: SplineBasis,
    coefficients: FloatArray,
    level: Level,
    center_mm: FloatArray,
    before: Boundary,
) -> tuple[Boundary, FloatArray]:
    """Move a boundary onto a surface that is near its own; see `find_rim`.

    Where it does not lead there, the boundary is looked for anew.
    """
    from labapp.core.surface import kernels

    radius = np.linalg.norm(before.points_mm[:, :2] - before.center_mm, axis=-1)
    theta = np.radians(before.theta_deg)
    way = np.stack([np.cos(theta), np.sin(theta)], axis=-1)
    longest, rear = np.full(len(radius), LONGEST_MM), level.rear.numbers
    radius, climb, over = kernels.follow_rim(
        basis.grid, coefficients, rear, center_mm, way, radius, longest, LAST_MM
    )
    boundary = _boundary_of(level.rear, center_mm, before.theta_deg, way, radius)
    inside = bool(basis.contains(*boundary.points_mm[:, :2].T).all() and (radius > 0).all())
    if inside and np.abs(over).max() < ON_RIM_MM:
        return boundary, climb
    return find_rim(basis, coefficients, level, center_mm)


def _boundary_of(
    rear: Rear, center_mm: FloatArray, theta_deg: FloatArray, way: FloatArray, radius: FloatArray
) -> Boundary:
    """Build a boundary of radii, shape (m,), along directions, shape (m, 2)."""
    place = center_mm + radius[:, None] * way
    points = np.column_stack([place, rear.height(place[:, 1])])
    return Boundary(np.asarray(center_mm, float), theta_deg, points)
