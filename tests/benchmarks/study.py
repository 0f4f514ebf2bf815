"""Studies at scale: identical bytes from any workers, overhead, and the simulated law.

Run as ``python -m tests.benchmarks.study FOLDER [PART …] [--frames N] [--simulated N]
[--long N] [--kills N] [--seed S]``.
Parts, in this order; by default all but ``long``:

make
    Simulates 40 recordings (4 currents, 2 gases, 5 of each) of 480x640 px in the folder, and adds
    an empty, a corrupt and a missing one. ``--simulated`` frames of each are simulated, and
    repeated forwards and backwards up to ``--frames``.
workers
    Measures them with 1 and 2 processes, with a Dask cluster of 4 workers in one program, and with
    2 separate workers over TCP.
speedup
    Speed-up by a second process.
overhead
    Time of a study in addition to measuring.
law
    The summary compared with the truth.
kills
    Kills workers and programs at random times.
long
    Measures a video of 100,000 frames (``--long``, 31 GB); if interrupted, it continues when called
    again.

Times are processor times, which other programs hardly affect, unless they are called wall.
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
from typing import Any
from unittest import mock

import numpy as np
import psutil  # type: ignore[import-untyped]
from pyarrow import compute, dataset

from labapp import Study
from labapp.config.scenario import read_scenario
from labapp.config.setup import read_setup
from labapp.core.pipeline import Settings
from labapp.export.tables import frame_tables
from labapp.media import Frame, open_source
from labapp.media.recording.nut import NutWriter
from labapp.run.measurers import WarmMeasurer
from labapp.run.study import stretches
from labapp.run.study import study as study_module
from labapp.run.study.summary import StudySummary
from labapp.simulated.benchmark import scenario_text
from labapp.simulated.simulate import simulate
from tests.run.study.kill import bytes_of, kill_at_random
from tests.run.study.test_cluster import cluster

CURRENTS_A, GASES, REPEATS = (80, 95, 110, 125), ("Ar", "He"), 5
STUDIED = "repeated.nut"
PARTS = ("make", "workers", "speedup", "overhead", "law", "kills")

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
    """Return the mean sizes of the simulated pools under a condition."""
    width = 6.0 + 0.014 * (current_a - 80)
    return {"width_mm": width, "height_mm": 0.24 + 0.0012 * (current_a - 80) + 0.04 * (gas == "He")}


# --- recordings ---------------------------------------------------------------------------------


def make_recording(
    folder: Path, seed: int, frames: int, current_a: int, gas: str, repeat: int
) -> None:
    """Simulate one recording, unless it exists."""
    out = folder / f"I{current_a}_{gas}_{repeat}"
    if (out / "recording.avi").exists():
        return
    law = law_mm(current_a, gas)
    text = scenario_text(frames)
    for old, new in (
        ("width_mm = 6.66", f"width_mm = {law['width_mm']}"),
        ("height_mm = 0.29", f"height_mm = {law['height_mm']}"),
        ("seed = 6001", f"seed = {100_000 * seed + 100 * current_a + 10 * (gas == 'He') + repeat}"),
    ):
        assert old in text
        text = text.replace(old, new)
    draft = folder / f"{out.name}.toml"
    draft.write_text(text, "utf-8")
    simulate(read_scenario(draft), out, workers=1)
    draft.unlink()


def there_and_back(simulated: int) -> list[int]:
    """Return the order of repeated frames: forwards and backwards, without a jump."""
    return [*range(simulated), *range(simulated - 2, 0, -1)]


def write_repeated(recording: Path, out: Path, frames: int) -> None:
    """Repeat a short recording as a long one of raw frames, which are very fast to read."""
    with open_source(recording) as source:
        each = [source.frame(k).image for k in range(len(source))]  # in order: far faster
        images = [each[k] for k in there_and_back(len(each))]
        rate_hz = source.frame_rate_hz or 1.0
    out.unlink(missing_ok=True)
    writer = NutWriter(out, images[0].shape, 8, rate_hz, "raw")
    for number in range(frames):
        writer.write(images[number % len(images)], number / rate_hz)
    writer.close()


def make(folder: Path, frames: int, simulated: int, seed: int) -> None:
    """Simulate all recordings and write the study."""
    folder.mkdir(parents=True, exist_ok=True)
    names = [(a, gas, k) for a in CURRENTS_A for gas in GASES for k in range(1, REPEATS + 1)]
    with ProcessPoolExecutor(2) as pool:
        for job in [pool.submit(make_recording, folder, seed, simulated, *name) for name in names]:
            job.result()
    for current, gas, repeat in names:
        recording = folder / f"I{current}_{gas}_{repeat}"
        if not (recording / STUDIED).exists():
            write_repeated(recording / "recording.avi", recording / STUDIED, frames)
    (folder / "empty.avi").touch()
    (folder / "corrupt.avi").write_bytes(random.Random(1).randbytes(100_000))
    setup = f"I{CURRENTS_A[0]}_{GASES[0]}_1/setup.toml"
    text = f'title = "Current and gas"\nsetup = "{setup}"\n'
    for name in ("empty.avi", "corrupt.avi", "missing.avi", f"I{{current_a}}_{{gas}}_*/{STUDIED}"):
        text += f'\n[[recording]]\nfile = "{name}"\n'
    (folder / "study.toml").write_text(text, "utf-8")


# --- identical results from any workers ---------------------------------------------------------


class ProcessWatcher:
    """Records processor time and memory of processes and their children."""

    def __init__(self, *programs: int) -> None:
        self._programs = programs
        self._used: dict[int, float] = {}
        self.memory: list[tuple[int, int]] = []
        """Resident memory of the first program and of the largest other process, bytes."""
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._watch)

    def __enter__(self) -> ProcessWatcher:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ended.set()
        self._thread.join()

    def _watch(self) -> None:
        while not self._ended.wait(0.3):
            own, others = 0, [0]
            for program in self._programs:
                try:
                    root = psutil.Process(program)
                    for one in (root, *root.children(recursive=True)):
                        times = one.cpu_times()
                        self._used[one.pid] = times.user + times.system
                        if one.pid == self._programs[0]:
                            own = one.memory_info().rss
                        else:
                            others.append(one.memory_info().rss)
                except psutil.Error:
                    continue
            self.memory.append((own, max(others)))

    @property
    def processor_s(self) -> float:
        """Total processor time, s."""
        return sum(self._used.values())

    def memory_text(self) -> str:
        """Largest memory of the first program, and of a worker in each third of the time, MB."""
        program, worker = np.array(self.memory).T / 1e6
        thirds = [round(float(part.max())) for part in np.array_split(worker, 3)]
        return f"workers at most {thirds} MB in each third of the time, program {program.max():.0f}"


def timed(command: list[str], *others: int) -> str:
    """Run a program; return the time and memory used by it and by its worker processes."""
    start_s = time.perf_counter()
    program = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    with ProcessWatcher(program.pid, *others) as used:
        program.wait()
    wall_s = time.perf_counter() - start_s
    load = os.getloadavg()[0]
    return (
        f"{wall_s:.1f} s wall, {used.processor_s:.1f} s, {used.memory_text()} MB, load {load:.1f}"
    )


def workers(folder: Path) -> None:
    """Measure the study with processes and with Dask workers, and compare the files."""
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
    for name, measure_to in ways.items():
        out = folder / f"by {name}"
        shutil.rmtree(out, ignore_errors=True)
        words = measure_to(out)
        hashes = bytes_of(out)
        first = first or hashes
        same = "the same bytes" if hashes == first else "OTHER BYTES"
        print(f"{name}: {words}; {len(hashes)} tasks, {same}", flush=True)
        states = [one.state for one in Study(study, out).status()]
        problems = [one.problem for one in Study(study, out).status() if one.problem]
        print(f"  {states.count('done')} done, {states.count('failed')} failed: {problems}")


def _over_tcp(command: list[str]) -> str:
    with cluster(2) as (address, programs):
        return timed([*command, "--scheduler", address], *(one.pid for one in programs))


# --- speed-up -----------------------------------------------------------------------------------


def speedup(folder: Path, rounds: int = 3) -> None:
    """Measure 4 recordings with 1 and 2 processes, and with two simultaneous independent programs.

    The last is the speed-up that the machine allows at that time.
    """
    names = [f"I{current}_{GASES[0]}_1" for current in CURRENTS_A]
    studies = {"all": names, "half 1": names[:2], "half 2": names[2:]}
    for study, recordings in studies.items():
        text = f'setup = "{names[0]}/setup.toml"\n'
        text += "".join(f'[[recording]]\nfile = "{name}/{STUDIED}"\n' for name in recordings)
        (folder / f"{study}.toml").write_text(text, "utf-8")

    def run(*ways: tuple[str, int]) -> tuple[float, float]:
        """Return wall and processor time of simultaneous programs: (study, processes) each."""
        start_s, before = time.perf_counter(), os.times()
        programs = []
        for study, count in ways:
            out = folder / f"speed-up {study}"
            shutil.rmtree(out, ignore_errors=True)
            command = [
                sys.executable,
                "-m",
                "labapp",
                "study",
                "run",
                str(folder / f"{study}.toml"),
            ]
            command += ["--out", str(out), "--workers", str(count)]
            programs.append(subprocess.Popen(command, stdout=subprocess.DEVNULL))
        assert [each.wait() for each in programs] == [0] * len(programs)
        after = os.times()
        cpu_s = after.children_user + after.children_system
        return time.perf_counter() - start_s, cpu_s - before.children_user - before.children_system

    ratios = []
    for _ in range(rounds):
        one, two, separate = run(("all", 1)), run(("all", 2)), run(("half 1", 1), ("half 2", 1))
        ratios.append(
            (one[0] / two[0], one[0] / separate[0], two[1] / one[1], separate[1] / one[1])
        )
        print(
            f"wall: 1 process {one[0]:.1f} s, 2 processes {two[0]:.1f} s (x {ratios[-1][0]:.2f}), "
            f"two programs {separate[0]:.1f} s (x {ratios[-1][1]:.2f}); processor: {one[1]:.1f}, "
            f"{two[1]:.1f}, {separate[1]:.1f} s; load {os.getloadavg()[0]:.1f}",
            flush=True,
        )
    wall, ceiling, used, used_apart = np.median(ratios, axis=0)
    print(
        f"medians: speed-up {wall:.2f} (two programs {ceiling:.2f}); processor time of 2 processes "
        f"over that of 1: {used:.3f} (two programs {used_apart:.3f})"
    )


# --- overhead -----------------------------------------------------------------------------------


def overhead(folder: Path) -> None:
    """Print the time of a study of 8 recordings beyond measuring their frames, in one process."""
    part = folder / "eight.toml"
    names = [f"I{current}_{gas}_1" for current in CURRENTS_A for gas in GASES]
    text = f'setup = "{names[0]}/setup.toml"\n'
    text += "".join(f'[[recording]]\nfile = "{name}/{STUDIED}"\n' for name in names)
    part.write_text(text, "utf-8")
    setup = read_setup(folder / names[0] / "setup.toml")

    def measure(name: str) -> None:
        with open_source(folder / name / STUDIED) as source:
            for result in WarmMeasurer(source.frame, setup, Settings())(range(len(source))):
                frame_tables(result, setup.calibration)

    measure(names[0])  # loads and compiles modules
    plain_s, study_s, results_s = [], [], []
    for k in range(3):
        start_s = time.process_time()
        for name in names:
            measure(name)
        plain_s.append(time.process_time() - start_s)
        out = folder / f"overhead {k}"
        shutil.rmtree(out, ignore_errors=True)
        study, start_s = Study(part, out), time.process_time()
        study.run(0)
        study_s.append(time.process_time() - start_s)
        start_s = time.process_time()
        study.results()
        results_s.append(time.process_time() - start_s)
    overhead_s = [(a - b) / len(names) for a, b in zip(study_s, plain_s, strict=True)]
    print(f"8 recordings, three times: measured {plain_s}, as a study {study_s} s")
    print(f"overhead of a recording {overhead_s} s; results of 8, with their plots: {results_s} s")


# --- the law ------------------------------------------------------------------------------------


def law(folder: Path) -> None:
    """Compare the means of recordings and conditions with the truth, and fit the law."""
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
    with open_source(folder / name / STUDIED) as source:
        frames = len(source)
    order = there_and_back(len(rows))
    repeated = [rows[order[k % len(order)]] for k in range(frames)]
    return {key: float(np.mean([float(row[key]) for row in repeated])) for key in repeated[0]}


def _slope(summary: StudySummary, truth: Mapping[str, Mapping[str, float]], size: str) -> str:
    """Return the slope against current by least squares: simulated, of these pools, measured."""
    by_name = {one.status.recording.name: one for one in summary.recordings}
    lines = []
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
        simulated = (law_mm(125, gas)[size] - law_mm(80, gas)[size]) / 45
        lines.append(
            f"{gas} measured {slopes[1]:.6f} ± {errors[1]:.6f} mm/A, true of these pools "
            f"{slopes[0]:.6f}, put in {simulated:.6f}"
        )
    return "; ".join(lines)


# --- a long recording ---------------------------------------------------------------------------


class Reference:
    """Times a constant operation between frames, as a reference for their time."""

    EVERY = 20

    def __init__(self) -> None:
        self._values = np.random.default_rng(4).random(200_000)
        self.took_s: list[float] = []
        """Processor time of each operation."""

    def measurer(self, read: Callable[[int], Frame], *others: Any) -> WarmMeasurer:
        """Return a measurer that times the operation before every `EVERY` frames."""

        def frame(number: int) -> Frame:
            if number % self.EVERY == 0:
                start_s = time.process_time()
                np.sort(self._values)
                self.took_s.append(time.process_time() - start_s)
            return read(number)

        return WarmMeasurer(frame, *others)


def long(folder: Path, frames: int) -> None:
    """Measure a long recording in this process; print time and memory of each stretch.

    If interrupted, it continues when it is called again.
    """
    recording = f"I{CURRENTS_A[0]}_{GASES[0]}_1"
    if not (folder / "long.nut").exists():
        write_repeated(folder / recording / "recording.avi", folder / "long.nut", frames)
    text = f'setup = "{recording}/setup.toml"\n[[recording]]\nfile = "long.nut"\n'
    (folder / "long.toml").write_text(text, "utf-8")
    out = folder / "long results"
    reference = Reference()
    table: list[tuple[float, float, float]] = []

    def measure(stretch: stretches.Stretch) -> None:
        reference.took_s.clear()
        begun = time.process_time()
        stretches.measure_stretch(stretch)
        own_s = time.process_time() - begun - sum(reference.took_s)
        took_ms = 1e3 * own_s / len(stretch.frames)
        memory_mb = psutil.Process().memory_info().rss / 1e6
        table.append((took_ms, took_ms / (1e3 * np.mean(reference.took_s)), memory_mb))
        print(
            f"{stretch.frames}: {took_ms:.2f} ms, {table[-1][1]:.3f} references, "
            f"{memory_mb:.0f} MB",
            flush=True,
        )

    with (
        mock.patch.object(stretches, "WarmMeasurer", reference.measurer),
        mock.patch.object(study_module, "measure_stretch", measure),
    ):
        study = Study(folder / "long.toml", out)
        study.run(0)
    begun = time.process_time()
    summary = study.results()
    print(f"results {time.process_time() - begun:.1f} s; {summary.recordings[0].statuses}")
    for at in range(1, len(table), 10):
        took, ratio, memory = np.median(table[at : at + 10], axis=0)
        print(f"stretches from {at}: {took:.2f} ms, {ratio:.3f} references, {memory:.0f} MB")
    open_lazily(out / "measures.parquet")


def open_lazily(folder: Path) -> None:
    """Print time and memory for reading few values of a Parquet dataset."""
    before, start_s = psutil.Process().memory_info().rss, time.process_time()
    rows = dataset.dataset(folder, format="parquet")
    last = compute.field("frame") >= rows.count_rows() - 100
    few = rows.to_table(["frame", "height_mm"], filter=last)
    more_mb = (psutil.Process().memory_info().rss - before) / 1e6
    size_mb = sum(each.stat().st_size for each in folder.glob("*.parquet")) / 1e6
    print(
        f"Parquet, {size_mb:.1f} MB, {rows.count_rows()} rows: {len(few)} rows of two columns in "
        f"{time.process_time() - start_s:.3f} s, {more_mb:.1f} MB"
    )


# --- kills --------------------------------------------------------------------------------------


def kills(folder: Path, count: int, seed: int) -> None:
    """Kill local processes and their program, then Dask's workers and their client."""
    for name in ("undisturbed", "disturbed"):
        shutil.rmtree(folder / name, ignore_errors=True)
    if (folder / "by 2 processes").exists():  # the undisturbed run
        shutil.copytree(folder / "by 2 processes", folder / "undisturbed")
    study = folder / "study.toml"
    print("local:", kill_at_random(study, count // 2, seed), flush=True)
    shutil.rmtree(folder / "disturbed")
    with cluster(2) as (address, programs):
        pids = [one.pid for one in programs]
        print("Dask:", kill_at_random(study, count - count // 2, seed, address, pids), flush=True)


def main() -> None:
    """Run the chosen parts."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("parts", nargs="*", metavar="PART")
    parser.add_argument("--frames", type=int, default=200)
    parser.add_argument("--simulated", type=int, default=20)
    parser.add_argument("--long", type=int, default=100_000)
    parser.add_argument("--kills", type=int, default=20)
    parser.add_argument("--seed", type=int, default=1)
    chosen = parser.parse_args()
    folder = chosen.folder.absolute()
    parts: dict[str, Callable[[], None]] = {
        "make": lambda: make(folder, chosen.frames, chosen.simulated, chosen.seed),
        "workers": lambda: workers(folder),
        "speedup": lambda: speedup(folder),
        "overhead": lambda: overhead(folder),
        "law": lambda: law(folder),
        "long": lambda: long(folder, chosen.long),
        "kills": lambda: kills(folder, chosen.kills, chosen.seed),
    }
    for part in chosen.parts or PARTS:
        parts[part]()


if __name__ == "__main__":
    main()
