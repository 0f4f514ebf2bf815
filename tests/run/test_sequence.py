"""A recording measured in stretches: the same whatever measures it, and whole in its tables."""

from __future__ import annotations

import csv
import json
from collections.abc import Generator
from concurrent.futures import Executor, Future
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from labapp.cli import app
from labapp.config.scenario import read_scenario
from labapp.config.setup import read_setup
from labapp.core.pipeline import Settings, start_correction
from labapp.export.results import ResultsWriter
from labapp.media import open_source
from labapp.run import sequence
from labapp.run.sequence import Job, Told, followers, measure_sequence
from labapp.session.record import Record
from labapp.session.session import Session
from labapp.simulated.benchmark import SCENARIO
from labapp.simulated.simulate import simulate
from tests.same import assert_same

FRAMES = 9


@pytest.fixture(scope="module")
def job(tmp_path_factory: pytest.TempPathFactory) -> Job:
    folder = tmp_path_factory.mktemp("sequence")
    (folder / "scenario.toml").write_text(SCENARIO.format(frames=FRAMES), "utf-8")
    simulate(read_scenario(folder / "scenario.toml"), folder / "made", workers=1)
    setup = read_setup(folder / "made" / "setup.toml")
    return Job(folder / "made" / "recording.avi", None, setup, Settings())


def test_two_sequences_in_turn_keep_apart(
    job: Job, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(sequence, "BATCH", 1)
    with open_source(job.path) as source:
        images = [source.frame(k).image for k in range(3)]
    for name, order in (("a", (0, 1, 2)), ("b", (2, 1, 0))):
        (tmp_path / name).mkdir()
        for k, number in enumerate(order):
            cv2.imwrite(str(tmp_path / name / f"{k}.png"), images[number])
    jobs = [Job(tmp_path / name, None, job.setup, job.settings) for name in "ab"]
    alone = [[one.rows for one in measure_sequence(each, range(3), [])] for each in jobs]
    in_turn = zip(*(measure_sequence(each, range(3), []) for each in jobs), strict=True)
    assert [[one.rows for one in pair] for pair in in_turn] == [
        list(pair) for pair in zip(*alone, strict=True)
    ]


def measures_of(told: Told) -> dict[str, float]:
    assert told.measurement.measures is not None
    return asdict(told.measurement.measures)


def test_stretches_are_measured_alike_here_and_by_processes(
    job: Job, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(sequence, "STRETCH", 5)
    monkeypatch.setattr(sequence, "BATCH", 2)
    told: dict[int, list[Told]] = {}
    for workers in (0, 2):
        with followers(FRAMES, workers) as pools:
            assert len(pools) == workers
            told[workers] = list(measure_sequence(replace(job, whole=True), range(FRAMES), pools))
    assert [one.frame for one in told[2]] == list(range(FRAMES))
    for here, there in zip(told[0], told[2], strict=True):
        assert here.rows == there.rows
        assert there.measurement.reconstruction is not None
        assert here.broke == there.broke
        np.testing.assert_equal(measures_of(here), measures_of(there))  # NaN is NaN
    cold = [one.frame for one in told[0] if one.broke is not None]
    assert {0, 5} <= set(cold)
    assert len(cold) <= 4
    with ResultsWriter(tmp_path / "out", job.setup.calibration, {}) as results:
        for one in told[2]:
            results.write(one.frame, one.time_s, one.measurement, one.rows)
    made = sorted(path.name for path in (tmp_path / "out").glob("surface_*"))
    assert made == [f"surface_{k:06d}.{end}" for k in range(FRAMES) for end in ("csv", "stl")]
    with (tmp_path / "out" / "measures.csv").open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["status"] for row in rows] == ["ok"] * FRAMES
    assert [int(row["frame"]) for row in rows] == list(range(FRAMES))


def test_a_sequence_given_up_takes_back_what_it_had_given_out(
    job: Job, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sequence, "BATCH", 2)
    given: list[Future[Any]] = []

    class Slow(Executor):
        def submit(self, *_: Any, **__: Any) -> Future[Any]:
            given.append(Future())
            if len(given) == 1:
                given[0].set_result(["the first"])
            return given[-1]

    told = measure_sequence(job, range(FRAMES), [Slow()])
    assert next(told) == "the first"
    assert isinstance(told, Generator)
    told.close()
    assert [one.cancelled() for one in given] == [False, True, True, True, True]


def test_a_frame_that_cannot_be_read_is_told_and_the_others_measured(
    job: Job, tmp_path: Path
) -> None:
    folder = tmp_path / "frames"
    folder.mkdir()
    with sequence.open_source(job.path) as source:
        for n in range(3):
            cv2.imwrite(str(folder / f"frame_{n}.png"), np.asarray(source.frame(n).image))
    (folder / "frame_1.png").write_bytes(b"not a picture")
    told = list(measure_sequence(Job(folder, None, job.setup, job.settings), range(3), []))
    assert [one.measurement.status for one in told] == ["ok", "unreadable", "ok"]


def test_the_command_follows_frames(job: Job, tmp_path: Path) -> None:
    (tmp_path / "setup.toml").write_text(job.setup.text, "utf-8")
    out = tmp_path / "results"
    given = ["reconstruct", job.path, "--setup", tmp_path / "setup.toml", "--out", out]
    some = ["--frames", "2:6", "--surfaces", "none", "--warm"]
    result = CliRunner().invoke(app, [*map(str, given), *some])
    assert result.exit_code == 0, result.output
    assert "4 frames, 4 with a surface" in result.output
    assert json.loads((out / "run.json").read_text("utf-8"))["warm"] is True
    with (out / "measures.csv").open(encoding="utf-8", newline="") as file:
        assert [row["frame"] for row in csv.DictReader(file)] == ["2", "3", "4", "5"]


def test_the_benchmark_measures_every_frame_and_no_label_wrong(tmp_path: Path) -> None:
    given = ["benchmark", "--frames", "40", "--workers", "0", "--cache", str(tmp_path)]
    result = CliRunner().invoke(app, given)
    assert result.exit_code == 0, result.output
    assert "100.00 % of the frames" in result.output
    assert "wrong labels            0;" in result.output
    assert (tmp_path / "oscillating_40.avi").exists()


def test_a_session_follows_frames_and_leaves_corrected_ones_as_they_are(
    job: Job, tmp_path: Path
) -> None:
    with Session.create(tmp_path / "one.labsession", Record(title="a pool that swings")) as session:
        session.set_setup(job.setup.text)
        session.import_recording(job.path)
        first = dict(session.measure([0, 1, 2], warm=True))
        assert [one.status for one in first.values()] == ["ok"] * 3
        bare = told_here(job)[1].measurement
        assert_same(first[1].measures, bare.measures)
        assert (bare.dots, bare.lattice, bare.match, bare.reconstruction) == (None,) * 4
        session.correct({1: start_correction(first[1])}, "as it is")
        again = dict(session.measure([0, 1, 2], warm=True))
        assert again[1].correction is not None
        assert again[2].status == "ok"


def told_here(job: Job) -> list[Told]:
    return list(measure_sequence(job, range(3), []))
