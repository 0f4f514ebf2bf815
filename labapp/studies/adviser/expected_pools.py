"""The pools that an experiment expects: a kind, and between which sizes."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product
from typing import Literal

import numpy as np
from scipy import special
from scipy.stats import qmc

from labapp.core.geometry.uncertainty import FIRST, QUANTITIES
from labapp.core.values import FloatArray, ReadOnlyArrays
from labapp.simulation.pools import Pool, ellipsoidal_cap

Kind = Literal["convex", "concave"]
Range = tuple[float, float]

SIZES, DRAWN = 3, 5
"""Width, length and height; and with them the place along X and Y: what is drawn of a pool."""


@dataclass(frozen=True)
class ExpectedPools:
    """Parts of ellipsoids, evenly spread over ranges of size and place.

    Raises
    ------
    ValueError
        If a range is upside down or not positive, or the highest pool would overhang.
    """

    width_mm: Range
    length_mm: Range
    """Smallest and largest, along X and along Y."""
    height_mm: Range
    """Least and most, positive for either kind."""
    kind: Kind = "convex"
    """``convex`` stands above the work piece, ``concave`` lies below it."""
    shift_mm: float = 0.3
    """How far a pool's middle lies off the electrode at most, along X and along Y."""

    def __post_init__(self) -> None:
        for name in ("width_mm", "length_mm", "height_mm"):
            low, high = getattr(self, name)
            if not 0 < low <= high:
                raise ValueError(f"{name}: a range above 0, from the smaller to the larger")
        if not self.shift_mm >= 0:
            raise ValueError("shift_mm: 0 or more")
        if self.height_mm[1] >= self.width_mm[0] / 2:
            raise ValueError("height_mm: below half the least width: its sides would overhang")

    @property
    def _ranges(self) -> FloatArray:
        shift = (-self.shift_mm, self.shift_mm)
        return np.array([self.width_mm, self.length_mm, self.height_mm, shift, shift])

    def at(self, share: FloatArray) -> Pool:
        """The pool whose sizes and place lie at shares 0 … 1 of their ranges, shape (5,)."""
        low, high = self._ranges.T
        width, length, height, x, y = map(float, low + share * (high - low))
        return ellipsoidal_cap(width, length, self.sign * height, (x, y))

    @property
    def sign(self) -> int:
        """+1 for convex pools, −1 for concave ones."""
        return 1 if self.kind == "convex" else -1

    @property
    def mean_height_mm(self) -> float:
        """Of the pools, mm."""
        return sum(self.height_mm) / 2

    def corners(self, shifted: bool) -> tuple[Pool, ...]:
        """Pools of extreme size, at the middle or each at the four extreme places."""
        places = list(product((0, 1), (0, 1))) if shifted else [(0.5, 0.5)]
        shares = [(*size, *place) for size in product((0, 1), repeat=3) for place in places]
        return tuple(dict.fromkeys(self.at(np.array(share)) for share in shares))

    def sample(self, count: int, seed: int, even: bool = True, places: int = 1) -> Sample:
        """Draw pools, each at a number of places, and errors of the calibration with each of these.

        Evenly, by a scrambled Sobol row, or each independently of the others. The places of a
        pool follow each other.
        """
        rng, total = np.random.default_rng(seed), count * places
        share = rng.random((total, DRAWN + FIRST))
        if even:
            row = qmc.Sobol(DRAWN + FIRST, rng=rng)
            share = row.random_base2(max(total - 1, 0).bit_length())[:total]
        # Drawn last, so that with these known exactly the same advice comes of a seed as ever.
        share = np.hstack([share, rng.random((total, len(QUANTITIES) - FIRST))])
        share[:, :SIZES] = np.repeat(share[:count, :SIZES], places, axis=0)
        pools = tuple(self.at(one) for one in share[:, :DRAWN])
        # It may hold a 0, to which no normal deviate belongs.
        deviate = special.ndtri(np.clip(share[:, DRAWN:], 1e-6, 1 - 1e-6))
        return Sample(pools, deviate, seed)


@dataclass(frozen=True)
class Sample(ReadOnlyArrays):
    """Pools that set-ups are compared on: the same ones, with the same errors."""

    pools: tuple[Pool, ...]
    """n of them."""
    deviate: FloatArray
    """Errors of the calibration, in standard uncertainties, shape (n, q)."""
    seed: int
