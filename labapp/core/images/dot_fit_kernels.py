"""Inner loops of the joint fit of dots to a picture, compiled for the processor (docs/adr/0018)."""

from __future__ import annotations

import numpy as np
from numba import types

from labapp.core.compiled import compiled as _compiled
from labapp.core.compiled import compiled_for as _compiled_for
from labapp.core.compiled import inner as _inner
from labapp.core.images.centroid_kernels import gaussian_samples
from labapp.core.images.dots import Grey, Picture
from labapp.core.values import FloatArray, IntArray

_f, _i = types.float64, types.int64
_f1 = types.Array(_f, 1, "A", readonly=True)
_f2 = types.Array(_f, 2, "C", readonly=True)
_grey = types.Array(types.float32, 2, "C", readonly=True)
_byte = types.Array(types.uint8, 2, "C", readonly=True)
_ints = types.Array(_i, 1, "A", readonly=True)

NEIGHBOUR_SIZES, AROUND_SIZES = 3.5, 4.0
"""Range of a dot's light and of its blurred light, in standard deviations."""


@_inner
def _between(picture: Grey, u: float, v: float, by: float) -> float:
    """Interpolate a picture that is ``by`` times smaller at a position in the full-size one."""
    height, width = picture.shape
    x = min(max((u + 0.5) / by - 0.5, 0.0), width - 1.0)
    y = min(max((v + 0.5) / by - 0.5, 0.0), height - 1.0)
    i, j = min(int(x), max(width - 2, 0)), min(int(y), max(height - 2, 0))
    right, below = min(i + 1, width - 1), min(j + 1, height - 1)
    x, y = x - i, y - j
    high = (1 - x) * picture[j, i] + x * picture[j, right]
    low = (1 - x) * picture[below, i] + x * picture[below, right]
    return float((1 - y) * high + y * low)


@_compiled(_f1, _f1, _f)
def neighbours(u: FloatArray, v: FloatArray, reach: float) -> tuple[IntArray, IntArray]:
    """Indices of the places within reach of each, concatenated, and the start of each list.

    Place k has the neighbours ``number[begin[k]:begin[k + 1]]``.
    """
    count, total = len(u), 0
    begin = np.zeros(count + 1, np.int64)
    number = np.empty(16 * count + 16, np.int64)
    for k in range(count):
        for other in range(count):
            if other == k or (u[k] - u[other]) ** 2 + (v[k] - v[other]) ** 2 > reach * reach:
                continue
            if total == len(number):
                number = np.append(number, np.empty(total, np.int64))
            number[total] = other
            total += 1
        begin[k + 1] = total
    return number[:total], begin


@_inner
def _patch(
    image: Picture,
    level: tuple[float, float, float],
    dots: FloatArray,
    others: IntArray,
    k: int,
    patch: Grey,
    light: Grey,
    lines: Grey,
) -> None:
    """Compute the residual light about a dot, and the modelled light of all dots there.

    The residual is the image minus all dots and the background, 0 outside the picture. Both have
    shape (side, side).
    """
    (u, v, peak, size), side = dots[k], len(patch)
    left, top = round(u) - side // 2, round(v) - side // 2
    across, down = lines[0, :side], lines[1, :side]
    gaussian_samples(left, u, size, across)
    gaussian_samples(top, v, size, down)
    for y in range(side):
        row, height = light[y], np.float32(peak) * down[y]
        for x in range(side):
            row[x] = height * across[x]
    for other in others:
        u_other, v_other, peak, size = dots[other]
        far = side / 2 + NEIGHBOUR_SIZES * size
        if abs(u_other - u) > far or abs(v_other - v) > far:
            continue
        gaussian_samples(left, u_other, size, across)
        gaussian_samples(top, v_other, size, down)
        for y in range(side):
            row, height = light[y], np.float32(peak) * down[y]
            for x in range(side):
                row[x] += height * across[x]
    first, last = max(-left, 0), min(side, image.shape[1] - left)
    slope = np.float32(level[1])
    for y in range(side):
        row = patch[y]
        if not 0 <= top + y < image.shape[0]:
            row[:] = 0.0
            continue
        dark = np.float32(level[0] + level[1] * (left - u) + level[2] * (top + y - v))
        row[:first] = 0.0
        row[last:] = 0.0
        seen, own = image[top + y, left + first : left + last], light[y, first:last]
        result = row[first:last]
        for x in range(len(result)):
            result[x] = np.float32(seen[x]) - own[x] - (dark + slope * np.float32(first + x))


@_inner
def _level(
    surroundings: Grey, by: float, blur: float, dot: FloatArray
) -> tuple[float, float, float]:
    """Background level at a dot, and its slopes along u and v."""
    u, v, far = dot[0], dot[1], blur / 2
    right, left = _between(surroundings, u + far, v, by), _between(surroundings, u - far, v, by)
    below, above = _between(surroundings, u, v + far, by), _between(surroundings, u, v - far, by)
    slopes = (right - left) / (2 * far), (below - above) / (2 * far)
    return _between(surroundings, u, v, by), slopes[0], slopes[1]


@_inner
def _folded_bell(center: float, by: float, width: float, values: Grey) -> tuple[int, int]:
    """Sample a Gaussian in a ``by`` times smaller picture with reflecting edges.

    Center and width are in pixels of the full-size picture. Returns the range of pixels set.
    """
    count, at, far = len(values), (center + 0.5) / by - 0.5, width / by
    first, last = int(at - AROUND_SIZES * far), int(at + AROUND_SIZES * far) + 1
    values[max(first, 0) : min(last + 1, count)] = 0.0
    begin, end = count, 0
    for k in range(first, last + 1):
        own = -1 - k if k < 0 else (2 * count - 1 - k if k >= count else k)
        if 0 <= own <= last and first <= own < count:
            values[own] += np.exp(-0.5 * ((k - at) / far) ** 2)
            begin, end = min(begin, own), max(end, own + 1)
    return begin, end


@_compiled(_grey, _f, _f, _f2)
def without_dots(around: Grey, by: float, blur: float, dots: FloatArray) -> Grey:
    """Subtract the light of dots, shape (n, 4), from a blurred, ``by`` times smaller picture."""
    result = around.copy()
    across, down = np.empty(around.shape[1], np.float32), np.empty(around.shape[0], np.float32)
    for k in range(len(dots)):
        u, v, peak, size = dots[k]
        wide = size**2 + blur**2
        left, right = _folded_bell(u, by, np.sqrt(wide), across)
        top, bottom = _folded_bell(v, by, np.sqrt(wide), down)
        for y in range(top, bottom):
            row, height = result[y], np.float32(peak * size**2 / wide) * down[y]
            for x in range(left, right):
                row[x] -= height * across[x]
    return result


@_compiled_for(*((own, _grey, _f, _f2, _f1, _ints, _ints, _i) for own in (_grey, _byte)))
def residual_sums(
    image: Picture,
    surroundings: Grey,
    blur: float,
    dots: FloatArray,
    width: FloatArray,
    number: IntArray,
    begin: IntArray,
    margin: int,
) -> FloatArray:
    """Weighted sums of the residual light in each dot's window, shape (n, 6).

    The weights are 1, u, v, the dot's profile, and the profile times r²; the last column is the
    sum of the window.

    Parameters
    ----------
    image, surroundings, blur
        The picture; the background from `without_dots`; the blur's standard deviation, px.
    dots
        Position u, v, peak and size of each dot, shape (n, 4).
    width
        Width of each dot's Gaussian window, shape (n,), px.
    number, begin
        See `neighbours`.
    margin
        Half side of the square about a dot in which light is integrated, px.
    """
    side, result, by = (
        2 * margin + 1,
        np.zeros((len(dots), 6)),
        image.shape[1] / surroundings.shape[1],
    )
    single, away = np.float32, np.empty((2, 2 * margin + 1), np.float32)
    patch, light = np.empty((side, side), single), np.empty((side, side), single)
    lines = np.empty((4, side), single)
    for k in range(len(dots)):
        others = number[begin[k] : begin[k + 1]]
        level = _level(surroundings, by, blur, dots[k])
        _patch(image, level, dots, others, k, patch, light, lines)
        u, v, _, size = dots[k]
        left, top = round(u) - margin, round(v) - margin
        gaussian_samples(left, u, width[k], lines[0])
        gaussian_samples(top, v, width[k], lines[1])
        gaussian_samples(left, u, size, lines[2])
        gaussian_samples(top, v, size, lines[3])
        for x in range(side):
            away[0, x], away[1, x] = left + x - u, (left + x - u) ** 2
            lines[2, x] *= lines[0, x]
        for y in range(side):
            row, row_u, row_own, row_wide = single(0.0), single(0.0), single(0.0), single(0.0)
            for x in range(side):
                value = patch[y, x]
                row += lines[0, x] * value
                row_u += lines[0, x] * value * away[0, x]
                row_own += lines[2, x] * value
                row_wide += lines[2, x] * value * away[1, x]
            away_v, down = top + y - v, lines[1, y]
            result[k, 0] += down * row
            result[k, 1] += down * row_u
            result[k, 2] += down * row * away_v
            down *= lines[3, y]
            result[k, 3] += down * row_own
            result[k, 4] += down * (row_wide + away_v**2 * row_own)
        result[k, 5] = lines[0].sum() * lines[1].sum()
    return result


@_inner
def _add_modes(
    sums: FloatArray, weight: float, q: float, spread: float, moments: FloatArray
) -> None:
    """Add a row's contribution to the projections on the modes; moments up to the fifth."""
    p, less = moments, q * q - 4 * spread
    b, c = 2 * q * q - 12 * spread, q**4 - 12 * spread * q * q + 24 * spread**2
    sums[0] += weight * p[1]
    sums[1] += weight * q * p[0]
    sums[2] += weight * (p[3] + less * p[1])
    sums[3] += weight * q * (p[2] + less * p[0])
    sums[4] += weight * (p[5] + b * p[3] + c * p[1])
    sums[5] += weight * q * (p[4] + b * p[2] + c * p[0])


@_inner
def _add_squares(
    sums: FloatArray, weight: float, q: float, spread: float, moments: FloatArray
) -> None:
    """Add a row's contribution to the sums of squared modes; even moments up to the tenth."""
    s, square, less = moments, q * q, q * q - 4 * spread
    b, c = 2 * q * q - 12 * spread, q**4 - 12 * spread * q * q + 24 * spread**2
    sums[0] += weight * s[1]
    sums[1] += weight * square * s[0]
    sums[2] += weight * (s[3] + 2 * less * s[2] + less * less * s[1])
    sums[3] += weight * square * (s[2] + 2 * less * s[1] + less * less * s[0])
    twice = b * b + 2 * c
    sums[4] += weight * (s[5] + 2 * b * s[4] + twice * s[3] + 2 * b * c * s[2] + c * c * s[1])
    sums[5] += (
        weight * square * (s[4] + 2 * b * s[3] + twice * s[2] + 2 * b * c * s[1] + c * c * s[0])
    )


@_compiled_for(*((own, _grey, _f, _f2, _f1, _ints, _ints, _i) for own in (_grey, _byte)))
def residual_modes(
    image: Picture,
    surroundings: Grey,
    blur: float,
    dots: FloatArray,
    width: FloatArray,
    number: IntArray,
    begin: IntArray,
    margin: int,
) -> FloatArray:
    """Project the residual light of each dot on modes, shape (6, n, 3); see `residual_sums`.

    The modes are windowed polynomials of the position, two each of the first, third and fifth
    order; a shift of a round dot contributes to the first order only. The last axis holds the
    projection, the sum of the squared mode, and the sum of the squared product of mode and light.
    """
    side, result, by = (
        2 * margin + 1,
        np.zeros((6, len(dots), 3)),
        image.shape[1] / surroundings.shape[1],
    )
    single, power = np.float32, np.empty((11, 2 * margin + 1), np.float32)
    patch, light = np.empty((side, side), single), np.empty((side, side), single)
    lines, moments, squares, white = (
        np.empty((2, side), single),
        np.empty(6),
        np.empty(6),
        np.empty(6),
    )
    for k in range(len(dots)):
        others = number[begin[k] : begin[k + 1]]
        level = _level(surroundings, by, blur, dots[k])
        _patch(image, level, dots, others, k, patch, light, lines)
        u, v, _, size = dots[k]
        left, top = round(u) - margin, round(v) - margin
        gaussian_samples(left, u, width[k], lines[0])
        gaussian_samples(top, v, width[k], lines[1])
        spread = 1.0 / (1.0 / width[k] ** 2 + 1.0 / size**2)
        for x in range(side):
            away, value = single(left + x - u), single(1.0)
            for n in range(11):
                power[n, x] = value
                value *= away
        for n in range(6):
            white[n] = 0.0
            for x in range(side):
                white[n] += lines[0, x] * lines[0, x] * power[2 * n, x]
        for y in range(side):
            for n in range(6):
                moment, square = single(0.0), single(0.0)
                for x in range(side):
                    moment += lines[0, x] * patch[y, x] * power[n, x]
                    weighed = lines[0, x] * light[y, x]
                    square += weighed * weighed * power[2 * n, x]
                moments[n], squares[n] = moment, square
            q, down = top + y - v, float(lines[1, y])
            _add_modes(result[:, k, 0], down, q, spread, moments)
            _add_squares(result[:, k, 1], down**2, q, spread, white)
            _add_squares(result[:, k, 2], down**2, q, spread, squares)
    return result
