"""Overviews of all frames of a session, updated incrementally."""

from __future__ import annotations

import threading
from collections.abc import Collection
from dataclasses import dataclass, field

import numpy as np

from labapp.core.values import FloatArray, IntArray
from labapp.session.file.database import Database
from labapp.session.file.schema import MEASURES
from labapp.session.results.measured import Basis, Overview, StoredResults

MANY = 500
"""Number of changed frames from which all are read, which takes no longer."""

ALL_FRAMES = -2

WATCHING = (
    "CREATE TEMP TABLE touched (frame INTEGER)",
    *(
        f"CREATE TEMP TRIGGER touched_{table}_{what.lower()} AFTER {what} ON main.{table} "
        f"BEGIN INSERT INTO touched VALUES ({frame}); END"
        for table, whole in (("result", None), ("document", None), ("frame", ALL_FRAMES))
        for what, row in (("INSERT", "NEW"), ("UPDATE", "NEW"), ("DELETE", "OLD"))
        for frame in (whole or f"{row}.frame",)
    ),
)
"""Triggers that record in memory the frames of each change, including undo and redo."""

QUERY = (
    "SELECT number, time_s, inputs, correction, status, sha256, "
    f"{', '.join(MEASURES)} FROM frame "
    "LEFT JOIN result ON result.frame = number AND scheme = ? "
    "LEFT JOIN document ON document.frame = number AND kind = 'correction'"
)


@dataclass
class _Table:
    """Results of a scheme as last read, one row per frame."""

    number: IntArray
    time_s: FloatArray
    inputs: IntArray
    """Number and time of the frame; row of `inputs` of its result, 0 without one; shape (n,)."""
    used: np.ndarray[tuple[int], np.dtype[np.object_]]
    present: np.ndarray[tuple[int], np.dtype[np.object_]]
    """SHA-256 of the correction of the result, and of the present one; None without."""
    status: np.ndarray[tuple[int], np.dtype[np.object_]]
    sizes: FloatArray
    """Status and measures of the result, shape (n,) and (n, number of measures)."""
    due: set[int] = field(default_factory=set)
    """Frames that have changed since."""
    seen: tuple[Collection[int], Overview] | None = None
    """The last overview, with the outdated rows of `inputs`."""


class Overviews:
    """The overviews of a session, one per scheme; thread-safe."""

    def __init__(self, database: Database, results: StoredResults) -> None:
        self._database = database
        self._results = results
        self._mutex = threading.Lock()
        self._tables: dict[str, _Table] = {}
        self._version: int | None = None
        for statement in WATCHING:
            database.rows(statement)

    def get(self, scheme: str, basis: Basis | None) -> Overview:
        """Return the overview of a scheme; the same object if nothing has changed.

        Parameters
        ----------
        basis
            Present inputs; None if the set-up is incomplete.

        Raises
        ------
        InputError
            If the session is damaged.
        """
        with self._mutex:
            try:
                self._note_changes()
                table = self._tables.get(scheme)
                if table is None or len(table.due) > MANY:
                    table = self._tables[scheme] = self._read(scheme)
                elif table.due:
                    self._update(table, scheme)
                outdated = self._results.outdated(basis)
            except BaseException:
                self._tables.clear()  # the changed frames are no longer known
                raise
            if table.seen is None or table.seen[0] != outdated:
                table.seen = outdated, _overview(table, outdated)
            return table.seen[1]

    def _note_changes(self) -> None:
        version = self._database.value("PRAGMA data_version")  # changed by other programs
        touched = {frame for (frame,) in self._database.rows("DELETE FROM touched RETURNING frame")}
        if version != self._version or ALL_FRAMES in touched:
            self._tables.clear()
        self._version = version
        for table in self._tables.values():
            table.due |= touched

    def _read(self, scheme: str) -> _Table:
        rows = self._database.rows(f"{QUERY} ORDER BY number", scheme)
        array = self._database.array
        columns = list(zip(*rows, strict=True)) or [()] * (6 + len(MEASURES))
        number, time_s, inputs, used, status, present, *sizes = columns
        return _Table(
            number=array(number, np.int64),
            time_s=array(time_s, np.float64),
            inputs=array([k or 0 for k in inputs], np.int64),
            used=_objects(used),
            present=_objects(present),
            status=_objects([str(word or "") for word in status]),
            sizes=array(sizes, np.float64).reshape(len(MEASURES), -1).T,
        )

    def _update(self, table: _Table, scheme: str) -> None:
        """Update the rows of the changed frames."""
        array = self._database.array
        for frame in table.due:
            for row in self._database.rows(f"{QUERY} WHERE number = ?", scheme, frame):
                place = int(np.searchsorted(table.number, frame))
                table.time_s[place : place + 1] = array(row[1:2], np.float64)
                table.inputs[place : place + 1] = array([row[2] or 0], np.int64)
                table.used[place], table.present[place] = row[3], row[5]
                table.status[place] = str(row[4] or "")
                table.sizes[place] = array(row[6:], np.float64)
        table.due.clear()
        table.seen = None


def _objects(values: Collection[object]) -> np.ndarray[tuple[int], np.dtype[np.object_]]:
    found = np.empty(len(values), dtype=object)
    found[:] = values
    return found


def _overview(table: _Table, outdated: Collection[int]) -> Overview:
    current = ~np.isin(table.inputs, list(outdated)) & (table.used == table.present)
    return Overview(
        frame=table.number.copy(),
        time_s=table.time_s.copy(),
        status=tuple(table.status.tolist()),
        corrected=np.asarray(table.present != np.array(None), bool),
        stale=(table.inputs > 0) & ~current.astype(bool),
        measures=dict(zip(MEASURES, table.sizes.T.copy(), strict=True)),
    )
