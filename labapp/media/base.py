"""Frames, sources of frames, and conversion to grey levels."""

from __future__ import annotations

import copy
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Protocol, Self

import cv2
import numpy as np
import numpy.typing as npt

from labapp.core.values import ReadOnlyArrays

GreyImage = npt.NDArray[Any]
"""Grey levels, shape (rows, columns): uint8 or uint16 as recorded, float32 for other types."""


@dataclass(frozen=True)
class Frame(ReadOnlyArrays):
    """A frame of a source."""

    index: int
    """Frame number in the source, from 0."""
    time_s: float | None
    """Time since the source's first frame, s; None if the source has no time base."""
    image: GreyImage
    """Grey levels, shape (rows, columns), read-only."""

    def repeats(self, before: Frame) -> bool:
        """Whether it has the pixels of the frame before it, which are not all of one level.

        Noise differs from frame to frame: a camera or program has added such a frame, often in
        place of a lost one, and it shows the pool of another time than its own. Without a time
        base this does not matter.
        """
        is_next = self.time_s is not None and self.index == before.index + 1
        return is_next and np.array_equal(self.image, before.image) and bool(np.ptp(self.image))


class FrameSource(Protocol):
    """Frames in a fixed order, each of the same shape: a video, an image, a folder of images."""

    name: str
    """Name for display."""
    frame_rate_hz: float | None
    """Frame rate, Hz; None without a time base."""
    shape: tuple[int, int]
    """(rows, columns) of every frame."""
    warnings: tuple[str, ...]
    """Warnings for the user, one sentence each."""
    description: str = ""
    """Description: "AVI, FFV1, 640×480 px, 8 bit grey, 60 frames/s"."""
    bit_depth: int = 8
    """Significant bits of a grey level: 8, 10, 12, 16; 32 for float."""
    index: bytes | None = None
    """Information from reading the file (time stamps, key frames …), with which
    ``open_source(path, index)`` opens it fast. None if opening is fast anyway. An index of another
    file is ignored.
    """

    def __len__(self) -> int: ...

    def frame(self, index: int) -> Frame:
        """Read frame ``index``, 0 ≤ index < len.

        Raises
        ------
        InputError
            If this frame cannot be read; other frames may be readable.
        IndexError
            If there is no such frame.
        """
        ...

    def reopen(self) -> Self:
        """Open the same frames again, without the state of earlier reads."""
        return copy.copy(self)

    def close(self) -> None:
        """Close the file. May be called twice."""
        return

    def __iter__(self) -> Iterator[Frame]:
        return (self.frame(index) for index in range(len(self)))

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def check_index(source: FrameSource, index: int) -> None:
    """Raise IndexError unless ``source`` has frame ``index``."""
    if not 0 <= index < len(source):
        raise IndexError(f"{source.name} has frames 0 to {len(source) - 1}, not {index}")


def format_frame_rate(rate_hz: float) -> str:
    """Format a frame rate with its unit: "60 frames/s", "1 frame/s", "29.97 frames/s"."""
    is_whole = rate_hz == round(rate_hz) or rate_hz >= 10_000
    figure = f"{rate_hz:.0f}" if is_whole else f"{rate_hz:.5g}"
    return f"{figure} frame{'s' * (figure != '1')}/s"


def to_grey(image: npt.NDArray[Any]) -> GreyImage:
    """Convert a decoded picture to grey levels, shape (rows, columns).

    Parameters
    ----------
    image
        Shape (rows, columns) or (rows, columns, 1 … 4) in OpenCV's order B, G, R, alpha. Colour is
        converted to luminance, alpha is ignored. uint8 and uint16 are unchanged; other types are
        converted to float32.
    """
    if image.dtype not in (np.uint8, np.uint16):
        with np.errstate(over="ignore"):  # infinite levels are an error of each reader
            image = image.astype(np.float32)
    if image.ndim == 2:
        return image
    if image.shape[2] < 3:
        return np.ascontiguousarray(image[..., 0])
    return np.asarray(cv2.cvtColor(np.ascontiguousarray(image[..., :3]), cv2.COLOR_BGR2GRAY))
