"""The sample run as a session of the user's own: what `labapp demo` measures and shows."""

from __future__ import annotations

from concurrent.futures.process import BrokenProcessPool
from pathlib import Path

import labapp
from labapp.core.reconstruction import Reconstruction
from labapp.errors import InputError
from labapp.session.pictures import write_surface_picture
from labapp.session.session import Session


def sample_folder() -> Path:
    """Folder of the sample run, beside the package in the repository.

    Raises
    ------
    InputError
        If it is not there, as in an installed package.
    """
    folder = Path(labapp.__file__).parents[1] / "sample_sessions" / "gtaw"
    if not folder.is_dir():
        raise InputError(folder, "sample run", "missing", "a checkout of labapp's repository")
    return folder


def open_demo(folder: Path) -> Session:
    """Open the session of the sample run in a folder; it is made there if it is not yet.

    It starts with the recording and the setup; measuring is left to the caller.

    Raises
    ------
    InputError
        If the folder cannot be written, or the session is open elsewhere.
    """
    path = folder / "gtaw.labsession"
    if path.exists():
        return Session.open(path)
    sample = sample_folder()
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(folder, "folder", error.strerror, "one that can be written") from error
    session = Session.create(path)
    try:
        session.set_setup((sample / "setup.toml").read_text("utf-8"))
        session.import_recording(sample / "recording.avi")
    except BaseException:
        session.close()
        path.unlink()
        raise
    return session


def draw_surface(reconstruction: Reconstruction, path: Path) -> str:
    """Draw a surface in 3-D; returns why it could not be, or nothing."""
    try:
        write_surface_picture(path, reconstruction)
    except ImportError as error:
        return f"{error.name} is not installed (pip install 'labapp[gui]')"
    except BrokenProcessPool:
        return "OpenGL cannot be used here"
    except OSError as error:
        return str(error.strerror)
    return ""
