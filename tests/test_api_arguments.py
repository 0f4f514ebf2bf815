"""Wrong arguments of the Python API: an `InputError` states what is wrong and what is expected."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
import pytest

import labapp
from labapp.config.setup import parse_setup
from labapp.core.matching.match_settings import MatchSettings
from labapp.core.pipeline import Settings
from labapp.core.schemes.irs import IrsSettings
from labapp.media import open_source
from labapp.session.record import Record

mpl.use("Agg")

SAMPLE = Path(__file__).parents[1] / "sample_sessions" / "gtaw"
RECORDING, SETUP = next(SAMPLE.glob("recording.*")), SAMPLE / "setup.toml"
ANY: Any = None


def error_of(call: Callable[[], object]) -> labapp.InputError:
    with pytest.raises(labapp.InputError) as caught:
        call()
    return caught.value


@pytest.fixture(scope="module")
def results() -> labapp.Results:
    with open_source(RECORDING) as source:
        return labapp.measure(np.array(source.frame(0).image), SETUP)


@pytest.fixture
def session(tmp_path: Path) -> labapp.Session:
    return labapp.Session.create(tmp_path / "one.labsession")


@pytest.mark.parametrize(
    ("field", "given"),
    [
        ("source", {"source": 5}),
        ("source", {"source": [[1, 2]]}),
        ("setup", {"setup": None}),
        ("setup", {"setup": {"laser": 1}}),
        ("setup", {"setup": "[laser]\ndistance_mm = 30"}),
        ("frames", {"frames": 0}),
        ("frames", {"frames": None}),
        ("frames", {"frames": "50:60"}),
        ("settings", {"settings": "irs"}),
        ("settings.scheme", {"settings": Settings(scheme="fitt")}),
        ("settings.algorithm", {"settings": Settings(algorithm="epa-r")}),
        ("settings.correspondence", {"settings": Settings(correspondence="S" + "S")}),  # type: ignore[arg-type]
        (
            "settings.match.correspondence",
            {"settings": Settings(match=MatchSettings(correspondence="I/I"))},
        ),
        ("settings.irs.algorithm", {"settings": Settings(irs=IrsSettings(algorithm="epa-c"))}),
        ("progress", {"progress": 3}),
    ],
)
def test_measure_names_the_argument(field: str, given: dict[str, Any]) -> None:
    source, setup = given.pop("source", RECORDING), given.pop("setup", SETUP)
    error = error_of(lambda: labapp.measure(source, setup, **given))
    assert error.field == field
    assert "--" not in str(error)  # no option of the command line


@pytest.mark.parametrize(
    ("call", "expected"),
    [
        (lambda r: r.dataframe("dotz"), "dots"),
        (lambda r: r.dataframe(["dots"]), "dots"),
        (lambda r: r.surfaces("a"), "above 0"),
        (lambda r: r.surfaces(np.nan), "above 0"),
        (lambda r: r.surfaces(np.inf), "above 0"),
        (lambda r: r.plot("hight_mm"), "height_mm"),
        (lambda r: r.plot("status"), "width_mm"),
        (lambda r: r.plot(None), "width_mm"),
        (lambda r: r.plot(axes=3), "axes"),
        (lambda r: r.plot_surface(99), "0 to 0"),
        (lambda r: r.plot_surface(-2), "0 to 0"),
        (lambda r: r.plot_surface("0"), "0 to 0"),
        (lambda r: r.plot_surface(0, axes="x"), "axes"),
        (lambda r: r.plot_surface(0, spacing_mm=-1), "above 0"),
        (lambda r: r.dynamics(of="heigt_mm"), "height_mm"),
        (lambda r: r.dynamics(band_hz=(5, 1)), "two frequencies"),
        (lambda r: r.dynamics(band_hz=(5,)), "two frequencies"),
        (lambda r: r.dynamics(band_hz=3), "two frequencies"),
        (lambda r: r.dynamics(segment_s="a"), "above 0"),
        (lambda r: r.dynamics(signals="x"), "read_signals"),
        (lambda r: r.of_session("x"), "Session"),
    ],
)
def test_results_state_what_is_expected(
    results: labapp.Results, call: Callable[[Any], object], expected: str
) -> None:
    assert expected in error_of(lambda: call(results)).expected


def test_negative_index_counts_from_the_last_surface(results: labapp.Results) -> None:
    assert results.plot_surface(-1).get_xlabel() == "X (mm)"


@pytest.mark.parametrize(
    "call",
    [
        lambda s: s.set_setup(None),
        lambda s: s.set_setup(SETUP),
        lambda s: s.set_setup(str(SETUP)),
        lambda s: s.update_setup(3),
        lambda s: s.update_setup({"laser": 3}),
        lambda s: s.update_setup({"lazer": {"distance_mm": 3.0}}),
        lambda s: s.update_setup({"laser": {"distance_mm": object()}}),
        lambda s: s.calibrate_laser([1.0], [2.0], [3.0]),
        lambda s: s.calibrate_laser("a", [2.0], [3.0]),
        lambda s: s.calibrate_plane(SAMPLE / "calibration.png", -1.0),
        lambda s: s.calibrate_plane(SAMPLE / "calibration.png", "a"),
        lambda s: s.calibrate_plane(3, 6.35),
        lambda s: s.calibrate_camera([]),
        lambda s: s.calibrate_camera(str(SAMPLE / "calibration.png")),
        lambda s: s.set_record("x"),
        lambda s: s.set_settings("x"),
        lambda s: s.set_settings(Settings(scheme="fitt")),
        lambda s: s.set_settings(Settings(algorithm="epa-r")),
        lambda s: s.set_settings(Settings(irs=IrsSettings(algorithm="epa-c"))),
        lambda s: s.set_signals("x"),
        lambda s: s.set_limits("x"),
        lambda s: s.set_entries("laser", "x"),
        lambda s: s.correct(3),
        lambda s: s.import_recording(4),
        lambda s: s.import_recording(RECORDING, 0),
        lambda s: s.import_recording(RECORDING, frame_rate_hz="a"),
        lambda s: s.relink(3),
        lambda s: s.measure(0),
        lambda s: s.measure("0:2"),
        lambda s: s.result("a"),
        lambda s: s.result(0, "fitt"),
        lambda s: s.overview("fitt"),
        lambda s: s.export(3),
        lambda s: s.export("out", "stl"),
        lambda s: s.export("out", scheme="fitt"),
    ],
)
def test_session_rejects_wrong_arguments_and_stores_nothing(
    session: labapp.Session, call: Callable[[Any], object]
) -> None:
    with session:
        error_of(lambda: call(session))
        assert session.history == ()


def test_overridden_choice_of_a_session_blocks_no_other_change(session: labapp.Session) -> None:
    with session:
        same = Settings(scheme="irs", algorithm="epa-c", irs=IrsSettings(algorithm="epa-c"))
        session.set_settings(same)
        session.set_settings(replace(same, algorithm="opa"))
        assert session.settings.algorithm == "opa"


@pytest.mark.parametrize("make", [labapp.Session.create, labapp.Session.open, labapp.Study])
def test_number_is_rejected_as_a_path(make: Callable[[Any], object]) -> None:
    assert error_of(lambda: make(5)).field == "path"


def test_failed_script_can_be_run_again(tmp_path: Path) -> None:
    path, text = tmp_path / "run.labsession", SETUP.read_text("utf-8")

    def script(setup: str, *, exist_ok: bool = True) -> list[int]:
        with labapp.Session.create(path, Record(title="run"), exist_ok=exist_ok) as session:
            session.set_setup(setup)
            session.import_recording(RECORDING, "0:2")
            return [number for number, _ in session.measure()]

    error_of(lambda: script(text.replace("[laser]", "[lazer]")))
    assert script(text) == [0, 1]
    assert script(text) == []  # nothing is lost, and nothing is measured twice
    assert error_of(lambda: script(text, exist_ok=False)).field == "file"
    with labapp.Session.open(path) as session:
        assert session.record.title == "run"
        assert len(session.stale_frames()) == 0
    other = tmp_path / "other.labsession"
    other.write_text("notes of a user")
    error_of(lambda: labapp.Session.create(other, exist_ok=True))
    assert other.read_text() == "notes of a user"


def test_implausible_setup_causes_a_warning_and_a_doubt(tmp_path: Path) -> None:
    text = SETUP.read_text("utf-8")
    low = text.replace("[electrode]\nheight_mm = 5.0", "[electrode]\nheight_mm = 0.5")
    assert low != text
    wrong = parse_setup(low, "setup.toml")
    with open_source(RECORDING) as source:
        image = np.array(source.frame(0).image)
    with pytest.warns(UserWarning, match=r"electrode\.height_mm is 0\.5 mm"):
        results = labapp.measure(image, wrong)
    assert results.setup_check is not None
    assert results.setup_check.is_doubtful
    assert list(results.dataframe()["setup_status"]) == ["doubtful"]
    with labapp.Session.create(tmp_path / "one.labsession") as session:
        session.set_setup(low)
        assert session.setup_status == "doubtful"
        assert "electrode.height_mm" in session.setup_words
        session.set_setup(text)
        assert session.setup_status != "doubtful"
