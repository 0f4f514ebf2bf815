"""Copies of sessions: backups, templates for another recording, samples."""

from __future__ import annotations

import os
import shutil
import sqlite3
import tempfile
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any, get_args
from urllib.parse import quote

from labapp.errors import InputError, os_errors_as_input
from labapp.files import atomic_file
from labapp.session.creation import new_session
from labapp.session.documents import PICTURED, Key, Kind
from labapp.session.file.database import SUFFIX, new_session_path
from labapp.session.file.schema import NO_FRAME
from labapp.session.samples import SAMPLES, sample_folder
from labapp.session.session import Session

BUSY_S = 30.0

OF_A_RECORDING = ("correction", "signals")
"""Kinds of documents that belong to the recording."""

OF_A_BENCH: tuple[Kind, ...] = ("setup", *PICTURED)
"""Kinds of documents that belong to the bench."""


def copy_session(source: Path, path: str | os.PathLike[str]) -> Path:
    """Copy the present state of a session, even while it is open for writing.

    The copy refers to the same recording. Unless it is in the same folder, the recording is read
    completely to verify it.

    Raises
    ------
    InputError
        If the file exists already, or it cannot be written.
    """
    path = new_session_path(path)
    uri = f"file:{quote(os.fspath(source))}?mode=ro"
    try:
        with (
            atomic_file(path) as part,
            closing(sqlite3.connect(uri, uri=True, timeout=BUSY_S)) as there,
            closing(sqlite3.connect(part)) as here,
        ):
            there.backup(here)
    except (OSError, sqlite3.Error) as error:
        why = error.strerror if isinstance(error, OSError) else None
        raise InputError(path, "file", why or error, "a folder that can be written") from error
    with Session.open(path) as copy:
        recording = copy.recording
        if recording is not None and copy.missing_recording is not None:
            place = source.parent / recording.path
            if place.exists():
                copy.relink(place)
    return path


def move_session(source: Path, path: str | os.PathLike[str]) -> Path:
    """Move a closed session to another name or folder; its recording is not moved.

    Raises
    ------
    InputError
        If the file exists already, or it cannot be written; the session is not moved then.
    """
    path = new_session_path(path)
    with Session.open(source, read_only=True) as session:
        place = session.recording_place
    with os_errors_as_input(path, "file", "a folder to write in"), atomic_file(path) as part:
        shutil.copyfile(source, part)
    with Session.open(path) as moved:
        if place is not None and moved.missing_recording is not None:
            moved.relink(place, verify=False)
    source.unlink()
    return path


def use_setup_of(session: Session, path: Path) -> None:
    """Copy set-up, calibrations and bench check from another session, with their pictures.

    Raises
    ------
    InputError
        If the other session cannot be read, or its set-up is incomplete.
    """
    with Session.open(path, read_only=True) as other:
        if other.setup_problems:
            raise InputError(path, "set-up", "not complete", "a session with a complete set-up")
        copied: dict[Key, Any] = {
            (kind, NO_FRAME): other._documents.get(kind) for kind in OF_A_BENCH
        }
        session._pictures.copy_from(other._pictures)
    session._documents.change(f"set-up of {path.stem}", copied)


def next_session(session: Session, path: str | os.PathLike[str]) -> Session:
    """Create a session for the next recording on the same bench, with ``session`` as template.

    Record, set-up, calibrations with their pictures, settings and limits are copied; the ticked
    checklists, the recording and its results are not.

    Raises
    ------
    InputError
        If the file exists already, it cannot be written, or the template is damaged.
    """
    copied: dict[Key, Any] = {
        (kind, NO_FRAME): session._documents.get(kind)
        for kind in get_args(Kind)
        if kind not in OF_A_RECORDING
    }
    if copied["record", NO_FRAME] is not None:
        copied["record", NO_FRAME] = replace(session.record, safety=())
    with new_session(path) as new:
        new._pictures.copy_from(session._pictures)
        new._documents.change(f"as in {session.path.stem}", copied)
    return new


def copy_sample(name: str, folder: Path) -> Path:
    """Copy a sample's session and recording into a folder; existing files are not replaced.

    Parameters
    ----------
    name
        One of `SAMPLES`.
    folder
        Destination; created if missing.

    Returns
    -------
    pathlib.Path
        The session file.

    Raises
    ------
    InputError
        If the sample is missing, or the folder cannot be written.
    """
    sample = sample_folder(name)
    session = f"{name}{SUFFIX}"
    with os_errors_as_input(folder, "folder", "one that can be written"):
        folder.mkdir(parents=True, exist_ok=True)
        for each in (SAMPLES[name].recording, session):
            if (folder / each).exists():
                continue
            with tempfile.TemporaryDirectory(prefix=".", dir=folder) as hidden:
                part = Path(hidden) / each
                copy = shutil.copytree if (sample / each).is_dir() else shutil.copyfile
                copy(sample / each, part)
                part.rename(folder / each)
    return folder / session
