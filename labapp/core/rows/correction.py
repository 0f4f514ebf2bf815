"""The operator's correction of a frame's dots and rows, and its edits (§5.2.2, §5.3).

A correction is absolute: the dots and rows that the operator confirmed are measured, independently
of what a later detector would find. Every edit is a function that returns a new correction. An
invalid dot, row or number raises ValueError with a message for the operator.

Rows are counted from the bottom up and columns from left to right, both from 1. Edits may use
numbers below 1 (a row below the lowest): all rows or columns are then renumbered from 1.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from itertools import pairwise

import numpy as np

from labapp.core.images.band_pass import dot_at
from labapp.core.images.dots import BandPassSettings, Dots, Image
from labapp.core.rows.lattice import Lattice, Site, find_holes
from labapp.core.values import BoolArray, FloatArray, IntArray, ReadOnlyArrays

PLACED_PX = 0.5
"""Least standard uncertainty of a dot that was moved by hand, px."""

MOST = 1000
"""Largest absolute value of a row or column number; no pattern has so many."""

_NONE = -(10**9)  # no row or column, while numbers below 1 are valid

Indices = Sequence[int] | IntArray


@dataclass(frozen=True)
class Correction(ReadOnlyArrays):
    """The dots and rows of one frame as the operator corrected them.

    Parameters
    ----------
    dots
        The n dots.
    lattice
        Their rows and columns, 0 for none; a dot may have only one of them. No two dots have the
        same site. Its reference and its blocked rows are not determined anew.
    manual
        Whether each dot was placed, moved or assigned a row or column by hand, shape (n,).

    Raises
    ------
    ValueError
        If the arrays differ in length, a number is below 0, or two dots have one site.
    """

    dots: Dots
    lattice: Lattice
    manual: BoolArray

    def __post_init__(self) -> None:
        object.__setattr__(self, "manual", np.asarray(self.manual, bool))
        super().__post_init__()
        row, column = self.lattice.row, self.lattice.column
        columns = [getattr(self.dots, field.name) for field in fields(Dots)]
        if {array.shape for array in (*columns, row, column, self.manual)} != {(len(self.dots),)}:
            raise ValueError("dots, rows, columns and manual must have the same length")
        if min(row.min(initial=0), column.min(initial=0)) < 0:
            raise ValueError("rows and columns are counted from 1")
        shared = _shared(row, column)
        if shared is not None:
            one, other = shared
            raise ValueError(
                f"row {row[one]}, column {column[one]} is already assigned to "
                f"{named(self.dots, one)} and cannot be assigned to {named(self.dots, other)} too"
            )

    @classmethod
    def of(cls, dots: Dots | None, lattice: Lattice | None) -> Correction:
        """Start from the dots and rows that were found.

        Dots that a search assigned to the same site get no row and column.

        Parameters
        ----------
        dots
            The dots; None for none.
        lattice
            Their rows and columns; None for none.
        """
        if dots is None:
            dots = Dots(*(np.zeros(0) for _ in fields(Dots)))
        n = len(dots)
        if lattice is None:
            lattice = Lattice(np.zeros(n, np.int64), np.zeros(n, np.int64))
        while (shared := _shared(lattice.row, lattice.column)) is not None:
            row, column = lattice.row, lattice.column
            together = (row == row[shared[0]]) & (column == column[shared[0]])
            lattice = replace(
                lattice, row=np.where(together, 0, row), column=np.where(together, 0, column)
            )
        return cls(dots, lattice, np.zeros(n, bool))

    @property
    def sited(self) -> BoolArray:
        """Whether each dot has both a row and a column, shape (n,)."""
        return np.asarray((self.lattice.row > 0) & (self.lattice.column > 0))


def add_dot(
    correction: Correction,
    image: Image,
    u_px: float,
    v_px: float,
    settings: BandPassSettings | None = None,
) -> Correction:
    """Append the dot at the pointer, without a row and column.

    It snaps to the peak under the pointer. If there is none, it is placed at the pointer, with the
    size of a dot as its uncertainty (see `dot_at`).

    Parameters
    ----------
    correction
        The frame's correction, which stays as it is.
    image
        Grey frame, shape (height, width).
    u_px, v_px
        Position of the pointer, px.
    settings
        Settings of the band-pass detector; None: the defaults.

    Raises
    ------
    ValueError
        If the position is outside the frame or at an existing dot.
    """
    if image.ndim != 2 or not (_inside(u_px, image.shape[1]) and _inside(v_px, image.shape[0])):
        raise ValueError(f"({u_px:g}, {v_px:g}) px is not in the frame")
    dots = correction.dots
    if len(dots):
        away = np.hypot(dots.u_px - u_px, dots.v_px - v_px)
        near = int(np.argmin(away))
        if away[near] < max(1.0, 0.5 * dots.size_px[near]):
            raise ValueError(f"{named(dots, near)} is there already")
    one = dot_at(image, u_px, v_px, dots, settings or BandPassSettings())
    return _rebuilt(
        Correction(
            _each(np.append, dots, one),
            replace(
                correction.lattice,
                row=np.append(correction.lattice.row, 0),
                column=np.append(correction.lattice.column, 0),
            ),
            np.append(correction.manual, True),
        )
    )


def delete_dots(correction: Correction, dots: Indices) -> Correction:
    """Delete dots; the indices of later dots decrease.

    Parameters
    ----------
    correction
        The frame's correction, which stays as it is.
    dots
        Indices of the dots, from 0.
    """
    keep = np.delete(np.arange(len(correction.dots)), _chosen(correction, dots))
    lattice = correction.lattice
    return _rebuilt(
        Correction(
            _each(lambda column: column[keep], correction.dots),
            replace(lattice, row=lattice.row[keep], column=lattice.column[keep]),
            correction.manual[keep],
        )
    )


def move_dots(correction: Correction, dots: Indices, du_px: float, dv_px: float) -> Correction:
    """Move dots; their standard uncertainty is then at least `PLACED_PX`.

    Parameters
    ----------
    correction
        The frame's correction, which stays as it is.
    dots
        Indices of the dots, from 0.
    du_px, dv_px
        Distance to the right and downwards, px.

    Raises
    ------
    ValueError
        If the distance is not finite or too large.
    """
    if not (abs(du_px) < 1e5 and abs(dv_px) < 1e5):
        raise ValueError(f"dots cannot be moved by ({du_px:g}, {dv_px:g}) px")
    moved = _mask(correction, dots)
    old = correction.dots
    dots_ = replace(
        old,
        u_px=old.u_px + du_px * moved,
        v_px=old.v_px + dv_px * moved,
        u_sigma_px=np.where(moved, np.maximum(old.u_sigma_px, PLACED_PX), old.u_sigma_px),
        v_sigma_px=np.where(moved, np.maximum(old.v_sigma_px, PLACED_PX), old.v_sigma_px),
    )
    return _rebuilt(replace(correction, dots=dots_, manual=correction.manual | moved))


def assign(
    correction: Correction, dots: Indices, row: int | None = None, column: int | None = None
) -> Correction:
    """Assign a row, a column or both to dots.

    Parameters
    ----------
    correction
        The frame's correction, which stays as it is.
    dots
        Indices of the dots, from 0.
    row, column
        The row k and the column t; None: unchanged.

    Raises
    ------
    ValueError
        If neither is given, or another dot has that site.
    """
    if row is None and column is None:
        raise ValueError("a row or a column is needed")
    chosen = _mask(correction, dots)
    sites = _Sites.of(correction)
    if row is not None:
        sites.row[chosen] = _number(row, "row")
    if column is not None:
        sites.column[chosen] = _number(column, "column")
    return sites.applied(correction, chosen)


def clear_rows(correction: Correction, dots: Indices) -> Correction:
    """Remove the row and column of dots.

    Their rays may still be determined from the surface; a dot to be ignored has to be deleted.

    Parameters
    ----------
    correction
        The frame's correction, which stays as it is.
    dots
        Indices of the dots, from 0.
    """
    chosen = _mask(correction, dots)
    sites = _Sites.of(correction)
    sites.row[chosen] = sites.column[chosen] = _NONE
    return sites.applied(correction, np.zeros(len(chosen), bool))


def shift_row(correction: Correction, row: int, columns: int) -> Correction:
    """Shift a row, and the reference if it is in it, by a number of columns.

    Parameters
    ----------
    correction
        The frame's correction, which stays as it is.
    row
        The row k.
    columns
        Number of columns; to the right if positive.

    Raises
    ------
    ValueError
        If the row has no dots.
    """
    sites = _Sites.of(correction)
    chosen = sites.dots_in(row) & (sites.column != _NONE)
    sites.column[chosen] += _number(columns, "number of columns")
    if sites.reference is not None and sites.reference[0] == row:
        sites.reference = (row, sites.reference[1] + columns)
    return sites.applied(correction, chosen)


def split_row(correction: Correction, row: int, column: int, above: bool = True) -> Correction:
    """Split a row in two: the dots from ``column`` on form a new row above or below the old one.

    Higher rows are renumbered. The reference moves with its part; if the row is blocked, both parts
    are.

    Parameters
    ----------
    correction
        The frame's correction, which stays as it is.
    row
        The row k.
    column
        First column t of the new row.
    above
        Whether the new row is above the old one, else below.

    Raises
    ------
    ValueError
        If the row has no dots on both sides.
    """
    sites = _Sites.of(correction)
    inside = sites.dots_in(row)
    part = inside & (sites.column >= _number(column, "column"))
    if not part.any() or part.sum() == inside.sum():
        raise ValueError(f"row {row} has no dots on both sides of column {column}")
    # The upper part and all rows above it move up by one.
    upper = part if above else inside & ~part
    sites.row[upper | (sites.row > row)] += 1
    if sites.reference is not None:
        k, t = sites.reference
        goes_up = k > row or (k == row and (t >= column) == above)
        sites.reference = (k + int(goes_up), t)
    marks = {k + int(k > row) for k in sites.blocked}
    sites.blocked = marks | ({row + 1} if row in marks else set())
    return sites.applied(correction, inside)


def merge_rows(correction: Correction, row: int, into: int) -> Correction:
    """Merge the dots of a row into another row; rows above it move down by one.

    Parameters
    ----------
    correction
        The frame's correction, which stays as it is.
    row
        The row that ends.
    into
        The row that gets its dots.

    Raises
    ------
    ValueError
        If they are the same row, a row has no dots, or two dots would have one site.
    """
    if row == into:
        raise ValueError(f"row {row} cannot be merged with itself")
    sites = _Sites.of(correction)
    chosen = sites.dots_in(row)
    sites.dots_in(into)
    sites.row[chosen] = into
    sites.row[sites.row > row] -= 1
    if sites.reference is not None:
        k, t = sites.reference
        k = into if k == row else k
        sites.reference = (k - int(k > row), t)
    blocked = {into if k == row else k for k in sites.blocked}
    sites.blocked = {k - int(k > row) for k in blocked}
    return sites.applied(correction, chosen)


def block_row(correction: Correction, row: int, blocked: bool = True) -> Correction:
    """Set whether a row has dots hidden by the torch.

    Missing dots of a blocked row are not used as evidence for the boundary.

    Parameters
    ----------
    correction
        The frame's correction, which stays as it is.
    row
        The row k.
    blocked
        Whether it is blocked.

    Raises
    ------
    ValueError
        If the row is to be unmarked and is not marked.
    """
    sites = _Sites.of(correction)
    if blocked:
        sites.blocked.add(_number(row, "row"))
    elif row in sites.blocked:
        sites.blocked.remove(row)
    else:
        raise ValueError(f"row {row} is not marked as blocked")
    return sites.applied(correction, np.zeros(len(correction.dots), bool))


def set_reference(correction: Correction, site: Site | None) -> Correction:
    """Set the site of the reference.

    Parameters
    ----------
    correction
        The frame's correction, which stays as it is.
    site
        Row and column (k, t); None: found automatically.
    """
    sites = _Sites.of(correction)
    if site is not None:
        site = _number(site[0], "row"), _number(site[1], "column")
    sites.reference = site
    return sites.applied(correction, np.zeros(len(correction.dots), bool))


def named(dots: Dots, index: int) -> str:
    """Describe a dot by its index and position, for messages."""
    return f"dot {index} at ({dots.u_px[index]:.1f}, {dots.v_px[index]:.1f}) px"


@dataclass
class _Sites:
    """Rows, columns, reference and blocked rows during an edit; numbers may be below 1."""

    row: IntArray
    column: IntArray
    reference: Site | None
    blocked: set[int]

    @classmethod
    def of(cls, correction: Correction) -> _Sites:
        lattice = correction.lattice
        row, column = (np.where(n > 0, n, _NONE) for n in (lattice.row, lattice.column))
        return cls(row, column, lattice.reference, set(lattice.blocked_rows))

    def dots_in(self, row: int) -> BoolArray:
        """Mask of the dots in a row; ValueError if there are none."""
        chosen = np.asarray(self.row == _number(row, "row"))
        if not chosen.any():
            raise ValueError(f"row {row} has no dots")
        return chosen

    def applied(self, correction: Correction, by_hand: BoolArray) -> Correction:
        """Return the correction with these sites, renumbered from 1, and more manual dots."""
        reference = self.reference or (1, 1)
        up = _shortfall(self.row, [reference[0], *self.blocked])
        right = _shortfall(self.column, [reference[1]])
        lattice = Lattice(
            np.where(self.row == _NONE, 0, self.row + up),
            np.where(self.column == _NONE, 0, self.column + right),
            None if self.reference is None else (reference[0] + up, reference[1] + right),
            blocked_rows=frozenset(k + up for k in self.blocked),
        )
        return _rebuilt(Correction(correction.dots, lattice, correction.manual | by_hand))


def _shortfall(numbers: IntArray, others: list[int]) -> int:
    """Offset by which all numbers must increase for the least to be 1; 0 if none is below 1."""
    numbers = numbers[numbers != _NONE]
    return 1 - min(1, *others, int(numbers.min(initial=1)))


def _rebuilt(correction: Correction) -> Correction:
    """Recompute the candidate sites of the reference for the current dots and rows."""
    lattice, dots = correction.lattice, np.flatnonzero(correction.sited)
    if lattice.reference is not None:
        return replace(correction, lattice=replace(lattice, candidates=(lattice.reference,)))
    sites = zip(lattice.row[dots].tolist(), lattice.column[dots].tolist(), strict=True)
    grid = dict(zip(sites, dots.tolist(), strict=True))
    holes = tuple(site for site, _ in find_holes(grid, correction.dots))
    return replace(correction, lattice=replace(lattice, candidates=holes))


def _shared(row: IntArray, column: IntArray) -> tuple[int, int] | None:
    """Find two dots with the same site, in ascending order; None if there are none."""
    dots = np.flatnonzero((row > 0) & (column > 0))
    order = dots[np.lexsort((dots, column[dots], row[dots]))]
    for one, other in pairwise(order.tolist()):
        if row[one] == row[other] and column[one] == column[other]:
            return one, other
    return None


def _each(function: Callable[..., FloatArray], *dots: Dots) -> Dots:
    """Apply a function to each field of dots."""
    return Dots(*(function(*(getattr(d, column.name) for d in dots)) for column in fields(Dots)))


def _chosen(correction: Correction, dots: Indices) -> IntArray:
    chosen = np.asarray(dots)
    if chosen.ndim != 1 or len(chosen) == 0:
        raise ValueError("no dot is selected")
    if chosen.dtype.kind not in "iu":
        raise ValueError("dots must be given by their integer indices")
    wrong = chosen[(chosen < 0) | (chosen >= len(correction.dots))]
    if len(wrong):
        raise ValueError(f"there is no dot {wrong[0]}; there are {len(correction.dots)}, from 0")
    return np.unique(chosen).astype(np.int64)


def _mask(correction: Correction, dots: Indices) -> BoolArray:
    mask = np.zeros(len(correction.dots), bool)
    mask[_chosen(correction, dots)] = True
    return mask


def _number(value: int, what: str) -> int:
    if abs(value) > MOST:
        raise ValueError(f"{value} is not a valid {what}; its absolute value is at most {MOST}")
    return int(value)


def _inside(place: float, size: int) -> bool:
    return -0.5 <= place <= size - 0.5
