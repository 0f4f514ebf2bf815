"""Writing of lossless video that remains readable when truncated.

NUT (docs/adr/0015): every frame is written immediately, with its own time stamp in µs.
"""

from __future__ import annotations

import errno
from fractions import Fraction
from pathlib import Path
from typing import Literal, cast

import av
import numpy as np
from av.error import FFmpegError
from av.video.stream import VideoStream

from labapp.errors import os_errors_as_input
from labapp.files import ByteFile, write_all
from labapp.media.base import GreyImage

Codec = Literal["ffv1", "raw"]

TICKS_HZ = 1_000_000

BUFFER_BYTE = 1 << 22
"""Size of the output buffer; smaller frames are written at once."""

FFV1 = {"level": "3", "slices": "4", "slicecrc": "1", "g": "1", "context": "0"}
"""Intra frames only, four slices for four threads, each with a checksum."""


class WrongFrame(ValueError):
    """A frame has the wrong format and was discarded; the next one may be valid."""


class _CompleteWriter:
    """Continues partial writes, which occur when a disk is nearly full."""

    def __init__(self, file: ByteFile) -> None:
        self._file = file
        self.close = file.close

    def write(self, content: bytes) -> int:
        """Write all of it, or raise OSError."""
        write_all(self._file, content)
        return len(content)


class NutWriter:
    """Writer of a video in NUT.

    Parameters
    ----------
    shape
        (rows, columns) of every frame.
    bit_depth
        Significant bits of a grey level: up to 8 for uint8, else for uint16.
    rate_hz
        Frame rate in the header, Hz; each frame has its own time stamp.
    codec
        ``ffv1``: about half the size; ``raw``: uncompressed.
    file
        Written instead of a file at ``path``.

    Raises
    ------
    InputError
        If the file exists already or cannot be created.
    """

    def __init__(
        self,
        path: Path,
        shape: tuple[int, int],
        bit_depth: int,
        rate_hz: float,
        codec: Codec = "ffv1",
        threads: int = 2,
        file: ByteFile | None = None,
    ) -> None:
        self.frames = 0
        self._file = _CompleteWriter(_create(path) if file is None else file)
        self._shape, self._top = shape, 2**bit_depth - 1
        self._dtype = np.uint8 if bit_depth <= 8 else np.uint16
        # No index at the end, which would take 240 bytes of memory per frame.
        options = {"flush_packets": "1", "write_index": "0"}
        self._container = av.open(
            self._file, "w", format="nut", options=options, buffer_size=BUFFER_BYTE
        )
        rate = Fraction(rate_hz).limit_denominator(1000) or Fraction(1)
        name = "ffv1" if codec == "ffv1" else "rawvideo"
        stream = cast(VideoStream, self._container.add_stream(name, rate=rate))
        stream.height, stream.width = shape
        self._format = stream.pix_fmt = (
            "gray" if bit_depth <= 8 else f"gray{_levels(bit_depth, codec)}le"
        )
        stream.time_base = stream.codec_context.time_base = Fraction(1, TICKS_HZ)
        if codec == "ffv1":
            # Golomb-Rice is the faster coder, but for 8 bits only.
            coder = {"coder": "0" if bit_depth <= 8 else "1"}
            stream.codec_context.options = FFV1 | coder
            stream.codec_context.thread_count = threads
        self._stream = stream
        self._last = -1

    def write(self, image: GreyImage, time_s: float) -> None:
        """Write a frame to the file without buffering.

        Parameters
        ----------
        image
            Grey levels of the right shape and type.
        time_s
            Time since the first frame, s; at least 1 µs after the previous one.

        Raises
        ------
        OSError
            If it cannot be written; previous frames are intact.
        WrongFrame
            If it has another shape or type, or levels with more bits.
        """
        if image.shape != self._shape or image.dtype != self._dtype or image.max() > self._top:
            raise WrongFrame(f"a frame of {image.shape}, {image.dtype}, up to {image.max()}")
        levels = np.ascontiguousarray(image)
        frame = av.VideoFrame.from_ndarray(levels, format=self._format)
        self._last = max(self._last + 1, round(time_s * TICKS_HZ))
        frame.pts, frame.time_base = self._last, Fraction(1, TICKS_HZ)
        for packet in self._stream.encode(frame):
            self._container.mux(packet)
        self.frames += 1

    def close(self) -> None:
        """End the video.

        Raises
        ------
        OSError
            If the end cannot be written; the file is readable without it.
        """
        try:
            self._container.close()
        except FFmpegError as error:
            raise OSError(errno.EIO, "the end of the video cannot be written") from error
        finally:
            self._file.close()


def _levels(bit_depth: int, codec: Codec) -> int:
    """Return the bits of the pixel format, which FFmpeg supports; 16 for raw video."""
    return 16 if codec == "raw" else next(n for n in (10, 12, 14, 16) if n >= bit_depth)


def _create(path: Path) -> ByteFile:
    with os_errors_as_input(path, "recording", "a file that can be made"):
        return path.open("xb", buffering=0)
