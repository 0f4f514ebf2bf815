"""Weld current and voltage on the recording's time axis, from a table that a logger wrote."""

from __future__ import annotations

import csv
import itertools
import math
import os
import re
from array import array
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TextIO

import numpy as np

from labapp.config.csv_tables import (
    PROBLEMS_SHOWN,
    bounded_lines,
    open_table,
    parse_number,
)
from labapp.core.values import FloatArray, ReadOnlyArrays
from labapp.errors import InputError

A_TABLE = "a table (CSV, UTF-8) with a line of names: a time (s, ms, µs), a current, a voltage"

LARGEST_FILE = 1 << 28
MOST_ROWS = 500_000
LINES_ABOVE = 60
"""Largest number of lines before the names, in which loggers describe themselves."""

NAMES = {
    "time": "time|zeit|t|seconds",
    "current": "current|weld_?current|welding_?current|strom|i|amps?|amperes?",
    "voltage": "voltage|weld_?voltage|welding_?voltage|arc_?voltage|spannung|u|v|volts?",
}
UNITS = {
    "time": {"s": 1.0, "sec": 1.0, "ms": 1e-3, "us": 1e-6, "µs": 1e-6, "μs": 1e-6},
    "current": {"a": 1.0, "ma": 1e-3, "ka": 1e3},
    "voltage": {"v": 1.0, "mv": 1e-3, "kv": 1e3},
}
"""Units of each column, and what one of them is in s, A, V. Without a unit it is these."""


@dataclass(frozen=True)
class Signals(ReadOnlyArrays):
    """Current and voltage of a weld; n samples."""

    file: str
    """Name of the table they were read from."""
    time_s: FloatArray
    """Time of each sample by the logger's clock, ascending, shape (n,), s."""
    current_a: FloatArray
    voltage_v: FloatArray
    """Shape (n,), A and V; NaN where there is none."""
    start_s: float = 0.0
    """Added to the logger's time it gives the recording's, s."""


@dataclass(frozen=True)
class _Column:
    """Where a quantity stands in a line, and what one of its units is."""

    quantity: str
    name: str
    place: int
    factor: float


def read_signals(path: str | os.PathLike[str]) -> Signals:
    """Read current and voltage from a table.

    The line of names may have others above it. A name is that of the quantity, with its unit in
    brackets or behind an underscore: ``time_s``, ``Current (A)``, ``U [V]``. The separator is a
    comma, a semicolon or a tab; the decimals' a point, or, with the latter two, a comma. An empty
    cell is a sample that is not there. Columns of other names are passed over.

    Raises
    ------
    InputError
        If the file cannot be read, or anything in it is missing or impossible; the first ten
        problems are reported together, each with its line and column.
    """
    path = Path(path)
    with open_table(path, A_TABLE, LARGEST_FILE) as file:
        return _read(path, file)


def _read(path: Path, file: TextIO) -> Signals:
    lines = bounded_lines(path, file, A_TABLE)
    above, separator, columns, width = _find_names(path, lines)
    problems: list[InputError] = []
    held = {column.quantity: array("d") for column in columns}
    last, last_line = -math.inf, 0
    reader = csv.reader(lines, delimiter=separator)
    for cells in reader:
        line = above + reader.line_num
        if not any(map(str.strip, cells)):
            continue
        if len(cells) != width:
            hint = "; decimal commas need ; between the columns" * (separator == ",")
            wanted = f"{width}, as in the line of names{hint}"
            problems.append(InputError(path, f"line {line}, cells", len(cells), wanted))
        else:
            time_s = _take(path, line, cells, columns, separator, held, problems)
            if time_s is not None and time_s <= last:
                wanted = f"a time after that of line {last_line}"
                cell = cells[columns[0].place].strip()
                problems.append(InputError(path, f"line {line}, {columns[0].name}", cell, wanted))
            if time_s is not None:
                last, last_line = time_s, line
        if len(problems) >= PROBLEMS_SHOWN:
            break
        if len(held["time"]) > MOST_ROWS:
            raise InputError(path, f"line {line}", "one more sample", f"at most {MOST_ROWS}")
    if problems:
        raise InputError.gather(problems)
    if not len(held["time"]):
        raise InputError(path, "rows", "none", "a row for each sample")
    missing = np.full(len(held["time"]), np.nan)
    current, voltage = (
        np.array(held[name]) if name in held else missing for name in ("current", "voltage")
    )
    return Signals(path.name, np.array(held["time"]), current, voltage)


def _find_names(path: Path, lines: Iterator[str]) -> tuple[int, str, list[_Column], int]:
    """Lines up to the names and with them, the separator, the columns, cells in a line."""
    found = ""
    for above, text in enumerate(itertools.islice(lines, LINES_ABOVE), 1):
        separator = max(",;\t", key=text.count)
        cells = next(csv.reader([text], delimiter=separator), [])
        columns = [column for place, cell in enumerate(cells) for column in _named(cell, place)]
        quantities = [column.quantity for column in columns]
        if "time" in quantities and len(set(quantities)) > 1:
            twice = next((q for q in NAMES if quantities.count(q) > 1), None)
            if twice is not None:
                raise InputError(path, f"line {above}, names", f"{twice} twice", A_TABLE)
            columns.sort(key=lambda column: column.quantity != "time")
            return above, separator, columns, len(cells)
        found = found or text.strip()
    raise InputError(path, "columns", found or "nothing", A_TABLE)


def _named(cell: str, place: int) -> list[_Column]:
    """The column of that name; none if it is of no use here."""
    name = cell.strip()
    parts = re.fullmatch(r"(.*?)[\s_]*(?:[\[(]\s*(\S+?)\s*[\])])?", name)
    word, unit = (parts[1], parts[2]) if parts else (name, None)
    for quantity, units in UNITS.items():
        end = word.lower().replace(" ", "_")
        own = unit.lower() if unit is not None else None
        if own is None and (behind := end.rpartition("_"))[0] and behind[2] in units:
            end, own = behind[0], behind[2]
        if re.fullmatch(NAMES[quantity], end) and (own is None or own in units):
            return [_Column(quantity, name, place, units[own] if own is not None else 1.0)]
    return []


def _take(
    path: Path,
    line: int,
    cells: list[str],
    columns: list[_Column],
    separator: str,
    held: dict[str, array[float]],
    problems: list[InputError],
) -> float | None:
    """Add a line's values to what is held; its time, None where it has none."""
    time_s = None
    for column in columns:
        cell = cells[column.place].strip()
        value = parse_number(cell, separator)
        if column.quantity == "time":
            time_s = None if value is None else value * column.factor
        elif not cell:
            value = math.nan
        if value is None:
            wanted = "a number" if column.quantity == "time" else "a number, or nothing"
            shown = cell or "nothing"
            problems.append(InputError(path, f"line {line}, {column.name}", shown, wanted))
            value = math.nan
        held[column.quantity].append(value * column.factor)
    return time_s
