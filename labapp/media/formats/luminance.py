"""Grey levels of decoded video frames of any pixel format."""

from __future__ import annotations

import functools
from typing import Any

import numpy as np
import numpy.typing as npt
from av.video.frame import VideoFrame

from labapp.media.base import GreyImage, to_grey

WHOLE_BITS = (8, 9, 10, 12, 14, 16)
"""Bits of the formats that store a grey level in the lowest bits of one or two bytes."""


def bit_depth_of(frame: VideoFrame) -> int:
    """Return the significant bits of the grey levels of `grey_of`."""
    bits = frame.format.components[0].bits
    return bits if _has_luminance(frame) else 8 if bits <= 8 else 16


def grey_of(frame: VideoFrame) -> GreyImage:
    """Return the grey levels of a decoded frame, shape (rows, columns), rotated by its metadata.

    Grey levels are unchanged; for Y′CbCr the luminance is used and, if limited to 16 … 235
    (ITU-R BT.601), expanded to the full range; colours are converted by `to_grey`.
    """
    bits = frame.format.components[0].bits
    if not _has_luminance(frame):
        if not frame.format.is_rgb and not frame.format.has_palette:
            return grey_of(frame.reformat(format="yuv444p" if bits <= 8 else "yuv444p16le"))
        image = to_grey(frame.to_ndarray(format="bgr24" if bits <= 8 else "bgr48le"))
        return _turned(image, frame.rotation)
    plane = frame.planes[0]
    levels: npt.NDArray[Any] = np.frombuffer(memoryview(plane), np.uint8)
    levels = levels.reshape(plane.height, -1)
    if bits > 8:
        levels = levels.view(">u2" if frame.format.is_big_endian else "<u2").astype(np.uint16)
    levels = levels[:, : frame.width]
    full = frame.format.name.startswith(("gray", "ya", "yuvj")) or int(frame.color_range) == 2
    return _turned(levels.copy() if full else _full_range(bits)[levels], frame.rotation)


def _has_luminance(frame: VideoFrame) -> bool:
    """Whether the first plane contains the grey levels only."""
    name = frame.format.name
    planar = name.startswith("yuv") and frame.format.is_planar
    grey = name.startswith("gray") and not name.startswith("grayf")
    known = planar or grey or name in {"nv12", "nv16", "nv21", "nv24"}
    return known and frame.format.components[0].bits in WHOLE_BITS


def _turned(image: GreyImage, rotation_deg: int) -> GreyImage:
    turned = np.rot90(image, round(rotation_deg / 90)) if rotation_deg else image
    return np.ascontiguousarray(turned)


@functools.cache
def _full_range(bits: int) -> npt.NDArray[Any]:
    """Return the full-range level of every limited level, shape (2^bits,)."""
    top = 2**bits - 1
    unit = 2 ** (bits - 8)
    levels: npt.NDArray[Any] = np.rint((np.arange(top + 1) - 16 * unit) * (top / (219 * unit)))
    levels = levels.clip(0, top).astype(np.uint8 if bits == 8 else np.uint16)
    return levels
