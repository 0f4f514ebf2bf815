"""Atomic writing of files: a reader sees all of a new file, or the former one."""

from __future__ import annotations

import os
import secrets
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from labapp.errors import os_errors_as_input


def as_bytes(text: str) -> bytes:
    r"""UTF-8; a file name that is no text keeps its odd bytes as ``\udcXX``, as in JSON."""
    return text.encode("utf-8", "backslashreplace")


def beside(path: Path) -> Path:
    """Hidden, unpredictable path in the folder of ``path``: no link can wait there to be followed.

    A file or folder there must still be created as new (``xb``, `mkdir`), never opened.
    """
    return path.with_name(f".{path.name}.{secrets.token_hex(8)}.part")


@contextmanager
def atomic_file(path: Path) -> Iterator[Path]:
    """Temporary file that replaces ``path`` when the block ends without error, else is deleted.

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
    """Write a temporary file and rename it to ``path``, so that no reader sees a part of it.

    A file that was there keeps its permissions, and a link keeps pointing at what it did.

    Raises
    ------
    OSError
        If it cannot be written; then what was there is untouched and nothing is left beside it.
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
    """Write a file by `write_atomically`; returns its path.

    Raises
    ------
    InputError
        If it cannot be written.
    """
    with os_errors_as_input(path, "file", "one that can be written"):
        write_atomically(path, content)
    return path
