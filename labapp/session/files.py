"""Files that are whole or not there."""

from __future__ import annotations

import os
import shutil
from pathlib import Path


def as_bytes(text: str) -> bytes:
    r"""UTF-8; a file name that is no text keeps its odd bytes as ``\udcXX``, as in JSON."""
    return text.encode("utf-8", "backslashreplace")


def write_whole(path: Path, content: bytes) -> None:
    """Write a file beside its place and rename it, so that no reader sees half of it.

    A file that was there keeps its permissions, and a link keeps pointing at what it did.

    Raises
    ------
    OSError
        If it cannot be written; then what was there is untouched and nothing is left beside it.
    """
    path = path.resolve()
    beside = path.with_name(f".{path.name}.part")
    try:
        with beside.open("wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        if path.exists():
            shutil.copymode(path, beside)
        beside.replace(path)
    except BaseException:
        beside.unlink(missing_ok=True)
        raise
