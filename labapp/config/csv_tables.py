"""Reading of untrusted CSV tables: limited in size, with errors that help the user."""

from __future__ import annotations

import csv
import itertools
import math
from array import array
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TextIO

import numpy as np

from labapp.core.values import FloatArray
from labapp.errors import InputError
from labapp.files import regular_size

LONGEST_LINE = 1 << 14
HEAD_BYTES = 1 << 16

LARGEST = 1e12
"""Upper limit of numbers in tables; a time may be counted from 1904."""

PROBLEMS_SHOWN = 10
"""Maximum number of problems of a table that are reported together."""


@contextmanager
def open_table(path: Path, wanted: str, largest: int) -> Iterator[TextIO]:
    """Open a table of at most ``largest`` bytes as UTF-8 text; all errors become `InputError`.

    Read it with ``csv.reader(…, strict=True)``: otherwise an open quotation mark takes all the rows
    after it for text.

    Raises
    ------
    InputError
        If the file cannot be read, is too large, or is not text; ``wanted`` is what is expected.
    """
    try:
        size = regular_size(path)
        if size > largest:
            raise InputError(path, "size", f"{size} bytes", f"at most {largest} bytes")
        with path.open("rb") as head:
            if b"\0" in head.read(HEAD_BYTES):
                raise InputError(path, "content", "binary or UTF-16", wanted)
        with path.open(encoding="utf-8-sig", newline="") as file:
            yield file
    except OSError as error:
        raise InputError(path, "file", error.strerror or error, wanted) from error
    except UnicodeDecodeError as error:
        raise InputError(path, "encoding", "not UTF-8", wanted) from error
    except csv.Error as error:
        raise InputError(path, "syntax", error, wanted) from error


def bounded_lines(path: Path, file: TextIO, wanted: str) -> Iterator[str]:
    """Lines of a file; a line longer than `LONGEST_LINE` raises before it fills the memory."""
    for number in itertools.count(1):
        text = file.readline(LONGEST_LINE)
        if len(text) >= LONGEST_LINE:
            long = f"more than {LONGEST_LINE} characters"
            raise InputError(path, f"line {number}", long, wanted)
        if not text:
            return
        yield text


def split_header(line: str) -> tuple[str, list[str]]:
    """Separator of a table (a comma, a semicolon or a tab) and the names of its columns."""
    separator = max(",;\t", key=line.count)
    cells = next(csv.reader([line], delimiter=separator), [])
    return separator, [cell.strip() for cell in cells]


def parse_number(cell: str, separator: str) -> float | None:
    """Parse a finite number, or return None; a decimal comma is allowed if not the separator."""
    if separator != ",":
        cell = cell.replace(",", ".")
    try:
        value = float(cell) if "_" not in cell else math.nan
    except ValueError:
        return None
    return value if math.isfinite(value) else None


class NumberCells:
    """Parser of a table's numbers, which all have the same decimal sign.

    The other sign separates thousands, or the number comes from elsewhere: it is no number then.
    """

    def __init__(self, separator: str) -> None:
        self._separator, self._signs = separator, set[str]()

    def parse(self, cell: str) -> float | None:
        """Parse a cell by `parse_number`; None, too, if above `LARGEST` or with the other sign."""
        signs = self._signs.union(sign for sign in ".," if sign in cell)
        value = parse_number(cell, self._separator) if len(signs) < 2 else None
        if value is None or abs(value) > LARGEST:
            return None
        self._signs = signs
        return value

    @property
    def expected(self) -> str:
        """A valid cell, for errors."""
        sign = "".join(self._signs)
        return f"a number, its decimal sign {sign} as above" if sign else "a number"


def read_columns(
    path: Path, wanted: str, largest: int, words: Collection[str] = ()
) -> tuple[dict[str, list[str]], dict[str, FloatArray]]:
    """Columns of text and of numbers, by name; the separator is a comma, a semicolon or a tab.

    Parameters
    ----------
    path, wanted, largest
        See `open_table`.
    words
        Names of text columns; all others are numbers, NaN if a cell is empty.

    Raises
    ------
    InputError
        If the file cannot be read, names are missing or repeated, or a cell is not a number.
    """
    with open_table(path, wanted, largest) as file:
        lines = bounded_lines(path, file, wanted)
        head = next(lines, "")
        separator, names = split_header(head)
        if not all(names) or len(set(names)) < len(names) or not names:
            raise InputError(
                path, "line 1", head.strip() or "empty", f"a name per column: {wanted}"
            )
        texts: dict[str, list[str]] = {name: [] for name in names if name in words}
        numbers = {name: array("d") for name in names if name not in words}
        number = NumberCells(separator)
        rows = csv.reader(lines, delimiter=separator, strict=True)
        for line, cells in enumerate(rows, 2):
            if not any(cells):
                continue
            if len(cells) != len(names):
                raise InputError(path, f"line {line}", f"{len(cells)} cells", f"{len(names)}")
            for name, cell in zip(names, map(str.strip, cells), strict=True):
                if name in texts:
                    texts[name].append(cell)
                    continue
                value = number.parse(cell) if cell else math.nan
                if value is None:
                    raise InputError(path, f"line {line}, {name}", cell, number.expected)
                numbers[name].append(value)
    return texts, {name: np.array(values) for name, values in numbers.items()}
