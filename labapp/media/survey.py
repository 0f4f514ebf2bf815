"""Survey of a recording at import: read all frames, and check random access."""

from __future__ import annotations

import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from labapp.core.values import FloatArray, ReadOnlyArrays
from labapp.errors import InputError
from labapp.media.base import Frame, FrameSource, GreyImage

if TYPE_CHECKING:
    from labapp.media.formats.video import VideoSource

CHECKED_FRAMES = 24
"""Number of random frames that are read again out of order."""

NAMED_FRAMES = 10
"""Most frames that are listed in a warning."""


@dataclass(frozen=True)
class Survey(ReadOnlyArrays):
    """Result of reading all frames of a recording."""

    checksum: npt.NDArray[np.uint32]
    """`frame_checksum` of each frame, shape (n,), uint32; 0 if a frame cannot be read."""
    readable: npt.NDArray[np.bool_]
    """Whether a frame can be read, shape (n,)."""
    time_s: FloatArray
    """Time of each frame since the first, shape (n,), s; NaN if unknown."""
    frame_exact: bool
    """Whether the frames read again out of order were the same."""
    checked: int
    """Number of these frames; 0 for a video that is always decoded from its start."""
    warnings: tuple[str, ...]
    """Warnings for the user in addition to those of the source, one sentence each."""


def frame_checksum(image: GreyImage) -> int:
    """Return the CRC-32 of a frame's grey levels, row by row, little-endian."""
    little = np.ascontiguousarray(image, image.dtype.newbyteorder("<"))
    return zlib.crc32(little.tobytes())


def repeated_words(numbers: Sequence[int]) -> str:
    """Warn of frames that repeat the one before, in a sentence; empty without any."""
    if not numbers:
        return ""
    frames = "frames" if len(numbers) > 1 else "a frame"
    return (
        f"{frames} with the pixels of the one before: {_named(numbers)}; "
        "unless they replace lost frames, the times after them are wrong, and so are frequencies"
    )


def survey(source: FrameSource, progress: Callable[[int, int], None] | None = None) -> Survey:
    """Read all frames in order, then some out of order from the reopened source.

    If a video then returns other frames, it is decoded from its start from now on
    (`VideoSource.decode_from_start`).

    Parameters
    ----------
    progress
        Called with the number of frames done and the total; may raise to stop.
    """
    order = _order(source)
    total = len(source) + len(order)
    checksum = np.zeros(len(source), np.uint32)
    readable = np.zeros(len(source), bool)
    time_s = np.full(len(source), np.nan)
    first_reason, repeated = "", list[int]()
    before: Frame | None = None
    for index in range(len(source)):
        try:
            frame = source.frame(index)
        except InputError as error:
            first_reason = first_reason or str(error)
        else:
            readable[index] = True
            checksum[index] = frame_checksum(frame.image)
            time_s[index] = np.nan if frame.time_s is None else frame.time_s
            if before is not None and frame.repeats(before):
                repeated.append(index)
            before = frame
        if progress is not None:
            progress(index + 1, total)
    exact = True
    with source.reopen() as again:
        for count, index in enumerate(order, 1):
            try:
                same = frame_checksum(again.frame(index).image) == checksum[index]
            except InputError:
                same = not readable[index]
            exact &= bool(same)
            if progress is not None:
                progress(len(source) + count, total)
    found = (_unread(readable, first_reason), repeated_words(repeated), *_inexact(source, exact))
    warnings = tuple(filter(None, found))
    return Survey(checksum, readable, time_s, exact, len(order), warnings)


def _order(source: FrameSource) -> list[int]:
    """Return the frames to read again: last, first, random jumps, then steps backwards."""
    video = _as_video(source)
    if video is not None and not video.seekable:
        return []
    count = len(source)
    drawn = np.random.default_rng(count).permutation(count)[:CHECKED_FRAMES].tolist()
    last = max(0, count - 1)
    return [last, 0, *drawn, *sorted({max(0, k - 1) for k in drawn[:4]}, reverse=True)]


def _unread(readable: npt.NDArray[np.bool_], first_reason: str) -> str:
    numbers = np.flatnonzero(~readable).tolist()
    if not numbers:
        return ""
    count = f"{len(numbers)} of {len(readable)} frames"
    return f"{count} cannot be read: {_named(numbers)} ({first_reason})"


def _named(numbers: Sequence[int]) -> str:
    return ", ".join(map(str, numbers[:NAMED_FRAMES])) + " …" * (len(numbers) > NAMED_FRAMES)


def _inexact(source: FrameSource, exact: bool) -> tuple[str, ...]:
    if exact:
        return ()
    video = _as_video(source)
    if video is None:
        return (f"{source.name} returned other frames when read again; has it changed?",)
    before = video.warnings
    video.decode_from_start()
    return tuple(sentence for sentence in video.warnings if sentence not in before)


def _as_video(source: FrameSource) -> VideoSource | None:
    # Late import, as PyAV takes as long as NumPy, and opening a session does not need it.
    from labapp.media.formats.video import VideoSource

    return source if isinstance(source, VideoSource) else None
