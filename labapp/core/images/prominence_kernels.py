"""Prominence of peaks of a picture, compiled (`band_pass`, docs/adr/0018)."""

from __future__ import annotations

import numpy as np
from numba import types

from labapp.core.compiled import compiled as _compiled
from labapp.core.compiled import inner as _inner
from labapp.core.images.dots import Grey
from labapp.core.union_find_kernels import root
from labapp.core.values import FloatArray, IntArray

_grey = types.Array(types.float32, 2, "C", readonly=True)
_ints = types.Array(types.int64, 1, "A", readonly=True)


@_inner
def _pixels_downwards(band: Grey, low: Grey) -> IntArray:
    """Rows and columns of the pixels that exceed ``low``, the highest first, shape (n, 2)."""
    height, width = band.shape
    places, values, count = np.empty((band.size, 2), np.int64), np.empty(band.size, np.float32), 0
    for v in range(height):
        for u in range(width):
            if band[v, u] > low[v, u]:
                places[count, 0], places[count, 1], values[count] = v, u, -band[v, u]
                count += 1
    return places[:count][np.argsort(values[:count])]


@_compiled(_grey, _grey, _ints, _ints)
def prominences(band: Grey, low: Grey, x: IntArray, y: IntArray) -> FloatArray:
    """Height of peaks over the highest saddle on the way to a higher one.

    Regions grow from the highest pixels down; where two meet, the lower peak ends: its prominence
    is the persistence of Edelsbrunner, Letscher and Zomorodian (2002, Discrete Comput. Geom. 28,
    511–533).

    Parameters
    ----------
    band, low
        Shape (height, width). Pixels that do not exceed ``low`` are on no way.
    x, y
        Columns and rows of n peaks, or of pixels next to them.

    Returns
    -------
    FloatArray
        Shape (n,); infinite where no way leads to a higher peak, 0 where there is no peak.
    """
    (height, width), over = band.shape, _pixels_downwards(band, low)
    # With a rim of pixels that are in no region.
    rank, parent = np.full((height + 2, width + 2), -1, np.int64), np.arange(len(over))
    prominence = np.full(len(over), np.inf)
    for k in range(len(over)):
        v, u = over[k]
        rank[v + 1, u + 1] = k
        for beside in rank[v : v + 3, u : u + 3].flat:
            if beside < 0:
                continue
            own, other = root(parent, k), root(parent, beside)
            if own != other:
                lower = max(own, other)
                parent[lower] = min(own, other)
                prominence[lower] = band[over[lower, 0], over[lower, 1]] - band[v, u]
    found = np.zeros(len(x))
    for n in range(len(x)):
        for beside in rank[y[n] : y[n] + 3, x[n] : x[n] + 3].flat:
            if beside >= 0:
                found[n] = max(found[n], prominence[beside])
    return found
