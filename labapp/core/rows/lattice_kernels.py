"""Inner loops of `lattice_growth`, the growth of a grid over the dots, compiled (docs/adr/0018).

Positions of dots are complex numbers, px, sorted by their real parts.
"""

from __future__ import annotations

import heapq

import numpy as np
from numba import types

from labapp.core.compiled import compiled, inner
from labapp.core.union_find_kernels import root
from labapp.core.values import BoolArray, ComplexArray, FloatArray, IntArray

BORDER = 3
"""Largest distance, in sites, from which a site's dot is predicted."""

MOST_PREDICTIONS = 16
"""Most predictions of a site: three in each of four directions, and one for each corner."""

LEAST_RATIO, MOST_RATIO = 0.6, 1.6
"""Least and largest ratio of adjacent steps."""

LOOSER = 1.4
"""Factor on the tolerance of a prediction that is not supported by a neighbouring row."""

SEED_GATE = 0.3
"""Tolerance of the predictions of the seed's neighbours, in steps."""

MOST_OPEN = 0.6
"""Largest closure error of a valid cell, in sides: the difference between the two paths around it.
After a misalignment by one column it is about 1."""

Claim = tuple[float, int, int, int]
"""Cost of a site's dot, from its distance to predictions; the site's row and column; the dot."""

_f, _i, _c = types.float64, types.int64, types.complex128
_dots = types.Array(_c, 1, "C", readonly=True)
_sites = types.Array(_i, 2, "C")


@inner
def first_right_of(dots_px: ComplexArray, u: float) -> int:
    """The first dot that is not left of u."""
    start, end = 0, len(dots_px)
    while start < end:
        middle = (start + end) // 2
        if dots_px[middle].real < u:
            start = middle + 1
        else:
            end = middle
    return start


@inner
def _nearest(dots_px: ComplexArray, place: complex, within: float) -> tuple[int, float, float]:
    """The dot nearest to a place, its distance and that of the second nearest, within a radius.

    Without a dot, its index is −1 and the distance infinite.
    """
    nearest, least, second = -1, np.inf, np.inf
    for dot in range(first_right_of(dots_px, place.real - within), len(dots_px)):
        off = dots_px[dot] - place
        if not off.real <= within:
            break
        square = off.real * off.real + off.imag * off.imag
        if square < least:
            nearest, least, second = dot, square, least
        elif square < second:
            second = square
    return nearest, np.sqrt(least), np.sqrt(second)


@inner
def _clamped(ratio: complex) -> complex:
    """Clip the magnitude of a ratio of steps to `LEAST_RATIO` … `MOST_RATIO`."""
    size = abs(ratio)
    return ratio * (min(max(size, LEAST_RATIO), MOST_RATIO) / size) if size > 0.0 else 1.0 + 0.0j


@inner
def _predictions(
    dots_px: ComplexArray, dot_at: IntArray, k: int, t: int, gate: float
) -> tuple[ComplexArray, FloatArray]:
    """Predict the position of a site's dot, shape (p,), with local steps and tolerances, (p, 2).

    Steps are complex numbers, so that their ratio extrapolates both rotation and scale of a row:
    arcs and fans of rows are followed exactly.
    """
    places, sizes, count = (
        np.empty(MOST_PREDICTIONS, np.complex128),
        np.empty((MOST_PREDICTIONS, 2)),
        0,
    )
    for dk, dt in ((0, 1), (0, -1), (1, 0), (-1, 0)):
        one, two = dot_at[k + dk, t + dt], dot_at[k + 2 * dk, t + 2 * dt]
        if one < 0 or two < 0:
            continue
        step = dots_px[one] - dots_px[two]
        for ek, et in ((dk, dt), (dt, dk), (-dt, -dk)):  # the same row, and the adjacent ones
            near, next_one = dot_at[k + ek, t + et], dot_at[k + dk + ek, t + dt + et]
            far = dot_at[k + 2 * dk + ek, t + 2 * dt + et]
            if near >= 0 and next_one >= 0 and far >= 0:
                ratio = (dots_px[near] - dots_px[next_one]) / (dots_px[next_one] - dots_px[far])
                places[count] = dots_px[one] + step * _clamped(ratio)
                sizes[count, 0], sizes[count, 1] = abs(step), gate * abs(step)
                count += 1
            elif near == one:
                places[count] = dots_px[one] + step
                sizes[count, 0], sizes[count, 1] = abs(step), LOOSER * gate * abs(step)
                count += 1
    for dt in (1, -1):
        for dk in (1, -1):
            one, other, corner = dot_at[k, t + dt], dot_at[k + dk, t], dot_at[k + dk, t + dt]
            if one >= 0 and other >= 0 and corner >= 0:
                shorter = min(
                    abs(dots_px[other] - dots_px[corner]), abs(dots_px[one] - dots_px[corner])
                )
                places[count] = dots_px[one] + dots_px[other] - dots_px[corner]
                sizes[count, 0], sizes[count, 1] = shorter, LOOSER * gate * shorter
                count += 1
    return places[:count], sizes[:count]


@inner
def _claim(
    dots_px: ComplexArray,
    dot_at: IntArray,
    taken: BoolArray,
    k: int,
    t: int,
    gate: float,
    doubt: float,
) -> Claim:
    """The dot that a site's predictions agree on, and its cost; −1 if there is none.

    At least half of the predictions must match a dot, and all of these the same one.
    """
    places, sizes = _predictions(dots_px, dot_at, k, t, gate)
    chosen, fitting, error = -1, 0, 0.0
    for p in range(len(places)):
        step, reach = sizes[p, 0], sizes[p, 1]
        dot, distance, second = _nearest(dots_px, places[p], max(doubt, 1.0) * reach)
        if dot < 0 or distance >= reach:
            continue
        if second < doubt * distance or (chosen >= 0 and dot != chosen):
            return np.inf, k, t, -1
        chosen, fitting, error = dot, fitting + 1, error + distance / step
    if chosen < 0 or taken[chosen] or 2 * fitting < len(places):
        return np.inf, k, t, -1
    # The mean distance in steps; the more predictions agree, the earlier.
    return error / fitting / fitting, k, t, chosen


@inner
def _seed_claims(
    dots_px: ComplexArray, middle: int, seed: int, first: complex, second: complex
) -> list[Claim]:
    """Claims of the seed and its neighbours, which precede all others in this order."""
    queue = [(-5.0, middle, middle, seed)]
    for dk, dt, step in ((0, 1, first), (0, -1, -first), (1, 0, second), (-1, 0, -second)):
        dot, distance, _ = _nearest(dots_px, dots_px[seed] + step, SEED_GATE * abs(step))
        if dot >= 0 and distance < SEED_GATE * abs(step):
            queue.append((len(queue) - 5.0, middle + dk, middle + dt, dot))
    return queue


@inner
def _connected_parts(dots_px: ComplexArray, dot_at: IntArray, placed: list[Claim]) -> IntArray:
    """Parents in a union-find forest of dots that are connected by valid cells (`MOST_OPEN`)."""
    parent = np.arange(len(dots_px))
    for _, k, t, dot in placed:
        right, up, across = dot_at[k, t + 1], dot_at[k + 1, t], dot_at[k + 1, t + 1]
        if right < 0 or up < 0 or across < 0:
            continue
        a, b, c, d = dots_px[dot], dots_px[right], dots_px[up], dots_px[across]
        sides = min(max(abs(b - a), abs(d - c)), max(abs(c - a), abs(d - b)))
        if abs(a - b - c + d) < MOST_OPEN * sides:
            for corner in (right, up, across):
                parent[root(parent, corner)] = root(parent, dot)
    return parent


@compiled(_dots, _sites, _i, _c, _c, _f, _f)
def grow(
    dots_px: ComplexArray,
    dot_at: IntArray,
    seed: int,
    first: complex,
    second: complex,
    gate: float,
    doubt: float,
) -> IntArray:
    """Grow a grid from a seed, in order of cost, and find its connected parts.

    Parameters
    ----------
    dots_px
        The dots, u − iv, shape (n,), px, sorted by u.
    dot_at
        Scratch array of −1, shape (m, m), which is restored. The grid grows from its middle, but
        not into the outermost BORDER sites.
    seed, first, second
        The first dot, and the steps to the next column and to the next row, px.
    gate, doubt
        As in `lattice_growth.GrowSettings`.

    Returns
    -------
    IntArray
        Row and column in ``dot_at``, dot, and representative dot of the connected part
        (`_connected_parts`) of each site, shape (s, 4).
    """
    taken, middle, end = np.zeros(len(dots_px), np.bool_), len(dot_at) // 2, len(dot_at) - BORDER
    queue = _seed_claims(dots_px, middle, seed, first, second)
    placed = [(0.0, 0, 0, 0)][:0]  # an empty list, typed for numba
    while queue:
        claim = heapq.heappop(queue)
        badness, k, t, dot = claim
        if dot_at[k, t] >= 0 or taken[dot]:
            continue
        if badness >= 0.0:  # the neighbourhood may have changed since
            again = _claim(dots_px, dot_at, taken, k, t, gate, doubt)
            if again != claim:
                if again[3] >= 0:
                    heapq.heappush(queue, again)
                continue
        dot_at[k, t], taken[dot] = dot, True
        placed.append(claim)
        for near_k in range(k - 2, k + 3):
            for near_t in range(t - 2, t + 3):
                inside = BORDER <= near_k < end and BORDER <= near_t < end
                if inside and dot_at[near_k, near_t] < 0:
                    near = _claim(dots_px, dot_at, taken, near_k, near_t, gate, doubt)
                    if near[3] >= 0:
                        heapq.heappush(queue, near)
    parent = _connected_parts(dots_px, dot_at, placed)
    sites = np.empty((len(placed), 4), np.int64)
    for at, (_, k, t, dot) in enumerate(placed):
        sites[at, 0], sites[at, 1], sites[at, 2], sites[at, 3] = k, t, dot, root(parent, dot)
        dot_at[k, t] = -1
    return sites
