"""Identity of a recording: digest of its files, and a fast check for changes."""

from __future__ import annotations

import hashlib
import os
from pathlib import Path

from labapp.errors import os_errors_as_input
from labapp.files import regular_size
from labapp.media.formats.images import IMAGE_SUFFIXES

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


def may_be(path: Path, size: int, frames: int) -> bool:
    """Whether a recording can be that of this size (`identify`) and number of frames, unread.

    Files that are no images may have been added to a folder, such as the session itself.

    Raises
    ------
    OSError
        If a file is missing.
    """
    if not path.is_dir():
        return sum(file.stat().st_size for file in _files(path)) == size
    images = image_byte = total_byte = 0
    with os.scandir(path) as entries:  # gives sizes faster than `Path.stat`
        for entry in entries:
            if entry.name.startswith("."):
                continue
            is_image = os.path.splitext(entry.name)[1].lower() in IMAGE_SUFFIXES
            images += is_image
            if entry.is_file():
                byte = entry.stat().st_size
                total_byte += byte
                image_byte += byte * is_image
    return image_byte <= size <= total_byte and (images < 2 or images == frames)


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
