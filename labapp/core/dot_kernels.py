"""Inner loops over the dots of a frame, compiled for the processor (docs/adr/0018).

Arrays may be read-only, and of any layout but for pictures.
"""

from __future__ import annotations

import numpy as np
from numba import types

from labapp.core.compiled import compiled as _compiled
from labapp.core.compiled import compiled_for as _compiled_for
from labapp.core.compiled import part as _inner
from labapp.core.dots import Grey, Picture
from labapp.core.values import BoolArray, FloatArray, IntArray

_f, _i = types.float64, types.int64
_f1, _f2 = (types.Array(_f, n, "A", readonly=True) for n in (1, 2))
_taps, _grey = (types.Array(types.float32, n, "C", readonly=True) for n in (1, 2))
_byte = types.Array(types.uint8, 2, "C", readonly=True)
_ints = types.Array(_i, 1, "A", readonly=True)
_mask = types.Array(types.boolean, 2, "C", readonly=True)


@_compiled(_f2, _f2, _f2)
def on_plane(
    matrix: FloatArray, image: FloatArray, sigma: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Put dots of some standard deviations on the imaging plane (`ImageCalibration`).

    Gives the places, shape (n, 2), their covariance and how many mm a pixel is there, shape (n,).
    """
    count = len(image)
    plane, covariance, scale = np.empty((count, 2)), np.empty((count, 2, 2)), np.empty(count)
    by = np.empty((2, 2))
    for k in range(count):
        u, v = image[k, 0], image[k, 1]
        w = matrix[2, 0] * u + matrix[2, 1] * v + matrix[2, 2]
        for i in range(2):
            plane[k, i] = (matrix[i, 0] * u + matrix[i, 1] * v + matrix[i, 2]) / w
            for j in range(2):
                by[i, j] = (matrix[i, j] - plane[k, i] * matrix[2, j]) / w
        for i in range(2):
            for j in range(2):
                covariance[k, i, j] = (
                    by[i, 0] * by[j, 0] * sigma[k, 0] ** 2 + by[i, 1] * by[j, 1] * sigma[k, 1] ** 2
                )
        scale[k] = np.sqrt(abs(by[0, 0] * by[1, 1] - by[0, 1] * by[1, 0]))
    return plane, covariance, scale


@_compiled(_f2, _f2)
def two_nearest(places: FloatArray, among: FloatArray) -> tuple[FloatArray, IntArray]:
    """Distance and number of the two nearest of some places, shape (m, 2), from each of others.

    Shapes (n, 2); where there is no second one it is infinitely far off and has the number m.
    """
    count = len(places)
    distance, number = np.empty((count, 2)), np.empty((count, 2), np.int64)
    among_x, among_y, square = among[:, 0].copy(), among[:, 1].copy(), np.empty(len(among))
    for k in range(count):
        for m in range(len(among)):
            x, y = places[k, 0] - among_x[m], places[k, 1] - among_y[m]
            square[m] = x * x + y * y
        first, second, one, other = np.inf, np.inf, len(among), len(among)
        for m in range(len(among)):
            if square[m] < second:
                if square[m] < first:
                    second, other = first, one
                    first, one = square[m], m
                else:
                    second, other = square[m], m
        distance[k, 0], distance[k, 1] = np.sqrt(first), np.sqrt(second)
        number[k, 0], number[k, 1] = one, other
    return distance, number


@_inner
def _tops(band: Grey, disc: BoolArray, v: int, u: int) -> bool:
    """Whether no pixel of a disc round one is over it."""
    (height, width), reach, own = band.shape, len(disc) // 2, band[v, u]
    if (u > 0 and band[v, u - 1] > own) or (u < width - 1 and band[v, u + 1] > own):
        return False  # most are told by their neighbours
    for y in range(max(v - reach, 0), min(v + reach + 1, height)):
        for x in range(max(u - reach, 0), min(u + reach + 1, width)):
            if disc[y - v + reach, x - u + reach] and band[y, x] > own:
                return False
    return True


@_compiled(_grey, _mask, _ints)
def peaks(band: Grey, disc: BoolArray, pixels: IntArray) -> IntArray:
    """Columns and rows, shape (2, n), of those of some pixels that none of a disc is over."""
    found, count = np.empty((2, len(pixels)), np.int64), 0
    for at in pixels:
        v, u = at // band.shape[1], at % band.shape[1]
        if _tops(band, disc, v, u):
            found[0, count], found[1, count] = u, v
            count += 1
    return found[:, :count].copy()


@_inner
def _mirrored(at: int, count: int) -> int:
    """A pixel's number where a picture goes on beyond its edge as in a mirror."""
    at %= 2 * count
    return 2 * count - 1 - at if at >= count else at


@_inner
def _blurred(
    image: Picture, taps: Grey, u: int, v: int, raw: Grey, rows: Grey, patch: Grey, reach: int
) -> None:
    """Blur a square round a pixel by a filter along rows and columns; rows may be longer."""
    side = 2 * reach + 1
    inside = reach <= v < image.shape[0] - reach and reach <= u < image.shape[1] - reach
    for y in range(side):
        at_y = v + y - reach if inside else _mirrored(v + y - reach, image.shape[0])
        for x in range(side):
            at_x = u + x - reach
            raw[y, x] = image[at_y, at_x if inside else _mirrored(at_x, image.shape[1])]
        for x in range(rows.shape[1]):
            rows[y, x] = 0.0
        for k in range(len(taps)):
            for x in range(rows.shape[1]):
                rows[y, x] += taps[k] * raw[y, x + k]
    for y in range(len(patch)):
        for x in range(rows.shape[1]):
            patch[y, x] = 0.0
        for k in range(len(taps)):
            for x in range(rows.shape[1]):
                patch[y, x] += taps[k] * rows[y + k, x]


@_inner
def _bell(center: float, width: float, values: FloatArray) -> None:
    """A Gaussian at whole numbers round 0: each value is the last times what shrinks evenly."""
    away = -(len(values) // 2) - center
    value = np.exp(-0.5 * (away / width) ** 2)
    ratio, shrinks = np.exp(-(away + 0.5) / width**2), np.exp(-1.0 / width**2)
    for k in range(len(values)):
        values[k] = value
        value *= ratio
        ratio *= shrinks


@_compiled_for(*((own, _grey, _taps, _ints, _ints, _i, _f1, _f) for own in (_grey, _byte)))
def centroids(
    image: Picture,
    around: Grey,
    taps: Grey,
    u: IntArray,
    v: IntArray,
    margin: int,
    width: FloatArray,
    reach: float,
) -> tuple[FloatArray, FloatArray]:
    """Centroids and second moments of light round pixels: see `dots.centroids`.

    Light is the image, blurred by a filter, over what is around it, another picture.
    """
    count, side, rim = len(u), 2 * margin + 1, len(taps) // 2
    even = (side + 7) // 8 * 8  # numbers are added eight at a time
    offset, moment, patch = np.zeros((2, count)), np.empty(count), np.zeros((side, even))
    raw = np.zeros((side + 2 * rim, even + 2 * rim), np.float32)
    rows = np.empty((side + 2 * rim, even), np.float32)
    blurred = np.empty((side, even), np.float32)
    along_u, along_v = np.empty(even), np.empty(side)
    pull_u, pull_v = np.zeros(even), np.empty(side)
    for k in range(count):
        _blurred(image, taps, u[k], v[k], raw, rows, blurred, margin + rim)
        patch[:] = 0.0
        first_y, last_y = max(margin - v[k], 0), min(side, image.shape[0] - v[k] + margin)
        first_x, last_x = max(margin - u[k], 0), min(side, image.shape[1] - u[k] + margin)
        for y in range(first_y, last_y):
            for x in range(first_x, last_x):
                light = blurred[y, x] - around[v[k] + y - margin, u[k] + x - margin]
                patch[y, x] = max(light, 0.0)
        for _ in range(4):
            _bell(offset[0, k], width[k], pull_u[:side])
            _bell(offset[1, k], width[k], pull_v)
            along_u[:] = 0.0
            for y in range(side):
                row = 0.0
                for x in range(even):
                    weighed = patch[y, x] * pull_u[x]
                    row += weighed
                    along_u[x] += pull_v[y] * weighed
                along_v[y] = pull_v[y] * row
            total, mean_u, mean_v, square = 1e-12, 0.0, 0.0, 0.0
            for at in range(side):
                away = at - margin
                total += along_u[at]
                mean_u += along_u[at] * away
                mean_v += along_v[at] * away
                square += (along_u[at] + along_v[at]) * away * away
            mean_u, mean_v = mean_u / total, mean_v / total
            moment[k] = square / total - mean_u * mean_u - mean_v * mean_v
            # The window holds the mean back; half as much again brings it home in a few steps.
            offset[0, k] += 1.5 * (mean_u - offset[0, k])
            offset[1, k] += 1.5 * (mean_v - offset[1, k])
            offset[0, k] = min(max(offset[0, k], -reach), reach)
            offset[1, k] = min(max(offset[1, k], -reach), reach)
    return offset, moment


@_compiled_for(*((own, _ints, _ints, _grey, _grey) for own in (_grey, _byte)))
def finest(image: Picture, u: IntArray, v: IntArray, narrow: Grey, wide: Grey) -> FloatArray:
    """Largest difference of two filters among nine pixels round each (`quick_dots._nine`)."""
    side, made = narrow.shape[1], np.empty(len(u))
    patch, across = np.empty((side, side)), np.empty((2, side, 3))
    for k in range(len(u)):
        for y in range(side):
            at_y = _mirrored(v[k] + y - side // 2, image.shape[0])
            for x in range(side):
                patch[y, x] = image[at_y, _mirrored(u[k] + x - side // 2, image.shape[1])]
        for y in range(side):
            for j in range(3):
                across[0, y, j] = across[1, y, j] = 0.0
                for x in range(side):
                    across[0, y, j] += narrow[j, x] * patch[y, x]
                    across[1, y, j] += wide[j, x] * patch[y, x]
        most = -np.inf
        for i in range(3):
            for j in range(3):
                value = 0.0
                for y in range(side):
                    value += narrow[i, y] * across[0, y, j] - wide[i, y] * across[1, y, j]
                most = max(most, value)
        made[k] = most
    return made


@_compiled(_ints, _ints, _f)
def first_of_each(u: IntArray, v: IntArray, within: float) -> IntArray:
    """Numbers of the pixels that none before them is near that stays: `dots.first_of_each`."""
    kept = np.empty(len(u), np.int64)
    count = 0
    for k in range(len(u)):
        alone = True
        for m in range(count):
            x, y = u[k] - u[kept[m]], v[k] - v[kept[m]]
            if x * x + y * y <= within * within:
                alone = False
                break
        if alone:
            kept[count] = k
            count += 1
    return kept[:count].copy()
