"""The setup file of a bench with a line pattern: ``[pattern] kind = "lines"``."""

from __future__ import annotations

import os
from pathlib import Path

from labapp.config.setup import A_SETUP, Setup, parse_setup, read_setup_text
from labapp.config.toml_keys import parse_toml, shown
from labapp.core.geometry.line_pattern import KIND
from labapp.errors import InputError


def read_line_setup(path: str | os.PathLike[str]) -> Setup:
    """Read and check a setup file with a line pattern.

    Raises
    ------
    InputError
        If the file cannot be read, its pattern is not a line pattern, or anything in it is unknown,
        missing or impossible; all problems are reported together.
    """
    path = Path(path)
    text = read_setup_text(path)
    pattern = parse_toml(text, path, A_SETUP).get("pattern")
    if isinstance(pattern, dict) and pattern.get("kind", "square") != KIND:
        kind = shown(pattern.get("kind", "square"))
        right = f'"{KIND}"; dots are measured by labapp reconstruct'
        raise InputError(path, "pattern.kind", kind, right)
    return parse_setup(text, path, lines=True)
