"""Numbers for display: with units and only the significant digits. Without Qt."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from labapp.text import MINUS, NOTHING, csv_text, plain, rounded

EXTRA_DECIMALS = 3
"""Largest number of additional decimals that a field shows because they were entered."""


@dataclass(frozen=True)
class ResultRow:
    """One line of a result table."""

    name: str
    value: float | str | None
    """A number or text; None or NaN if there is none."""
    sigma: float | None = None
    """Its standard uncertainty; None if there is none."""
    unit: str = ""
    """"mm", "°", "px/mm" …"""
    decimals: int = 3
    """Decimals to show if σ is unknown."""
    note: str = ""
    """Further explanation, shown as a tooltip."""

    @property
    def texts(self) -> tuple[str, str, str, str]:
        """Displayed name, value, ± and unit."""
        if isinstance(self.value, str):
            return self.name, self.value, "", self.unit
        value, sigma = rounded(self.value, self.sigma, self.decimals)
        return self.name, value, sigma, self.unit


def entered(value: float, decimals: int) -> str:
    """A number in a field: with the field's decimals, or a few more if more were entered."""
    whole = np.format_float_positional(value, trim="-")
    more = len(whole.partition(".")[2])
    return plain(value, more if decimals < more <= decimals + EXTRA_DECIMALS else decimals)


def parsed(entry: str) -> float | None:
    """The entered number, with a decimal point or comma; None if it is not a finite number."""
    if "_" in entry:  # Python would read 1_0 as 10
        return None
    try:
        value = float(entry.strip().replace(MINUS, "-").replace(",", "."))
    except ValueError:
        return None
    return value if math.isfinite(value) else None


def with_thousands(entry: str) -> float | None:
    """The entered number if its comma separates thousands, as in 1,250; None if it cannot."""
    grouped = re.fullmatch(r"([-+−]?\d{1,3}),(\d{3})(e.*)?", entry.strip(), re.IGNORECASE)
    if grouped is None or not parsed(grouped[1]):  # no one writes 0,250 for 250
        return None
    return parsed("".join(filter(None, grouped.groups())))


def as_csv(rows: Iterable[ResultRow]) -> str:
    """Result rows as comma-separated values at full precision, for a program."""
    cells = ((row.name, row.value, row.sigma, row.unit) for row in rows)
    return csv_text([("quantity", "value", "sigma", "unit"), *cells])


def round_factor(most: float) -> float:
    """The largest 1, 2 or 5 times a power of ten that does not exceed ``most`` (positive)."""
    power: float = 10.0 ** math.floor(math.log10(most))
    # log10 may round up to the next power.
    return max((step * power for step in (1.0, 2.0, 5.0) if step * power <= most), default=power)


def cell_text(cell: str | float | None) -> str:
    """Text of a table cell: a float has three significant digits, and all before the point."""
    if cell is None or (isinstance(cell, float) and not math.isfinite(cell)):
        return NOTHING
    if isinstance(cell, float):
        place = 2 - math.floor(math.log10(abs(cell))) if cell else 0
        return plain(cell, max(0, place))
    return str(cell)
