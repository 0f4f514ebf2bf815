"""Compiled formatting of arrays as decimal text, fast enough for the tables of every frame."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from numba import types

from labapp.core.compiled import compiled
from labapp.core.values import FloatArray, IntArray

LARGEST, ROUNDED = 2.0**50, 4e-16
"""A scaled number above `LARGEST`, or closer to a tie than `ROUNDED` times its value, might be
rounded incorrectly."""

LONGEST = 24
"""Most characters of a number: sign, digits, point and comma."""


@compiled(
    types.Array(types.float64, 2, "A", readonly=True),
    types.Array(types.int64, 1, "A", readonly=True),
)
def format_fixed(values: FloatArray, digits: IntArray) -> tuple[npt.NDArray[np.uint8], int]:
    """Format numbers as lines of comma-separated fixed-point decimals; empty where not finite.

    Parameters
    ----------
    values
        Numbers, shape (rows, columns).
    digits
        Decimals of each column, shape (columns,).

    Returns
    -------
    text, length
        Buffer of ASCII bytes, and the number used; −1 if a number might be rounded incorrectly.
    """
    text, reverse = np.empty(values.size * LONGEST, np.uint8), np.empty(LONGEST, np.uint8)
    at, scale, ten = 0, 10.0**digits, np.uint64(10)
    for row in range(values.shape[0]):
        for column in range(values.shape[1]):
            value = values[row, column]
            if np.isfinite(value):
                scaled = abs(value) * scale[column]
                off_tie = abs(scaled - np.floor(scaled) - 0.5)
                if scaled >= LARGEST or off_tie <= ROUNDED * scaled:
                    return text, -1
                left = np.uint64(np.rint(scaled))
                if value < 0.0 and left > 0:
                    text[at] = 45  # the sign
                    at += 1
                count = 0
                while left > 0 or count <= digits[column]:
                    tenth = left // ten
                    reverse[count] = 48 + np.uint8(left - ten * tenth)
                    left, count = tenth, count + 1
                for k in range(count - 1, -1, -1):
                    text[at] = reverse[k]
                    at += 1
                    if k == digits[column] and k > 0:
                        text[at] = 46  # the point
                        at += 1
            text[at] = 44 if column < values.shape[1] - 1 else 10  # a comma, or the line's end
            at += 1
    return text, at
