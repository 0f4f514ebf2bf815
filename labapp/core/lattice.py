"""Dots → Lattice: rows, columns, blocked rows, reference (§5.2.2, §5.3)."""

from __future__ import annotations

from dataclasses import dataclass

from labapp.core.values import IntArray, freeze


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
    reference: tuple[int, int] | None = None
    candidates: tuple[tuple[int, int], ...] = ()
    blocked_rows: frozenset[int] = frozenset()

    def __post_init__(self) -> None:
        freeze(self)
