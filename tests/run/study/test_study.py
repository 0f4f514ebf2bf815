"""A study: run, interrupted, run again; reasons of failures; equal results for any workers."""

from __future__ import annotations

import csv
import errno
import os
import shutil
from concurrent.futures import BrokenExecutor
from pathlib import Path

import numpy as np
import pandas as pd
import polars as pl
import pytest
import xarray as xr
from typer.testing import CliRunner

from labapp import Study, files
from labapp.cli import app
from labapp.config.setup import read_setup
from labapp.core.pipeline import Settings, measure
from labapp.core.recording.residual_check import Residuals
from labapp.errors import InputError
from labapp.media import open_source
from labapp.run import measurers
from labapp.run.study import stretches, workers
from labapp.run.study import study as study_module
from tests.run.study.conftest import write_study
from tests.run.study.kill import bytes_of

STATES = ["done", "done", "failed", "failed", "failed"]


@pytest.fixture(autouse=True)
def _short(monkeypatch: pytest.MonkeyPatch) -> None:
    """Use stretches of three frames, so that a recording has several."""
    monkeypatch.setattr(measurers, "STRETCH", 3)


@pytest.fixture(scope="module")
def measured_once(simulated: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of the study, measured in stretches of three frames."""
    folder = tmp_path_factory.mktemp("measured")
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(measurers, "STRETCH", 3)
        Study(write_study(folder, simulated)).run(0)
    return folder


@pytest.fixture
def measured_file(measured_once: Path, tmp_path: Path) -> Path:
    """A copy of `study_file` and of its results."""
    shutil.copytree(measured_once, tmp_path, dirs_exist_ok=True)
    return tmp_path / "study.toml"


def rows_of(folder: Path) -> pd.DataFrame:
    table = pd.read_parquet(folder / "measures.parquet")
    return table.sort_values(["recording", "frame"], ignore_index=True)


def test_valid_recordings_are_measured_and_failures_explained(study_file: Path) -> None:
    study = Study(study_file)
    assert {status.state for status in study.status()} == {
        "waiting",
        "failed",
    }  # one file is missing
    notes: list[str] = []
    statuses = study.run(0, note=notes.append)
    assert [status.state for status in statuses] == STATES
    assert [(status.frames, status.frames_done) for status in statuses[:2]] == [(5, 5), (4, 4)]
    assert all(status.problem for status in statuses[2:])
    assert not any(status.problem for status in statuses[:2])
    assert [note.partition(":")[0] for note in notes] == ["empty", "corrupt", "missing"]
    assert [status.state for status in Study(study_file).status()] == STATES
    summary = study.results()
    rows = rows_of(study.folder)
    assert rows["frame"].tolist() == [0, 1, 2, 3, 4, 5, 6, 7, 8]
    assert rows["current_a"].tolist() == [80.0] * 5 + [100.0] * 4
    assert set(rows["gas"]) == {"Ar"}
    assert set(rows["status"]) == {"ok"}
    assert [group.conditions for group in summary.groups] == [
        {"current_a": 80, "gas": "Ar"},
        {"current_a": 100, "gas": "Ar"},
    ]


def test_values_equal_those_of_reconstruct(
    measured_file: Path, simulated: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    study = Study(measured_file)
    study.results()
    monkeypatch.undo()
    monkeypatch.setattr(measurers, "STRETCH", 3)
    arguments = ["reconstruct", simulated / "recording.avi", "--setup", simulated / "setup.toml"]
    options = ["--out", tmp_path / "out", "--frames", ":5", "--surfaces", "none", "--warm"]
    assert CliRunner().invoke(app, [*map(str, arguments), *map(str, options)]).exit_code == 0
    with (tmp_path / "out" / "measures.csv").open(encoding="utf-8", newline="") as file:
        expected = list(csv.DictReader(file))
    rows = rows_of(study.folder)
    rows = rows[rows["recording"] == "first"]
    for name in ("width_mm", "height_mm", "height_sigma_mm", "time_s", "dots"):
        assert rows[name].tolist() == pytest.approx([float(r[name]) for r in expected], abs=1e-6)
    assert rows["setup_status"].tolist() == [row["setup_status"] for row in expected]


def test_finished_tasks_are_not_repeated(
    measured_file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    study = Study(measured_file)
    before = bytes_of(study.folder)
    assert len(before) == 4
    measured: list[object] = []
    monkeypatch.setattr(stretches, "_measured", lambda *arguments: measured.append(arguments))
    study.run(0)
    assert not measured
    assert bytes_of(study.folder) == before


def test_changed_setup_settings_or_frames_are_measured_again(
    measured_file: Path, simulated: Path, tmp_path: Path
) -> None:
    text = measured_file.read_text("utf-8")
    changed = text.replace('name = "first"', 'name = "first"\nscheme = "ers"')
    measured_file.write_text(changed, "utf-8")
    assert [status.state for status in Study(measured_file).status()[:2]] == ["waiting", "done"]
    setup = (simulated / "setup.toml").read_text("utf-8")
    (tmp_path / "other.toml").write_text(setup + "# other\n", "utf-8")
    changed = text.replace('name = "second"', 'name = "second"\nsetup = "other.toml"')
    measured_file.write_text(changed, "utf-8")
    assert [status.state for status in Study(measured_file).status()[:2]] == ["done", "waiting"]
    measured_file.write_text(text.replace('frames = ":5"', 'frames = ":6"'), "utf-8")
    first = Study(measured_file).status()[0]
    assert (first.state, first.frames_done) == ("part", 3)


def test_conditions_can_change_without_measuring(measured_file: Path) -> None:
    text = measured_file.read_text("utf-8").replace('gas = "Ar"', 'gas = "He", speed = 2')
    measured_file.write_text(text, "utf-8")
    study = Study(measured_file)
    assert [status.state for status in study.status()] == STATES
    study.results()
    rows = rows_of(study.folder)
    assert set(rows["gas"]) == {"He"}
    assert set(rows["speed"]) == {2.0}


def test_residuals_of_frames_are_kept_in_full(measured_file: Path, simulated: Path) -> None:
    study = Study(measured_file)
    first, bench = study.plan.recordings[0], read_setup(simulated / "setup.toml").bench
    tasks = study.tasks(first)
    assert tasks is not None
    kept = {}
    for stretch in tasks.stretches:
        assert stretch.done is not None
        with stretches.StretchFile(stretch, stretch.done) as read:
            kept |= read.residuals()
    assert list(kept) == [0, 1, 2, 3, 4]
    with open_source(first.path) as source:
        found, _ = measure(source.frame(1).image, bench, first.settings)
    residuals = Residuals.of(found)
    assert residuals is not None
    assert np.array_equal(kept[1].ray, residuals.ray)
    assert np.array_equal(kept[1].residual_mm, residuals.residual_mm)
    assert np.array_equal(kept[1].surface.coefficients, residuals.surface.coefficients)
    assert np.array_equal(kept[1].surface.basis.x_knots, residuals.surface.basis.x_knots)
    assert np.array_equal(kept[1].surface.basis.y_knots, residuals.surface.basis.y_knots)


def test_process_that_died_while_idle_is_replaced() -> None:
    with workers.local_workers(1, tasks=1) as team:
        assert isinstance(team.executor, workers._Processes)
        (pool,) = team.executor._idle
        assert pool is not None
        (process,) = pool._processes.values()
        process.kill()

        def use_until_broken() -> None:
            while True:
                pool.submit(os.getpid).result()

        with pytest.raises(BrokenExecutor):
            use_until_broken()
        assert team.executor.submit(max, 1, 2).result() == 2


@pytest.mark.slow
def test_files_are_equal_for_any_number_of_processes(measured_file: Path, tmp_path: Path) -> None:
    digests = {0: bytes_of(Study(measured_file).folder)}
    for count in (1, 2):
        study = Study(measured_file, tmp_path / f"out_{count}")
        assert [status.state for status in study.run(count)] == STATES
        digests[count] = bytes_of(study.folder)
    assert digests[0] == digests[1] == digests[2]
    assert len(digests[0]) == 4


def test_stopped_run_continues_where_it_stopped(study_file: Path) -> None:
    study = Study(study_file)

    def stop(progress: study_module.StudyProgress) -> None:
        if progress.frames_done >= 3:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        study.run(0, progress=stop)
    before = bytes_of(study.folder)
    assert len(before) == 1
    assert study.status()[0].state == "part"
    study.results()  # of the finished part
    assert len(rows_of(study.folder)) == 3
    study.run(0)
    assert [status.state for status in study.status()] == STATES
    assert before.items() <= bytes_of(study.folder).items()


def test_full_disk_stops_a_run_without_loss(
    study_file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    study = Study(study_file)
    write = stretches.write_atomically
    written: list[Path] = []

    def write_until_full(path: Path, content: bytes) -> None:
        written.append(path)
        if len(written) == 3:
            raise OSError(errno.ENOSPC, "no space left")
        write(path, content)

    monkeypatch.setattr(stretches, "write_atomically", write_until_full)
    with pytest.raises(InputError) as error:
        study.run(0)
    assert "no space left" in str(error.value)
    monkeypatch.undo()
    monkeypatch.setattr(measurers, "STRETCH", 3)
    assert not list(study.folder.glob("*/.*.part"))
    assert len(bytes_of(study.folder)) == 1
    assert [status.state for status in study.run(0)] == STATES


def test_damaged_file_is_measured_again(measured_file: Path) -> None:
    study = Study(measured_file)
    before = bytes_of(study.folder)
    damaged = sorted((study.folder / "stretches").glob("*.npz"))
    for path, content in zip(
        damaged, (b"", b"PK none", damaged[2].read_bytes()[:-400]), strict=False
    ):
        path.write_bytes(content)
    damaged[3].write_bytes(damaged[3].read_bytes().replace(b"ok", b"no"))
    states = [recording.status.state for recording in study.results().recordings]
    assert "done" not in states
    study.run(0)
    assert [recording.status.state for recording in study.results().recordings] == STATES
    assert bytes_of(study.folder) == before


def test_changed_recording_is_checked_again(
    measured_file: Path, simulated: Path, tmp_path: Path
) -> None:
    (tmp_path / "missing.avi").write_bytes((simulated / "recording.avi").read_bytes())
    assert Study(measured_file).status()[4].problem
    status = Study(measured_file).run(0)[4]
    assert (status.state, status.problem, status.frames) == ("done", "", 9)


def test_only_one_run_at_a_time(study_file: Path) -> None:
    study = Study(study_file)
    with study._alone(), pytest.raises(InputError):
        study.run(0)


def test_folder_with_other_files_is_rejected(study_file: Path, tmp_path: Path) -> None:
    (tmp_path / "theirs").mkdir()
    (tmp_path / "theirs" / "thesis.txt").touch()
    with pytest.raises(InputError):
        Study(study_file, tmp_path / "theirs")
    with pytest.raises(InputError):
        Study(study_file, study_file)


@pytest.mark.parametrize("key", ["setup", "frames"])
def test_wrong_key_of_a_recording_does_not_stop_the_others(study_file: Path, key: str) -> None:
    text = study_file.read_text("utf-8")
    wrong = {"setup": 'setup = "none.toml"', "frames": 'frames = "70:"'}[key]
    changed = text.replace('frames = ":5"', wrong)
    study_file.write_text(changed, "utf-8")
    statuses = Study(study_file).run(0)
    assert [status.state for status in statuses] == ["failed", *STATES[1:]]
    assert key in statuses[0].problem


def test_dataset_opens_lazily_and_has_units(measured_file: Path) -> None:
    study = Study(measured_file)
    study.results()
    scanned = pl.scan_parquet(study.folder / "measures.parquet" / "*.parquet")
    mean = scanned.filter(pl.col("current_a") == 100).select(pl.col("height_mm").mean())
    rows = rows_of(study.folder)
    assert mean.collect().item() == rows[rows["current_a"] == 100]["height_mm"].mean()
    from pyarrow import parquet

    schema = parquet.read_schema(study.folder / "measures.parquet" / "first.parquet")
    assert schema.field("height_sigma_mm").metadata[b"units"] == b"mm"
    # A recording removed from the study is removed from its results.
    text = measured_file.read_text("utf-8").replace('name = "second"', 'name = "other"')
    measured_file.write_text(text, "utf-8")
    Study(measured_file).results()
    assert set(rows_of(study.folder)["recording"]) == {"first", "other"}


def test_surfaces_are_an_array_over_frames(measured_file: Path, simulated: Path) -> None:
    study = Study(measured_file)
    study.results(surfaces=True)
    assert not (study.folder / "surfaces.zarr").exists()  # none were stored
    study.run(0, surfaces=True)
    study.results(surfaces=True)
    data = xr.open_zarr(study.folder / "surfaces.zarr", group="second", consolidated=False)
    assert data["z_mm"].dims == ("frame", "y", "x")
    assert data["frame"].values.tolist() == [5, 6, 7, 8]
    assert {data[name].attrs["units"] for name in ("z_mm", "x", "y")} == {"mm"}
    rows = rows_of(study.folder)
    heights = rows[rows["recording"] == "second"]["height_mm"].to_numpy()
    np.testing.assert_allclose(data["z_mm"].max(("x", "y")).values, heights, atol=2e-3)
    setup = read_setup(simulated / "setup.toml")
    with open_source(simulated / "recording.avi") as source:
        measurement, _ = measure(source.frame(5).image, setup.bench, Settings())
    assert measurement.reconstruction is not None
    z_mm = data["z_mm"].sel(frame=5)
    for x, y in ((0.0, 0.0), (1.0, -1.0)):
        stored = z_mm.sel(x=x, y=y, method="nearest")
        expected = measurement.reconstruction.surface.height(np.array(stored.x), np.array(stored.y))
        assert float(stored) == pytest.approx(float(expected), abs=1e-6)


def test_failing_tasks_are_retried_and_then_reported(
    study_file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    attempts: list[object] = []
    measured = stretches._measured

    def flaky(stretch: stretches.Stretch, measurer: object) -> bytes:
        attempts.append(stretch.frames)
        if stretch.frames == range(3) and len(attempts) < workers.ATTEMPTS:
            raise RuntimeError("a hiccup")
        if stretch.frames == range(8, 9):
            raise RuntimeError("always")
        return measured(stretch, measurer)

    monkeypatch.setattr(stretches, "_measured", flaky)
    statuses = Study(study_file).run(0)
    assert [status.state for status in statuses] == ["done", "failed", *STATES[2:]]
    assert "always" in statuses[1].problem
    assert attempts.count(range(8, 9)) == workers.ATTEMPTS
    monkeypatch.undo()
    monkeypatch.setattr(measurers, "STRETCH", 3)
    assert [status.state for status in Study(study_file).run(0)] == STATES


def test_temporary_files_of_a_killed_run_are_deleted(
    measured_file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    study = Study(measured_file)
    temporary = files.beside(study.folder / "stretches" / "x.npz")
    temporary.touch()
    study.run(0)
    assert temporary.exists()  # another run may be writing it
    monkeypatch.setattr(study_module, "OLD_S", -1.0)
    study.run(0)
    assert not temporary.exists()
