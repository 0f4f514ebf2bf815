"""Sessions of single recordings of a study: made, completed, made anew, or kept. Without Qt.

Beside each session is a file with a digest of everything that its results depend on. A session
of another digest is deleted and made anew, unless the operator has worked in it.
"""

from __future__ import annotations

import hashlib
import itertools
import json
from collections.abc import Iterator
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Literal

from labapp.errors import InputError, os_errors_as_input
from labapp.files import as_bytes, relative_path, write_file
from labapp.run.study.plan import StudyRecording, shown_condition
from labapp.run.study.status import Tasks
from labapp.run.study.study import Study
from labapp.session.creation import new_session
from labapp.session.file.database import SUFFIX, SessionInUse
from labapp.session.record import Record
from labapp.session.session import Session
from labapp.simulation.parallel import Progress

CHANGES_OF_STUDY = ["record", "setup", "settings"]
"""Documents that `begin_session` sets, each in one change; any further change is the operator's."""

State = Literal["complete", "partial", "outdated", "changed", "unreadable"]
"""State of a session: as the study measures now, in full or in part; made of other things; changed
by the operator; not readable by this version."""

KEPT_WORDS = {"changed": "it was changed by hand", "unreadable": "it cannot be read"}
IN_USE_WORDS = "it is in use"


@dataclass(frozen=True)
class BegunSession:
    """A session that shows what the study measures."""

    path: Path
    kept: str = ""
    """Which earlier session of the recording is kept beside it, and why; empty if none is."""


def begin_session(study: Study, recording: StudyRecording, progress: Progress) -> BegunSession:
    """Return a session of a study's recording, measured as in the study.

    An earlier one is completed, or made anew if it was made of other things. One that the operator
    has changed, that is in use or cannot be read, is kept, and the next free name is used.

    Parameters
    ----------
    progress
        Called with the current stage, the frames done, and their total; may raise to stop. If it
        raises during the import, no session is left; later, the measured frames are kept.

    Raises
    ------
    InputError
        If the recording has changed since the study was run, it or its setup file cannot be read,
        or the session cannot be written.
    """
    tasks = _tasks(study, recording)
    kept = ""
    for path in _paths(study, recording):
        state = _state(path, tasks) if path.exists() else "outdated"
        if state in KEPT_WORDS:
            kept = f"{path.stem} is kept, as {KEPT_WORDS[state]}"
            continue
        try:
            if state == "outdated":
                _make(path, tasks, progress)
            if state != "complete":
                _measure(path, tasks, progress)
        except SessionInUse:
            kept = f"{path.stem} is kept, as {IN_USE_WORDS}"
            continue
        return BegunSession(path, kept)
    raise AssertionError("names do not end")


def must_be_closed(study: Study, recording: StudyRecording, path: Path) -> bool:
    """Whether an open session is one of the recording's that `begin_session` would change."""
    try:
        tasks = _tasks(study, recording)
    except InputError:
        return False
    if path not in itertools.takewhile(Path.exists, _paths(study, recording)):
        return False
    return _state(path, tasks) in ("partial", "outdated")


def _paths(study: Study, recording: StudyRecording) -> Iterator[Path]:
    """Yield the paths of a recording's sessions; no name of a recording contains a space."""
    for number in itertools.count(1):
        yield study.folder / "sessions" / f"{recording.name}{f' {number}' * (number > 1)}{SUFFIX}"


def _tasks(study: Study, recording: StudyRecording) -> Tasks:
    tasks = study.tasks(recording)
    if tasks is None:
        expected = "the study run again"
        raise InputError(recording.path, "recording", "has changed", expected)
    return tasks


# --- what it was made of ------------------------------------------------------------------------


def _digest(path: Path, tasks: Tasks) -> str:
    """Return a digest of everything that a session at a path is made of."""
    facts = {
        "results": [stretch.key for stretch in tasks.stretches],
        "recording": relative_path(tasks.recording.path, path.parent),
        "record": asdict(_record(tasks.recording)),
    }
    return hashlib.sha256(as_bytes(json.dumps(facts, sort_keys=True))).hexdigest()


def _digest_file(path: Path) -> Path:
    return path.with_name(f"{path.name}.made-of")


def _state(path: Path, tasks: Tasks) -> State:
    """Return the state of a session file, which may be in use."""
    try:
        made_of = _digest_file(path).read_text("utf-8").strip()
    except (OSError, UnicodeDecodeError):
        made_of = ""
    is_outdated = made_of != _digest(path, tasks)
    try:
        with Session.open(path, read_only=True) as session:
            frames = session.frames.tolist()
            if _is_changed(session) or not (is_outdated or frames == list(tasks.frames)):
                return "changed"
            if is_outdated:
                return "outdated"
            return "partial" if len(session.stale_frames()) else "complete"
    except InputError:
        return "unreadable"


def _is_changed(session: Session) -> bool:
    """Whether the operator has changed anything, or imported the recording in another way."""
    kinds = [kind for change in session.history for kind, _ in change.keys if not change.undone]
    recording = session.recording
    imported = recording is not None and (recording.embedded or recording.rate_is_given)
    return imported or kinds != CHANGES_OF_STUDY or len(session.history) > len(kinds)


# --- making it ----------------------------------------------------------------------------------


def _make(path: Path, tasks: Tasks, progress: Progress) -> None:
    """Create a session without results; delete one that is there, unless it is in use."""
    recording = tasks.recording
    if path.exists():
        Session.open(path).close()
    with os_errors_as_input(path, "file", "one that can be replaced"):
        path.parent.mkdir(parents=True, exist_ok=True)
        # First, so that a session beside this file is always made of what it says.
        _digest_file(path).unlink(missing_ok=True)
        path.unlink(missing_ok=True)
    with new_session(path, _record(recording)) as session:
        session.set_setup(tasks.setup.text)
        session.set_settings(recording.settings)
        session.import_recording(
            recording.path,
            recording.frames,
            progress=lambda done, total: progress("importing", done, total),
        )
        session.close()
    write_file(_digest_file(path), as_bytes(_digest(path, tasks) + "\n"))


def _measure(path: Path, tasks: Tasks, progress: Progress) -> None:
    """Measure each stretch that is not complete, from its beginning, as the study does."""
    done, total = 0, len(tasks.frames)
    with Session.open(path) as session:
        left = set(session.stale_frames().tolist())
        for stretch in tasks.stretches:
            if left.isdisjoint(stretch.frames):
                done += len(stretch.frames)
                continue
            for _ in session.measure_each(stretch.frames, warm=stretch.warm):
                done += 1
                progress("measuring", done, total)


def _record(recording: StudyRecording) -> Record:
    """Record of a recording: conditions with a field of their own, others as notes."""
    kinds = {each.name: str(each.type) for each in fields(Record)}
    known, others = {}, []
    for name, value in recording.conditions.items():
        wanted = "str" if isinstance(value, str) else "float | None"
        if kinds.get(name) == wanted and name not in ("title", "notes"):
            known[name] = value
        else:
            others.append(f"{name} = {shown_condition(value)}")
    return Record(title=recording.name, notes="\n".join(others), **known)  # type: ignore[arg-type]
