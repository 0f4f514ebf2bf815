"""The registry of dot patterns: directions of the rays of a lens.

A kind is an entry of `PATTERNS`. It gives the tangents of the rays' angles to the beam axis: their
intersections with a screen normal to the axis at distance 1, sideways (with X) and upwards.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from labapp.core.values import BoolArray, FloatArray

Tangents = Callable[[int, int, float], FloatArray]
"""Rows, columns, angle between neighbours at the centre (rad) → tangents (aside, up), shape
(rows, columns, 2).

Rows run from the top of the fan to its bottom, columns with X; the centre is (0, 0). Two more rows
or columns must not change the other rays.
"""


@dataclass(frozen=True)
class PatternKind:
    """A kind of dot pattern.

    Parameters
    ----------
    title
        Name shown to users.
    tangents
        Directions of its rays.
    outline
        Rows and columns → mask of the rays that exist, shape (rows, columns); None: all of them.
    """

    title: str
    tangents: Tangents
    outline: Callable[[int, int], BoolArray] | None = None

    def beyond(self, rows: int, columns: int) -> frozenset[tuple[int, int]]:
        """Rays ``(i, j)`` outside the outline."""
        if self.outline is None:
            return frozenset()
        outside = np.argwhere(~self.outline(rows, columns)) + 1
        return frozenset((int(i), int(j)) for i, j in outside)


def square(rows: int, columns: int, step: float) -> FloatArray:
    """Rays at equal angles along the middle row and the middle column (Fig. 4-14)."""
    return _tangents(*_from_center(rows, columns), step)


def hexagonal(rows: int, columns: int, step: float) -> FloatArray:
    """Rays with six equidistant neighbours: every other row is offset by half a step along X.

    The middle row is not offset; rows are √3/2 of a step apart.
    """
    row, column = _from_center(rows, columns)
    return _tangents(row * np.sqrt(3.0) / 2.0, column + row % 2 / 2.0, step)


def hexagon(rows: int, columns: int) -> BoolArray:
    """Mask of the rays in the hexagon about the middle row, shape (rows, columns).

    With as many rows as columns it is regular: n rays on each side, 2n − 1 rows, and
    3n(n − 1) + 1 rays in all. With fewer rows its upper and lower corners are cut off.
    """
    row, column = _from_center(rows, columns)
    aside = np.abs(column + row % 2 / 2.0) + np.abs(row) / 2.0
    return np.asarray(aside <= (columns - 1) / 2)


def _from_center(rows: int, columns: int) -> tuple[FloatArray, FloatArray]:
    """Row numbers, shape (rows, 1), and column numbers, shape (1, columns), from the centre."""
    row, column = np.arange(float(rows)), np.arange(float(columns))
    return (row - (rows - 1) / 2)[:, None], (column - (columns - 1) / 2)[None]


def _tangents(row: FloatArray, column: FloatArray, step: float) -> FloatArray:
    aside, up = np.broadcast_arrays(np.tan(column * step), np.tan(-row * step))
    return np.stack([aside, up], axis=-1)


PATTERNS: dict[str, PatternKind] = {
    "square": PatternKind("square grid", square),
    "hexagonal": PatternKind("hexagonal grid", hexagonal, hexagon),
}
"""All kinds with rays at given angles, by their name in setup files."""

MEASURED = "directions"
"""The kind with individually measured rays (`measured_steps`)."""

FEWEST_RAYS = 9
"""Least number of measured rays of a pattern."""

MeasuredRay = tuple[int, int, float, float]
"""Row and column of a ray from the centre; its tangents over that of the inter-beam angle."""


def measured_steps(rays: tuple[MeasuredRay, ...], rows: int, columns: int) -> FloatArray:
    """Tangents of measured rays over that of the inter-beam angle, shape (rows, columns, 2).

    Rays that were not measured are interpolated and extrapolated linearly in their row; in rows of
    fewer than two measured rays, from every other row, since rows may be staggered.
    """
    steps = np.full((rows, columns, 2), np.nan)
    for row, column, *place in rays:
        steps[row + (rows - 1) // 2, column + (columns - 1) // 2] = place
    for i in range(rows):
        steps[i] = _filled(steps[i])
    for first in (0, 1):
        for column in range(columns):
            steps[first::2, column] = _filled(steps[first::2, column])
    return steps


def _filled(line: FloatArray) -> FloatArray:
    """Interpolate and extrapolate the NaN of a line of points, shape (n, 2), linearly."""
    at, known = np.arange(len(line)), np.flatnonzero(np.isfinite(line[:, 0]))
    if len(known) < 2:
        return line
    left = known[np.clip(np.searchsorted(known, at, "right") - 1, 0, len(known) - 2)]
    right = known[np.clip(np.searchsorted(known, at, "right"), 1, len(known) - 1)]
    share = ((at - left) / (right - left))[:, None]
    filled = line[left] + share * (line[right] - line[left])
    return np.where(np.isfinite(line), line, filled)
