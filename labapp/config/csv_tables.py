"""Reading of untrusted CSV tables: bounded in size, with errors a user can act on."""

from __future__ import annotations

import csv
import itertools
import math
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TextIO

from labapp.errors import InputError

LONGEST_LINE = 1 << 14
HEAD_BYTES = 1 << 16

PROBLEMS_SHOWN = 10
"""Most problems of a table that are reported together."""


@contextmanager
def open_table(path: Path, wanted: str, largest: int) -> Iterator[TextIO]:
    """Open a table as UTF-8 text; errors of file, encoding and syntax become `InputError`.

    Parameters
    ----------
    wanted
        What it should be, for the errors.
    largest
        Largest size, bytes.

    Raises
    ------
    InputError
        If it cannot be read, is too large, or is no text.
    """
    try:
        size = path.stat().st_size
        if size > largest:
            raise InputError(path, "size", f"{size} bytes", f"at most {largest} bytes")
        with path.open("rb") as head:
            if b"\0" in head.read(HEAD_BYTES):
                raise InputError(path, "content", "binary, or UTF-16", wanted)
        with path.open(encoding="utf-8-sig", newline="") as file:
            yield file
    except OSError as error:
        raise InputError(path, "file", error.strerror, wanted) from error
    except UnicodeDecodeError as error:
        raise InputError(path, "encoding", "not UTF-8", wanted) from error
    except csv.Error as error:
        raise InputError(path, "syntax", error, wanted) from error


def bounded_lines(path: Path, file: TextIO, wanted: str) -> Iterator[str]:
    """Lines of a file; one longer than `LONGEST_LINE` raises before it fills the memory."""
    for number in itertools.count(1):
        text = file.readline(LONGEST_LINE)
        if len(text) >= LONGEST_LINE:
            long = f"more than {LONGEST_LINE} characters"
            raise InputError(path, f"line {number}", long, wanted)
        if not text:
            return
        yield text


def parse_number(cell: str, separator: str) -> float | None:
    """Parse a finite number; a decimal comma is allowed unless it is the separator. Else None."""
    if separator != ",":
        cell = cell.replace(",", ".")
    try:
        value = float(cell) if "_" not in cell else math.nan
    except ValueError:
        return None
    return value if math.isfinite(value) else None
