"""The results of a session: measurements, their inputs, and whether they are stale."""

from __future__ import annotations

import functools
import sqlite3
from collections import Counter, OrderedDict
from collections.abc import Collection
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from labapp.config.setup import Setup, parse_setup
from labapp.core.pipeline import Measurement, Settings
from labapp.core.recording.residual_check import DOUBTFUL, MOST, Residuals, judge_setup
from labapp.core.schemes import SCHEMES
from labapp.core.values import BoolArray, FloatArray, IntArray, ReadOnlyArrays
from labapp.errors import InputError
from labapp.session.file.blobs import Damaged, damage_as_input, fingerprint, pack, unpack
from labapp.session.file.database import INTACT_SESSION, Database
from labapp.session.file.schema import MEASURES
from labapp.session.results.setup_verdicts import SetupVerdicts, chosen_evenly
from labapp.text import now
from labapp.version import VERSION

SETUP_CHANGED = "the rig or a calibration was changed"
SETTINGS_CHANGED = "the settings were changed"
CORRECTION_CHANGED = "the dots or rows were corrected"

MAX_STASHED_BYTES = 64_000_000
"""Memory for results with former corrections, which undo and redo restore."""


@dataclass(frozen=True)
class Basis:
    """Inputs of a measurement besides the image."""

    setup: Setup
    """Rig and image calibration."""
    settings: Settings
    """Settings of every step, including the scheme."""

    @property
    def scheme(self) -> str:
        """Name of the scheme; see `scheme_name`."""
        return scheme_name(self.settings)

    def fingerprints(self) -> tuple[str, str]:
        """Return the SHA-256 of the set-up's values, without comments, and of the settings."""
        return _setup_fingerprint(self.setup.text), _settings_fingerprint(self.settings)


@dataclass(frozen=True)
class Result:
    """Stored result of a frame by a scheme."""

    frame: int
    """Frame number in the recording."""
    measurement: Measurement
    scheme: str
    """Name of the scheme, as in `Basis.scheme`."""
    version: str
    """Version of labapp that measured it."""
    measured: str
    """Time of the measurement, ISO 8601."""
    setup: str
    """Set-up of the measurement, TOML."""
    settings: Settings
    stale: tuple[str, ...]
    """Reasons why it is stale, one clause each; empty if it is not."""
    doubt: str = ""
    """Why the set-up of the measurement is doubtful; empty if it is not."""

    @property
    def parsed_setup(self) -> Setup:
        """Set-up of the measurement.

        Raises
        ------
        InputError
            If its text is damaged.
        """
        return _parsed(self.setup)


@dataclass(frozen=True)
class Overview(ReadOnlyArrays):
    """Status, staleness and measures of all frames of a session; n frames."""

    frame: IntArray
    """Numbers in the recording, ascending, shape (n,)."""
    time_s: FloatArray
    """Times, shape (n,), s; NaN if unknown."""
    status: tuple[str, ...]
    """Status of each frame; empty if it was not measured."""
    corrected: BoolArray
    """Which frames were corrected manually, shape (n,)."""
    stale: BoolArray
    """Which results are stale, shape (n,)."""
    measures: dict[str, FloatArray]
    """Name in `Measures` → values, shape (n,); NaN if unknown."""


class _Row(NamedTuple):
    """A stored result: inputs, time, and the packed measurement."""

    version: str
    setup: bytes
    settings: bytes
    correction: str | None
    measured: str
    content: bytes


class StoredResults:
    """The results of a session."""

    def __init__(self, database: Database) -> None:
        self._database = database
        self.verdicts = SetupVerdicts(database)
        self._stashed: OrderedDict[tuple[int, str, str | None], _Row] = OrderedDict()

    def put(
        self, frame: int, measurement: Measurement, basis: Basis, correction: str | None
    ) -> None:
        """Store a result; it replaces a former one of the same frame and scheme.

        A former result with another correction is stashed for `restore`. If its correction is the
        present one, because the new one was undone during the measurement, the former result is
        retained and the new one is stashed.

        Parameters
        ----------
        correction
            SHA-256 of the correction used; None without.

        Raises
        ------
        InputError
            If it cannot be saved; then nothing has changed.
        """
        setup, settings = pack(basis.setup.text), pack(basis.settings)
        key, origin = (VERSION, setup, settings), (correction, now())
        seal = fingerprint((frame, basis.scheme, *key, *origin))
        content = pack((measurement, seal))
        row = _Row(*key, *origin, content)
        with self._database.transaction() as connection:
            former = self._row(frame, basis.scheme)
            if former is not None and self._differ_by_correction(former, row):
                if former.correction == self._corrected(frame):
                    self._stash(frame, basis.scheme, row)
                    return
                self._stash(frame, basis.scheme, former)
            _replace(connection, frame, basis.scheme, row, measurement)

    def restore(self, changed: Collection[tuple[str, int]]) -> None:
        """Restore stashed results where a ``("correction", frame)`` was changed."""
        for kind, frame in changed:
            if kind == "correction":
                self._restore(frame)

    def _restore(self, frame: int) -> None:
        """Restore the result of a frame with its present correction, if it is stashed.

        Only results measured since the session was opened, with the same set-up and settings, are.
        """
        present = self._corrected(frame)
        for (scheme,) in self._database.rows("SELECT scheme FROM result WHERE frame = ?", frame):
            former, row = self._row(frame, scheme), self._stashed.get((frame, scheme, present))
            if former is None or row is None or not self._differ_by_correction(former, row):
                continue
            try:
                measurement = _verified(row.content, (frame, scheme, *row[:-1]))
            except Damaged:
                continue
            self._stash(frame, scheme, former)
            with self._database.transaction() as connection:
                _replace(connection, frame, scheme, row, measurement)

    def _row(self, frame: int, scheme: str) -> _Row | None:
        found = self._database.rows(
            "SELECT version, setup, settings, correction, measured, content "
            "FROM result JOIN inputs ON inputs.id = result.inputs "
            "JOIN detail ON detail.result = result.id WHERE frame = ? AND scheme = ?",
            frame,
            scheme,
        )
        return _Row(*found[0]) if found else None

    def _corrected(self, frame: int) -> str | None:
        """Return the SHA-256 of a frame's correction; None without."""
        found: str | None = self._database.value(
            "SELECT sha256 FROM document WHERE kind = 'correction' AND frame = ?", frame
        )
        return found

    def _differ_by_correction(self, one: _Row, other: _Row) -> bool:
        """Whether two results differ in the correction and in no other input."""
        try:
            one_inputs, other_inputs = (
                self._inputs(row.setup, row.settings).fingerprints() for row in (one, other)
            )
        except InputError:
            return False
        return one_inputs == other_inputs and one.correction != other.correction

    def _stash(self, frame: int, scheme: str, row: _Row) -> None:
        """Store a result for `restore`; beyond `MAX_STASHED_BYTES` the oldest are discarded."""
        key = frame, scheme, row.correction
        self._stashed.pop(key, None)
        self._stashed[key] = row
        size = sum(len(kept.content) for kept in self._stashed.values())
        while size > MAX_STASHED_BYTES:
            size -= len(self._stashed.popitem(last=False)[1].content)

    def get(
        self, frame: int, scheme: str, basis: Basis | None, correction: str | None
    ) -> Result | None:
        """Return the result of a frame by a scheme; None if it was not measured.

        Parameters
        ----------
        basis, correction
            Present inputs, for the check whether it is stale; basis None if the set-up is
            incomplete.

        Raises
        ------
        InputError
            If it is damaged.
        """
        row = self._row(frame, scheme)
        if row is None:
            if self._database.rows(
                "SELECT 1 FROM result WHERE frame = ? AND scheme = ?", frame, scheme
            ):
                named = f"result of frame {frame}"
                raise InputError(self._database.path, named, "incomplete", INTACT_SESSION)
            return None
        with damage_as_input(self._database.path, f"result of frame {frame}"):
            measurement = _verified(row.content, (frame, scheme, *row[:-1]))
        inputs = self._inputs(row.setup, row.settings)
        doubt = self.verdicts.doubt_of(row.setup)
        if doubt and measurement.setup_status:
            measurement = replace(measurement, setup_status=DOUBTFUL)
        outdated = _differences(basis, inputs)
        return Result(
            frame=frame,
            measurement=measurement,
            scheme=scheme,
            version=row.version,
            measured=row.measured,
            setup=inputs.setup.text,
            settings=inputs.settings,
            stale=(*outdated, *((CORRECTION_CHANGED,) if row.correction != correction else ())),
            doubt=doubt,
        )

    def judge_setup(self, basis: Basis) -> None:
        """Check a set-up by all its current results, and store the verdict.

        Raises
        ------
        InputError
            If the verdict cannot be saved.
        """
        given = VERSION, pack(basis.setup.text), pack(basis.settings)
        rows = self._database.rows(
            "SELECT frame, status FROM result JOIN inputs ON inputs.id = inputs "
            "WHERE version = ? AND setup = ? AND settings = ? AND correction IS (SELECT sha256 "
            "FROM document WHERE kind = 'correction' AND document.frame = result.frame) "
            "ORDER BY frame",
            *given,
        )
        samples = []
        for frame in chosen_evenly([frame for frame, status in rows if status == "ok"]):
            row = self._row(frame, basis.scheme)
            if row is None:  # damaged
                continue
            residuals = _residuals(row.content, (frame, basis.scheme, *row[:-1]))
            samples += [residuals] if residuals else []
        statuses = Counter(status for _, status in rows)
        self.verdicts.put(given, judge_setup(basis.setup.rig, statuses, samples))

    def counts(self) -> dict[tuple[str, str], int]:
        """Return the number of results: (scheme, version of labapp) → count."""
        rows = self._database.rows(
            "SELECT scheme, version, count(*) FROM result JOIN inputs ON inputs.id = result.inputs "
            "GROUP BY scheme, version ORDER BY scheme, version"
        )
        if wrong := [name for row in rows for name in row[:2] if not isinstance(name, str)]:
            raise InputError(self._database.path, "results", f"{wrong[0]!r}", INTACT_SESSION)
        return {(scheme, version): count for scheme, version, count in rows}

    def problems(self) -> list[str]:
        """Return sentences about damaged results; empty if there are none."""
        found = []
        for number, version, setup, settings in self._database.rows(
            "SELECT id, version, setup, settings FROM inputs"
        ):
            try:
                parse_setup(unpack(setup, str), self._database.path, lines=True)
                unpack(settings, Settings)
            except (Damaged, InputError) as error:
                found.append(f"inputs {number} of version {version} are damaged: {error}")
        found += self.verdicts.problems()
        names = ", ".join(MEASURES)
        for result, frame, scheme, status, *sizes in self._database.rows(
            f"SELECT id, frame, scheme, status, {names} FROM result"
        ):
            named = f"result of frame {frame} ({scheme})"
            stored = self._database.rows(
                "SELECT frame, scheme, version, setup, settings, correction, measured, content "
                "FROM result JOIN inputs ON inputs.id = inputs "
                "LEFT JOIN detail ON result = result.id WHERE result.id = ?",
                result,
            )
            try:
                measurement = _verified(stored[0][-1], stored[0][:-1])
            except Damaged as error:
                found.append(f"{named} is damaged: {error}")
                continue
            expected = [getattr(measurement.measures, name, None) for name in MEASURES]
            expected = [None if size is None or np.isnan(size) else size for size in expected]
            if (measurement.status, expected) != (status, sizes):
                found.append(f"{named} differs from its measurement")
        return found

    def outdated(self, basis: Basis | None) -> frozenset[int]:
        """Return the rows of `inputs` that differ from the present ones, with stale results."""
        found = set()
        for number, setup, settings in self._database.rows(
            "SELECT id, setup, settings FROM inputs"
        ):
            try:
                if _differences(basis, self._inputs(setup, settings)):
                    found.add(number)
            except InputError:
                found.add(number)
        return frozenset(found)

    def _inputs(self, setup: bytes, settings: bytes) -> Basis:
        try:
            return _read_inputs(setup, settings)
        except (Damaged, InputError) as error:
            raise InputError(
                self._database.path, "inputs", error, "what was written there"
            ) from error


def _replace(
    connection: sqlite3.Connection, frame: int, scheme: str, row: _Row, measurement: Measurement
) -> None:
    """Insert a result, and delete an earlier one of the same frame and scheme."""
    key = row.version, row.setup, row.settings
    connection.execute(
        "INSERT OR IGNORE INTO inputs (version, setup, settings) VALUES (?, ?, ?)", key
    )
    (inputs,) = connection.execute(
        "SELECT id FROM inputs WHERE version = ? AND setup = ? AND settings = ?", key
    ).fetchone()
    connection.execute("DELETE FROM result WHERE frame = ? AND scheme = ?", (frame, scheme))
    result = connection.execute(
        "INSERT INTO result (frame, scheme, inputs, correction, measured, status, "
        f"correspondence, {', '.join(MEASURES)}) "
        f"VALUES ({', '.join('?' * (7 + len(MEASURES)))})",
        (
            *(frame, scheme, inputs, row.correction, row.measured, measurement.status),
            None if measurement.match is None else measurement.match.orientation,
            *(getattr(measurement.measures, name, None) for name in MEASURES),
        ),
    ).lastrowid
    connection.execute("INSERT INTO detail VALUES (?, ?)", (result, row.content))
    connection.execute(
        "DELETE FROM inputs WHERE NOT EXISTS (SELECT 1 FROM result WHERE result.inputs = inputs.id)"
    )


def _verified(content: object, columns: tuple[object, ...]) -> Measurement:
    """Return the measurement of a detail after verifying its seal against the other columns.

    Raises
    ------
    Damaged
        If it is damaged, or frame, scheme, version, set-up, settings, correction or time differ.
    """
    measurement: Measurement
    measurement, seal = unpack(content, tuple[Measurement, str])
    if seal != fingerprint(columns):
        raise Damaged("it belongs to another frame or other inputs")
    return measurement


@functools.lru_cache(maxsize=2 * MOST)
def _residuals(content: bytes, columns: tuple[object, ...]) -> Residuals | None:
    """Return the residuals of a detail (`_verified`); None if it has none, or is damaged."""
    try:
        return Residuals.of(_verified(content, columns))
    except Damaged:
        return None


@functools.lru_cache(maxsize=64)
def _read_inputs(setup: bytes, settings: bytes) -> Basis:
    return Basis(_parsed(unpack(setup, str)), unpack(settings, Settings))


@functools.lru_cache(maxsize=64)
def _parsed(setup: str) -> Setup:
    return parse_setup(setup, "setup", lines=True)


@functools.lru_cache(maxsize=64)
def _setup_fingerprint(text: str) -> str:
    """Return the SHA-256 of a set-up's values, without comments."""
    setup = _parsed(text)
    return fingerprint((setup.rig, setup.calibration))


@functools.lru_cache(maxsize=64)
def _settings_fingerprint(settings: Settings) -> str:
    return fingerprint(settings)


def _differences(now: Basis | None, then: Basis) -> tuple[str, ...]:
    if now is None:
        return (SETUP_CHANGED,)
    # For results of other schemes, ignore which scheme is chosen.
    chosen = replace(now.settings, scheme=then.settings.scheme, algorithm=then.settings.algorithm)
    setup, settings = Basis(now.setup, chosen).fingerprints()
    before = then.fingerprints()
    return tuple(
        reason
        for reason, changed in (
            (SETUP_CHANGED, setup != before[0]),
            (SETTINGS_CHANGED, settings != before[1]),
        )
        if changed
    )


def scheme_name(settings: Settings) -> str:
    """Return the name of the scheme, with the algorithm if it has several: ``irs-opa``."""
    algorithm = SCHEMES[settings.scheme].algorithm(settings.algorithm)
    return f"{settings.scheme}-{algorithm}" if algorithm else settings.scheme
