"""Drive the real window through all steps, and save a picture of each page and dialog.

`python -m tests.tour --out FOLDER` from the checkout; copied beside an installed labapp,
`python -m tour --out FOLDER`. It needs a display. An error on a page ends the tour; the page is
named, and the exit code is 1.
"""

from __future__ import annotations

import argparse
import os
import re
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from unittest import mock

from labapp.errors import InputError
from labapp.gui import drafts
from labapp.gui.app import open_window, start_app
from labapp.gui.preferences import Preferences


@dataclass(frozen=True)
class BorrowedPreferences(Preferences):
    """Preferences of the tour: samples are copied into its own folder, not the user's.

    Parameters
    ----------
    tour_folder
        Folder for all files of the tour but its pictures.
    """

    tour_folder: str = ""

    @property
    def samples_folder(self) -> Path:
        """Where copies of samples go."""
        return Path(self.tour_folder) / "samples"


def tour(out: Path, size_px: tuple[int, int], theme: str) -> str:
    """Go through the app as an operator does, and write a picture of every page and dialog.

    No files of the user are read or changed.

    Parameters
    ----------
    out
        Folder for the pictures (PNG); those of an earlier tour are replaced.
    size_px
        Width and height of the window, screen px.
    theme
        ``light`` or ``dark``.

    Returns
    -------
    str
        The error, with the page; empty if there was none.

    Raises
    ------
    InputError
        If the folder cannot be written, there is no display, or nothing can be drawn in 3-D.
    """
    _make_room(out)
    app = start_app()

    from PySide6.QtCore import QSettings, Qt

    from labapp.export.rendering.drawing import can_draw

    from .bench import lay_out
    from .hands import Hands, TourFailed
    from .way import go_through

    if not can_draw():
        raise InputError("the tour", "3-D", "nothing can be drawn here", "OpenGL, or Mesa's")
    app.setAttribute(Qt.ApplicationAttribute.AA_DontUseNativeDialogs)  # Qt dialogs can be driven
    with tempfile.TemporaryDirectory(prefix="labapp-tour-") as name:
        folder = Path(name)
        for form in (QSettings.Format.NativeFormat, QSettings.Format.IniFormat):
            QSettings.setPath(form, QSettings.Scope.UserScope, str(folder / "qt"))
        lay_out(folder)
        preferences = BorrowedPreferences(
            theme=theme, last_folder=str(folder / "measurements"), tour_folder=name
        )
        own_drafts = mock.patch.object(drafts, "drafts_folder", return_value=folder / "drafts")
        with own_drafts, open_window(app, preferences, folder / "preferences.json") as window:
            try:
                go_through(Hands(window, out, size_px), folder)
            except TourFailed as failure:
                return str(failure)
            finally:
                window.close()
    return ""


def _make_room(out: Path) -> None:
    """Create the folder, and delete the pictures of an earlier tour."""
    try:
        out.mkdir(parents=True, exist_ok=True)
        for picture in out.glob("[0-9][0-9][0-9]-*.png"):
            picture.unlink()
    except OSError as error:
        raise InputError(out, "--out", error.strerror, "a folder that can be written") from error


def _size(text: str) -> tuple[int, int]:
    match = re.fullmatch(r"([1-9]\d{2,3})x([1-9]\d{2,3})", text)
    if match is None:
        raise argparse.ArgumentTypeError(f"{text} is not WIDTHxHEIGHT in px, such as 1366x768")
    return int(match[1]), int(match[2])


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the tour; return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--out", type=Path, required=True, help="folder for the pictures")
    parser.add_argument("--size", type=_size, default="1366x768", help="of the window, screen px")
    parser.add_argument("--theme", choices=("light", "dark"), default="dark")
    parser.add_argument("--scale", type=float, default=1.0, help="screen pixels to a layout pixel")
    options = parser.parse_args(arguments)
    os.environ["QT_SCALE_FACTOR"] = f"{options.scale:g}"
    try:
        error_text = tour(options.out.absolute(), options.size, options.theme)
    except InputError as error:
        parser.error(str(error))
    if error_text:
        print(f"the tour ended early. {error_text}", file=sys.stderr)
        return 1
    print(f"The pictures are in {options.out}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
