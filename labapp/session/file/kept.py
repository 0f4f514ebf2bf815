"""What was read from a session and is read again only when it may have changed."""

from __future__ import annotations

from collections.abc import Callable, Hashable
from typing import Any

from labapp.session.file.database import Database


class Kept:
    """Values by name: a window reads them all the time, and must not wait while results are saved.

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
        """The value of a name, read if it is not known."""
        if self._database.read_only:
            version = self._database.value("PRAGMA data_version")  # another program's changes
            if version != self._version:
                self._version = version
                self.forget()
        values = self._values
        if name not in values:
            # Forgotten meanwhile, it goes into values that nobody looks at any more.
            values[name] = read()
        return values[name]

    def forget(self) -> None:
        """Read everything anew: something was changed."""
        self._values = {}
