"""What the operator says, and every change of it: undo, redo, saved with the session.

A document is one thing the operator decides: the record, the setup, the settings, a calibration,
the correction of one frame, the weld's current and voltage, the limits of its sizes. A change sets
some of them, in one transaction with what they were before.
"""

from __future__ import annotations

import datetime
import sqlite3
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from typing import Any, Literal, Never

from labapp.core.pipeline import Settings
from labapp.core.rows.correction import Correction
from labapp.run.limits import Limits
from labapp.session.file.blobs import Damaged, fingerprint_of, pack, unpack, unpack_from
from labapp.session.file.database import Database
from labapp.session.file.kept import Kept
from labapp.session.record import LaserReadings, PlanePicture, Record
from labapp.session.signals import Signals

Kind = Literal[
    "record",
    "setup",
    "settings",
    "laser-calibration",
    "plane-calibration",
    "correction",
    "signals",
    "limits",
]
Key = tuple[Kind, int]
"""Kind, and the frame of a correction; `WHOLE` for what belongs to no frame."""

WHOLE = -1

CLASSES: dict[str, type] = {
    "record": Record,
    "setup": str,
    "settings": Settings,
    "laser-calibration": LaserReadings,
    "plane-calibration": PlanePicture,
    "correction": Correction,
    "signals": Signals,
    "limits": Limits,
}
"""What a document of each kind is."""

Along = Callable[[Collection[Key]], object]

KEPT_CHANGES = 500
KEPT_BYTES = 64_000_000
"""The history is cut at the older end to stay within both."""


@dataclass(frozen=True)
class Change:
    """One step of the history.

    Parameters
    ----------
    number
        Counts up over the session's life.
    label
        What was done, in words.
    made
        When, ISO 8601.
    undone
        Whether it was taken back, and can be made again.
    keys
        The documents it set.
    """

    number: int
    label: str
    made: str
    undone: bool
    keys: tuple[Key, ...]


class Documents:
    """The documents of a session and their history.

    Parameters
    ----------
    database
        The session file.
    along
        What else belongs to a change, an undo or a redo: called with the documents it set, in the
        same transaction.
    """

    def __init__(self, database: Database, along: Along = lambda _: None) -> None:
        self._database = database
        self._along = along
        self._kept = Kept(database)

    def get(self, kind: Kind, frame: int = WHOLE) -> Any:
        """The document; None where there is none.

        Raises
        ------
        InputError
            If it is damaged.
        """
        if frame != WHOLE:
            return self._read(kind, frame)
        return self._kept.get(kind, lambda: self._read(kind, frame))

    def _read(self, kind: Kind, frame: int) -> Any:
        blob = self._database.value(
            "SELECT content FROM document WHERE kind = ? AND frame = ?", kind, frame
        )
        if blob is None:
            return None
        return unpack_from(self._database.path, _named(kind, frame), blob, CLASSES[kind])

    def fingerprints(self, kind: Kind) -> dict[int, str]:
        """SHA-256 of every document of a kind, by frame."""
        return dict(self._database.rows("SELECT frame, sha256 FROM document WHERE kind = ?", kind))

    def fingerprint(self, kind: Kind, frame: int = WHOLE) -> str | None:
        """SHA-256 of a document; None where there is none."""

        def read() -> str | None:
            found: str | None = self._database.value(
                "SELECT sha256 FROM document WHERE kind = ? AND frame = ?", kind, frame
            )
            return found

        return read() if frame != WHOLE else self._kept.get((kind, "sha256"), read)

    def change(self, label: str, values: Mapping[Key, object]) -> bool:
        """Set documents in one step; None takes one away. What was undone can no more be redone.

        Returns
        -------
        bool
            False if everything was so already: then there is no step.

        Raises
        ------
        InputError
            If it cannot be saved; then nothing has changed.
        """
        with self._database.transaction() as connection:
            parts = []
            for (kind, frame), value in values.items():
                before = _content(connection, kind, frame)
                after = None if value is None else pack(value)
                if before != after:
                    parts.append((kind, frame, before, after))
                    _put(connection, kind, frame, after)
            if not parts:
                return False
            connection.execute("DELETE FROM change WHERE undone = 1")
            made = datetime.datetime.now().astimezone().isoformat(timespec="seconds")
            number = connection.execute(
                "INSERT INTO change (label, made) VALUES (?, ?)", (label, made)
            ).lastrowid
            connection.executemany(
                "INSERT INTO change_part VALUES (?, ?, ?, ?, ?)",
                [(number, *part) for part in parts],
            )
            _cut(connection)
            self._along([part[:2] for part in parts])
        self._kept.forget()
        return True

    def undo(self) -> Change | None:
        """Take back the last change that stands; None if none is left."""
        return self._step(undone=False, order="DESC", side="before")

    def redo(self) -> Change | None:
        """Make the last change again that was taken back; None if there is none."""
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
                if content is not None:  # what is damaged is left in the history
                    named = f"{_named(kind, frame)} in the history"
                    unpack_from(self._database.path, named, content, CLASSES.get(kind, Never))
                _put(connection, kind, frame, content)
            connection.execute("UPDATE change SET undone = ? WHERE id = ?", (not undone, number))
            self._along([part[:2] for part in parts])
        self._kept.forget()
        return next(change for change in self.history() if change.number == number)

    def history(self) -> tuple[Change, ...]:
        """Every change that is kept, the oldest first."""
        found: tuple[Change, ...] = self._kept.get("history", self._read_history)
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

    def problems(self) -> list[str]:
        """Documents that are damaged, or are not what the history says; empty if all is well."""
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
        held = {
            (kind, frame): (sha256, content)
            for kind, frame, sha256, content in self._database.rows(
                "SELECT kind, frame, sha256, content FROM document"
            )
        }
        for (kind, frame), (sha256, content) in held.items():
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
            if held.get((kind, frame), (None, None))[1] != content
        ]
        return found


class KeptSignals:
    """The session's current and voltage: unpacking takes long, and is done once for each table.

    Parameters
    ----------
    documents
        Where they are.
    """

    def __init__(self, documents: Documents) -> None:
        self._documents = documents
        self._held: tuple[str | None, Signals | None] = (None, None)

    def get(self) -> Signals | None:
        """The signals; None where there are none. See `Documents.get`."""
        sha256 = self._documents.fingerprint("signals")
        if sha256 != self._held[0]:
            self._held = sha256, self._documents.get("signals")
        return self._held[1]


def _named(kind: str, frame: int) -> str:
    return kind if frame == WHOLE else f"{kind} of frame {frame}"


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


def _cut(connection: sqlite3.Connection) -> None:
    """Forget the oldest changes beyond what is kept; the newest always stays."""
    sizes = connection.execute(
        "SELECT change, sum(coalesce(length(before), 0) + coalesce(length(after), 0)) "
        "FROM change_part GROUP BY change ORDER BY change DESC"
    ).fetchall()
    total = 0
    for place, (number, size) in enumerate(sizes):
        total += size
        if place and (place >= KEPT_CHANGES or total > KEPT_BYTES):
            connection.execute("DELETE FROM change WHERE id <= ?", (number,))
            return
