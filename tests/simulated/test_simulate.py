"""A simulation as a session: its contents; it is complete or absent."""

from __future__ import annotations

import errno
from pathlib import Path

import numpy as np
import pytest

from labapp.config.scenario import (
    FASTEST_VIDEO_HZ,
    SLOWEST_VIDEO_HZ,
    Scenario,
    find_scenario,
    read_scenario,
    shipped_scenarios,
)
from labapp.errors import InputError
from labapp.media import open_source
from labapp.session.session import Session
from labapp.simulated.simulate import begin_session, simulate
from labapp.simulation.recording import write_video


@pytest.fixture(scope="module")
def simulation(tmp_path_factory: pytest.TempPathFactory) -> tuple[Scenario, Path]:
    """The scenario of a hollow, two frames, and the folder of its simulation."""
    path = next(path for path in shipped_scenarios() if path.stem == "concave")
    folder = tmp_path_factory.mktemp("simulated") / "hollow"
    scenario = read_scenario(path, frames=2)
    simulate(scenario, folder, workers=1)
    return scenario, folder


def test_session_contains_the_setup_and_the_expected_sizes(
    simulation: tuple[Scenario, Path],
) -> None:
    scenario, folder = simulation
    path = folder / "hollow.labsession"
    begin_session(scenario, folder, path)
    with Session.open(path) as session:
        assert session.setup_text == (folder / "setup.toml").read_text("utf-8")
        assert session.record.title == "A hollow: its reflection is turned round both ways (I/I)"
        assert session.record.expected_height_mm == pytest.approx(-0.61, abs=0.02)
        assert session.frames.tolist() == [0, 1]
        assert session.recording is not None
        assert session.recording.path == "recording.avi"
    path.unlink()  # its lock file stays, and does not prevent a replacement


def test_exception_in_progress_leaves_no_session(simulation: tuple[Scenario, Path]) -> None:
    scenario, folder = simulation
    before = {file.name for file in folder.iterdir()}

    def stop(done: int, total: int) -> None:
        raise InterruptedError

    with pytest.raises(InterruptedError):
        begin_session(scenario, folder, folder / "other.labsession", stop)
    new_files = {file.name for file in folder.iterdir()} - before
    assert new_files <= {".other.labsession.lock"}
    simulate(scenario, folder, workers=1)  # the folder can still be replaced


def test_existing_file_is_not_overwritten(simulation: tuple[Scenario, Path]) -> None:
    scenario, folder = simulation
    path = folder / "mine.labsession"
    path.write_text("mine", "utf-8")
    with pytest.raises(InputError, match="file"):
        begin_session(scenario, folder, path)
    assert path.read_text("utf-8") == "mine"


def test_full_disk_is_reported_and_leaves_no_files(
    simulation: tuple[Scenario, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    scenario, _ = simulation
    monkeypatch.setattr("labapp.simulation.recording.write_video", full)
    with pytest.raises(InputError, match="No space left on device"):
        simulate(scenario, tmp_path / "out", workers=1)
    assert list(tmp_path.iterdir()) == []


def test_calibrated_bench_can_be_simulated(tmp_path: Path) -> None:
    """The covariance of calibration points does not change the view of the camera."""
    path = next(path for path in shipped_scenarios() if path.stem == "concave")
    covariance = [[0.01 * (row == column) for column in range(6)] for row in range(6)]
    calibrated = f"[image_calibration]\npoints_covariance_px2 = {covariance}\n"
    text = path.read_text("utf-8").replace("[image_calibration]\n", calibrated)
    assert calibrated in text
    (tmp_path / "own.toml").write_text(text, "utf-8")
    assert read_scenario(tmp_path / "own.toml").recording.view == read_scenario(path).recording.view


@pytest.mark.parametrize("rate_hz", [1e-5, 1000.5, 2000.0])
def test_frame_rate_that_a_video_cannot_store_is_rejected(tmp_path: Path, rate_hz: float) -> None:
    text = find_scenario(Path("egg")).read_text("utf-8")
    path = tmp_path / "own.toml"
    path.write_text(text.replace("frame_rate_hz = 60.0", f"frame_rate_hz = {rate_hz}"), "utf-8")
    with pytest.raises(InputError, match=r"recording\.frame_rate_hz"):
        read_scenario(path)
    path.write_text(path.read_text("utf-8") + '\nformat = "tif"\n', "utf-8")
    assert read_scenario(path).recording.frame_rate_hz == rate_hz


@pytest.mark.parametrize("rate_hz", [SLOWEST_VIDEO_HZ, FASTEST_VIDEO_HZ])
def test_video_keeps_all_frames_and_its_rate(tmp_path: Path, rate_hz: float) -> None:
    images = [np.full((48, 64), k, np.uint8) for k in range(20)]
    write_video(tmp_path / "a.avi", images, rate_hz, (64, 48))
    with open_source(tmp_path / "a.avi") as source:
        assert (len(source), source.frame_rate_hz) == (20, pytest.approx(rate_hz))


def test_noise_of_minus_zero_is_none(tmp_path: Path) -> None:
    text = (
        find_scenario(Path("egg")).read_text("utf-8").replace("[look]", "[look]\nunevenness = -0.0")
    )
    assert "unevenness" in text
    (tmp_path / "own.toml").write_text(text, "utf-8")
    read_scenario(tmp_path / "own.toml", frames=1).recording.frame(0)
