"""Frames measured cold, and in stretches: the same wherever that is, whole in their tables."""

from __future__ import annotations

import csv
import json
import os
import subprocess
import sys
import textwrap
from collections.abc import Callable, Iterator, Sequence
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
from labapp.core import pipeline
from labapp.core.pipeline import Measurement, Settings, measure, start_correction
from labapp.core.rows.correction import Correction
from labapp.core.schemes import fit
from labapp.core.sequence import following
from labapp.core.sequence.prior import Prior
from labapp.core.surface.pool_fit import FitSettings
from labapp.errors import InputError
from labapp.export.frame_result import FrameResult
from labapp.export.results import ResultsWriter
from labapp.media import Frame, open_source
from labapp.run import measurers
from labapp.run.measurers import (
    AHEAD,
    ColdMeasurer,
    RecordingMeasurer,
    WarmMeasurer,
    measuring_pool,
    stretch_pools,
)
from labapp.session.record import Record
from labapp.session.session import Session
from labapp.simulated.benchmark import SCENARIO
from labapp.simulated.simulate import simulate
from tests.same import assert_same

FRAMES = 9


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> RecordingMeasurer:
    folder = tmp_path_factory.mktemp("sequence")
    (folder / "scenario.toml").write_text(SCENARIO.format(frames=FRAMES), "utf-8")
    simulate(read_scenario(folder / "scenario.toml"), folder / "made", workers=1)
    setup = read_setup(folder / "made" / "setup.toml")
    return RecordingMeasurer(folder / "made" / "recording.avi", None, setup, Settings())


def test_two_sequences_in_turn_keep_apart(
    recording: RecordingMeasurer, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(measurers, "BATCH", 1)
    with open_source(recording.path) as source:
        images = [source.frame(k).image for k in range(3)]
    for name, order in (("a", (0, 1, 2)), ("b", (2, 1, 0))):
        (tmp_path / name).mkdir()
        for k, number in enumerate(order):
            cv2.imwrite(str(tmp_path / name / f"{k}.png"), images[number])
    jobs = [replace(recording, path=tmp_path / name) for name in "ab"]
    alone = [[one.rows for one in each(range(3))] for each in jobs]
    in_turn = zip(*(each(range(3)) for each in jobs), strict=True)
    assert [[one.rows for one in pair] for pair in in_turn] == [
        list(pair) for pair in zip(*alone, strict=True)
    ]


def assemble_measures(told: FrameResult) -> dict[str, float]:
    assert told.measurement.measures is not None
    return asdict(told.measurement.measures)


def test_stretches_are_measured_alike_here_and_by_processes(
    recording: RecordingMeasurer, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(measurers, "STRETCH", 5)
    monkeypatch.setattr(measurers, "BATCH", 2)
    told: dict[int, list[FrameResult]] = {}
    for workers in (0, 2):
        with stretch_pools(FRAMES, workers) as pools:
            assert len(pools) == workers
            told[workers] = list(replace(recording, with_surfaces=True, pools=pools)(range(FRAMES)))
    assert [one.frame for one in told[2]] == list(range(FRAMES))
    for here, there in zip(told[0], told[2], strict=True):
        assert here.rows == there.rows
        assert there.measurement.reconstruction is not None
        assert here.track_lost == there.track_lost
        np.testing.assert_equal(assemble_measures(here), assemble_measures(there))  # NaN is NaN
    cold = {one.frame for one in told[0] if one.track_lost is not None}
    assert cold == {0, 1, 2, 5, 6, 7}  # the first three of each stretch
    with ResultsWriter(tmp_path / "out", recording.setup.calibration, {}) as results:
        for one in told[2]:
            results.write(one)
    made = sorted(path.name for path in (tmp_path / "out").glob("surface_*"))
    assert made == [f"surface_{k:06d}.{end}" for k in range(FRAMES) for end in ("csv", "stl")]
    with (tmp_path / "out" / "measures.csv").open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["status"] for row in rows] == ["ok"] * FRAMES
    assert [int(row["frame"]) for row in rows] == list(range(FRAMES))


class Slow(Executor):
    """A pool that has done the first of what it was given when it has so much, and no more."""

    def __init__(self, most: int, done: Any) -> None:
        self.given: list[Future[Any]] = []
        self._most, self._done = most, done

    def submit(self, *_: Any, **__: Any) -> Future[Any]:
        self.given.append(Future())
        if len(self.given) == self._most:
            self.given[0].set_result(self._done)
        return self.given[-1]


def test_a_sequence_given_up_takes_back_what_it_had_given_out(
    recording: RecordingMeasurer, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(measurers, "BATCH", 2)
    pool = Slow(5, ["the first"])
    told = replace(recording, pools=[pool])(range(FRAMES))
    assert next(told) == "the first"
    told.close()
    assert [one.cancelled() for one in pool.given] == [False, True, True, True, True]


def test_a_frame_that_cannot_be_read_is_told_and_the_others_measured(
    recording: RecordingMeasurer, tmp_path: Path
) -> None:
    folder = tmp_path / "frames"
    folder.mkdir()
    with open_source(recording.path) as source:
        for n in range(3):
            cv2.imwrite(str(folder / f"frame_{n}.png"), np.asarray(source.frame(n).image))
    (folder / "frame_1.png").write_bytes(b"not a picture")
    told = list(replace(recording, path=folder)(range(3)))
    assert [one.measurement.status for one in told] == ["ok", "unreadable", "ok"]


def test_the_command_follows_frames(recording: RecordingMeasurer, tmp_path: Path) -> None:
    (tmp_path / "setup.toml").write_text(recording.setup.text, "utf-8")
    out = tmp_path / "results"
    given = ["reconstruct", recording.path, "--setup", tmp_path / "setup.toml", "--out", out]
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
    recording: RecordingMeasurer, tmp_path: Path
) -> None:
    with Session.create(tmp_path / "one.labsession", Record(title="a pool that swings")) as session:
        session.set_setup(recording.setup.text)
        session.import_recording(recording.path)
        first = dict(session.measure_each([0, 1, 2], warm=True))
        assert [one.status for one in first.values()] == ["ok"] * 3
        bare = told_here(recording)[1].measurement
        assert_same(first[1].measures, bare.measures)
        assert (bare.dots, bare.lattice, bare.match, bare.reconstruction) == (None,) * 4
        session.correct({1: start_correction(first[1])}, "as it is")
        again = dict(session.measure_each([0, 1, 2], warm=True))
        assert again[1].correction is not None
        assert again[2].status == "ok"


@pytest.mark.parametrize(
    ("frames", "gap", "remembered"),
    [
        (range(9), None, [1, 2, 3, 4, 5, 6]),
        (range(9), "unreadable", [1, 2, 1, 1, 2]),
        (range(9), "corrected", [1, 2, 1, 1, 2]),
        ([0, 1, 2, 3, 4, 6, 7, 8], None, [1, 2, 1, 1, 1]),  # two changes of the step
    ],
)
def test_frames_beside_a_gap_are_not_taken_for_equally_spaced(
    recording: RecordingMeasurer,
    monkeypatch: pytest.MonkeyPatch,
    frames: Sequence[int],
    gap: str | None,
    remembered: list[int],
) -> None:
    """What a frame is extrapolated from; the first three are measured by themselves."""
    found: list[int] = []
    predict = following.predictions

    def counted(prior: Prior) -> Iterator[np.ndarray]:
        found.append(len(prior.past))
        return predict(prior)

    monkeypatch.setattr(following, "predictions", counted)
    with open_source(recording.path) as source:

        def read(number: int) -> Frame:
            if gap == "unreadable" and number == 5:
                raise InputError(recording.path, "frame", number, "a frame")
            return source.frame(number)

        def corrected(number: int) -> Correction | None:
            if gap == "corrected" and number == 5:
                cold, _ = measure(source.frame(5).image, recording.setup.bench, Settings())
                return start_correction(cold)
            return None

        measurer = WarmMeasurer(read, recording.setup, Settings(), corrected)
        results = list(measurer(frames))
    wrong = [one.frame for one in results if one.measurement.status != "ok"]
    assert wrong == ([5] if gap == "unreadable" else [])
    assert found == remembered


@pytest.mark.slow
def test_a_chain_in_another_process_gives_the_same(recording: RecordingMeasurer) -> None:
    frames = [0, 1, 2, 3, 4, 7, 8]  # with a gap
    with open_source(recording.path) as source, measuring_pool(1) as pool:
        given = source.frame, recording.setup, Settings()
        here, there = (list(WarmMeasurer(*given, pool=each)(frames)) for each in (None, pool))
    assert [one.frame for one in there] == frames
    for one, other in zip(here, there, strict=True):
        assert one.track_lost == other.track_lost
        assert_same(one.measurement.measures, other.measurement.measures)


def told_here(recording: RecordingMeasurer) -> list[FrameResult]:
    return list(recording(range(3)))


# --- each frame by itself -------------------------------------------------------------------------


class Later(Executor):
    """A pool that has done nothing before it is asked for the last frame."""

    def __init__(self, last: int) -> None:
        self.begun: list[tuple[Future[Any], Any]] = []
        self._last = last

    def submit(self, work: Any, /, *given: Any, **_: Any) -> Future[Any]:
        self.begun.append((Future(), lambda: work(*given)))
        if given[0] == self._last:
            for future, do in reversed(self.begun):
                future.set_result(do())
        return self.begun[-1][0]


@pytest.fixture
def plain(monkeypatch: pytest.MonkeyPatch, recording: RecordingMeasurer) -> Any:
    """A cold measurer whose measurements say no more than grey level and correction of a frame."""

    def measure(image: np.ndarray, *given: Any) -> tuple[Measurement, None]:
        return Measurement("no-dots", f"{image[0, 0]}, {given[-1]}", given[1].scheme), None

    def read(number: int) -> Frame:
        if number == 3:
            raise InputError("3.png", "content", "cannot be decoded", "a complete image")
        return Frame(0, number / 10, np.full((2, 2), number, np.uint8))

    monkeypatch.setattr(measurers, "measure", measure)

    def measurer(pool: Executor | None = None) -> ColdMeasurer:
        corrected: Any = {5: "by hand"}.get
        return ColdMeasurer(read, recording.setup, recording.settings, corrected, pool)

    return measurer


def test_cold_frames_come_in_their_order_wherever_they_are_measured(plain: Any) -> None:
    frames = [5, 1, 3, 4, 0]
    for pool in (None, Later(last=0)):
        found = list(plain(pool)(frames))
        assert [each.frame for each in found] == frames
        assert [each.time_s for each in found] == [0.5, 0.1, None, 0.4, 0.0]
        assert [each.measurement.status for each in found] == [
            *("no-dots", "no-dots", "unreadable", "no-dots", "no-dots")
        ]
        assert found[0].measurement.reason == "5, by hand"
        assert found[1].measurement.reason == "1, None"
        assert "cannot be decoded" in found[2].measurement.reason
        assert {each.track_lost for each in found} == {None}


def test_a_pool_is_given_some_frames_ahead_which_are_taken_back_at_the_end(plain: Any) -> None:
    first = FrameResult(4, None, Measurement("no-dots", "", "fit"))
    pool = Slow(AHEAD + 1, first)
    results = plain(pool)(range(4, 100))
    assert next(results) == first
    results.close()
    assert [one.cancelled() for one in pool.given] == [False, *[True] * AHEAD]


def test_one_frame_at_a_time_is_measured_here(plain: Any) -> None:
    asked: list[int] = []

    def numbers() -> Iterator[int]:
        for number in range(9):
            asked.append(number)
            yield number

    for result in plain()(numbers()):
        assert asked[-1] == result.frame


THREADS = """
    import labapp.run.measurers as measurers
    import numpy as np
    from labapp.config.setup import read_setup
    from labapp.core.pipeline import Measurement, Settings
    from labapp.media import Frame
    from threadpoolctl import ThreadpoolController

    def measure(*_):
        import scipy.linalg
        libraries = ThreadpoolController().select(user_api="blas").info()
        print({library["num_threads"] for library in libraries})
        return Measurement("no-dots", "it is dark", "fit"), None

    measurers.measure = measure
    setup = read_setup("sample_sessions/gtaw/setup.toml")
    frame = Frame(0, None, np.zeros((2, 2), np.uint8))
    list(measurers.ColdMeasurer(lambda _: frame, setup, Settings())([0]))
"""


def test_matrices_are_multiplied_in_one_thread_from_the_first_frame_on() -> None:
    """Those of SciPy, too, which nothing may have loaded before."""
    done = subprocess.run(
        [sys.executable, "-c", textwrap.dedent(THREADS)],
        capture_output=True,
        text=True,
        check=False,
        cwd=Path(__file__).parents[2],
        env={**os.environ, "PYTHONPATH": ".", "OPENBLAS_NUM_THREADS": "2"},
    )
    assert (done.returncode, done.stdout) == (0, "{1}\n"), done.stderr


@pytest.fixture
def slipping(
    monkeypatch: pytest.MonkeyPatch, recording: RecordingMeasurer
) -> Callable[[int], ColdMeasurer]:
    """A cold measurer of the recording that has the rows of one frame a row off."""
    rig = recording.setup.rig

    def measurer(slips: int) -> ColdMeasurer:
        with open_source(recording.path) as source:
            images = {number: source.frame(number) for number in range(4)}

        def measure(image: np.ndarray, *given: Any) -> tuple[Measurement, None]:
            found, _ = pipeline.measure(image, *given)
            if image is not images[slips].image:
                return found, None
            assert found.match is not None
            match = replace(
                found.match,
                ray=found.match.ray + np.array([1, 0]),
                witness=np.roll(found.match.witness, 1, axis=0),
            )
            made = fit.reconstruct(match, rig, FitSettings())
            return replace(found, match=match, reconstruction=made), None

        monkeypatch.setattr(measurers, "measure", measure)
        return ColdMeasurer(images.__getitem__, recording.setup, recording.settings)

    return measurer


@pytest.mark.parametrize("slips", [0, 1, 3])
def test_a_frame_whose_rows_slipped_is_not_answered(
    slipping: Callable[[int], ColdMeasurer], slips: int
) -> None:
    told = list(slipping(slips)(range(4)))
    assert [each.frame for each in told] == list(range(4))
    expected = ["ambiguous-rows" if k == slips else "ok" for k in range(4)]
    assert [each.measurement.status for each in told] == expected


def test_two_frames_whose_rows_differ_are_both_not_answered(
    slipping: Callable[[int], ColdMeasurer],
) -> None:
    told = list(slipping(1)(range(2)))
    assert [each.measurement.status for each in told] == ["ambiguous-rows"] * 2


def test_what_was_measured_is_told_before_measuring_fails(
    monkeypatch: pytest.MonkeyPatch, recording: RecordingMeasurer
) -> None:
    def measure(image: np.ndarray, *given: Any) -> Any:
        if image[0, 0] == 4:
            raise OSError("a process has ended")
        return pipeline.measure(images[int(image[0, 0])], *given)

    with open_source(recording.path) as source:
        images = [source.frame(number).image for number in range(4)]
    monkeypatch.setattr(measurers, "measure", measure)

    def read(number: int) -> Frame:
        return Frame(number, None, np.full((2, 2), number, np.uint8))

    told = []
    with pytest.raises(OSError, match="a process has ended"):
        told.extend(ColdMeasurer(read, recording.setup, recording.settings)(range(9)))
    assert [each.frame for each in told] == [0, 1, 2, 3]
