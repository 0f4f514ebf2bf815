"""Cache of values read from a session file."""

from __future__ import annotations

from collections.abc import Callable, Hashable
from typing import Any

from labapp.session.file.database import Database


class ReadCache:
    """Values by name: a window reads them often, and must not wait while results are saved.

    Parameters
    ----------
    database
        Where they are from. This program alone writes to it, unless it is open read-only.
    """

    def __init__(self, database: Database) -> None:
        self._database = database
        self._values: dict[Hashable, Any] = {}
        self._version: object = None

    def get(self, name: Hashable, read: Callable[[], Any]) -> Any:
        """Cached value of a name; on a miss, ``read()``."""
        if self._database.read_only:
            version = self._database.value("PRAGMA data_version")  # another program's changes
            if version != self._version:
                self._version = version
                self.clear()
        values = self._values
        if name not in values:
            # Cleared meanwhile, it goes into a dict that nobody reads any more.
            values[name] = read()
        return values[name]

    def clear(self) -> None:
        """Discard every value, as after a change."""
        self._values = {}
