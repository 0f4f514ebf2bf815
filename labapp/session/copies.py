"""Copies of sessions: one saved as it is now, and one of a sample to try things with."""

from __future__ import annotations

import os
import shutil
import sqlite3
from contextlib import closing
from pathlib import Path
from urllib.parse import quote

from labapp.errors import InputError
from labapp.session.database import SUFFIX, new_session_path
from labapp.session.samples import SAMPLES, sample_folder
from labapp.session.session import Session

BUSY_S = 30.0


def copy_session(source: Path, path: str | os.PathLike[str]) -> Path:
    """Copy a session as it is now, even while it is open and written to.

    The copy finds the recording where it is; it is read through once for that, unless the copy
    stands beside the session.

    Parameters
    ----------
    source
        The session file.
    path
        The new one.

    Raises
    ------
    InputError
        If there is a file of that name, or it cannot be written.
    """
    path = new_session_path(path)
    beside = path.with_name(f".{path.name}.part")
    try:
        beside.unlink(missing_ok=True)
        uri = f"file:{quote(os.fspath(source))}?mode=ro"
        with (
            closing(sqlite3.connect(uri, uri=True, timeout=BUSY_S)) as there,
            closing(sqlite3.connect(beside)) as here,
        ):
            there.backup(here)
        beside.rename(path)
    except (OSError, sqlite3.Error) as error:
        beside.unlink(missing_ok=True)
        raise InputError(path, "file", error, "a folder that can be written") from error
    with Session.open(path) as copy:
        recording = copy.recording
        if recording is not None and copy.missing_recording is not None:
            place = source.parent / recording.path
            if place.exists():
                copy.relink(place)
    return path


def copy_sample(name: str, folder: Path) -> Path:
    """Copy a sample's session and its recording into a folder; what is there already stays.

    Parameters
    ----------
    name
        One of `SAMPLES`.
    folder
        Where to; made if it does not exist.

    Returns
    -------
    pathlib.Path
        The session file.

    Raises
    ------
    InputError
        If the sample is not there, or the folder cannot be written.
    """
    sample = sample_folder(name)
    session = f"{name}{SUFFIX}"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for part in (SAMPLES[name].recording, session):
            if not (folder / part).exists():
                beside = folder / f".{part}.part"
                if (sample / part).is_dir():
                    shutil.copytree(sample / part, beside, dirs_exist_ok=True)
                else:
                    shutil.copyfile(sample / part, beside)
                beside.rename(folder / part)
    except OSError as error:
        raise InputError(folder, "folder", error.strerror, "one that can be written") from error
    return folder / session
