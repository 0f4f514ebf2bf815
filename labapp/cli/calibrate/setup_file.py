"""The setup file that calibrated values are written into."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated

import typer

from labapp.cli.shared import show_warnings
from labapp.errors import InputError

SetupToChange = Annotated[
    Path | None,
    typer.Option("--setup", help="Setup file (TOML) to write the values into; made if missing."),
]


def write_values(setup: Path | None, values: Mapping[str, Mapping[str, object]]) -> None:
    """Write calibrated values into a setup file and say what the file still lacks."""
    from labapp.config.setup import read_setup, update_setup

    if setup is None:
        return
    update_setup(setup, values)
    typer.echo(f"Written to [{'], ['.join(values)}] of {setup.absolute()}")
    try:
        show_warnings(read_setup(setup))
    except InputError as lacking:
        typer.echo(f"It is not complete yet:\n{lacking}", err=True)
