"""Lattice → Match: which ray made which dot, and how sure (§4.2.2, §5.2.3, §7.1)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from labapp.core.values import FloatArray, IntArray, freeze

Orientation = Literal["S/S", "S/I", "I/I"]
"""Column/row correspondence: S grows the same way as the rays, I the other way."""


@dataclass(frozen=True)
class Trial:
    """One hypothesis that was tried: its orientation, reference site (k, t) and residual."""

    orientation: Orientation
    reference: tuple[int, int]
    residual_mm: float


@dataclass(frozen=True)
class Match:
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
        Its reflected row and column (k, t), counted from 1, shape (n, 2); 0 where the dot was
        matched by prediction only.
    plane_mm
        The dot on the imaging plane, IPCS (X′, Z′), shape (n, 2), mm.
    plane_covariance_mm2
        Covariance of that, shape (n, 2, 2), mm².
    witness
        Shape (rows, columns) of the pattern: +1 where the ray came back, −1 where it did not,
        0 where it cannot testify (absent, blocked by the torch, off the plane, in doubt).
    trials
        Everything that was tried, the best first.
    margin
        Residual of the best other orientation over that of the chosen one.
    """

    orientation: Orientation
    dot: IntArray
    ray: IntArray
    reflected: IntArray
    plane_mm: FloatArray
    plane_covariance_mm2: FloatArray
    witness: IntArray
    trials: tuple[Trial, ...] = ()
    margin: float = float("inf")

    def __post_init__(self) -> None:
        freeze(self)
