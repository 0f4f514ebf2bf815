"""The results of a session: what was measured, from what, and whether that still stands."""

from __future__ import annotations

import datetime
import functools
import sqlite3
from collections import OrderedDict
from collections.abc import Collection
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from labapp.config.setup import Setup, parse_setup
from labapp.core.pipeline import Measurement, Settings
from labapp.core.schemes import SCHEMES
from labapp.core.values import BoolArray, FloatArray, IntArray, freeze
from labapp.errors import InputError
from labapp.session.file.blobs import Damaged, fingerprint, pack, unpack
from labapp.session.file.database import Database
from labapp.session.file.schema import MEASURES
from labapp.version import VERSION

SETUP_CHANGED = "the rig or a calibration was changed"
SETTINGS_CHANGED = "the settings were changed"
CORRECTION_CHANGED = "the dots or rows were corrected"

ASIDE_BYTES = 64_000_000
"""So much of what frames gave with other dots and rows is kept in memory, for undo and redo."""


@dataclass(frozen=True)
class Basis:
    """What a frame is measured from, besides its image.

    Parameters
    ----------
    setup
        Rig and image calibration.
    settings
        Of every step, the scheme included.
    """

    setup: Setup
    settings: Settings

    @property
    def scheme(self) -> str:
        """Name that results are kept under; see `scheme_name`."""
        return scheme_name(self.settings)

    def fingerprints(self) -> tuple[str, str]:
        """SHA-256 of what the setup says (comments aside) and of the settings."""
        return _said_by(self.setup.text), fingerprint(self.settings)


@dataclass(frozen=True)
class Result:
    """What is kept of one frame by one scheme.

    Parameters
    ----------
    frame
        Its number in the recording.
    measurement
        What it gave.
    scheme
        Name of the scheme, as in `Basis.scheme`.
    version
        Of labapp, which measured it.
    measured
        When, ISO 8601.
    setup
        The setup it was measured with, TOML.
    settings
        The settings it was measured with.
    stale
        Why it no longer stands, a clause each; empty while it does.
    """

    frame: int
    measurement: Measurement
    scheme: str
    version: str
    measured: str
    setup: str
    settings: Settings
    stale: tuple[str, ...]


@dataclass(frozen=True)
class Overview:
    """All frames of a session at a glance; n frames.

    Parameters
    ----------
    frame
        Numbers in the recording, ascending, shape (n,).
    time_s
        Times, shape (n,), s; NaN where unknown.
    status
        Each frame's status; empty where it was not measured.
    corrected
        Which frames have a correction by hand, shape (n,).
    stale
        Which results no longer stand, shape (n,).
    measures
        Name → values, shape (n,), of `Measures`; NaN where there is none.
    """

    frame: IntArray
    time_s: FloatArray
    status: tuple[str, ...]
    corrected: BoolArray
    stale: BoolArray
    measures: dict[str, FloatArray]

    def __post_init__(self) -> None:
        freeze(self)


class _Row(NamedTuple):
    """A result as it is kept: what it was measured from, when, and the measurement, packed."""

    version: str
    setup: bytes
    settings: bytes
    correction: str | None
    measured: str
    content: bytes


class Results:
    """The results of a session.

    Parameters
    ----------
    database
        The session file.
    """

    def __init__(self, database: Database) -> None:
        self._database = database
        self._aside: OrderedDict[tuple[int, str, str | None], _Row] = OrderedDict()

    def put(
        self, frame: int, measurement: Measurement, basis: Basis, correction: str | None
    ) -> None:
        """Keep what a frame gave; what the same scheme gave before is replaced.

        What it gave with other dots and rows is put aside for `bring_back`. If that is what stands,
        as the correction was taken back meanwhile, it stays, and the new is put aside.

        Parameters
        ----------
        frame, measurement
            The frame's number and what it gave.
        basis
            What it was measured from.
        correction
            SHA-256 of the correction it was measured with; None without.

        Raises
        ------
        InputError
            If it cannot be saved; then nothing has changed.
        """
        setup, settings = pack(basis.setup.text), pack(basis.settings)
        key, made = (VERSION, setup, settings), (correction, _now())
        seal = fingerprint((frame, basis.scheme, *key, *made))
        content = pack((measurement, seal))
        row = _Row(*key, *made, content)
        with self._database.transaction() as connection:
            former = self._row(frame, basis.scheme)
            if former is not None and self._differ_by_correction(former, row):
                if former.correction == self._corrected(frame):
                    self._put_aside(frame, basis.scheme, row)
                    return
                self._put_aside(frame, basis.scheme, former)
            _replace(connection, frame, basis.scheme, row, measurement)

    def bring_back(self, changed: Collection[tuple[str, int]]) -> None:
        """Have frames whose correction was changed give what they gave before with the same.

        Parameters
        ----------
        changed
            Kind and frame of the documents that were set.
        """
        for kind, frame in changed:
            if kind == "correction":
                self._bring_back(frame)

    def _bring_back(self, frame: int) -> None:
        """Have a frame give what it gave with the dots and rows that it has now, if that is known.

        It is if it was measured since the session was opened, and set-up and settings are the same.
        """
        present = self._corrected(frame)
        for (scheme,) in self._database.rows("SELECT scheme FROM result WHERE frame = ?", frame):
            former, row = self._row(frame, scheme), self._aside.get((frame, scheme, present))
            if former is None or row is None or not self._differ_by_correction(former, row):
                continue
            try:
                measurement = _unsealed(row.content, (frame, scheme, *row[:-1]))
            except Damaged:
                continue
            self._put_aside(frame, scheme, former)
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
        """SHA-256 of a frame's correction; None without."""
        found: str | None = self._database.value(
            "SELECT sha256 FROM document WHERE kind = 'correction' AND frame = ?", frame
        )
        return found

    def _differ_by_correction(self, one: _Row, other: _Row) -> bool:
        """Whether two results were measured from the same, but for the correction."""
        try:
            one_inputs, other_inputs = (
                self._inputs(row.setup, row.settings).fingerprints() for row in (one, other)
            )
        except InputError:
            return False
        return one_inputs == other_inputs and one.correction != other.correction

    def _put_aside(self, frame: int, scheme: str, row: _Row) -> None:
        """Keep a result for `bring_back`; where there are many, the first goes."""
        key = frame, scheme, row.correction
        self._aside.pop(key, None)
        self._aside[key] = row
        size = sum(len(kept.content) for kept in self._aside.values())
        while size > ASIDE_BYTES:
            size -= len(self._aside.popitem(last=False)[1].content)

    def get(
        self, frame: int, scheme: str, basis: Basis | None, correction: str | None
    ) -> Result | None:
        """What a scheme gave for a frame; None if it was not measured.

        Parameters
        ----------
        frame, scheme
            Which result.
        basis, correction
            What it would be measured from now; no basis where the setup is not complete.

        Raises
        ------
        InputError
            If it is damaged.
        """
        row = self._row(frame, scheme)
        if row is None:
            return None
        path, named = self._database.path, f"result of frame {frame}"
        try:
            measurement = _unsealed(row.content, (frame, scheme, *row[:-1]))
        except Damaged as error:
            raise InputError(path, named, error, "what was written there") from error
        inputs = self._inputs(row.setup, row.settings)
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
        )

    def counts(self) -> dict[tuple[str, str], int]:
        """How many results there are: (scheme, version of labapp) → count."""
        rows = self._database.rows(
            "SELECT scheme, version, count(*) FROM result JOIN inputs ON inputs.id = result.inputs "
            "GROUP BY scheme, version ORDER BY scheme, version"
        )
        return {(scheme, version): count for scheme, version, count in rows}

    def problems(self) -> list[str]:
        """Results that are damaged; empty if all is well."""
        found = []
        for number, version, setup, settings in self._database.rows("SELECT * FROM inputs"):
            try:
                parse_setup(unpack(setup, str), self._database.path)
                unpack(settings, Settings)
            except (Damaged, InputError) as error:
                found.append(f"inputs {number} of version {version} are damaged: {error}")
        names = ", ".join(MEASURES)
        for result, frame, scheme, status, *sizes in self._database.rows(
            f"SELECT id, frame, scheme, status, {names} FROM result"
        ):
            named = f"result of frame {frame} ({scheme})"
            kept = self._database.rows(
                "SELECT frame, scheme, version, setup, settings, correction, measured, content "
                "FROM result JOIN inputs ON inputs.id = inputs "
                "LEFT JOIN detail ON result = result.id WHERE result.id = ?",
                result,
            )
            try:
                measurement = _unsealed(kept[0][-1], kept[0][:-1])
            except Damaged as error:
                found.append(f"{named} is damaged: {error}")
                continue
            held = [getattr(measurement.measures, name, None) for name in MEASURES]
            held = [None if size is None or np.isnan(size) else size for size in held]
            if (measurement.status, held) != (status, sizes):
                found.append(f"{named} is not what its frame gave")
        return found

    def outdated(self, basis: Basis | None) -> frozenset[int]:
        """Rows of `inputs` from which nothing would be measured now, whose results do not stand."""
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
    """Put a result in the place of the one that the frame has by the same scheme, if any."""
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


def _unsealed(content: object, kept_with: tuple[object, ...]) -> Measurement:
    """The measurement in a detail, which vouches for what stands beside it in the tables.

    Raises
    ------
    Damaged
        If it is, or if frame, scheme, version, set-up, settings, correction or time are others.
    """
    measurement: Measurement
    measurement, seal = unpack(content, tuple[Measurement, str])
    if seal != fingerprint(kept_with):
        raise Damaged("it is of another frame, or was measured from something else")
    return measurement


@functools.lru_cache(maxsize=64)
def _read_inputs(setup: bytes, settings: bytes) -> Basis:
    return Basis(parse_setup(unpack(setup, str), "setup"), unpack(settings, Settings))


@functools.lru_cache(maxsize=64)
def _said_by(text: str) -> str:
    """SHA-256 of what a setup says, comments aside."""
    setup = parse_setup(text, "setup")
    return fingerprint((setup.rig, setup.calibration))


def _differences(now: Basis | None, then: Basis) -> tuple[str, ...]:
    if now is None:
        return (SETUP_CHANGED,)
    # Results of another scheme than the chosen one stand by what else the settings say.
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
    """Name of the scheme; with its algorithm where it has several: ``irs-opa``."""
    several = SCHEMES[settings.scheme].algorithms
    return f"{settings.scheme}-{settings.algorithm}" if several else settings.scheme


def _now() -> str:
    return datetime.datetime.now().astimezone().isoformat(timespec="seconds")
