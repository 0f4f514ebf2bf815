"""`labapp lines` and its setup files."""

from __future__ import annotations

import csv
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

from labapp.config.line_setup import read_line_setup
from labapp.config.setup import read_setup
from labapp.errors import InputError
from labapp.simulation.camera import CameraView
from labapp.simulation.pools import spherical_cap
from tests.conftest import Run
from tests.line_truth.frames import LineLook, render_lines
from tests.setups import FIVE_LINES as SETUP

SAMPLES = Path(__file__).parents[1] / "sample_sessions"
VIEW = CameraView((2.0, 638.0), (452.0, 638.0), 60.0, (2.0, 188.0), 60.0)

pytestmark = pytest.mark.usefixtures("state")


@pytest.fixture
def setup(tmp_path: Path) -> Path:
    path = tmp_path / "setup.toml"
    path.write_text(SETUP, "utf-8")
    return path


def rows(path: Path) -> list[dict[str, str]]:
    with path.open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def test_setup_of_a_line_pattern(setup: Path):
    bench = read_line_setup(setup)
    assert bench.line_rig is not None
    pattern = bench.line_rig.pattern
    assert (pattern.count, pattern.interline_angle_deg, pattern.fan_angle_deg) == (5, 0.23, 5.0)
    assert bench.rig.laser.projection_angle_deg == 27.0


@pytest.mark.parametrize(
    ("old", "new", "field"),
    [
        ("count = 5", "count = 5.5", "pattern.count"),
        ("count = 5", "", "pattern.count"),
        ("count = 5", "count = 5\nrows = 3", "pattern.rows"),
        ("distance_mm = 90.0", "distance_mm = -1", "laser.distance_mm"),
        ('kind = "lines"', 'kind = "square"', "pattern.kind"),
        ("interline_angle_deg = 0.23", "interline_angle_deg = 20", "pattern.interline_angle_deg"),
    ],
)
def test_wrong_line_setup_is_rejected(setup: Path, old: str, new: str, field: str):
    setup.write_text(SETUP.replace(old, new, 1), "utf-8")
    with pytest.raises(InputError) as caught:
        read_line_setup(setup)
    assert field in [problem.field for problem in caught.value.problems]


def test_line_setup_is_rejected_as_a_dot_setup(setup: Path):
    with pytest.raises(InputError) as caught:
        read_setup(setup)
    assert caught.value.field == "pattern.kind"


@pytest.mark.slow
def test_frames_are_measured_into_tables(labapp: Run, setup: Path, tmp_path: Path):
    pools = (spherical_cap(6.0, 0.25), None)
    (tmp_path / "frames").mkdir()
    for k, pool in enumerate(pools):
        image = render_lines(pool, read_line_setup(setup).line_rig, VIEW, LineLook(),
                             np.random.default_rng(k)).image  # fmt: skip
        cv2.imwrite(str(tmp_path / "frames" / f"frame_{k}.png"), image)
    out = tmp_path / "out"
    code, stdout, _ = labapp("lines", tmp_path / "frames", "--setup", setup, "--out", out)
    assert code == 0
    assert "ok 1" in stdout
    features = rows(out / "features.csv")
    assert [row["status"] for row in features] == ["ok", "no-lines"]
    assert float(features[0]["pool_height_mm"]) == pytest.approx(0.25, rel=0.1)
    assert features[1]["pool_height_mm"] == ""
    for value, sigma, true in (
        ("pool_width_mm", "pool_width_sigma_mm", 6.0),
        ("pool_curvature_per_mm", "pool_curvature_sigma_per_mm", 0.25 * 2 / 3.0**2),
    ):
        off = float(features[0][value]) - true
        assert abs(off) < 3 * float(features[0][sigma]) < true
        assert features[1][sigma] == ""
    assert "width_mm" not in features[0]  # of the pool, in other tables
    assert float(features[0]["plane_width_mm"]) > 10.0
    assert [row["setup_status"] for row in features] == ["entered", "entered"]
    assert [row["numbered"] for row in features] == ["1", ""]
    lines = rows(out / "lines.csv")
    assert [row["number"] for row in lines] == ["1", "2", "3", "4", "5"]
    points = rows(out / "line_points.csv")
    assert {row["line"] for row in points} == {"1", "2", "3", "4", "5"}
    assert (out / "surface_000000.csv").exists()
    assert not (out / "surface_000001.csv").exists()


def test_exit_code_without_lines_is_1(labapp: Run, setup: Path, tmp_path: Path):
    noise = 20 + np.random.default_rng(1).normal(size=(640, 480))
    cv2.imwrite(str(tmp_path / "dark.png"), noise.astype(np.uint8))
    arguments = ("lines", tmp_path / "dark.png", "--setup", setup, "--out", tmp_path / "out")
    code, _, _ = labapp(*arguments)
    assert code == 1
    assert rows(tmp_path / "out" / "features.csv")[0]["state"] == "no-pool"


def test_one_line_is_tracked(labapp: Run, setup: Path, tmp_path: Path):
    (tmp_path / "frames").mkdir()
    v, u = np.mgrid[:120, :160]
    for k in range(4):
        light = 20 + 60 * np.exp(-((v - 60 - 0.5 * k - (u - 80) ** 2 / 400) ** 2) / 8)
        light += np.random.default_rng(k).normal(size=light.shape)
        cv2.imwrite(str(tmp_path / "frames" / f"frame_{k}.png"), light.astype(np.uint8))
    arguments = ("lines", tmp_path / "frames", "--setup", setup, "--out", tmp_path / "out")
    code, _, _ = labapp(*arguments, "--follow")
    assert code == 0
    shift = [float(row["shift_px"]) for row in rows(tmp_path / "out" / "track.csv")]
    assert np.diff(shift) == pytest.approx([0.5, 0.5, 0.5], abs=0.15)


def test_measuring_names_only_the_frames_that_failed(labapp: Run, tmp_path: Path):
    folder = Path(shutil.copytree(SAMPLES / "gmaw", tmp_path / "gmaw"))
    arguments = ("session", "measure", folder / "gmaw.labsession", "--frames", "0:12")
    code, stdout, stderr = labapp(*arguments)
    assert code == 0
    assert "followed" in stdout
    assert "pulse" in stdout
    assert "frame " not in stderr


def test_current_needs_a_tracked_line(labapp: Run, setup: Path, tmp_path: Path):
    (tmp_path / "frames").mkdir()
    for k in range(2):
        cv2.imwrite(str(tmp_path / "frames" / f"{k}.png"), np.full((60, 80), 20, np.uint8))
    (tmp_path / "log.csv").write_text("time_s,current_A\n0,80\n1,300\n", "utf-8")
    (tmp_path / "volts.csv").write_text("time_s,voltage_V\n0,12\n1,13\n", "utf-8")
    source, out = str(tmp_path / "frames"), str(tmp_path / "out")
    arguments = ["lines", source, "--setup", str(setup), "--out", out]
    code, _, stderr = labapp(*arguments, "--signals", str(tmp_path / "log.csv"))
    assert code == 2
    assert "--signals" in stderr
    code, _, stderr = labapp(*arguments, "--follow", "--signals", str(tmp_path / "volts.csv"))
    assert code == 2
    assert "volts.csv" in stderr
    code, _, _ = labapp(*arguments, "--follow", "--signals", str(tmp_path / "log.csv"))
    assert code == 1  # there is no line


def test_options_of_dots_are_refused_for_a_session_of_lines(labapp: Run, tmp_path: Path):
    sample = Path(__file__).parents[1] / "sample_sessions/five_lines/five_lines.labsession"
    out = tmp_path / "out"
    code, _, stderr = labapp("session", "export", sample, "--out", out, "--report", "--hdf5")
    assert code == 2
    assert "hdf5, report" in stderr
    assert not out.exists()
    code, _, _ = labapp("session", "export", sample, "--out", out)
    assert code == 0
    assert (out / "features.csv").is_file()
