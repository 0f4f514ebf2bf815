"""The exception for wrong input: where it is, what it is, and what is expected instead."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager

MAX_SHOWN = 80
"""Characters of a wrong value that a message repeats."""


class InputError(Exception):
    """Something given to the program cannot be used, and this says what would be right.

    Parameters
    ----------
    source
        The file, folder or option it was found in.
    field
        The field, as the full dotted key (``laser.distance_mm``).
    value
        What was found there, as it is to be shown.
    expected
        What would be right, completing "expected …".
    others
        Further problems found in the same reading, reported together.
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
        own = f"{self.source}: {self.field}: {shown}; expected {self.expected}"
        return "\n".join([own, *map(str, self.others)])

    @property
    def problems(self) -> tuple[InputError, ...]:
        """This problem and the others, each on its own."""
        return (InputError(self.source, self.field, self.value, self.expected), *self.others)

    @classmethod
    def gather(cls, problems: list[InputError]) -> InputError:
        """One error that reports all of ``problems``; there is at least one."""
        first, *rest = problems
        return cls(first.source, first.field, first.value, first.expected, tuple(rest))


@contextmanager
def os_errors_as_input(path: str | os.PathLike[str], field: str, expected: str) -> Iterator[None]:
    """Raise an `OSError` of the block as an `InputError` about ``path``."""
    try:
        yield
    except OSError as error:
        raise InputError(path, field, error.strerror or error, expected) from error
