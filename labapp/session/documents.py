"""Documents of a session, with persistent undo and redo.

A document is a unit of the operator's input: the record, the set-up, the settings, a calibration,
entries for one, the correction of one frame, the weld's signals, the limits of the sizes. A change
sets some of them, and stores their former values, in one transaction.
"""

from __future__ import annotations

import sqlite3
from collections.abc import Callable, Collection, Mapping
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, Literal, Never, get_args

from labapp.core.pipeline import FrameCorrection, Settings
from labapp.errors import InputError
from labapp.run.limits import Limits
from labapp.session.file.blobs import Damaged, fingerprint_of, pack, unpack, unpack_from
from labapp.session.file.database import Database
from labapp.session.file.read_cache import ReadCache
from labapp.session.file.schema import NO_FRAME
from labapp.session.record import (
    BenchCheckRecord,
    BenchEntries,
    LaserEntries,
    LaserReadings,
    PlanePicture,
    Record,
)
from labapp.session.signals import Signals
from labapp.text import now

Kind = Literal[
    "record",
    "setup",
    "settings",
    "laser-entries",
    "laser-calibration",
    "plane-entries",
    "plane-calibration",
    "bench-entries",
    "bench-check",
    "correction",
    "signals",
    "limits",
]
Key = tuple[Kind, int]
"""Kind, and the frame of a correction; `NO_FRAME` for other documents."""

CLASSES: dict[str, Any] = {
    "record": Record,
    "setup": str,
    "settings": Settings,
    "laser-entries": LaserEntries,
    "laser-calibration": LaserReadings,
    "plane-entries": PlanePicture,
    "plane-calibration": PlanePicture,
    "bench-entries": BenchEntries,
    "bench-check": BenchCheckRecord,
    "correction": FrameCorrection,
    "signals": Signals,
    "limits": Limits,
}
"""Class of a document, by its kind."""

PICTURED: tuple[Kind, ...] = tuple(
    kind for kind in get_args(Kind) if kind.startswith(("laser", "plane", "bench"))
)
"""Kinds of documents that may have pictures."""

OnChange = Callable[[Collection[Key]], object]

MAX_CHANGES = 500
MAX_HISTORY_BYTES = 64_000_000
"""Limits of the history; the oldest changes are deleted."""


@dataclass(frozen=True)
class Change:
    """One step of the history."""

    number: int
    """Increases over the session's life."""
    label: str
    made: str
    """Time, ISO 8601."""
    undone: bool
    """Whether it was undone, and can be redone."""
    keys: tuple[Key, ...]
    """The changed documents."""


class Documents:
    """The documents of a session and their history.

    Parameters
    ----------
    on_change
        Called with the documents that a change, undo or redo has set, in the same transaction.
    """

    def __init__(self, database: Database, on_change: OnChange = lambda _: None) -> None:
        self._database = database
        self._on_change = on_change
        self._cache = ReadCache(database)
        self._values: dict[Kind, tuple[str, Any]] = {}

    def get(self, kind: Kind, frame: int = NO_FRAME) -> Any:
        """Return a document; None if there is none. Those of no frame are cached by content.

        Raises
        ------
        InputError
            If it is damaged.
        """
        if frame == NO_FRAME:
            sha256 = self.fingerprint(kind)
            cached = self._values.get(kind)
            if cached is not None and cached[0] == sha256:
                return cached[1]
        found = self._database.rows(
            "SELECT sha256, content FROM document WHERE kind = ? AND frame = ?", kind, frame
        )
        if not found:
            return None
        sha256, content = found[0]
        value = unpack_from(self._database.path, _named(kind, frame), content, CLASSES[kind])
        if frame == NO_FRAME:
            self._values[kind] = sha256, value
        return value

    def fingerprints(self, kind: Kind) -> dict[int, str]:
        """Return the SHA-256 of every document of a kind, by frame."""
        return dict(self._database.rows("SELECT frame, sha256 FROM document WHERE kind = ?", kind))

    def fingerprint(self, kind: Kind, frame: int = NO_FRAME) -> str | None:
        """Return the SHA-256 of a document; None if there is none."""

        def read() -> str | None:
            found: str | None = self._database.value(
                "SELECT sha256 FROM document WHERE kind = ? AND frame = ?", kind, frame
            )
            return found

        return read() if frame != NO_FRAME else self._cache.get((kind, "sha256"), read)

    def change(self, label: str, values: Mapping[Key, object]) -> bool:
        """Set documents in one change; None deletes one. Undone changes are discarded.

        Returns
        -------
        bool
            Whether anything differed; otherwise no change is stored.

        Raises
        ------
        InputError
            If it cannot be saved; then nothing has changed.
        """
        with self._database.transaction() as connection:
            parts = []
            for (kind, frame), value in values.items():
                if not isinstance(value, CLASSES[kind] | None):
                    right = getattr(CLASSES[kind], "__name__", "a correction of dots or of lines")
                    raise InputError(self._database.path, kind, repr(value), right)
                before = _content(connection, kind, frame)
                after = None if value is None else pack(value)
                if before != after:
                    parts.append((kind, frame, before, after))
                    _put(connection, kind, frame, after)
            if not parts:
                return False
            connection.execute("DELETE FROM change WHERE undone = 1")
            number = connection.execute(
                "INSERT INTO change (label, made) VALUES (?, ?)", (label, now())
            ).lastrowid
            connection.executemany(
                "INSERT INTO change_part VALUES (?, ?, ?, ?, ?)",
                [(number, *part) for part in parts],
            )
            _prune(connection)
            self._on_change([part[:2] for part in parts])
        self._cache.clear()
        return True

    def undo(self) -> Change | None:
        """Undo the last change and return it; None if there is none."""
        return self._step(undone=False, order="DESC", side="before")

    def redo(self) -> Change | None:
        """Redo the change that was undone last and return it; None if there is none."""
        return self._step(undone=True, order="ASC", side="after")

    def _step(self, *, undone: bool, order: str, side: str) -> Change | None:
        with self._database.transaction() as connection:
            found = connection.execute(
                f"SELECT id FROM change WHERE undone = ? ORDER BY id {order} LIMIT 1", (undone,)
            ).fetchone()
            if found is None:
                return None
            (number,) = found
            parts = connection.execute(
                f"SELECT kind, frame, {side} FROM change_part WHERE change = ?", (number,)
            ).fetchall()
            for kind, frame, content in parts:
                if content is not None:  # raises if damaged, and leaves it in the history
                    named = f"{_named(kind, frame)} in the history"
                    unpack_from(self._database.path, named, content, CLASSES.get(kind, Never))
                _put(connection, kind, frame, content)
            connection.execute("UPDATE change SET undone = ? WHERE id = ?", (not undone, number))
            self._on_change([part[:2] for part in parts])
        self._cache.clear()
        return next(change for change in self.history() if change.number == number)

    def history(self) -> tuple[Change, ...]:
        """Return the changes in the history, the oldest first."""
        found: tuple[Change, ...] = self._cache.get("history", self._read_history)
        return found

    def _read_history(self) -> tuple[Change, ...]:
        keys: dict[int, list[Key]] = {}
        for number, kind, frame in self._database.rows(
            "SELECT change, kind, frame FROM change_part ORDER BY change, kind, frame"
        ):
            keys.setdefault(number, []).append((kind, frame))
        return tuple(
            Change(number, str(label), str(made), bool(undone), tuple(keys.get(number, ())))
            for number, label, made, undone in self._database.rows(
                "SELECT id, label, made, undone FROM change ORDER BY id"
            )
        )

    def pictures(self) -> dict[str, str]:
        """Return the SHA-256 of the pictures of calibrations and bench check → kind."""
        found: dict[str, str] = {}
        for kind in PICTURED:
            with suppress(InputError):  # `problems` reports it
                document = self.get(kind)
                parts = getattr(document, "pictures", (document,))
                for one in (*parts, getattr(document, "cross", None)):
                    if sha256 := getattr(one, "picture_sha256", None):
                        found[sha256] = kind
                    found |= dict.fromkeys(getattr(one, "further_sha256", ()), kind)
        return found

    def problems(self) -> list[str]:
        """Return sentences about damaged documents and contradictions with the history."""
        found = []
        expected = {
            (kind, frame): content
            for kind, frame, content in self._database.rows(
                "SELECT kind, frame, after FROM change_part JOIN change ON change.id = change "
                "WHERE undone = 0 ORDER BY change"
            )
        } | {
            (kind, frame): content
            for kind, frame, content in self._database.rows(
                "SELECT kind, frame, before FROM change_part JOIN change ON change.id = change "
                "WHERE undone = 1 ORDER BY change DESC"
            )
        }
        stored = {
            (kind, frame): (sha256, content)
            for kind, frame, sha256, content in self._database.rows(
                "SELECT kind, frame, sha256, content FROM document"
            )
        }
        for (kind, frame), (sha256, content) in stored.items():
            named = _named(kind, frame)
            try:
                unpack(content, CLASSES.get(kind, Never))
                if fingerprint_of(content) != sha256:
                    found.append(f"{named} is not what was written")
            except Damaged as error:
                found.append(f"{named} is damaged: {error}")
        found += [
            f"{kind} ({frame}) is not what the history says"
            for (kind, frame), content in expected.items()
            if stored.get((kind, frame), (None, None))[1] != content
        ]
        checked = {content for _, content in stored.values()} | {None}
        for kind, frame, *contents in self._database.rows(
            "SELECT kind, frame, before, after FROM change_part"
        ):
            for content in {*contents} - checked:
                try:
                    unpack(content, CLASSES.get(kind, Never))
                except Damaged as error:
                    found.append(f"{_named(kind, frame)} in the history is damaged: {error}")
        return found


def _named(kind: str, frame: int) -> str:
    return kind if frame == NO_FRAME else f"{kind} of frame {frame}"


def _content(connection: sqlite3.Connection, kind: str, frame: int) -> bytes | None:
    found = connection.execute(
        "SELECT content FROM document WHERE kind = ? AND frame = ?", (kind, frame)
    ).fetchone()
    return None if found is None else found[0]


def _put(connection: sqlite3.Connection, kind: str, frame: int, content: bytes | None) -> None:
    if content is None:
        connection.execute("DELETE FROM document WHERE kind = ? AND frame = ?", (kind, frame))
    else:
        connection.execute(
            "INSERT OR REPLACE INTO document VALUES (?, ?, ?, ?)",
            (kind, frame, fingerprint_of(content), content),
        )


def _prune(connection: sqlite3.Connection) -> None:
    """Delete the oldest changes beyond the limits, but never the newest."""
    sizes = connection.execute(
        "SELECT change, sum(coalesce(length(before), 0) + coalesce(length(after), 0)) "
        "FROM change_part GROUP BY change ORDER BY change DESC"
    ).fetchall()
    total = 0
    for place, (number, size) in enumerate(sizes):
        total += size
        if place and (place >= MAX_CHANGES or total > MAX_HISTORY_BYTES):
            connection.execute("DELETE FROM change WHERE id <= ?", (number,))
            return
