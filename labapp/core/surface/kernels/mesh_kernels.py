"""Loop over the triangles of a mesh, compiled."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from numba import types

from labapp.core.compiled import FLOATS_2, INT, compiled
from labapp.core.values import FloatArray, IntArray


@compiled(FLOATS_2, types.Array(INT, 2, "A", readonly=True))
def facets(vertices: FloatArray, triangles: IntArray) -> npt.NDArray[np.float32]:
    """Unit normal and corners of the triangles that have an area, shape (k, 12).

    Parameters
    ----------
    vertices
        Shape (n, 3).
    triangles
        Indices of their corners, counter-clockwise seen from outside, shape (m, 3).
    """
    found, count = np.empty((len(triangles), 12), np.float32), 0
    for one, two, three in triangles:
        a, b, c = vertices[one], vertices[two], vertices[three]
        x, y, z = b[0] - a[0], b[1] - a[1], b[2] - a[2]
        u, v, w = c[0] - a[0], c[1] - a[1], c[2] - a[2]
        normal_x, normal_y, normal_z = y * w - z * v, z * u - x * w, x * v - y * u
        area = np.sqrt(normal_x * normal_x + normal_y * normal_y + normal_z * normal_z)
        if not area > 0.0:
            continue
        own = found[count]
        own[0], own[1], own[2] = normal_x / area, normal_y / area, normal_z / area
        for axis in range(3):
            own[3 + axis], own[6 + axis], own[9 + axis] = a[axis], b[axis], c[axis]
        count += 1
    return found[:count]
