"""`labapp calibrate bench`: pictures of mirrors adjust a setup file."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from labapp.cli import app
from labapp.config.setup import read_setup
from labapp.core.images import find_dots
from labapp.errors import InputError
from labapp.simulation.forward import trace
from labapp.simulation.render import Look, render
from tests.core.test_bench_check import EXACT, TEXT, VIEW
from tests.mirrors import FlatMirror


@pytest.fixture
def setup(tmp_path: Path) -> Path:
    path = tmp_path / "setup.toml"
    path.write_text(TEXT, "utf-8")
    return path


@pytest.mark.slow
def test_rendered_plate_adjusts_the_setup_file(
    setup: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    look = Look(glow=0.0)
    laser = replace(EXACT.rig.laser, aim_x_mm=0.6)
    observation = trace(FlatMirror(), replace(EXACT.rig, laser=laser))
    image = render(observation, VIEW, look, np.random.default_rng(1)).image
    cv2.imwrite(str(tmp_path / "plate.png"), image)
    arguments = ["calibrate", "bench", str(tmp_path / "plate.png"), "--mirror", "plate:0"]
    table = tmp_path / "residuals.csv"
    arguments += ["--setup", str(setup), "--use"]
    with monkeypatch.context() as patched:
        edited = TEXT.replace("# by protractor", "# by two protractors")
        find = find_dots.find_mirror_dots
        patched.setattr(
            find_dots,
            "find_mirror_dots",
            lambda *a: (setup.write_text(edited, "utf-8"), find(*a))[1],
        )
        rejected = CliRunner().invoke(app, arguments)
    assert isinstance(rejected.exception, InputError)
    assert setup.read_text("utf-8") == edited
    result = CliRunner().invoke(app, [*arguments, "--out", str(table)])
    assert result.exit_code == 0, result.output
    uncertainty = read_setup(setup).rig.uncertainty
    assert uncertainty is not None
    assert uncertainty.status == "checked"
    assert len(table.read_text("utf-8").splitlines()) > 300


def test_prediction_needs_no_picture(setup: Path):
    result = CliRunner().invoke(app, ["calibrate", "bench", "--setup", str(setup), "--predict"])
    assert result.exit_code == 0, result.output
    assert "plate at 0 mm" in result.output


@pytest.mark.parametrize(("mirror", "is_predicted"), [("ball:10", True), ("ball:60", False)])
def test_mirror_that_reflects_no_dot_is_not_predicted(
    setup: Path, mirror: str, *, is_predicted: bool
):
    arguments = ["calibrate", "bench", "--setup", str(setup), "--predict", "--mirror", mirror]
    result = CliRunner().invoke(app, arguments)
    assert result.exit_code == 0, result.output
    assert "ball" in result.output
    assert ("not predicted" in result.output) is not is_predicted


@pytest.mark.parametrize(
    "more", [["a.png"], ["--use"], ["--out", "a.csv"], ["--free", "picture.u"]]
)
def test_prediction_ignores_no_option(setup: Path, more: list[str]):
    arguments = ["calibrate", "bench", "--setup", str(setup), "--predict", *more]
    assert isinstance(CliRunner().invoke(app, arguments).exception, InputError)


@pytest.mark.parametrize(
    "command",
    [
        ["bench", "--mirror", "plate:0", "--mirror", "plate:0", "--setup"],
        ["pattern", "--height", "0", "--height", "1", "--out", "rays.csv", "--setup"],
        ["plane", "--setup"],
    ],
)
def test_a_picture_does_not_count_twice(
    setup: Path, monkeypatch: pytest.MonkeyPatch, command: list[str]
):
    monkeypatch.chdir(setup.parent)
    cv2.imwrite("a.png", np.zeros((9, 9), np.uint8))
    Path("b.png").symlink_to("a.png")
    result = CliRunner().invoke(app, ["calibrate", *command, str(setup), "a.png", "b.png"])
    assert isinstance(result.exception, InputError)
    assert result.exception.value == "given twice"


def test_every_picture_needs_a_mirror(setup: Path):
    result = CliRunner().invoke(app, ["calibrate", "bench", "a.png", "--setup", str(setup)])
    assert result.exit_code != 0
