"""`labapp calibrate fold`: the mirror image of an imaging plane in the setup file."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from labapp.cli import app
from labapp.config.setup import read_setup, update_setup

SETUP = Path(__file__).parents[1] / "sample_sessions" / "gtaw" / "setup.toml"
LEVEL = {"distance_mm": 52.0, "h_mm": 45.0, "pitch_deg": 90.0}
MIRROR = ["--point", "0", "-30", "20", "--normal", "0", "1", "1"]


@pytest.fixture
def setup(tmp_path: Path) -> Path:
    path = tmp_path / "setup.toml"
    path.write_text(SETUP.read_text("utf-8"), "utf-8")
    update_setup(path, {"imaging_plane": LEVEL})
    return path


def test_horizontal_plane_above_a_mirror_becomes_vertical(setup: Path) -> None:
    before = read_setup(setup)
    command = ["calibrate", "fold", "--setup", str(setup), *MIRROR]
    assert CliRunner().invoke(app, command).exit_code == 0
    assert read_setup(setup).text == before.text
    result = CliRunner().invoke(app, [*command, "--use"])
    assert result.exit_code == 0, result.output
    after = read_setup(setup)
    assert after.rig.imaging_plane.origin_mm[1:] == pytest.approx([-55, 42])
    np.testing.assert_allclose(after.rig.imaging_plane.normal, [0, -1, 0], atol=1e-9)
    assert after.rig.uncertainty is not None
    assert "imaging_plane.pitch_deg" not in after.rig.uncertainty.assumed


def test_mirroring_twice_restores_the_plane(setup: Path) -> None:
    update_setup(setup, {"imaging_plane": {"pitch_deg": 50.0, "yaw_deg": 20.0}})
    before = read_setup(setup).rig.imaging_plane
    options = ["--setup", str(setup), *MIRROR, "--use"]
    for _ in range(2):
        result = CliRunner().invoke(app, ["calibrate", "fold", *options])
        assert result.exit_code == 0, result.output
    after = read_setup(setup).rig.imaging_plane
    np.testing.assert_allclose(after.pose_mm, before.pose_mm, atol=1e-6)


@pytest.mark.parametrize(
    ("given", "option"),
    [
        (["--point", "0", "-30", "20", "--normal", "0", "0", "0"], "--normal"),
        (["--point", "nan", "-30", "20", "--normal", "0", "1", "0"], "--point"),
        (["--point", "0", "60", "0", "--normal", "0", "1", "1"], "--point"),
        (["--point", "0", "-30", "0", "--normal", "0", "1", "0.02"], "--normal"),
        ([*MIRROR, "--tilt-sigma", "-1"], "--tilt-sigma"),
        ([*MIRROR, "--tilt-sigma", "45"], "pitch_deg_sigma"),
    ],
)
def test_impossible_mirror_is_rejected(setup: Path, given: list[str], option: str) -> None:
    before = setup.read_text("utf-8")
    result = CliRunner().invoke(app, ["calibrate", "fold", "--setup", str(setup), *given, "--use"])
    assert result.exit_code != 0
    assert option in (result.output + str(result.exception))
    assert setup.read_text("utf-8") == before


@pytest.mark.parametrize("length", ["1e-300", "1e300"])
def test_normal_may_have_any_length(setup: Path, length: str) -> None:
    def pose(normal: list[str]) -> str:
        mirror = [*MIRROR[:4], "--normal", *normal]
        return CliRunner().invoke(app, ["calibrate", "fold", "--setup", str(setup), *mirror]).output

    assert pose(["0", length, length]) == pose(["0", "1", "1"])
