"""Match: the matched pairs of ray and dot, which `matching` finds and every scheme begins with."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from labapp.core.values import CannotMeasure, FloatArray, IntArray, ReadOnlyArrays

Orientation = Literal["S/S", "S/I", "I/I"]
"""Column/row correspondence: S grows the same way as the rays, I the other way."""

ORIENTATIONS: tuple[Orientation, ...] = ("S/S", "S/I", "I/I")


def ways(orientation: Orientation) -> IntArray:
    """Whether reflected rows grow with the rays', and columns: +1 or −1 each, shape (2,)."""
    by_column, by_row = orientation.split("/")
    return np.array([1 if by_row == "S" else -1, 1 if by_column == "S" else -1])


def missing_share(missed: int, pairs: int) -> float:
    """Share of the dots that are missing, where so many rays amid so many pairs have no dot.

    The mean of its posterior, with a twentieth of a dot missing beforehand: never none.
    """
    return (missed + 0.05) / (pairs + missed + 1)


@dataclass(frozen=True)
class Trial:
    """How well the matched dots fit with one orientation.

    Parameters
    ----------
    orientation
        The correspondence.
    residual_mm
        Root mean square distance of computed from captured dots, mm; infinite if no surface has
        this correspondence.
    """

    orientation: Orientation
    residual_mm: float


@dataclass(frozen=True)
class Match(ReadOnlyArrays):
    """Matched pairs of ray and reflected dot, n of them.

    Parameters
    ----------
    orientation
        The correspondence that was settled on.
    dot
        Index of each pair's dot in `Dots`, shape (n,).
    ray
        Its ray (i, j), counted from 1, shape (n, 2).
    reflected
        Its reflected row and column (k, t), counted from 1, shape (n, 2); 0 where it is
        not known.
    plane_mm
        The dot on the imaging plane, IPCS (X′, Z′), shape (n, 2), mm.
    plane_covariance_mm2
        Covariance of that, shape (n, 2, 2), mm².
    witness
        Shape (rows, columns) of the pattern: +1 where the ray came back, −1 where it did not,
        0 where it cannot testify (absent, blocked by the torch, off the plane, in doubt).
    trials
        Every orientation that was tried, the best first.
    missing
        Share of the dots that are missing: the probability that a ray that came back has no dot.
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
        """Residual of the best other orientation over that of the chosen one."""
        others = [t.residual_mm for t in self.trials if t.orientation != self.orientation]
        own = [t.residual_mm for t in self.trials if t.orientation == self.orientation]
        return min(others) / max(own[0], 1e-9) if own and others else float("inf")


@dataclass(frozen=True)
class Candidate:
    """One of the matches of a frame whose rows are open: the marker in one of several holes.

    Parameters
    ----------
    match
        The match; None where no surface has its rays with the set-up as it is entered.
    step
        Rows and columns by which its rays are on from those of the first candidate.
    cost
        −2 log likelihood of it with the set-up that it is likeliest with, within its uncertainty,
        less that of the first candidate.
    """

    match: Match | None
    step: tuple[int, int]
    cost: float


class RowsOpen(CannotMeasure):
    """``ambiguous-rows``, with the matches that one frame leaves open.

    Parameters
    ----------
    reason
        One sentence for the operator.
    candidates
        First the one that is likeliest with the set-up as it is entered.
    """

    def __init__(self, reason: str, candidates: tuple[Candidate, ...]) -> None:
        super().__init__("ambiguous-rows", reason)
        self.candidates = candidates
