"""Which way reflected rows and columns run, against the rays' (§4.2.2.1)."""

from __future__ import annotations

from typing import Literal

import numpy as np

from labapp.core.values import IntArray

Orientation = Literal["S/S", "S/I", "I/I"]
"""Column/row correspondence: S grows the same way as the rays, I the other way."""

ORIENTATIONS: tuple[Orientation, ...] = ("S/S", "S/I", "I/I")


def ways(orientation: Orientation) -> IntArray:
    """+1 or −1: whether reflected rows, and columns, grow with the rays'; shape (2,)."""
    by_column, by_row = orientation.split("/")
    return np.array([1 if by_row == "S" else -1, 1 if by_column == "S" else -1])
