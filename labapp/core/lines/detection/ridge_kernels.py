"""Compiled loops that link ridge points to chains."""

from __future__ import annotations

import numpy as np
from numba import types

from labapp.core.compiled import compiled as _compiled
from labapp.core.compiled import inner as _inner
from labapp.core.values import FloatArray, IntArray

_i, _f = types.int64, types.float64
_index = types.Array(types.int32, 2, "C")
_f1, _f2 = types.Array(_f, 1, "C"), types.Array(_f, 2, "C")
_i1, _i2 = types.Array(_i, 1, "C"), types.Array(_i, 2, "C")


@_inner
def _next_point(
    index: IntArray,
    pixel: IntArray,
    place: FloatArray,
    tangent: FloatArray,
    free: IntArray,
    at: int,
) -> int:
    """Neighbour of point ``at`` that continues along ``tangent[-1]``; −1 if there is none."""
    height, width = index.shape
    forth_u, forth_v = tangent[-1, 0], tangent[-1, 1]
    best, least = -1, 1e9
    for du in range(-2, 3):
        for dv in range(-2, 3):
            u, v = pixel[at, 0] + du, pixel[at, 1] + dv
            if u < 0 or v < 0 or u >= width or v >= height:
                continue
            other = index[v, u]
            if other < 0 or free[other] == 0:
                continue
            step_u, step_v = place[other, 0] - place[at, 0], place[other, 1] - place[at, 1]
            length = np.sqrt(step_u * step_u + step_v * step_v)
            ahead = step_u * forth_u + step_v * forth_v
            turn = abs(tangent[other, 0] * forth_u + tangent[other, 1] * forth_v)
            if length < 0.3 or length > 2.3 or ahead < 0.7 * length or turn < 0.7:
                continue
            cost = length + 2.0 * (1.0 - ahead / length) + 2.0 * (1.0 - turn)
            if cost < least:
                best, least = other, cost
    return best


@_inner
def _take_beside(
    index: IntArray,
    pixel: IntArray,
    place: FloatArray,
    along: FloatArray,
    free: IntArray,
    at: int,
) -> None:
    """Mark the points beside, not ahead of, a ridge point as used: they are the same ridge."""
    height, width = index.shape
    for du in range(-1, 2):
        for dv in range(-1, 2):
            u, v = pixel[at, 0] + du, pixel[at, 1] + dv
            if 0 <= u < width and 0 <= v < height and index[v, u] >= 0:
                beside = index[v, u]
                ahead = (place[beside, 0] - place[at, 0]) * along[0]
                ahead += (place[beside, 1] - place[at, 1]) * along[1]
                if ahead < 0.5:
                    free[beside] = 0


@_compiled(_index, _i2, _f2, _f2, _i1, _i)
def link(
    index: IntArray,
    pixel: IntArray,
    place: FloatArray,
    tangent: FloatArray,
    order: IntArray,
    seeds: int,
) -> tuple[IntArray, IntArray]:
    """Link ridge points to chains in both directions, starting from the strongest.

    Parameters
    ----------
    index
        Number of the point in each pixel, −1 if there is none, shape (height, width), int32.
    pixel, place, tangent
        Pixel (u, v), position (u, v), px, and unit vector along the ridge of n points, each shape
        (n, 2); ``tangent`` has one more row, which is used as work space.
    order
        Point numbers from the strongest to the weakest, shape (n,).
    seeds
        Number of the strongest points that may start a chain.

    Returns
    -------
    tuple
        Points of all chains, concatenated, and the start index of each chain, plus the end.
    """
    count = len(order)
    free = np.ones(count, np.int64)
    points, starts = np.empty(count, np.int64), np.zeros(count + 1, np.int64)
    filled, chains = 0, 0
    side = np.empty(count, np.int64)
    for rank in range(seeds):
        seed = order[rank]
        if free[seed] == 0:
            continue
        free[seed] = 0
        first = filled
        for sign in (-1.0, 1.0):
            tangent[-1] = sign * tangent[seed]
            at, long = seed, 0
            while True:
                other = _next_point(index, pixel, place, tangent, free, at)
                if other < 0:
                    break
                along = tangent[other, 0] * tangent[-1, 0] + tangent[other, 1] * tangent[-1, 1]
                tangent[-1] = tangent[other] if along > 0 else -tangent[other]
                _take_beside(index, pixel, place, tangent[-1], free, other)
                free[other] = 0
                side[long] = other
                long += 1
                at = other
            if sign < 0:
                for k in range(long):
                    points[filled + k] = side[long - 1 - k]
                points[filled + long] = seed
                filled += long + 1
            else:
                points[filled : filled + long] = side[:long]
                filled += long
        if filled > first:
            chains += 1
            starts[chains] = filled
    return points[:filled], starts[: chains + 1]
