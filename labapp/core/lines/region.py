"""The part of a pool surface between reflected lines, which determine it."""

from __future__ import annotations

import numpy as np

from labapp.core.lines.surface import LineSurface
from labapp.core.surface.boundary import POINTS, Boundary
from labapp.core.surface.reconstruction import Reconstruction
from labapp.core.values import FloatArray


def between_lines(surface: LineSurface) -> Reconstruction:
    """Return the fitted surface within the convex hull of the lines' points.

    Its ``boundary`` is the edge of the known region, not that of the pool.
    """
    points = surface.point_mm
    center = points[:, :2].mean(axis=0)
    edge = Boundary.polar(center, _reach(points[:, :2] - center))
    x, y = edge.points_mm[:, :2].T
    count = len(points)
    return Reconstruction(
        scheme="fit",
        surface=surface.surface,
        boundary=edge.at_height(surface.surface.height(x, y)),
        ray=np.zeros((count, 2), np.int64),
        points_mm=points,
        residual_mm=np.full((count, 2), np.nan),
        sigma_mm=surface.sigma_mm(points[:, 0], points[:, 1]),
    )


def _reach(points_mm: FloatArray) -> FloatArray:
    """Polar radius of the hull of points about the origin, shape (n, 2), by angle, shape (m,)."""
    from scipy.spatial import ConvexHull

    planes = ConvexHull(points_mm).equations  # normals, and offsets below 0
    angle = np.radians(-180.0 + 360.0 * np.arange(POINTS) / POINTS)
    toward = np.stack([np.cos(angle), np.sin(angle)], axis=-1) @ planes[:, :2].T
    with np.errstate(divide="ignore"):
        reach = np.where(toward > 1e-9, -planes[:, 2] / toward, np.inf)
    return np.asarray(reach.min(axis=1))
