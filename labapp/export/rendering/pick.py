"""Intersection of a ray with a triangle mesh, to find the point at the pointer."""

from __future__ import annotations

import numpy as np

from labapp.core.values import FloatArray, IntArray
from labapp.export.rendering.scene import Scene

EPS = 1e-9


def first_hit(
    vertices: FloatArray, triangles: IntArray, start: FloatArray, way: FloatArray
) -> FloatArray | None:
    """Return the first intersection of a ray with a surface, shape (3,); None if there is none.

    Parameters
    ----------
    vertices, triangles
        The surface, shapes (n, 3) and (k, 3).
    start, way
        Origin and direction of the ray, each of shape (3,).

    Notes
    -----
    Möller and Trumbore, *Journal of Graphics Tools* 2 (1997), for all triangles at once.
    """
    if not len(triangles):
        return None
    a, b, c = (vertices[triangles[:, k]] for k in range(3))
    one, other = b - a, c - a
    normal = np.cross(one, other)
    against = -(normal @ way)
    with np.errstate(divide="ignore", invalid="ignore"):
        from_a = start - a
        across = np.cross(from_a, way)
        u = (other * across).sum(axis=1) / against
        v = -(one * across).sum(axis=1) / against
        along = (from_a * normal).sum(axis=1) / against
    inside = (u >= -EPS) & (v >= -EPS) & (u + v <= 1 + EPS) & np.isfinite(along) & (along >= 0)
    if not inside.any():
        return None
    return np.asarray(start + along[inside].min() * way)


def point_over(scene: Scene, x_mm: float, y_mm: float) -> FloatArray | None:
    """Return the point of a scene's surface at (x, y), shape (3,), mm; None outside the surface."""
    above, down = np.array([x_mm, y_mm, 1e3]), np.array([0.0, 0.0, -1.0])
    return first_hit(scene.vertices_mm, scene.triangles, above, down)


def seen_point(
    scene: Scene, view_matrix: FloatArray, across: float, up: float
) -> FloatArray | None:
    """Return the point of a scene's surface that is visible at a position in the picture, mm.

    Parameters
    ----------
    view_matrix
        Matrix from the drawn scene to the picture, shape (4, 4).
    across, up
        Position: −1 at the left and the bottom, 1 at the right and the top.
    """
    stretch = np.array([1.0, 1.0, scene.exaggeration])
    ends = np.array([[across, up, -1.0, 1.0], [across, up, 1.0, 1.0]])
    near, far = ends @ np.linalg.inv(view_matrix).T
    start, end = near[:3] / near[3], far[:3] / far[3]
    hit = first_hit(scene.vertices_mm * stretch, scene.triangles, start, end - start)
    return None if hit is None else hit / stretch
