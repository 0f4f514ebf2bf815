"""Frames from images, folders, stacks and videos: `open_source` opens any of them."""

from __future__ import annotations

import os
from pathlib import Path

import cv2

from labapp.errors import InputError
from labapp.media.base import Frame, FrameSource, GreyImage
from labapp.media.images import IMAGE_SUFFIXES, open_folder, open_image
from labapp.media.quiet import quiet_opencv
from labapp.media.video import VideoSource

__all__ = ["Frame", "FrameSource", "GreyImage", "open_source"]


def open_source(path: str | os.PathLike[str]) -> FrameSource:
    """Open an image, a folder of images, a TIFF stack or a video.

    Raises
    ------
    InputError
        If there is no such file, or no frame can be read from it.
    """
    quiet_opencv()
    path = Path(path)
    try:
        size = path.stat().st_size
        if path.is_dir():
            return open_folder(path)
        with path.open("rb"):
            pass
    except OSError as error:
        raise InputError(
            path, "source", error.strerror, "an image, a folder of images or a video"
        ) from error
    if size == 0:
        raise InputError(path, "size", "0 bytes", "an image or a video with something in it")
    if path.suffix.lower() in IMAGE_SUFFIXES or cv2.haveImageReader(str(path)):
        return open_image(path)
    return VideoSource(path)
