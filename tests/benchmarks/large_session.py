"""A session of many frames: time to open it and to save a correction, and memory.

Run as ``python tests/benchmarks/large_session.py [frames]``: makes a recording (640×480, MJPG) and
a session of it in a temporary folder. Every frame has the result of a single measured one. Each
figure is printed with a simple reference timed in the same run, as machines differ and are busy.
"""

from __future__ import annotations

import itertools
import os
import resource
import sqlite3
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterable
from pathlib import Path

import cv2
import imageio_ffmpeg
import numpy as np

import labapp
from labapp.core.pipeline import start_correction
from labapp.core.rows.correction import Correction
from labapp.session.session import Session

SAMPLE = Path(labapp.__file__).parents[1] / "sample_sessions" / "gtaw"
SAVED = 100


def median_ms(work: Callable[[int], object], times: int) -> float:
    times_s = []
    for number in range(times):
        start_s = time.perf_counter()
        work(number)
        times_s.append(time.perf_counter() - start_s)
    return float(np.median(times_s)) * 1000


def make_recording(path: Path, frames: int) -> None:
    video = cv2.VideoCapture(str(SAMPLE / "recording.avi"))
    pictures = []
    while (read := video.read())[0]:
        pictures.append(
            cv2.cvtColor(read[1], cv2.COLOR_BGR2GRAY)[80:560].repeat(2, axis=1)[:, :640]
        )
    write_recording(path, (pictures[number % len(pictures)] for number in range(frames)))


def write_recording(path: Path, pictures: Iterable[np.ndarray]) -> None:
    """Write pictures of one size, at least one, as MJPG at 500 frames/s."""
    following = iter(pictures)
    first = next(following)
    command = (
        f"{imageio_ffmpeg.get_ffmpeg_exe()} -loglevel error -f rawvideo -pix_fmt gray "
        f"-s {first.shape[1]}x{first.shape[0]} -r 500 -i - -c:v mjpeg -q:v 4 -pix_fmt yuvj420p -y"
    )
    with subprocess.Popen([*command.split(), path], stdin=subprocess.PIPE) as ffmpeg:
        assert ffmpeg.stdin is not None
        for picture in itertools.chain([first], following):
            ffmpeg.stdin.write(np.ascontiguousarray(picture).tobytes())
        ffmpeg.stdin.close()
    assert ffmpeg.returncode == 0


def make_session(folder: Path, frames: int) -> Path:
    path, recording = folder / "large.labsession", folder / "large.avi"
    make_recording(recording, frames)
    with Session.create(folder / "one.labsession") as one:
        one.set_setup((SAMPLE / "setup.toml").read_text("utf-8"))
        one.import_recording(SAMPLE / "recording.avi", ":1")
        ((_, measurement),) = one.measure()
        setup = one.setup_text
    with Session.create(path) as session:
        session.set_setup(setup)
        start_s = time.perf_counter()
        session.import_recording(recording)
        print(
            f"import            {(time.perf_counter() - start_s) / frames * 1000:8.2f} ms a frame"
        )
        basis = session._basis()
        assert basis is not None
        start_s = time.perf_counter()
        with session._database.transaction():
            for number in range(frames):
                session._results.put(number, measurement, basis, None)
        print(
            f"keep a result     {(time.perf_counter() - start_s) / frames * 1000:8.2f} ms a frame"
        )
    print(f"session file      {path.stat().st_size / 1e6:8.1f} MB, {frames} frames with results")
    return path


def plain_insert_ms(folder: Path, content: bytes) -> float:
    """Return the time to insert the same bytes into a plain SQLite table, equally durable, ms."""
    connection = sqlite3.connect(folder / "plain.db", isolation_level=None)
    connection.execute("PRAGMA synchronous = EXTRA")
    connection.execute("CREATE TABLE t (number INTEGER PRIMARY KEY, content BLOB)")
    median = median_ms(
        lambda number: connection.execute("INSERT INTO t VALUES (?, ?)", (number, content)), SAVED
    )
    connection.close()
    return median


def look(path: Path, folder: Path) -> None:
    """Open, scrub and correct, in a separate process so that its memory can be measured."""
    start_s = time.perf_counter()
    session = Session.open(path)
    overview = session.overview()
    session.frame(0)
    opened = time.perf_counter() - start_s
    result = session.result(0)
    assert result is not None
    with path.open("rb") as file:
        start_s = time.perf_counter()
        while file.read(1 << 20):
            pass
        read = time.perf_counter() - start_s
    print(f"open, first frame {opened * 1000:8.0f} ms   {opened / read:6.2f} × reading the file")
    frames = np.random.default_rng(1).integers(0, len(overview.frame), SAVED)
    scrub = median_ms(lambda k: session.frame(int(frames[k])), SAVED)
    shown = median_ms(lambda k: session.result(int(frames[k])), SAVED)
    glance = median_ms(lambda _: session.overview(), 5)
    print(
        f"a frame           {scrub:8.2f} ms   a result {shown:.2f} ms, all of them {glance:.0f} ms"
    )
    correction = start_correction(result.measurement)
    moved = [
        Correction(correction.dots, correction.lattice, np.arange(len(correction.manual)) == k)
        for k in range(SAVED)
    ]
    save = median_ms(lambda k: session.correct({int(frames[k]): moved[k]}), SAVED)
    undo = median_ms(lambda _: session.undo(), SAVED)
    plain = plain_insert_ms(folder, os.urandom(8000))
    print(
        f"save a correction {save:8.2f} ms   {save / plain:6.2f} × a bare insert ({plain:.2f} ms)"
    )
    print(f"undo it           {undo:8.2f} ms   {undo / plain:6.2f} ×")
    session.close()
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    print(f"memory            {peak:8.0f} MB at most")


def main(arguments: list[str]) -> None:
    frames = int(arguments[0]) if arguments else 10_000
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        if len(arguments) > 1:
            look(Path(arguments[1]), folder)
            return
        path = make_session(folder, frames)
        sys.stdout.flush()
        subprocess.run([sys.executable, __file__, str(frames), str(path)], check=True)


if __name__ == "__main__":
    main(sys.argv[1:])
