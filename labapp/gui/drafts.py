"""Drafts: sessions without a name yet, in a folder of the app."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import platformdirs

from labapp.errors import os_errors_as_input
from labapp.gui.dialogs import new_path
from labapp.gui.preferences import documents_folder
from labapp.log import NAME
from labapp.session.file.database import SUFFIX

if TYPE_CHECKING:
    from labapp.session.session import Session


def drafts_folder() -> Path:
    """Folder of the drafts, which may not exist yet."""
    return platformdirs.user_data_path(NAME, appauthor=False) / "drafts"


def is_draft(path: Path) -> bool:
    """Whether a session file is a draft."""
    return path.parent == drafts_folder()


def drafts() -> list[Path]:
    """Files of the drafts, the most recently changed first."""
    try:
        found = [(path.stat().st_mtime, path) for path in drafts_folder().glob(f"*{SUFFIX}")]
    except OSError:
        return []
    return [path for _, path in sorted(found, reverse=True)]


def new_draft(recording: Path) -> Session:
    """Create a draft for a recording, which is not imported yet.

    Raises
    ------
    InputError
        If the draft cannot be written.
    """
    from labapp.session.session import Session

    folder = drafts_folder()
    with os_errors_as_input(folder, "folder", "one that can be written"):
        folder.mkdir(parents=True, exist_ok=True)
    return Session.create(new_path(folder, recording.stem))


def folder_of(session: Session) -> Path:
    """Folder for files made from a session: its own, or that of the recording for a draft."""
    if not is_draft(session.path):
        return session.path.parent
    place = session.recording_place
    return documents_folder() if place is None else place.parent
