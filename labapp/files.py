"""Atomic writing of files: a reader sees either the old file or the complete new one."""

from __future__ import annotations

import os
import secrets
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from labapp.errors import os_errors_as_input


def as_bytes(text: str) -> bytes:
    r"""Encode as UTF-8; undecodable bytes of file names are written as ``\udcXX``, as in JSON."""
    return text.encode("utf-8", "backslashreplace")


def beside(path: Path) -> Path:
    """Return a hidden, unpredictable path in the folder of ``path``, safe from planted links.

    The file or folder must still be created as new (``xb``, `mkdir`), never opened.
    """
    return path.with_name(f".{path.name}.{secrets.token_hex(8)}.part")


@contextmanager
def atomic_file(path: Path) -> Iterator[Path]:
    """Yield a temporary file, which replaces ``path`` unless the block raises.

    Raises
    ------
    OSError
        If it cannot be created or renamed.
    """
    part = beside(path)
    part.open("xb").close()
    try:
        yield part
        part.replace(path)
    finally:
        part.unlink(missing_ok=True)


def write_atomically(path: Path, content: bytes) -> None:
    """Write a temporary file and rename it to ``path``, so that readers never see a partial file.

    Permissions of an existing file are preserved, and links are followed, not replaced.

    Raises
    ------
    OSError
        If it cannot be written; an existing file is unchanged and no temporary file remains.
    """
    path = path.resolve()
    with atomic_file(path) as part:
        with part.open("wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        if path.exists():
            shutil.copymode(path, part)


def write_file(path: Path, content: bytes) -> Path:
    """Write a file with `write_atomically` and return its path.

    Raises
    ------
    InputError
        If it cannot be written.
    """
    with os_errors_as_input(path, "file", "one that can be written"):
        write_atomically(path, content)
    return path


def relative_path(path: Path, folder: Path) -> str:
    """Return a path relative to a folder, with ``/``; absolute if there is no relative path."""
    try:
        return Path(os.path.relpath(path, folder)).as_posix()
    except ValueError:  # on another drive
        return path.absolute().as_posix()
