"""The exception for invalid input: its source, field and value, and what is expected instead."""

from __future__ import annotations

import difflib
import math
import numbers
import os
from collections.abc import Iterable, Iterator
from contextlib import contextmanager

MAX_SHOWN = 80
"""Most characters of an invalid value that a message shows."""


def printable(text: str) -> str:
    """Return a line in which control characters, which a terminal would obey, are escaped."""
    return "".join(one if one.isprintable() else repr(one)[1:-1] for one in text)


def parser_words(error: Exception) -> str:
    """Return what a parser found wrong, without terms of Python."""
    if isinstance(error, RecursionError):
        return "is nested too deeply"
    return str(error) or "cannot be read"


class InputError(Exception):
    """Invalid input, with a description of valid input.

    Parameters
    ----------
    source
        The file, folder or option which has the invalid value.
    field
        The field, as the full dotted key (``laser.distance_mm``).
    value
        The invalid value, as it is to be shown.
    expected
        What is valid, completing "expected …".
    others
        Further problems of the same input, reported together.
    """

    def __init__(
        self,
        source: str | os.PathLike[str],
        field: str,
        value: object,
        expected: str,
        others: tuple[InputError, ...] = (),
    ) -> None:
        self.source = os.fspath(source)
        self.field = field
        self.value = value
        self.expected = expected
        self.others = others
        super().__init__(self.source, field, value, expected)

    def __str__(self) -> str:
        shown = str(self.value)
        if len(shown) > MAX_SHOWN:
            shown = shown[: MAX_SHOWN - 1] + "…"
        where = printable(f"{self.source}: {self.field}: {shown}")
        first = f"{where}; expected {self.expected}"
        return "\n".join([first, *map(str, self.others)])

    @property
    def problems(self) -> tuple[InputError, ...]:
        """This problem and the others, one error each."""
        return (InputError(self.source, self.field, self.value, self.expected), *self.others)

    @classmethod
    def gather(cls, problems: list[InputError]) -> InputError:
        """One error that reports several.

        Parameters
        ----------
        problems
            The errors, at least one.
        """
        first, *rest = problems
        return cls(first.source, first.field, first.value, first.expected, tuple(rest))


def unknown_name(
    source: str | os.PathLike[str], field: str, value: object, known: Iterable[str]
) -> InputError:
    """Return the error for an unknown name, which suggests the most similar known name."""
    names = list(known)
    similar = difflib.get_close_matches(str(value), names, 1)
    every = f"one of {', '.join(names)}"
    expected = f"{similar[0]} (the most similar name), or {every}" if similar else every
    return InputError(source, field, repr(value), expected)


def require(
    value: object, kinds: type | tuple[type, ...], source: str, field: str, expected: str
) -> None:
    """Raise `InputError` unless a value is an instance of the given types.

    A bool does not count as a number, nor a str as a sequence.
    """
    named = kinds if isinstance(kinds, tuple) else (kinds,)
    is_other = any(isinstance(value, kind) and kind not in named for kind in (bool, str))
    if is_other or not isinstance(value, kinds):
        given = f"{value!r} ({type(value).__name__})"
        raise InputError(source, field, given, expected)


def check_positive(value: object, source: str, field: str, unit: str) -> None:
    """Raise `InputError` unless a value is a finite number above 0."""
    right = f"a number above 0 ({unit})"
    require(value, (numbers.Real,), source, field, right)
    if not (isinstance(value, numbers.Real) and 0 < float(value) < math.inf):
        raise InputError(source, field, value, right)


PATH = (str, os.PathLike)
"""Types of path arguments."""


@contextmanager
def os_errors_as_input(path: str | os.PathLike[str], field: str, expected: str) -> Iterator[None]:
    """Convert an `OSError` raised in the block to an `InputError` about ``path``."""
    try:
        yield
    except OSError as error:
        raise InputError(path, field, error.strerror or error, expected) from error
