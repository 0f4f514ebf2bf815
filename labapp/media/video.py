"""Frames from video files, decoded by FFmpeg through OpenCV."""

from __future__ import annotations

import math
from pathlib import Path

import cv2
import numpy as np

from labapp.core.values import FloatArray
from labapp.errors import InputError
from labapp.media.base import Frame, FrameSource, GreyImage, check_index, to_grey

FAR_FRAMES = 60
"""A jump forward of more than this is made by seeking, a shorter one by decoding on."""

DAMAGED_FRAMES = 50
"""More frames than this that cannot be decoded, one after the other, are the end."""

GREY_FORMATS = frozenset(
    int.from_bytes(code, "little") for code in (b"Y800", b"GREY", b"Y8  ", b"Y1\x00\x10")
)
"""Pixel formats (8 and 16 bit) that OpenCV hands over as they are with CONVERT_RGB = 0."""

A_VIDEO = "a video that FFmpeg can decode: AVI, MKV or MP4 with FFV1, MJPG, H.264 or raw frames"


class VideoSource(FrameSource):
    """A video whose frames are known by their time stamps.

    The number of frames in an AVI, whose rate is constant, is believed when a seek to the last
    finds a frame with the last one's time and nothing after it; everything else is counted by
    decoding. Where a seek has gone is told by the stamp of the frame found there. Stamps that do
    not grow (H.264 in AVI) tell nothing: then a jump back decodes from the start.

    Parameters
    ----------
    path
        The file.

    Raises
    ------
    InputError
        If there is not one whole frame in it.
    """

    def __init__(self, path: Path) -> None:
        self.name = path.name
        self._path = path
        self._capture = _open(path)
        try:
            self._reliable = False
            self._next = 0
            rate = self._capture.get(cv2.CAP_PROP_FPS)
            self.frame_rate_hz: float | None = rate if math.isfinite(rate) and rate > 0 else None
            claimed = int(self._capture.get(cv2.CAP_PROP_FRAME_COUNT))
            self._stamp_ms = self._stamps(claimed)
            if not len(self._stamp_ms):
                raise InputError(path, "frames", "not one that is whole", A_VIDEO)
            self._reliable = bool((np.diff(self._stamp_ms) > 0).all())
            self.warnings = self._ends_early(claimed)
            self._time_s = self._times()
            self._rewind()
            self._grab()
            rows, columns = self._retrieve(0).shape
            self.shape = (rows, columns)
        except BaseException:
            self.close()
            raise

    def __len__(self) -> int:
        return len(self._stamp_ms)

    def close(self) -> None:
        """Let go of the file. Closing twice does no harm."""
        self._capture.release()

    def frame(self, index: int) -> Frame:
        """Read frame ``index``; see `FrameSource.frame`. Reading in order never seeks."""
        check_index(self, index)
        if not self._next - 1 <= index <= self._next + FAR_FRAMES:
            self._jump(index)
        while self._next <= index:
            if not self._grab():
                self._rewind()
                break
        if self._next != index + 1:
            raise self._unreadable(index)
        time_s = None if self._time_s is None else float(self._time_s[index])
        return Frame(index, time_s, self._retrieve(index))

    def _rewind(self) -> None:
        self._capture.release()
        self._capture = _open(self._path)
        self._next = 0

    def _grab(self) -> bool:
        """Decode the next frame that can be; False at the end.

        With reliable stamps a frame that cannot be decoded is passed over without those after it
        taking its number.
        """
        if not any(self._capture.grab() for _ in range(DAMAGED_FRAMES)):
            return False
        if self._reliable:
            half = np.diff(self._stamp_ms).min(initial=np.inf) / 2
            self._next = int(np.searchsorted(self._stamp_ms, self._now() + half))
        else:
            self._next += 1
        return True

    def _jump(self, index: int) -> None:
        """Get to ``index`` or before it; where a seek goes is known by the stamp found there."""
        if self._reliable:
            self._capture.set(cv2.CAP_PROP_POS_FRAMES, index)
            if self._grab() and self._next <= index + 1:
                return
        self._rewind()

    def _now(self) -> float:
        """Time stamp of the frame grabbed last, ms."""
        return float(self._capture.get(cv2.CAP_PROP_POS_MSEC))

    def _retrieve(self, index: int) -> GreyImage:
        retrieved, image = self._capture.retrieve()
        if not retrieved:
            raise self._unreadable(index)
        return to_grey(image)

    def _unreadable(self, index: int) -> InputError:
        return InputError(self._path, f"frame {index}", "cannot be decoded", "a whole frame")

    def _stamps(self, claimed: int) -> FloatArray:
        """Time stamp of every frame, shape (n,), ms."""
        if _is_avi(self._path):
            self._capture.set(cv2.CAP_PROP_POS_FRAMES, claimed - 1)
            if self._capture.grab():
                last = np.array([self._now()])
                if self._fits(last, claimed) and not self._capture.grab():
                    return self._regular(claimed)
        self._rewind()
        counted = []
        while self._grab():
            counted.append(self._now())
        stamps = np.array(counted)
        # With the last frame in its place, those missing are holes: the others keep their numbers.
        return self._regular(claimed) if self._fits(stamps, claimed) else stamps

    def _fits(self, stamp_ms: FloatArray, claimed: int) -> bool:
        """Whether frames stand at multiples of the interval, the last at ``claimed`` − 1."""
        if self.frame_rate_hz is None or not len(stamp_ms):
            return False
        place = stamp_ms / 1000 * self.frame_rate_hz
        on_grid = np.abs(place - place.round()).max() < 0.25
        return bool(on_grid and round(place[-1]) == claimed - 1)

    def _regular(self, count: int) -> FloatArray:
        assert self.frame_rate_hz is not None
        return np.arange(count, dtype=np.float64) * (1000 / self.frame_rate_hz)

    def _ends_early(self, claimed: int) -> tuple[str, ...]:
        # Fewer frames over the whole time are a varying rate, not an early end.
        last = self._stamp_ms[-1] / 1000 * (self.frame_rate_hz or 0) if self._reliable else 0
        if max(len(self), round(last) + 1) >= claimed:
            return ()
        return (
            f"{self.name} ends early: its header says {claimed} frames, {len(self)} of them whole",
        )

    def _times(self) -> FloatArray | None:
        """Time of every frame since the first, shape (n,), s."""
        elapsed: FloatArray = (self._stamp_ms - self._stamp_ms[0]) / 1000
        if self.frame_rate_hz is None:
            return elapsed if self._reliable else None
        regular: FloatArray = self._regular(len(self)) / 1000
        # Containers round stamps (Matroska: to 1 ms); a frame later than that was later.
        if self._reliable and (np.abs(elapsed - regular) * self.frame_rate_hz >= 0.5).any():
            return elapsed
        return regular


def _is_avi(path: Path) -> bool:
    with path.open("rb") as file:
        return file.read(4) == b"RIFF"


def _open(path: Path) -> cv2.VideoCapture:
    # FFmpeg only: other back ends take names with digits for numbered pictures.
    capture = cv2.VideoCapture(str(path), cv2.CAP_FFMPEG)
    if not capture.isOpened():
        raise InputError(path, "content", "not a video, or its index is missing", A_VIDEO)
    if int(capture.get(cv2.CAP_PROP_CODEC_PIXEL_FORMAT)) in GREY_FORMATS:
        capture.set(cv2.CAP_PROP_CONVERT_RGB, 0)
    return capture
