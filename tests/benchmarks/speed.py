"""Speed of measuring: followed and cold frames, their dots, and a video from file to CSV.

Run as ``python -m tests.benchmarks.speed [--frames N] [--cache FOLDER] [--cases FOLDER …]``. The
video is that of `labapp benchmark`. From file to CSV it is measured in this process, without the
start and the check of the set-up, and by the command. A folder of cases has a folder each with
``frame.png`` and ``setup.toml``; each frame is measured independently, after all have been measured
once, which loads the compiled functions that only some frames need. Times are
processor times on one core, unless stated otherwise. Each ratio is from one run: where other
programs share the cores, ratios are more reliable than times. The profile contains the time of a
followed frame by module, including the profiler's overhead, and calls of the costliest functions.
"""

from __future__ import annotations

import argparse
import cProfile
import os
import pstats
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from itertools import islice
from pathlib import Path

import cv2
import numpy as np
import platformdirs
from threadpoolctl import ThreadpoolController

from labapp.config.setup import read_setup
from labapp.core.images.band_pass import tuning_of
from labapp.core.images.dots import Image
from labapp.core.pipeline import Settings, measure
from labapp.core.recording.chain import WarmChain
from labapp.export.frame_result import FrameResult
from labapp.export.tables import table_rows
from labapp.media import open_source
from labapp.simulated.benchmark import Video, make_video, run_video, time_frames
from tests.benchmarks.detectors import detectors

FOLLOWED, BEFORE, SEARCHED = 200, 20, 40
"""Frames followed under the profiler, frames before them, and frames whose dots are searched."""

COMMAND_WANTED = {"none": "<= 50", "all": "<= 80"}
"""Wanted processor time of `labapp reconstruct`, without and with the files of all surfaces."""

COUNTED = {
    "fits of several rounds": "run_rounds",
    "inverses of the normal matrix": "inverse_band",
    "covariances of dots": "covariance_of_dots",
}
"""Counted operations, and their compiled functions."""


def seconds(work: Callable[..., object], *arguments: object) -> float:
    """Return the processor time of a call, s."""
    start_s = time.process_time()
    work(*arguments)
    return time.process_time() - start_s


def print_ratio(name: str, ratio: float, required: str) -> None:
    """Print a ratio and its requirement."""
    print(f"{name:42}{ratio:8.2f}   wanted {required}")


def compare_dots(images: list[Image]) -> None:
    """Compare the detector without a prior with OpenCV's SimpleBlobDetector, frame by frame.

    They take turns, as other programs and the memory allocated so far change the times of both.
    """
    size_px = tuning_of(images[0], Settings().dots.band_pass).size_px
    (_, labapp_detector), (_, blobs) = islice(detectors(size_px), 2)
    assert not isinstance(labapp_detector, str)
    assert not isinstance(blobs, str)
    both = labapp_detector, blobs
    times = np.array([[seconds(find, one) for find in both] for one in images[:1] + images])[1:]
    labapp_ms, opencv_ms = 1e3 * np.median(times, axis=0)
    print(f"dots of a cold frame {labapp_ms:.1f} ms, SimpleBlobDetector {opencv_ms:.1f} ms")
    ratio = float(np.median(times[:, 0] / times[:, 1]))
    print_ratio("cold dots / SimpleBlobDetector", ratio, "<= 1")


def time_cases(folder: Path) -> None:
    """Print median and largest time of cold frames of a folder of cases, ms."""
    cases = []
    for case in sorted(path.parent for path in folder.glob("*/frame.png")):
        with open_source(case / "frame.png") as source:
            cases.append((source.frame(0).image, read_setup(case / "setup.toml").bench))
    for case in cases:
        measure(*case, Settings())
    times_ms = 1e3 * np.array([seconds(measure, *case, Settings()) for case in cases])
    print(f"cold frames of {folder.name}: {len(cases)}")
    print_ratio("  median, ms", float(np.median(times_ms)), "<= 100")
    print_ratio("  worst, ms", float(times_ms.max()), "<= 1000")


def time_command(video: Video, out: Path) -> None:
    """Print the time of `labapp reconstruct --warm` from its start to its end.

    Its reference is the time in which this process decodes the video.
    """
    with open_source(video.path) as source:
        decoding_s = seconds(lambda: [source.frame(number) for number in range(len(source))])
    frames, setup = len(video.height_mm), video.path.with_suffix("") / "setup.toml"
    command = [sys.executable, "-m", "labapp", "reconstruct", video.path, "--setup", setup]
    for surfaces, wanted in COMMAND_WANTED.items():
        begun, used = time.perf_counter(), sum(os.times()[2:4])
        subprocess.run(
            [*command, "--out", out, "--warm", "--surfaces", surfaces],
            check=True,
            capture_output=True,
        )
        rate, used = frames / (time.perf_counter() - begun), sum(os.times()[2:4]) - used
        print(
            f"reconstruct --warm --surfaces {surfaces}: {rate:.0f} frames a second, with its start"
        )
        print(f"  {1e3 * used / frames:.2f} ms of all processors a frame")
        print_ratio("  processor time / decoding", used / decoding_s, wanted)


def profile_followed(video: Video) -> None:
    """Print the time of a followed frame by module, from reading it to the text of its rows."""
    chain, profile = WarmChain(video.setup.bench, Settings()), cProfile.Profile(time.process_time)
    with open_source(video.path) as source:

        def follow(number: int) -> None:
            frame = source.frame(number)
            result = FrameResult(number, frame.time_s, chain.measure(frame.image))
            table_rows(result, video.setup.calibration)

        for number in range(BEFORE):
            follow(number)
        for number in range(BEFORE, BEFORE + FOLLOWED):
            profile.runcall(follow, number)
    shares: Counter[str] = Counter()
    calls: Counter[str] = Counter()
    statistics = pstats.Stats(profile).stats  # type: ignore[attr-defined]  # not in typeshed
    for (path, _, name), (_, count, own_s, _, _) in statistics.items():
        module = path.rpartition("/labapp/")[2] if "/labapp/" in path else "NumPy, OpenCV, Python"
        shares[module] += own_s
        calls[name] += count if module.endswith("kernels.py") else 0
    print(f"\n{'profile of a followed frame':42}{'ms':>8}")
    for module, own_s in shares.most_common(14):
        print(f"  {module:40}{1e3 * own_s / FOLLOWED:8.2f}")
    print(f"{'calls a followed frame':42}")
    print(f"  {'of all functions':40}{sum(one[1] for one in statistics.values()) / FOLLOWED:8.0f}")
    for name, function in COUNTED.items():
        print(f"  {name:40}{calls[function] / FOLLOWED:8.1f}")


def main() -> None:
    """Print all."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--frames", type=int, default=2000)
    parser.add_argument("--cache", type=Path)
    parser.add_argument("--cases", type=Path, nargs="*", default=[])
    chosen = parser.parse_args()
    if chosen.frames < BEFORE + FOLLOWED:
        parser.error(f"--frames {chosen.frames}: expected at least {BEFORE + FOLLOWED}")
    folder = chosen.cache or Path(platformdirs.user_cache_dir("labapp")) / "benchmark"
    folder.mkdir(parents=True, exist_ok=True)
    video = make_video(folder, chosen.frames)
    with tempfile.TemporaryDirectory(dir=folder) as out:
        run = run_video(video, Path(out) / "results", 2)
        ms = 1e3 * run.processor_s / run.frames
        print(f"from file to CSV, two processes, {run.frames} frames, {run.cold} of them cold")
        print_ratio("  frames a second", run.frames / run.seconds, ">= 500")
        print(f"  {ms:.2f} ms of all processors a frame, the start of the processes in it")
        time_command(video, Path(out) / "command")
    cv2.setNumThreads(1)
    with ThreadpoolController().limit(limits=1, user_api="blas"):
        latency = time_frames(video, min(chosen.frames, 400))
        followed, cold = latency.processor.median, 1e3 * latency.cold_s
        print(f"a followed frame {followed:.2f} ms, a cold one {cold:.0f} ms")
        print_ratio("cold / followed", cold / followed, "<= 25")
        numbers = np.linspace(0, chosen.frames - 1, SEARCHED).astype(int).tolist()
        with open_source(video.path) as source:
            compare_dots([source.frame(number).image for number in numbers])
        for cases in chosen.cases:
            time_cases(cases)
        profile_followed(video)


if __name__ == "__main__":
    main()
