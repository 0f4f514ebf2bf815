"""Frames from images, folders, stacks, videos and high-speed recordings: `open_source`."""

from __future__ import annotations

import os
from pathlib import Path

import cv2

from labapp.errors import InputError, os_errors_as_input
from labapp.files import regular_size
from labapp.media.base import Frame, FrameSource, GreyImage
from labapp.media.formats.cine import CINE_MAGIC, CineSource
from labapp.media.formats.images import IMAGE_SUFFIXES, ImageSequence, files_in, images_in
from labapp.media.formats.numpy_stack import NPY_MAGIC, ZIP_MAGIC, NumpyStack
from labapp.media.formats.photron import PHOTRON_SUFFIXES, PhotronSource
from labapp.media.formats.tiff import TIFF_MAGICS, TIFF_SUFFIXES, TiffStack
from labapp.media.quiet import quiet_opencv

__all__ = ["Frame", "FrameSource", "GreyImage", "open_source", "read_picture"]

VIDEO_SUFFIXES = frozenset(
    ".avi .mkv .mp4 .m4v .mov .nut .mpg .mpeg .ts .wmv .asf .webm .ogv .flv .mxf .dv .gif".split()
)
RECORDING_SUFFIXES = VIDEO_SUFFIXES | {".cine", ".npy", ".npz"} | PHOTRON_SUFFIXES

NAME_ONE = "name the one to open, or measure them all as a study"
"""Advice for a folder with several recordings."""


def open_source(path: str | os.PathLike[str], index: bytes | None = None) -> FrameSource:
    """Open a recording; its type is recognised by its content, or else by its name.

    Parameters
    ----------
    path
        An image, a folder of images or with one recording in it, a TIFF stack, a video, a Phantom
        .cine, a Photron .mraw or its header, a NumPy .npy or .npz.
    index
        The `FrameSource.index` of an earlier opening, with which a video need not be read again.

    Raises
    ------
    InputError
        If there is no such file, or no frame can be read from it.
    """
    quiet_opencv()
    path = Path(path)
    with os_errors_as_input(path, "source", "an image, a folder of images or a video"):
        if path.is_dir():
            return _open_folder(path, index)
        size = regular_size(path)
        with path.open("rb") as file:
            head = file.read(12)
    if size == 0:
        raise InputError(path, "size", "0 bytes", "an image or a video with something in it")
    return _by_content(path, head, index) or _by_name(path, index)


def read_picture(path: str | os.PathLike[str]) -> GreyImage:
    """Read a picture, or the first frame of a recording; raises like `open_source`."""
    with open_source(path) as source:
        return source.frame(0).image


def _by_content(path: Path, head: bytes, index: bytes | None) -> FrameSource | None:
    """Open a file whose first bytes identify its format; None for other files."""
    if head == b"SQLite forma":
        wanted = "a recording; sessions are for labapp session: labapp session --help"
        raise InputError(path, "content", "a session, or another database", wanted)
    if head[:4] in TIFF_MAGICS:
        return TiffStack(path)
    if head[:4] == CINE_MAGIC:
        return CineSource(path)
    if head[:6] == NPY_MAGIC:
        return NumpyStack(path, archive=False)
    if head[:4] == ZIP_MAGIC:
        return NumpyStack(path, archive=True)
    if head[:4] == b"GIF8" or (head[:4] == b"RIFF" and head[8:] != b"WEBP"):
        return _video(path, index)
    return None


def _by_name(path: Path, index: bytes | None) -> FrameSource:
    suffix = path.suffix.lower()
    if suffix in PHOTRON_SUFFIXES:
        return PhotronSource(path)
    if suffix == ".cine":
        return CineSource(path)
    if suffix in (".npy", ".npz"):
        return NumpyStack(path, archive=suffix == ".npz")
    if suffix in TIFF_SUFFIXES:
        return TiffStack(path)
    if suffix in IMAGE_SUFFIXES or cv2.haveImageReader(str(path)):
        return ImageSequence(path, [path])
    return _video(path, index)


def _video(path: Path, index: bytes | None) -> FrameSource:
    # Imported on use, as PyAV takes as long to import as NumPy.
    from labapp.media.formats.video import VideoSource

    return VideoSource(path, index)


def _open_folder(path: Path, index: bytes | None) -> FrameSource:
    """Open the images in a folder, or the one recording in it."""
    images = images_in(path)
    if len(images) > 1:
        return ImageSequence(path, images)
    recordings = [entry for entry in files_in(path) if entry.suffix.lower() in RECORDING_SUFFIXES]
    headers = {entry.stem for entry in recordings if entry.suffix.lower() in (".cih", ".cihx")}
    # A Photron recording is two files; its header represents both.
    recordings = [
        entry
        for entry in recordings
        if entry.suffix.lower() != ".mraw" or entry.stem not in headers
    ]
    found = [*images, *recordings]
    if len(found) == 1:
        return open_source(found[0], index)
    if found:
        names = ", ".join(entry.name for entry in found)
        raise InputError(path, "folder", names, f"one recording in it; {NAME_ONE}")
    wanted = "a folder of images (PNG, TIFF, BMP, JPEG, PGM) or with one video in it"
    if any(entry.is_dir() for entry in path.iterdir()):
        raise InputError(
            path, "folder", "folders, but no image or recording", f"{wanted}; {NAME_ONE}"
        )
    raise InputError(path, "folder", "no image or recording in it", wanted)
