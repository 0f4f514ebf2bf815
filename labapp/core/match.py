"""The match: pairs of ray and dot, found by `matching` and used by every scheme."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from labapp.core.values import CannotMeasure, FloatArray, IntArray, ReadOnlyArrays

Orientation = Literal["S/S", "S/I", "I/I"]
"""Column/row correspondence: S for the same order as the rays, I for the inverse order."""

ORIENTATIONS: tuple[Orientation, ...] = ("S/S", "S/I", "I/I")


def ways(orientation: Orientation) -> IntArray:
    """Signs of the order of reflected rows and columns relative to the rays', ±1, shape (2,)."""
    by_column, by_row = orientation.split("/")
    return np.array([1 if by_row == "S" else -1, 1 if by_column == "S" else -1])


def missing_share(missed: int, pairs: int) -> float:
    """Estimate the share of missing dots from the numbers of missed rays and of pairs.

    The posterior mean, with a prior of 0.05 missing dots, so that it is never 0.
    """
    return (missed + 0.05) / (pairs + missed + 1)


@dataclass(frozen=True)
class Trial:
    """Residual of the matched dots for one orientation.

    Parameters
    ----------
    orientation
        The correspondence.
    residual_mm
        Root mean square distance between computed and captured dots, mm; infinite if no surface
        has this correspondence.
    """

    orientation: Orientation
    residual_mm: float


@dataclass(frozen=True)
class Match(ReadOnlyArrays):
    """The n matched pairs of ray and reflected dot.

    Parameters
    ----------
    orientation
        The chosen correspondence.
    dot
        Index of each pair's dot in `Dots`, shape (n,).
    ray
        Its ray (i, j), counted from 1, shape (n, 2).
    reflected
        Its reflected row and column (k, t), counted from 1, shape (n, 2); 0 if unknown.
    plane_mm
        Position of the dot on the imaging plane, IPCS (X′, Z′), shape (n, 2), mm.
    plane_covariance_mm2
        Covariance of the position, shape (n, 2, 2), mm².
    witness
        Evidence of each ray, shape (rows, columns) of the pattern: +1 if it was reflected by the
        pool, −1 if it was not, 0 if unknown (absent, blocked by the torch, off the plane, or in
        doubt).
    trials
        All orientations tried, the best first.
    missing
        Share of missing dots: the probability that a ray reflected by the pool has no dot.
    """

    orientation: Orientation
    dot: IntArray
    ray: IntArray
    reflected: IntArray
    plane_mm: FloatArray
    plane_covariance_mm2: FloatArray
    witness: IntArray
    trials: tuple[Trial, ...] = ()
    missing: float = 0.0

    @property
    def margin(self) -> float:
        """Ratio of the residual of the best other orientation to that of the chosen one."""
        others = [t.residual_mm for t in self.trials if t.orientation != self.orientation]
        own = [t.residual_mm for t in self.trials if t.orientation == self.orientation]
        return min(others) / max(own[0], 1e-9) if own and others else float("inf")


@dataclass(frozen=True)
class Candidate:
    """One of the possible matches of a frame with ambiguous rows: the marker in one of the holes.

    Parameters
    ----------
    match
        The match; None if no surface fits it with the nominal set-up.
    step
        Offset of its rays from those of the first candidate, in rows and columns.
    cost
        −2 log likelihood, maximised over the set-up within its uncertainty, relative to the first
        candidate.
    """

    match: Match | None
    step: tuple[int, int]
    cost: float


class RowsOpen(CannotMeasure):
    """``ambiguous-rows``, with the possible matches of the frame.

    Parameters
    ----------
    reason
        One sentence for the operator.
    candidates
        The possible matches; first the likeliest with the nominal set-up.
    """

    def __init__(self, reason: str, candidates: tuple[Candidate, ...]) -> None:
        super().__init__("ambiguous-rows", reason)
        self.candidates = candidates
