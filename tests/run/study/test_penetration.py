"""From a study's results to a model and its predictions; a model beside the measures."""

from __future__ import annotations

import csv
from dataclasses import replace
from pathlib import Path

import pytest

from labapp import Study
from labapp.core.dynamics.penetration import ModelSettings, fit_model
from labapp.export.penetration import write_model
from labapp.simulation.penetration import FEATURES, TARGET, simulate_welds
from tests.conftest import Run

LAW = 0.4
"""Back-side width over the pool's width, of the sections here."""


def rows(path: Path) -> list[dict[str, str]]:
    with path.open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


@pytest.mark.slow
def test_from_a_study_to_a_prediction(simulated: Path, tmp_path: Path, labapp: Run) -> None:
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
    code, said, _ = labapp(
        *("penetration", "fit", features, "--out", model, "--model", "arx", "--step", step),
        *("--use", "width_mm", "--orders", 0, 1, 0, "--left-out", tmp_path / "left.csv"),
    )
    assert code == 0, said
    assert "9 sections of 3 welds" in said
    assert len(rows(tmp_path / "left.csv")) == 9
    assert labapp("penetration", "predict", model, study, "--out", out)[0] == 0
    widths = [width for table in tables.values() for width in table["width_mm"]]
    found = rows(out)
    assert [float(row["model_back_width_mm"]) for row in found] == pytest.approx(
        [LAW * width for width in widths], abs=1e-3
    )
    assert {row["model"] for row in found} == {"model"}
    # The same of a recording by itself, beside its measures.
    folder = tmp_path / "alone"
    given = simulated / "recording.avi", "--setup", simulated / "setup.toml", "--warm"
    code, *_ = labapp("reconstruct", *given, "--out", folder, "--model", model, "--frames", "3:6")
    assert code == 0
    beside = [float(row["model_back_width_mm"]) for row in rows(folder / "penetration.csv")]
    assert beside == pytest.approx([LAW * w for w in tables["weld_1"]["width_mm"]], abs=0.01)
    assert labapp("penetration", "predict", model, folder, "--out", out)[0] == 0
    again = [float(row["model_back_width_mm"]) for row in rows(out)]
    assert again == pytest.approx(beside, abs=1e-4)
    # A later run without a model leaves none of its predictions there.
    assert labapp("reconstruct", *given, "--out", folder, "--frames", "0")[0] == 0
    assert not (folder / "penetration.csv").exists()


@pytest.mark.slow
def test_shape_is_there_without_surfaces_in_the_results(
    simulated: Path, tmp_path: Path, labapp: Run
) -> None:
    welds = [one.series for one in simulate_welds(3, 1)]
    model = fit_model(welds, "arx", ModelSettings(FEATURES, TARGET))
    write_model(tmp_path / "model.json", replace(model, rmse_mm=0.1))
    for more in ([], ["--warm"]):
        out = tmp_path / f"results{len(more)}"
        code, *_ = labapp(
            *("reconstruct", simulated / "recording.avi", "--setup", simulated / "setup.toml"),
            *("--out", out, "--surfaces", "none", "--frames", ":3"),
            *("--model", tmp_path / "model.json", *more),
        )
        assert code == 0
        assert not list(out.glob("surface*"))
        assert all(row["model_back_width_mm"] for row in rows(out / "penetration.csv"))


def test_what_the_commands_cannot_do(tmp_path: Path, labapp: Run) -> None:
    table, out = tmp_path / "welds.csv", tmp_path / "model.json"
    assert labapp("penetration", "simulate", "--out", table, "--welds", 3)[0] == 0
    for wrong in (["--orders", 3, 1, 0], ["--orders", 1, 0, 0], ["--use", "brightness"]):
        code, _, said = labapp("penetration", "fit", table, "--out", out, "--model", "arx", *wrong)
        assert code == 2, said
    assert not out.exists()
    out.write_text("{}")
    assert labapp("penetration", "predict", out, table, "--out", tmp_path / "p.csv")[0] == 2
    assert labapp("penetration", "onnx", out, "--out", tmp_path / "m.onnx")[0] == 2
