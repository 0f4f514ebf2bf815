"""Inner loops over the light of each dot, compiled for the processor (docs/adr/0018).

Arrays may be read-only; pictures must be contiguous, other arrays need not be.
"""

from __future__ import annotations

import numpy as np
from numba import types

from labapp.core.compiled import compiled_for as _compiled_for
from labapp.core.compiled import inner as _inner
from labapp.core.images.dots import Grey, Picture
from labapp.core.values import FloatArray, IntArray

_f, _i = types.float64, types.int64
_f1 = types.Array(_f, 1, "A", readonly=True)
_taps, _grey = (types.Array(types.float32, n, "C", readonly=True) for n in (1, 2))
_byte = types.Array(types.uint8, 2, "C", readonly=True)
_ints = types.Array(_i, 1, "A", readonly=True)

SETTLED_PX = 1e-4
"""The iteration ends when a centroid moves by less."""


@_inner
def _mirrored(at: int, count: int) -> int:
    """Index of a pixel with reflection at the edges of the picture."""
    if 0 <= at < count:
        return at
    at %= 2 * count
    return 2 * count - 1 - at if at >= count else at


@_inner
def _convolve(line: Grey, taps: Grey, step: int, count: int, out: Grey) -> None:
    """Convolve a line with a symmetric filter whose taps are ``step`` elements apart.

    The first ``count`` results are written to ``out``.
    """
    rim = len(taps) // 2
    middle, result = line[rim * step :], out[:count]
    for x in range(count):
        result[x] = taps[rim] * middle[x]
    for k in range(rim):
        weight, one, other = taps[k], line[k * step :], line[(2 * rim - k) * step :]
        for x in range(count):
            result[x] += weight * (one[x] + other[x])


@_inner
def _blurred(image: Picture, taps: Grey, u: int, v: int, lines: Grey, patch: Grey) -> None:
    """Blur a square about a pixel, shape (side, any), by a symmetric separable filter.

    ``lines`` is scratch memory for two copies of the square with the filter's margin. Rows are
    stored one after the other; where the filter runs into the next row, the result is not used.
    """
    side, rim = len(patch), len(taps) // 2
    wide, reach = side + 2 * rim, side // 2 + rim
    inside = reach <= v < image.shape[0] - reach and reach <= u < image.shape[1] - reach
    for y in range(wide):
        row = lines[0, y * wide : (y + 1) * wide]
        if inside:
            own = image[v + y - reach, u - reach : u + reach + 1]
            for x in range(wide):
                row[x] = own[x]
        else:
            at_y = _mirrored(v + y - reach, image.shape[0])
            for x in range(wide):
                row[x] = image[at_y, _mirrored(u + x - reach, image.shape[1])]
    _convolve(lines[0], taps, 1, wide * wide - 2 * rim, lines[1])
    _convolve(lines[1], taps, wide, wide * side, lines[0])
    for y in range(side):
        row, own = patch[y], lines[0, y * wide :]
        for x in range(side):
            row[x] = own[x]


@_inner
def _interpolation(at: int, by: float, count: int) -> tuple[int, float]:
    """Index and fraction for interpolation in a picture that is ``by`` times smaller."""
    place = min(max((at + 0.5) / by - 0.5, 0.0), count - 1.0)
    before = min(int(place), max(count - 2, 0))
    return before, place - before


@_inner
def _subtract_background(
    patch: Grey, around: Grey, by: float, u: int, v: int, shape: tuple[int, int], across: Grey
) -> None:
    """Subtract the background, a downsampled picture, from a patch whose first pixel is (u, v).

    Negative differences and pixels outside the picture are set to 0.
    """
    (side, padded), zero = patch.shape, np.float32(0.0)
    top, _ = _interpolation(v, by, around.shape[0])
    last, _ = _interpolation(v + side - 1, by, around.shape[0])
    last = min(last + 1, around.shape[0] - 1)
    for x in range(padded):
        column, on = _interpolation(u + x, by, around.shape[1])
        after = min(column + 1, around.shape[1] - 1)
        for row in range(top, last + 1):
            low, high = around[row, column], around[row, after]
            across[row - top, x] = low + np.float32(on) * (high - low)
    first_x, last_x = max(-u, 0), min(side, shape[1] - u)
    for y in range(side):
        if not 0 <= v + y < shape[0]:
            patch[y] = zero
            continue
        row, part = _interpolation(v + y, by, around.shape[0])
        low, high = across[row - top], across[min(row + 1, last) - top]
        share = np.float32(part)
        for x in range(padded):
            light = patch[y, x] - (low[x] + share * (high[x] - low[x]))
            patch[y, x] = light if light > zero else zero
        patch[y, :first_x] = zero
        patch[y, last_x:] = zero


@_inner
def gaussian_samples(first: int, center: float, width: float, values: Grey) -> None:
    """Sample a Gaussian at consecutive integers, by a recursive ratio of neighbouring values.

    Parameters
    ----------
    first, center, width
        First integer; mean and standard deviation of the Gaussian, whose peak value is 1.
    values
        Output array, shape (n,).
    """
    away = first - center
    value = np.exp(-0.5 * (away / width) ** 2)
    ratio, shrinks = np.exp(-(away + 0.5) / width**2), np.exp(-1.0 / width**2)
    for k in range(len(values)):
        values[k] = value
        value *= ratio
        ratio *= shrinks


@_inner
def _centroid(patch: Grey, place: FloatArray, width: float, reach: float, lines: Grey) -> float:
    """Set a place, shape (2,), relative to the patch's middle, to the centroid; return the moment.

    The light is weighted by a Gaussian window that follows the centroid; the moment is the sum of
    the second central moments along u and v, px². ``lines`` is scratch memory for four rows.
    """
    (side, padded), moment = patch.shape, 0.0
    along_u, along_v, pull_u, pull_v = lines[0], lines[1], lines[2], lines[3]
    pull_u[side:] = 0.0
    for _ in range(4):
        gaussian_samples(-(side // 2), place[0], width, pull_u[:side])
        gaussian_samples(-(side // 2), place[1], width, pull_v[:side])
        along_u[:] = 0.0
        for y in range(side):
            row = np.float32(0.0)
            for x in range(padded):
                weighed = patch[y, x] * pull_u[x]
                row += weighed
                along_u[x] += pull_v[y] * weighed
            along_v[y] = pull_v[y] * row
        total, mean_u, mean_v, square = 1e-12, 0.0, 0.0, 0.0
        for at in range(side):
            away = at - side // 2
            total += along_u[at]
            mean_u += along_u[at] * away
            mean_v += along_v[at] * away
            square += (along_u[at] + along_v[at]) * away * away
        mean_u, mean_v = mean_u / total, mean_v / total
        moment = square / total - mean_u * mean_u - mean_v * mean_v
        # The window biases the mean towards its centre: over-relaxation speeds up convergence.
        change_u, change_v = 1.5 * (mean_u - place[0]), 1.5 * (mean_v - place[1])
        place[0] = min(max(place[0] + change_u, -reach), reach)
        place[1] = min(max(place[1] + change_v, -reach), reach)
        if max(abs(change_u), abs(change_v)) < SETTLED_PX:
            break
    return moment


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
    """Compute centroids and second moments of the light about pixels (`band_pass._described`).

    The light is the image, blurred by a symmetric filter, minus the background ``around``, which
    may be downsampled. Centroids are offsets from the pixels, shape (2, n), px; a moment is the sum
    of the second central moments along u and v, shape (n,), px².
    """
    count, side, rim = len(u), 2 * margin + 1, len(taps) // 2
    padded = (side + 7) // 8 * 8  # for vector instructions
    by, single = image.shape[1] / around.shape[1], np.float32
    offset, moment, patch = np.zeros((2, count)), np.empty(count), np.zeros((side, padded), single)
    squares, across = (
        np.zeros((2, (side + 2 * rim) ** 2), single),
        np.empty((side + 2, padded), single),
    )
    lines = np.empty((4, padded), single)
    for k in range(count):
        _blurred(image, taps, u[k], v[k], squares, patch)
        _subtract_background(patch, around, by, u[k] - margin, v[k] - margin, image.shape, across)
        moment[k] = _centroid(patch, offset[:, k], width[k], reach, lines)
    return offset, moment


@_compiled_for(*((own, _ints, _ints, _grey, _grey) for own in (_grey, _byte)))
def largest_fine_response(
    image: Picture, u: IntArray, v: IntArray, narrow: Grey, wide: Grey
) -> FloatArray:
    """Largest difference of two filters in the 3 × 3 pixels about each.

    The filters, shape (3, side), are those of `band_pass._shifted_gaussians`.
    """
    side, result = narrow.shape[1], np.empty(len(u))
    column, across = np.empty(side, np.float32), np.empty((6, side), np.float32)
    filters = np.concatenate((narrow, wide))
    for k in range(len(u)):
        across[:] = 0.0
        for x in range(side):
            at_x = _mirrored(u[k] + x - side // 2, image.shape[1])
            for y in range(side):
                column[y] = image[_mirrored(v[k] + y - side // 2, image.shape[0]), at_x]
            for j in range(6):
                weight, own = filters[j, x], across[j]
                for y in range(side):
                    own[y] += weight * column[y]
        most = np.float32(-np.inf)
        for i in range(3):
            for j in range(3):
                value = np.float32(0.0)
                for y in range(side):
                    value += narrow[i, y] * across[j, y] - wide[i, y] * across[3 + j, y]
                most = max(most, value)
        result[k] = most
    return result
