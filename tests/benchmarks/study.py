"""Studies at scale: the same bytes from any workers, what it costs, the law that was simulated.

Run as ``python -m tests.benchmarks.study FOLDER [PART …] [--frames N] [--kills N] [--seed S]``.
Parts, in this order; without any, all but ``long``:

make
    Simulates 40 recordings (4 currents, 2 gases, 5 of each) of 480x640 px into the folder, and puts
    an empty, a corrupt and a missing one among them.
workers
    Measures them by 1 and 2 processes, by a Dask cluster of 4 workers in one program, and by 2
    separate workers over TCP.
overhead
    What a study costs beside measuring.
law
    The summary against the truth.
kills
    Kills workers and programs at random moments.
long
    Measures 20,000 frames (``--long``) that are generated as they are read.

Times are the processor's, which other programs hardly change, unless they are called wall.
"""

from __future__ import annotations

import argparse
import csv
import os
import random
import shutil
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Mapping
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from unittest import mock

import numpy as np
import psutil  # type: ignore[import-untyped]
from pyarrow import parquet

from labapp import Study
from labapp.config.scenario import read_scenario
from labapp.config.setup import read_setup
from labapp.core.pipeline import Settings
from labapp.export.tables import frame_tables
from labapp.media import Frame, GreyImage, open_source
from labapp.run.measurers import WarmMeasurer
from labapp.run.study import stretches
from labapp.run.study import study as study_module
from labapp.run.study.summary import StudySummary
from labapp.simulated.benchmark import SCENARIO
from labapp.simulated.simulate import simulate
from tests.run.study.kill import bytes_of, kill_at_random
from tests.run.study.test_cluster import cluster

CURRENTS_A, GASES, REPEATS = (80, 95, 110, 125), ("Ar", "He"), 5
PARTS = ("make", "workers", "overhead", "law", "kills")

LOCAL_CLUSTER = """
import sys
from pathlib import Path
from distributed import LocalCluster
from labapp import Study

if __name__ == "__main__":
    with LocalCluster(n_workers=4, threads_per_worker=1, dashboard_address=None) as cluster:
        Study(Path(sys.argv[1]), Path(sys.argv[2])).run(scheduler=cluster.scheduler_address)
"""


def law_mm(current_a: float, gas: str) -> dict[str, float]:
    """Mean sizes of the simulated pools under a condition."""
    width = 6.0 + 0.014 * (current_a - 80)
    return {"width_mm": width, "height_mm": 0.24 + 0.0012 * (current_a - 80) + 0.04 * (gas == "He")}


# --- recordings ---------------------------------------------------------------------------------


def make_recording(folder: Path, current_a: int, gas: str, repeat: int, frames: int) -> None:
    """Simulate one recording, unless it is there."""
    out = folder / f"I{current_a}_{gas}_{repeat}"
    if (out / "recording.avi").exists():
        return
    law = law_mm(current_a, gas)
    text = SCENARIO.format(frames=frames)
    for old, new in (
        ("width_mm = 6.66", f"width_mm = {law['width_mm']}"),
        ("height_mm = 0.29", f"height_mm = {law['height_mm']}"),
        ("seed = 6001", f"seed = {7000 + 100 * current_a + 10 * (gas == 'He') + repeat}"),
    ):
        assert old in text
        text = text.replace(old, new)
    draft = folder / f"{out.name}.toml"
    draft.write_text(text, "utf-8")
    simulate(read_scenario(draft), out, workers=1)
    draft.unlink()


def make(folder: Path, frames: int) -> None:
    """Simulate all recordings and write the study."""
    folder.mkdir(parents=True, exist_ok=True)
    with ProcessPoolExecutor(2) as pool:
        jobs = [
            pool.submit(make_recording, folder, current, gas, repeat, frames)
            for current in CURRENTS_A
            for gas in GASES
            for repeat in range(1, REPEATS + 1)
        ]
        for job in jobs:
            job.result()
    (folder / "empty.avi").touch()
    (folder / "corrupt.avi").write_bytes(random.Random(1).randbytes(100_000))
    setup = f"I{CURRENTS_A[0]}_{GASES[0]}_1/setup.toml"
    text = f'title = "Current and gas"\nsetup = "{setup}"\n'
    for name in ("empty", "corrupt", "missing", "I{current_a}_{gas}_*/recording"):
        text += f'\n[[recording]]\nfile = "{name}.avi"\n'
    (folder / "study.toml").write_text(text, "utf-8")


# --- the same from any workers ------------------------------------------------------------------


class Watched:
    """Processor time, and memory over time, of processes and their children."""

    def __init__(self, *programs: int) -> None:
        self._programs = programs
        self._used: dict[int, float] = {}
        self.memory: list[tuple[float, int, int]] = []
        """(time, s; processes; the largest one's resident memory, bytes)."""
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._watch)

    def __enter__(self) -> Watched:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ended.set()
        self._thread.join()

    def _watch(self) -> None:
        while not self._ended.wait(0.3):
            sizes = []
            for program in self._programs:
                try:
                    root = psutil.Process(program)
                    for one in (root, *root.children(recursive=True)):
                        times = one.cpu_times()
                        self._used[one.pid] = times.user + times.system
                        sizes.append(one.memory_info().rss)
                except psutil.Error:
                    continue
            if sizes:
                self.memory.append((time.monotonic(), len(sizes), max(sizes)))

    @property
    def processor_s(self) -> float:
        """Processor time of all of them together, s."""
        return sum(self._used.values())

    def thirds_mb(self) -> list[float]:
        """Largest resident memory of a process in each third of the time, MB."""
        sizes = np.array([size for *_, size in self.memory]) / 1e6
        return [round(float(part.max()), 0) for part in np.array_split(sizes, 3)]


def timed(command: list[str], *others: int) -> str:
    """Run a program; what it took, together with other processes that work for it."""
    begun = time.perf_counter()
    program = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    with Watched(program.pid, *others) as seen:
        program.wait()
    wall_s = time.perf_counter() - begun
    load = os.getloadavg()[0]
    return (
        f"{wall_s:.1f} s wall, {seen.processor_s:.1f} s, largest process in each third of the time "
        f"{seen.thirds_mb()} MB, load {load:.1f}"
    )


def workers(folder: Path) -> None:
    """Measure the study by processes and by Dask's workers, and compare the files."""
    study = folder / "study.toml"
    command = [sys.executable, "-m", "labapp", "study", "run", str(study), "--out"]
    ways: dict[str, Callable[[Path], str]] = {
        "1 process": lambda out: timed([*command, str(out), "--workers", "1"]),
        "2 processes": lambda out: timed([*command, str(out), "--workers", "2"]),
        "LocalCluster of 4": lambda out: timed(
            [sys.executable, "-c", LOCAL_CLUSTER, str(study), str(out)]
        ),
        "2 workers over TCP": lambda out: _over_tcp([*command, str(out)]),
    }
    first: dict[str, str] = {}
    for name, way in ways.items():
        out = folder / f"by {name}"
        shutil.rmtree(out, ignore_errors=True)
        words = way(out)
        made = bytes_of(out)
        first = first or made
        same = "the same bytes" if made == first else "OTHER BYTES"
        print(f"{name}: {words}; {len(made)} tasks, {same}", flush=True)
        states = [one.state for one in Study(study, out).status()]
        problems = [one.problem for one in Study(study, out).status() if one.problem]
        print(f"  {states.count('done')} done, {states.count('failed')} failed: {problems}")


def _over_tcp(command: list[str]) -> str:
    with cluster(2) as (address, programs):
        return timed([*command, "--scheduler", address], *(one.pid for one in programs))


# --- what it costs ------------------------------------------------------------------------------


def overhead(folder: Path) -> None:
    """Tell what a study of 8 recordings takes beyond measuring their frames, in one process."""
    part = folder / "eight.toml"
    names = [f"I{current}_{gas}_1" for current in CURRENTS_A for gas in GASES]
    text = f'setup = "{names[0]}/setup.toml"\n'
    text += "".join(f'[[recording]]\nfile = "{name}/recording.avi"\n' for name in names)
    part.write_text(text, "utf-8")
    setup = read_setup(folder / names[0] / "setup.toml")

    def measure(name: str) -> None:
        with open_source(folder / name / "recording.avi") as source:
            for result in WarmMeasurer(source.frame, setup, Settings())(range(len(source))):
                frame_tables(result, setup.calibration)

    measure(names[0])  # modules are loaded and compiled now
    plain_s, study_s, results_s = [], [], []
    for k in range(3):
        begun = time.process_time()
        for name in names:
            measure(name)
        plain_s.append(time.process_time() - begun)
        out = folder / f"overhead {k}"
        shutil.rmtree(out, ignore_errors=True)
        study, begun = Study(part, out), time.process_time()
        study.run(0)
        study_s.append(time.process_time() - begun)
        begun = time.process_time()
        study.results()
        results_s.append(time.process_time() - begun)
    beside = [(a - b) / len(names) for a, b in zip(study_s, plain_s, strict=True)]
    print(f"8 recordings, three times: measured {plain_s}, as a study {study_s} s")
    print(f"overhead of a recording {beside} s; results of 8, with their plots: {results_s} s")


# --- the law ------------------------------------------------------------------------------------


def law(folder: Path) -> None:
    """Hold each recording's mean and each condition's against the truth, and fit the law."""
    summary = Study(folder / "study.toml", folder / "by 2 processes").results()
    truth = {one.status.recording.name: _truth(folder, one.status.recording.name)
             for one in summary.recordings if one.means}  # fmt: skip
    for size in ("width_mm", "length_mm", "height_mm", "area_mm2", "volume_mm3"):
        errors, sigmas, noises = [], [], []
        for group in summary.groups:
            true = np.mean([truth[name][size] for name in group.recordings])
            mean = group.means[size]
            errors.append(mean.mean - true)
            sigmas.append(mean.sigma)
            noises.append(mean.noise)
        off = np.abs(errors) / np.array(sigmas)
        print(
            f"{size}: largest error {np.max(np.abs(errors)):.4f}, ± {np.mean(sigmas):.4f} (noise "
            f"{np.mean(noises):.5f}); {int((off < 1).sum())} of {len(off)} within ±, "
            f"{int((off < 2).sum())} within 2 ±"
        )
    for size in ("width_mm", "height_mm"):
        print(f"{size}: {_slope(summary, truth, size)}")
    for one in summary.outliers[:10]:
        print("outlier", one.recording, one.frame, one.measure, one.value, one.usual, one.times)
    print(f"{len(summary.outliers)} outliers; look at {folder / 'by 2 processes/summary.html'}")


def _truth(folder: Path, name: str) -> dict[str, float]:
    with (folder / name / "truth.csv").open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    return {key: float(np.mean([float(row[key]) for row in rows])) for key in rows[0]}


def _slope(summary: StudySummary, truth: Mapping[str, Mapping[str, float]], size: str) -> str:
    """Slope against the current by least squares: simulated, true in these pools, measured."""
    by_name = {one.status.recording.name: one for one in summary.recordings}
    found = []
    for gas in GASES:
        groups = [one for one in summary.groups if one.conditions["gas"] == gas]
        names = [name for one in groups for name in one.recordings]
        at = np.array([float(str(one.conditions["current_a"])) for one in groups])
        at = np.repeat(at, [len(one.recordings) for one in groups])
        basis = np.stack([np.ones_like(at), at], axis=1)
        slopes, errors = [], []
        for values in (
            [truth[name][size] for name in names],
            [by_name[name].means[size].mean for name in names],
        ):
            fit, residual, *_ = np.linalg.lstsq(basis, np.array(values), rcond=None)
            scatter = residual[0] / (len(names) - 2)
            slopes.append(fit[1])
            errors.append(np.sqrt(scatter * np.linalg.inv(basis.T @ basis)[1, 1]))
        put_in = (law_mm(125, gas)[size] - law_mm(80, gas)[size]) / 45
        found.append(
            f"{gas} measured {slopes[1]:.6f} ± {errors[1]:.6f} mm/A, true of these pools "
            f"{slopes[0]:.6f}, put in {put_in:.6f}"
        )
    return "; ".join(found)


# --- a long recording ---------------------------------------------------------------------------


class Stream:
    """Frames of a swinging pool, generated as they are read: rendered ones with fresh noise."""

    name, frame_rate_hz, shape, warnings = "stream", 200.0, (640, 480), ()
    description, bit_depth, index = "generated frames", 8, None

    def __init__(self, rendered: list[GreyImage], frames: int) -> None:
        self._rendered, self._frames = rendered, frames
        noise = np.random.default_rng(3).normal(0, 1.5, (2 * 640, 480))
        self._noise = np.round(noise).astype(np.int16)
        self.made_s = 0.0
        """Processor time that generating them took, s."""

    def __len__(self) -> int:
        return self._frames

    def frame(self, number: int) -> Frame:
        """Generate a frame."""
        begun = time.process_time()
        # To and fro: no jump where it begins anew.
        place = number % (2 * len(self._rendered) - 2)
        image = self._rendered[min(place, 2 * len(self._rendered) - 2 - place)]
        noise = self._noise[number % 640 :][:640]
        made = np.clip(image + noise, 0, 255).astype(np.uint8)
        self.made_s += time.process_time() - begun
        return Frame(number, number / self.frame_rate_hz, made)

    def __enter__(self) -> Stream:
        return self

    def __exit__(self, *_: object) -> None:
        return


def long(folder: Path, frames: int) -> None:
    """Measure a long recording in this process; time and memory of each stretch."""
    draft = folder / "long.scenario.toml"
    draft.write_text(SCENARIO.format(frames=200), "utf-8")
    scenario = read_scenario(draft)
    rendered = [scenario.recording.frame(k).image for k in range(200)]
    stream = Stream(rendered, frames)
    (folder / "long.avi").write_bytes(b"generated")
    (folder / "long.setup.toml").write_text(scenario.setup, "utf-8")
    text = 'setup = "long.setup.toml"\n[[recording]]\nfile = "long.avi"\n'
    (folder / "long.toml").write_text(text, "utf-8")
    out = folder / "long results"
    shutil.rmtree(out, ignore_errors=True)
    took_ms: list[float] = []
    memory_mb: list[float] = []

    def measure(stretch: stretches.Stretch) -> None:
        begun, made_s = time.process_time(), stream.made_s
        stretches.measure_stretch(stretch)
        own_s = time.process_time() - begun - (stream.made_s - made_s)
        took_ms.append(1e3 * own_s / len(stretch.frames))
        memory_mb.append(psutil.Process().memory_info().rss / 1e6)
        print(f"{len(took_ms)}: {took_ms[-1]:.2f} ms, {memory_mb[-1]:.0f} MB", flush=True)

    with (
        mock.patch.object(stretches, "open_source", return_value=stream),
        mock.patch.object(study_module, "measure_stretch", measure),
    ):
        study = Study(folder / "long.toml", out)
        study.run(0)
    begun = time.process_time()
    summary = study.results()
    print(f"results {time.process_time() - begun:.1f} s; {summary.recordings[0].statuses}")
    steady = np.array(took_ms[1:])
    print(
        f"{frames} frames: {np.median(steady):.2f} ms a frame, stretches {steady.min():.2f} to "
        f"{steady.max():.2f} ms; memory after the second {memory_mb[1]:.0f}, at the end "
        f"{memory_mb[-1]:.0f}, with results {psutil.Process().memory_info().rss / 1e6:.0f} MB"
    )
    path, before = out / "measures.parquet" / "long.parquet", psutil.Process().memory_info().rss
    begun = time.process_time()
    file = parquet.ParquetFile(path)
    some = file.read_row_group(file.num_row_groups - 1, columns=["frame", "height_mm"])
    more_mb = (psutil.Process().memory_info().rss - before) / 1e6
    print(
        f"Parquet {path.stat().st_size / 1e6:.1f} MB, {file.num_row_groups} row groups: the last "
        f"{len(some)} rows of two columns in {time.process_time() - begun:.3f} s, {more_mb:.1f} MB"
    )


# --- kills --------------------------------------------------------------------------------------


def kills(folder: Path, count: int, seed: int) -> None:
    """Kill local processes and their program, then Dask's workers and their client."""
    for name in ("undisturbed", "disturbed"):
        shutil.rmtree(folder / name, ignore_errors=True)
    if (folder / "by 2 processes").exists():  # that is the run that nobody disturbed
        shutil.copytree(folder / "by 2 processes", folder / "undisturbed")
    study = folder / "study.toml"
    print("local:", kill_at_random(study, count // 2, seed), flush=True)
    shutil.rmtree(folder / "disturbed")
    with cluster(2) as (address, programs):
        pids = [one.pid for one in programs]
        print("Dask:", kill_at_random(study, count - count // 2, seed, address, pids), flush=True)


def main() -> None:
    """Do the parts that are wanted."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("parts", nargs="*", metavar="PART")
    parser.add_argument("--frames", type=int, default=200)
    parser.add_argument("--long", type=int, default=20_000)
    parser.add_argument("--kills", type=int, default=20)
    parser.add_argument("--seed", type=int, default=1)
    given = parser.parse_args()
    folder = given.folder.absolute()
    do: dict[str, Callable[[], None]] = {
        "make": lambda: make(folder, given.frames),
        "workers": lambda: workers(folder),
        "overhead": lambda: overhead(folder),
        "law": lambda: law(folder),
        "long": lambda: long(folder, given.long),
        "kills": lambda: kills(folder, given.kills, given.seed),
    }
    for part in given.parts or PARTS:
        do[part]()


if __name__ == "__main__":
    main()
