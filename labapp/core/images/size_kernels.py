"""Inner loops of the estimates of noise and dot size, compiled (`dot_size`, docs/adr/0018).

Arrays may be read-only; pictures must be contiguous, other arrays need not be.
"""

from __future__ import annotations

import numpy as np
from numba import types

from labapp.core.compiled import compiled as _compiled
from labapp.core.compiled import compiled_for as _compiled_for
from labapp.core.compiled import inner as _inner
from labapp.core.images.dots import Grey, Picture
from labapp.core.values import BoolArray, FloatArray, IntArray

_f, _i = types.float64, types.int64
_f1, _f2 = (types.Array(_f, n, "A", readonly=True) for n in (1, 2))
_grey = types.Array(types.float32, 2, "C", readonly=True)
_byte = types.Array(types.uint8, 2, "C", readonly=True)
_ints = types.Array(_i, 1, "A", readonly=True)


BINS = 256
"""Bins in which values are counted to find their median."""


@_inner
def _median(values: Grey) -> float:
    """Median of values ≥ 0, shape (n,): the bin that contains it is found first, then sorted.

    `np.median` partitions all values, which takes several times as long.
    """
    most = values.max()
    if not 0.0 < most < np.inf:  # NaN, too
        return float(np.median(values))
    counts, place, per_value = np.zeros(BINS, np.int64), np.empty(len(values), np.int64), 1 / most
    for k in range(len(values)):
        place[k] = min(int((BINS - 1) * (values[k] * per_value)), BINS - 1)
        counts[place[k]] += 1
    low, high = (len(values) - 1) // 2, len(values) // 2
    first, before = 0, 0
    while before + counts[first] <= low:
        before += counts[first]
        first += 1
    last, until = first, before + counts[first]
    while until <= high:
        last += 1
        until += counts[last]
    near = np.sort(values[(place >= first) & (place <= last)])
    return float((near[low - before] + near[high - before]) / 2)


@_compiled_for(*((own, _i, _i) for own in (_grey, _byte)))
def tile_noise(image: Picture, rows: int, columns: int) -> Grey:
    """Estimate the noise in a picture's tiles, shape (rows, columns); see `dot_size.local_noise`.

    Every second pixel of every second row is used.
    """
    height, width = image.shape
    result = np.empty((rows, columns), np.float32)
    for i in range(rows):
        top, bottom = max(i * height // rows, 1), min((i + 1) * height // rows, height - 1)
        for j in range(columns):
            left, right = max(j * width // columns, 1), min((j + 1) * width // columns, width - 1)
            some = np.empty(((bottom - top + 1) // 2) * ((right - left + 1) // 2), np.float32)
            count = 0
            for v in range(top, bottom, 2):
                for u in range(left, right, 2):
                    sides = float(image[v - 1, u]) + float(image[v + 1, u])
                    sides += float(image[v, u - 1]) + float(image[v, u + 1])
                    ends = float(image[v - 1, u - 1]) + float(image[v + 1, u + 1])
                    ends += float(image[v - 1, u + 1]) + float(image[v + 1, u - 1])
                    some[count] = abs(4.0 * float(image[v, u]) - 2.0 * sides + ends) / 6.0
                    count += 1
            result[i, j] = _median(some)
    return result


@_compiled(_grey, _ints, _ints, _f)
def responses(band: Grey, u: IntArray, v: IntArray, step: float) -> FloatArray:
    """Largest of 3 × 3 values of a ``step`` times smaller picture about each full-size pixel."""
    height, width = band.shape
    result = np.empty(len(u))
    for k in range(len(u)):
        x, y = round((u[k] + 0.5) / step - 0.5), round((v[k] + 0.5) / step - 0.5)
        most = -np.inf
        for at_y in range(max(y - 1, 0), min(y + 2, height)):
            for at_x in range(max(x - 1, 0), min(x + 2, width)):
                most = max(most, band[at_y, at_x])
        result[k] = most
    return result


@_compiled(_f2, _f1, _f2, _f1, _f, _f)
def parts(
    places: FloatArray,
    strength: FloatArray,
    wholes: FloatArray,
    of_whole: FloatArray,
    within: float,
    share: float,
) -> BoolArray:
    """Whether each place is near a whole with at least a share of the place's strength.

    Places and wholes have shapes (n, 2) and (m, 2).
    """
    result = np.zeros(len(places), np.bool_)
    for k in range(len(places)):
        for m in range(len(wholes)):
            x, y = places[k, 0] - wholes[m, 0], places[k, 1] - wholes[m, 1]
            if x * x + y * y <= within * within and of_whole[m] >= share * strength[k]:
                result[k] = True
                break
    return result
