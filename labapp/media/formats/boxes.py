"""Check of the counts in the boxes of an MP4 or MOV, before FFmpeg allocates memory for them.

FFmpeg allocates some fifty bytes for every sample that a box counts, and again for every edit. A
count takes four bytes only, whatever the file contains.
"""

from __future__ import annotations

import mmap
import re
from collections.abc import Iterator
from pathlib import Path

from labapp.errors import InputError

BEGINNINGS = frozenset(b"ftyp styp moov moof mdat wide free skip pnot udta uuid".split())
"""Types of the first box of such a file."""

COUNT_AT = {b"stsz": 12, b"stz2": 12, b"trun": 8, b"elst": 8}
"""Boxes with a count of samples or edits; offset of the count from their type, bytes."""

COUNTED = re.compile(b"|".join(COUNT_AT))

PACKED = re.compile(b"cmov")
"""An obsolete box that contains all others, compressed."""

MOST_ENTRIES = 2**22
"""Limit of samples times edits; for a large file two per byte."""


def mp4_formats(path: Path) -> tuple[str, ...]:
    """Return FFmpeg's names of MP4 and MOV if a file is one, by its first bytes; else empty.

    Raises
    ------
    InputError
        If it counts more samples than it can contain.
    OSError
        If it cannot be read.
    """
    with path.open("rb") as file:
        if file.read(8)[4:] not in BEGINNINGS:
            return ()
        with mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as content:
            entries, most = _entries(content), max(MOST_ENTRIES, 2 * len(content))
    if entries > most:
        expected = f"at most {most}: no more frames than are in the file"
        raise InputError(path, "samples and edits", entries, expected)
    return "mov", "mp4"


def _entries(content: mmap.mmap) -> float:
    """Return the number of samples by the boxes, times that of edits."""
    samples, edits = 0, 0
    for start, end in _described(content):
        if any(PACKED.finditer(content, start, end)):
            return float("inf")
        for kind, place in [(m[0], m.start()) for m in COUNTED.finditer(content, start, end)]:
            # A length of 1 means that the 64-bit length follows the type.
            at = place + COUNT_AT[kind] + 8 * (content[place - 4 : place] == b"\0\0\0\1")
            count = int.from_bytes(content[at : at + 4], "big")
            edits += count * (kind == b"elst")
            samples += count * (kind != b"elst")
    return samples * max(edits, 1)


def _described(content: mmap.mmap) -> Iterator[tuple[int, int]]:
    """Yield start and end of the outermost boxes, except those with frame data."""
    at = 0
    while at + 8 <= len(content):
        length, kind = int.from_bytes(content[at : at + 4], "big"), content[at + 4 : at + 8]
        if length == 1:
            length = int.from_bytes(content[at + 8 : at + 16], "big")
        end = min(at + length, len(content)) if length else len(content)
        if kind != b"mdat":
            yield at, end
        if end < at + 8:
            return
        at = end
