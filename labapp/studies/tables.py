"""Tables of a simulation's results, as CSV and as Markdown."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Self

from labapp.text import csv_text

Cell = str | int | float | None


@dataclass(frozen=True)
class Table:
    """A table that a command prints and writes."""

    name: str
    """Name of its file, without the ending."""
    caption: str
    """One line with the content of the table and the corresponding table or figure of the text."""
    columns: tuple[str, ...]
    """Names of the columns, including units."""
    rows: tuple[tuple[Cell, ...], ...]
    """Cells; None or NaN if a value is unknown."""

    @classmethod
    def of(cls, name: str, caption: str, rows: Iterable[Mapping[str, Cell]]) -> Self:
        """Table of rows, at least one, that each have the same columns: name → cell."""
        first, *others = rows
        cells = (tuple(row[column] for column in first) for row in (first, *others))
        return cls(name, caption, tuple(first), tuple(cells))

    def csv(self) -> str:
        """CSV with a header row; an unknown value is an empty cell."""
        return csv_text([self.columns, *([_text(cell, 6) for cell in row] for row in self.rows)])

    def markdown(self) -> str:
        """The caption in bold, and the table with aligned columns."""
        cells = [list(self.columns), *([_text(cell, 3) for cell in row] for row in self.rows)]
        widths = [max(3, *map(len, column)) for column in zip(*cells, strict=True)]
        cells.insert(1, ["-" * width for width in widths])
        lines = [
            " | ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True))
            for row in cells
        ]
        return f"**{self.caption}**\n\n" + "".join(f"| {line} |\n" for line in lines)


def _text(cell: Cell, digits: int) -> str:
    if cell is None or (isinstance(cell, float) and math.isnan(cell)):
        return ""
    return f"{cell:.{digits}g}" if isinstance(cell, float) else str(cell)
