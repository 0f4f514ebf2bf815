"""The default search for rows and columns: region growing of a grid from dot to dot.

Each new dot is predicted from the local steps in both directions. The search is conservative: a dot
in doubt gets no row and column rather than wrong ones. The dissertation's two searches are in
`row_search`.

A *grid* is an array of the dot at each site, −1 if there is none, shape (rows, columns). Positions
of dots are complex numbers here, u − iv, px: right and up.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy

from labapp.core.images.dots import Dots
from labapp.core.rows.lattice import Lattice, Site, find_holes, lattice_of_sites
from labapp.core.values import (
    BoolArray,
    CannotMeasure,
    ComplexArray,
    FloatArray,
    IntArray,
    median,
)

MOST_STEPS = 1000
"""Largest number of steps that a grid grows from its seed."""

LEAST_SHARED = 4
"""Grids are merged if they have at least this many dots in common, not all on one line, and agree
on their rows and columns."""

MOST_SLIP, MOST_SLANT = 0.55, 0.7
"""A row is misaligned by a column if the slant of its columns differs from that of other rows by at
least the first, or is at least the second, in steps along the row: both slightly over a half."""

NEAREST, NEAR = 10, 40
"""Numbers of nearest dots among which a dot's opposite neighbours, and a dot off their line, are
searched for."""

MOST_UNEVEN = 0.5
"""Two neighbours are opposite if the sum of the steps to them is shorter than this fraction of the
shorter step. A step without an opposite one counts as this uneven."""

LEAST_CROSSING, LEAST_OFF_LINE = 0.4, 0.6
"""Least sine of the angle between the two steps of a seed: if the second one has an opposite step,
and otherwise."""

NEARLY_SHORTEST = 1.05
"""Two steps are the shortest if twice their inner product is at most this multiple of the lesser
square: with a factor of 1, equally short ones could alternate."""


@dataclass(frozen=True)
class GrowSettings:
    """Settings of the default search.

    Parameters
    ----------
    gate
        A dot is assigned to a site if it lies within this fraction of the local step from the
        site's predicted position.
    doubt
        It is left in doubt if another dot lies within this many times its distance from there.
    least, share
        Least number of dots of a grid, and least share of all dots.
    """

    gate: float = 0.36
    doubt: float = 1.8
    least: int = 9
    share: float = 0.5


def grow_lattice(dots: Dots, settings: GrowSettings) -> Lattice:
    """Index the dots by growing a grid from the most regular neighbourhoods.

    Raises
    ------
    CannotMeasure
        ``too-few-dots`` if there are fewer dots than a grid needs, ``no-rows`` if they do not
        form one.
    """
    from labapp.core.rows.lattice_kernels import BORDER, grow

    if len(dots) < settings.least:
        raise CannotMeasure(
            "too-few-dots", f"only {len(dots)} dots found; a grid needs {settings.least}"
        )
    dots_px = dots.u_px - 1j * dots.v_px
    order = np.argsort(dots_px.real)
    rank, in_order = np.argsort(order), dots_px[order]
    across = 2 * (min(len(dots), MOST_STEPS) + BORDER) + 1
    dot_at = np.full((across, across), -1)
    tried = np.zeros(len(dots), np.bool_)
    grids: list[IntArray] = []
    for seed, first, second in _seeds(dots_px):
        if tried[seed]:
            continue
        k, t, dot = _largest_part(
            grow(in_order, dot_at, rank[seed], first, second, settings.gate, settings.doubt)
        )
        dot = order[dot]
        tried[dot] = True
        if len(dot) >= settings.least:
            grown = _upright(_reduced(_grid_of(k, t, dot), dots_px), dots_px)
            grids.append(_without_slips(grown, dots_px))
    grid = _largest_without_jumps(grids, dots_px, in_order)
    if len(grids) > 1 and _count(grid) < settings.share * len(dots):
        sound = [_without_jumps(grown, dots_px, in_order) for grown in grids]
        whole = _upright(_reduced(merge_grids(sound), dots_px), dots_px)
        whole = _without_jumps(_without_slips(whole, dots_px), dots_px, in_order)
        grid = max(grid, whole, key=_count)
    if _count(grid) < max(settings.least, settings.share * len(dots)):
        raise CannotMeasure("no-rows", "the dots do not form rows and columns")
    grid = _grid_of(*_sites(grid))  # without empty margins
    sites = {(k + 1, t + 1): dot for k, t, dot in np.stack(_sites(grid), axis=-1).tolist()}
    holes = find_holes(sites, dots)
    certain = [site for site, sides in holes if sides == 4]
    return lattice_of_sites(
        sites,
        len(dots),
        reference=certain[0] if len(certain) == 1 else None,
        candidates=tuple(site for site, _ in holes),
    )


def merge_grids(grids: list[IntArray]) -> IntArray:
    """Merge the largest grid with the grids that overlap it and agree on all common dots.

    Grids and result are arrays of the dot at each site, −1 if there is none, shape (rows, columns).
    A gap between parts of a pattern may stop a grid's growth in most places but not in all; grids
    of two parts then have dots in common.
    """
    first, *rest = sorted(grids, key=_count, reverse=True)
    whole = _site_of(first)
    while True:
        for number, other in enumerate(rest):
            further = _sites_to_add(whole, _site_of(other))
            if further is not None:
                whole |= further
                del rest[number]
                break
        else:
            k, t = np.array(list(whole.values())).T
            return _grid_of(k, t, np.array(list(whole)))


def _site_of(grid: IntArray) -> dict[int, Site]:
    """Map each dot of a grid to its site."""
    return {dot: (k, t) for k, t, dot in np.stack(_sites(grid), axis=-1).tolist()}


def _sites_to_add(whole: dict[int, Site], other: dict[int, Site]) -> dict[int, Site] | None:
    """Sites in a grid of the additional dots of another; None if the two do not agree."""
    shared = list(whole.keys() & other.keys())
    if len(shared) < LEAST_SHARED:
        return None
    in_whole, in_other = (np.array([sites[dot] for dot in shared]) for sites in (whole, other))
    # A row of one grid may be a diagonal of the other.
    turn, _, rank, _ = np.linalg.lstsq(_centered(in_other), _centered(in_whole), rcond=None)
    if rank < 2:
        return None
    turn = np.rint(turn).astype(np.int64)
    offset = in_whole - in_other @ turn
    if abs(round(np.linalg.det(turn))) != 1 or np.ptp(offset, axis=0).any():
        return None
    sites = np.array(list(other.values())) @ turn + offset[0]
    taken = set(whole.values())
    return {
        dot: site
        for dot, site in zip(other, map(tuple, sites.tolist()), strict=True)
        if dot not in whole and site not in taken
    }


def _centered(sites: IntArray) -> FloatArray:
    return np.asarray(sites - sites.mean(axis=0))


def _seeds(dots_px: ComplexArray) -> list[tuple[int, complex, complex]]:
    """Find dots midway between two neighbours, the most regular first.

    Returns triples of the dot, the step to one of these neighbours, and a step in another
    direction: to a neighbour of another such pair if there is one, or else to the nearest dot well
    off the first line (the distance of rows may be ten times that of the dots within them).
    """
    points = np.stack([dots_px.real, dots_px.imag], axis=-1)
    near = scipy.spatial.cKDTree(points).query(points, k=min(NEAR + 1, len(points)))[1][:, 1:]
    offset = dots_px[near] - dots_px[:, None]
    length = np.abs(offset)
    a, b = np.triu_indices(min(NEAREST, near.shape[1]), 1)
    step = (offset[:, b] - offset[:, a]) / 2
    dots = np.arange(len(dots_px))
    with np.errstate(divide="ignore", invalid="ignore"):  # two dots in one place
        error = np.abs(offset[:, a] + offset[:, b]) / np.minimum(length[:, a], length[:, b])
        size = np.where(error < MOST_UNEVEN, length[:, a] + length[:, b], np.inf)
        shortest = dots, size.argmin(axis=1)
        first = step[shortest]
        crossing = np.where(_sine_between(first, step) > LEAST_CROSSING, size, np.inf)
        off_line = _sine_between(first, offset) > LEAST_OFF_LINE
    # A dot off the line without an opposite one is the last choice.
    last = np.where(off_line.any(axis=1), np.finfo(float).max, np.inf)
    size_across = np.column_stack([crossing, last])
    across = np.column_stack([step, offset[dots, off_line.argmax(axis=1)]])
    doubt = np.column_stack([error, np.full(len(dots_px), MOST_UNEVEN)])
    found = np.isfinite(size_across)
    ends = np.where(found, size_across, -np.inf).argmax(axis=1)
    both = np.column_stack([size_across.argmin(axis=1), ends])
    second = np.take_along_axis(across, both, axis=1)
    doubt = np.take_along_axis(doubt, both, axis=1) + error[shortest][:, None]
    doubt[~(found.any(axis=1) & np.isfinite(size[shortest]))] = np.inf
    order = np.argsort(doubt, axis=None, kind="stable")[: np.isfinite(doubt).sum()]
    seed = order // 2
    return list(
        zip(seed.tolist(), first[seed].tolist(), second.ravel()[order].tolist(), strict=True)
    )


def _sine_between(first: ComplexArray, second: ComplexArray) -> FloatArray:
    """Absolute sine of the angle between steps of shapes (n,) and (n, m), shape (n, m)."""
    return np.abs((first[:, None].conj() * second).imag) / np.abs(first[:, None]) / np.abs(second)


def _largest_part(sites: IntArray) -> tuple[IntArray, IntArray, IntArray]:
    """Row, column and dot of the largest part from `grow`; empty if it is a single dot."""
    k, t, dot, part = sites.T
    size = np.bincount(part)[part]
    kept = (part == part[size.argmax()]) & (size > 1)
    return k[kept], t[kept], dot[kept]


def _count(grid: IntArray) -> int:
    """Number of dots of a grid."""
    return int((grid >= 0).sum())


def _sites(grid: IntArray) -> tuple[IntArray, IntArray, IntArray]:
    """Row, column and dot of each occupied site, shape (s,) each."""
    k, t = np.nonzero(grid >= 0)
    return k, t, grid[k, t]


def _grid_of(k: IntArray, t: IntArray, dot: IntArray) -> IntArray:
    """Build the array of the dot at each site, −1 if there is none, shape (rows, columns)."""
    grid = np.full((np.ptp(k) + 1, np.ptp(t) + 1), -1)
    grid[k - k.min(), t - t.min()] = dot
    return grid


def _places(grid: IntArray, dots_px: ComplexArray) -> ComplexArray:
    """Position of each site's dot, px; NaN if there is none."""
    return np.where(grid >= 0, dots_px[grid], complex(np.nan, np.nan))


def _reduced(grid: IntArray, dots_px: ComplexArray) -> IntArray:
    """Renumber a grid by its two shortest steps, since a grid grown at a hole may be diagonal.

    Lagrange's reduction of the lattice, with inner products summed over the cells.
    """
    place = _places(grid, dots_px)
    a, b = place[:-1, 1:] - place[:-1, :-1], place[1:, :-1] - place[:-1, :-1]
    with np.errstate(divide="ignore", invalid="ignore"):  # two dots in one place
        along, across = np.nansum(np.abs(a) / np.abs(b)), np.nansum(np.abs(b) / np.abs(a))
        mixed = np.nansum((a * b.conj()).real / (np.abs(a) * np.abs(b)))
    row, column = (1, 0), (0, 1)  # coefficients of the old k and t in the new k and in the new t
    for _ in range(8):
        if 2 * abs(mixed) <= NEARLY_SHORTEST * min(along, across):
            break
        if along <= across:  # subtract a multiple of the step along rows from that across them
            m = round(mixed / along)
            column = column[0] + m * row[0], column[1] + m * row[1]
            mixed, across = mixed - m * along, across - 2 * m * mixed + m * m * along
        else:
            m = round(mixed / across)
            row = row[0] + m * column[0], row[1] + m * column[1]
            mixed, along = mixed - m * across, along - 2 * m * mixed + m * m * across
    rows, columns = (abs(a) * grid.shape[0] + abs(b) * grid.shape[1] for a, b in (row, column))
    if rows * columns > 4 * MOST_STEPS**2:  # degenerate steps
        return grid
    k, t, dot = _sites(grid)
    return _grid_of(row[0] * k + row[1] * t, column[0] * k + column[1] * t, dot)


def _upright(grid: IntArray, dots_px: ComplexArray) -> IntArray:
    """Orient the grid so that columns count from left to right and rows from the bottom up."""
    place = _places(grid, dots_px)
    along, across = (steps[~np.isnan(steps)] for steps in (np.diff(place), np.diff(place, axis=0)))
    level = [np.abs(steps.real).sum() / max(np.abs(steps).sum(), 1e-9) for steps in (along, across)]
    if level[0] < level[1]:
        grid, along, across = grid.T, across, along
    if along.real.sum() < 0:
        grid = grid[:, ::-1]
    if across.imag.sum() < 0:
        grid = grid[::-1]
    return grid


def _without_slips(grid: IntArray, dots_px: ComplexArray) -> IntArray:
    """Keep the largest block of adjacent rows without misalignment.

    A row may be joined to the next with an offset of one column, or from alternating dots of two
    rows. Its columns then slant by a whole step more than those of other rows; those of curved or
    fanned rows do not.
    """
    place = _places(grid, dots_px)
    with np.errstate(divide="ignore", invalid="ignore"):  # two dots in one place
        lean = (np.diff(place, axis=0) / _steps_along(place[:-1])).real
    slant = np.full(len(grid), np.nan)
    for k in np.nonzero(~np.isnan(lean).all(axis=1))[0]:
        slant[k + 1] = median(lean[k][~np.isnan(lean[k])])
    median_slant = median(slant[~np.isnan(slant)]) if not np.isnan(slant).all() else 0.0
    sound = (np.abs(slant - median_slant) < MOST_SLIP) & (np.abs(slant) < MOST_SLANT)
    part = np.cumsum(~sound)
    kept: BoolArray = part == np.bincount(part, (grid >= 0).sum(axis=1)).argmax()
    return grid[kept]


def _largest_without_jumps(
    grids: list[IntArray], dots_px: ComplexArray, in_order: ComplexArray
) -> IntArray:
    """Cut the largest grids (`_without_jumps`) until none of the others can be larger."""
    largest = np.empty((0, 0), np.int64)
    for grid in sorted(grids, key=_count, reverse=True):
        if _count(grid) <= _count(largest):
            break
        largest = max(largest, _without_jumps(grid, dots_px, in_order), key=_count)
    return largest


def _without_jumps(grid: IntArray, dots_px: ComplexArray, in_order: ComplexArray) -> IntArray:
    """Keep the largest part of a grid without steps to wrong dots.

    ``in_order`` are the dots sorted by u. Other parts would have wrong rows or columns.
    """
    from labapp.core.rows.jump_kernels import without_jumps

    kept = without_jumps(in_order, _places(grid, dots_px))
    return grid if kept.all() else np.where(kept, grid, -1)


def _steps_along(place: ComplexArray) -> ComplexArray:
    """Step along the row at each site: central or one-sided difference, or NaN."""
    wide = np.pad(place, ((0, 0), (1, 1)), constant_values=np.nan)
    left, right = place - wide[:, :-2], wide[:, 2:] - place
    step = np.where(np.isnan(left), right, left)
    return np.where(np.isnan(left + right), step, (left + right) / 2)
