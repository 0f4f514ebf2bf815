"""Words that the window, the command line, files and messages have alike."""

from __future__ import annotations

SIGMA_OF = "noise and level only"
"""What the ± of a measured pool hold: not that the set-up may be off."""


def several(count: int, thing: str) -> str:
    """A number of things: "1 frame", "2 frames"."""
    return f"{count} {thing}{'s' * (count != 1)}"


UNITS = ("bytes", "kB", "MB", "GB", "TB")


def size_in_words(size: int) -> str:
    """A file's size."""
    value, unit = float(size), 0
    while value >= 1000 and unit < len(UNITS) - 1:
        value, unit = value / 1000, unit + 1
    return f"{value:.0f} {UNITS[unit]}" if unit == 0 else f"{value:.1f} {UNITS[unit]}"


FORMULA = tuple("=+-@＝＋－＠\t\r\n")
"""A cell that begins so is a formula to a spreadsheet, which runs it; text may be anybody's.

Signs of full width are the same to some.
"""


def as_cell(value: object) -> object:
    """A value as a cell of CSV: text that a spreadsheet would run gets ``'`` before it.

    So does text in which only further ``'`` stand before such a beginning: one taken away from any
    text that begins so gives it back. Numbers stay as they are.
    """
    if not isinstance(value, str) or not value.lstrip("'").startswith(FORMULA):
        return value
    try:
        float(value)
    except ValueError:
        return f"'{value}"
    return value
