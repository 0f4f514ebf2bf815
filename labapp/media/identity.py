"""Identity of a recording: digest of its files, and a fast check for changes."""

from __future__ import annotations

import hashlib
from pathlib import Path

from labapp.errors import os_errors_as_input
from labapp.files import regular_size

PAIRED = frozenset({".cih", ".cihx", ".mraw"})

READABLE = "one that can be read"


def identify(path: Path) -> tuple[int, str]:
    """Return size in bytes and SHA-256 of a recording; for a folder or a pair, of all files.

    Raises
    ------
    InputError
        If it cannot be read.
    """
    with os_errors_as_input(path, "recording", READABLE):
        files = _files(path)
        size = 0
        digests = []
        for file in files:
            size += regular_size(file)
            with file.open("rb") as stream:
                digests.append((file.name, hashlib.file_digest(stream, "sha256").hexdigest()))
    if len(files) == 1 and files[0] == path:
        return size, digests[0][1]
    return size, hashlib.sha256(repr(digests).encode()).hexdigest()


def size_of(path: Path) -> int:
    """Return the size of a recording in bytes, as `identify` does, without reading it.

    Raises
    ------
    OSError
        If a file is missing.
    """
    return sum(file.stat().st_size for file in _files(path))


def stamp(path: Path) -> str:
    """Return a digest of names, sizes and modification times of a recording's files.

    Raises
    ------
    InputError
        If a file is missing.
    """
    with os_errors_as_input(path, "recording", READABLE):
        seen = [(file.name, file.stat()) for file in _files(path)]
    facts = [(name, found.st_size, found.st_mtime_ns) for name, found in seen]
    return hashlib.sha256(repr(facts).encode()).hexdigest()


def _files(path: Path) -> list[Path]:
    if path.is_dir():
        return sorted(p for p in path.iterdir() if p.is_file() and not p.name.startswith("."))
    if path.suffix.lower() in PAIRED:
        return sorted(
            p for p in path.parent.iterdir() if p.stem == path.stem and p.suffix.lower() in PAIRED
        )
    return [path]
