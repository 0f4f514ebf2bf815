from __future__ import annotations

import datetime
import re
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

import labapp
from labapp.config.setup import Setup, parse_setup, updated_setup
from labapp.core.geometry.coordinates import ImageCalibration
from labapp.core.geometry.rig import Rig
from labapp.core.geometry.uncertainty import QUANTITIES, AxisPoints, RigUncertainty
from labapp.core.match import Match, Trial
from labapp.core.pipeline import Measurement, Settings
from labapp.core.rows import correction
from labapp.core.schemes import ers
from labapp.core.surface.measures import SIZES, measure_surface
from labapp.errors import InputError
from labapp.export.summary import format_ranges
from labapp.session.record import Record
from labapp.session.report import data, figures, layout, report_pdf
from labapp.session.report.data import FrameLine, ReportData
from labapp.session.report.layout import Story, plain
from labapp.session.report.results import add_corrections, add_example, add_results
from labapp.session.results.measured import CORRECTION_CHANGED, SETUP_CHANGED
from labapp.session.session import Session
from labapp.simulation.forward import exact_match, trace
from labapp.simulation.pools import spherical_cap
from labapp.studies.measured_budget import Contribution, measured_budget, total
from tests.scenes import FRAME_SHAPE, as_dots

SAMPLE = Path(labapp.__file__).parents[1] / "sample_sessions" / "gtaw"
SETUP = (SAMPLE / "setup.toml").read_text("utf-8")
ERS = Settings(scheme="ers")
NOW = datetime.datetime(2026, 11, 21, 4, 0)


@pytest.fixture(autouse=True)
def coarse_figures(monkeypatch: pytest.MonkeyPatch) -> None:
    """Draw with a low resolution, because drawing takes most of the time of a report."""
    for module in (figures, layout):
        monkeypatch.setattr(module, "DPI", 40)


@pytest.fixture(scope="module")
def setup() -> Setup:
    return parse_setup(SETUP, "setup.toml")


@pytest.fixture(scope="module")
def cap_measurement(setup: Setup) -> Measurement:
    """A cap of 6 mm, 0.3 mm high, measured by ERS from exact dots."""
    match = exact_match(trace(spherical_cap(6.0, 0.3), setup.rig))
    reconstruction = ers.reconstruct(match, setup.rig, ers.ErsSettings())
    return Measurement(
        status="ok",
        reason="",
        scheme="ers",
        dots=as_dots(setup.calibration.to_image(match.plane_mm)),
        match=match,
        reconstruction=reconstruction,
        measures=measure_surface(reconstruction, match, setup.rig),
    )


@pytest.fixture
def session(tmp_path: Path) -> Iterator[Session]:
    """A session of six frames, none of them measured."""
    folder = tmp_path / "frames"
    folder.mkdir()
    rng = np.random.default_rng(1)
    for k in range(6):
        image = rng.integers(0, 255, FRAME_SHAPE, np.uint8)
        assert cv2.imwrite(str(folder / f"{k}.png"), image)
    with Session.create(tmp_path / "run.labsession") as session:
        session.set_setup(SETUP)
        session.set_settings(ERS)
        session.import_recording(folder, frame_rate_hz=50.0)
        yield session


@pytest.fixture
def store(session: Session, cap_measurement: Measurement) -> Callable[..., None]:
    """Store a measurement of a frame as if it had been made now."""

    def put(frame: int, width_mm: float | None = None, **changes: object) -> None:
        measurement = replace(cap_measurement, **changes)
        if width_mm is not None:
            assert measurement.measures is not None
            measurement = replace(
                measurement, measures=replace(measurement.measures, width_mm=width_mm)
            )
        basis = session._basis()
        assert basis is not None
        session._results.put(
            frame, measurement, basis, session._documents.fingerprint("correction", frame)
        )

    return put


NOTHING = {"match": None, "reconstruction": None, "measures": None}


def page_count(pdf: bytes) -> int:
    assert pdf.startswith(b"%PDF-")
    assert pdf.rstrip().endswith(b"%%EOF")
    return len(re.findall(rb"/Type\s*/Page\b", pdf))


def frame_lines(session: Session) -> list[FrameLine]:
    return data.frame_lines(session, "ers", None)


# --- statistics and tables --------------------------------------------------------------------


def test_statistics_follow_eq_7_2_and_exclude_stale_frames(
    session: Session, store: Callable[..., None]
):
    session.update_setup({"laser": {"distance_mm": 31.0}})
    store(0, 99.0)
    session.undo()
    for frame, width in ((1, 6.0), (2, 7.0), (3, 9.5)):
        store(frame, width)
    store(4, status="no-match", reason="9 dots are left over", **NOTHING)
    rows = {row[0]: row[1:] for row in data.statistics_cells(frame_lines(session))}
    widths = np.array([6.0, 7.0, 9.5])
    assert rows["width (mm)"] == [
        "3",
        "7.5000",
        data.UNKNOWN,
        f"{np.sqrt(np.sum((widths - 7.5) ** 2) / 3):.4f}",
        "6.0000",
        "9.5000",
        "3.5000",
        data.UNKNOWN,
    ]
    assert rows["ARE (mm)"][0] == "3"
    cells = data.status_cells(frame_lines(session))[1:]
    assert cells == [
        ["in the mean", "", "3", "1–3"],
        ["no-match", "9 dots are left over", "1", "4"],
        ["not measured", "", "1", "5"],
        ["stale, left out", SETUP_CHANGED, "1", "0"],
    ]


def test_reasons_that_differ_in_numbers_are_grouped(session: Session, store: Callable[..., None]):
    for frame in (0, 1, 3):
        store(frame, status="no-match", reason=f"{frame + 7} dots, ±0.{frame} px", **NOTHING)
    assert data.status_cells(frame_lines(session))[1] == [
        "no-match",
        "7 dots, ±0.0 px",
        "3",
        "0–1, 3",
    ]


def test_correction_makes_its_frame_stale_and_is_listed(
    session: Session, cap_measurement: Measurement, store: Callable[..., None]
):
    store(2)
    moved = correction.move_dots(
        correction.Correction.of(cap_measurement.dots, None), [0, 4], 0.5, 0.0
    )
    session.correct({2: correction.block_row(moved, 3)})
    line = frame_lines(session)[2]
    assert (line.stale, line.state, line.counts) == ((CORRECTION_CHANGED,), "stale", False)
    story = Story()
    add_corrections(story, ReportData.of(session, None, None))
    count = str(len(moved.dots))
    assert story.tables[0][1:] == [["2", count, "2", "blocked rows 3"]]
    assert [row[2] for row in story.tables[1]][1:] == ["set-up", "settings", "correction"]
    store(2, correction=session.correction(2))
    assert frame_lines(session)[2].state == "corrected by hand"


def test_frame_with_two_similar_correspondences_is_doubtful(
    session: Session, cap_measurement: Measurement, store: Callable[..., None]
):
    assert cap_measurement.match is not None
    for frame, rival in ((0, 0.049), (1, 0.051)):
        trials = (Trial("S/S", 0.01), Trial("I/I", rival))
        store(frame, match=replace(cap_measurement.match, orientation="S/S", trials=trials))
    assert [line.state for line in frame_lines(session)[:3]] == [
        "doubtful",
        "measured",
        "not measured",
    ]


def test_rows_that_do_not_allow_a_correspondence_are_counted():
    lines = [FrameLine(0, 0.0, rows_allow=True), FrameLine(1, 0.1), FrameLine(4, 0.4)]
    assert "1 of 1 frame" in data.rows_sentence(lines)
    lines[2] = replace(lines[2], rows_allow=False)
    assert "1 of 2 frames, not in 4" in data.rows_sentence(lines)
    assert not data.rows_sentence(lines[1:2])


def test_only_the_first_and_last_of_many_frames_are_listed():
    lines = [FrameLine(k, k / 50) for k in range(100)]
    cells = data.frame_cells(lines)
    assert [row[0] for row in cells[1:]] == [*map(str, range(20)), "…", *map(str, range(80, 100))]
    assert cells[21][-1] == "60 frames"
    assert len(data.frame_cells(lines[:60])) == 61


def test_representative_frame_has_the_median_peak(cap_measurement: Measurement):
    assert cap_measurement.measures is not None

    def line(frame: int, **sizes: float) -> FrameLine:
        assert cap_measurement.measures is not None
        return FrameLine(frame, 0.0, "ok", measures=replace(cap_measurement.measures, **sizes))

    convex = [line(k, height_mm=h) for k, h in enumerate((0.2, 0.5, 0.31, 0.3))]
    assert data.representative([*convex, FrameLine(9, 0.0, "no-dots")]) is convex[2]
    concave = [line(k, height_mm=0.0, depth_mm=d) for k, d in enumerate((-0.4, -0.2, -0.3))]
    assert data.representative(concave) is concave[2]
    assert data.representative([replace(convex[0], stale=("x",))]) is None


@pytest.mark.parametrize(
    ("numbers", "text"),
    [
        ([], ""),
        ([3], "3"),
        ([0, 1, 2, 5, 7, 8], "0–2, 5, 7–8"),
        ([2, 1], "1–2"),
        (list(range(0, 30, 2)), "0, 2, 4, 6, 8, 10, 12, 14, 16, 18, 20, 22 and 3 more"),
    ],
)
def test_frame_numbers_are_abbreviated(numbers: list[int], text: str):
    assert format_ranges(numbers) == text


def test_changed_settings_are_listed_with_their_defaults():
    assert data.settings_cells(Settings())[1:] == []
    assert data.settings_cells(ERS)[1:] == [["scheme", "ers", "fit"]]


def test_rig_is_listed_with_units(setup: Setup):
    cells = {row[1]: row[2] for row in data.rig_cells(setup)}
    assert cells["projection angle α"] == "31.14 °"
    assert cells["s: O′ at X = −s"] == "45 mm"
    assert cells["pose"] == "vertical, square to Y"
    arm = np.hypot(242.01 - 44.0, 587.93 - 590.0)
    assert cells["scale along O′X′"] == f"{arm / 34.925:.4f} px/mm"
    tilted = SETUP.replace("\ns_mm", "\npitch_deg = 4.0\nyaw_deg = -3.0\ns_mm")
    cells = {row[1]: row[2] for row in data.rig_cells(parse_setup(tilted, "setup.toml"))}
    assert cells["pitch, yaw, roll"].startswith("4 °, -3 °, ")


def test_rig_table_lists_nonideal_quantities(setup: Setup):
    values = {
        "laser": {"azimuth_deg": 1.5, "aim_x_mm": 0.25, "aim_y_mm": -0.5},
        "pattern": {"rotation_deg": 0.75},
        "imaging_plane": {"glass_mm": 3.0, "roll_deg": 0.5},
        "camera_lens": {"distortion_percent": -2.0},
    }
    text = updated_setup(SETUP, "setup.toml", values)
    ideal = {row[1] for row in data.rig_cells(setup)}
    cells = {row[1]: row[2] for row in data.rig_cells(parse_setup(text, "setup.toml"))}
    assert cells["glass on the pool's side"].startswith("3 mm")
    assert {name: cells[name] for name in cells.keys() - ideal} == {
        "azimuth": "1.5 °",
        "aim along X": "0.25 mm",
        "aim along Y": "-0.5 mm",
        "rotation about the beam axis": "0.75 °",
        "pitch, yaw, roll": cells["pitch, yaw, roll"],
        "distortion in the plane's corner": "-2 %",
    }
    assert cells["pitch, yaw, roll"].endswith("0.5 °")


# --- error budget -----------------------------------------------------------------------------


def sizes(match: Match, rig: Rig) -> np.ndarray:
    size = measure_surface(ers.reconstruct(match, rig, ERS.ers), match, rig)
    return np.array([getattr(size, name) for name in SIZES])


def test_budget_equals_measurements_with_changed_values(cap_measurement: Measurement, setup: Setup):
    budget = {
        contribution.name: contribution
        for contribution in measured_budget(cap_measurement, setup, ERS)
    }
    assert len(budget) == len(QUANTITIES)
    assert all(contribution.assumed for contribution in budget.values() if contribution.sigma > 0.0)
    assert {name for name, contribution in budget.items() if contribution.sigma == 0.0} == {
        name
        for name in budget
        if "glass" in name  # there is none
    }
    assert cap_measurement.match is not None
    farther, nearer = (
        replace(setup.rig, laser=replace(setup.rig.laser, distance_mm=31.48 + step))
        for step in (0.5, -0.5)
    )
    change = (sizes(cap_measurement.match, farther) - sizes(cap_measurement.match, nearer)) / 2
    distance = budget["laser, distance"]
    assert (distance.sigma, distance.unit) == (0.5, "mm")
    np.testing.assert_allclose(distance.change, change, atol=1e-9)
    assert change[0] > 0.02


def test_budget_of_a_calibration_point_equals_a_moved_point(cap_measurement: Measurement):
    setup = parse_setup(SETUP + "origin_px_sigma = 0.2\n", "setup.toml")
    budget = {
        contribution.name: contribution
        for contribution in measured_budget(cap_measurement, setup, ERS)
    }
    assert cap_measurement.match is not None
    image = setup.calibration.to_image(cap_measurement.match.plane_mm)
    points = (242.01, 587.93), 34.925, (43.06, 499.99), 15.875
    right, left = (
        sizes(
            replace(
                cap_measurement.match,
                plane_mm=ImageCalibration.from_three_points((u, 590.0), *points).to_plane(image),
            ),
            setup.rig,
        )
        for u in (44.2, 43.8)
    )
    origin = budget["image calibration, O′, u"]
    assert (origin.sigma, origin.assumed) == (0.2, False)
    np.testing.assert_allclose(origin.change, (right - left) / 2, rtol=1e-6, atol=1e-12)
    assert np.abs(origin.change).max() > 1e-4


def test_correlated_quantities_are_combined(cap_measurement: Measurement, setup: Setup):
    laser = "angle_distance_correlation = {}\n[pattern]"
    uncorrelated, correlated, anticorrelated = (
        parse_setup(SETUP.replace("[pattern]", laser.format(share)), "setup.toml")
        for share in (0.0, 0.9, -0.9)
    )
    changes = measured_budget(cap_measurement, setup, ERS)
    widths = [
        total(np.zeros(6), changes, one.rig)[0]
        for one in (uncorrelated, correlated, anticorrelated)
    ]
    squares = np.sqrt(np.sum(np.square([one.change[0] for one in changes])))
    assert widths[0] == pytest.approx(squares)
    assert len({round(width, 6) for width in widths}) == 3
    assert widths[1] ** 2 + widths[2] ** 2 == pytest.approx(2 * widths[0] ** 2)


def test_budget_counts_errors_of_the_frame_once(cap_measurement: Measurement, setup: Setup):
    assert cap_measurement.measures is not None
    measures = replace(cap_measurement.measures, width_sigma_mm=0.05, width_sigma_setup_mm=0.04)
    line = FrameLine(0, 0.0, "ok", measures=measures)
    changes = np.array([0.04, 0.1, np.nan, 0.0, 0.0, 0.0])
    parts = [
        Contribution("a", 0.1, "mm", True, -changes),
        Contribution("b", 0.1, "mm", False, np.zeros(6)),
        *[Contribution("other", 0.1, "mm", False, np.zeros(6))] * (len(QUANTITIES) - 2),
    ]
    exact = RigUncertainty(AxisPoints(setup.calibration, 1.0, 1.0), np.eye(len(QUANTITIES)))
    cells = data.budget_cells([line], parts, replace(setup.rig, uncertainty=exact))
    assert cells[1][2] == "0.0300"
    assert [row[0] for row in cells[2:4]] == ["a*", "b"]
    assert cells[2][2] == "0.0400"
    assert cells[-1][2:5] == ["0.0500", "0.1000", "0.0000"]


# --- pages ------------------------------------------------------------------------------------


def test_report_is_a_reproducible_pdf(session: Session, store: Callable[..., None], tmp_path: Path):
    for frame in range(4):
        store(frame, 6.0 + 0.1 * frame)
    pdf = report_pdf(session, now=NOW)
    assert page_count(pdf) >= 5
    assert report_pdf(session, now=NOW) == pdf


def test_figures_and_tables_are_numbered(session: Session, store: Callable[..., None]):
    store(0)
    store(1)
    story = Story()
    report = ReportData.of(session, None, None)
    add_results(story, report)
    add_example(story, report)
    numbered = [caption.split(".")[0] for caption in story.captions]
    assert numbered == [
        *("Table 1", "Table 2", "Figure 1", "Figure 2", "Table 3"),
        *("Figure 3", "Figure 4", "Figure 5"),
    ]


def test_empty_session_has_a_report(tmp_path: Path):
    with Session.create(tmp_path / "new.labsession") as session:
        assert page_count(report_pdf(session, now=NOW)) >= 1
        session.update_setup({"laser": {"distance_mm": -3.0}})
        assert page_count(report_pdf(session, now=NOW)) >= 1


def test_missing_surfaces_and_recording_are_reported(
    session: Session, store: Callable[..., None], tmp_path: Path
):
    for frame in range(3):
        store(frame, status="no-match", reason="<b> & 3 dots", **NOTHING)
    (tmp_path / "frames").rename(tmp_path / "elsewhere")
    story = Story()
    report = ReportData.of(session, None, None)
    add_results(story, report)
    add_example(story, report)
    assert story.tables[0][1] == ["no-match", "<b> & 3 dots", "3", "0–2"]
    assert story.captions[-1].endswith("The frame itself cannot be read.")
    assert page_count(report_pdf(session, now=NOW)) >= 2


def test_report_of_selected_frames(session: Session, store: Callable[..., None]):
    store(1)
    assert [line.frame for line in data.frame_lines(session, "ers", [4, 1, 1])] == [1, 4]
    assert frame_lines(session)[1].status == "ok"
    assert data.frame_lines(session, "fit", [1])[0].status == ""
    with pytest.raises(InputError, match=r"frame: 6; expected frames of the session"):
        report_pdf(session, frames=[6], now=NOW)


def test_damaged_result_has_its_own_status(session: Session, store: Callable[..., None]):
    store(0)
    with session._database.transaction() as connection:
        connection.execute("UPDATE detail SET content = x'00'")
    assert frame_lines(session)[0].status == "damaged"
    assert page_count(report_pdf(session, now=NOW)) >= 2


@pytest.mark.parametrize(
    "text",
    [
        "<b>not bold</b> & <unclosed",
        "Ω σ Ольга ąęł",
        "long" * 400,
        "word " * 4000,
        "tab\tnew\nline\r\n\x00\x1b\ud800￾",
        "焊接熔池 한국어 テスト 😀",
        "]]> &amp; &#0; <para>",
        "",
    ],
)
def test_any_text_can_be_reported(text: str, tmp_path: Path):
    story = Story()
    story.title(text or "untitled")
    story.text(text)
    story.listing([("notes", text), (text, "x")])
    story.table(text, [["a", "b"], [text, text]], "lr", (0.5, 0.5))
    assert page_count(story.pdf(text, "footer", text.encode("utf-8", "replace").decode())) >= 1


def test_markup_is_escaped_and_line_breaks_are_preserved():
    assert plain("a < b & c\n<i>") == "a &lt; b &amp; c<br/>&lt;i&gt;"


def test_report_contains_the_title_of_the_record(tmp_path: Path):
    record = Record(title="Bead on plate", operator="A. Weld", safety=(("goggles", "2026"),))
    with Session.create(tmp_path / "x.labsession", record) as session:
        pdf = report_pdf(session, now=NOW)
        assert b"Bead on plate" in pdf
        assert report_pdf(session, now=NOW + datetime.timedelta(days=1)) != pdf
