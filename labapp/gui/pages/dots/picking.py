"""Geometry of a frame's dots: dots at the pointer, joined dots, sites. Without Qt."""

from __future__ import annotations

import numpy as np
from scipy.spatial.distance import cdist

from labapp.core.rows.correction import Correction, assign, clear_rows
from labapp.core.rows.lattice import Site
from labapp.core.values import FloatArray, IntArray

NEIGHBOURS = 8
"""Number of numbered dots used to estimate a site."""

FAR_OFF = 0.35
"""Distance from the nearest site, in steps, above which a dot is not numbered."""


def nearest(dots_px: FloatArray, u: float, v: float, within_px: float) -> int | None:
    """Index of the dot nearest to a position; None if none is near enough.

    Parameters
    ----------
    dots_px
        (u, v) of the dots, shape (n, 2), px.
    within_px
        Largest distance, px.
    """
    if len(dots_px) == 0:
        return None
    away = np.hypot(*(dots_px - (u, v)).T)
    closest = int(np.argmin(away))
    return closest if away[closest] <= within_px else None


def in_box(dots_px: FloatArray, one: tuple[float, float], other: tuple[float, float]) -> IntArray:
    """Indices of the dots in the box with these corners, edges included, shape (m,)."""
    corners = np.array([one, other])
    inside = (dots_px >= corners.min(axis=0)) & (dots_px <= corners.max(axis=0))
    return np.flatnonzero(inside.all(axis=1))


def joints(row: IntArray, column: IntArray) -> tuple[IntArray, IntArray]:
    """Pairs of consecutive dots along rows, and along columns, each of shape (m, 2).

    Along a row the next dot is joined at any distance; along a column only a dot of the next row,
    so that a row shifted by mistake visibly interrupts the columns.
    """
    sited = np.flatnonzero((row > 0) & (column > 0))
    order = sited[np.lexsort((column[sited], row[sited]))]
    along_rows = np.stack([order[:-1], order[1:]], axis=1)
    along_rows = along_rows[row[along_rows[:, 0]] == row[along_rows[:, 1]]]
    order = sited[np.lexsort((row[sited], column[sited]))]
    up = np.stack([order[:-1], order[1:]], axis=1)
    next_up = (column[up[:, 0]] == column[up[:, 1]]) & (row[up[:, 1]] == row[up[:, 0]] + 1)
    return along_rows, up[next_up]


def row_ends(row: IntArray, dots_px: FloatArray) -> tuple[tuple[int, int], ...]:
    """Number and leftmost dot of each row."""
    ends = []
    for k in np.unique(row[row > 0]).tolist():
        members = np.flatnonzero(row == k)
        ends.append((k, int(members[np.argmin(dots_px[members, 0])])))
    return tuple(ends)


def site_at(correction: Correction, u: float, v: float) -> tuple[Site, float] | None:
    """Site (k, t) at a position, and the distance of its centre in steps; None without rows.

    It is estimated from the numbered dots around the position.
    """
    sited = np.flatnonzero(correction.sited)
    places = correction.dots.image_px[sited]
    away = np.hypot(*(places - (u, v)).T)
    near = np.argsort(away)[:NEIGHBOURS]
    if len(near) < 3:
        return None
    offset = places[near] - (u, v)
    if np.linalg.matrix_rank(offset - offset.mean(axis=0), tol=1.0) < 2:
        return None
    weight = 1 / (1 + (away[near] / max(away[near].min(), 1.0)) ** 2)
    numbers = np.stack([correction.lattice.row, correction.lattice.column], axis=1)[sited[near]]
    terms = np.column_stack([np.ones(len(near)), offset])
    found = np.linalg.lstsq(terms * weight[:, None], numbers * weight[:, None], rcond=None)[0][0]
    k, t = np.rint(found).astype(int).tolist()
    return (k, t), float(np.abs(found - (k, t)).max())


def site_px(correction: Correction, site: Site) -> FloatArray | None:
    """Position of a site, shape (2,), px: of its dot or from its neighbours; None without rows."""
    row, column = correction.lattice.row, correction.lattice.column
    places = correction.dots.image_px
    own = np.flatnonzero((row == site[0]) & (column == site[1]))
    if len(own):
        return np.asarray(places[own[0]])
    pairs = []
    for step in (np.array([0, 1]), np.array([1, 0])):
        ends = [
            np.flatnonzero((row == k) & (column == t))
            for k, t in (site + step, site - step)  # beside it, then above and below
        ]
        if all(len(end) for end in ends):
            pairs.append((places[ends[0][0]] + places[ends[1][0]]) / 2)
    if pairs:
        return np.asarray(np.mean(pairs, axis=0))
    sited = np.flatnonzero(correction.sited)
    offset = np.stack([row, column], axis=1)[sited] - np.array(site)
    near = np.argsort(np.hypot(*offset.T))[:NEIGHBOURS]
    if len(near) < 3 or np.linalg.matrix_rank(offset[near] - offset[near].mean(axis=0)) < 2:
        return None
    terms = np.column_stack([np.ones(len(near)), offset[near]])
    return np.asarray(np.linalg.lstsq(terms, places[sited[near]], rcond=None)[0][0])


def numbered_by_neighbours(
    correction: Correction, dots: IntArray
) -> tuple[Correction, dict[int, str]]:
    """Set the row and column of dots from the dots around them.

    Returns
    -------
    tuple
        The correction, and for each of the dots that has no number now, the reason: it lies between
        sites, too few dots near it are numbered, or another dot has its site.

    Raises
    ------
    ValueError
        If no dot can be numbered.
    """
    made, unnumbered = clear_rows(correction, dots), dict[int, str]()
    # Those beside numbered dots come first: they are the neighbours of those farther off.
    places = correction.dots.image_px
    away = cdist(places[dots], places[made.sited]).min(axis=1, initial=np.inf)
    for dot in dots[np.argsort(away, kind="stable")].tolist():
        try:
            made = _numbered(made, dot)
        except ValueError as error:
            unnumbered[dot] = str(error)
    if len(unnumbered) == len(dots):
        raise ValueError(*list(unnumbered.values())[:1])
    return made, unnumbered


def _numbered(correction: Correction, dot: int) -> Correction:
    u, v = correction.dots.image_px[dot].tolist()
    found = site_at(correction, u, v)
    if found is None or found[1] > FAR_OFF:
        raise ValueError(
            f"the dots near ({u:.1f}, {v:.1f}) px do not fix its row and column; type them"
        )
    return assign(correction, [dot], *found[0])
