"""`labapp tour`: the real window driven through the whole guided way, a picture of each view."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from labapp.errors import InputError
from labapp.gui.app import open_window, start_app
from labapp.gui.preferences import Preferences


@dataclass(frozen=True)
class BorrowedPreferences(Preferences):
    """Preferences of the tour: samples are copied into its own folder, not among the user's.

    Parameters
    ----------
    tour_folder
        Where everything goes that the tour makes, besides its pictures.
    """

    tour_folder: str = ""

    @property
    def samples_folder(self) -> Path:
        """Where copies of samples go."""
        return Path(self.tour_folder) / "samples"


def tour(
    out: Path,
    size_px: tuple[int, int],
    theme: str,
    scale: float,
    tell: Callable[[str], None],
) -> str:
    """Go through the app as an operator does, and write a picture of every page and dialog.

    Nothing of the user's is read or changed.

    Parameters
    ----------
    out
        Folder for the pictures (PNG); those of an earlier tour are replaced.
    size_px
        Width and height of the window, px of the screen.
    theme
        ``light`` or ``dark``.
    scale
        Screen pixels to a pixel of the layout.
    tell
        Called with a line for every picture.

    Returns
    -------
    str
        Where it went wrong and how; empty if it did not.

    Raises
    ------
    InputError
        If the folder cannot be written, there is no display, or nothing can be drawn in 3-D.
    """
    _make_room(out)
    os.environ["QT_SCALE_FACTOR"] = f"{scale:g}"
    app = start_app()

    from PySide6.QtCore import QSettings, Qt

    from labapp.export.drawing import can_draw
    from labapp.gui.tour.bench import lay_out
    from labapp.gui.tour.hands import Hands, TourFailed
    from labapp.gui.tour.way import go_through

    if not can_draw():
        raise InputError("the tour", "3-D", "nothing can be drawn here", "OpenGL, or Mesa's")
    app.setAttribute(Qt.ApplicationAttribute.AA_DontUseNativeDialogs)  # they can be driven
    with tempfile.TemporaryDirectory(prefix="labapp-tour-") as name:
        folder = Path(name)
        for form in (QSettings.Format.NativeFormat, QSettings.Format.IniFormat):
            QSettings.setPath(form, QSettings.Scope.UserScope, str(folder / "qt"))
        lay_out(folder)
        preferences = BorrowedPreferences(
            theme=theme, last_folder=str(folder / "measurements"), tour_folder=name
        )
        with open_window(app, preferences, folder / "preferences.json") as window:
            try:
                go_through(Hands(window, out, size_px, tell), folder)
            except TourFailed as failure:
                return str(failure)
            finally:
                window.close()
    return ""


def _make_room(out: Path) -> None:
    """Make the folder, and take the pictures of an earlier tour out of it."""
    try:
        out.mkdir(parents=True, exist_ok=True)
        for picture in out.glob("[0-9][0-9]-*.png"):
            picture.unlink()
    except OSError as error:
        raise InputError(out, "--out", error.strerror, "a folder that can be written") from error
