"""Inner loops over the dots of a frame, compiled for the processor (docs/adr/0018).

Arrays may be read-only, and of any layout but for pictures.
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


@_inner
def _any_over(values: Grey, floor: Grey) -> bool:
    """Whether any of some values is over its floor; all are looked at, several at once."""
    some = np.int32(0)
    for k in range(len(values)):
        some |= np.int32(values[k] > floor[k])
    return bool(some)


BLOCK = 32
"""So many pixels of a row are passed over at once where none is over its floor."""


@_compiled(_grey, _grey, _mask)
def peaks(band: Grey, floor: Grey, disc: BoolArray) -> IntArray:
    """Columns and rows, shape (2, n), of pixels over the floor that none of a disc is over.

    A floor of shape (1, 1) holds everywhere.
    """
    height, width = band.shape
    found, count = np.empty((2, 256), np.int64), 0
    level = np.full(width, floor[0, 0])
    for v in range(height):
        own, floors = band[v], level if floor.size == 1 else floor[v]
        for first in range(0, width, BLOCK):
            last = min(first + BLOCK, width)
            for u in range(
                first, last if _any_over(own[first:last], floors[first:last]) else first
            ):
                if not (own[u] > floors[u] and _tops(band, disc, v, u)):
                    continue
                if count == found.shape[1]:
                    more = np.empty((2, 2 * count), np.int64)
                    more[:, :count] = found
                    found = more
                found[0, count], found[1, count] = u, v
                count += 1
    return found[:, :count].copy()


@_compiled(_grey, _ints, _ints, _f)
def ridges(band: Grey, u: IntArray, v: IntArray, slender: float) -> BoolArray:
    """Whether peaks are so many times more curved one way than the other; edges are mirrors."""
    (height, width), made = band.shape, np.empty(len(u), np.bool_)
    for k in range(len(u)):
        above, below = abs(v[k] - 1), height - 1 - abs(height - 2 - v[k])
        left, right = abs(u[k] - 1), width - 1 - abs(width - 2 - u[k])
        own = 2.0 * band[v[k], u[k]]
        across = own - band[v[k], left] - band[v[k], right]
        along = own - band[above, u[k]] - band[below, u[k]]
        skew = band[above, left] + band[below, right] - band[above, right] - band[below, left]
        both = across * along - skew * skew / 16.0
        made[k] = slender * (across + along) ** 2 > (1.0 + slender) ** 2 * both
    return made


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
    """Centroids and second moments of light round pixels: see `band_pass._described`.

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


@_inner
def _beside(image: Picture, v: int, u: int, away: int) -> float:
    """Mean of the two pixels so far above and below one, or left and right, whichever is less.

    Beyond an edge the picture is mirrored at its last pixel.
    """
    height, width = image.shape
    above, below, left, right = v - away, v + away, u - away, u + away
    if above < 0 or below >= height or left < 0 or right >= width:
        above, below = abs(above), height - 1 - abs(height - 1 - below)
        left, right = abs(left), width - 1 - abs(width - 1 - right)
    along = float(image[above, u]) + float(image[below, u])
    across = float(image[v, left]) + float(image[v, right])
    return 0.5 * min(along, across)


@_inner
def _falls(image: Picture, v: int, falls: Grey) -> None:
    """How far the light falls from each pixel of a row to what is beside it, grey levels."""
    (height, width), first, last = image.shape, 0, 0
    if 2 <= v < height - 2 and width > 4:  # no edge between these: several are taken at once
        first, last = 2, width - 2
        row, inner = image[v], falls[first:last]
        rows = image[v - 2, 2:], image[v - 1, 2:], image[v + 1, 2:], image[v + 2, 2:]
        _falls_amid(row[first:last], row, row[1:], row[3:], row[4:], rows, inner)
    for k in range(first + width - last):
        u = k if k < first else last + k - first
        falls[u] = float(image[v, u]) - min(_beside(image, v, u, 1), _beside(image, v, u, 2))


@_inner
def _falls_amid(
    own: Picture,
    before: Picture,
    left: Picture,
    right: Picture,
    after: Picture,
    rows: tuple[Picture, Picture, Picture, Picture],
    falls: Grey,
) -> None:
    """Do what `_falls` does where no edge is near, of pixels and those beside them, shape (n,)."""
    single, half = np.float32, np.float32(0.5)
    top, above, below, bottom = rows
    for u in range(len(falls)):
        one, other = single(above[u]) + single(below[u]), single(left[u]) + single(right[u])
        near = one if one < other else other
        one, other = single(top[u]) + single(bottom[u]), single(before[u]) + single(after[u])
        far = one if one < other else other
        falls[u] = single(own[u]) - half * (near if near < far else far)


@_inner
def _darkest(image: Picture, v: int, u: int, reach: int, step: int) -> float:
    """Least of every ``step``-th pixel of a square round one, what is within the picture."""
    (height, width), least = image.shape, float(image[v, u])
    for y in range(v - reach, v + reach + 1, step):
        for x in range(u - reach, u + reach + 1, step):
            if 0 <= y < height and 0 <= x < width:
                least = min(least, float(image[y, x]))
    return least


@_inner
def _times_deeper(
    over_ground: float, one: float, two: float, near: float, far: float, sharper: float
) -> float:
    """How many times deeper a pixel falls than a dot's: towards the next pixels or those beyond."""
    times = over_ground / max(near * one, 1e-3 * over_ground)
    return times if times > sharper else over_ground / max(far * two, 1e-3 * over_ground)


@_compiled_for(*((own, _f, _f, _f, _i) for own in (_grey, _byte)))
def spikes(
    image: Picture, over: float, size: float, sharper: float, reach: int
) -> tuple[IntArray, FloatArray]:
    """Pixels that no dot has: columns and rows, shape (2, n).

    Light of dots that are Gaussians of this size or larger, however many, falls from a pixel to the
    mean of two on both sides of it at most as one Gaussian does from its top. Spikes fall so many
    times deeper, towards the darkest pixel of a square of half side ``reach``, and ``over`` grey
    levels besides. Asked for are the pixels next to it and next to those, as some spikes are of two
    by two pixels. The second array, shape (2, n), is how many times deeper each falls and what is
    beside it, grey levels.
    """
    height, width = image.shape
    found, told, count = np.empty((2, 64), np.int64), np.empty((2, 64)), 0
    near, far = np.exp(0.5 / size**2), np.exp(2.0 / size**2)
    far = far if far < 4.0 else np.inf  # dots so small have no light so far off
    falls, floor = np.empty(width, np.float32), np.full(width, np.float32(over))
    for v in range(height):
        _falls(image, v, falls)
        for first in range(0, width, BLOCK):
            last = min(first + BLOCK, width)
            for u in range(
                first, last if _any_over(falls[first:last], floor[first:last]) else first
            ):
                if not falls[u] > floor[u]:
                    continue
                own = float(image[v, u])
                one, two = _beside(image, v, u, 1), _beside(image, v, u, 2)
                # The darkest of some pixels may show already that it falls no deeper.
                for step in (reach, 1):
                    ground = _darkest(image, v, u, reach, step)
                    high, low, lower = own - ground - over, one - ground, two - ground
                    times = _times_deeper(high, low, lower, near, far, sharper)
                    if high > 0.0 and times <= sharper:
                        break
                if not (high > 0.0 and times > sharper):
                    continue
                fit = two
                if high > sharper * max(near * low, 1e-3 * high):
                    # The pixel next to it may be a spike as well.
                    fit = min(one, ground + far / near * lower) if far < np.inf else one
                if count == found.shape[1]:
                    more, further = np.empty((2, 2 * count), np.int64), np.empty((2, 2 * count))
                    more[:, :count], further[:, :count] = found, told
                    found, told = more, further
                found[0, count], found[1, count] = u, v
                told[0, count], told[1, count] = times, fit
                count += 1
    return found[:, :count].copy(), told[:, :count].copy()


@_compiled(_ints, _ints, types.Array(types.boolean, 1, "A", readonly=True))
def hanging_together(u: IntArray, v: IntArray, begun: BoolArray) -> BoolArray:
    """Which pixels are begun with, or hang together with such by their sides or corners."""
    made, waiting = begun.copy(), np.flatnonzero(begun)
    next_ones = np.empty(len(u), np.int64)
    next_ones[: len(waiting)] = waiting
    count, done = len(waiting), 0
    while done < count:
        own = next_ones[done]
        done += 1
        for k in range(len(u)):
            if not made[k] and abs(u[k] - u[own]) <= 1 and abs(v[k] - v[own]) <= 1:
                made[k], next_ones[count] = True, k
                count += 1
    return made


@_compiled_for(*((own, _ints, _ints, _grey, _grey) for own in (_grey, _byte)))
def finest(image: Picture, u: IntArray, v: IntArray, narrow: Grey, wide: Grey) -> FloatArray:
    """Largest difference of two filters among nine pixels round each (`band_pass._nine`)."""
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


@_compiled_for(*((own, _i, _i) for own in (_grey, _byte)))
def tile_noise(image: Picture, rows: int, columns: int) -> Grey:
    """Noise of a picture's tiles, shape (rows, columns): see `dot_size.local_noise`.

    Every second pixel of every second row stands for the others.
    """
    height, width = image.shape
    made = np.empty((rows, columns), np.float32)
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
            made[i, j] = np.median(some)
    return made


@_compiled(_grey, _ints, _ints, _f)
def answers(band: Grey, u: IntArray, v: IntArray, step: float) -> FloatArray:
    """Largest value of a picture, made smaller ``step``-fold, about each pixel of the large one."""
    height, width = band.shape
    made = np.empty(len(u))
    for k in range(len(u)):
        x, y = round((u[k] + 0.5) / step - 0.5), round((v[k] + 0.5) / step - 0.5)
        most = -np.inf
        for at_y in range(max(y - 1, 0), min(y + 2, height)):
            for at_x in range(max(x - 1, 0), min(x + 2, width)):
                most = max(most, band[at_y, at_x])
        made[k] = most
    return made


@_compiled(_f2, _f1, _f2, _f1, _f, _f)
def parts(
    places: FloatArray,
    strength: FloatArray,
    wholes: FloatArray,
    of_whole: FloatArray,
    within: float,
    share: float,
) -> BoolArray:
    """Whether a whole lies within some distance of each place that has this share of its strength.

    Places and wholes have shapes (n, 2) and (m, 2).
    """
    made = np.zeros(len(places), np.bool_)
    for k in range(len(places)):
        for m in range(len(wholes)):
            x, y = places[k, 0] - wholes[m, 0], places[k, 1] - wholes[m, 1]
            if x * x + y * y <= within * within and of_whole[m] >= share * strength[k]:
                made[k] = True
                break
    return made


@_compiled(_ints, _ints, _f)
def first_of_each(u: IntArray, v: IntArray, within: float) -> IntArray:
    """Numbers of the pixels that none before them is near that stays."""
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
