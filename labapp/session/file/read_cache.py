"""Cache of values read from a session file."""

from __future__ import annotations

from collections.abc import Callable, Hashable
from typing import Any

from labapp.session.file.database import Database


class ReadCache:
    """Cached values, so that the app need not wait for the database while results are saved.

    Parameters
    ----------
    database
        Source of the values. Only this program writes to it, unless it is open read-only.
    """

    def __init__(self, database: Database) -> None:
        self._database = database
        self._values: dict[Hashable, Any] = {}
        self._version: object = None

    def get(self, name: Hashable, read: Callable[[], Any]) -> Any:
        """Return the cached value of a name; on a miss, that of ``read()``."""
        if self._database.read_only:
            version = self._database.value("PRAGMA data_version")  # changed by other programs
            if version != self._version:
                self._version = version
                self.clear()
        values = self._values
        if name not in values:
            # If `clear` is called during the read, the value goes into a discarded dict.
            values[name] = read()
        return values[name]

    def clear(self) -> None:
        """Discard all values, after a change."""
        self._values = {}
