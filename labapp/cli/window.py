"""`labapp` and `labapp FILE`: the way into the app; `labapp tour`: a way through it."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import Annotated, Literal

import typer

from labapp.cli.shared import NOTHING
from labapp.errors import InputError
from labapp.system import has_display, quoted


def asks_for_app(arguments: Sequence[str], commands: Collection[str]) -> bool:
    """Whether the app is wanted: no argument at all, or one that is a file and no command."""
    if not arguments:
        return True
    (first, *others) = arguments
    if others or first.startswith("-") or first in commands:
        return False
    return bool(Path(first).suffix) or os.sep in first or Path(first).exists()


def open_app(arguments: Sequence[str]) -> int:
    """Open the app; returns its exit code when its window was closed.

    Raises
    ------
    InputError
        If there is no such file, no display, or what windows need is not installed.
    """
    try:
        from labapp.gui.app import main
    except ImportError as error:
        raise _lacking(error) from error
    return main(arguments)


def _lacking(error: ImportError) -> InputError:
    expected = "what windows need: pip install 'labapp[gui]'. Without it: labapp --help"
    return InputError("the app", error.name or "library", error, expected)


def show_in_app(session: Path) -> None:
    """Open a session in the app where there is a display; elsewhere tell how to."""
    if not has_display(os.environ):
        typer.echo(f"To see it in the app: labapp {quoted(os.fspath(session))}")
        return
    typer.echo("The app opens with it; close its window to end.")
    # A process of its own: whatever comes over the window, the results are there.
    subprocess.run([sys.executable, "-m", "labapp", os.fspath(session)], check=False)


def tour(
    out: Annotated[
        Path, typer.Option(help="Folder for the pictures (PNG); those of an earlier tour go.")
    ],
    size: Annotated[
        str, typer.Option(metavar="WxH", help="Width and height of the window, screen pixels.")
    ] = "1366x768",
    theme: Annotated[
        Literal["light", "dark"], typer.Option(help="Light or dark, whatever the desktop is.")
    ] = "dark",
    scale: Annotated[
        float,
        typer.Option(min=0.5, max=4.0, help="Scaling: 1.5 makes everything half as large again."),
    ] = 1.0,
) -> None:
    """Drive the app through the whole guided way and save a picture of every page and dialog.

    It works on a copy of the sample run, and leaves your sessions and preferences alone.

    A page that goes wrong ends it: it is named, and the exit code is 1.
    """
    out = out.absolute()
    found = re.fullmatch(r"([1-9]\d{2,3})x([1-9]\d{2,3})", size)
    if found is None:
        raise InputError("--size", "size", size, "width and height in pixels, such as 1366x768")
    try:
        from labapp.gui.tour import tour as go
    except ImportError as error:
        raise _lacking(error) from error
    wrong = go(out, (int(found[1]), int(found[2])), theme, scale, typer.echo)
    if wrong:
        typer.echo(f"labapp: the tour ended early. {wrong}", err=True)
        raise typer.Exit(NOTHING)
    typer.echo(f"The pictures are in {out}")
