"""Text shared by the app, the command line, files and messages: counts, sizes, CSV cells."""

from __future__ import annotations

import csv
import math
from collections.abc import Iterable, Sequence
from datetime import datetime

SIGMA_OF = "noise, level and set-up"
"""Contributions to the ± of a pool's sizes."""

HEIGHT_SIGMA_OF = "noise and level only"
"""Contributions to the ± of single heights, and to that of sizes in older sessions."""

SETUP_WORDS = {
    "entered": "The set-up was entered by hand, not calibrated; usual uncertainties are assumed.",
    "calibrated": "Laser and imaging plane were calibrated, not checked against a known mirror.",
    "checked": "The set-up was checked against a known mirror.",
    "doubtful": "The set-up is doubtful: a value is unusual, or the recording contradicts it.",
}
"""Meaning of each `setup_status`, for the operator."""

SETUP_MARKS = {"entered": "○", "calibrated": "◐", "checked": "✓", "doubtful": "▲"}
"""Symbols before these words in the app."""


def setup_words(status: str, checked: str = "", doubt: str = "", was_checked: str = "") -> str:
    """Return the meaning of a `setup_status`; empty if there is none.

    Parameters
    ----------
    status
        The status.
    checked
        Date of the bench check, ISO 8601.
    doubt
        Reason for the doubt (`SetupVerdict.reason`).
    was_checked
        Date of a bench check after which the set-up was changed, ISO 8601.
    """
    words = SETUP_WORDS.get(status, "")
    if status == "checked" and checked:
        return f"{words[:-1]} on {checked[:10]}."
    if status == "doubtful" and doubt:
        return f"The set-up is doubtful: {doubt}."
    if was_checked and status in ("entered", "calibrated"):
        day = was_checked[:10]
        return f"The set-up was changed after the bench check of {day}: it counts as {status} only."
    return words


def marked_setup_words(status: str, words: str) -> str:
    """Return the words of a `setup_status` with its symbol; empty if there is none."""
    return f"{SETUP_MARKS[status]} {words}" if words else ""


def now() -> str:
    """Return the current time, ISO 8601 with the time zone, to the second."""
    return datetime.now().astimezone().isoformat(timespec="seconds")


def local_time(iso: str) -> str:
    """Return an ISO 8601 time as local date and time, to the minute: "2024-05-01 10:00".

    Another text, which a file of somebody else may contain, is returned as it is.
    """
    try:
        return f"{datetime.fromisoformat(iso).astimezone():%Y-%m-%d %H:%M}"
    except (ValueError, OverflowError, OSError):  # the latter two for years beyond the calendar
        return iso


def pluralize(count: int, noun: str) -> str:
    """Return count and noun, in the plural unless the count is 1: "1 frame", "2 frames"."""
    return f"{count} {noun}{'s' * (count != 1)}"


def capitalized(words: str) -> str:
    """Begin a text with a capital letter, unless it begins with the name of a file."""
    first, *_ = words.split(" ")
    return words if "." in first.rstrip(".") else words[:1].upper() + words[1:]


BYTES = ("bytes", "kB", "MB", "GB", "TB")


MINUS = "−"
"""Minus sign, as wide as a plus; a hyphen reads as a dash."""

NOTHING = "–"
"""Placeholder for a missing number."""


def plain(value: float, decimals: int) -> str:
    """A number with the given decimals (negative: rounded to tens, …), never a negative zero."""
    return f"{round(value, decimals):z.{max(decimals, 0)}f}".replace("-", MINUS)


def rounded(value: float | None, sigma: float | None, decimals: int = 3) -> tuple[str, str]:
    """Text of a value and of its σ: σ to two significant digits, the value to the same place.

    Parameters
    ----------
    value, sigma
        None or NaN if unknown.
    decimals
        Decimals of the value if σ is unknown or 0; the text of σ is empty then.
    """
    if value is None or not math.isfinite(value):
        return NOTHING, ""
    if sigma is None or not (math.isfinite(sigma) and sigma > 0):
        return plain(value, decimals), ""
    # Rounding may carry: 0.0996 to two digits is 0.10.
    place = 1 - math.floor(math.log10(float(f"{sigma:.1e}")))
    return plain(value, place), plain(sigma, place)


def with_sigma(value: float | None, sigma: float | None) -> str:
    """A value and its σ in one text: "5.003 ± 0.010", see `rounded`."""
    return " ± ".join(filter(None, rounded(value, sigma)))


def format_bytes(size: float) -> str:
    """Return a file size with a decimal unit: "512 bytes", "1.5 MB"."""
    value, unit = float(size), 0
    while value >= 1000 and unit < len(BYTES) - 1:
        value, unit = value / 1000, unit + 1
    return f"{value:.0f} {BYTES[unit]}" if unit == 0 else f"{value:.1f} {BYTES[unit]}"


_SIMPLE = {
    each.lower().replace("²", "2").replace("³", "3").replace("µ", "u"): each
    for each in "A bar cm Hz kA kg kHz kJ kPa kV kW l m mA min mm mm² mm³ ms ppm px s V W µm "
    "µs".split()
} | {"deg": "°", "c": "°C", "pct": "%", "percent": "%", "um_per_unit": "µm per mm or °"}

UNITS = _SIMPLE | {
    f"{ending}_{over}{per}": f"{unit}/{per}"
    for ending, unit in _SIMPLE.items()
    for per in ("mm", "cm", "m", "s", "min", "h")
    for over in ("", "per_")
}
"""Endings of the names of columns and conditions, and the units that they stand for.

Letters that name other things more often, as in ``plate_n`` or ``ray_k``, stand for none."""


def split_unit(name: str) -> tuple[str, str]:
    """Words and unit of a column or condition: ``travel_mm_s`` gives "travel" and "mm/s".

    The unit is empty where the name does not end in one of `UNITS`.
    """
    words = name.split("_")
    for count in (3, 2, 1):
        unit = UNITS.get("_".join(words[-count:]).lower())
        if unit is not None and len(words) > count:
            return " ".join(words[:-count]), unit
    return " ".join(words), ""


def column_heading(name: str) -> str:
    """A column's name above a table: ``height_mm`` is "height, mm", ``kept_to`` "kept to"."""
    return ", ".join(filter(None, split_unit(name)))


def axis_label(name: str) -> str:
    """A column's name along an axis: ``height_mm`` is "height (mm)"."""
    words, unit = split_unit(name)
    return f"{words} ({unit})" if unit else words


FORMULA = tuple("=+-@＝＋－＠\t\r\n")
"""Spreadsheets evaluate a cell that begins with one of these as a formula (CSV injection).

Some treat full-width signs alike.
"""


def as_cell(value: object) -> object:
    """Return a CSV cell: text that a spreadsheet would evaluate is escaped with a leading ``'``.

    Text that begins with ``'`` before such a character is escaped too, so that removing one ``'``
    restores the original of any escaped text. Numbers are unchanged.
    """
    if not isinstance(value, str) or not value.lstrip("'").startswith(FORMULA):
        return value
    try:
        float(value)
    except ValueError:
        return f"'{value}"
    return value


def number_cell(value: float) -> str:
    """Return a number with seven digits as a CSV cell; empty if it is NaN or infinite."""
    return f"{value:.7g}" if math.isfinite(value) else ""


def csv_text(rows: Iterable[Sequence[object]]) -> str:
    """Return rows as CSV text; text that a spreadsheet would evaluate is escaped (`as_cell`)."""
    return unescaped_csv_text([as_cell(cell) for cell in row] for row in rows)


def unescaped_csv_text(rows: Iterable[Sequence[object]]) -> str:
    """Return rows as CSV text without escaping, for rows of numbers or from a CSV file."""
    lines = _Lines()
    csv.writer(lines).writerows(rows)
    return "".join(lines)


class _Lines(list[str]):
    """Lines ending with a line feed; with csv's ``lineterminator`` a CR in a cell is not quoted."""

    def write(self, line: str) -> None:
        self.append(line.removesuffix("\r\n") + "\n")
