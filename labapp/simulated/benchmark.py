"""How fast a recording is measured, and how well: one simulated video, all timings in one run."""

from __future__ import annotations

import csv
import importlib
import os
import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
from scipy.spatial import cKDTree
from threadpoolctl import ThreadpoolController

from labapp.config.scenario import read_scenario
from labapp.config.setup import Setup, read_setup
from labapp.core.images.band_pass import Exposure, band_pass_dots, quick_dots
from labapp.core.images.dots import Dots, Image
from labapp.core.pipeline import Settings, measure
from labapp.core.sequence.warm import WarmChain
from labapp.core.values import FloatArray, IntArray
from labapp.export.results import ResultsWriter
from labapp.files import atomic_file
from labapp.media import open_source
from labapp.run.sequence import Job, await_ready, followers, measure_sequence
from labapp.simulated.simulate import simulate
from labapp.simulated.simulated_pool import BENCH
from labapp.simulation.parallel import Progress

RATE_HZ, WAVE_HZ = 200.0, 37.3

SCENARIO = f"""# A pool that swings, before a fast camera.

[pool]
shape = "egg"
width_mm = 6.66
head_mm = 3.0
tail_mm = 4.4
height_mm = 0.29
center_mm = [0.0, -0.6]
wander_percent = 2.0

[[pool.wave]]
mode = [0, 1]
amplitude_mm = 0.03
frequency_hz = {WAVE_HZ}

{BENCH}
[look]
hot_pixels = 2
missing = 0.01

[recording]
frames = {{frames}}
frame_rate_hz = {RATE_HZ}
exposure_ms = 0.0
seed = 6001
"""

TRUE_PX = 3.0
"""A found dot within this distance is a true one."""

STEPS = ("dots", "match", "fit", "level", "measures")


@dataclass(frozen=True)
class Video:
    """The video and what it was made of.

    Parameters
    ----------
    path
        Raw 8-bit grey frames in an AVI: decoding costs next to nothing, as with a camera.
    setup
        Its setup.
    height_mm
        True height of the pool in each frame, shape (frames,), mm.
    dots
        True dots of each frame that show: place, shape (n, 2), px, and ray (i, j), shape (n, 2).
    """

    path: Path
    setup: Setup
    height_mm: FloatArray
    dots: list[tuple[FloatArray, IntArray]]


def make_video(
    cache: Path,
    frames: int,
    workers: int | None = None,
    progress: Progress | None = None,
) -> Video:
    """Simulate the video into a folder, or take it from there.

    Raises
    ------
    InputError
        If the folder cannot be written.
    """
    folder = cache / f"oscillating_{frames}"
    path = cache / f"oscillating_{frames}.avi"
    text = SCENARIO.format(frames=frames)
    scenario = folder / "scenario.toml"
    if not (path.exists() and scenario.exists() and scenario.read_text("utf-8") == text):
        cache.mkdir(parents=True, exist_ok=True)
        draft = cache / "scenario.toml"
        draft.write_text(text, encoding="utf-8")
        simulate(read_scenario(draft), folder, workers, progress)
        draft.unlink()
        _write_raw(folder / "recording.avi", path)
    truth = _rows(folder / "truth.csv")
    dots: defaultdict[int, list[list[float]]] = defaultdict(list)
    for row in _rows(folder / "dots_truth.csv"):
        if row["visible"] == "1":
            names = ("u_px", "v_px", "ray_row", "ray_column")
            dots[int(row["frame"])].append([float(row[name]) for name in names])
    table = [np.array(dots[k]).reshape(-1, 4) for k in range(frames)]
    return Video(
        path,
        read_setup(folder / "setup.toml"),
        np.array([float(row["height_mm"]) for row in truth]),
        [(one[:, :2], one[:, 2:].astype(np.int64)) for one in table],
    )


def _rows(path: Path) -> Iterator[dict[str, str]]:
    with path.open(encoding="utf-8", newline="") as file:
        yield from csv.DictReader(file)


def _write_raw(source_path: Path, path: Path) -> None:
    with (
        atomic_file(path) as part,
        open_source(source_path) as source,
        av.open(str(part), "w", format="avi") as container,
    ):
        stream = container.add_stream("rawvideo", rate=round(RATE_HZ))
        stream.height, stream.width = source.shape
        stream.pix_fmt = "gray"
        for frame in source:
            picture = av.VideoFrame.from_ndarray(np.ascontiguousarray(frame.image), format="gray")
            container.mux(stream.encode(picture))
        container.mux(stream.encode(None))


# --- the chain ----------------------------------------------------------------------------------


@dataclass(frozen=True)
class Spread:
    """Times of one thing, ms."""

    median: float
    worst: float

    @classmethod
    def of(cls, times_s: Sequence[float]) -> Spread:
        """Median and 99th percentile."""
        return cls(*(1e3 * np.quantile(times_s, [0.5, 0.99])))


@dataclass(frozen=True)
class Latency:
    """How long one frame takes, alone on one core.

    Parameters
    ----------
    frame, steps
        A whole frame, and its steps, by the clock.
    processor
        A whole frame by the time its processor spent on it, which other programs hardly change.
    cold_s
        A frame of the cold chain, s of the processor.
    """

    frame: Spread
    steps: dict[str, Spread]
    processor: Spread
    cold_s: float


def time_frames(video: Video, frames: int, cold: int = 3) -> Latency:
    """Measure so many frames of the video one after the other, and some by the cold chain."""
    cv2.setNumThreads(1)
    steps: dict[str, list[float]] = {name: [] for name in STEPS}
    last = [0.0]

    def passed(step: str) -> None:
        now = time.perf_counter()
        steps[step].append(now - last[0])
        last[0] = now

    rig, calibration, settings = video.setup.rig, video.setup.calibration, Settings()
    chain = WarmChain(rig, calibration, settings, passed)
    wall, used = [], []
    with (
        open_source(video.path) as source,
        ThreadpoolController().limit(limits=1, user_api="blas"),
    ):
        for number in range(frames):
            image = source.frame(number).image
            start, last[0] = time.process_time(), time.perf_counter()
            begun = last[0]
            chain.measure(image)
            if number:  # the first is cold
                wall.append(time.perf_counter() - begun)
                used.append(time.process_time() - start)
        begun = time.process_time()
        for number in range(cold):
            image = source.frame((number + 1) * frames // (cold + 1)).image
            measure(image, rig, calibration, settings)
        cold_s = (time.process_time() - begun) / cold
    told = {name: Spread.of(times) for name, times in steps.items()}
    return Latency(Spread.of(wall), told, Spread.of(used), cold_s)


@dataclass(frozen=True)
class Run:
    """The whole video, from its file to the tables.

    Parameters
    ----------
    frames, seconds, processor_s
        How many frames, in how long, and what time of processors that took.
    start_s
        How long before the processes that measure had started and loaded what they need.
    measured, cold
        How many have a surface; how many were measured by the cold chain.
    wrong, labelled
        Dots with a wrong ray; share of the dots shown that have theirs.
    surprise
        Root mean square error of the height over its σ.
    frequency_hz, true_hz
        Of the height's largest swing, and of the pool's.
    """

    frames: int
    seconds: float
    processor_s: float
    start_s: float
    measured: int
    cold: int
    wrong: int
    labelled: float
    surprise: float
    frequency_hz: float
    true_hz: float = WAVE_HZ


def run_video(
    video: Video, out: Path, workers: int | None, progress: Callable[[], None] = lambda: None
) -> Run:
    """Measure the video into CSV files and hold them against the truth.

    Raises
    ------
    InputError
        If the folder cannot be written.
    """
    frames, broke = len(video.height_mm), 0
    begun, used = time.perf_counter(), sum(os.times()[:4])
    job = Job(video.path, None, video.setup, Settings())
    with followers(frames, workers) as pools:
        await_ready(pools)
        start_s = time.perf_counter() - begun
        with ResultsWriter(out, video.setup.calibration, {"benchmark": "chain"}, False) as results:
            for told in measure_sequence(job, range(frames), pools):
                results.write(told.frame, told.time_s, told.measurement, told.rows)
                broke += told.broke is not None
                progress()
        seconds = time.perf_counter() - begun - start_s
    used = sum(os.times()[:4]) - used
    heights, sigma = np.full((2, frames), np.nan)
    for row in _rows(out / "measures.csv"):
        if row["status"] == "ok":
            frame = int(row["frame"])
            heights[frame], sigma[frame] = float(row["height_mm"]), float(row["height_sigma_mm"])
    surprise = (heights - video.height_mm) / sigma
    right = wrong = 0
    for row in _rows(out / "dots.csv"):
        if row["ray_row"]:
            is_right = _is_right(video, row)
            right, wrong = right + is_right, wrong + (not is_right)
    shown = sum(len(place) for place, _ in video.dots)
    return Run(
        frames,
        seconds,
        used,
        start_s,
        int(np.isfinite(heights).sum()),
        broke,
        wrong,
        right / shown,
        float(np.sqrt(np.nanmean(np.square(surprise)))),
        _frequency(heights),
    )


def _is_right(video: Video, row: dict[str, str]) -> bool:
    """Whether a dot's ray, in its row of ``dots.csv``, made a dot there."""
    place, ray = video.dots[int(row["frame"])]
    own = place[(ray == [int(row["ray_row"]), int(row["ray_column"])]).all(axis=1)]
    off = own - [float(row["u_px"]), float(row["v_px"])]
    return bool((np.hypot(*off.T) <= TRUE_PX).any())


def _frequency(heights: FloatArray) -> float:
    """Of the largest swing above 10 Hz, by a spectrum that is padded to a hundredth of a Hz."""
    known = np.isfinite(heights)
    at = np.arange(len(heights))
    swing = np.interp(at, at[known], heights[known])
    swing = (swing - swing.mean()) * np.hanning(len(swing))
    count = int(RATE_HZ / 0.01)
    power = np.abs(np.fft.rfft(swing, count))
    frequency = np.fft.rfftfreq(count, 1 / RATE_HZ)
    fast = frequency > 10.0
    return float(frequency[fast][np.argmax(power[fast])])


# --- detectors of dots --------------------------------------------------------------------------


@dataclass(frozen=True)
class Detected:
    """What a detector made of some frames.

    Parameters
    ----------
    name
        The detector.
    time
        Of a frame, by the processor, ms.
    recall, precision
        Share of the dots shown that it found; share of what it found that is one.
    error_px
        Root mean square distance of those from their true places, px.
    """

    name: str
    time: Spread
    recall: float
    precision: float
    error_px: float


def detectors(size_px: float) -> Iterator[tuple[str, Callable[[Image], FloatArray] | str]]:
    """Yield name and function of each detector, or where it is missing how to get it.

    Those of other programs are set as their guides say, for dots of the given size, as Gaussians.
    """
    settings = Settings().dots.band_pass

    opencv: Any = cv2  # its hints leave this detector out

    def blobs(image: Image) -> FloatArray:
        chosen = opencv.SimpleBlobDetector_Params()
        chosen.filterByColor, chosen.blobColor = True, 255
        chosen.filterByArea, chosen.minArea = True, float(size_px**2)
        chosen.maxArea = float(60 * size_px**2)
        chosen.filterByCircularity = chosen.filterByConvexity = chosen.filterByInertia = False
        chosen.minThreshold, chosen.maxThreshold, chosen.thresholdStep = 25.0, 200.0, 5.0
        chosen.minDistBetweenBlobs = 3.0 * size_px
        found = opencv.SimpleBlobDetector_create(chosen).detect(image)
        return np.array([point.pt for point in found]).reshape(-1, 2)

    def located(trackpy: Any) -> Callable[[Image], FloatArray]:
        diameter = 2 * round(2 * size_px) + 1
        return lambda image: np.asarray(
            trackpy.locate(image, diameter, minmass=20 * size_px**2)[["x", "y"]]
        )

    def dogs(feature: Any) -> Callable[[Image], FloatArray]:
        return lambda image: feature.blob_dog(
            np.asarray(image, float) / 255.0,
            min_sigma=0.7 * size_px,
            max_sigma=1.6 * size_px,
            threshold=0.03,
        )[:, 1::-1]

    yield "labapp, whole search", lambda image: band_pass_dots(image, settings).image_px
    yield "OpenCV SimpleBlobDetector", blobs
    for name, module, package, made in (
        ("trackpy locate", "trackpy", "trackpy", located),
        ("scikit-image blob_dog", "skimage.feature", "scikit-image", dogs),
    ):
        try:
            yield name, made(importlib.import_module(module))
        except ImportError:
            yield name, f"not installed: pip install {package}"


def compare_detectors(video: Video, count: int) -> list[Detected | tuple[str, str]]:
    """Run every detector on ``count`` frames over the video; of one missing, say how to get it."""
    frames = np.linspace(0, len(video.dots) - 1, count).astype(int).tolist()
    with open_source(video.path) as source:
        images = [source.frame(number).image for number in frames]
    settings = Settings().dots.band_pass
    exposure = Exposure.of(images[0], settings)

    def quick(image: Image) -> FloatArray:
        dots: Dots = quick_dots(image, exposure, settings)
        return dots.image_px

    true = [video.dots[number][0] for number in frames]
    made: list[Detected | tuple[str, str]] = [_detected("labapp, warm", quick, images, true)]
    for name, detector in detectors(exposure.size_px):
        if isinstance(detector, str):
            made.append((name, detector))
        else:
            made.append(_detected(name, detector, images, true))
    return made


def _detected(
    name: str,
    detector: Callable[[Image], FloatArray],
    images: list[Image],
    true: list[FloatArray],
) -> Detected:
    times, hits, found_count, off = [], 0, 0, []
    detector(images[0])
    for image, places in zip(images, true, strict=True):
        begun = time.process_time()
        found = detector(image)
        times.append(time.process_time() - begun)
        found_count += len(found)
        if len(found) == 0:
            continue
        distance, nearest = cKDTree(found).query(places)
        _, own = cKDTree(places).query(found)
        pairs = (own[nearest] == np.arange(len(places))) & (distance <= TRUE_PX)
        hits += int(pairs.sum())
        off += distance[pairs].tolist()
    shown = sum(map(len, true))
    error = float(np.sqrt(np.mean(np.square(off)))) if off else float("nan")
    return Detected(name, Spread.of(times), hits / shown, hits / max(found_count, 1), error)
