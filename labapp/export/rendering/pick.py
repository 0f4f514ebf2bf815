"""Where a ray meets a surface of triangles: what the pointer is on."""

from __future__ import annotations

import numpy as np

from labapp.core.values import FloatArray, IntArray

EPS = 1e-9


def first_hit(
    vertices: FloatArray, triangles: IntArray, start: FloatArray, way: FloatArray
) -> FloatArray | None:
    """Return where a ray first meets a surface, shape (3,); None where it does not.

    Parameters
    ----------
    vertices, triangles
        The surface, shapes (n, 3) and (k, 3).
    start, way
        The ray begins at the one and goes along the other, each of shape (3,).

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
