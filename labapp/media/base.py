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
"""Grey levels, shape (rows, columns): uint8 or uint16 as recorded, float32 where it was neither."""


@dataclass(frozen=True)
class Frame(ReadOnlyArrays):
    """A frame of a source."""

    index: int
    """Its place in the source, from 0."""
    time_s: float | None
    """Time since the source's first frame, s; None where the source has no time base."""
    image: GreyImage
    """Grey levels, shape (rows, columns), read-only."""


class FrameSource(Protocol):
    """Frames in a fixed order, each of the same shape: a video, an image, a folder of images."""

    name: str
    """What to call it."""
    frame_rate_hz: float | None
    """Frames a second; None where there is no time base."""
    shape: tuple[int, int]
    """(rows, columns) of every frame."""
    warnings: tuple[str, ...]
    """What the user should know about it, one sentence each."""
    description: str = ""
    """What was read, in words: "AVI, FFV1, 640×480 px, 8 bit grey, 60 frames/s"."""
    bit_depth: int = 8
    """Significant bits of a grey level: 8, 10, 12, 16; 32 for float."""
    index: bytes | None = None
    """What opening had to find out in the file (time stamps, key frames …): ``open_source(path,
    index)`` opens it again at once. None where opening is cheap. An index that does not fit the
    file is ignored.
    """

    def __len__(self) -> int: ...

    def frame(self, index: int) -> Frame:
        """Read frame ``index``, 0 ≤ index < len.

        Raises
        ------
        InputError
            If this frame cannot be read; other frames may still be.
        IndexError
            If there is no such frame.
        """
        ...

    def reopen(self) -> Self:
        """Open the same frames once more, with nothing left of what was read before.

        A reader that keeps a place in its file opens the file again.
        """
        return copy.copy(self)

    def close(self) -> None:
        """Close the file. Closing twice does no harm."""
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
    """Frame rate with its unit, to five digits: "60 frames/s", "1 frame/s", "29.97 frames/s"."""
    is_whole = rate_hz == round(rate_hz) or rate_hz >= 10_000
    figure = f"{rate_hz:.0f}" if is_whole else f"{rate_hz:.5g}"
    return f"{figure} frame{'s' * (figure != '1')}/s"


def to_grey(image: npt.NDArray[Any]) -> GreyImage:
    """Grey levels of a decoded picture, shape (rows, columns).

    Parameters
    ----------
    image
        Shape (rows, columns) or (rows, columns, 1 … 4) in OpenCV's order B, G, R, alpha. Colour
        becomes luminance, alpha is dropped. uint8 and uint16 keep their levels; every other type
        becomes float32.
    """
    if image.dtype not in (np.uint8, np.uint16):
        image = image.astype(np.float32)
    if image.ndim == 2:
        return image
    if image.shape[2] < 3:
        return np.ascontiguousarray(image[..., 0])
    return np.asarray(cv2.cvtColor(np.ascontiguousarray(image[..., :3]), cv2.COLOR_BGR2GRAY))
