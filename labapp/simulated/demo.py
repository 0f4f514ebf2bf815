"""The sample run as a session of the user, which `labapp demo` measures and shows."""

from __future__ import annotations

from concurrent.futures.process import BrokenProcessPool
from pathlib import Path

from labapp.core.surface.reconstruction import Reconstruction
from labapp.errors import os_errors_as_input
from labapp.export.rendering.pictures import write_surface_picture
from labapp.session.samples import begin_session
from labapp.session.session import Session


def open_demo(folder: Path) -> Session:
    """Open the session of the sample run in a folder; it is created if missing.

    The caller measures it.

    Raises
    ------
    InputError
        If the folder cannot be written, or the session is open elsewhere.
    """
    path = folder / "gtaw.labsession"
    if path.exists():
        return Session.open(path)
    with os_errors_as_input(folder, "folder", "one that can be written"):
        folder.mkdir(parents=True, exist_ok=True)
    return begin_session("gtaw", path)


def draw_surface(reconstruction: Reconstruction, path: Path) -> str:
    """Draw a surface in 3-D; returns the reason if that is not possible, else ""."""
    try:
        write_surface_picture(path, reconstruction)
    except ImportError as error:
        return f"{error.name} is not installed (pip install 'labapp[gui]')"
    except BrokenProcessPool:
        return "OpenGL cannot be used here"
    except OSError as error:
        return str(error.strerror)
    return ""
