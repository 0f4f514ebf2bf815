"""The Python API: `labapp.measure` and its results as tables, grids and plots."""

from __future__ import annotations

import dataclasses
import inspect
import pkgutil
import re
from collections.abc import Callable
from pathlib import Path
from types import FunctionType

import matplotlib as mpl
import numpy as np
import pytest

import labapp
from labapp.config.setup import read_setup
from labapp.core.pipeline import Settings
from labapp.export.tables import TABLES
from labapp.media import open_source
from tests.conftest import Run

mpl.use("Agg")

SAMPLE = Path(__file__).parents[1] / "sample_sessions" / "gtaw"
RECORDING, SETUP = next(SAMPLE.glob("recording.*")), SAMPLE / "setup.toml"

MEASURED, BLANK = 0, 1


@pytest.fixture(scope="module")
def image() -> np.ndarray:
    with open_source(RECORDING) as source:
        return np.array(source.frame(0).image)


@pytest.fixture(scope="module")
def results(image: np.ndarray) -> labapp.Results:
    """Results of a frame that can be measured and of one that cannot."""
    return labapp.measure(np.array([image, np.zeros_like(image)]), SETUP)


def test_all_public_names_exist() -> None:
    assert set(labapp.__all__) <= set(dir(labapp))
    for name in labapp.__all__:
        assert getattr(labapp, name) is not None
    with pytest.raises(AttributeError, match="nothing"):
        _ = labapp.nothing


def documented() -> dict[str, object]:
    """Names of the API reference and their objects."""
    text = (Path(__file__).parents[1] / "docs/reference/api.md").read_text("utf-8")
    return {name: pkgutil.resolve_name(name) for name in re.findall(r"^::: (\S+)", text, re.M)}


def test_exported_and_documented_names_are_equal() -> None:
    names = {name for name in documented() if name.count(".") == 1}
    assert names == {f"labapp.{name}" for name in labapp.__all__ if name != "__version__"}


@pytest.mark.parametrize(("name", "documented_object"), documented().items())
def test_every_documented_name_explains_its_parameters(
    name: str, documented_object: object
) -> None:
    unexplained = []
    for full_name, function in public_functions(name, documented_object).items():
        doc = inspect.getdoc(function) or ""
        section = doc.partition("Parameters\n----------\n")[2]
        explained = set(re.findall(r"\w+", " ".join(re.findall(r"^\w[\w, ]*$", section, re.M))))
        parameters = set(inspect.signature(function).parameters) - {"self", "cls"}
        if not doc or parameters - explained:
            unexplained.append((full_name, parameters - explained))
    assert not unexplained
    assert inspect.getdoc(documented_object)


def test_the_fields_of_documented_classes_are_in_their_docstrings() -> None:
    """``help`` shows docstrings only."""
    for name, what in documented().items():
        if not dataclasses.is_dataclass(what):
            continue
        section = (inspect.getdoc(what) or "").partition("Parameters\n----------\n")[2]
        explained = " ".join(re.findall(r"^\w[\w, …]*$", section, re.MULTILINE))
        fields = [field.name for field in dataclasses.fields(what) if field.init]
        for first, last in re.findall(r"(\w+) … (\w+)", explained):
            explained += " " + " ".join(fields[fields.index(first) : fields.index(last) + 1])
        assert not set(fields) - set(re.findall(r"\w+", explained)), name


def public_functions(name: str, documented_object: object) -> dict[str, Callable[..., object]]:
    """Return a function by its name, or the public methods of a class of labapp."""
    if not inspect.isclass(documented_object):
        return {name: documented_object} if callable(documented_object) else {}
    bases = [base for base in documented_object.__mro__ if base.__module__.startswith("labapp.")]
    return {
        f"{name}.{key}": getattr(documented_object, key)
        for base in bases
        for key, value in vars(base).items()
        if not key.startswith("_") and isinstance(value, FunctionType | classmethod | staticmethod)
    }


def test_recording_and_image_give_the_values_of_the_command_line(
    image: np.ndarray, labapp: Run, tmp_path: Path
) -> None:
    import labapp as api

    out = tmp_path / "out"
    code, _, _ = labapp(
        "reconstruct", RECORDING, "--setup", SETUP, "--out", out, "--frames", "0:1",
        "--surfaces", "none",
    )  # fmt: skip
    assert code == 0
    (row,) = (out / "measures.csv").read_text("utf-8").splitlines()[1:]
    measured_frames: list[int] = []
    by_path = api.measure(
        RECORDING, SETUP, frames="0", progress=lambda r: measured_frames.append(r.frame)
    )
    by_image = api.measure(image, read_setup(SETUP))
    assert measured_frames == [0]
    for results in (by_path, by_image):
        (height,) = results.dataframe()["height_mm"]
        assert f"{height:.6f}" in row.split(",")


def test_table_has_a_row_for_each_frame_with_units_and_status(
    results: labapp.Results,
) -> None:
    table = results.dataframe()
    assert list(table["frame"]) == [0, 1]
    assert list(table["status"]) == ["ok", "no-dots"]
    assert np.isnan(table["height_mm"][BLANK])
    assert table.attrs["units"]["height_mm"] == "mm"
    assert list(table) == [column.name for column in TABLES["measures"]]
    points = results.dataframe("points")
    reconstruction = results[MEASURED].measurement.reconstruction
    assert reconstruction is not None
    assert len(points) == len(reconstruction.points_mm)
    assert points["z_mm"].to_numpy() == pytest.approx(reconstruction.points_mm[:, 2])


def test_surfaces_share_a_grid_and_end_at_the_boundary(results: labapp.Results) -> None:
    grid = results.surfaces(0.2)
    reconstruction = results[MEASURED].measurement.reconstruction
    assert reconstruction is not None
    height = grid["height"]
    assert height.dims == ("frame", "y", "x")
    assert list(grid["frame"]) == [0]  # the other has no surface
    x, y = np.meshgrid(grid["x"], grid["y"])
    inside = reconstruction.boundary.contains(x, y)
    assert np.isfinite(height[0].to_numpy()[inside]).all()
    assert np.isnan(height[0].to_numpy()[~inside]).all()
    assert float(height.max()) == pytest.approx(results.dataframe()["height_mm"][0], rel=0.02)


def test_results_can_be_followed_sliced_and_plotted(image: np.ndarray) -> None:
    results = labapp.measure(np.array([image] * 3), SETUP, follow=True)
    assert [r.measurement.status for r in results] == ["ok"] * 3
    assert [r.frame for r in results[1:]] == [1, 2]
    assert "3 frames, 3 measured" in repr(results)
    axes = results.plot("width_mm")
    (line,) = axes.get_lines()
    assert line.get_ydata() == pytest.approx(results.dataframe()["width_mm"])
    axes = results.plot_surface(2)
    assert axes.get_xlabel() == "X (mm)"
    reconstruction = results[2].measurement.reconstruction
    assert reconstruction is not None
    color = axes.collections[0].get_facecolor()  # one for each band of heights
    assert len(color) > 10
    bands = axes.collections[0].get_paths()
    rim = reconstruction.boundary.center_mm + 0.998 * (
        reconstruction.boundary.points_mm[:, :2] - reconstruction.boundary.center_mm
    )
    is_filled = np.any([band.contains_points(rim) for band in bands], axis=0)
    assert is_filled.mean() > 0.99  # no steps along the boundary


@pytest.mark.parametrize(
    ("size", "label", "sigma"),
    [
        ("height_mm", "height (mm)", "height_sigma_mm"),
        ("volume_mm3", "volume (mm³)", "volume_sigma_mm3"),
        ("asymmetry", "asymmetry", "asymmetry_sigma"),
        ("dots", "dots", None),
    ],
)
def test_plot_has_a_label_with_unit_and_a_band(
    results: labapp.Results, size: str, label: str, sigma: str | None
) -> None:
    axes = results.plot(size)
    assert axes.get_ylabel() == label
    assert all(tick == round(tick) for tick in axes.get_xticks())  # frames
    table = results.dataframe().iloc[MEASURED]
    bands = [band.get_paths()[0].vertices[:, 1] for band in axes.collections]
    spans = [float(np.ptp(band)) for band in bands]
    assert spans == ([] if sigma is None else [pytest.approx(2 * table[sigma])])


def test_representations_are_short(results: labapp.Results) -> None:
    measured, blank = results[MEASURED], results[BLANK]
    assert "no-dots" in repr(blank)
    assert measured.measurement.measures is not None
    height = f"{measured.measurement.measures.height_mm:.3f}"
    for item in (measured, measured.measurement, measured.measurement.measures):
        assert height in repr(item)
    reconstruction = measured.measurement.reconstruction
    assert reconstruction is not None
    parts = (reconstruction.boundary, measured.measurement.dots, measured.measurement.match)
    for item in (measured, blank, measured.measurement, measured.measurement.measures, *parts):
        assert len(repr(item)) < 400, repr(item)


def test_results_of_a_session_are_the_stored_ones() -> None:
    with labapp.Session.open(SAMPLE / "gtaw.labsession", read_only=True) as session:
        of_session = labapp.Results.of_session(session)
        assert len(of_session) == len(session.frames)
        stored = session.result(0)
        assert stored is not None
        assert stored.measurement.measures is not None
        height_mm = stored.measurement.measures.height_mm
    assert "gtaw.labsession" in repr(session)
    table = of_session.dataframe()
    assert table["height_mm"][0] == height_mm
    assert (np.diff(table["time_s"]) > 0).all()


def test_other_settings_are_used(image: np.ndarray) -> None:
    (result,) = labapp.measure(image, SETUP, settings=Settings(scheme="ers"))
    assert result.measurement.scheme == "ers"


@pytest.mark.parametrize(
    "wrong", [np.zeros(5), np.zeros((2, 2), complex), np.zeros((0, 4)), np.zeros((1, 2, 3, 4))]
)
def test_invalid_image_is_rejected(wrong: np.ndarray) -> None:
    with pytest.raises(labapp.InputError):
        labapp.measure(wrong, SETUP)


def test_wrong_grid_spacing_and_missing_surface_are_rejected(
    results: labapp.Results,
) -> None:
    for spacing_mm in (0.0, -1.0, 1e-7, float("nan")):
        with pytest.raises(labapp.InputError):
            results.surfaces(spacing_mm)
    with pytest.raises(labapp.InputError, match="no-dots"):
        results.plot_surface(BLANK)
