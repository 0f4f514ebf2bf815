"""Grid points and triangle mesh of a pool surface within its boundary, for files and figures."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from labapp.core.surface.measures import grid_within, spoke_points
from labapp.core.surface.reconstruction import Reconstruction
from labapp.core.values import FloatArray, IntArray


def grid_nodes(
    reconstruction: Reconstruction, spacing_mm: float
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Nodes x, y, z of a grid through the origin within the boundary, shape (n,) each, mm."""
    x, y = grid_within(reconstruction.boundary, spacing_mm)
    return x, y, reconstruction.unbounded.height(x, y)


def surface_mesh(reconstruction: Reconstruction, spacing_mm: float) -> tuple[FloatArray, IntArray]:
    """Triangle mesh that ends exactly at the boundary, made of scaled copies of the boundary.

    Parameters
    ----------
    reconstruction
        The reconstruction.
    spacing_mm
        Largest distance between rings, mm; along a ring there is a vertex per boundary point.

    Returns
    -------
    vertices, triangles
        Shape (n, 3), mm, the centre first and the boundary last; and indices, shape (k, 3),
        counter-clockwise seen from above.
    """
    boundary, surface = reconstruction.boundary, reconstruction.unbounded
    radius = np.linalg.norm(boundary.points_mm[:, :2] - boundary.center_mm, axis=-1).max()
    rings = max(int(np.ceil(radius / spacing_mm)), 1)
    count = len(boundary.points_mm)
    inner = spoke_points(surface, boundary, np.arange(1, rings) / rings)
    x, y = boundary.center_mm
    centre = [x, y, surface.height(np.asarray(x), np.asarray(y))]
    vertices = np.vstack([centre, inner.transpose(1, 0, 2).reshape(-1, 3), boundary.points_mm])
    return vertices, _ring_triangles(rings, count)


@lru_cache(maxsize=4)
def _ring_triangles(rings: int, count: int) -> IntArray:
    """Triangles of `surface_mesh` with so many rings and boundary points; kept for all frames."""
    here = np.arange(count)
    after = np.roll(here, -1)
    triangles = [np.column_stack([np.zeros(count, int), 1 + here, 1 + after])]
    for ring in range(rings - 1):
        a, b = 1 + ring * count, 1 + (ring + 1) * count
        triangles.append(np.column_stack([a + here, b + here, b + after]))
        triangles.append(np.column_stack([a + here, b + after, a + after]))
    made = np.vstack(triangles)
    made.flags.writeable = False
    return made
