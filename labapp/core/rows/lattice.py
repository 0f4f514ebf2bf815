"""Lattice: the reflected row and column of each dot, and the holes among them (§5.2.2, §5.3)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from labapp.core.geometry.coordinates import ImageCalibration
from labapp.core.images.dots import Dots
from labapp.core.values import IntArray, ReadOnlyArrays

Site = tuple[int, int]
"""Reflected row k and column t, counted from 1."""

HOLE_DISTANCE = 0.25
"""A site between two dots is a hole if no dot is closer to their midpoint than this share of their
distance."""

_NEXT: tuple[Site, ...] = ((0, 1), (0, -1), (1, 0), (-1, 0))


@dataclass(frozen=True, repr=False)
class Lattice(ReadOnlyArrays):
    """The reflected row and column of each dot.

    They are counted in the picture, upwards and to the right, until `number_on_plane` or a match
    counts them along Z′ and X′ of the imaging plane.

    Parameters
    ----------
    row, column
        Reflected row k and column t of each dot, both counted from 1, shape (n,) for n dots; 0 for
        dots in doubt, which have none.
    reference
        Site (k, t) of the marker's hole: the reference's, unless the centre ray exists. None if it
        is ambiguous or unknown.
    candidates
        All sites (k, t) that could be the marker's hole, the likeliest first.
    blocked_rows
        Rows k with dots hidden by the torch.
    """

    row: IntArray
    column: IntArray
    reference: Site | None = None
    candidates: tuple[Site, ...] = ()
    blocked_rows: frozenset[int] = frozenset()


def lattice_of_sites(
    dot_at: dict[Site, int],
    count: int,
    reference: Site | None = None,
    candidates: tuple[Site, ...] = (),
) -> Lattice:
    """Build the lattice of ``count`` dots from a mapping of sites (k, t), from 1, to dots."""
    sites = np.array(list(dot_at), np.int64).reshape(-1, 2)
    return lattice_of_dots(sites, list(dot_at.values()), count, reference, candidates)


def lattice_of_dots(
    sites: IntArray,
    dots: IntArray | list[int],
    count: int,
    reference: Site | None = None,
    candidates: tuple[Site, ...] = (),
) -> Lattice:
    """Build the lattice of ``count`` dots from the sites (k, t) of m of them, shape (m, 2)."""
    row, column = np.zeros((2, count), np.int64)
    row[dots], column[dots] = sites.T
    candidates = candidates or ((reference,) if reference else ())
    return Lattice(row, column, reference, candidates, _blocked_rows(sites))


def find_holes(dot_at: dict[Site, int], dots: Dots) -> list[tuple[Site, int]]:
    """Find empty sites with dots on the left and right, and on 3 or 4 sides in all.

    ``dot_at`` maps sites (k, t) to dots. Returns sites and numbers of sides, 4 before 3.
    """
    if not dot_at:
        return []
    points = dots.u_px + 1j * dots.v_px
    holes = []
    for k, t in [(k, t + 1) for k, t in dot_at if (k, t + 2) in dot_at]:
        lit = [(k + dk, t + dt) in dot_at for dk, dt in _NEXT]
        if (k, t) in dot_at or sum(lit) < 3:
            continue
        left, right = points[dot_at[k, t - 1]], points[dot_at[k, t + 1]]
        if np.abs(points - (left + right) / 2).min() > HOLE_DISTANCE * abs(right - left):
            holes.append(((k, t), sum(lit)))
    return sorted(holes, key=lambda hole: (-hole[1], hole[0]))


def number_on_plane(lattice: Lattice, dots: Dots, calibration: ImageCalibration) -> Lattice:
    """Number the rows along Z′ and the columns along X′, as those of matched dots are.

    In the picture they run otherwise if the camera sees the imaging plane mirrored, upside down or
    turned.

    Parameters
    ----------
    lattice, dots
        Rows and columns in the picture, upwards and to the right, and their dots.
    """
    right, down = calibration.jacobian(dots.image_px.mean(axis=0)).T
    turned = abs(right[0]) + abs(down[1]) < abs(right[1]) + abs(down[0])
    row, column = (lattice.column, lattice.row) if turned else (lattice.row, lattice.column)
    upwards, rightwards = (right[1], -down[0]) if turned else (-down[1], right[0])
    if not turned and upwards > 0 and rightwards > 0:
        return lattice
    last_row, last_column = row.max() + 1, column.max() + 1

    def on_plane(site: Site) -> Site:
        k, t = reversed(site) if turned else site
        return (
            int(k if upwards > 0 else last_row - k),
            int(t if rightwards > 0 else last_column - t),
        )

    row = row if upwards > 0 else np.where(row > 0, last_row - row, 0)
    column = column if rightwards > 0 else np.where(column > 0, last_column - column, 0)
    sited = (row > 0) & (column > 0)
    blocked = (
        _blocked_rows(np.stack([row, column], axis=-1)[sited])
        if turned
        else frozenset(on_plane((k, 1))[0] for k in lattice.blocked_rows)
    )
    reference = None if lattice.reference is None else on_plane(lattice.reference)
    return Lattice(row, column, reference, tuple(map(on_plane, lattice.candidates)), blocked)


def empty_sites(lattice: Lattice) -> list[Site]:
    """Sites (k, t) without a dot, next to at least one with a dot."""
    on = lattice.row > 0
    taken = set(zip(lattice.row[on].tolist(), lattice.column[on].tolist(), strict=True))
    return sorted({(k + dk, t + dt) for k, t in taken for dk, dt in _NEXT} - taken)


def _blocked_rows(sites: IntArray) -> frozenset[int]:
    """Rows that lack two or more adjacent dots between others: hidden by the torch."""
    k, t = sites[np.lexsort(sites.T[::-1])].T
    return frozenset(k[1:][(np.diff(k) == 0) & (np.diff(t) > 2)].tolist())
