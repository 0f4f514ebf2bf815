"""Dots → Lattice: rows, columns, blocked rows, reference (§5.2.2, §5.3).

The default grows a grid from neighbour to neighbour, each new dot predicted from the local steps
both ways. Its contract: no dot is given a wrong row or column; a dot in doubt is given none. The
text's two searches are in `row_search`.
"""

from __future__ import annotations

import heapq
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from labapp.core.dots import Dots
from labapp.core.values import CannotMeasure, FloatArray, IntArray, freeze

Site = tuple[int, int]


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
    if len(dots) < settings.least:
        raise CannotMeasure(
            "too-few-dots", f"{len(dots)} dots were found, a grid needs {settings.least}"
        )
    points = dots.image_px * [1.0, -1.0]
    tree = cKDTree(points)
    plane = [complex(*point) for point in points]
    grid: dict[Site, int] = {}
    tried: set[int] = set()
    for seed, first, second in _seeds(points, tree):
        if seed in tried:
            continue
        grown = _sound_part(_Growth(points, tree, settings).run(seed, first, second), plane)
        tried.update(grown.values())
        # Held against the best so far by what is left of it: a slip halves the largest grid.
        if len(grown) > len(grid):
            grown = _without_slips(_upright(_unsheared(grown, plane), points), plane)
            grid = max(grid, grown, key=len)
    if len(grid) < max(settings.least, settings.share * len(dots)):
        raise CannotMeasure("no-rows", "the dots do not form rows and columns")
    grid = _from_one(grid)
    holes = find_holes(grid, dots)
    certain = [site for site, sides in holes if sides == 4]
    return lattice_of_sites(
        grid,
        len(dots),
        reference=certain[0] if len(certain) == 1 else None,
        candidates=tuple(site for site, _ in holes),
    )


def _seeds(points: FloatArray, tree: cKDTree) -> list[tuple[int, FloatArray, FloatArray]]:
    """Dots that lie midway between two neighbours, the most regular first.

    Returns triples of the dot, the step to such a neighbour, and the step across: to the other
    such neighbour where there is one, otherwise to the nearest dot well off the first line (rows
    may be ten times further apart than the dots within them).
    """
    near = tree.query(points, k=min(41, len(points)))[1][:, 1:]
    seeds = []
    for p in range(len(points)):
        offset = points[near[p]] - points[p]
        length = np.linalg.norm(offset, axis=1)
        some = slice(0, 10)
        error = np.linalg.norm(offset[some, None] + offset[None, some], axis=2)
        error /= np.minimum(length[some, None], length[None, some])
        pairs = [
            (length[a] + length[b], error[a, b], (offset[b] - offset[a]) / 2)
            for a, b in zip(*np.nonzero(np.triu(error < 0.5, 1)), strict=True)
        ]
        if not pairs:
            continue
        pairs.sort(key=lambda pair: pair[0])
        first = pairs[0][2]
        across = [(step, err) for _, err, step in pairs[1:] if _turn(first, step) > 0.4]
        off_line = np.nonzero(_turn(first, offset) > 0.6)[0]
        if len(off_line):
            across.append((offset[off_line[0]], 0.5))
        seeds += [(pairs[0][1] + err, p, first, step) for step, err in across[:1] + across[-1:]]
    seeds.sort(key=lambda seed: seed[0])
    return [(p, first, second) for _, p, first, second in seeds]


def _turn(first: FloatArray, second: FloatArray) -> FloatArray:
    """Absolute sine of the angle between steps, shapes (2,) and (…, 2)."""
    cross = np.abs(first[0] * second[..., 1] - first[1] * second[..., 0])
    return np.asarray(cross / (np.linalg.norm(first) * np.linalg.norm(second, axis=-1)))


_NEXT: tuple[Site, ...] = ((0, 1), (0, -1), (1, 0), (-1, 0))


class _Growth:
    """One grid growing over the dots; a scratch pad, not a value."""

    def __init__(self, points: FloatArray, tree: cKDTree, settings: GrowSettings) -> None:
        self.points, self.tree, self.settings = points, tree, settings
        self.plane = [complex(*point) for point in points]
        self.dot_at: dict[Site, int] = {}
        self.site_of: dict[int, Site] = {}
        self.queue: list[tuple[float, Site, int]] = []

    def run(self, seed: int, first: FloatArray, second: FloatArray) -> dict[Site, int]:
        self._place((0, 0), seed)
        for site, step in (
            ((0, 1), first),
            ((0, -1), -first),
            ((1, 0), second),
            ((-1, 0), -second),
        ):
            distance, dot = self.tree.query(self.points[seed] + step)
            if distance < 0.3 * np.linalg.norm(step) and dot not in self.site_of:
                self._place(site, int(dot))
        while self.queue:
            badness, site, dot = heapq.heappop(self.queue)
            if site in self.dot_at or dot in self.site_of:
                continue
            again = self._claim(site)
            if again is None:
                continue
            if again != (badness, dot):  # what is known round the site has changed since
                heapq.heappush(self.queue, (again[0], site, again[1]))
                continue
            self._place(site, dot)
        return self.dot_at

    def _place(self, site: Site, dot: int) -> None:
        self.dot_at[site] = dot
        self.site_of[dot] = site
        for dk in range(-2, 3):
            for dt in range(-2, 3):
                near = (site[0] + dk, site[1] + dt)
                if near not in self.dot_at:
                    claim = self._claim(near)
                    if claim is not None:
                        heapq.heappush(self.queue, (claim[0], near, claim[1]))

    def _claim(self, site: Site) -> tuple[float, int] | None:
        """The dot that the predictions of the site point at, and how badly they fit.

        Every prediction that falls on a dot must fall on the same one, and most must.
        """
        chosen: int | None = None
        errors = []
        predictions = list(self._predictions(site))
        for predicted, step, gate in predictions:
            distance, near = self.tree.query((predicted.real, predicted.imag), k=2)
            if distance[0] > gate * step:
                continue
            if distance[1] < self.settings.doubt * distance[0]:
                return None
            if chosen is not None and near[0] != chosen:
                return None
            chosen = int(near[0])
            errors.append(distance[0] / step)
        if chosen is None or chosen in self.site_of or 2 * len(errors) < len(predictions):
            return None
        return float(np.mean(errors)) / len(errors), chosen

    def _predictions(self, site: Site) -> Iterator[tuple[complex, float, float]]:
        """Where the site's dot should be, the local step, and the gate as a fraction of it.

        Steps are complex numbers, so that a row's turning and stretching go on as a ratio: arcs
        and fans of rows are followed exactly.
        """
        k, t = site

        def at(dk: int, dt: int) -> complex | None:
            dot = self.dot_at.get((k + dk, t + dt))
            return None if dot is None else self.plane[dot]

        gate = self.settings.gate
        for dk, dt in _NEXT:
            one, two, three = at(dk, dt), at(2 * dk, 2 * dt), at(3 * dk, 3 * dt)
            if one is None or two is None:
                continue
            step = one - two
            if three is None:
                yield one + step, abs(step), 1.4 * gate
            else:
                yield one + step * _tame(step / (two - three)), abs(step), gate
            for ek, et in ((dt, dk), (-dt, -dk)):
                beside, near, far = at(ek, et), at(dk + ek, dt + et), at(2 * dk + ek, 2 * dt + et)
                if beside is not None and near is not None and far is not None:
                    yield one + step * _tame((beside - near) / (near - far)), abs(step), gate
        for (dk, dt), (ek, et) in ((a, b) for a in _NEXT[:2] for b in _NEXT[2:]):
            one, other, corner = at(dk, dt), at(ek, et), at(dk + ek, dt + et)
            if one is None or other is None or corner is None:
                continue
            shorter = min(abs(other - corner), abs(one - corner))
            yield one + other - corner, shorter, 1.4 * gate


def _tame(ratio: complex) -> complex:
    """A ratio of steps, kept within what neighbouring steps of one surface can differ by."""
    size = min(max(abs(ratio), 0.6), 1.6)
    return ratio / abs(ratio) * size if abs(ratio) else 1.0


def _sound_part(grid: dict[Site, int], plane: list[complex]) -> dict[Site, int]:
    """The largest part of a grid that hangs together by cells whose two ways round agree.

    Opposite sides of a cell may differ by little more than half of a step; where a row or column
    has slipped they differ by a whole one.
    """
    cells = []
    for k, t in grid:
        corners = [(k, t), (k, t + 1), (k + 1, t), (k + 1, t + 1)]
        if not all(corner in grid for corner in corners):
            continue
        a, b, c, d = (plane[grid[corner]] for corner in corners)
        open_by = abs(a - b - c + d)
        if open_by < 0.6 * min(max(abs(b - a), abs(d - c)), max(abs(c - a), abs(d - b))):
            cells.append(corners)
    parent = {site: site for site in grid}

    def root(site: Site) -> Site:
        while parent[site] != site:
            parent[site] = parent[parent[site]]
            site = parent[site]
        return site

    for corners in cells:
        for corner in corners[1:]:
            parent[root(corner)] = root(corners[0])
    parts: dict[Site, list[Site]] = {}
    for site in grid:
        parts.setdefault(root(site), []).append(site)
    largest = max(parts.values(), key=len)
    return {site: grid[site] for site in largest} if len(largest) > 1 else {}


def _unsheared(grid: dict[Site, int], plane: list[complex]) -> dict[Site, int]:
    """Index by the two shortest steps: a grid grown next to a hole may run along diagonals.

    Lagrange's reduction of the lattice, its inner products summed over the cells.
    """
    along, across, mixed = 0.0, 0.0, 0.0
    for (k, t), dot in grid.items():
        if (k, t + 1) in grid and (k + 1, t) in grid:
            a, b = plane[grid[k, t + 1]] - plane[dot], plane[grid[k + 1, t]] - plane[dot]
            size = abs(a) * abs(b)
            along, across = along + abs(a) ** 2 / size, across + abs(b) ** 2 / size
            mixed += (a * b.conjugate()).real / size
    for _ in range(8):
        if 2 * abs(mixed) <= 1.05 * min(along, across):
            break
        if along <= across:  # step over rows less as many steps along them
            m = round(mixed / along)
            grid = {(k, t + m * k): dot for (k, t), dot in grid.items()}
            mixed, across = mixed - m * along, across - 2 * m * mixed + m * m * along
        else:
            m = round(mixed / across)
            grid = {(k + m * t, t): dot for (k, t), dot in grid.items()}
            mixed, along = mixed - m * across, along - 2 * m * mixed + m * m * across
    return grid


def _without_slips(grid: dict[Site, int], plane: list[complex]) -> dict[Site, int]:
    """Keep the most rows that hang together without a slip.

    Neighbour by neighbour a row may be joined to the next one column off all along, or by dots of
    two rows in turn. Its columns then slant by a whole step more than those of other rows, which
    bowed and fanned rows do not.
    """
    rows: dict[int, dict[int, complex]] = {}
    for (k, t), dot in grid.items():
        rows.setdefault(k, {})[t] = plane[dot]
    slants = {}
    for k in sorted(rows):
        below = rows.get(k - 1, {})
        leans = [
            ((rows[k][t] - below[t]) / step).real
            for t in rows[k].keys() & below.keys()
            for step in _steps_at(below, t)
        ]
        if leans:
            slants[k] = float(np.median(leans))
    usual = float(np.median(list(slants.values()))) if slants else 0.0
    parts: list[list[int]] = []
    for k in sorted(rows):
        if k in slants and abs(slants[k] - usual) < 0.55 and abs(slants[k]) < 0.7 and parts:
            parts[-1].append(k)
        else:
            parts.append([k])
    kept = max(parts, key=lambda part: sum(len(rows[k]) for k in part))
    return {site: dot for site, dot in grid.items() if site[0] in kept}


def _steps_at(row: dict[int, complex], t: int) -> list[complex]:
    """Step along a row at column t: across it, or to the one neighbour there is."""
    if t - 1 in row and t + 1 in row:
        return [(row[t + 1] - row[t - 1]) / 2]
    if t + 1 in row:
        return [row[t + 1] - row[t]]
    return [row[t] - row[t - 1]] if t - 1 in row else []


def _upright(grid: dict[Site, int], points: FloatArray) -> dict[Site, int]:
    """Turn the grid so that rows run left to right and are counted from the bottom up."""

    def steps(dk: int, dt: int) -> FloatArray:
        pairs = [
            points[grid[k + dk, t + dt]] - points[dot]
            for (k, t), dot in grid.items()
            if (k + dk, t + dt) in grid
        ]
        return np.array(pairs).reshape(-1, 2)

    along, across = steps(0, 1), steps(1, 0)
    level = [
        np.abs(s[:, 0]).sum() / max(np.linalg.norm(s, axis=1).sum(), 1e-9) for s in (along, across)
    ]
    if level[0] < level[1]:
        grid = {(t, k): dot for (k, t), dot in grid.items()}
        along, across = across, along
    if along[:, 0].sum() < 0:
        grid = {(k, -t): dot for (k, t), dot in grid.items()}
    if across[:, 1].sum() < 0:
        grid = {(-k, t): dot for (k, t), dot in grid.items()}
    return grid


def _from_one(grid: dict[Site, int]) -> dict[Site, int]:
    """Count rows and columns from 1."""
    k0, t0 = (min(site[axis] for site in grid) for axis in (0, 1))
    return {(k - k0 + 1, t - t0 + 1): dot for (k, t), dot in grid.items()}


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
    tree = cKDTree(points)
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
