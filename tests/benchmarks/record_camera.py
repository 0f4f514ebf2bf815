"""Speed of recording, and whether a camera at 200 frames/s is recorded without loss.

record_camera.py [SECONDS] [FRAMES_A_SECOND] [FOLDER]: 10 s, 200 frames/s, a temporary folder. The
reference is writing the same bytes to the same disk, in the same run.
"""

from __future__ import annotations

import resource
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from labapp.media import GreyImage, open_source
from labapp.media.cameras import CameraSettings, Feed
from labapp.media.recording.nut import Codec, NutWriter
from labapp.media.recording.recorder import Plan, Recorder
from labapp.session.samples import sample_folder
from tests.media.cameras.faulty import Faults, FaultyDevice

WRITTEN = 400


def frames() -> list[GreyImage]:
    """Return frames of the sample run, 480×640 px."""
    with open_source(sample_folder("gtaw") / "recording.avi") as source:
        return [source.frame(k).image for k in range(12)]


def encode(folder: Path, images: list[GreyImage], codec: Codec, threads: int) -> None:
    """Time the writer alone, and plain writing."""
    path = folder / "speed.nut"
    writer = NutWriter(path, images[0].shape, 8, 200, codec, threads)
    start_s, cpu_s = time.perf_counter(), time.process_time()
    for k in range(WRITTEN):
        writer.write(images[k % len(images)], k / 200)
    writer.close()
    wall_s, cpu_s = time.perf_counter() - start_s, time.process_time() - cpu_s
    size = path.stat().st_size / WRITTEN
    path.unlink()
    start_s = time.perf_counter()
    with path.open("xb", buffering=0) as file:
        for k in range(WRITTEN):
            file.write(images[k % len(images)].tobytes())
    plain_s = time.perf_counter() - start_s
    path.unlink()
    print(
        f"{codec} on {threads}: {WRITTEN / wall_s:.0f} frames/s, "
        f"{1e3 * cpu_s / WRITTEN:.2f} ms of a core and {size / 1e3:.0f} kB a frame; "
        f"plain writing {WRITTEN / plain_s:.0f} frames/s"
    )


def film(
    folder: Path,
    images: list[GreyImage],
    codec: Codec,
    faults: Faults,
    duration_and_rate: list[float],
) -> None:
    """Record a simulated camera, and print lost frames and memory."""
    seconds, rate_hz = duration_and_rate
    device = FaultyDevice("camera", lambda k: images[k % len(images)], faults=faults)
    path = folder / "film.nut"
    events: list[str] = []
    with Recorder(
        lambda: path, Plan(codec=codec), 8, rate_hz, lambda event: events.append(str(event))
    ) as recorder:
        take = recorder.trigger()
        waiting, memory = [], []
        settings = CameraSettings(rate_hz=rate_hz)
        with Feed("camera", device.open, recorder.take, recorder.note, settings) as feed:
            until_s = time.monotonic() + seconds
            while time.monotonic() < until_s:
                time.sleep(0.2)
                waiting.append(recorder.waiting_mb)
                memory.append(int(Path("/proc/self/statm").read_text().split()[1]) * 4096 / 1e6)
    counts = feed.counts
    with open_source(path) as video:
        is_complete = len(video) == take.frames == counts.frames
        steps_s = np.diff([frame.time_s or 0.0 for frame in video])
    path.unlink()
    take.notes.unlink()
    third = len(memory) // 3
    print(
        f"{codec} at {rate_hz:g} frames/s for {seconds:g} s: {counts}, lost by the recorder "
        f"{take.lost}, all in the file: {is_complete}, longest gap {1e3 * steps_s.max():.0f} ms, "
        f"waiting at most {max(waiting):.1f} MB, memory {np.median(memory[:third]):.0f} MB in the "
        f"first third, {np.median(memory[-third:]):.0f} MB in the last"
    )
    if events:
        print("    " + "\n    ".join(events[:5]))


def main() -> None:
    """Measure and print."""
    arguments = sys.argv[1:]
    seconds, rate_hz = (float(arguments[k]) if len(arguments) > k else (10, 200)[k] for k in (0, 1))
    images = frames()
    with tempfile.TemporaryDirectory(dir=arguments[2] if len(arguments) > 2 else None) as name:
        folder = Path(name)
        for codec, threads in (("raw", 1), ("ffv1", 1), ("ffv1", 2)):
            encode(folder, images, codec, threads)
        for codec in ("raw", "ffv1"):
            film(folder, images, codec, Faults(), [seconds, rate_hz])
        period = round(rate_hz * seconds / 50)
        faults = Faults(garbage=0.01, unplug_every=max(2, period), unplugged_s=0.02)
        film(folder, images, "raw", faults, [seconds, rate_hz])
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3
    print(f"peak memory {peak:.0f} MB")


if __name__ == "__main__":
    main()
