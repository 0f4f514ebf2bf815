"""`labapp` and `labapp FILE`: open the app."""

from __future__ import annotations

import os
import subprocess
from collections.abc import Callable, Collection, Sequence
from pathlib import Path

import typer

from labapp.errors import InputError
from labapp.system import has_display, own_command, quoted

LIBRARIES = (
    "libegl1 libgl1 libglib2.0-0 libxkbcommon0 libfontconfig1 libdbus-1-3 libxcb-cursor0 "
    "libxcb-icccm4 libxcb-keysyms1 libxcb-shape0 libxkbcommon-x11-0 libxcursor1"
)
"""Packages of Debian and Ubuntu with the libraries that Qt and VTK need."""


def asks_for_app(arguments: Sequence[str], commands: Callable[[], Collection[str]]) -> bool:
    """Whether to open the app: without arguments, or with one that is a file, not a command.

    The commands are called only if they matter: making them takes a tenth of a second.
    """
    if not arguments:
        return True
    (first, *others) = arguments
    if others or first.startswith("-"):
        return False
    if Path(first).suffix or os.sep in first:
        return True
    return Path(first).exists() and first not in commands()


def open_app(arguments: Sequence[str]) -> int:
    """Open the app, and return its exit code after its window is closed.

    Raises
    ------
    InputError
        If there is no such file, no display, or packages of the app or system libraries are not
        installed.
    """
    try:
        from labapp.gui.app import main
    except ModuleNotFoundError as error:
        expected = "the packages of the app: pip install 'labapp[gui]'. Without it: labapp --help"
        raise InputError("the app", error.name or "package", error, expected) from error
    except ImportError as error:
        expected = f"system libraries; on Debian and Ubuntu: sudo apt install {LIBRARIES}"
        raise InputError("the app", error.name or "library", error, expected) from error
    return main(arguments)


def show_in_app(session: Path) -> None:
    """Open a session in the app if there is a display; otherwise print the command for it."""
    if not has_display(os.environ):
        typer.echo(f"To see it in the app: labapp {quoted(os.fspath(session))}")
        return
    typer.echo("The app opens with it; close its window to end.")
    # In a separate process, so that a crash of the app does not affect this command.
    subprocess.run([*own_command(), os.fspath(session)], check=False)
