"""Requirements that hold for any damaged file; `Broken` is raised where one does not."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import io
import json
import random
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from labapp import cli
from labapp.cli.session.info import _facts, _text
from labapp.config.setup import read_setup, update_setup
from labapp.core.pipeline import Measurement, Settings
from labapp.core.rows.correction import Correction
from labapp.core.values import CannotMeasure
from labapp.errors import InputError
from labapp.export.folder import verify_export
from labapp.export.frame_result import FrameResult
from labapp.export.results import surface_files
from labapp.export.tables import csv_rows, frame_tables
from labapp.media import open_source
from labapp.session.corrections.csv_file import read_correction
from labapp.session.file.blobs import fingerprint
from labapp.session.file.schema import MEASURES
from labapp.session.record import Record
from labapp.session.session import Session
from tests.fuzz.damage import damage_session, damaged_bytes, damaged_text
from tests.fuzz.originals import (
    SETUP,
    SHAPE,
    Originals,
    dots_of,
    keep,
    lattice_of,
    measurement_of,
)

SCHEMES = ("fit", "ers")
ENTRIES = "laser_entries", "plane_entries", "bench_entries"
UNREPORTED = "differs, and problems() is silent"


class Broken(AssertionError):
    """A requirement does not hold."""


@dataclasses.dataclass
class Tally:
    """Number of calls that succeeded or were rejected with a damaged file."""

    used: int = 0
    refused: int = 0

    def attempt(self, call: Callable[[], Any]) -> Any:
        """Return the result of a call, or None if it raised an `InputError` with a message."""
        try:
            result = call()
        except InputError as error:
            self.refused += 1
            if not str(error).strip() or not error.expected:
                raise Broken(f"an error that says nothing: {error!r}") from error
            return None
        self.used += 1
        return result


@contextlib.contextmanager
def unchanged(folder: Path) -> Iterator[None]:
    """Check that no file in a folder is changed, added or removed."""
    before = _contents(folder)
    yield
    after = _contents(folder)
    for name in sorted(before.keys() | after.keys()):
        if before.get(name) != after.get(name):
            what = "new" if name not in before else "gone" if name not in after else "changed"
            raise Broken(f"{name} is {what}")


def _contents(folder: Path) -> dict[str, bytes]:
    return {
        path.relative_to(folder).as_posix(): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file() and not (path.name.startswith(".") and path.name.endswith(".lock"))
    }


# --- sessions ---------------------------------------------------------------------------------


def facts(session: Session) -> dict[tuple[Any, ...], Any]:
    """Return every value that a session shows, by its kind; rejected ones are omitted."""
    shown: dict[tuple[Any, ...], Any] = {}

    def note(key: tuple[Any, ...], call: Callable[[], Any]) -> Any:
        with contextlib.suppress(InputError):
            shown[key] = call()
        return shown.get(key)

    for name in (
        *("record", "setup_text", "settings"),
        *("laser_calibration", "plane_calibration", "bench_check"),
        *ENTRIES,
    ):
        note((name,), functools.partial(_fingerprint_of, session, name))
    numbers = note(("frames",), functools.partial(_numbers, session))
    for frame in numbers or ():
        note(("correction", frame), lambda frame=frame: fingerprint(session.correction(frame)))
        note(("frame", frame), lambda frame=frame: fingerprint(session.frame(frame).image))
        for scheme in SCHEMES:
            result = note(
                ("result", frame, scheme),
                lambda frame=frame, scheme=scheme: session.result(frame, scheme),
            )
            if result is not None:
                shown["result", frame, scheme] = (
                    fingerprint(result.measurement.measures),
                    result.measurement.status,
                    fingerprint(result.measurement),
                    *(result.setup, fingerprint(result.settings), result.version, result.stale),
                )
    for scheme in SCHEMES:
        overview = note(("overview", scheme), lambda scheme=scheme: session.overview(scheme))
        if overview is None:
            continue
        del shown["overview", scheme]
        for k, frame in enumerate(overview.frame.tolist()):
            sizes = {name: float(values[k]) for name, values in overview.measures.items()}
            shown["measures", frame, scheme] = repr(sizes)
            shown["glance", frame, scheme] = (overview.status[k], bool(overview.stale[k]))
            shown["time", frame] = repr(float(overview.time_s[k]))
    return shown


def _numbers(session: Session) -> list[int]:
    return [int(number) for number in session.frames]


def _fingerprint_of(session: Session, name: str) -> str:
    return fingerprint(getattr(session, name))


UNMEASURED = repr(dict.fromkeys(MEASURES, float("nan")))
NOTHING = {fingerprint(None), fingerprint(""), fingerprint(Record()), fingerprint(Settings())}


def unreported(before: dict[Any, Any], after: dict[Any, Any], *, forged: bool) -> list[str]:
    """Return values that differ from those of the undamaged file; missing ones do not count."""
    differences = []
    for key, value in after.items():
        known = before.get(key)
        kind = key[0]
        if kind == "frames" or value is None or value in NOTHING or value == known:
            continue
        if kind == "glance" and value[0] == "":
            continue
        if kind == "measures" and value == UNMEASURED:
            continue
        if forged and kind == "result" and known is not None and value[:2] == known[:2]:
            continue
        if forged and kind in ("glance", "frame"):
            continue
        differences.append(f"{key}: {_difference(value, known)}")
    return differences


def _difference(value: Any, known: Any) -> str:
    if isinstance(value, tuple) and isinstance(known, tuple):
        parts = zip(value, known, strict=True)
        return ", ".join(f"{a!r:.90} instead of {b!r:.90}" for a, b in parts if a != b)
    return f"{value!r:.200} instead of {known!r:.200}"


def look(session: Session, tally: Tally) -> None:
    """Read everything a window shows of a session."""
    attempt = tally.attempt
    for name in (
        *("record", "setup_text", "setup", "settings", "laser_calibration", "plane_calibration"),
        *("bench_check", "recording", "missing_recording", "history", "measured_by", "frames"),
        *ENTRIES,
    ):
        attempt(functools.partial(getattr, session, name))
    attempt(lambda: "\n".join(_text(_facts(session))))
    attempt(lambda: json.dumps(_facts(session)))
    for name in ("plane_calibration", *ENTRIES):
        stored = attempt(functools.partial(getattr, session, name))
        for one in getattr(stored, "pictures", (stored,) * (stored is not None)):
            attempt(functools.partial(session.picture, one.picture_sha256))
    setup = attempt(lambda: session.setup)
    attempt(session.stale_frames)
    numbers = attempt(functools.partial(_numbers, session)) or []
    for frame in [*numbers[:8], 0, 99]:
        attempt(functools.partial(session.frame, frame))
        correction = attempt(lambda frame=frame: session.correction(frame))
        if correction is not None:
            correction.sited.sum() + len(correction.dots.image_px)
        for scheme in SCHEMES:
            result = attempt(lambda f=frame, scheme=scheme: session.result(f, scheme))
            if result is not None:
                _show(frame, result.measurement, None if setup is None else setup.calibration)


def _show(frame: int, measurement: Measurement, calibration: Any) -> None:
    if calibration is not None:
        for name, table in frame_tables(FrameResult(frame, None, measurement), calibration).items():
            csv_rows(name, table)
    if measurement.reconstruction is not None:
        with contextlib.suppress(InputError, CannotMeasure):
            surface_files(frame, measurement.reconstruction, {"csv", "stl"}, 0.5)


def change(session: Session, tally: Tally, rng: random.Random) -> None:
    """Do what an operator might do with a session."""
    attempt = tally.attempt
    correction = Correction(dots_of(2), lattice_of(), np.ones(12, bool))
    steps: list[Callable[[], Any]] = [
        session.undo,
        session.undo,
        session.redo,
        lambda: session.set_record(Record(notes="changed")),
        lambda: session.update_setup({"laser": {"distance_mm": 33.0}}),
        lambda: session.set_setup(SETUP.read_text("utf-8")),
        lambda: session.set_settings(dataclasses.replace(session.settings, scheme="ers")),
        lambda: session.correct({0: correction, 1: None}),
        lambda: session.calibrate_laser([13.676], [18.561], [7.874]),
        lambda: session.set_entries("plane", session.plane_calibration),
        lambda: keep(session, 4, measurement_of(4), "fit"),
        lambda: session.relink(session.path.with_name("recording.npy")),
    ]
    rng.shuffle(steps)
    for step in [*steps, session.undo, session.redo, *[session.undo] * 4]:
        attempt(step)
    attempt(lambda: session.history)


def try_session(folder: Path, known: dict[Any, Any], rng: random.Random) -> Tally:
    """Damage the session in a folder, open it read-only and writable, and use it."""
    tally = Tally()
    (path,) = folder.glob("*.labsession")
    damage = damage_session(path, rng)
    forged = damage == "blob"
    with unchanged(folder):
        session = tally.attempt(lambda: Session.open(path, read_only=True))
        if session is not None:
            with session:
                look(session, tally)
                problems = tally.attempt(session.problems)
                if problems == []:
                    _check_unreported(known, facts(session), forged=forged)
                _check_read_only(session)
    with contextlib.ExitStack() as stack:
        journal = Path(f"{path}-journal").exists()
        before = _contents(folder)
        session = tally.attempt(lambda: Session.open(path))
        if session is None:
            if not journal and _contents(folder) != before:
                raise Broken("it was not opened, and is changed")
            return tally
        stack.enter_context(session)
        problems = tally.attempt(session.problems)
        change(session, tally, rng)
        if problems == [] and tally.attempt(session.problems) == []:
            # Results may have become stale by the changes; numbers and frames must not differ.
            after = {
                k: v for k, v in facts(session).items() if k[0] in ("measures", "frame", "time")
            }
            after.pop(("measures", 4, "fit"), None)  # measured in `change`
            _check_unreported(known, after, forged=forged)
    extra = [name for name in _contents(folder) if name not in before]
    if [name for name in extra if not name.endswith("-journal")]:
        raise Broken(f"left beside it: {extra}")
    return tally


def _check_unreported(known: dict[Any, Any], now: dict[Any, Any], *, forged: bool) -> None:
    if differing := unreported(known, now, forged=forged):
        raise Broken(f"{UNREPORTED}: {'; '.join(differing[:3])}")


def _check_read_only(session: Session) -> None:
    try:
        session.set_record(Record(notes="never"))
    except InputError:
        return
    raise Broken("a read-only session was changed")


# --- other files ------------------------------------------------------------------------------


def try_setup(folder: Path, path: Path, rng: random.Random) -> Tally:
    tally = Tally()
    path.write_bytes(damaged_text(path.read_bytes(), rng))
    session_path = folder / "new.labsession"
    with Session.create(session_path) as session, unchanged(folder / "setup"):
        setup = tally.attempt(lambda: read_setup(path))
        if setup is not None:
            pixels = np.array([[0.0, 0.0], [100.0, 50.0]])
            setup.calibration.to_plane(pixels)
        text = path.read_bytes().decode("utf-8-sig", "replace")
        if tally.attempt(lambda: session.set_setup(text) or True):
            tally.attempt(lambda: session.setup)
            tally.attempt(lambda: session.update_setup({"laser": {"distance_mm": 33.0}}))
            tally.attempt(lambda: session.setup)
    before = path.read_bytes()
    values = {"laser": {"distance_mm": 33.0}, "pattern": {"absent": None}, "electrode": {}}
    refused = not tally.attempt(lambda: update_setup(path, values) or True)
    if refused and path.read_bytes() != before:
        raise Broken("the setup was refused, and is changed")
    return tally


def try_recording(folder: Path, path: Path, rng: random.Random) -> Tally:
    tally = Tally()
    target = path
    if path.is_dir() or path.suffix in (".cih", ".cihx"):
        files = sorted((path if path.is_dir() else path.parent).iterdir())
        target = rng.choice(files)
    target.write_bytes(damaged_bytes(target.read_bytes(), rng, rng.choice([64, 300, 2000])))
    # In a separate folder, so that files beside the recording do not belong to the session.
    session_path = folder / "new.labsession"
    with unchanged(path if path.is_dir() else path.parent):
        source = tally.attempt(lambda: open_source(path))
        if source is not None:
            with source:
                for k in {0, len(source) // 2, len(source) - 1}:
                    frame = tally.attempt(lambda k=k: source.frame(k))
                    if frame is not None and frame.image.shape != source.shape:
                        raise Broken(f"frame {k} is {frame.image.shape}, not {source.shape}")
        with Session.create(session_path) as session:
            embed = rng.random() < 0.5
            entry = tally.attempt(lambda: session.import_recording(path, embed=embed))
            if entry is None:
                if session.recording is not None or len(session.frames):
                    raise Broken("it was not imported, and is there")
            else:
                for k in session.frames[:5].tolist():
                    tally.attempt(lambda k=k: session.frame(k))
                session.overview()
        if entry is not None:
            with Session.open(session_path, read_only=True) as session:
                for k in session.frames[:3].tolist():
                    tally.attempt(lambda k=k: session.frame(k))
    return tally


def try_table(folder: Path, path: Path, rng: random.Random) -> Tally:
    tally = Tally()
    path.write_bytes(damaged_text(path.read_bytes(), rng))
    before = Correction(dots_of(1), lattice_of(), np.zeros(12, bool))
    with unchanged(folder):
        correction = tally.attempt(lambda: read_correction(path, 1, SHAPE, before))
        if correction is not None and not np.isfinite(correction.dots.image_px).all():
            raise Broken("a dot is nowhere")
    return tally


def try_manifest(folder: Path, path: Path, rng: random.Random) -> Tally:
    tally = Tally()
    if rng.random() < 0.8:
        path.write_bytes(damaged_text(path.read_bytes(), rng))
    else:
        other = rng.choice(sorted(path.parent.iterdir()))
        other.write_bytes(damaged_bytes(other.read_bytes(), rng))
    with unchanged(folder):
        problems = tally.attempt(lambda: verify_export(path.parent))
        if problems is not None and not all(isinstance(each, str) for each in problems):
            raise Broken(f"what is no sentence: {problems}")
    return tally


# --- the command line ---------------------------------------------------------------------------


def try_command_line(folder: Path, path: Path, originals: Originals, rng: random.Random) -> Tally:
    """Run the commands a user would try on a damaged file."""
    tally = Tally()
    if path.suffix == ".labsession":
        damage_session(path, rng)
        commands = [["session", "info", path], ["session", "info", "--json", "--history", path]]
        commands += [["session", "verify", path], ["session", "measure", path]]
    elif path.suffix == ".toml":
        path.write_bytes(damaged_text(path.read_bytes(), rng))
        recording = originals.recordings[0]
        commands = [["reconstruct", recording, "--setup", path, "--frames", "0"]]
        commands[0] += ["--out", folder / "out"]
    else:
        path.write_bytes(damaged_bytes(path.read_bytes(), rng, 300))
        commands = [["reconstruct", path, "--setup", SETUP, "--frames", ":2"]]
        commands[0] += ["--out", folder / "out"]
    for command in commands:
        read_only = command[1] != "measure"
        with unchanged(path.parent) if read_only else contextlib.nullcontext():
            code, stderr = _run([str(part) for part in command])
        if code not in (0, 1, 2) or "Traceback" in stderr or "a fault in the program" in stderr:
            raise Broken(f"labapp {' '.join(map(str, command))}: exit code {code}: {stderr}")
        tally.used += code == 0
        tally.refused += code != 0
    return tally


def _run(arguments: list[str]) -> tuple[int, str]:
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            cli.main(arguments)
        except SystemExit as ended:
            return int(ended.code or 0), err.getvalue()
    raise Broken("the command line came back")


# --- one case -----------------------------------------------------------------------------------

KINDS = (
    *(["session"] * 26),
    *(["setup"] * 6),
    *(["recording"] * 8),
    *(["table"] * 4),
    *(["manifest"] * 3),
    "command line",
)


def try_case(
    kind: str, originals: Originals, folder: Path, known: Any, rng: random.Random
) -> Tally:
    """Damage one file of a kind in an empty folder, and check the requirements of its kind."""
    groups = {
        "session": originals.sessions,
        "setup": originals.setups,
        "recording": originals.recordings,
        "table": originals.tables,
        "manifest": originals.manifests,
        "command line": (
            *(originals.sessions[:2] * 4),
            *originals.setups,
            *(path for path in originals.recordings if path.is_file()),
        ),
    }
    original = rng.choice(groups[kind])
    container = original if original.is_dir() else original.parent
    shutil.copytree(container, folder / container.name)
    path = folder / original.relative_to(container.parent)
    if kind == "session":
        return try_session(folder / container.name, known[original], rng)
    if kind == "command line":
        return try_command_line(folder, path, originals, rng)
    tries = {
        "setup": try_setup,
        "recording": try_recording,
        "table": try_table,
        "manifest": try_manifest,
    }
    return tries[kind](folder, path, rng)
