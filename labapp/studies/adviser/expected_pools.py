"""The expected pools of an experiment: their kind and the ranges of their sizes."""

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
"""Number of sizes (width, length, height), and of drawn values including the position in X and Y.
"""


@dataclass(frozen=True)
class ExpectedPools:
    """Parts of ellipsoids, uniformly distributed over ranges of size and position.

    Raises
    ------
    ValueError
        If a range is reversed or not positive, or the highest pool would overhang.
    """

    width_mm: Range
    length_mm: Range
    """Smallest and largest extent along X and along Y."""
    height_mm: Range
    """Smallest and largest height, positive for both kinds."""
    kind: Kind = "convex"
    """``convex`` is above the work piece, ``concave`` below it."""
    shift_mm: float = 0.3
    """Maximum distance of a pool's centre from the electrode along X and along Y."""

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
        """The pool with its sizes and position at shares 0 … 1 of their ranges, shape (5,)."""
        low, high = self._ranges.T
        width, length, height, x, y = map(float, low + share * (high - low))
        return ellipsoidal_cap(width, length, self.sign * height, (x, y))

    @property
    def sign(self) -> int:
        """+1 for convex pools, −1 for concave ones."""
        return 1 if self.kind == "convex" else -1

    @property
    def mean_height_mm(self) -> float:
        """Mean height of the pools, mm."""
        return sum(self.height_mm) / 2

    def corners(self, shifted: bool) -> tuple[Pool, ...]:
        """Pools of extreme size, centred or each at the four extreme positions."""
        places = list(product((0, 1), (0, 1))) if shifted else [(0.5, 0.5)]
        shares = [(*size, *place) for size in product((0, 1), repeat=3) for place in places]
        return tuple(dict.fromkeys(self.at(np.array(share)) for share in shares))

    def sample(self, count: int, seed: int, even: bool = True, places: int = 1) -> Sample:
        """Draw pools, each at a number of positions, and calibration errors for each position.

        The pools are drawn evenly, by a scrambled Sobol sequence, or independently of each other.
        The positions of a pool are consecutive.
        """
        rng, total = np.random.default_rng(seed), count * places
        share = rng.random((total, DRAWN + FIRST))
        if even:
            row = qmc.Sobol(DRAWN + FIRST, rng=rng)
            share = row.random_base2(max(total - 1, 0).bit_length())[:total]
        # Drawn last, so that a seed gives the same advice as before if these are known exactly.
        share = np.hstack([share, rng.random((total, len(QUANTITIES) - FIRST))])
        share[:, :SIZES] = np.repeat(share[:count, :SIZES], places, axis=0)
        pools = tuple(self.at(one) for one in share[:, :DRAWN])
        # It may contain a 0, for which there is no normal deviate.
        deviate = special.ndtri(np.clip(share[:, DRAWN:], 1e-6, 1 - 1e-6))
        return Sample(pools, deviate, seed)


@dataclass(frozen=True)
class Sample(ReadOnlyArrays):
    """Pools and errors that are the same for all compared set-ups."""

    pools: tuple[Pool, ...]
    """n pools."""
    deviate: FloatArray
    """Errors of the calibration, in standard uncertainties, shape (n, q)."""
    seed: int
