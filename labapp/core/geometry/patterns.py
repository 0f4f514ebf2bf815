"""The kinds of dot pattern: where the rays of a lens go. Here is their list.

A kind is a function and an entry of `PATTERNS`. It gives the tangents of the rays to the beam axis:
where they pass through a screen across the axis at distance 1, to the side (with X) and upwards.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from labapp.core.values import FloatArray

Tangents = Callable[[int, int, float], FloatArray]
"""Rows, columns, angle between neighbours at the centre (rad) → tangents (aside, up), shape
(rows, columns, 2).

Rows run from the top of the fan to its bottom, columns with X; the centre is (0, 0). With two rows
or two columns more, the rays amid them are the same.
"""


def square(rows: int, columns: int, step: float) -> FloatArray:
    """Rays at equal angles along the middle row and the middle column (Fig. 4-14)."""
    tangents = np.empty((rows, columns, 2))
    tangents[..., 0] = np.tan((np.arange(columns) - (columns - 1) / 2) * step)
    tangents[..., 1] = np.tan(((rows - 1) / 2 - np.arange(rows)) * step)[:, None]
    return tangents


PATTERNS: dict[str, Tangents] = {"square": square}
"""All kinds, by their name in setup files."""
