"""Frames from image files: one picture, or a folder of pictures."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from labapp.errors import InputError, os_errors_as_input
from labapp.files import regular_size
from labapp.media.base import GreyImage, to_grey
from labapp.media.formats.stored import READABLE, StoredFrames, check_shape, finite, first_readable
from labapp.media.formats.tiff import TIFF_MAGICS, TIFF_SUFFIXES, TiffStack
from labapp.pixels import MOST_PIXELS

IMAGE_SUFFIXES = frozenset(
    ".png .bmp .jpg .jpeg .jp2 .webp .pgm .ppm .pbm .pnm .pfm .exr".split()
) | set(TIFF_SUFFIXES)
PNG_MAGIC = b"\x89PNG\r\n\x1a\n"
LARGEST_FILE = 8 * MOST_PIXELS
"""Largest image file, bytes: four samples of 16 bit per pixel."""

AN_IMAGE = f"a complete image of at most {MOST_PIXELS} px: PNG, TIFF, BMP, JPEG, PGM"


class ImageSequence(StoredFrames):
    """Pictures of the same shape, read one at a time.

    Raises
    ------
    InputError
        If none of them can be read.
    """

    def __init__(self, path: Path, pictures: Sequence[Path]) -> None:
        self._pictures = tuple(pictures)
        image = first_readable(lambda index: read_image(self._pictures[index]), len(self._pictures))
        kinds = sorted({picture.suffix.lstrip(".").upper() for picture in self._pictures} - {""})
        kind = " and ".join(kinds) or "image"
        super().__init__(
            path,
            kind if len(self._pictures) == 1 else f"{len(self._pictures)} pictures, {kind}",
            len(self._pictures),
            (image.shape[0], image.shape[1]),
            8 * image.dtype.itemsize,
        )

    def _grey(self, index: int) -> GreyImage:
        picture = self._pictures[index]
        return check_shape(picture, "size", read_image(picture), self.shape, "pictures")


def images_in(path: Path) -> list[Path]:
    """Return the image files in a folder, in natural order (``2.png`` before ``10.png``)."""
    return [entry for entry in files_in(path) if entry.suffix.lower() in IMAGE_SUFFIXES]


def files_in(path: Path) -> list[Path]:
    """Return the entries of a folder, in natural order, without hidden ones."""
    with os_errors_as_input(path, "folder", "a folder that may be read"):
        entries = [entry for entry in path.iterdir() if not entry.name.startswith(".")]
    return sorted(entries, key=lambda entry: natural_key(entry.name))


def read_image(path: Path) -> GreyImage:
    """Read an image file as grey levels, shape (rows, columns).

    Raises
    ------
    InputError
        If it cannot be opened, is not a complete image, or contains several, NaN or infinity.
    """
    # Not read by OpenCV, for specific errors.
    with os_errors_as_input(path, "file", READABLE):
        size = regular_size(path)
        content = path.read_bytes() if size <= LARGEST_FILE else b""
    if size > LARGEST_FILE:
        raise InputError(path, "size", f"{size} bytes", f"at most {LARGEST_FILE} bytes: {AN_IMAGE}")
    if not content:
        raise InputError(path, "size", "0 bytes", AN_IMAGE)
    if content[:4] in TIFF_MAGICS:
        with TiffStack(path) as stack:
            if len(stack) > 1:
                raise InputError(
                    path, "pages", len(stack), "one picture a file, or open the stack itself"
                )
            return stack.frame(0).image
    image = decoded(content)
    if image is None:
        raise InputError(path, "content", "cannot be decoded", AN_IMAGE)
    return finite(path, to_grey(image))


def decoded(content: bytes) -> npt.NDArray[Any] | None:
    """Decode a picture, turned upright by its EXIF data; None if it is damaged or too large.

    Frames of a video are turned by their metadata, too: a picture that calibrates them must match.
    """
    if not content or _is_cut_off(content):
        return None
    flags = cv2.IMREAD_ANYCOLOR | cv2.IMREAD_ANYDEPTH
    try:
        image = cv2.imdecode(np.frombuffer(content, np.uint8), flags)
    except (cv2.error, MemoryError):
        return None
    return image if image is not None and image.size else None


def _is_cut_off(content: bytes) -> bool:
    """Whether a chunk of a PNG exceeds the file, for which OpenCV would allocate memory."""
    at = len(PNG_MAGIC)
    if content[:at] != PNG_MAGIC:
        return False
    while content[at + 4 : at + 8] not in (b"", b"IEND"):
        at += 12 + int.from_bytes(content[at : at + 4], "big")
    return at >= len(content)


def natural_key(name: str) -> list[tuple[int, int, str]]:
    """Return a sort key that compares digits as numbers: ``frame2`` before ``frame10``."""
    return [
        (0, int(part), "") if part.isdecimal() else (1, 0, part.casefold())
        for part in re.split(r"(\d+)", name)
        if part
    ]
