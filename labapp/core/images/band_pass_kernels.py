"""Inner loops of the band-pass and over the dots of a frame, compiled (docs/adr/0018).

Arrays may be read-only; pictures must be contiguous, other arrays need not be.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from numba import types

from labapp.core.compiled import compiled as _compiled
from labapp.core.compiled import compiled_for as _compiled_for
from labapp.core.compiled import inner as _inner
from labapp.core.images.dots import Grey, Picture
from labapp.core.values import BoolArray, FloatArray, IntArray

Line = npt.NDArray[np.float32] | npt.NDArray[np.int16]

_f, _i = types.float64, types.int64
_f1, _f2 = (types.Array(_f, n, "A", readonly=True) for n in (1, 2))
_grey = types.Array(types.float32, 2, "C", readonly=True)
_byte = types.Array(types.uint8, 2, "C", readonly=True)
_ints = types.Array(_i, 1, "A", readonly=True)
_mask = types.Array(types.boolean, 2, "C", readonly=True)


@_compiled(_f2, _f2, _f2)
def on_plane(
    matrix: FloatArray, image: FloatArray, sigma: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Map dots and their standard uncertainties to the imaging plane (`ImageCalibration`).

    Returns positions, shape (n, 2), mm, their covariance, shape (n, 2, 2), mm², and the local
    scale, shape (n,), mm/px.
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
    """Distances and indices of the two places in ``among``, shape (m, 2), nearest to each place.

    Both have shape (n, 2); a missing neighbour has infinite distance and the index m.
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


@_compiled(_f2)
def next_apart(places: FloatArray) -> FloatArray:
    """Distance of each place, shape (n, 2), to the nearest other, shape (n,); infinite if n = 1."""
    count = len(places)
    x, y, least = places[:, 0].copy(), places[:, 1].copy(), np.full(count, np.inf)
    for k in range(count - 1):
        own_x, own_y, own = x[k], y[k], least[k]
        to_x, to_y, next_one = x[k + 1 :], y[k + 1 :], least[k + 1 :]
        for m in range(len(next_one)):
            away_x, away_y = own_x - to_x[m], own_y - to_y[m]
            square = away_x * away_x + away_y * away_y
            next_one[m] = square if square < next_one[m] else next_one[m]
            own = square if square < own else own
        least[k] = own
    return np.asarray(np.sqrt(least))


@_inner
def _is_peak(band: Grey, disc: BoolArray, v: int, u: int) -> bool:
    """Whether no pixel of a disc about a pixel exceeds it."""
    (height, width), reach, own = band.shape, len(disc) // 2, band[v, u]
    if (u > 0 and band[v, u - 1] > own) or (u < width - 1 and band[v, u + 1] > own):
        return False  # a quick test that rejects most pixels
    for y in range(max(v - reach, 0), min(v + reach + 1, height)):
        for x in range(max(u - reach, 0), min(u + reach + 1, width)):
            if disc[y - v + reach, x - u + reach] and band[y, x] > own:
                return False
    return True


@_inner
def _any_over(values: Grey, floor: Grey) -> bool:
    """Whether any value exceeds its floor; without an early exit, so that it vectorises."""
    some = False
    for k in range(len(values)):
        some |= values[k] > floor[k]
    return some


BLOCK = 32
"""Number of pixels of a row that are skipped at once if none exceeds its floor."""


@_compiled(_grey, _grey, _mask)
def peaks(band: Grey, floor: Grey, disc: BoolArray) -> IntArray:
    """Find local maxima over a disc that exceed the floor: columns and rows, shape (2, n).

    A floor of shape (1, 1) applies everywhere.
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
                if not (own[u] > floors[u] and _is_peak(band, disc, v, u)):
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
    """Whether the ratio of principal curvatures of peaks exceeds a limit; edges are reflected."""
    (height, width), result = band.shape, np.empty(len(u), np.bool_)
    for k in range(len(u)):
        above, below = abs(v[k] - 1), height - 1 - abs(height - 2 - v[k])
        left, right = abs(u[k] - 1), width - 1 - abs(width - 2 - u[k])
        own = 2.0 * band[v[k], u[k]]
        across = own - band[v[k], left] - band[v[k], right]
        along = own - band[above, u[k]] - band[below, u[k]]
        skew = band[above, left] + band[below, right] - band[above, right] - band[below, left]
        both = across * along - skew * skew / 16.0
        result[k] = slender * (across + along) ** 2 > (1.0 + slender) ** 2 * both
    return result


@_inner
def _pixels_over(band: Grey, low: Grey) -> IntArray:
    """Rows and columns, shape (n, 2), of the pixels that exceed ``low``, row by row."""
    height, width = band.shape
    over, count = np.empty((width, 2), np.int64), 0
    for v in range(height):
        own, floor = band[v], low[v]
        if len(over) < count + width:
            more = np.empty((2 * (count + width), 2), np.int64)
            more[:count] = over[:count]
            over = more
        for first in range(0, width, BLOCK):
            last = min(first + BLOCK, width)
            if not _any_over(own[first:last], floor[first:last]):
                continue
            for u in range(first, last):
                over[count, 0], over[count, 1] = v, u
                count += own[u] > floor[u]
    return over[:count]


@_inner
def _upsampled(band: Grey, v: int, u: int, taps: Grey, patch: Grey, four: Grey) -> None:
    """Upsample one pixel of a band twofold; its four values are written to ``four``, row by row.

    The interpolation is by polynomials through six pixels; ``taps`` are their weights a quarter of
    the way from the third to the fourth. ``patch``, shape (7, 7), is scratch memory.
    """
    (height, width), single = band.shape, np.float32
    inside = 3 <= v < height - 3 and 3 <= u < width - 3
    for y in range(7):
        row = band[v + y - 3 if inside else min(max(v + y - 3, 0), height - 1)]
        for x in range(7):
            patch[y, x] = row[u + x - 3 if inside else min(max(u + x - 3, 0), width - 1)]
    for x in range(2):
        above, below = single(0.0), single(0.0)
        for y in range(7):
            across = single(0.0)
            for m in range(6):
                across += taps[m if x else 5 - m] * patch[y, m + x]
            above += taps[5 - y] * across if y < 6 else single(0.0)
            below += taps[y - 1] * across if y else single(0.0)
        four[x], four[2 + x] = above, below


@_inner
def _is_upsampled_peak(
    fours: Grey, number: npt.NDArray[np.int32], disc: BoolArray, v: int, u: int
) -> bool:
    """Whether no upsampled pixel of a disc about a pixel exceeds it.

    ``fours``, shape (n, 4), holds the upsampled values of n pixels of the band, and ``number``,
    shape (height, width), the index of each pixel in it; pixels with a negative index are ignored.
    """
    (height, width), reach = number.shape, len(disc) // 2
    own = fours[number[v >> 1, u >> 1], 2 * (v & 1) + (u & 1)]
    for k in range(2 * reach + 1):  # from its row outwards, as larger pixels are mostly close
        y = v + (k + 1) // 2 * (1 if k & 1 else -1)
        if not 0 <= y < 2 * height:
            continue
        numbers, part = number[y >> 1], disc[y - v + reach]
        for x in range(max(u - reach, 0), min(u + reach + 1, 2 * width)):
            at = numbers[x >> 1]
            if at >= 0 and part[x - u + reach] and fours[at, 2 * (y & 1) + (x & 1)] > own:
                return False
    return True


@_compiled(_grey, _grey, _mask)
def upsampled_peaks(band: Grey, low: Grey, disc: BoolArray) -> tuple[IntArray, FloatArray]:
    """Find peaks of a band that is upsampled twofold where it exceeds ``low`` (`peaks`).

    Parameters
    ----------
    band, low
        Shape (height, width); pixels that do not exceed ``low`` contain no peak and do not
        compete with one.
    disc
        See `peaks`.

    Returns
    -------
    places, heights
        Columns and rows, shape (2, n), and the upsampled band there, shape (n,).
    """
    over = _pixels_over(band, low)
    number = np.full(band.shape, -1, np.int32)
    fours, patch = np.empty((len(over), 4), np.float32), np.empty((7, 7), np.float32)
    # Lagrange's polynomials through six pixels.
    taps = np.array([77, -693, 6930, 2310, -495, 63], np.float32) / np.float32(8192)
    for k in range(len(over)):
        number[over[k, 0], over[k, 1]] = k
        _upsampled(band, over[k, 0], over[k, 1], taps, patch, fours[k])
    found, high, count = np.empty((2, 4 * len(over)), np.int64), np.empty(4 * len(over)), 0
    for k in range(len(over)):
        most = fours[k].max()  # the other three cannot be peaks
        for m in range(4):
            v, u = 2 * over[k, 0] + m // 2, 2 * over[k, 1] + m % 2
            if fours[k, m] < most or not _is_upsampled_peak(fours, number, disc, v, u):
                continue
            found[0, count], found[1, count], high[count] = u, v, most
            count += 1
    row = np.argsort(found[1, :count], kind="mergesort")
    return found[:, :count][:, row], high[:count][row]


@_compiled_for(*((own,) for own in (_grey, _byte)))
def halved(image: Picture) -> Grey:
    """Downsample an image twofold by averaging 2 × 2 pixels, without rounding."""
    result = np.empty((image.shape[0] // 2, image.shape[1] // 2), np.float32)
    for v in range(result.shape[0]):
        above, below, own = image[2 * v], image[2 * v + 1], result[v]
        for u in range(result.shape[1]):
            one = np.float32(above[2 * u]) + np.float32(above[2 * u + 1])
            other = np.float32(below[2 * u]) + np.float32(below[2 * u + 1])
            own[u] = np.float32(0.25) * (one + other)
    return result


@_inner
def _beside(image: Picture, v: int, u: int, away: int) -> float:
    """Mean of the pixels at a distance above and below, or left and right, whichever is less.

    At an edge the picture is reflected about its last pixel.
    """
    height, width = image.shape
    above, below = _mirrored(v - away, height), _mirrored(v + away, height)
    left, right = _mirrored(u - away, width), _mirrored(u + away, width)
    along = float(image[above, u]) + float(image[below, u])
    across = float(image[v, left]) + float(image[v, right])
    return 0.5 * min(along, across)


@_inner
def _mirrored(at: int, count: int) -> int:
    """Index of a pixel with reflection about the first and the last one."""
    return count - 1 - abs(count - 1 - abs(at))


@_inner
def _falls_inside(
    above: Picture, below: Picture, high: Picture, low: Picture, row: Picture, falls: Line
) -> None:
    """Compute `_falls` of a row but for two pixels at either end; the four rows begin there."""
    narrow, left, own, right, farther = falls.dtype.type, row[1:], row[2:], row[3:], row[4:]
    for u in range(len(falls)):
        along, across = narrow(above[u] + below[u]), narrow(left[u] + right[u])
        near = along if along < across else across
        along, across = narrow(high[u] + low[u]), narrow(row[u] + farther[u])
        far = along if along < across else across
        falls[u] = 2 * own[u] - (near if near < far else far)


@_inner
def _falls(image: Picture, v: int, falls: Line) -> None:
    """Compute twice the fall of light from each pixel of a row to its surroundings, grey levels."""
    (height, width), first, last = image.shape, 0, 0
    if width > 4:  # away from the edges: vectorised
        first, last = 2, width - 2
        above, below = image[_mirrored(v - 1, height), 2:], image[_mirrored(v + 1, height), 2:]
        high, low = image[_mirrored(v - 2, height), 2:], image[_mirrored(v + 2, height), 2:]
        _falls_inside(above, below, high, low, image[v], falls[first:last])
    for k in range(first + width - last):
        u = k if k < first else last + k - first
        least = min(_beside(image, v, u, 1), _beside(image, v, u, 2))
        falls[u] = 2.0 * float(image[v, u]) - 2.0 * least


@_inner
def _darkest(image: Picture, v: int, u: int, reach: int, step: int) -> float:
    """Minimum over every ``step``-th pixel of a square about a pixel, within the picture."""
    (height, width), least = image.shape, float(image[v, u])
    for y in range(v - reach, v + reach + 1, step):
        for x in range(u - reach, u + reach + 1, step):
            if 0 <= y < height and 0 <= x < width:
                least = min(least, float(image[y, x]))
    return least


@_inner
def _ratio_of_falls(
    over_ground: float, one: float, two: float, near: float, far: float, sharper: float
) -> float:
    """Fall of light at a pixel over that at a dot's peak: to the next pixels or those beyond."""
    times = over_ground / max(near * one, 1e-3 * over_ground)
    return times if times > sharper else over_ground / max(far * two, 1e-3 * over_ground)


@_compiled_for(*((own, _f, _f, _f, _i) for own in (_grey, _byte)))
def spikes(
    image: Picture, over: float, size: float, sharper: float, reach: int
) -> tuple[IntArray, FloatArray]:
    """Find pixels that are too sharp for dots: columns and rows, shape (2, n).

    The light of any number of Gaussian dots of this size or larger falls from a pixel to the mean
    of two opposite neighbours by at most as much as one Gaussian falls from its peak, relative to
    the darkest pixel of a square of half side ``reach``. Spikes fall ``sharper`` times as much, and
    by ``over`` grey levels besides. The neighbours at distances 1 and 2 are tested, as some spikes
    have 2 × 2 pixels. The second array, shape (2, n), is each spike's ratio of falls and the grey
    level beside it.
    """
    height, width = image.shape
    found, values, count = np.empty((2, 64), np.int64), np.empty((2, 64)), 0
    near, far = np.exp(0.5 / size**2), np.exp(2.0 / size**2)
    far = far if far < 4.0 else np.inf  # smaller dots have no light at distance 2
    # For a picture of bytes these are 16-bit integers.
    falls, floor = image[0] * np.int16(0), image[0] * np.int16(0)
    floor[:] = 2.0 * over
    for v in range(height):
        _falls(image, v, falls)
        if not _any_over(falls, floor):
            continue
        for first in range(0, width, BLOCK):
            last = min(first + BLOCK, width)
            for u in range(
                first, last if _any_over(falls[first:last], floor[first:last]) else first
            ):
                if not falls[u] > floor[u]:
                    continue
                own = float(image[v, u])
                one, two = _beside(image, v, u, 1), _beside(image, v, u, 2)
                # A coarse search for the darkest pixel may already exclude a spike.
                for step in (reach, 1):
                    ground = _darkest(image, v, u, reach, step)
                    high, low, lower = own - ground - over, one - ground, two - ground
                    times = _ratio_of_falls(high, low, lower, near, far, sharper)
                    if high > 0.0 and times <= sharper:
                        break
                if not (high > 0.0 and times > sharper):
                    continue
                fit = two
                if high > sharper * max(near * low, 1e-3 * high):
                    # The neighbour may belong to the same spike.
                    fit = min(one, ground + far / near * lower) if far < np.inf else one
                if count == found.shape[1]:
                    more, further = np.empty((2, 2 * count), np.int64), np.empty((2, 2 * count))
                    more[:, :count], further[:, :count] = found, values
                    found, values = more, further
                found[0, count], found[1, count] = u, v
                values[0, count], values[1, count] = times, fit
                count += 1
    return found[:, :count].copy(), values[:, :count].copy()


@_compiled(_ints, _ints, types.Array(types.boolean, 1, "A", readonly=True))
def connected_pixels(u: IntArray, v: IntArray, begun: BoolArray) -> BoolArray:
    """Select the seed pixels and all pixels that are 8-connected to them.

    The pixels are in the order of the picture's rows, and of the columns within a row.
    """
    result, waiting = begun.copy(), np.flatnonzero(begun)
    next_ones = np.empty(len(u), np.int64)
    next_ones[: len(waiting)] = waiting
    width = u.max() + 2 if len(u) else 2  # one more than there are, which separates the rows
    place = v * width + u
    count, done = len(waiting), 0
    while done < count:
        own = place[next_ones[done]]
        done += 1
        for row in (own - width, own, own + width):
            k = np.searchsorted(place, row - 1)
            while k < len(place) and place[k] <= row + 1:
                if not result[k]:
                    result[k], next_ones[count] = True, k
                    count += 1
                k += 1
    return result


@_compiled(_ints, _ints, _f)
def first_of_each(u: IntArray, v: IntArray, within: float) -> IntArray:
    """Indices of pixels with no earlier selected pixel within a distance."""
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
