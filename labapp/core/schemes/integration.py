"""Common part of zonal and modal integration: iterative integration of a slope field.

Both determine the slopes from the reflections, fit heights to all of them by least squares, and
move the reflection points along their rays to these heights, until nothing changes. As slopes leave
a constant height undetermined, it is chosen such that the mean height at the boundary, extrapolated
by the slope of the nearest point, is that of the work piece.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import scipy

from labapp.core.geometry.rig import Rig
from labapp.core.match import Match
from labapp.core.schemes.slopes import (
    ReflectedRays,
    best_of_loops,
    reconstruction_within,
    reflected_rays,
)
from labapp.core.surface.boundary import Boundary, BoundaryModel, boundary_on_work_piece
from labapp.core.surface.interpolation import ThinPlateSurface
from labapp.core.surface.reconstruction import Reconstruction
from labapp.core.values import CannotMeasure, FloatArray

Integrate = Callable[[ReflectedRays, FloatArray, FloatArray], FloatArray]
"""Function of the rays, their points' (x, y), shape (n, 2), mm, and the gradients there, shape
(n, 2), that returns heights up to a constant, shape (n,), mm."""


def reconstruct_by(
    scheme: str, integrate: Integrate, match: Match, rig: Rig, loops: int, model: BoundaryModel
) -> Reconstruction:
    """Reconstruct the pool surface by integration of its slopes.

    Raises
    ------
    CannotMeasure
        ``too-few-dots``, ``no-surface`` or ``no-boundary``.
    """
    rays, boundary = reflected_rays(match, rig), boundary_on_work_piece(match, rig, model)

    def move(normals: FloatArray, distance_mm: FloatArray) -> FloatArray:
        place = rays.points(distance_mm)[:, :2]
        gradient = -normals[:, :2] / normals[:, 2:]
        if not np.isfinite(gradient).all():
            return np.full(len(distance_mm), np.nan)
        z = integrate(rays, place, gradient)
        z -= _height_at_boundary(place, z, gradient, boundary)
        return np.asarray((z - rays.laser_mm[2]) / rays.direction[:, 2])

    best = best_of_loops(rays, move, ThinPlateSurface, loops)
    if best is None:
        raise CannotMeasure("no-surface", "the reflection points diverge from the first loop on")
    return reconstruction_within(scheme, match, rays, best, boundary)


def _height_at_boundary(
    place: FloatArray, z: FloatArray, gradient: FloatArray, boundary: Boundary
) -> float:
    """Mean height at the boundary, extrapolated by the slope of the nearest reflection point."""
    edge = boundary.points_mm[:, :2]
    near = scipy.spatial.cKDTree(place).query(edge)[1]
    return float(np.mean(z[near] + np.sum(gradient[near] * (edge - place[near]), axis=-1)))
