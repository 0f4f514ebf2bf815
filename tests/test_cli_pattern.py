"""`labapp calibrate pattern`: pictures of a plate give a table of rays."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from labapp.cli import app
from labapp.config.setup import read_setup
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
def test_rendered_plates_determine_the_rays(setup: Path, tmp_path: Path):
    arguments = ["calibrate", "pattern"]
    for k, z in enumerate((0.0, 5.0)):
        image = render(
            trace(FlatMirror(z), EXACT.rig), VIEW, Look(), np.random.default_rng(k)
        ).image
        cv2.imwrite(str(tmp_path / f"plate{k}.png"), image)
        arguments += [str(tmp_path / f"plate{k}.png"), "--height", str(z)]
    out = tmp_path / "rays.csv"
    result = CliRunner().invoke(
        app, [*arguments, "--setup", str(setup), "--out", str(out), "--use"]
    )
    assert result.exit_code == 0, result.output
    pattern = read_setup(setup).rig.pattern
    assert pattern.kind == "directions"
    assert len(pattern.measured) > 300
    assert pattern.marker == (10, 10)
    deviation = pattern.tangents - EXACT.rig.pattern.tangents
    i, j = np.array([ray[:2] for ray in pattern.measured]).T + 9
    assert np.sqrt(np.mean(deviation[i, j] ** 2)) < np.tan(np.radians(0.05))


@pytest.mark.parametrize(
    "given",
    [
        ["a.png", "--height", "0"],
        ["a.png", "b.png", "--height", "0"],
        ["a.png", "b.png", "--height", "2", "--height", "2"],
        ["a.png", "b.png", "--height", "0", "--height", "nan"],
    ],
)
def test_two_different_heights_are_required(setup: Path, given: list[str]):
    options = ["--setup", str(setup), "--out", str(setup.parent / "rays.csv")]
    result = CliRunner().invoke(app, ["calibrate", "pattern", *given, *options])
    assert result.exit_code != 0
    assert not (setup.parent / "rays.csv").exists()
