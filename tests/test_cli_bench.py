"""`labapp calibrate bench`: mirrors' pictures in, an adjusted setup file out."""

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
from labapp.simulation.calibration.mirrors import FlatMirror
from labapp.simulation.forward import trace
from labapp.simulation.render import Look, render
from tests.core.test_bench_check import EXACT, TEXT, VIEW


@pytest.fixture
def setup(tmp_path: Path) -> Path:
    path = tmp_path / "setup.toml"
    path.write_text(TEXT, "utf-8")
    return path


@pytest.mark.slow
def test_a_rendered_plate_adjusts_the_setup_file(
    setup: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    look = Look(glow=0.0)
    laser = replace(EXACT.rig.laser, aim_x_mm=0.6)
    made = trace(FlatMirror(), replace(EXACT.rig, laser=laser))
    image = render(made, VIEW, look, np.random.default_rng(1)).image
    cv2.imwrite(str(tmp_path / "plate.png"), image)
    given = ["calibrate", "bench", str(tmp_path / "plate.png"), "--mirror", "plate:0"]
    table = tmp_path / "residuals.csv"
    given += ["--setup", str(setup), "--use"]
    with monkeypatch.context() as meanwhile:
        edited = TEXT.replace("# by protractor", "# by two protractors")
        find = find_dots.find_mirror_dots
        meanwhile.setattr(
            find_dots,
            "find_mirror_dots",
            lambda *a: (setup.write_text(edited, "utf-8"), find(*a))[1],
        )
        refused = CliRunner().invoke(app, given)
    assert isinstance(refused.exception, InputError)
    assert setup.read_text("utf-8") == edited
    done = CliRunner().invoke(app, [*given, "--out", str(table)])
    assert done.exit_code == 0, done.output
    known = read_setup(setup).rig.uncertainty
    assert known is not None
    assert known.status == "checked"
    assert len(table.read_text("utf-8").splitlines()) > 300


def test_it_predicts_without_a_picture(setup: Path):
    done = CliRunner().invoke(app, ["calibrate", "bench", "--setup", str(setup), "--predict"])
    assert done.exit_code == 0, done.output
    assert "plate at 0 mm" in done.output


@pytest.mark.parametrize(("mirror", "is_predicted"), [("ball:10", True), ("ball:60", False)])
def test_a_mirror_that_shows_no_dot_is_not_predicted(
    setup: Path, mirror: str, *, is_predicted: bool
):
    given = ["calibrate", "bench", "--setup", str(setup), "--predict", "--mirror", mirror]
    done = CliRunner().invoke(app, given)
    assert done.exit_code == 0, done.output
    assert "ball" in done.output
    assert ("not predicted" in done.output) is not is_predicted


def test_every_picture_needs_its_mirror(setup: Path):
    done = CliRunner().invoke(app, ["calibrate", "bench", "a.png", "--setup", str(setup)])
    assert done.exit_code != 0
