"""Expected content of every session file, recorded from the changes that sessions acknowledged.

A change counts as soon as the session's call returns. The files are read with SQLite alone.
"""

from __future__ import annotations

import sqlite3
import tomllib
from collections.abc import Callable, Iterator, Mapping
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any
from unittest import mock

from labapp.session.documents import Documents
from labapp.session.file.blobs import pack, unpack
from labapp.session.frames import Frames
from labapp.session.results.measured import StoredResults

Key = tuple[str, int]
Values = dict[Key, bytes | None]


class ExpectedContent:
    """Expected content of a session file: its documents, and the values for undo and redo.

    Parameters
    ----------
    path
        The file before its first change.
    """

    def __init__(self, path: Path) -> None:
        self.documents = dict(_documents(path))
        self.results: dict[tuple[int, str], set[str]] = {}
        self.first_results = _results(path)
        self.recording: bytes | None = None
        self.done: list[tuple[Values, Values]] = []
        self.undone: list[tuple[Values, Values]] = []
        sides: dict[int, tuple[bool, Values, Values]] = {}
        for number, undone, kind, frame, before, after in _rows(
            path,
            "SELECT id, undone, kind, frame, before, after FROM change "
            "JOIN change_part ON change = id ORDER BY id",
        ):
            _, old, new = sides.setdefault(number, (bool(undone), {}, {}))
            old[kind, frame], new[kind, frame] = before, after
        for was_undone, old, new in sides.values():
            (self.undone if was_undone else self.done).append((old, new))
        self.undone.reverse()

    def change(self, values: Mapping[Key, object]) -> None:
        """Set documents."""
        after = {key: None if value is None else pack(value) for key, value in values.items()}
        after = {key: blob for key, blob in after.items() if blob != self.documents.get(key)}
        if after:
            self.done.append(({key: self.documents.get(key) for key in after}, after))
            self.undone.clear()
            self._put(after)

    def step(self, back: bool) -> None:
        """Undo, or redo."""
        source, target = (self.done, self.undone) if back else (self.undone, self.done)
        if source:
            old, new = source.pop()
            target.append((old, new))
            self._put(old if back else new)

    def _put(self, values: Values) -> None:
        for key, blob in values.items():
            if blob is None:
                self.documents.pop(key, None)
            else:
                self.documents[key] = blob


class Witness:
    """Records the changes that sessions acknowledge while it is `listening`.

    Attributes
    ----------
    changes
        Number of changes.
    expected
        Expected content by path.
    """

    def __init__(self) -> None:
        self.changes = 0
        self.expected: dict[Path, ExpectedContent] = {}

    @contextmanager
    def listening(self) -> Iterator[None]:
        """Record every change of every session in this process."""
        with (
            self._after(
                Documents, "change", lambda expected, _, __, values: expected.change(values)
            ),
            self._after(Documents, "undo", lambda expected, *_: expected.step(back=True)),
            self._after(Documents, "redo", lambda expected, *_: expected.step(back=False)),
            self._after(Frames, "import_recording", self._imported),
            self._after(StoredResults, "put", self._measured),
        ):
            yield

    def register(self, path: Path) -> None:
        """Record the content of a file before its first change."""
        if path not in self.expected:
            self.expected[path] = ExpectedContent(path)

    def differences(self) -> list[str]:
        """Differences between the files and their expected content, one per line."""
        lines = []
        for path, expected in self.expected.items():
            stored = _documents(path)
            for key in sorted(stored.keys() | expected.documents.keys()):
                if stored.get(key) != expected.documents.get(key):
                    lines.append(f"{path.name}: {key} is not as it was acknowledged")
            results = dict(_results(path))
            for (frame, scheme), statuses in expected.results.items():
                if results.get((frame, scheme)) not in statuses:
                    lines.append(f"{path.name}: the {scheme} result of frame {frame} is lost")
            if expected.recording is not None and _recording(path) != expected.recording:
                lines.append(f"{path.name}: the recording is not the one that was imported")
        return lines

    def value(self, path: Path, key: str) -> object:
        """The stored value of a set-up entry (``section.key``) or of a record entry (a name)."""
        section, _, name = key.partition(".")
        blob = _documents(path).get(("setup" if name else "record", -1))
        if blob is None:
            return None
        if name:
            return tomllib.loads(unpack(blob)).get(section, {}).get(name)
        return getattr(unpack(blob), section)

    def _after(self, owner: type, name: str, note: Callable[..., object]) -> Any:
        original = getattr(owner, name)

        def wrapped(this: Any, *args: Any, **kwargs: Any) -> Any:
            path = this._database.path
            self.register(path)
            result = original(this, *args, **kwargs)
            note(self.expected[path], result, *args)
            self.changes += 1
            return result

        return mock.patch.object(owner, name, wrapped)

    def _imported(self, expected: ExpectedContent, recording: object, *_: object) -> None:
        expected.recording = pack(recording)

    def _measured(
        self,
        expected: ExpectedContent,
        _: object,
        frame: int,
        measurement: Any,
        basis: Any,
        *__: Any,
    ) -> None:
        # Undo and redo restore earlier statuses.
        key = frame, basis.scheme
        first = {expected.first_results[key]} if key in expected.first_results else set()
        expected.results.setdefault(key, first).add(measurement.status)


def _rows(path: Path, sql: str) -> list[tuple[Any, ...]]:
    with closing(sqlite3.connect(f"{path.as_uri()}?mode=ro", uri=True)) as connection:
        return connection.execute(sql).fetchall()


def _documents(path: Path) -> dict[Key, bytes]:
    rows = _rows(path, "SELECT kind, frame, content FROM document")
    return {(kind, frame): content for kind, frame, content in rows}


def _results(path: Path) -> dict[tuple[int, str], str]:
    rows = _rows(path, "SELECT frame, scheme, status FROM result")
    return {(frame, scheme): status for frame, scheme, status in rows}


def _recording(path: Path) -> bytes | None:
    rows = _rows(path, "SELECT content FROM recording")
    return rows[0][0] if rows else None
