"""A followed frame's rows of every table: the text of `tables.table_rows`, in less time than it."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from numba import types

from labapp.core.compiled import compiled
from labapp.core.geometry.coordinates import ImageCalibration
from labapp.core.pipeline import Measurement
from labapp.core.values import FloatArray, IntArray
from labapp.export.tables import TABLES, Table, csv_rows, frame_tables

LARGEST, ROUNDED = 2.0**50, 4e-16
"""Numbers that are larger once the point is gone, or nearer to a tie than so much of themselves,
may be rounded the wrong way here."""

LONGEST = 24
"""Most characters of such a number: its sign, its digits, its point and a comma."""


def quick_rows(
    frame: int, time_s: float | None, measurement: Measurement, calibration: ImageCalibration
) -> dict[str, str]:
    """A frame's rows of every table, as CSV text: see `tables.table_rows`."""
    tables = frame_tables(frame, time_s, measurement, calibration)
    return {name: _rows(name, table) for name, table in tables.items()}


def _rows(name: str, table: Table) -> str:
    columns, end = TABLES[name], "\n"
    if columns[-1].digits is None:
        last = set(table[columns[-1].name].tolist())
        columns, end = columns[:-1], f",{''.join(last)}\n"
        if len(last) != 1:
            return csv_rows(name, table)
    if any(column.digits is None for column in columns):
        return csv_rows(name, table)
    digits = np.array([column.digits for column in columns])
    values = np.column_stack([table[column.name] for column in columns]).astype(float)
    text, length = fixed(values, digits)
    if length < 0:
        return csv_rows(name, table)
    rows = text[:length].tobytes().decode("ascii")
    return rows if end == "\n" else rows.replace("\n", end)


@compiled(
    types.Array(types.float64, 2, "A", readonly=True),
    types.Array(types.int64, 1, "A", readonly=True),
)
def fixed(values: FloatArray, digits: IntArray) -> tuple[npt.NDArray[np.uint8], int]:
    """Lines of numbers with commas between them; of what is not finite, nothing.

    Parameters
    ----------
    values, digits
        Shape (rows, columns), and the decimals of each column, shape (columns,).

    Returns
    -------
    text, length
        Bytes, and how many of them; −1 if the rounding of a number cannot be told here.
    """
    text, own = np.empty(values.size * LONGEST, np.uint8), np.empty(LONGEST, np.uint8)
    at = 0
    for row in range(values.shape[0]):
        for column in range(values.shape[1]):
            value = values[row, column]
            if np.isfinite(value):
                scaled = abs(value) * 10.0 ** digits[column]
                off_tie = abs(scaled - np.floor(scaled) - 0.5)
                if scaled >= LARGEST or off_tie <= ROUNDED * scaled:
                    return text, -1
                left = np.int64(np.rint(scaled))
                if value < 0.0 and left > 0:
                    text[at] = 45  # the sign
                    at += 1
                count = 0
                while left > 0 or count <= digits[column]:
                    own[count] = 48 + left % 10
                    left //= 10
                    count += 1
                for k in range(count - 1, -1, -1):
                    text[at] = own[k]
                    at += 1
                    if k == digits[column] and k > 0:
                        text[at] = 46  # the point
                        at += 1
            text[at] = 44 if column < values.shape[1] - 1 else 10  # a comma, or the line's end
            at += 1
    return text, at
