"""A penetration model from the results of a study, and its predictions with the measures."""

from __future__ import annotations

import csv
from dataclasses import replace
from pathlib import Path

import pytest

from labapp import Study
from labapp.core.dynamics.penetration import ModelSettings, fit_model
from labapp.core.dynamics.weld_series import in_steps
from labapp.export.penetration import write_model
from labapp.simulation.penetration import FEATURES, TARGET, simulate_welds
from tests.conftest import Run

LAW = 0.4
"""Ratio of back-side width to pool width in these sections."""


def rows(path: Path) -> list[dict[str, str]]:
    with path.open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


@pytest.mark.slow
def test_model_of_a_study_predicts_its_sections(
    simulated: Path, tmp_path: Path, labapp: Run
) -> None:
    text = f"setup = '{simulated / 'setup.toml'}'\n"
    for k in range(3):
        text += f"[[recording]]\nfile = '{simulated / 'recording.avi'}'\nname = 'weld_{k}'\n"
        text += (
            f"frames = '{3 * k}:{3 * k + 3}'\nconditions = {{ travel_mm_s = 2, start_mm = 7 }}\n"
        )
    study = tmp_path / "welds.toml"
    study.write_text(text, "utf-8")
    assert labapp("study", "run", study, "--workers", "0")[0] == 0
    tables = Study(study).tables()
    assert list(tables) == ["weld_0", "weld_1", "weld_2"]
    lines = [f"recording,position_mm,{TARGET}"]
    for name, table in tables.items():
        assert (table["convexity_mm"] > 0).all()
        for time_s, width in zip(table["time_s"], table["width_mm"], strict=True):
            lines.append(f"{name},{7 + 2 * time_s},{LAW * width}")
    (tmp_path / "sections.csv").write_text("\n".join(lines), "utf-8")
    features, model, out = (tmp_path / name for name in ("f.csv", "model.json", "p.csv"))
    assert (
        labapp("penetration", "table", study, tmp_path / "sections.csv", "--out", features)[0] == 0
    )
    step = float(tables["weld_0"]["time_s"][1] - tables["weld_0"]["time_s"][0])
    code, stdout, _ = labapp(
        *("penetration", "fit", features, "--out", model, "--model", "arx", "--step", step),
        *("--use", "width_mm", "--orders", 0, 1, 0, "--left-out", tmp_path / "left.csv"),
    )
    assert code == 0, stdout
    assert "9 sections of 3 welds" in stdout
    assert len(rows(tmp_path / "left.csv")) == 9
    assert labapp("penetration", "predict", model, study, "--out", out)[0] == 0
    widths = [width for table in tables.values() for width in table["width_mm"]]
    predictions = rows(out)
    assert [float(row["model_back_width_mm"]) for row in predictions] == pytest.approx(
        [LAW * width for width in widths], abs=1e-3
    )
    assert {row["model"] for row in predictions} == {"model"}
    # The model is also applied to a single recording, with its measures.
    folder = tmp_path / "alone"
    arguments = simulated / "recording.avi", "--setup", simulated / "setup.toml", "--warm"
    code, *_ = labapp(
        "reconstruct", *arguments, "--out", folder, "--model", model, "--frames", "3:6"
    )
    assert code == 0
    of_recording = [float(row["model_back_width_mm"]) for row in rows(folder / "penetration.csv")]
    assert of_recording == pytest.approx([LAW * w for w in tables["weld_1"]["width_mm"]], abs=0.01)
    assert labapp("penetration", "predict", model, folder, "--out", out)[0] == 0
    of_folder = [float(row["model_back_width_mm"]) for row in rows(out)]
    assert of_folder == pytest.approx(of_recording, abs=1e-4)
    # A later run without a model removes the predictions.
    assert labapp("reconstruct", *arguments, "--out", folder, "--frames", "0")[0] == 0
    assert not (folder / "penetration.csv").exists()


@pytest.mark.slow
def test_shape_features_need_no_exported_surfaces(
    simulated: Path, tmp_path: Path, labapp: Run
) -> None:
    settings = ModelSettings(FEATURES, TARGET)
    steps = [in_steps(weld.series, settings.step_s) for weld in simulate_welds(3, 1)]
    model = fit_model(steps, "arx", settings)
    write_model(tmp_path / "model.json", replace(model, rmse_mm=0.1))
    for options in ([], ["--warm"]):
        out = tmp_path / f"results{len(options)}"
        code, *_ = labapp(
            *("reconstruct", simulated / "recording.avi", "--setup", simulated / "setup.toml"),
            *("--out", out, "--surfaces", "none", "--frames", ":3"),
            *("--model", tmp_path / "model.json", *options),
        )
        assert code == 0
        assert not list(out.glob("surface*"))
        assert all(row["model_back_width_mm"] for row in rows(out / "penetration.csv"))


def test_impossible_commands_are_rejected(tmp_path: Path, labapp: Run) -> None:
    table, out = tmp_path / "welds.csv", tmp_path / "model.json"
    assert labapp("penetration", "simulate", "--out", table, "--welds", 3)[0] == 0
    for wrong in (["--orders", 3, 1, 0], ["--orders", 1, 0, 0], ["--use", "brightness"]):
        code, _, stderr = labapp(
            "penetration", "fit", table, "--out", out, "--model", "arx", *wrong
        )
        assert code == 2, stderr
    assert not out.exists()
    out.write_text("{}")
    assert labapp("penetration", "predict", out, table, "--out", tmp_path / "p.csv")[0] == 2
    assert labapp("penetration", "onnx", out, "--out", tmp_path / "m.onnx")[0] == 2
