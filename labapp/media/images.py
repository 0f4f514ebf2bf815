"""Frames from image files: one picture, a folder of them, or a TIFF stack."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from labapp.errors import InputError
from labapp.media.base import Frame, FrameSource, GreyImage, check_index, to_grey

IMAGE_SUFFIXES = frozenset(
    ".png .tif .tiff .bmp .jpg .jpeg .jp2 .webp .pgm .ppm .pbm .pnm .pfm .exr".split()
)
AN_IMAGE = "a whole image: PNG, TIFF, BMP, JPEG, PGM"


@dataclass(frozen=True)
class Page:
    """One picture in one file; ``number`` is None for a file that is not a stack."""

    path: Path
    number: int | None = None

    def __str__(self) -> str:
        return str(self.path) if self.number is None else f"{self.path}, page {self.number}"


class ImageSequence(FrameSource):
    """Pictures of one shape, read one at a time.

    Parameters
    ----------
    pages
        The pictures in order, at least one.
    name
        What to call them.

    Raises
    ------
    InputError
        If not one of them can be read.
    """

    frame_rate_hz = None
    warnings: tuple[str, ...] = ()

    def __init__(self, pages: Sequence[Page], name: str) -> None:
        self.name = name
        self._pages = tuple(pages)
        self.shape = self._first_shape()

    def _first_shape(self) -> tuple[int, int]:
        refused: list[InputError] = []
        for page in self._pages:
            try:
                rows, columns = read_image(page).shape
            except InputError as error:
                refused.append(error)
            else:
                return rows, columns
        raise refused[0]

    def __len__(self) -> int:
        return len(self._pages)

    def frame(self, index: int) -> Frame:
        """Read picture ``index``; see `FrameSource.frame`."""
        check_index(self, index)
        page = self._pages[index]
        image = read_image(page)
        if image.shape != self.shape:
            rows, columns = self.shape
            raise InputError(
                page.path,
                "size",
                f"{image.shape[1]}×{image.shape[0]} px",
                f"{columns}×{rows} px like the pictures before it",
            )
        return Frame(index, None, image)


def open_folder(path: Path) -> ImageSequence:
    """Open every image in a folder, in natural order (``2.png`` before ``10.png``)."""
    try:
        names = sorted(
            (
                entry
                for entry in path.iterdir()
                if entry.suffix.lower() in IMAGE_SUFFIXES and not entry.name.startswith(".")
            ),
            key=lambda entry: natural_key(entry.name),
        )
    except OSError as error:
        raise InputError(path, "folder", error.strerror, "a folder that may be read") from error
    if not names:
        raise InputError(
            path,
            "folder",
            "no image in it",
            "a folder of images (PNG, TIFF, BMP, JPEG, PGM), or name a video file",
        )
    return ImageSequence([Page(entry) for entry in names], path.name or str(path))


def open_image(path: Path) -> ImageSequence:
    """Open an image file; each page of a TIFF stack is a frame."""
    count = cv2.imcount(str(path)) if path.suffix.lower() in {".tif", ".tiff"} else 1
    pages = [Page(path, number) for number in range(count)] if count > 1 else [Page(path)]
    return ImageSequence(pages, path.name)


def read_image(page: Page) -> GreyImage:
    """Grey levels of one picture, shape (rows, columns).

    Raises
    ------
    InputError
        If it cannot be opened, is not a whole image, or holds NaN or infinity.
    """
    image = _decode(page)
    if image is None or image.size == 0:
        raise InputError(page.path, "content", "cannot be decoded", AN_IMAGE)
    grey = to_grey(image)
    if grey.dtype == np.float32 and not np.isfinite(grey).all():
        raise InputError(page.path, "grey levels", "NaN or infinity", "finite grey levels")
    return grey


def _decode(page: Page) -> npt.NDArray[Any] | None:
    try:
        if page.number is not None:
            _, images = cv2.imreadmulti(str(page.path), page.number, 1, flags=cv2.IMREAD_UNCHANGED)
            return images[0] if images else None
        # Read here rather than by OpenCV: it says why a file cannot be opened.
        content = np.fromfile(page.path, np.uint8)
        if not content.size:
            raise InputError(page.path, "size", "0 bytes", AN_IMAGE)
        return cv2.imdecode(content, cv2.IMREAD_UNCHANGED)
    except OSError as error:
        raise InputError(page.path, "file", error.strerror, "a file that may be read") from error
    except cv2.error:
        return None


def natural_key(name: str) -> list[tuple[int, int, str]]:
    """Sort key that takes digits as numbers: ``frame2`` before ``frame10``."""
    return [
        (0, int(part), "") if part.isdecimal() else (1, 0, part.casefold())
        for part in re.split(r"(\d+)", name)
        if part
    ]
