"""Reading and validation of TOML files: rules for keys, and the problems of a table."""

from __future__ import annotations

import difflib
import json
import re
import tomllib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeGuard

import numpy as np

from labapp.errors import InputError, parser_words
from labapp.files import read_limited

LARGEST_MM = 10_000.0
"""Lengths above this are taken for an error in the unit."""

LARGEST_TEXT = 1 << 24
"""Largest TOML file, bytes."""

LARGEST = 1e9
"""Upper limit of numbers of any kind."""

SMALLEST = 1e-6
"""Lower limit of numbers that must be above 0."""


def read_text(path: Path, wanted: str) -> str:
    """Read a UTF-8 text file; ``wanted`` is the expected content, for the error.

    Raises
    ------
    InputError
        If the file cannot be read, is larger than `LARGEST_TEXT` or is not text.
    """
    try:
        return read_limited(path, LARGEST_TEXT, wanted).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(path, "encoding", "not UTF-8", wanted) from error


def parse_toml(text: str, path: Path, wanted: str) -> dict[str, Any]:
    """Parse the text of a file that was read from ``path``.

    Raises
    ------
    InputError
        If the text is not TOML.
    """
    try:
        return tomllib.loads(text)
    except (ValueError, RecursionError) as error:  # ValueError: too many digits, too
        raise InputError(path, "syntax", *_syntax(text, error, wanted)) from error


def _syntax(text: str, error: Exception, wanted: str) -> tuple[str, str]:
    """The line of a syntax error and what was expected."""
    place = _PLACE.search(str(error))
    lines = text.splitlines()
    if place is None or not 0 < int(place[1]) <= len(lines):
        return parser_words(error), wanted
    line = lines[int(place[1]) - 1].strip()
    shown_line = f"line {place[1]} is “{line}”" if line else f"line {place[1]} is empty"
    if number := _DECIMAL_COMMA.search(line):
        return shown_line, f"a decimal point: {number[1]}.{number[2]}"
    key, equals, value = (part.strip() for part in line.partition("="))
    if equals and key and not value:
        return shown_line, f"a value after {key} ="
    if equals and value[0].isalpha() and value not in ("true", "false", "nan", "inf"):
        return shown_line, f'a number, or text in quotation marks: {key} = "{value}"'
    if equals and (unit := _WITH_UNIT.fullmatch(value)):
        return shown_line, f"the number without its unit: {key} = {unit[1]}"
    return f"{shown_line} ({_PLACE.sub('', str(error)).strip()})", wanted


_PLACE = re.compile(r"\(at line (\d+), column \d+\)")
_DECIMAL_COMMA = re.compile(r"=\s*([+-]?\d+),(\d+)\s*(?:#.*)?$")
_WITH_UNIT = re.compile(r"([+-]?\d+(?:\.\d+)?)\s*(?:mm|cm|m|in|px|deg|°|\")\s*(?:#.*)?")


@dataclass(frozen=True)
class Rule:
    """Rule for the value of a key."""

    expected: str
    """The permitted values, as a phrase that completes "expected …"."""
    accepts: Callable[[object], bool]
    """Function that tells whether a TOML value is permitted."""
    required: bool = True
    """Whether the key is required."""


def is_number(value: object) -> TypeGuard[float]:
    """Whether this is a finite number (true, false, nan and inf are not)."""
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) < LARGEST


def are_numbers(value: object, count: int) -> TypeGuard[list[float]]:
    """Whether this is a list of finite numbers of the given length."""
    return isinstance(value, list) and len(value) == count and all(map(is_number, value))


def is_matrix(value: object) -> bool:
    """Whether this is a list of 3 rows of 3 numbers that can be inverted."""
    return (
        isinstance(value, list)
        and len(value) == 3
        and all(are_numbers(row, 3) for row in value)
        and bool(np.linalg.cond(np.array(value, float)) < 1e12)
    )


def between(low: float, high: float, unit: str, required: bool = True) -> Rule:
    """A number above ``low`` and below ``high``."""
    return Rule(
        f"a number above {low:g} and below {high:g} ({unit})",
        lambda value: is_number(value) and (low or SMALLEST) < value < high,
        required,
    )


def within(low: float, high: float, unit: str, required: bool = False) -> Rule:
    """A number from ``low`` to ``high``."""
    return Rule(
        f"a number from {low:g} to {high:g}{f' ({unit})' if unit else ''}",
        lambda value: is_number(value) and low <= value <= high,
        required,
    )


def whole(low: int, high: int, required: bool = False) -> Rule:
    """A whole number from ``low`` to ``high``."""
    return Rule(
        f"a whole number from {low} to {high}",
        lambda value: type(value) is int and low <= value <= high,
        required,
    )


def one_of(*words: str, required: bool = False) -> Rule:
    """One of some words."""
    return Rule(" or ".join(f'"{word}"' for word in words), lambda v: v in words, required)


def check_keys(
    path: Path, table: str, keys: object, rules: Mapping[str, Rule], form: str = ""
) -> list[InputError]:
    """Problems of one table: unknown, missing and invalid keys.

    Parameters
    ----------
    table
        Full name of the table.
    keys
        Value found, a table or not; None if there is none.
    rules
        Key → rule for its value.
    form
        Notation of the table; ``[table]`` by default.
    """
    if not isinstance(keys, dict):
        needed = ", ".join(key for key, rule in rules.items() if rule.required)
        found = "missing" if keys is None else shown(keys)
        expected = f"a table {form or f'[{table}]'}{f' with {needed}' if needed else ''}"
        return [InputError(path, table, found, expected)]
    problems = []
    for key, value in keys.items():
        full = f"{table}.{key}"
        if key not in rules:
            problems.append(unknown_key(path, full, rules))
        elif not rules[key].accepts(value):
            problems.append(InputError(path, full, shown(value), rules[key].expected))
    problems += [
        InputError(path, f"{table}.{key}", "missing", rule.expected)
        for key, rule in rules.items()
        if rule.required and key not in keys
    ]
    return problems


def unknown_key(path: Path, full: str, known: Mapping[str, object]) -> InputError:
    """Error for an unknown key or table, with the most similar known one."""
    near = difflib.get_close_matches(full.rpartition(".")[2], known, 1)
    expected = f"{near[0]}, the most similar key" if near else f"one of {', '.join(known)}"
    return InputError(path, full, "unknown key", expected)


def shown(value: object) -> str:
    """A value in TOML notation."""
    try:
        text = json.dumps(value, default=str, ensure_ascii=False)
    except (ValueError, RecursionError):
        return "a number with thousands of digits or a list nested too deeply"
    return text.replace("NaN", "nan").replace("Infinity", "inf")
