"""Inner loops of `lattice_growth`, the search for steps of a grid to wrong dots, compiled.

Positions of dots are complex numbers, px. A step is that from a site's dot to the next one in its
column. Those along rows are searched in the transposed grid.
"""

from __future__ import annotations

import numpy as np
from numba import types

from labapp.core.compiled import compiled, inner
from labapp.core.rows.lattice_kernels import first_right_of
from labapp.core.union_find_kernels import root
from labapp.core.values import BoolArray, ComplexArray, FloatArray, IntArray

BETWEEN = 0.45
"""A dot is between two others if it is within this share of their distance from their midpoint.
Other dots of a grid are not, even if its rows are slanted by a whole step."""

ALIKE = 0.3
"""Largest difference of two steps that are alike, in units of the shorter of one of them and a step
across it."""

AROUND = 3
"""Steps are compared with the median of those from sites within this many rows and columns."""

MOST_UNLIKE = 0.6
"""Largest difference of a usual step from that median, in steps along and across it. That of a step
to a wrong dot is 0.6 … 1. On strongly curved surfaces, steps are also longer, but no others are."""

USUAL, LONG, DOUBTFUL, WRONG = 1, 2, 3, 4
"""Kinds of steps (`_kind_of_step`)."""

_c = types.complex128
_dots = types.Array(_c, 1, "C", readonly=True)
_places = types.Array(_c, 2, "C", readonly=True)


@inner
def _square(step: complex) -> float:
    """Square of a step's length."""
    return step.real * step.real + step.imag * step.imag


@inner
def _is_site(places: ComplexArray, k: int, t: int) -> bool:
    """Whether a site is in the grid and has a dot."""
    rows, columns = places.shape
    return 0 <= k < rows and 0 <= t < columns and not np.isnan(places[k, t].real)


@inner
def _has_dot_between(dots_px: ComplexArray, places: ComplexArray, k: int, t: int) -> bool:
    """Whether a dot is between those of two sites, and is not that of a site beside them."""
    one, other = places[k, t], places[k + 1, t]
    middle, within = (one + other) / 2, BETWEEN * abs(other - one)
    for dot in range(first_right_of(dots_px, middle.real - within), len(dots_px)):
        off = dots_px[dot] - middle
        if off.real > within:
            break
        if _square(off) < within * within:
            beside = False
            for i in range(k - 1, k + 3):
                for j in range(t - 1, t + 2):
                    beside |= _is_site(places, i, j) and places[i, j] == dots_px[dot]
            if not beside:
                return True
    return False


@inner
def _most_alike(places: ComplexArray, k: int, t: int) -> float:
    """Square of the largest difference of a step that is like a site's."""
    least = _square(places[k + 1, t] - places[k, t])
    for j in (t - 1, t + 1):
        if _is_site(places, k, j):
            least = min(least, _square(places[k, j] - places[k, t]))
    return ALIKE * ALIKE * least


@inner
def _is_steady(places: ComplexArray, k: int, t: int) -> bool:
    """Whether a site's step is like all adjacent ones."""
    step, most = places[k + 1, t] - places[k, t], _most_alike(places, k, t)
    for i, j in ((k + 1, t), (k - 1, t), (k, t + 1), (k, t - 1)):
        is_step = _is_site(places, i, j) and _is_site(places, i + 1, j)
        if is_step and _square(places[i + 1, j] - places[i, j] - step) > most:
            return False
    return True


@inner
def _insert(values: FloatArray, count: int, value: float) -> None:
    """Insert a value into the first so many values, which are sorted."""
    while count > 0 and values[count - 1] > value:
        values[count] = values[count - 1]
        count -= 1
    values[count] = value


@inner
def _median_step(places: ComplexArray, k: int, t: int, dk: int, dt: int) -> complex:
    """Median step by (dk, dt) sites from the sites around one, each component; NaN if none."""
    rows, columns = places.shape
    u, v, count = np.empty((2 * AROUND + 1) ** 2), np.empty((2 * AROUND + 1) ** 2), 0
    for i in range(max(k - AROUND, 0), min(k + AROUND + 1, rows - dk)):
        for j in range(max(t - AROUND, 0), min(t + AROUND + 1, columns - dt)):
            step = places[i + dk, j + dt] - places[i, j]
            if not np.isnan(step.real):
                _insert(u, count, step.real)
                _insert(v, count, step.imag)
                count += 1
    low, high = (count - 1) // 2, count // 2
    return complex((u[low] + u[high]) / 2, (v[low] + v[high]) / 2) if count > 0 else np.nan + 0.0j


@inner
def _kind_of_step(dots_px: ComplexArray, places: ComplexArray, k: int, t: int) -> int:
    """The kind of a site's step.

    A step that is longer than usual is wrong only if a dot is between: rows are further apart on
    curved surfaces, and beyond a row that is dark.
    """
    between = _has_dot_between(dots_px, places, k, t)
    if not between and _is_steady(places, k, t):
        return USUAL
    along = _median_step(places, k, t, 1, 0)
    off = places[k + 1, t] - places[k, t] - along
    if not between and _square(off) < _most_alike(places, k, t):
        return USUAL
    across = _median_step(places, k, t, 0, 1)
    # The difference in units of both steps, by Cramer's rule; NaN without a step across.
    cell = (along.conjugate() * across).imag
    longer, aside = (off.conjugate() * across).imag / cell, (along.conjugate() * off).imag / cell
    if longer < -MOST_UNLIKE or abs(aside) > MOST_UNLIKE:
        return WRONG
    if longer > MOST_UNLIKE:
        return WRONG if between else LONG
    return DOUBTFUL if between else USUAL


@inner
def _settle_doubts(kinds: IntArray, places: ComplexArray) -> None:
    """Let steps that are side by side and alike decide together.

    They are all wrong if most of them are doubtful or wrong, or half of them with a wrong one:
    between two rows there may be a false dot, or a row of which some dots are missing. Otherwise,
    those in doubt are usual.
    """
    rows, columns = places.shape
    for k in range(rows - 1):
        start, votes = 0, 0.0
        for t in range(columns):
            if kinds[k, t] > 0:
                votes += 1.0 * (kinds[k, t] >= DOUBTFUL) + 0.5 * (kinds[k, t] == WRONG) - 0.5
                if t + 1 < columns and kinds[k, t + 1] > 0:
                    step, other = places[k + 1, t : t + 2] - places[k, t : t + 2]
                    if _square(other - step) < _most_alike(places, k, t):
                        continue
            for j in range(start, t + 1):
                if votes > 0.0 and kinds[k, j] > 0:
                    kinds[k, j] = WRONG
                elif kinds[k, j] == DOUBTFUL:
                    kinds[k, j] = USUAL
            start, votes = t + 1, 0.0


@inner
def _kinds_of_steps(dots_px: ComplexArray, places: ComplexArray) -> IntArray:
    """Kinds of the sites' steps, shape (rows, columns); 0 where there is none."""
    rows, columns = places.shape
    kinds = np.zeros((rows, columns), np.int64)
    for k in range(rows - 1):
        for t in range(columns):
            if _is_site(places, k, t) and _is_site(places, k + 1, t):
                kinds[k, t] = _kind_of_step(dots_px, places, k, t)
    if kinds.max() >= DOUBTFUL:
        _settle_doubts(kinds, places)
    return kinds


@inner
def _largest_part(kinds: IntArray, kinds_along: IntArray) -> BoolArray:
    """Whether each site belongs to the largest part connected by usual steps, or to one that joins.

    A part joins if more of its steps to the others are long than wrong.
    """
    rows, columns = kinds.shape
    steps = [(0, 0, 0)][:0]  # an empty list, typed for numba
    for k in range(rows):
        for t in range(columns):
            site = k * columns + t
            for kind, following in ((kinds[k, t], site + columns), (kinds_along[k, t], site + 1)):
                if kind > 0:
                    steps.append((site, following, kind))
    parent = np.arange(rows * columns)
    for one, other, kind in steps:
        if kind == USUAL:
            parent[root(parent, other)] = root(parent, one)
    part = np.array([root(parent, site) for site in range(rows * columns)])
    kept, joining = np.zeros(rows * columns, np.bool_), int(np.bincount(part).argmax())
    while joining >= 0:
        kept |= part == joining
        votes = np.zeros(rows * columns, np.int64)
        for one, other, kind in steps:
            if kept[one] != kept[other]:
                votes[part[other if kept[one] else one]] += 1 if kind == LONG else -1
        joining = int(votes.argmax()) if votes.max() > 0 else -1
    return kept.reshape(rows, columns)


@compiled(_dots, _places)
def without_jumps(dots_px: ComplexArray, places: ComplexArray) -> BoolArray:
    """Cut a grid at wrong steps, and find its largest part.

    A grid that jumps over a row, for example at a gap between parts of a pattern, has dots between
    its rows, or steps aside at the end of the jump. Wrong steps within a part that is connected
    otherwise do not cut it.

    Parameters
    ----------
    dots_px
        All dots, u − iv, shape (n,), px, sorted by u.
    places
        Position of each site's dot, px, NaN if there is none, shape (rows, columns).

    Returns
    -------
    BoolArray
        Whether each site belongs to it, shape (rows, columns).
    """
    kept: BoolArray = ~np.isnan(places.real)
    while kept.any():
        there = np.where(kept, places, np.nan + 0.0j)
        kinds, kinds_along = (
            _kinds_of_steps(dots_px, there),
            _kinds_of_steps(dots_px, there.T.copy()),
        )
        if max(kinds.max(), kinds_along.max()) < WRONG:
            break
        count = kept.sum()
        kept &= _largest_part(kinds, kinds_along.T)
        if kept.sum() == count:
            break
    return kept
