"""Boundary of a fitted surface: where it reaches the work piece, or a rear that lies lower.

It is traced from a centre outwards (`trace_boundary`), or from the boundary of a similar surface
(`retrace_boundary`), by Newton steps along each direction.
"""

from __future__ import annotations

import numpy as np

from labapp.core.surface.boundary import Boundary
from labapp.core.surface.level import Level, Rear
from labapp.core.surface.spline import SplineBasis
from labapp.core.values import CannotMeasure, FloatArray

LONGEST_MM, LAST_MM = 0.3, 3e-3
"""Longest Newton step if the boundary is close, and the step length at which the iteration ends, as
the next step would be some nanometres."""

ON_BOUNDARY_MM = 1e-3
"""Tolerance of the surface's height at the boundary before the last step. If it is exceeded at any
point, the boundary is traced from the centre."""

DIRECTIONS, CELLS = 360, 63
"""Number of boundary points, and of intervals per direction in which the first crossing is
searched for."""


def trace_boundary(
    basis: SplineBasis, coefficients: FloatArray, level: Level, center_mm: FloatArray
) -> tuple[Boundary, FloatArray]:
    """Trace the boundary: the first place in each direction where the surface reaches its height.

    This height is that of the work piece, z = 0, or of a rear that lies below it.

    Parameters
    ----------
    basis, coefficients
        The surface: splines and their coefficients, shape (p,), mm.
    level
        The side of the work piece that the pool is on, and its rear.
    center_mm
        Origin of the directions, shape (2,), mm.

    Returns
    -------
    boundary, boundary_slope
        The boundary of m points, one per direction; gradient there of the surface's height above
        the boundary's, shape (m, 2).

    Raises
    ------
    CannotMeasure
        ``open-boundary`` if the surface does not reach it in some direction within its rectangle.
    """
    from labapp.core.surface.kernels import boundary_kernels, spline_kernels

    theta = np.linspace(-np.pi, np.pi, DIRECTIONS, endpoint=False)
    way = np.stack([np.cos(theta), np.sin(theta)], axis=-1)
    edge = np.where(way > 0, basis.high_mm, basis.low_mm) - center_mm
    limit = (np.abs(edge) / np.maximum(np.abs(way), 1e-9)).min(axis=-1) * (1 - 1e-9)
    reach = limit[:, None] * np.linspace(0.0, 1.0, CELLS + 1)
    place = center_mm + reach[..., None] * way[:, None]
    height = spline_kernels.surface_at(basis.grid, coefficients, place.reshape(-1, 2))[0]
    inside = level.pool_sign * (height.reshape(reach.shape) - level.rear.height(place[..., 1])) > 0
    # The centre of a dented pool may lie below the work piece: start at the first point inside.
    entered = np.cumsum(inside, axis=1) > 0
    crossing = entered[:, :-1] & inside[:, :-1] & ~inside[:, 1:]
    if not crossing.any(axis=1).all():
        raise CannotMeasure(
            "open-boundary", "the surface does not come down to the work piece all round"
        )
    cell = limit / CELLS
    radius = reach[np.arange(DIRECTIONS), np.argmax(crossing, axis=1)] + 0.5 * cell
    rear = level.rear.as_array
    radius, boundary_slope, _ = boundary_kernels.newton_to_boundary(
        basis.grid, coefficients, rear, center_mm, way, radius, cell, LAST_MM
    )
    return _boundary_of(level.rear, center_mm, np.degrees(theta), way, radius), boundary_slope


def retrace_boundary(
    basis: SplineBasis,
    coefficients: FloatArray,
    level: Level,
    center_mm: FloatArray,
    before: Boundary,
) -> tuple[Boundary, FloatArray]:
    """Trace the boundary from that of a similar surface, which is faster than `trace_boundary`.

    Parameters, return values and errors are the same; ``before`` is the boundary of the similar
    surface. If steps from there do not converge, the boundary is traced from the centre.
    """
    from labapp.core.surface.kernels import boundary_kernels

    radius = np.hypot(*(before.points_mm[:, :2] - before.center_mm).T)
    theta = np.radians(before.theta_deg)
    way = np.array([np.cos(theta), np.sin(theta)]).T
    longest, rear = np.full(len(radius), LONGEST_MM), level.rear.as_array
    radius, boundary_slope, over = boundary_kernels.newton_to_boundary(
        basis.grid, coefficients, rear, center_mm, way, radius, longest, LAST_MM
    )
    boundary = _boundary_of(level.rear, center_mm, before.theta_deg, way, radius)
    inside = bool(basis.contains(*boundary.points_mm[:, :2].T).all() and (radius > 0).all())
    if inside and np.abs(over).max() < ON_BOUNDARY_MM:
        return boundary, boundary_slope
    return trace_boundary(basis, coefficients, level, center_mm)


def _boundary_of(
    rear: Rear, center_mm: FloatArray, theta_deg: FloatArray, way: FloatArray, radius: FloatArray
) -> Boundary:
    """Build a boundary from radii, shape (m,), along directions, shape (m, 2)."""
    place = center_mm + radius[:, None] * way
    points = np.column_stack([place, rear.height(place[:, 1])])
    return Boundary(np.asarray(center_mm, float), theta_deg, points)
