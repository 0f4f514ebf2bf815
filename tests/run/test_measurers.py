"""Frames measured cold and in stretches: equal results in any process, complete tables."""

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
from labapp.config.setup import Setup, read_setup
from labapp.core import pipeline
from labapp.core.geometry.coordinates import ImageCalibration
from labapp.core.geometry.optics import project_rays
from labapp.core.pipeline import Measurement, Settings, measure, start_correction
from labapp.core.rows.correction import Correction
from labapp.core.schemes import fit
from labapp.core.sequence import tracking
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
from labapp.simulation.camera import CameraView
from labapp.simulation.forward import trace
from labapp.simulation.pools import egg
from labapp.simulation.render import Look, render
from tests.same import assert_same
from tests.simulated_recordings import simulated_recording

FRAMES = 9


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> RecordingMeasurer:
    folder = simulated_recording(tmp_path_factory.mktemp("sequence"), FRAMES)
    setup = read_setup(folder / "setup.toml")
    return RecordingMeasurer(folder / "recording.avi", None, setup, Settings())


def test_two_interleaved_sequences_are_independent(
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
    separate = [[result.rows for result in job(range(3))] for job in jobs]
    interleaved = zip(*(job(range(3)) for job in jobs), strict=True)
    assert [[result.rows for result in pair] for pair in interleaved] == [
        list(pair) for pair in zip(*separate, strict=True)
    ]


def measures_of(result: FrameResult) -> dict[str, float]:
    assert result.measurement.measures is not None
    return asdict(result.measurement.measures)


def test_stretches_are_measured_equally_with_and_without_processes(
    recording: RecordingMeasurer, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(measurers, "STRETCH", 5)
    monkeypatch.setattr(measurers, "BATCH", 2)
    results_of: dict[int, list[FrameResult]] = {}
    for workers in (0, 2):
        with stretch_pools(FRAMES, workers) as pools:
            assert len(pools) == workers
            results_of[workers] = list(
                replace(recording, with_surfaces=True, pools=pools)(range(FRAMES))
            )
    assert [result.frame for result in results_of[2]] == list(range(FRAMES))
    for local, distributed in zip(results_of[0], results_of[2], strict=True):
        assert local.rows == distributed.rows
        assert distributed.measurement.reconstruction is not None
        assert local.track_lost == distributed.track_lost
        np.testing.assert_equal(measures_of(local), measures_of(distributed))  # NaN is NaN
    cold = {result.frame for result in results_of[0] if result.track_lost is not None}
    assert cold == {0, 1, 2, 5, 6, 7}  # the first three of each stretch
    with ResultsWriter(tmp_path / "out", recording.setup.calibration, {}) as results:
        for result in results_of[2]:
            results.write(result)
    surface_files = sorted(path.name for path in (tmp_path / "out").glob("surface_*"))
    assert surface_files == [
        f"surface_{k:06d}.{end}" for k in range(FRAMES) for end in ("csv", "stl")
    ]
    with (tmp_path / "out" / "measures.csv").open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["status"] for row in rows] == ["ok"] * FRAMES
    assert [int(row["frame"]) for row in rows] == list(range(FRAMES))


class Slow(Executor):
    """A pool that finishes only its first task, when it has a given number of tasks."""

    def __init__(self, most: int, done: Any) -> None:
        self.tasks: list[Future[Any]] = []
        self._most, self._done = most, done

    def submit(self, *_: Any, **__: Any) -> Future[Any]:
        self.tasks.append(Future())
        if len(self.tasks) == self._most:
            self.tasks[0].set_result(self._done)
        return self.tasks[-1]


def test_closed_sequence_cancels_its_tasks(
    recording: RecordingMeasurer, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(measurers, "BATCH", 2)
    pool = Slow(5, ["the first"])
    results = replace(recording, pools=[pool])(range(FRAMES))
    assert next(results) == "the first"
    results.close()
    assert [task.cancelled() for task in pool.tasks] == [False, True, True, True, True]


def test_unreadable_frame_is_reported_and_the_others_measured(
    recording: RecordingMeasurer, tmp_path: Path
) -> None:
    folder = tmp_path / "frames"
    folder.mkdir()
    with open_source(recording.path) as source:
        for n in range(3):
            cv2.imwrite(str(folder / f"frame_{n}.png"), np.asarray(source.frame(n).image))
    (folder / "frame_1.png").write_bytes(b"not a picture")
    results = list(replace(recording, path=folder)(range(3)))
    assert [result.measurement.status for result in results] == ["ok", "unreadable", "ok"]


def test_command_follows_frames(recording: RecordingMeasurer, tmp_path: Path) -> None:
    (tmp_path / "setup.toml").write_text(recording.setup.text, "utf-8")
    out = tmp_path / "results"
    arguments = ["reconstruct", recording.path, "--setup", tmp_path / "setup.toml", "--out", out]
    options = ["--frames", "2:6", "--surfaces", "none", "--warm"]
    result = CliRunner().invoke(app, [*map(str, arguments), *options])
    assert result.exit_code == 0, result.output
    assert "4 frames, 4 with a surface" in result.output
    assert json.loads((out / "run.json").read_text("utf-8"))["warm"] is True
    with (out / "measures.csv").open(encoding="utf-8", newline="") as file:
        assert [row["frame"] for row in csv.DictReader(file)] == ["2", "3", "4", "5"]


def test_benchmark_measures_every_frame_without_wrong_labels(tmp_path: Path) -> None:
    arguments = ["benchmark", "--frames", "40", "--workers", "0", "--cache", str(tmp_path)]
    result = CliRunner().invoke(app, arguments)
    assert result.exit_code == 0, result.output
    assert "100.00 % of the frames" in result.output
    assert "wrong labels            0;" in result.output
    assert (tmp_path / "oscillating_40.avi").exists()


def test_session_follows_frames_and_keeps_corrections(
    recording: RecordingMeasurer, tmp_path: Path
) -> None:
    with Session.create(tmp_path / "one.labsession", Record(title="a pool that swings")) as session:
        session.set_setup(recording.setup.text)
        session.import_recording(recording.path)
        first = dict(session.measure_each([0, 1, 2], warm=True))
        assert [measurement.status for measurement in first.values()] == ["ok"] * 3
        bare = first_results(recording)[1].measurement
        assert_same(first[1].measures, bare.measures)
        assert (bare.dots, bare.lattice, bare.match, bare.reconstruction) == (None,) * 4
        session.correct({1: start_correction(first[1])}, "as it is")
        remeasured = dict(session.measure_each([0, 1, 2], warm=True))
        assert remeasured[1].correction is not None
        assert remeasured[2].status == "ok"


@pytest.mark.parametrize(
    ("frames", "gap", "remembered"),
    [
        (range(9), None, [1, 2, 3, 4, 5, 6]),
        (range(9), "unreadable", [1, 2, 1, 1, 2]),
        (range(9), "corrected", [1, 2, 1, 1, 2]),
        ([0, 1, 2, 3, 4, 6, 7, 8], None, [1, 2, 1, 1, 1]),  # two changes of the step
    ],
)
def test_frames_beside_a_gap_are_not_treated_as_equally_spaced(
    recording: RecordingMeasurer,
    monkeypatch: pytest.MonkeyPatch,
    frames: Sequence[int],
    gap: str | None,
    remembered: list[int],
) -> None:
    """Number of frames used for each extrapolation; the first three are measured cold."""
    past_counts: list[int] = []
    predict = tracking.predictions

    def count_and_predict(prior: Prior) -> Iterator[np.ndarray]:
        past_counts.append(len(prior.past))
        return predict(prior)

    monkeypatch.setattr(tracking, "predictions", count_and_predict)
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
    wrong = [result.frame for result in results if result.measurement.status != "ok"]
    assert wrong == ([5] if gap == "unreadable" else [])
    assert past_counts == remembered


@pytest.mark.slow
def test_chain_in_another_process_gives_equal_results(recording: RecordingMeasurer) -> None:
    frames = [0, 1, 2, 3, 4, 7, 8]  # with a gap
    with open_source(recording.path) as source, measuring_pool(1) as pool:
        arguments = source.frame, recording.setup, Settings()
        local, remote = (
            list(WarmMeasurer(*arguments, pool=executor)(frames)) for executor in (None, pool)
        )
    assert [result.frame for result in remote] == frames
    for result, other in zip(local, remote, strict=True):
        assert result.track_lost == other.track_lost
        assert_same(result.measurement.measures, other.measurement.measures)


def first_results(recording: RecordingMeasurer) -> list[FrameResult]:
    return list(recording(range(3)))


# --- cold frames ----------------------------------------------------------------------------------


class Later(Executor):
    """A pool that runs its tasks, in reverse order, when the last frame is submitted."""

    def __init__(self, last: int) -> None:
        self.pending: list[tuple[Future[Any], Any]] = []
        self._last = last

    def submit(self, work: Any, /, *arguments: Any, **_: Any) -> Future[Any]:
        self.pending.append((Future(), lambda: work(*arguments)))
        if arguments[0] == self._last:
            for future, do in reversed(self.pending):
                future.set_result(do())
        return self.pending[-1][0]


@pytest.fixture
def plain(monkeypatch: pytest.MonkeyPatch, recording: RecordingMeasurer) -> Any:
    """A cold measurer whose measurements contain only grey level and correction of a frame."""

    def measure(image: np.ndarray, *arguments: Any) -> tuple[Measurement, None]:
        return Measurement("no-dots", f"{image[0, 0]}, {arguments[-1]}", arguments[1].scheme), None

    def read(number: int) -> Frame:
        if number == 3:
            raise InputError("3.png", "content", "cannot be decoded", "a complete image")
        return Frame(0, number / 10, np.full((2, 2), number, np.uint8))

    monkeypatch.setattr(measurers, "measure", measure)

    def measurer(pool: Executor | None = None) -> ColdMeasurer:
        corrected: Any = {5: "by hand"}.get
        return ColdMeasurer(read, recording.setup, recording.settings, corrected, pool)

    return measurer


def test_cold_frames_are_returned_in_order_from_any_process(plain: Any) -> None:
    frames = [5, 1, 3, 4, 0]
    for pool in (None, Later(last=0)):
        results = list(plain(pool)(frames))
        assert [result.frame for result in results] == frames
        assert [result.time_s for result in results] == [0.5, 0.1, None, 0.4, 0.0]
        assert [result.measurement.status for result in results] == [
            *("no-dots", "no-dots", "unreadable", "no-dots", "no-dots")
        ]
        assert results[0].measurement.reason == "5, by hand"
        assert results[1].measurement.reason == "1, None"
        assert "cannot be decoded" in results[2].measurement.reason
        assert {result.track_lost for result in results} == {None}


def test_frames_submitted_ahead_are_cancelled_at_the_end(plain: Any) -> None:
    first = FrameResult(4, None, Measurement("no-dots", "", "fit"))
    pool = Slow(AHEAD + 1, first)
    results = plain(pool)(range(4, 100))
    assert next(results) == first
    results.close()
    assert [task.cancelled() for task in pool.tasks] == [False, *[True] * AHEAD]


def test_frames_are_measured_one_at_a_time_without_a_pool(plain: Any) -> None:
    requested: list[int] = []

    def numbers() -> Iterator[int]:
        for number in range(9):
            requested.append(number)
            yield number

    for result in plain()(numbers()):
        assert requested[-1] == result.frame


THREADS = """
    import labapp.run.measurers as measurers
    import numpy as np
    from labapp.config.setup import read_setup
    from labapp.core.pipeline import Measurement, Settings
    from labapp.core.recording.residual_check import ResidualRecord
    from labapp.export.frame_result import FrameResult
    from labapp.media import Frame
    from labapp.run.runner import with_setup_check
    from threadpoolctl import ThreadpoolController

    def print_threads():
        import scipy.linalg
        libraries = ThreadpoolController().select(user_api="blas").info()
        print({library["num_threads"] for library in libraries})

    dark = Measurement("no-dots", "it is dark", "fit")
    setup = read_setup("sample_sessions/gtaw/setup.toml")
"""

MEASURING = """
    def measure(*_):
        print_threads()
        return dark, None

    measurers.measure = measure
    frame = Frame(0, None, np.zeros((2, 2), np.uint8))
    list(measurers.ColdMeasurer(lambda _: frame, setup, Settings())([0]))
"""

JUDGING = """
    class Record(ResidualRecord):
        def add_and_judge(self, measurement, residuals=None):
            print_threads()
            return measurement

    def in_other_processes(frames):
        yield from (FrameResult(frame, None, dark) for frame in frames)

    list(with_setup_check(in_other_processes, Record(setup.rig))([0]))
"""


@pytest.mark.parametrize("part", [MEASURING, JUDGING], ids=["measuring", "judging"])
def test_linear_algebra_uses_one_thread_from_the_first_frame(part: str) -> None:
    """This includes the libraries of SciPy, which may not have been imported before."""
    process = subprocess.run(
        [sys.executable, "-c", textwrap.dedent(THREADS) + textwrap.dedent(part)],
        capture_output=True,
        text=True,
        check=False,
        cwd=Path(__file__).parents[2],
        env={**os.environ, "PYTHONPATH": ".", "OPENBLAS_NUM_THREADS": "2"},
    )
    assert (process.returncode, process.stdout) == (0, "{1}\n"), process.stderr


LOADED = """
    import sys
    from pathlib import Path

    from labapp.config.setup import read_setup
    from labapp.core.pipeline import Settings
    from labapp.run.measurers import RecordingMeasurer, load_all

    load_all()
    before = set(sys.modules)
    folder = Path(sys.argv[1])
    setup = read_setup(folder / "setup.toml")
    list(RecordingMeasurer(folder / "recording.avi", None, setup, Settings())(range(5)))
    loaded = set(sys.modules) - before
    print({name for name in loaded if name.startswith(("labapp.", "scipy.spatial"))})
"""


def test_a_started_process_has_loaded_what_frames_need(recording: RecordingMeasurer) -> None:
    process = subprocess.run(
        [sys.executable, "-c", textwrap.dedent(LOADED), str(recording.path.parent)],
        capture_output=True,
        text=True,
        check=False,
        cwd=Path(__file__).parents[2],
        env={**os.environ, "PYTHONPATH": "."},
    )
    assert (process.returncode, process.stdout) == (0, "set()\n"), process.stderr


@pytest.fixture
def slipping(
    monkeypatch: pytest.MonkeyPatch, recording: RecordingMeasurer
) -> Callable[[int], ColdMeasurer]:
    """A cold measurer of the recording that shifts the rows of one frame by one."""
    rig = recording.setup.rig

    def measurer(shifted: int) -> ColdMeasurer:
        with open_source(recording.path) as source:
            images = {number: source.frame(number) for number in range(4)}

        def measure(image: np.ndarray, *arguments: Any) -> tuple[Measurement, None]:
            measurement, _ = pipeline.measure(image, *arguments)
            if image is not images[shifted].image:
                return measurement, None
            assert measurement.match is not None
            match = replace(
                measurement.match,
                ray=measurement.match.ray + np.array([1, 0]),
                ray_states=np.roll(measurement.match.ray_states, 1, axis=0),
            )
            reconstruction = fit.reconstruct(match, rig, FitSettings())
            return replace(measurement, match=match, reconstruction=reconstruction), None

        monkeypatch.setattr(measurers, "measure", measure)
        return ColdMeasurer(images.__getitem__, recording.setup, recording.settings)

    return measurer


@pytest.mark.parametrize("shifted", [0, 1, 3])
def test_frame_with_shifted_rows_is_refused(
    slipping: Callable[[int], ColdMeasurer], shifted: int
) -> None:
    results = list(slipping(shifted)(range(4)))
    assert [result.frame for result in results] == list(range(4))
    expected = ["ambiguous-rows" if k == shifted else "ok" for k in range(4)]
    assert [result.measurement.status for result in results] == expected


def test_two_frames_whose_rows_differ_are_both_refused(
    slipping: Callable[[int], ColdMeasurer],
) -> None:
    results = list(slipping(1)(range(2)))
    assert [result.measurement.status for result in results] == ["ambiguous-rows"] * 2


@pytest.mark.slow
def test_frames_are_measured_again_after_the_pool_has_moved_by_a_row(
    recording: RecordingMeasurer,
) -> None:
    rig, count, moved = recording.setup.rig, 12, 4
    landing_mm = project_rays(rig.laser, rig.pattern).landing_mm
    row_mm = float(landing_mm[10, 9, 1] - landing_mm[9, 9, 1])
    view = CameraView((44.0, 590.0), (242.02, 590.0), 34.925, (44.0, 499.99), 15.875)
    axes = view.origin_px, view.x_axis_px, view.x_axis_mm, view.z_axis_px, view.z_axis_mm
    setup = Setup(rig, ImageCalibration.from_three_points(*axes), "")

    def read(number: int) -> Frame:
        pool = egg(6.66, 3.0, 4.4, 0.29, (0.0, -0.6 if number < moved else -0.6 + row_mm))
        rng = np.random.default_rng(number)
        return Frame(number, None, render(trace(pool, rig), view, Look(), rng).image)

    results = list(WarmMeasurer(read, setup, Settings())(range(count)))
    statuses = [result.measurement.status for result in results]
    assert statuses[:moved] == ["ok"] * moved
    # The first frames after the move may be those with wrong rows, until the vote has turned.
    assert statuses[moved] == "ambiguous-rows"
    assert statuses[-4:] == ["ok"] * 4
    assert results[-1].track_lost is None


def test_results_before_a_failure_are_returned(
    monkeypatch: pytest.MonkeyPatch, recording: RecordingMeasurer
) -> None:
    def measure(image: np.ndarray, *arguments: Any) -> Any:
        if image[0, 0] == 4:
            raise OSError("a process has ended")
        return pipeline.measure(images[int(image[0, 0])], *arguments)

    with open_source(recording.path) as source:
        images = [source.frame(number).image for number in range(4)]
    monkeypatch.setattr(measurers, "measure", measure)

    def read(number: int) -> Frame:
        return Frame(number, None, np.full((2, 2), number, np.uint8))

    results = []
    with pytest.raises(OSError, match="a process has ended"):
        results.extend(ColdMeasurer(read, recording.setup, recording.settings)(range(9)))
    assert [result.frame for result in results] == [0, 1, 2, 3]
