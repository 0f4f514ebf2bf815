"""Matched pairs of rays and dots, found by `matching` and used by every scheme."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from labapp.core.values import CannotMeasure, FloatArray, IntArray, ReadOnlyArrays

Orientation = Literal["S/S", "S/I", "I/I"]
"""Order of columns/order of rows: S as the rays, I inverse. Settings call it correspondence."""

ORIENTATIONS: tuple[Orientation, ...] = ("S/S", "S/I", "I/I")


def signs_of(orientation: Orientation) -> IntArray:
    """Signs of reflected rows and columns relative to those of the rays, ±1, shape (2,)."""
    by_column, by_row = orientation.split("/")
    return np.array([1 if by_row == "S" else -1, 1 if by_column == "S" else -1])


def missing_share(missed: int, pairs: int) -> float:
    """Estimate the share of missing dots from the numbers of missed rays and of pairs.

    The posterior mean with a prior worth one dot, 0.05 of it missing: never 0.
    """
    return (missed + 0.05) / (pairs + missed + 1)


@dataclass(frozen=True)
class Trial:
    """Residual of the matched dots for one orientation.

    Parameters
    ----------
    residual_mm
        Root mean square distance between computed and captured dots, mm; infinite if no surface
        has this orientation.
    """

    orientation: Orientation
    residual_mm: float


@dataclass(frozen=True, repr=False)
class Match(ReadOnlyArrays):
    """The n matched pairs of ray and reflected dot.

    Parameters
    ----------
    dot
        Index of each pair's dot in `Dots`, shape (n,).
    ray
        Ray (i, j) of each pair, counted from 1, shape (n, 2).
    reflected
        Reflected row and column (k, t) of each pair, counted from 1, shape (n, 2); 0 if unknown.
    plane_mm
        Position of each dot on the imaging plane, IPCS (X′, Z′), shape (n, 2), mm.
    plane_covariance_mm2
        Covariance of the positions, shape (n, 2, 2), mm².
    ray_states
        State of every ray, shape (rows, columns): +1 lit, the pool reflected it; −1 dark, it did
        not; 0 unknown (absent, blocked by the torch, off the plane, in doubt).
    trials
        All orientations tried, the best first.
    missing
        Share of missing dots: the probability that the dot of a reflected ray was not detected.
    """

    orientation: Orientation
    dot: IntArray
    ray: IntArray
    reflected: IntArray
    plane_mm: FloatArray
    plane_covariance_mm2: FloatArray
    ray_states: IntArray
    trials: tuple[Trial, ...] = ()
    missing: float = 0.0

    @property
    def residual_ratio(self) -> float:
        """Residual of the best other orientation divided by that of the selected one."""
        others = [t.residual_mm for t in self.trials if t.orientation != self.orientation]
        own = [t.residual_mm for t in self.trials if t.orientation == self.orientation]
        return min(others) / max(own[0], 1e-9) if own and others else float("inf")


@dataclass(frozen=True)
class MatchedDots:
    """What the fit of a surface needs of a `Match`, whose fields have the same names."""

    ray: IntArray
    plane_mm: FloatArray
    plane_covariance_mm2: FloatArray
    ray_states: IntArray
    missing: float = 0.0


@dataclass(frozen=True)
class Candidate:
    """One possible match of a frame whose rows are ambiguous: the marker in one of several holes.

    Parameters
    ----------
    match
        The match; None if no surface fits its rays with the set-up as entered, or its rim is left
        out.
    step
        Offset of its rays from those of the first candidate, in rows and columns.
    cost
        −2 log likelihood, maximized over the set-up within its uncertainty, minus that of the
        first candidate.
    """

    match: Match | None
    step: tuple[int, int]
    cost: float


class RowsOpen(CannotMeasure):
    """``ambiguous-rows``, with the matches that are possible for one frame.

    Parameters
    ----------
    reason
        One sentence for the operator.
    candidates
        Possible matches; first the one that is most likely with the set-up as entered.
    """

    def __init__(self, reason: str, candidates: tuple[Candidate, ...]) -> None:
        super().__init__("ambiguous-rows", reason)
        self.candidates = candidates
