"""The sample sessions are intact, close to the truth, and readable by later versions."""

from __future__ import annotations

import csv
from pathlib import Path
from unittest import mock

import numpy as np
import pytest

from labapp.errors import InputError
from labapp.session import samples
from labapp.session.copies import copy_sample
from labapp.session.results.line_trends import line_trend
from labapp.session.samples import SAMPLES, sample_folder
from labapp.session.session import Session

EXPECTED = {
    "gtaw": ["ok"] * 30,
    "thumb_tack": ["ok"] * 3,
    "blocked_rows": ["ok", "ok", "ok", "ambiguous-rows", "no-match", "ambiguous-rows"],
    "concave": ["ok"] * 6,
}


def texts(name: str, column: str) -> list[str]:
    with (sample_folder(name) / "truth.csv").open(encoding="utf-8") as file:
        return [row[column] for row in csv.DictReader(file)]


def truth(name: str, column: str) -> np.ndarray:
    return np.array([float(text) for text in texts(name, column)])


LINES = ("five_lines", "gmaw")


@pytest.fixture(params=SAMPLES)
def name(request: pytest.FixtureRequest) -> str:
    return str(request.param)


@pytest.mark.parametrize("name", EXPECTED)
def test_sample_session_is_intact_and_near_the_truth(name: str):
    path = sample_folder(name) / f"{name}.labsession"
    before = path.read_bytes()
    with Session.open(path, read_only=True) as session:
        assert session.problems() == []
        assert session.record == SAMPLES[name].record
        assert session.plane_calibration is not None
        overview = session.overview()
        assert list(overview.status) == EXPECTED[name]
        assert not overview.stale.any()
        extreme = "depth_mm" if name == "concave" else "height_mm"
        measured = np.array([status == "ok" for status in overview.status])
        error = overview.measures[extreme][measured] / truth(name, extreme)[measured] - 1
        assert np.abs(error).max() < 0.03
        assert session.frame(int(session.frames[-1])).image.any()
    assert path.read_bytes() == before


@pytest.mark.parametrize("name", LINES)
def test_line_session_is_intact_and_near_the_truth(name: str):
    with Session.open(sample_folder(name) / f"{name}.labsession", read_only=True) as session:
        assert session.problems() == []
        assert session.record == SAMPLES[name].record
        overview = session.overview()
        assert not overview.stale.any()
        if name == "gmaw":
            on = [state == "on" for state in texts(name, "pulse")]
            assert [status == "pulse" for status in overview.status] == on
            assert set(overview.status) == {"followed", "pulse"}
            v, measured = truth(name, "line_v_px"), line_trend(session).values["shift_px"]
            is_known = np.isfinite(measured)
            assert np.corrcoef(measured[is_known], v[is_known])[0, 1] > 0.9
            return
        trend = line_trend(session)
        height = trend.values["pool_height_mm"]
        is_known = np.isfinite(height)
        true = truth(name, "height_mm") + truth(name, "depth_mm")
        assert is_known.mean() > 0.6
        assert {-1, 1} == set(np.sign(true[is_known]))
        error = height / true - 1
        assert np.median(np.abs(error[is_known])) < 0.03
        assert np.abs(error[is_known]).max() < 0.15
        assert (np.abs(height - true)[is_known] < 2.5 * trend.height_sigma_mm[is_known]).all()
        is_right = [a == b for a, b in zip(trend.states, texts(name, "state"), strict=True)]
        assert np.mean(is_right) > 0.9


def test_copy_of_a_sample_follows_no_links(name: str, tmp_path: Path):
    folder = tmp_path / "copy"
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine.txt").write_text("mine")
    folder.mkdir()
    for file in (SAMPLES[name].recording, f"{name}.labsession"):
        is_folder = (sample_folder(name) / file).is_dir()
        (folder / f".{file}.part").symlink_to("../mine" if is_folder else "../mine.txt")
    with Session.open(copy_sample(name, folder)) as session:
        assert session.frame(int(session.frames[0])).image.any()
    assert (tmp_path / "mine.txt").read_text() == "mine"
    assert not list((tmp_path / "mine").iterdir())


def test_session_with_blocked_rows_contains_a_correction():
    path = sample_folder("blocked_rows") / "blocked_rows.labsession"
    with Session.open(path, read_only=True) as session:
        assert session.corrected_frames().tolist() == [2]
        correction = session.correction(2)
        assert correction is not None
        assert correction.lattice.reference == (6, 8)


def test_missing_sample_is_reported(tmp_path: Path):
    with (
        mock.patch.object(samples, "bundled", tmp_path.joinpath),
        pytest.raises(InputError) as caught,
    ):
        sample_folder("gtaw")
    assert caught.value.source == str(tmp_path / "sample_sessions/gtaw")
    assert caught.value.value == "missing"


def test_failed_session_leaves_no_file(tmp_path: Path):
    unreadable = InputError("recording.avi", "content", "damaged", "a video")
    with (
        mock.patch.object(Session, "import_recording", side_effect=unreadable),
        pytest.raises(InputError, match="damaged"),
    ):
        samples.begin_session("gtaw", tmp_path / "a.labsession")
    assert not list(tmp_path.glob("*.labsession"))
