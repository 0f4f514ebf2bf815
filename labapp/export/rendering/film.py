"""Films of the pool in 3-D, in true time, with a common view and colour scale."""

from __future__ import annotations

import contextlib
import os
import textwrap
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Executor
from dataclasses import replace
from fractions import Fraction
from pathlib import Path
from typing import cast

import av
import numpy as np
from av.container import OutputContainer
from av.error import FFmpegError
from av.video.stream import VideoStream

from labapp.core.pipeline import Measurement
from labapp.core.values import FloatArray, IntArray
from labapp.errors import InputError
from labapp.export.frame_result import FrameResult
from labapp.export.rendering.scene import Scene, empty_scene, scene_of
from labapp.export.rendering.studio import Picture, draw_there
from labapp.files import atomic_file
from labapp.simulation.parallel import in_order

CODEC = "mpeg4"
QUALITY = 2
"""Quantiser from 1 (best) to 31."""

TICKS_HZ = 60_000
"""Time base of a film, ticks per second; at most 65535 in MPEG-4."""

UNTIMED_HZ = 10.0
"""Default frame rate if the recording has no time base."""

AHEAD = 3
"""Number of pictures drawn while one is being written."""

LINE = 60
"""Characters per line of the text shown instead of a surface."""


class Extent:
    """Common extent of all frames of a film, accumulated frame by frame."""

    def __init__(self) -> None:
        self._low, self._high = np.full(3, np.inf), np.full(3, -np.inf)
        self._depth, self._height = np.inf, -np.inf

    def add(self, measurement: Measurement) -> None:
        """Include a frame; one without a surface has no effect."""
        if measurement.reconstruction is None or measurement.measures is None:
            return
        outline, sizes = measurement.reconstruction.boundary.points_mm, measurement.measures
        self._low = np.minimum(self._low, outline.min(axis=0))
        self._high = np.maximum(self._high, outline.max(axis=0))
        self._depth = min(self._depth, sizes.depth_mm)
        self._height = max(self._height, sizes.height_mm)

    @property
    def known(self) -> bool:
        """Whether any frame has a surface."""
        return bool(np.isfinite(self._low).all())

    @property
    def limits(self) -> tuple[float, float]:
        """Lowest and highest point of all frames, mm, for the colour scale."""
        return self._depth, max(self._height, self._depth + 1e-6)

    @property
    def within_mm(self) -> FloatArray:
        """Lowest and highest corner of the bounding box, shape (2, 3), mm."""
        box = np.stack([self._low, self._high])
        box[:, 2] = min(box[0, 2], self._depth), max(box[1, 2], self._height)
        return box


def write_film(
    path: Path,
    measured: Iterable[FrameResult],
    times_s: FloatArray,
    extent: Extent,
    process: Executor,
    progress: Callable[[int], None],
) -> None:
    """Write a film (MP4, MPEG-4) of frames; without a surface, the reason is shown.

    Parameters
    ----------
    path
        Path of the film; written atomically.
    measured
        Result of each frame; consumed a few at a time.
    times_s
        Time of each frame in the film: `film_times`.
    extent
        Common extent of all frames, at least one of which has a surface.
    process
        A `studio.drawing_process`, which has size and view.
    progress
        Called with the number of frames done; may raise to stop, and no file is left then.

    Raises
    ------
    InputError
        If the frame rate is too high for a film.
    ImportError
        Without PyVista.
    BrokenProcessPool
        If nothing can be drawn.
    OSError
        If it cannot be written.
    """
    begun = (process.submit(draw_there, film_scene(each, extent)) for each in measured)

    def counted() -> Iterator[Picture]:
        for done, picture in enumerate(in_order(begun, AHEAD), 1):
            yield picture
            progress(done)

    write_video(path, counted(), times_s)


def film_scene(result: FrameResult, extent: Extent) -> Scene:
    """Return the scene of a frame: its surface, or the reason why there is none."""
    measurement, stamp = result.measurement, f"frame {result.frame}"
    if result.time_s is not None:
        stamp += f", {result.time_s:.4f} s"
    if measurement.reconstruction is None:
        why = f"cannot be measured: {measurement.reason or measurement.status}"
        notice = "\n".join(textwrap.wrap(why, LINE))
        return empty_scene(extent.within_mm, extent.limits, stamp, notice)
    scene = scene_of(measurement.reconstruction, limits=extent.limits)
    return replace(scene, within_mm=extent.within_mm, stamp=stamp)


def film_times(
    frames: Sequence[tuple[int, float | None]], rate_hz: float | None = None
) -> FloatArray:
    """Return the start of each frame in the film and the end of the last, shape (n + 1,), s.

    A frame is shown until the next one, also across omitted frames.

    Parameters
    ----------
    frames
        Number and time, s, of each frame, ascending.
    rate_hz
        Frame rate of the film; None: that of the recording, or 10 Hz if it has no time base.
    """
    times = np.array([np.nan if time_s is None else time_s for _, time_s in frames])
    if rate_hz is not None or not np.isfinite(times).all():
        numbers = np.array([float(frame) for frame, _ in frames])
        step = np.diff(numbers).min(initial=np.inf)
        times = numbers / ((step if np.isfinite(step) else 1.0) * (rate_hz or UNTIMED_HZ))
    least = np.diff(times).min(initial=np.inf)
    last = times[-1] + (least if np.isfinite(least) else 1 / (rate_hz or UNTIMED_HZ))
    return np.asarray(np.append(times, last) - times[0], np.float64)


def write_video(path: Path, pictures: Iterable[Picture], times_s: FloatArray) -> None:
    """Write pictures as a video, atomically.

    Parameters
    ----------
    path
        Path of the file, MP4.
    pictures
        Pictures, B, G, R, each of shape (height, width, 3), both even.
    times_s
        Start of each and end of the last, shape (n + 1,), from 0, ascending, s.

    Raises
    ------
    InputError
        If the frame rate exceeds 60000 Hz.
    OSError
        If it cannot be written.
    """
    ticks = np.round(times_s * TICKS_HZ).astype(np.int64)
    if (np.diff(ticks) < 1).any():
        rate = 1 / np.diff(times_s).min()
        most = f"at most {TICKS_HZ} frames/s: a film that is slower than the recording"
        raise InputError("export", "film_rate_hz", f"{rate:.6g}", most)
    # Written through Python's file, so that a full disk is reported as such.
    with atomic_file(path) as part, part.open("wb") as file:
        container = av.open(file, "w", format="mp4")
        try:
            _encode(container, pictures, ticks)
        except BaseException:
            with contextlib.suppress(FFmpegError, OSError):  # the first failure is reported
                container.close()
            raise
        container.close()
        file.flush()
        os.fsync(file.fileno())


def _encode(container: OutputContainer, pictures: Iterable[Picture], ticks: IntArray) -> None:
    """Encode pictures into a container that is being written."""
    stream: VideoStream | None = None
    for picture, begin, end in zip(pictures, ticks[:-1], ticks[1:], strict=True):
        if stream is None:
            options = {"flags": "+qscale", "global_quality": str(QUALITY * 118)}
            stream = cast(VideoStream, container.add_stream(CODEC, rate=TICKS_HZ, options=options))
            stream.height, stream.width = picture.shape[:2]
            stream.pix_fmt = "yuv420p"
            stream.codec_context.time_base = Fraction(1, TICKS_HZ)
        frame = av.VideoFrame.from_ndarray(picture, format="bgr24")
        frame.pts, frame.time_base = int(begin), Fraction(1, TICKS_HZ)
        for packet in stream.encode(frame):  # the encoder does not buffer frames
            packet.duration = int(end - begin)
            container.mux(packet)
