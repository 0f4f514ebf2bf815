"""Kinds of dot pattern: directions of the rays of a lens.

A kind is an entry of `PATTERNS`. It gives the tangents of the rays to the beam axis: their
positions on a screen normal to the axis at distance 1, to the side (with X) and upwards.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from labapp.core.values import BoolArray, FloatArray

Tangents = Callable[[int, int, float], FloatArray]
"""Rows, columns, angle between neighbours at the centre (rad) → tangents (aside, up), shape
(rows, columns, 2).

Rows run from the top of the fan to its bottom, columns with X; the centre is (0, 0). Adding two
rows or two columns does not change the inner rays.
"""


@dataclass(frozen=True)
class PatternKind:
    """A kind of dot pattern.

    Parameters
    ----------
    title
        Common name.
    tangents
        Directions of its rays.
    outline
        Rows and columns → mask of the existing rays, shape (rows, columns); None: all exist.
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
    """Rays with six equidistant neighbours: every other row is shifted by half a step (with X).

    The middle row is not shifted; the row spacing is √3/2 of a step.
    """
    row, column = _from_center(rows, columns)
    return _tangents(row * np.sqrt(3.0) / 2.0, column + row % 2 / 2.0, step)


def hexagon(rows: int, columns: int) -> BoolArray:
    """Mask of the rays within the hexagon on the middle row, shape (rows, columns).

    With equal numbers of rows and columns it is regular: n rays on each side, 2n − 1 rows, and
    3n(n − 1) + 1 rays in total. With fewer rows its upper and lower corners are cut off.
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
"""Kind of a pattern whose rays were measured individually, see `measured_steps`."""

FEWEST_RAYS = 9
"""Smallest number of measured rays of a pattern."""

MeasuredRay = tuple[int, int, float, float]
"""Row and column relative to the centre ray; tangents divided by that of the inter-beam angle."""


def measured_steps(rays: tuple[MeasuredRay, ...], rows: int, columns: int) -> FloatArray:
    """Tangents of rays divided by that of the inter-beam angle, shape (rows, columns, 2).

    Unmeasured rays are interpolated or extrapolated linearly from the nearest ones of their row.
    Rows with fewer than two measured rays use every other row, because rows may be staggered.
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
    """Replace NaN in a line of positions, shape (n, 2), by linear inter- and extrapolation."""
    at, known = np.arange(len(line)), np.flatnonzero(np.isfinite(line[:, 0]))
    if len(known) < 2:
        return line
    left = known[np.clip(np.searchsorted(known, at, "right") - 1, 0, len(known) - 2)]
    right = known[np.clip(np.searchsorted(known, at, "right"), 1, len(known) - 1)]
    share = ((at - left) / (right - left))[:, None]
    linear = line[left] + share * (line[right] - line[left])
    return np.where(np.isfinite(line), line, linear)
