"""Shape of the reflected rows, and which correspondences it allows (§4.2.2.3, §7.1).

Convex rows, whose middle is highest in the image, come from a convex pool (S/S) or a deep concave
one (I/I); concave rows come from a shallow concave pool (S/I, S/S).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from labapp.core.match import Match, Orientation
from labapp.core.values import FloatArray, IntArray

Shape = Literal["convex", "concave"]

ALLOWED: dict[Shape, tuple[Orientation, ...]] = {
    "convex": ("S/S", "I/I"),
    "concave": ("S/S", "S/I"),
}
"""Correspondences that ERS tries by the shape of the reflected image (§7.1)."""

LEAST_DOTS = 4
"""Minimum number of dots of a row whose shape is determined: that of shorter rows is noise."""


@dataclass(frozen=True)
class RowShapes:
    """Numbers of convex and of concave reflected rows."""

    convex: int
    concave: int

    @property
    def shape(self) -> Shape | None:
        """Shape of the majority of the rows; None if there is no majority."""
        if self.convex == self.concave:
            return None
        return "convex" if self.convex > self.concave else "concave"

    def allows(self, orientation: Orientation) -> bool | None:
        """Whether the rule of §7.1 allows an orientation; None without a majority."""
        return None if self.shape is None else orientation in ALLOWED[self.shape]


def row_shapes(plane_mm: FloatArray, row: IntArray) -> RowShapes:
    """Count convex and concave rows, by the sign of a parabola fitted to each.

    Parameters
    ----------
    plane_mm
        Dots on the imaging plane (X′, Z′), shape (n, 2), mm.
    row
        Reflected row k of each, shape (n,); 0: none.
    """
    curvatures = []
    for k in np.unique(row[row > 0]):
        x, z = plane_mm[row == k].T
        if len(x) >= LEAST_DOTS:
            curvatures.append(np.polynomial.Polynomial.fit(x, z, 2).coef[2])
    signs = np.sign(curvatures)
    return RowShapes(int(np.sum(signs < 0)), int(np.sum(signs > 0)))


def match_row_shapes(match: Match) -> RowShapes:
    """Shapes of the reflected rows of a match."""
    return row_shapes(match.plane_mm, match.reflected[:, 0])
