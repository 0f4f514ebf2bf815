"""Corrections from a table of dots (CSV) that was edited in a spreadsheet or by a script.

The columns are those that `labapp detect` writes and that a session exports to `dots.csv`; other
columns are ignored.
"""

from __future__ import annotations

import csv
import itertools
import math
import os
from collections.abc import Iterator
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import TextIO

import numpy as np
import scipy

from labapp.config.csv_tables import (
    PROBLEMS_SHOWN,
    NumberCells,
    bounded_lines,
    open_table,
)
from labapp.core.images.dots import Dots
from labapp.core.rows.correction import MOST, PLACED_PX, Correction, set_reference
from labapp.core.rows.lattice import Lattice
from labapp.core.values import FloatArray, IntArray
from labapp.errors import InputError

NEEDED = ("u_px", "v_px", "reflected_row", "reflected_column")
A_TABLE = f"a table of dots (CSV, UTF-8) with the columns {', '.join(NEEDED)}"

LARGEST_FILE = 1 << 29
MOST_DOTS = 10_000
"""Most dots of a frame."""

SAME_PX = 1.0
"""Largest distance between a dot of the table and its former position."""

UNMOVED_PX = 1e-3
"""Smallest distance that counts as moved by hand: tables round to 0.0001 px."""

USUAL_SIZE_PX = 2.0
"""Size of a dot in a frame in which none was found."""


@dataclass(frozen=True)
class _Row:
    """A line of the table; row and column are 0 if the dot has none."""

    line: int
    u_px: float
    v_px: float
    row: int
    column: int
    blocked: bool | None


def read_correction(
    path: str | os.PathLike[str], frame: int, frame_shape: tuple[int, int], before: Correction
) -> Correction:
    """Read the correction of a frame, with dots, rows and columns, from a table.

    A dot within 1 px of a former one has its uncertainty, and is marked as manual only if its
    position, row or column differs; any other dot is manual. The reference is determined later.

    Parameters
    ----------
    path
        The table; with a column ``frame``, rows of other frames are ignored. The separator is a
        comma, a semicolon or a tab; the decimal sign a point or, with the latter two, a comma.
    frame_shape
        Height and width of the frame, px.
    before
        Present dots and rows of the frame.

    Raises
    ------
    InputError
        If the file cannot be read, or anything in it is missing or invalid; the first ten problems
        are reported together.
    """
    path = Path(path)
    rows = _read(path, frame, frame_shape)
    place = np.array([(row.u_px, row.v_px) for row in rows])
    origin = _match_dots(place, before.dots.image_px)
    known = origin >= 0
    source = np.where(known, origin, len(before.dots))  # the last: a manual dot
    old = _with_manual_dot(before.dots)
    dots = Dots(*(getattr(old, column.name)[source] for column in fields(Dots)))
    exact = known & (np.hypot(*(place - dots.image_px).T) <= UNMOVED_PX)
    u, v = np.where(exact, dots.image_px.T, place.T)
    site = np.array([(row.row, row.column) for row in rows], np.int64)
    former = np.column_stack([before.lattice.row, before.lattice.column])
    former = np.vstack([former, [[0, 0]]])[source]
    changed = ~exact | (site != former).any(axis=1)
    blocked = frozenset(row.row for row in rows if row.blocked)
    lattice = Lattice(site[:, 0], site[:, 1], blocked_rows=blocked)
    manual = changed | np.append(before.manual, True)[source]
    # The search for the reference also determines its possible sites.
    return set_reference(Correction(replace(dots, u_px=u, v_px=v), lattice, manual), None)


def _match_dots(place: FloatArray, before: FloatArray) -> IntArray:
    """Return the index of each dot's former dot, each used at most once; −1 if none, shape (n,)."""
    same = np.full(len(place), -1)
    if not len(before):
        return same
    distance, nearest = scipy.spatial.cKDTree(before).query(place, distance_upper_bound=SAME_PX)
    taken: set[int] = set()
    for dot in np.argsort(distance, kind="stable").tolist():
        if math.isfinite(distance[dot]) and int(nearest[dot]) not in taken:
            taken.add(int(nearest[dot]))
            same[dot] = nearest[dot]
    return same


def _with_manual_dot(dots: Dots) -> Dots:
    """Append a dot with the properties of a manual dot, at an arbitrary position."""
    size = float(np.median(dots.size_px)) if len(dots) else USUAL_SIZE_PX
    unsure = max(size, PLACED_PX)
    peak, snr = (float(np.median(x)) if len(dots) else 1.0 for x in (dots.peak, dots.snr))
    placed = Dots(*(np.array([x]) for x in (0.0, 0.0, unsure, unsure, size, peak, snr)))
    return Dots(*(np.append(getattr(dots, c.name), getattr(placed, c.name)) for c in fields(Dots)))


def _read(path: Path, frame: int, frame_shape: tuple[int, int]) -> list[_Row]:
    """Read the table's rows of one frame, at least one."""
    problems: list[InputError] = []
    rows: list[_Row] = []
    with open_table(path, A_TABLE, LARGEST_FILE) as file:
        reader = _Reader(path, file, frame, frame_shape, problems)
        for line, cells in reader.lines():
            row = reader.row(line, cells)
            rows += [] if row is None else [row]
            if len(rows) > MOST_DOTS:
                wanted = f"at most {MOST_DOTS} dots"
                raise InputError(path, f"line {line}", f"dot {len(rows)}", wanted)
            if len(problems) >= PROBLEMS_SHOWN:
                break
    problems = problems or _contradictions(path, rows)
    if problems:
        raise InputError.gather(problems[:PROBLEMS_SHOWN])
    if not rows:
        which = f"no dot of frame {frame}" if reader.has_frames else "no dot"
        raise InputError(path, "rows", which, "a row for each dot of the frame")
    return rows


class _Reader:
    """Reads a table line by line and collects its problems."""

    def __init__(
        self,
        path: Path,
        file: TextIO,
        frame: int,
        frame_shape: tuple[int, int],
        problems: list[InputError],
    ) -> None:
        self._path = path
        self._frame = frame
        self._problems = problems
        self._bounds = {"u_px": frame_shape[1] - 0.5, "v_px": frame_shape[0] - 0.5}
        bounded = bounded_lines(path, file, A_TABLE)
        head = next(bounded, "")
        self._separator = max(",;\t", key=head.count)
        self._number = NumberCells(self._separator)
        self._reader = csv.reader(
            itertools.chain([head], bounded), delimiter=self._separator, strict=True
        )
        self._names = [name.strip() for name in next(self._reader, [])]
        self.has_frames = "frame" in self._names
        twice = [n for n in {*NEEDED, "frame", "blocked"} if self._names.count(n) > 1]
        missing = [name for name in NEEDED if name not in self._names]
        if missing or twice:
            found = f"no {', no '.join(missing)}" if missing else f"{twice[0]} twice"
            raise InputError(path, "columns", found, A_TABLE)

    def lines(self) -> Iterator[tuple[int, dict[str, str]]]:
        """Yield the number of each line of the frame, from 1, and its cells by column."""
        width = len(self._names)
        place = self._names.index("frame") if self.has_frames else None
        for cells in self._reader:
            # Fast path: most lines of a long table belong to other frames.
            plain = place is not None and len(cells) == width and len(cells[place]) < 10
            if place is not None and plain and cells[place].isdecimal():
                if int(cells[place]) == self._frame:
                    yield self._reader.line_num, self._by_column(cells)
                continue
            if len(self._problems) >= PROBLEMS_SHOWN:
                return
            line = self._reader.line_num
            if not any(map(str.strip, cells)):
                continue
            if len(cells) != width:
                hint = "; decimal commas need ; between the columns" * (self._separator == ",")
                self._refuse(line, "cells", len(cells), f"{width}, as in the first line{hint}")
                continue
            named = self._by_column(cells)
            wanted = "a number of a frame, from 0"
            if place is None or self._integer(line, "frame", named, 0, wanted) == self._frame:
                yield line, named

    def _by_column(self, cells: list[str]) -> dict[str, str]:
        return dict(zip(self._names, map(str.strip, cells), strict=True))

    def row(self, line: int, cells: dict[str, str]) -> _Row | None:
        """Parse a line; None if anything in it is wrong."""
        before = len(self._problems)
        u, v = (self._place(line, name, cells) for name in NEEDED[:2])
        expected = f"a whole number from 1 to {MOST}, or nothing for a dot in doubt"
        row, column = (
            self._integer(line, name, cells, 1, expected) if cells[name] else 0
            for name in NEEDED[2:]
        )
        blocked = {"": None, "0": False, "1": True}.get(cells.get("blocked", ""))
        if blocked is None and cells.get("blocked", ""):
            self._refuse(line, "blocked", cells["blocked"], "1, 0 or nothing")
        if blocked and row == 0:
            self._refuse(line, "blocked", "1", "a dot with a row, as rows are blocked")
        if len(self._problems) > before or u is None or v is None or row is None or column is None:
            return None
        return _Row(line, u, v, row, column, blocked)

    def _place(self, line: int, name: str, cells: dict[str, str]) -> float | None:
        value = self._number.parse(cells[name])
        if value is None or not -0.5 <= value <= self._bounds[name]:
            inside = f"a number from -0.5 to {self._bounds[name]:g} (px, within the frame)"
            self._refuse(line, name, cells[name], inside)
            return None
        return value

    def _integer(
        self, line: int, name: str, cells: dict[str, str], least: int, expected: str
    ) -> int | None:
        value = self._number.parse(cells[name])
        most = MOST if least else math.inf
        if value is None or value != math.floor(value) or not least <= value <= most:
            self._refuse(line, name, cells[name], expected)
            return None
        return int(value)

    def _refuse(self, line: int, name: str, value: object, expected: str) -> None:
        shown = value if value != "" else "nothing"
        self._problems.append(InputError(self._path, f"line {line}, {name}", shown, expected))


def _contradictions(path: Path, rows: list[_Row]) -> list[InputError]:
    """Return problems of valid lines that contradict each other."""
    problems = []
    sites: dict[tuple[int, int], int] = {}
    places: dict[tuple[float, float], int] = {}
    marks: dict[int, tuple[bool, int]] = {}
    for row in rows:
        site, place = (row.row, row.column), (row.u_px, row.v_px)
        if (line := places.setdefault(place, row.line)) != row.line:
            shown = f"{row.u_px:g}, {row.v_px:g}"
            other = f"another position than that of line {line}"
            problems.append(InputError(path, f"line {row.line}, u_px, v_px", shown, other))
        if min(site) > 0 and (line := sites.setdefault(site, row.line)) != row.line:
            shown = f"row {row.row}, column {row.column}"
            other = f"another row or column than that of line {line}"
            field = f"line {row.line}, reflected_row, reflected_column"
            problems.append(InputError(path, field, shown, other))
        if row.row and row.blocked is not None:
            blocked, line = marks.setdefault(row.row, (row.blocked, row.line))
            if blocked != row.blocked:
                same = f"{int(blocked)} as in line {line}, which is also in row {row.row}"
                field = f"line {row.line}, blocked"
                problems.append(InputError(path, field, int(row.blocked), same))
    return problems
