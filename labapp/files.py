"""Files that are whole or not there."""

from __future__ import annotations

import os
import secrets
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


def as_bytes(text: str) -> bytes:
    r"""UTF-8; a file name that is no text keeps its odd bytes as ``\udcXX``, as in JSON."""
    return text.encode("utf-8", "backslashreplace")


def beside(path: Path) -> Path:
    """A hidden name beside a path that nobody can foresee: no link waits there to be followed.

    What is made there must still be made as new (``xb``, `mkdir`), never opened or emptied.
    """
    return path.with_name(f".{path.name}.{secrets.token_hex(8)}.part")


@contextmanager
def made_whole(path: Path) -> Iterator[Path]:
    """A new, empty file beside a path, which takes its place when all went well; else it is gone.

    Raises
    ------
    OSError
        If it cannot be made or renamed.
    """
    part = beside(path)
    part.open("xb").close()
    try:
        yield part
        part.replace(path)
    finally:
        part.unlink(missing_ok=True)


def write_whole(path: Path, content: bytes) -> None:
    """Write a file beside its place and rename it, so that no reader sees half of it.

    A file that was there keeps its permissions, and a link keeps pointing at what it did.

    Raises
    ------
    OSError
        If it cannot be written; then what was there is untouched and nothing is left beside it.
    """
    path = path.resolve()
    with made_whole(path) as part:
        with part.open("wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        if path.exists():
            shutil.copymode(path, part)
