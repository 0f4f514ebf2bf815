"""Frames from image files: one picture, or a folder of them."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from labapp.errors import InputError
from labapp.media.base import GreyImage, to_grey
from labapp.media.stored import StoredFrames, finite, regular_size
from labapp.media.tiff import TIFF_MAGICS, TIFF_SUFFIXES, TiffStack
from labapp.pixels import MOST_PIXELS

IMAGE_SUFFIXES = frozenset(
    ".png .bmp .jpg .jpeg .jp2 .webp .pgm .ppm .pbm .pnm .pfm .exr".split()
) | set(TIFF_SUFFIXES)
AN_IMAGE = f"a whole image of at most {MOST_PIXELS} px: PNG, TIFF, BMP, JPEG, PGM"


class ImageSequence(StoredFrames):
    """Pictures of one shape, read one at a time.

    Parameters
    ----------
    path
        The file or folder, for its name.
    pictures
        The files in order, at least one.

    Raises
    ------
    InputError
        If not one of them can be read.
    """

    def __init__(self, path: Path, pictures: Sequence[Path]) -> None:
        self._pictures = tuple(pictures)
        image = self._first_whole()
        kinds = sorted({picture.suffix.lstrip(".").upper() for picture in self._pictures} - {""})
        kind = " and ".join(kinds) or "image"
        super().__init__(
            path,
            kind if len(self._pictures) == 1 else f"{len(self._pictures)} pictures, {kind}",
            len(self._pictures),
            (image.shape[0], image.shape[1]),
            8 * image.dtype.itemsize,
        )

    def _first_whole(self) -> GreyImage:
        refused: list[InputError] = []
        for picture in self._pictures:
            try:
                return read_image(picture)
            except InputError as error:
                refused.append(error)
        raise refused[0]

    def _grey(self, index: int) -> GreyImage:
        picture = self._pictures[index]
        image = read_image(picture)
        if image.shape != self.shape:
            rows, columns = self.shape
            raise InputError(
                picture,
                "size",
                f"{image.shape[1]}×{image.shape[0]} px",
                f"{columns}×{rows} px like the pictures before it",
            )
        return image


def images_in(path: Path) -> list[Path]:
    """The image files in a folder, in natural order (``2.png`` before ``10.png``)."""
    return [entry for entry in files_in(path) if entry.suffix.lower() in IMAGE_SUFFIXES]


def files_in(path: Path) -> list[Path]:
    """What is in a folder, in natural order, without hidden files."""
    try:
        entries = [entry for entry in path.iterdir() if not entry.name.startswith(".")]
    except OSError as error:
        raise InputError(path, "folder", error.strerror, "a folder that may be read") from error
    return sorted(entries, key=lambda entry: natural_key(entry.name))


def read_image(path: Path) -> GreyImage:
    """Grey levels of one picture in a file, shape (rows, columns).

    Raises
    ------
    InputError
        If it cannot be opened, is not a whole image, holds several, or NaN or infinity.
    """
    # Read here rather than by OpenCV: it says why a file cannot be opened.
    try:
        regular_size(path)
        content = np.fromfile(path, np.uint8)
    except OSError as error:
        raise InputError(path, "file", error.strerror, "a file that may be read") from error
    if not content.size:
        raise InputError(path, "size", "0 bytes", AN_IMAGE)
    if content[:4].tobytes() in TIFF_MAGICS:
        with TiffStack(path) as stack:
            if len(stack) > 1:
                raise InputError(
                    path, "pages", len(stack), "one picture a file, or open the stack itself"
                )
            return stack.frame(0).image
    try:
        image = cv2.imdecode(content, cv2.IMREAD_UNCHANGED)
    except cv2.error:
        image = None
    if image is None or image.size == 0:
        raise InputError(path, "content", "cannot be decoded", AN_IMAGE)
    return finite(path, to_grey(image))


def natural_key(name: str) -> list[tuple[int, int, str]]:
    """Sort key that takes digits as numbers: ``frame2`` before ``frame10``."""
    return [
        (0, int(part), "") if part.isdecimal() else (1, 0, part.casefold())
        for part in re.split(r"(\d+)", name)
        if part
    ]
