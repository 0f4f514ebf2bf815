"""`labapp advise`: its output, its files and its errors."""

from __future__ import annotations

import csv
from pathlib import Path

import pytest

from labapp.config.setup import read_setup, update_setup
from tests.conftest import Run

pytestmark = pytest.mark.usefixtures("little_search")

POOLS = """[pools]
kind = "convex"
width_mm = 6.5
length_mm = 7.0
height_mm = [0.2, 0.21]
"""
BENCH = """[bench]
projection_angle_deg = 26
distance_mm = 40
plane_distance_mm = [60, 65]
"""
LINES = """[pattern]
kind = "lines"
count = 5
interline_angle_deg = 2.0
fan_angle_deg = 20.0
"""


def write_question(folder: Path, text: str) -> Path:
    path = folder / "bench.toml"
    path.write_text(text, "utf-8")
    return path


def test_advice_is_printed_and_written(labapp: Run, tmp_path: Path) -> None:
    out = tmp_path / "advice"
    code, stdout, stderr = labapp(
        "advise", write_question(tmp_path, POOLS + BENCH), "--quick", "--out", out
    )
    assert code == 0, stderr
    assert "laser, projection angle: 26.00 °" in stdout
    assert "Expected mean height error" in stdout
    assert "to spare" in (out / "advice.md").read_text("utf-8")
    with (out / "advice.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert rows[0]["what"] == "recommended"
    assert 0 < float(rows[0]["error_mm"]) < 0.02
    assert min(float(rows[0][name]) for name in rows[0] if "margin" in name) >= 0
    assert (out / "advice.png").read_bytes().startswith(b"\x89PNG")
    # The setup lacks only the values that have to be measured on the bench.
    setup = out / "setup.toml"
    points = {"origin_px": [0, 480], "x_axis_px": [240, 480], "x_axis_mm": 50.8}
    points |= {"z_axis_px": [0, 240], "z_axis_mm": 50.8}
    update_setup(setup, {"image_calibration": points})
    rig = read_setup(setup).rig
    assert (rig.laser.projection_angle_deg, rig.laser.distance_mm) == (26.0, 40.0)
    assert 60 <= -rig.imaging_plane.origin_mm[1] <= 65


def test_options_override_the_file_and_no_solution_is_reported(labapp: Run, tmp_path: Path) -> None:
    out = tmp_path / "advice"
    file = write_question(tmp_path, POOLS + BENCH)
    code, stdout, stderr = labapp("advise", file, "--height", "0.5:0.6", "--quick", "--out", out)
    assert code == 1, stderr
    assert "No set-up within these limits" in stdout
    assert "dots on the imaging plane, above and below" in stdout
    assert "too little" in (out / "advice.md").read_text("utf-8")
    assert not (out / "setup.toml").exists()


@pytest.mark.parametrize(
    ("text", "options", "message"),
    [
        ("", (), "pools"),
        (POOLS + "[bnch]\n", (), "bench, the most similar"),
        (POOLS.replace("convex", "flat"), (), "pools.kind"),
        (POOLS + "[camera]\npx_per_mm = -1\n", (), "camera.px_per_mm"),
        (POOLS + "[bench]\nprojection_angle_deg = [6, 30]\n", (), "above half the fan"),
        (POOLS + LINES, (), 'pattern.kind: "lines"; expected a pattern of dots'),
        (POOLS, ("--height", "4:5"), "overhang"),
        (POOLS, ("--width", "8:6"), "pools.width_mm"),
        (POOLS, ("--width", "x"), "--width"),
        ("[pools", (), "syntax"),
    ],
)
def test_wrong_questions_are_rejected(
    labapp: Run, tmp_path: Path, text: str, options: tuple[str, ...], message: str
) -> None:
    code, _, stderr = labapp(
        "advise", write_question(tmp_path, text), *options, "--out", tmp_path / "advice"
    )
    assert code == 2
    assert message in stderr
    assert "Traceback" not in stderr
    assert not (tmp_path / "advice").exists()
