"""Dots → Lattice: rows, columns, blocked rows, reference (§5.2.2, §5.3).

The default grows a grid from neighbour to neighbour, each new dot predicted from the local steps
both ways. Its contract: no dot is given a wrong row or column; a dot in doubt is given none. The
text's two searches are in `row_search`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy

from labapp.core.images.dots import Dots
from labapp.core.values import BoolArray, CannotMeasure, ComplexArray, FloatArray, IntArray, freeze

Site = tuple[int, int]

MOST_STEPS = 1000
"""A grid grows no further than so many steps from the dot that it begins at."""

SHARED = 4
"""Grids are joined that have so many dots in common, not all on one line, in the same rows and
columns."""

_NEXT: tuple[Site, ...] = ((0, 1), (0, -1), (1, 0), (-1, 0))


@dataclass(frozen=True)
class Lattice:
    """Which reflected row and column each dot is in.

    Parameters
    ----------
    row, column
        Reflected row k (from the bottom up) and column t (from left to right) of each dot, both
        counted from 1, shape (n,) for n dots; 0 where the dot is in doubt and has none.
    reference
        Site (k, t) of the absent centre dot, where one stands out; None where none does.
    candidates
        Every site (k, t) that could be the absent centre dot, the likeliest first.
    blocked_rows
        Rows k with dots hidden by the torch.
    """

    row: IntArray
    column: IntArray
    reference: Site | None = None
    candidates: tuple[Site, ...] = ()
    blocked_rows: frozenset[int] = frozenset()

    def __post_init__(self) -> None:
        freeze(self)


@dataclass(frozen=True)
class GrowSettings:
    """How the default search decides.

    Parameters
    ----------
    gate
        A dot is taken for a site if it lies within this fraction of the local step from where
        the site is predicted.
    doubt
        … and is left in doubt if another dot lies within this many times that distance.
    least, share
        A grid of fewer dots, or of a smaller share of them, is no grid.
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
        ``too-few-dots`` if fewer dots than a grid needs were found, ``no-rows`` if they do not
        form one.
    """
    from labapp.core.rows.lattice_kernels import BORDER, grow

    if len(dots) < settings.least:
        raise CannotMeasure(
            "too-few-dots", f"{len(dots)} dots were found, a grid needs {settings.least}"
        )
    plane = dots.u_px - 1j * dots.v_px
    order = np.argsort(plane.real)
    rank, in_order = np.argsort(order), plane[order]
    across = 2 * (min(len(dots), MOST_STEPS) + BORDER) + 1
    dot_at = np.full((across, across), -1)
    tried = np.zeros(len(dots), np.bool_)
    grids: list[IntArray] = []
    for seed, first, second in _seeds(plane):
        if tried[seed]:
            continue
        k, t, dot = _sound_part(
            grow(in_order, dot_at, rank[seed], first, second, settings.gate, settings.doubt)
        )
        dot = order[dot]
        tried[dot] = True
        if len(dot) >= settings.least:
            grown = _upright(_unsheared(_grid_of(k, t, dot), plane), plane)
            grids.append(_without_slips(grown, plane))
    grid = max(grids, key=_count, default=np.empty((0, 0), np.int64))
    if len(grids) > 1 and _count(grid) < settings.share * len(dots):
        whole = _upright(_unsheared(joined(grids), plane), plane)
        grid = max(grid, _without_slips(whole, plane), key=_count)
    if _count(grid) < max(settings.least, settings.share * len(dots)):
        raise CannotMeasure("no-rows", "the dots do not form rows and columns")
    grid = _grid_of(*_sites(grid))
    sites = {(k + 1, t + 1): dot for k, t, dot in np.stack(_sites(grid), axis=-1).tolist()}
    holes = find_holes(sites, dots)
    certain = [site for site, sides in holes if sides == 4]
    return lattice_of_sites(
        sites,
        len(dots),
        reference=certain[0] if len(certain) == 1 else None,
        candidates=tuple(site for site, _ in holes),
    )


def joined(grids: list[IntArray]) -> IntArray:
    """Join grids that overlap to the largest, as far as they agree on all dots they share.

    Each is the dot at each site, −1 where there is none, shape (rows, columns); so is the result.
    A gap between tiles of a pattern ends a grid's growth in most places, and not in all: grids of
    two tiles then have some dots of each other.
    """
    first, *rest = sorted(grids, key=_count, reverse=True)
    whole = _site_of(first)
    while True:
        for number, other in enumerate(rest):
            further = _further(whole, _site_of(other))
            if further is not None:
                whole |= further
                del rest[number]
                break
        else:
            k, t = np.array(list(whole.values())).T
            return _grid_of(k, t, np.array(list(whole)))


def _site_of(grid: IntArray) -> dict[int, Site]:
    """The site of each dot of a grid."""
    return {dot: (k, t) for k, t, dot in np.stack(_sites(grid), axis=-1).tolist()}


def _further(whole: dict[int, Site], other: dict[int, Site]) -> dict[int, Site] | None:
    """Sites that another grid's further dots have in a grid; None where the two do not agree."""
    shared = list(whole.keys() & other.keys())
    if len(shared) < SHARED:
        return None
    own, its = (np.array([sites[dot] for dot in shared]) for sites in (whole, other))
    # What is a row of one may be a diagonal of the other.
    turn, _, rank, _ = np.linalg.lstsq(_centered(its), _centered(own), rcond=None)
    if rank < 2:
        return None
    turn = np.rint(turn).astype(np.int64)
    offset = own - its @ turn
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


def _seeds(plane: ComplexArray) -> list[tuple[int, complex, complex]]:
    """Dots that lie midway between two neighbours, the most regular first.

    Returns triples of the dot, the step to such a neighbour, and the step across: to the other
    such neighbour where there is one, otherwise to the nearest dot well off the first line (rows
    may be ten times further apart than the dots within them).
    """
    points = np.stack([plane.real, plane.imag], axis=-1)
    near = scipy.spatial.cKDTree(points).query(points, k=min(41, len(points)))[1][:, 1:]
    offset = plane[near] - plane[:, None]
    length = np.abs(offset)
    a, b = np.triu_indices(min(10, near.shape[1]), 1)
    step = (offset[:, b] - offset[:, a]) / 2
    dots = np.arange(len(plane))
    with np.errstate(divide="ignore", invalid="ignore"):  # two dots in one place
        error = np.abs(offset[:, a] + offset[:, b]) / np.minimum(length[:, a], length[:, b])
        size = np.where(error < 0.5, length[:, a] + length[:, b], np.inf)
        shortest = dots, size.argmin(axis=1)
        first = step[shortest]
        crossing = np.where(_turn(first, step) > 0.4, size, np.inf)
        off_line = _turn(first, offset) > 0.6
    # A dot off the line is taken after all that have another one opposite.
    last = np.where(off_line.any(axis=1), np.finfo(float).max, np.inf)
    size_across = np.column_stack([crossing, last])
    across = np.column_stack([step, offset[dots, off_line.argmax(axis=1)]])
    doubt = np.column_stack([error, np.full(len(plane), 0.5)])
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


def _turn(first: ComplexArray, second: ComplexArray) -> FloatArray:
    """Absolute sine of the angle between steps, shapes (n,) and (n, m)."""
    return np.abs((first[:, None].conj() * second).imag) / np.abs(first[:, None]) / np.abs(second)


def _sound_part(sites: IntArray) -> tuple[IntArray, IntArray, IntArray]:
    """Row, column and dot of the largest part of what has grown; none if nothing hangs together."""
    k, t, dot, part = sites.T
    size = np.bincount(part)[part]
    kept = (part == part[size.argmax()]) & (size > 1)
    return k[kept], t[kept], dot[kept]


def _count(grid: IntArray) -> int:
    """How many sites of a grid have a dot."""
    return int((grid >= 0).sum())


def _sites(grid: IntArray) -> tuple[IntArray, IntArray, IntArray]:
    """Row, column and dot of each site that has one, shape (s,) each."""
    k, t = np.nonzero(grid >= 0)
    return k, t, grid[k, t]


def _grid_of(k: IntArray, t: IntArray, dot: IntArray) -> IntArray:
    """Dot at each site, −1 where there is none, shape (rows, columns)."""
    grid = np.full((np.ptp(k) + 1, np.ptp(t) + 1), -1)
    grid[k - k.min(), t - t.min()] = dot
    return grid


def _places(grid: IntArray, plane: ComplexArray) -> ComplexArray:
    """Place of each site's dot, px; NaN where there is none."""
    return np.where(grid >= 0, plane[grid], complex(np.nan, np.nan))


def _unsheared(grid: IntArray, plane: ComplexArray) -> IntArray:
    """Index by the two shortest steps: a grid grown next to a hole may run along diagonals.

    Lagrange's reduction of the lattice, its inner products summed over the cells.
    """
    place = _places(grid, plane)
    a, b = place[:-1, 1:] - place[:-1, :-1], place[1:, :-1] - place[:-1, :-1]
    with np.errstate(divide="ignore", invalid="ignore"):  # two dots in one place
        along, across = np.nansum(np.abs(a) / np.abs(b)), np.nansum(np.abs(b) / np.abs(a))
        mixed = np.nansum((a * b.conj()).real / (np.abs(a) * np.abs(b)))
    row, column = (1, 0), (0, 1)  # how many times the old k and t go into the new k, the new t
    for _ in range(8):
        if 2 * abs(mixed) <= 1.05 * min(along, across):
            break
        if along <= across:  # step over rows less as many steps along them
            m = round(mixed / along)
            column = column[0] + m * row[0], column[1] + m * row[1]
            mixed, across = mixed - m * along, across - 2 * m * mixed + m * m * along
        else:
            m = round(mixed / across)
            row = row[0] + m * column[0], row[1] + m * column[1]
            mixed, along = mixed - m * across, along - 2 * m * mixed + m * m * across
    rows, columns = (abs(a) * grid.shape[0] + abs(b) * grid.shape[1] for a, b in (row, column))
    if rows * columns > 4 * MOST_STEPS**2:  # steps that differ so much are of no grid
        return grid
    k, t, dot = _sites(grid)
    return _grid_of(row[0] * k + row[1] * t, column[0] * k + column[1] * t, dot)


def _upright(grid: IntArray, plane: ComplexArray) -> IntArray:
    """Turn the grid so that rows run left to right and are counted from the bottom up."""
    place = _places(grid, plane)
    along, across = np.diff(place, axis=1), np.diff(place, axis=0)
    level = [
        np.nansum(np.abs(steps.real)) / max(np.nansum(np.abs(steps)), 1e-9)
        for steps in (along, across)
    ]
    if level[0] < level[1]:
        grid, along, across = grid.T, across, along
    if np.nansum(along.real) < 0:
        grid = grid[:, ::-1]
    if np.nansum(across.imag) < 0:
        grid = grid[::-1]
    return grid


def _without_slips(grid: IntArray, plane: ComplexArray) -> IntArray:
    """Keep the most rows that hang together without a slip.

    Neighbour by neighbour a row may be joined to the next one column off all along, or by dots of
    two rows in turn. Its columns then slant by a whole step more than those of other rows, which
    bowed and fanned rows do not.
    """
    place = _places(grid, plane)
    with np.errstate(divide="ignore", invalid="ignore"):  # two dots in one place
        lean = (np.diff(place, axis=0) / _steps_along(place[:-1])).real
    slant = np.full(len(grid), np.nan)
    for k in np.nonzero(~np.isnan(lean).all(axis=1))[0]:
        slant[k + 1] = np.median(lean[k][~np.isnan(lean[k])])
    usual = np.median(slant[~np.isnan(slant)]) if not np.isnan(slant).all() else 0.0
    sound = (np.abs(slant - usual) < 0.55) & (np.abs(slant) < 0.7)
    part = np.cumsum(~sound)
    kept: BoolArray = part == np.bincount(part, (grid >= 0).sum(axis=1)).argmax()
    return grid[kept]


def _steps_along(place: ComplexArray) -> ComplexArray:
    """Step along its row at each site: across it, or to the one neighbour there is, else NaN."""
    wide = np.pad(place, ((0, 0), (1, 1)), constant_values=np.nan)
    left, right = place - wide[:, :-2], wide[:, 2:] - place
    step = np.where(np.isnan(left), right, left)
    return np.where(np.isnan(left + right), step, (left + right) / 2)


def lattice_of_sites(
    grid: dict[Site, int],
    count: int,
    reference: Site | None = None,
    candidates: tuple[Site, ...] = (),
) -> Lattice:
    """Build the lattice of ``count`` dots from the dot at each site (k, t), counted from 1."""
    row, column = np.zeros(count, np.int64), np.zeros(count, np.int64)
    for (k, t), dot in grid.items():
        row[dot], column[dot] = k, t
    candidates = candidates or ((reference,) if reference else ())
    return Lattice(row, column, reference, candidates, _blocked_rows(grid))


def find_holes(grid: dict[Site, int], dots: Dots) -> list[tuple[Site, int]]:
    """Empty sites with lit neighbours left and right and on how many sides in all (3 or 4).

    ``grid`` is the dot at each site (k, t). The holes with most such sides come first.
    """
    if not grid:
        return []
    points = dots.image_px
    tree = scipy.spatial.cKDTree(points)
    holes = []
    for k, t in {(k + dk, t + dt) for k, t in grid for dk, dt in _NEXT} - grid.keys():
        lit = [(k + dk, t + dt) in grid for dk, dt in _NEXT]
        if not (lit[0] and lit[1]) or sum(lit) < 3:
            continue
        left, right = points[grid[k, t - 1]], points[grid[k, t + 1]]
        nearest = tree.query((left + right) / 2)[0]
        if nearest > 0.5 * np.linalg.norm(right - left) / 2:
            holes.append(((k, t), sum(lit)))
    return sorted(holes, key=lambda hole: (-hole[1], hole[0]))


def empty_sites(lattice: Lattice) -> list[Site]:
    """Sites (k, t) without a dot, next to at least one with a dot."""
    on = lattice.row > 0
    taken = set(zip(lattice.row[on].tolist(), lattice.column[on].tolist(), strict=True))
    return sorted({(k + dk, t + dt) for k, t in taken for dk, dt in _NEXT} - taken)


def _blocked_rows(grid: dict[Site, int]) -> frozenset[int]:
    """Rows that lack two or more neighbouring dots between lit ones: hidden by the torch."""
    rows: dict[int, list[int]] = {}
    for k, t in grid:
        rows.setdefault(k, []).append(t)
    return frozenset(k for k, ts in rows.items() if len(ts) > 1 and np.diff(np.sort(ts)).max() > 2)
