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
    """Of a frame that can be measured and of one that cannot."""
    return labapp.measure(np.array([image, np.zeros_like(image)]), SETUP)


def test_the_public_names_are_those_that_are_there() -> None:
    assert set(labapp.__all__) <= set(dir(labapp))
    for name in labapp.__all__:
        assert getattr(labapp, name) is not None
    with pytest.raises(AttributeError, match="nothing"):
        _ = labapp.nothing


def documented() -> dict[str, object]:
    """Names of the API reference, and what they stand for."""
    text = (Path(__file__).parents[1] / "docs/reference/api.md").read_text("utf-8")
    return {name: pkgutil.resolve_name(name) for name in re.findall(r"^::: (\S+)", text, re.M)}


def test_what_is_exported_is_documented_and_the_reverse() -> None:
    names = {name for name in documented() if name.count(".") == 1}
    assert names == {f"labapp.{name}" for name in labapp.__all__ if name != "__version__"}


@pytest.mark.parametrize(("name", "what"), documented().items())
def test_every_documented_name_says_what_its_parameters_are(name: str, what: object) -> None:
    silent = []
    for each, function in public_functions(name, what).items():
        doc = inspect.getdoc(function) or ""
        section = doc.partition("Parameters\n----------\n")[2]
        explained = set(re.findall(r"\w+", " ".join(re.findall(r"^\w[\w, ]*$", section, re.M))))
        parameters = set(inspect.signature(function).parameters) - {"self", "cls"}
        if not doc or parameters - explained:
            silent.append((each, parameters - explained))
    assert not silent
    assert inspect.getdoc(what)


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


def public_functions(name: str, what: object) -> dict[str, Callable[..., object]]:
    """A function, or the methods of a class that are labapp's own."""
    if not inspect.isclass(what):
        return {name: what} if callable(what) else {}
    bases = [base for base in what.__mro__ if base.__module__.startswith("labapp.")]
    return {
        f"{name}.{key}": getattr(what, key)
        for base in bases
        for key, value in vars(base).items()
        if not key.startswith("_") and isinstance(value, FunctionType | classmethod | staticmethod)
    }


def test_a_recording_and_its_images_give_the_same_as_the_command_line(
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
    seen: list[int] = []
    by_path = api.measure(RECORDING, SETUP, frames="0", progress=lambda r: seen.append(r.frame))
    by_image = api.measure(image, read_setup(SETUP))
    assert seen == [0]
    for found in (by_path, by_image):
        (height,) = found.dataframe()["height_mm"]
        assert f"{height:.6f}" in row.split(",")


def test_a_table_has_a_row_a_frame_with_units_and_why_there_is_no_surface(
    results: labapp.Results,
) -> None:
    table = results.dataframe()
    assert list(table["frame"]) == [0, 1]
    assert list(table["status"]) == ["ok", "no-dots"]
    assert np.isnan(table["height_mm"][BLANK])
    assert table.attrs["units"]["height_mm"] == "mm"
    assert list(table) == [column.name for column in TABLES["measures"]]
    points = results.dataframe("points")
    made = results[MEASURED].measurement.reconstruction
    assert made is not None
    assert len(points) == len(made.points_mm)
    assert points["z_mm"].to_numpy() == pytest.approx(made.points_mm[:, 2])


def test_surfaces_lie_on_one_grid_and_end_at_the_boundary(results: labapp.Results) -> None:
    grid = results.surfaces(0.2)
    made = results[MEASURED].measurement.reconstruction
    assert made is not None
    height = grid["height"]
    assert height.dims == ("frame", "y", "x")
    assert list(grid["frame"]) == [0]  # the other has no surface
    x, y = np.meshgrid(grid["x"], grid["y"])
    inside = made.boundary.contains(x, y)
    assert np.isfinite(height[0].to_numpy()[inside]).all()
    assert np.isnan(height[0].to_numpy()[~inside]).all()
    assert float(height.max()) == pytest.approx(results.dataframe()["height_mm"][0], rel=0.02)


def test_frames_may_be_followed_sliced_and_shown(image: np.ndarray) -> None:
    found = labapp.measure(np.array([image] * 3), SETUP, follow=True)
    assert [r.measurement.status for r in found] == ["ok"] * 3
    assert [r.frame for r in found[1:]] == [1, 2]
    assert "3 frames, 3 measured" in repr(found)
    axes = found.plot("width_mm")
    (line,) = axes.get_lines()
    assert line.get_ydata() == pytest.approx(found.dataframe()["width_mm"])
    axes = found.plot_surface(2)
    assert axes.get_xlabel() == "X (mm)"
    made = found[2].measurement.reconstruction
    assert made is not None
    color = axes.collections[0].get_facecolor()  # one for each band of heights
    assert len(color) > 10
    bands = axes.collections[0].get_paths()
    rim = made.boundary.center_mm + 0.998 * (
        made.boundary.points_mm[:, :2] - made.boundary.center_mm
    )
    shown = np.any([band.contains_points(rim) for band in bands], axis=0)
    assert shown.mean() > 0.99  # no steps along the boundary


@pytest.mark.parametrize(
    ("size", "label", "sigma"),
    [
        ("height_mm", "height (mm)", "height_sigma_mm"),
        ("volume_mm3", "volume (mm³)", "volume_sigma_mm3"),
        ("asymmetry", "asymmetry", "asymmetry_sigma"),
        ("dots", "dots", None),
    ],
)
def test_a_plot_names_size_and_unit_and_has_a_band(
    results: labapp.Results, size: str, label: str, sigma: str | None
) -> None:
    axes = results.plot(size)
    assert axes.get_ylabel() == label
    assert all(tick == round(tick) for tick in axes.get_xticks())  # frames
    table = results.dataframe().iloc[MEASURED]
    bands = [band.get_paths()[0].vertices[:, 1] for band in axes.collections]
    spans = [float(np.ptp(band)) for band in bands]
    assert spans == ([] if sigma is None else [pytest.approx(2 * table[sigma])])


def test_what_is_printed_is_short(results: labapp.Results) -> None:
    measured, blank = results[MEASURED], results[BLANK]
    assert "no-dots" in repr(blank)
    assert measured.measurement.measures is not None
    height = f"{measured.measurement.measures.height_mm:.3f}"
    for each in (measured, measured.measurement, measured.measurement.measures):
        assert height in repr(each)
    made = measured.measurement.reconstruction
    assert made is not None
    parts = (made.boundary, measured.measurement.dots, measured.measurement.match)
    for each in (measured, blank, measured.measurement, measured.measurement.measures, *parts):
        assert len(repr(each)) < 400, repr(each)


def test_the_results_of_a_session_are_those_that_it_has() -> None:
    with labapp.Session.open(SAMPLE / "gtaw.labsession", read_only=True) as session:
        of_session = labapp.Results.of_session(session)
        assert len(of_session) == len(session.frames)
        kept = session.result(0)
        assert kept is not None
        assert kept.measurement.measures is not None
        height_mm = kept.measurement.measures.height_mm
    assert "gtaw.labsession" in repr(session)
    table = of_session.dataframe()
    assert table["height_mm"][0] == height_mm
    assert (np.diff(table["time_s"]) > 0).all()


def test_other_settings_are_used(image: np.ndarray) -> None:
    (found,) = labapp.measure(image, SETUP, settings=Settings(scheme="ers"))
    assert found.measurement.scheme == "ers"


@pytest.mark.parametrize(
    "wrong", [np.zeros(5), np.zeros((2, 2), complex), np.zeros((0, 4)), np.zeros((1, 2, 3, 4))]
)
def test_what_is_no_image_is_refused(wrong: np.ndarray) -> None:
    with pytest.raises(labapp.InputError):
        labapp.measure(wrong, SETUP)


def test_a_grid_that_is_too_fine_and_a_frame_without_a_surface_are_refused(
    results: labapp.Results,
) -> None:
    for spacing_mm in (0.0, -1.0, 1e-7, float("nan")):
        with pytest.raises(labapp.InputError):
            results.surfaces(spacing_mm)
    with pytest.raises(labapp.InputError, match="no-dots"):
        results.plot_surface(BLANK)
