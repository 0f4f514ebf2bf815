"""Time to read a frame while the operator scrubs through a 640×480 recording.

Run as ``python tests/benchmarks/scrub_video.py [frames]``. Recordings are made by ffmpeg.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import imageio_ffmpeg
import numpy as np

from labapp.media.formats.video import VideoSource

ROWS, COLUMNS = 480, 640
SCRUBBED = 100
FORMATS = {
    "mjpg.avi": (["-c:v", "mjpeg", "-q:v", "3", "-pix_fmt", "yuvj420p"], 30.0),
    "ffv1.mkv": (["-c:v", "ffv1", "-pix_fmt", "gray"], 120.0),
    "ffv1.avi": (["-c:v", "ffv1", "-pix_fmt", "gray"], 120.0),
    "h264.mp4": (["-c:v", "libx264", "-pix_fmt", "yuv420p", "-preset", "veryfast"], None),
}
"""Options of ffmpeg for each recording, and the longest time for a frame, ms."""


def write(folder: Path, frames: int) -> None:
    """Write one recording per format: a matrix of dots that drifts over noise."""
    rng = np.random.default_rng(0)
    v, u = np.mgrid[:ROWS, :COLUMNS]
    noise = rng.normal(25, 6, (ROWS + 64, COLUMNS + 64))
    programs = [
        subprocess.Popen(
            [
                *(imageio_ffmpeg.get_ffmpeg_exe(), "-v", "error", "-f", "rawvideo"),
                *("-pix_fmt", "gray", "-s", f"{COLUMNS}x{ROWS}", "-r", "60", "-i", "-"),
                *(*options, str(folder / name)),
            ],
            stdin=subprocess.PIPE,
        )
        for name, (options, _) in FORMATS.items()
    ]
    for k in range(frames):
        shift = 10 * np.sin(k / 30)
        lattice = np.cos(np.pi * (u - shift) / 25) * np.cos(np.pi * (v + shift) / 25)
        down, right = rng.integers(0, 64, 2)
        picture = noise[down : down + ROWS, right : right + COLUMNS] + 190 * lattice**20
        content = picture.clip(0, 255).astype(np.uint8).tobytes()
        for program in programs:
            assert program.stdin is not None
            program.stdin.write(content)
    for program in programs:
        program.communicate()
        assert program.returncode == 0


def milliseconds(work: Callable[[], object]) -> float:
    """Return the time of ``work``, ms."""
    start = time.perf_counter()
    work()
    return 1000 * (time.perf_counter() - start)


def measure(path: Path, bar_ms: float | None) -> None:
    """Print the times to open, play and scrub a recording."""
    source = VideoSource(path)
    index = source.index
    source.close()
    first_ms = milliseconds(lambda: VideoSource(path).close())
    again_ms = milliseconds(lambda: VideoSource(path, index).close())
    with VideoSource(path, index) as source:
        drawn = np.random.default_rng(1).integers(0, len(source), SCRUBBED).tolist()
        played = milliseconds(lambda: [source.frame(k) for k in range(SCRUBBED)]) / SCRUBBED
        before = time.process_time()
        each = [milliseconds(lambda k=k: source.frame(k)) for k in drawn]
        busy = 1000 * (time.process_time() - before) / SCRUBBED
    scrubbed = float(np.median(each))
    bar = "" if bar_ms is None else f" (at most {bar_ms:g}: {'ok' if scrubbed <= bar_ms else 'NO'})"
    print(
        f"{path.name}: scrubbing {scrubbed:.1f} ms a frame{bar}, 95 % {np.quantile(each, 0.95):.1f}"
        f", of the processor {busy:.1f}"
        f"; in order {played:.1f} ms; ratio {scrubbed / played:.1f}; "
        f"opening {first_ms:.0f} ms, with index {again_ms:.0f} ms, {len(index or b'')} bytes"
    )


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as folder:
        write(Path(folder), int(sys.argv[1]) if len(sys.argv) > 1 else 2000)
        for name, (_, bar_ms) in FORMATS.items():
            measure(Path(folder) / name, bar_ms)
