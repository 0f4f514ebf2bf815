"""Speed and accuracy of measuring one simulated video of an oscillating pool."""

from __future__ import annotations

import csv
import os
import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import av
import cv2
import numpy as np
import tomlkit
from threadpoolctl import ThreadpoolController

from labapp.config.scenario import read_scenario
from labapp.config.setup import Setup, read_setup
from labapp.core.pipeline import Settings, measure
from labapp.core.recording.chain import WarmChain
from labapp.core.surface.measures import sigma_name
from labapp.core.values import FloatArray, IntArray
from labapp.export.results import ResultsWriter
from labapp.files import atomic_file
from labapp.media import open_source
from labapp.run.measurers import RecordingMeasurer, await_loaded, stretch_pools
from labapp.run.runner import run
from labapp.simulated.simulate import simulate
from labapp.simulated.simulated_pool import oscillating_pool
from labapp.simulation.parallel import Progress

RATE_HZ, WAVE_HZ = 200.0, 37.3
COLD = 3  # frames measured without a prior

TRUE_PX = 3.0
"""Maximum distance between a detected dot and the true dot that it matches."""

STEPS = ("dots", "surface", "measures")


@dataclass(frozen=True)
class Video:
    """A simulated video and its ground truth."""

    path: Path
    """Raw 8-bit grey frames in an AVI: as with a camera, decoding takes almost no time."""
    setup: Setup
    height_mm: FloatArray
    """True height of the pool in each frame, shape (frames,), mm."""
    dots: list[tuple[FloatArray, IntArray]]
    """Visible true dots of each frame: position, shape (n, 2), px; ray (i, j), shape (n, 2)."""


def scenario_text(frames: int) -> str:
    """Scenario of an oscillating pool in front of a fast camera."""
    fast = {"frame_rate_hz": RATE_HZ, "exposure_ms": 0.0}
    return tomlkit.dumps(oscillating_pool(WAVE_HZ, 2.0, frames=frames, seed=6001, **fast))


def make_video(
    cache: Path,
    frames: int,
    workers: int | None = None,
    progress: Progress | None = None,
) -> Video:
    """Simulate the video into a folder, or reuse the existing one.

    Raises
    ------
    InputError
        If the folder cannot be written.
    """
    folder = cache / f"oscillating_{frames}"
    path = cache / f"oscillating_{frames}.avi"
    text = scenario_text(frames)
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


@dataclass(frozen=True)
class Spread:
    """Median and 99th percentile of measured times, ms."""

    median: float
    worst: float

    @classmethod
    def of(cls, times_s: Sequence[float]) -> Spread:
        """Spread of times in s."""
        return cls(*(1e3 * np.quantile(times_s, [0.5, 0.99])))


@dataclass(frozen=True)
class Latency:
    """Time per frame on one core."""

    frame: Spread
    steps: dict[str, Spread]
    """Wall time of a frame measured with a prior, and of its steps."""
    processor: Spread
    """Processor time of a frame with a prior, which other programs hardly affect."""
    cold_s: float
    """Processor time of a frame measured without a prior, s."""


def time_frames(video: Video, frames: int) -> Latency:
    """Time the first ``frames`` frames with the previous frame as prior, and `COLD` without."""
    cv2.setNumThreads(1)
    steps: dict[str, list[float]] = {name: [] for name in STEPS}
    last = [0.0]

    def passed(step: str) -> None:
        now = time.perf_counter()
        steps[step].append(now - last[0])
        last[0] = now

    bench, settings = video.setup.bench, Settings()
    chain = WarmChain(bench, settings, passed)
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
            if number:  # the first has no prior
                wall.append(time.perf_counter() - begun)
                used.append(time.process_time() - start)
        begun = time.process_time()
        for number in range(COLD):
            image = source.frame((number + 1) * frames // (COLD + 1)).image
            measure(image, bench, settings)
        cold_s = (time.process_time() - begun) / COLD
    by_step = {name: Spread.of(times) for name, times in steps.items()}
    return Latency(Spread.of(wall), by_step, Spread.of(used), cold_s)


@dataclass(frozen=True)
class Run:
    """Throughput and accuracy for the whole video, from its file to the CSV tables."""

    frames: int
    seconds: float
    processor_s: float
    """Number of frames, wall time and processor time."""
    start_s: float
    """Time until the measuring processes had started and loaded their modules."""
    measured: int
    cold: int
    """Frames with a surface; frames measured without a prior."""
    wrong: int
    labelled: float
    """Dots with a wrong ray; share of the visible dots with the correct ray."""
    normalized_error: float
    """Root mean square of the height's error divided by its σ from noise and level."""
    frequency_hz: float
    true_hz: float = WAVE_HZ
    """Frequency of the height's largest oscillation, measured and true."""


def run_video(
    video: Video, out: Path, workers: int | None, progress: Callable[[], None] = lambda: None
) -> Run:
    """Measure the video into CSV files and compare them with the ground truth.

    Raises
    ------
    InputError
        If the folder cannot be written.
    """
    frames, lost = len(video.height_mm), 0
    begun, used = time.perf_counter(), sum(os.times()[:4])
    with stretch_pools(frames, workers) as pools:
        await_loaded(pools)
        measurer = RecordingMeasurer(
            video.path, None, video.setup, Settings(), sigma_parts=True, pools=pools
        )
        start_s = time.perf_counter() - begun
        made = {"benchmark": "chain"}
        with ResultsWriter(out, video.setup.calibration, made, False, sigma_parts=True) as results:
            for result in run(range(frames), measurer, [results.write]):
                lost += result.track_lost is not None
                progress()
        seconds = time.perf_counter() - begun - start_s
    used = sum(os.times()[:4]) - used
    heights, sigma = np.full((2, frames), np.nan)
    for row in _rows(out / "measures.csv"):
        if row["status"] == "ok":
            frame = int(row["frame"])
            # The set-up is exactly that of the simulated bench.
            noise, level = (float(row[sigma_name("height_mm", p)]) for p in ("noise", "level"))
            heights[frame], sigma[frame] = float(row["height_mm"]), np.hypot(noise, level)
    normalized_error = (heights - video.height_mm) / sigma
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
        lost,
        wrong,
        right / shown,
        float(np.sqrt(np.nanmean(np.square(normalized_error)))),
        _frequency(heights),
    )


def _is_right(video: Video, row: dict[str, str]) -> bool:
    """Whether the ray in a row of ``dots.csv`` has a true dot within `TRUE_PX` of it."""
    place, ray = video.dots[int(row["frame"])]
    own = place[(ray == [int(row["ray_row"]), int(row["ray_column"])]).all(axis=1)]
    off = own - [float(row["u_px"]), float(row["v_px"])]
    return bool((np.hypot(*off.T) <= TRUE_PX).any())


def _frequency(heights: FloatArray) -> float:
    """Frequency of the strongest oscillation above 10 Hz, from a zero-padded spectrum (0.01 Hz)."""
    known = np.isfinite(heights)
    at = np.arange(len(heights))
    swing = np.interp(at, at[known], heights[known])
    swing = (swing - swing.mean()) * np.hanning(len(swing))
    count = int(RATE_HZ / 0.01)
    power = np.abs(np.fft.rfft(swing, count))
    frequency = np.fft.rfftfreq(count, 1 / RATE_HZ)
    fast = frequency > 10.0
    return float(frequency[fast][np.argmax(power[fast])])
