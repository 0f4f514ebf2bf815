"""Tables of features, model files, predictions frame by frame, ONNX."""

from __future__ import annotations

import json
import pickle
import tracemalloc
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.io import loadmat

from labapp.core.dynamics.penetration import Kind, ModelSettings, PenetrationModel, fit_model
from labapp.core.dynamics.weld_series import Orders, WeldSeries, in_steps
from labapp.core.pipeline import Measurement
from labapp.core.surface.measures import Measures
from labapp.errors import InputError
from labapp.export.features import FeatureTable, feature_sigmas
from labapp.export.frame_result import FrameResult
from labapp.export.penetration import (
    Predictor,
    prediction_csv,
    read_model,
    write_model,
    write_onnx,
)
from labapp.simulation.penetration import FEATURES, TARGET, simulate_welds

WELDS = tuple(one.series for one in simulate_welds(4, 2))


@cache
def fitted(kind: Kind) -> PenetrationModel:
    settings = ModelSettings(FEATURES, TARGET, orders=Orders(1, 2, 1), full_mm=0.5)
    steps = [in_steps(one, settings.step_s) for one in WELDS[:3]]
    model = fit_model(steps, kind, settings)
    return replace(model, factor=1.2, rmse_mm=0.1)


@pytest.fixture(scope="module", params=["arx", "gp"])
def model(request: pytest.FixtureRequest) -> PenetrationModel:
    return fitted(request.param)


# --- tables -------------------------------------------------------------------------------------


def test_table_is_read_as_written(tmp_path: Path) -> None:
    written = FeatureTable(FEATURES, TARGET, WELDS)
    written.write(tmp_path / "features.csv")
    read = FeatureTable.read(tmp_path / "features.csv")
    assert (read.features, read.target) == (FEATURES, TARGET)
    for one, other in zip(read.welds, WELDS, strict=True):
        assert one.name == other.name
        for name in ("time_s", "value", "noise", "level", "target", "target_sigma"):
            expected = getattr(other, name)
            np.testing.assert_allclose(getattr(one, name), expected, rtol=1e-6, equal_nan=True)


def test_table_can_be_read_as_a_matlab_file(tmp_path: Path) -> None:
    FeatureTable(FEATURES, TARGET, WELDS).write(tmp_path / "features.mat")
    read = loadmat(tmp_path / "features.mat")["features"][0, 0]
    count = sum(len(weld.time_s) for weld in WELDS)
    assert read["convexity_sigma_noise_mm"].shape == (count, 1)
    assert read["width_mm"][:, 0] == pytest.approx(np.concatenate([w.value[:, 0] for w in WELDS]))
    assert [str(cell[0]) for cell in read["recording"][[0, -1], 0]] == ["weld_01", "weld_04"]


@pytest.mark.parametrize(
    "text",
    [
        "",
        "recording,time_s\nweld,0\n",
        "recording,width_mm\nweld,6\n",
        "time_s,width_mm\n0,6\n",
        "recording,time_s,width_mm\nweld,0,six\n",
        "recording,time_s,width_mm\nweld,1,6\nweld,1,6\n",
        "recording,time_s,width_mm\nweld,,6\n",
        "recording,time_s,width_mm,a_mm,b_mm\nweld,0,6,1,2\n",
        "recording,time_s,width_mm,width_mm\nweld,0,6,6\n",
        "recording,time_s,width_mm\n",
        "recording,time_s,width_mm\nweld,0,6,7\n",
        "recording,time_s,width_mm\nweld,0,1e300\n",
        "recording,time_s,width_mm,width_sigma_noise_mm\nweld,0,6,-0.1\n",
    ],
)
def test_invalid_table_is_rejected(text: str, tmp_path: Path) -> None:
    (tmp_path / "features.csv").write_text(text, "utf-8")
    with pytest.raises(InputError):
        FeatureTable.read(tmp_path / "features.csv")


def test_impossible_choice_fit_or_format_is_rejected(tmp_path: Path) -> None:
    table = FeatureTable(FEATURES, TARGET, WELDS)
    with pytest.raises(InputError):
        table.chosen(("area_mm2",))
    with pytest.raises(InputError):
        replace(table, welds=WELDS[:2]).fit("arx", ModelSettings(FEATURES, TARGET))
    with pytest.raises(InputError):
        table.write(tmp_path / "features.xlsx")


def test_uncertainty_of_features_excludes_the_setup() -> None:
    columns = {
        name: np.array([value])
        for name, value in {
            "width_mm": 6.0,
            "width_sigma_mm": 0.13,
            "width_sigma_level_mm": 0.04,
            "width_sigma_setup_mm": 0.12,
            "asymmetry": 0.1,
            "asymmetry_sigma": 0.05,
        }.items()
    }
    noise, level = feature_sigmas("width_mm", columns)
    assert (noise[0], level[0]) == pytest.approx((0.03, 0.04))
    noise, level = feature_sigmas("asymmetry", columns)  # no parts are known
    assert (noise[0], level[0]) == pytest.approx((0.05, 0))


# --- model files --------------------------------------------------------------------------------


def test_stored_model_gives_equal_predictions(model: PenetrationModel, tmp_path: Path) -> None:
    write_model(tmp_path / "model.json", model)
    read = read_model(tmp_path / "model.json")
    assert read.settings == model.settings
    assert (read.kind, read.factor, read.rmse_mm) == (model.kind, 1.2, 0.1)
    expected, predicted = model.predict(WELDS[3]), read.predict(WELDS[3])
    np.testing.assert_array_equal(predicted.value, expected.value)
    np.testing.assert_array_equal(predicted.sigma, expected.sigma)
    np.testing.assert_array_equal(predicted.is_outside, expected.is_outside)


def changed(key: str, value: Any) -> Callable[[dict[str, Any]], object]:
    *folders, last = key.split("/")

    def change(content: dict[str, Any]) -> None:
        for folder in folders:
            content = content[folder]
        assert last in content
        content[last] = value

    return change


@pytest.mark.parametrize(
    "damage",
    [
        changed("program", "other"),
        changed("format", 2),
        changed("kind", "svm"),
        changed("kind", ["gp"]),
        changed("features", []),
        changed("features", ["width_mm", "width_mm", "length_mm"]),
        changed("features", ["width_mm", "length_mm", "os.system"]),
        changed("step_s", 0.0),
        changed("step_s", 1e-9),
        changed("step_s", float("nan")),
        changed("time_constants_s", []),
        changed("time_constants_s", [-1.0]),
        changed("time_constants_s", [1e300]),
        changed("orders/lags", 0),
        changed("orders/lags", 10**9),
        changed("orders/delay", 10**9),
        changed("orders/delay", -1),
        changed("orders/poles", True),
        changed("full_mm", -1),
        changed("target", "=cmd()"),
        changed("center", [1.0]),
        changed("scale", [0.0] * 6),
        changed("low", [float("nan")] * 6),
        changed("mean_mm", 10**400),
        changed("factor", float("inf")),
        changed("static", None),
        changed("static/values", [0.0] * 100_000),
        changed("static/values", []),
        changed("static/points", [[1.0]]),
        changed("static/variances", [-1.0] * 3),
        changed("static/lengths", [0.0] * 6),
        changed("static/signal", -1.0),
        changed("static/signal", "much"),
        changed("static/signal", "1.5"),
        changed("mean_mm", True),
        changed("rmse_mm", "0.1"),
        changed("step_s", True),
        changed("scale", ["1"] * 6),
        changed("scale", [True] * 6),
        changed("low", [1e6] * 6),
        changed("center", [[0.0], [0.0, 1.0]]),
    ],
)
def test_damaged_model_is_rejected(damage: Callable[[Any], object], tmp_path: Path) -> None:
    path = tmp_path / "model.json"
    write_model(path, fitted("gp"))
    content = json.loads(path.read_text("utf-8"))
    damage(content)
    path.write_text(json.dumps(content), "utf-8")
    with pytest.raises(InputError):
        read_model(path)


@pytest.mark.parametrize(
    "content", [b"", b"[]", b"{}", b"null", b"[" * 100_000, b"\xff\xfe", pickle.dumps([1])]
)
def test_invalid_model_file_is_rejected(content: bytes, tmp_path: Path) -> None:
    (tmp_path / "model.json").write_bytes(content)
    with pytest.raises(InputError):
        read_model(tmp_path / "model.json")


def test_linear_model_with_wrong_weights_is_rejected(tmp_path: Path) -> None:
    write_model(tmp_path / "model.json", fitted("arx"))
    content = json.loads((tmp_path / "model.json").read_text("utf-8"))
    content["static"]["weights"] = [1.0]
    (tmp_path / "model.json").write_text(json.dumps(content), "utf-8")
    with pytest.raises(InputError):
        read_model(tmp_path / "model.json")


@pytest.mark.parametrize("kind", ["arx", "gp"])
@pytest.mark.parametrize("value", [None, "text", float("nan"), -1e15, [], [[1.0]], {}, "missing"])
def test_error_names_the_damaged_field(kind: str, value: Any, tmp_path: Path) -> None:
    path = tmp_path / "model.json"
    write_model(path, fitted(kind))
    original = path.read_text("utf-8")
    content = json.loads(original)
    names = [*content, *(f"{part}.{key}" for part in ("orders", "static") for key in content[part])]
    for name in set(names) - {"version"}:  # of the writing program, not used
        damaged = json.loads(original)
        *parts, key = name.split(".")
        of = damaged[parts[0]] if parts else damaged
        if value == "missing":
            del of[key]
        elif (name, value) in [("full_mm", None), ("target", "text")]:
            continue
        else:
            of[key] = value
        path.write_text(json.dumps(damaged), "utf-8")
        with pytest.raises(InputError) as error:
            read_model(path)
        # Of an object without fields, the first is missing; of an array, one item may be wrong.
        field = error.value.field
        assert field == name or field.startswith((f"{name}.", f"{name}[")), field
        assert error.value.source == str(path)


def test_long_text_in_an_array_is_rejected_without_copies(tmp_path: Path) -> None:
    write_model(tmp_path / "model.json", fitted("gp"))
    content = json.loads((tmp_path / "model.json").read_text("utf-8"))
    content["static"]["points"][1][0] = "x" * 1_000_000
    (tmp_path / "model.json").write_text(json.dumps(content), "utf-8")
    tracemalloc.start()
    try:
        with pytest.raises(InputError, match=r"static\.points\[1\]\[0\]"):
            read_model(tmp_path / "model.json")
        assert tracemalloc.get_traced_memory()[1] < 50_000_000
    finally:
        tracemalloc.stop()


def test_linear_model_with_negative_variances_is_rejected(tmp_path: Path) -> None:
    write_model(tmp_path / "model.json", fitted("arx"))
    content = json.loads((tmp_path / "model.json").read_text("utf-8"))
    content["static"]["covariance"] = (-np.array(content["static"]["covariance"])).tolist()
    (tmp_path / "model.json").write_text(json.dumps(content), "utf-8")
    with pytest.raises(InputError, match=r"static\.covariance"):
        read_model(tmp_path / "model.json")


# --- predictions --------------------------------------------------------------------------------


def frames(weld: WeldSeries) -> list[FrameResult]:
    """Frames with the features of a weld; NaN: not measured."""
    names = [*Measures.__dataclass_fields__]
    results = []
    for k, time_s in enumerate(weld.time_s.tolist()):
        width, length, convexity = weld.value[k].tolist()
        sizes: dict[str, Any] = dict.fromkeys(names, np.nan)
        for name, column in (("width", 0), ("length", 1), ("convexity", 2)):
            noise, level = weld.noise[k, column], weld.level[k, column]
            sizes[f"{name}_sigma_mm"] = np.hypot(noise, level)
            sizes[f"{name}_sigma_level_mm"] = level
        sizes |= {"width_mm": width, "length_mm": length, "convexity_mm": convexity}
        measured = np.isfinite(width)
        measurement = Measurement("ok" if measured else "no-dots", "", "fit",
                             measures=Measures(**sizes) if measured else None)  # fmt: skip
        results.append(FrameResult(k, time_s, measurement))
    return results


def test_predictions_frame_by_frame_equal_those_of_the_weld(model: PenetrationModel) -> None:
    value = WELDS[3].value.copy()
    value[100:130], value[300:450] = np.nan, np.nan  # a short gap, and one that is not bridged
    weld = replace(WELDS[3], value=value)
    predictor = Predictor("bench", model)
    shown = []
    for result in frames(weld):
        predictor.add(result)
        shown.append(predictor.values()["penetration_mm"])
    expected, predicted = model.predict(weld), predictor.predictions()
    assert predicted is not None
    assert np.isnan(expected.value).any()
    np.testing.assert_allclose(predicted.time_s, expected.time_s)
    np.testing.assert_allclose(predicted.value, expected.value, rtol=1e-9)
    np.testing.assert_allclose(predicted.sigma, expected.sigma, rtol=1e-6)
    # The last complete step is shown, or nothing if there is no prediction.
    assert shown[0] is None
    assert shown[250] == pytest.approx(expected.value[int(250 / 3) - 1])
    assert shown[440] is None


def test_recording_without_times_is_rejected() -> None:
    predictor = Predictor("bench", fitted("arx"))
    with pytest.raises(InputError):
        predictor.add(FrameResult(0, None, Measurement("no-dots", "", "fit")))


def test_predictions_are_marked_with_their_model(model: PenetrationModel) -> None:
    far = replace(WELDS[3], value=WELDS[3].value + 5)
    predictions = {"a": model.predict(WELDS[3]), "b": model.predict(far)}
    head, *rows = prediction_csv("bench", model, predictions).splitlines()
    assert head.split(",")[2:4] == ["model_back_width_mm", "model_back_width_sigma_mm"]
    assert all(row.endswith(",bench") for row in rows)
    assert {row.split(",")[-2] for row in rows if row.startswith("b")} == {"extrapolated"}


# --- ONNX ---------------------------------------------------------------------------------------


def test_onnx_gives_equal_values(model: PenetrationModel, tmp_path: Path) -> None:
    import onnx
    from onnx.reference import ReferenceEvaluator

    write_onnx(tmp_path / "model.onnx", model)
    graph = onnx.load(tmp_path / "model.onnx")
    run = ReferenceEvaluator(graph)
    steps, predicted = in_steps(WELDS[3], 0.1), model.predict(WELDS[3])
    for last in (60, 111, 199):
        window = steps.value[last + 1 - model.memory : last + 1]
        (value,) = run.run(None, {"features": window})
        assert value == pytest.approx(predicted.value[last], rel=1e-9)
    facts = {entry.key: entry.value for entry in graph.metadata_props}
    assert SimpleNamespace(**facts).features == "width_mm length_mm convexity_mm"
