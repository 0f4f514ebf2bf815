"""The boundary of a pool and its sizes, compiled.

Arguments have the meanings that the package gives.
"""

from __future__ import annotations

import numpy as np

from labapp.core.compiled import FLOAT, FLOATS_1, FLOATS_2, INT
from labapp.core.compiled import compiled as _compiled
from labapp.core.surface.kernels.spline_kernels import (
    accumulate_at_boundary,
    accumulate_splines,
    drop_share,
    height_and_slopes,
)
from labapp.core.values import FloatArray

MOST_BOUNDARY_STEPS = 20
"""Newton steps along a direction, if the boundary does not settle before."""


@_compiled(FLOATS_2, FLOATS_1, FLOATS_1, FLOATS_1, FLOATS_2, FLOATS_1, FLOATS_1, FLOAT)
def newton_to_boundary(
    grid: FloatArray,
    coefficients: FloatArray,
    rear: FloatArray,
    center: FloatArray,
    way: FloatArray,
    radius: FloatArray,
    longest: FloatArray,
    last: float,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Newton steps along m directions to where a surface comes down to its boundary.

    Parameters
    ----------
    grid, coefficients, rear
        See the package.
    center, way, radius
        Where directions start, shape (2,), unit vectors along them, shape (m, 2), and how far out
        the steps begin, shape (m,), mm.
    longest
        Longest step along each direction, shape (m,), mm.
    last
        The steps end after one in which all are shorter, mm.

    Returns
    -------
    radius, boundary_slope, over
        Radii of the boundary, shape (m,), mm. Where each was before its last step: gradient of the
        surface's height over the boundary's, shape (m, 2), and that height, shape (m,), mm.
    """
    count, work = len(radius), np.empty((4, 4))
    out, boundary_slope, over = radius.copy(), np.empty((count, 2)), np.empty(count)
    for _ in range(MOST_BOUNDARY_STEPS):
        most = 0.0
        for k in range(count):
            x, y = center[0] + out[k] * way[k, 0], center[1] + out[k] * way[k, 1]
            z, slope_x, slope_y = height_and_slopes(grid, coefficients, x, y, work)
            share, share_slope = drop_share(rear, y)
            over[k] = z + rear[0] * share
            boundary_slope[k, 0] = slope_x
            boundary_slope[k, 1] = slope_y + rear[0] * share_slope
            outward = boundary_slope[k, 0] * way[k, 0] + boundary_slope[k, 1] * way[k, 1]
            change = -over[k] / outward if abs(outward) > 1e-6 else 0.0
            out[k] += min(max(change, -longest[k]), longest[k])
            most = max(most, abs(change))
        if most < last:
            break
    return out, boundary_slope, over


# --- sizes --------------------------------------------------------------------------------------


@_compiled(FLOATS_2, FLOATS_1, FLOATS_2, FLOATS_1, FLOATS_1, FLOATS_1, FLOATS_1, INT)
def spokes(
    grid: FloatArray,
    coefficients: FloatArray,
    outline: FloatArray,
    center: FloatArray,
    fraction: FloatArray,
    weight: FloatArray,
    rear: FloatArray,
    stride: int,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Sample a surface at fractions of the way from a centre to each ``stride``-th boundary point.

    The number of boundary points is a multiple of ``stride``.

    Returns
    -------
    samples, over, share
        Places with their height, shape (n, 3); height over that of the boundary, shape (n,); weight
        of a sample in the volume, shape (n,): that on its spoke times its share of the wedges of
        all boundary points (`measures.wedges`), those between two spokes shared by how near they
        are.
    """
    count, rings, work = len(outline), len(fraction), np.empty((4, 4))
    wedge = np.empty(count)
    for k in range(count):
        before, after = outline[k - 1], outline[(k + 1) % count]
        x, y = outline[k, 0] - center[0], outline[k, 1] - center[1]
        twice = (before[0] - center[0]) * y - x * (before[1] - center[1])
        twice += x * (after[1] - center[1]) - (after[0] - center[0]) * y
        wedge[k] = twice / 4.0
    samples = np.empty((count // stride * rings, 3))
    over, share = np.empty(len(samples)), np.empty(len(samples))
    for spoke in range(count // stride):
        own = 0.0
        for off in range(1 - stride, stride):
            own += wedge[(spoke * stride + off) % count] * (1.0 - abs(off) / stride)
        end = outline[spoke * stride]
        for ring in range(rings):
            at = spoke * rings + ring
            x = center[0] + fraction[ring] * (end[0] - center[0])
            y = center[1] + fraction[ring] * (end[1] - center[1])
            z, _, _ = height_and_slopes(grid, coefficients, x, y, work)
            samples[at, 0], samples[at, 1], samples[at, 2] = x, y, z
            over[at] = z + rear[0] * drop_share(rear, y)[0]
            share[at] = own * weight[ring] * fraction[ring]
    return samples, over, share


@_compiled(FLOATS_2, INT, FLOATS_2, FLOATS_1, FLOATS_2, FLOATS_2, FLOATS_1, FLOATS_1)
def size_gradients(
    grid: FloatArray,
    count: int,
    samples: FloatArray,
    share: FloatArray,
    outline: FloatArray,
    boundary_slope: FloatArray,
    center: FloatArray,
    rear: FloatArray,
) -> FloatArray:
    """Derivatives of width, length, area and volume, shape (4, p + 1).

    They are by p = ``count`` coefficients and by the drop of the rear. Samples and their weights in
    the volume, ``share``, are those of `spokes`.
    """
    out, work = np.zeros((4, count + 1)), np.empty((4, 4))
    for axis in range(2):
        low, high = 0, 0
        for k in range(len(outline)):
            low = k if outline[k, axis] < outline[low, axis] else low
            high = k if outline[k, axis] > outline[high, axis] else high
        for end, sign in ((high, -1.0), (low, 1.0)):
            moved = sign / boundary_slope[end, axis]
            x, y = outline[end, 0], outline[end, 1]
            accumulate_at_boundary(grid, rear, x, y, moved, work, out[axis])
    for k in range(len(outline)):
        x, y, z = outline[k]
        off_x, off_y = x - center[0], y - center[1]
        # Where the surface rises by dz the boundary moves by −dz over its slope outwards.
        moved = (
            -2.0
            * np.pi
            / len(outline)
            * (off_x * off_x + off_y * off_y)
            / (boundary_slope[k, 0] * off_x + boundary_slope[k, 1] * off_y)
        )
        accumulate_at_boundary(grid, rear, x, y, moved, work, out[2])
        accumulate_at_boundary(grid, rear, x, y, moved * z, work, out[3])
    for k in range(len(samples)):
        accumulate_splines(grid, samples[k, 0], samples[k, 1], share[k], work, out[3])
    return out
