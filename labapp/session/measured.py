"""The results of a session: what was measured, from what, and whether that still stands."""

from __future__ import annotations

import datetime
import functools
from dataclasses import dataclass, replace

import numpy as np

import labapp
from labapp.core.pipeline import Measurement, Settings
from labapp.core.values import BoolArray, FloatArray, IntArray, freeze
from labapp.errors import InputError
from labapp.session.blobs import Damaged, fingerprint, pack, unpack
from labapp.session.database import Database
from labapp.session.schema import MEASURES
from labapp.session.setup import Setup, parse_setup

SETUP_CHANGED = "the rig or a calibration was changed"
SETTINGS_CHANGED = "the settings were changed"
CORRECTION_CHANGED = "the dots or rows were corrected"


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


class Results:
    """The results of a session.

    Parameters
    ----------
    database
        The session file.
    """

    def __init__(self, database: Database) -> None:
        self._database = database

    def put(
        self, frame: int, measurement: Measurement, basis: Basis, correction: str | None
    ) -> None:
        """Keep what a frame gave; what the same scheme gave before is replaced.

        All of it but the surfaces one σ away (`Reconstruction.variants`): they are five times the
        rest, and what they are for, the ± of points and sizes, is kept.

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
        reconstruction = measurement.reconstruction
        if reconstruction is not None:
            reconstruction = replace(reconstruction, variants=())
        key, made = (labapp.__version__, setup, settings), (correction, _now())
        seal = fingerprint((frame, basis.scheme, *key, *made))
        content = pack((replace(measurement, reconstruction=reconstruction), seal))
        sizes = [getattr(measurement.measures, name, None) for name in MEASURES]
        with self._database.transaction() as connection:
            connection.execute(
                "INSERT OR IGNORE INTO inputs (version, setup, settings) VALUES (?, ?, ?)", key
            )
            (inputs,) = connection.execute(
                "SELECT id FROM inputs WHERE version = ? AND setup = ? AND settings = ?", key
            ).fetchone()
            connection.execute(
                "DELETE FROM result WHERE frame = ? AND scheme = ?", (frame, basis.scheme)
            )
            result = connection.execute(
                "INSERT INTO result (frame, scheme, inputs, correction, measured, status, "
                f"correspondence, {', '.join(MEASURES)}) "
                f"VALUES ({', '.join('?' * (7 + len(MEASURES)))})",
                (
                    *(frame, basis.scheme, inputs, *made, measurement.status),
                    None if measurement.match is None else measurement.match.orientation,
                    *sizes,
                ),
            ).lastrowid
            connection.execute("INSERT INTO detail VALUES (?, ?)", (result, content))
            connection.execute(
                "DELETE FROM inputs WHERE NOT EXISTS "
                "(SELECT 1 FROM result WHERE result.inputs = inputs.id)"
            )

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
        found = self._database.rows(
            "SELECT version, setup, settings, correction, measured, content "
            "FROM result JOIN inputs ON inputs.id = result.inputs "
            "JOIN detail ON detail.result = result.id WHERE frame = ? AND scheme = ?",
            frame,
            scheme,
        )
        if not found:
            return None
        version, setup, settings, corrected, measured, content = found[0]
        path, named = self._database.path, f"result of frame {frame}"
        try:
            measurement = _unsealed(content, (frame, scheme, *found[0][:-1]))
        except Damaged as error:
            raise InputError(path, named, error, "what was written there") from error
        inputs = self._inputs(setup, settings)
        outdated = _differences(basis, inputs)
        return Result(
            frame=frame,
            measurement=measurement,
            scheme=scheme,
            version=version,
            measured=measured,
            setup=inputs.setup.text,
            settings=inputs.settings,
            stale=(*outdated, *((CORRECTION_CHANGED,) if corrected != correction else ())),
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
    """``fit``, ``ers``, or ``irs-`` with its algorithm."""
    return f"irs-{settings.algorithm}" if settings.scheme == "irs" else settings.scheme


def _now() -> str:
    return datetime.datetime.now().astimezone().isoformat(timespec="seconds")
