"""The set-up page: missing values, one undo step per edit, and a drawing that follows."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pyqtgraph as pg
import pytest
from PySide6.QtCore import QPoint, QRect, Qt
from PySide6.QtGui import QImage
from PySide6.QtTest import QTest
from pytestqt.qtbot import QtBot
from scipy.ndimage import label

from labapp.config.setup import read_setup
from labapp.config.setup_keys import SECTIONS
from labapp.core.geometry.line_pattern import LinePattern, LineRays
from labapp.core.geometry.rig import DotPattern
from labapp.core.geometry.uncertainty import ANGLE, DISTANCE, INDEX, POINTS, QUANTITIES
from labapp.errors import InputError
from labapp.gui.pages.setup import presenter
from labapp.gui.pages.setup.page import SetupPage
from labapp.gui.pages.setup.presenter import RIG
from labapp.gui.tasks import PROBLEM
from labapp.gui.views.drawings.bench import DRAWN
from labapp.gui.views.drawings.pattern import PatternView
from labapp.gui.workspace import Workspace
from labapp.session.checklist import SAFETY, STEPS, tick
from labapp.session.session import Session
from labapp.simulation.positioning import Fate
from tests.gui.conftest import KEPT, let_draw

SAMPLES = Path(__file__).parents[3] / "sample_sessions"

GRID = [(i, j) for i in range(1, 20) for j in range(1, 20) if (i, j) != (10, 10)]

KEYS = [entry.key for _, entries in RIG for entry in entries]


@pytest.fixture
def empty(tmp_path: Path) -> Iterator[Session]:
    with Session.create(tmp_path / "new.labsession") as session:
        yield session


def test_new_session_is_incomplete_and_drawn_with_defaults(
    empty: Session,
) -> None:
    shown = presenter.shown(empty)
    rules = {
        f"{section}.{key}": rule for section in SECTIONS for key, rule in SECTIONS[section].items()
    }
    needed = [
        key for key in KEYS if key in rules and rules[key].required
    ]  # without those of line patterns
    assert shown.missing == set(needed)
    assert shown.problems == {}
    assert set(shown.values.values()) == {None}
    assert shown.others == ("The imaging plane is not calibrated: that is step Imaging plane.",)
    bench = presenter.bench(empty)
    assert bench.rig is not None
    assert bench.rig.laser.distance_mm == presenter.DEFAULTS["laser.distance_mm"]
    assert bench.words.startswith(presenter.NOT_ENTERED)
    assert bench.rows == ()  # dots are not counted for a bench of default values
    assert presenter.rig(empty) is None
    presenter.put(empty, "laser.projection_angle_deg", 90)
    assert presenter.bench(empty).view is None


def test_defaults_fill_only_missing_values(empty: Session) -> None:
    presenter.put(empty, "laser.distance_mm", 42.0)
    presenter.put_usual(empty)
    shown = presenter.shown(empty)
    assert shown.values["laser.distance_mm"] == 42.0
    assert shown.values["pattern.rows"] == 19
    assert shown.missing == {"imaging_plane.s_mm", "imaging_plane.h_mm"}
    for key in shown.missing:
        presenter.put(empty, key, 3.0)
    rig = presenter.rig(empty)
    assert rig is not None
    assert rig.laser.distance_mm == 42.0


def test_every_quantity_has_a_field_for_its_uncertainty() -> None:
    fields = [presenter.sigma_entry(entry) for _, entries in RIG for entry in entries]
    keys = {entry.key for entry in (*fields, *presenter.UNCERTAIN_ONLY[1]) if entry is not None}
    assert keys == {one.sigma_key for one in QUANTITIES}


def test_setup_is_calibrated_until_it_is_edited(empty: Session) -> None:
    empty.set_setup(read_setup(SAMPLES / "gtaw" / "setup.toml").text)
    assert empty.setup.rig.uncertainty.status == "entered"
    cross = [13.66, 13.7, 13.68], [18.52, 18.6, 18.56], [7.86, 7.9, 7.87]
    laser = empty.calibrate_laser(*cross)
    assert empty.setup.rig.uncertainty.status == "entered"
    plane = empty.calibrate_plane(SAMPLES / "gtaw" / "calibration.png", 6.35)
    known = empty.setup.rig.uncertainty
    assert known.status == "calibrated"
    assert "calibrated" in presenter.shown(empty).status
    assert known.sigma[INDEX["laser.distance_mm"]] == laser.distance_sigma_mm
    assert known.correlation[ANGLE, DISTANCE] == pytest.approx(laser.correlation)
    covariance = known.covariance[np.ix_(POINTS, POINTS)]
    np.testing.assert_allclose(covariance, plane.affine_covariance_px2, rtol=1e-6, atol=1e-9)
    # A changed value is no longer calibrated.
    presenter.put(empty, "laser.distance_mm", 31.0)
    changed = empty.setup.rig.uncertainty
    assert changed.status == "entered"
    assert "laser.distance_mm" in changed.assumed
    assert "laser.projection_angle_deg" not in changed.assumed
    assert changed.correlation[ANGLE, DISTANCE] == 0.0
    empty.undo()
    assert empty.setup.rig.uncertainty.status == "calibrated"
    np.testing.assert_array_equal(empty.setup.rig.uncertainty.covariance, known.covariance)
    # Values without a calibration keep their entered ±.
    presenter.put(empty, "imaging_plane.distance_mm_sigma", 0.2)
    presenter.put(empty, "imaging_plane.distance_mm", 51.0)
    assert presenter.shown(empty).sigmas["imaging_plane.distance_mm_sigma"] == 0.2


def test_impossible_values_are_reported_at_their_field(empty: Session) -> None:
    empty.set_setup(read_setup(SAMPLES / "gtaw" / "setup.toml").text)
    presenter.put(empty, "laser.projection_angle_deg", 90)
    shown = presenter.shown(empty)
    assert "below 90" in shown.problems["laser.projection_angle_deg"]
    presenter.put(empty, "laser.projection_angle_deg", 2.0)
    assert "half the fan" in presenter.shown(empty).problems["laser.projection_angle_deg"]


def test_bench_counts_the_reflected_dots(empty: Session) -> None:
    empty.set_setup(read_setup(SAMPLES / "gtaw" / "setup.toml").text)
    usual = presenter.bench(empty)
    assert "Usual pool: 5 × 6 mm, flat" in usual.words
    for name, value in (("width", 6.0), ("length", 8.0), ("height", 0.8)):
        presenter.note(empty, f"expected_{name}_mm", value)
    bench = presenter.bench(empty)
    assert bench.view is not None
    assert bench.view.tally[Fate.BLOCKED] > 0
    values = {row.name: row.value for row in bench.rows}
    assert values["Blocked by the torch"] == str(bench.view.tally[Fate.BLOCKED])
    assert values["L2"] == bench.view.clearance.l2_mm
    presenter.note(empty, "expected_height_mm", 4.0)
    assert "overhang" in presenter.bench(empty).words


def test_checked_item_is_stored_with_its_time(empty: Session) -> None:
    (first, _), (second, _), *_ = SAFETY
    empty.set_record(tick(empty.record, first, True, "2026-11-21T10:00:00+01:00"))
    empty.set_record(tick(empty.record, second, True, "2026-11-21T10:01:00+01:00"))
    empty.set_record(tick(empty.record, first, False, "2026-11-21T10:02:00+01:00"))
    assert empty.record.safety == ((second, "2026-11-21T10:01:00+01:00"),)
    empty.undo()
    assert dict(empty.record.safety)[first].startswith("2026-11-21T10:00")


# --- the page ---------------------------------------------------------------------------------


@pytest.fixture
def page(qtbot: QtBot, copy_sample: Callable[[str], Path]) -> Iterator[SetupPage]:
    workspace = Workspace()
    workspace.show(Session.open(copy_sample("gtaw")))
    setup_page = SetupPage(workspace)
    KEPT.extend([workspace, setup_page, setup_page.panel])
    workspace.changed.connect(lambda: setup_page.refresh() if workspace.session else None)
    setup_page.refresh()
    setup_page.show()
    setup_page.panel.show()
    yield setup_page
    workspace.close()


def retype(qtbot: QtBot, field, text: str) -> None:
    field.editor.setFocus()
    field.editor.selectAll()
    qtbot.keyClicks(field.editor, text)
    qtbot.keyClick(field.editor, Qt.Key.Key_Return)


def test_edit_changes_session_and_drawing_and_can_be_undone(qtbot: QtBot, page: SetupPage) -> None:
    session = page.workspace.session
    assert session is not None
    field = page.rig_fields["electrode.height_mm"]
    words = page.bench.words.text()
    retype(qtbot, field, "1,5")
    assert session.setup.rig.electrode.height_mm == 1.5
    assert page.bench.words.text() != words
    page.workspace.undo()
    assert field.value() == 5.0
    assert page.bench.words.text() == words


def test_uncertainty_is_entered_beside_its_value(qtbot: QtBot, page: SetupPage) -> None:
    session = page.workspace.session
    assert session is not None
    field = page.sigma_fields["laser.distance_mm_sigma"]
    assert field.value() is None
    retype(qtbot, field, "0,3")
    assert session.setup.rig.uncertainty.sigma[DISTANCE] == 0.3
    assert "laser.distance_mm" not in session.setup.rig.uncertainty.assumed
    page.workspace.undo()
    assert field.value() is None
    assert session.setup.rig.uncertainty.sigma[DISTANCE] == 0.5


def test_welding_direction_can_be_chosen(page: SetupPage) -> None:
    session = page.workspace.session
    assert session is not None
    page.travel.edited.emit("-y")
    assert session.setup.rig.travel == "-y"
    assert page.travel.value() == "-y"
    page.workspace.undo()
    assert session.setup.rig.travel == "+y"


def test_dot_pattern_can_be_chosen(page: SetupPage) -> None:
    session = page.workspace.session
    assert session is not None
    page.kind.edited.emit("hexagonal")
    assert session.setup.rig.pattern.kind == "hexagonal"
    assert page.kind.value() == "hexagonal"
    page.workspace.undo()
    assert session.setup.rig.pattern.kind == "square"
    # Measured rays come from a setup file; other patterns have none.
    assert page.pattern.accessibleDescription().startswith("360 rays")
    page.kind.edited.emit("directions")
    assert any("pattern.rays" in words for words in presenter.shown(session).others)
    page.workspace.undo()
    keys = {"kind": "directions", "rays": [[i, j, j - 10.0, 10.0 - i] for i, j in GRID]}
    page.workspace.attempt(lambda session: session.update_setup({"pattern": keys}, "rays"))
    assert page.kind.value() == "directions"
    page.kind.edited.emit("square")
    assert not session.setup_problems
    page.workspace.undo()
    assert len(session.setup.rig.pattern.measured) == len(GRID)


def test_every_field_has_a_name_of_its_own(page: SetupPage) -> None:
    fields = [*page.rig_fields.values(), *page.sigma_fields.values(), *page.record_fields.values()]
    names = [field.editor.accessibleName() for field in fields]
    assert len(set(names)) == len(names)


def test_problem_of_a_field_stays_while_others_are_accepted(
    qtbot: QtBot, page: SetupPage, copy_sample: Callable[[str], Path]
) -> None:
    session = page.workspace.session
    assert session is not None
    angle, height = (
        page.rig_fields[key] for key in ("laser.projection_angle_deg", "electrode.height_mm")
    )
    retype(qtbot, angle, "400")
    message = angle.problem.text()
    assert "0 to 90" in message
    retype(qtbot, height, "1,5")
    assert session.setup.rig.electrode.height_mm == 1.5
    assert (angle.problem.text(), angle.problem.isHidden()) == (message, False)
    retype(qtbot, height, "x")
    retype(qtbot, angle, "30")
    assert angle.problem.isHidden()
    assert not height.problem.isHidden()
    page.workspace.show(Session.open(copy_sample("concave")))
    assert height.problem.isHidden()


def test_cleared_field_is_marked(qtbot: QtBot, page: SetupPage) -> None:
    field = page.rig_fields["laser.distance_mm"]
    field.editor.clear()
    field.flush()
    assert field.problem.isHidden()
    assert field.editor.text() == ""
    assert field.editor.lineEdit().placeholderText() == "35"
    assert "⚠" in page.tabs.tabText(2)
    assert page.bench.words.text().startswith(presenter.NOT_ENTERED)
    page.workspace.undo()
    assert field.value() == 31.48
    assert not page.bench.words.text().startswith(presenter.NOT_ENTERED)


@pytest.mark.parametrize("key", list(DRAWN))
def test_dimension_entered_in_the_drawing_updates_it(
    qtbot: QtBot, page: SetupPage, key: str
) -> None:
    session = page.workspace.session
    assert session is not None
    box = page.bench.boxes[key]
    plotted = box.plot.listDataItems()
    before = [item.getData() for item in plotted]
    value = page.rig_fields[key].value()
    assert value is not None
    assert box.field.value() == value
    retype(qtbot, box.field, f"{value + 1:g}")
    assert page.rig_fields[key].value() == pytest.approx(value + 1)
    after = [item.getData() for item in box.plot.listDataItems()]
    assert not all(
        np.array_equal(one, other, equal_nan=True)
        for old, new in zip(before, after, strict=True)
        for one, other in zip(old, new, strict=True)
    )
    page.workspace.undo()
    assert box.field.value() == value


@pytest.mark.parametrize("key", list(DRAWN))
def test_refusal_in_the_drawing_can_be_read(qtbot: QtBot, page: SetupPage, key: str) -> None:
    page.bench.resize(900, 640)
    let_draw()
    box = page.bench.boxes[key]
    before = box.geometry()
    retype(qtbot, box.field, "1,250")
    let_draw()
    assert box.field.problem.isVisible()
    assert box.plot.rect().contains(box.geometry())
    middle = box.field.problem.mapTo(box.plot, box.field.problem.rect().center())
    assert box.isAncestorOf(box.plot.childAt(middle))  # no other box covers it
    retype(qtbot, box.field, box.field.editor.text())
    let_draw()
    assert box.geometry() == before


def assert_nothing_overlaps(page: SetupPage) -> None:
    """Check the fields of the drawing as drawn: against each other, names, torch and axes."""
    let_draw()
    for plot in (page.bench.whole, page.bench.top):
        boxes = [each for each in page.bench.boxes.values() if each.plot is plot]
        assert all(plot.rect().contains(each.geometry()) for each in boxes)
        areas = [*(each.geometry() for each in boxes), *page.bench.obstacles(plot)]
        pairs = itertools.combinations(areas, 2)
        obstacles = set(map(id, areas[len(boxes) :]))
        assert not any(
            a.intersects(b) for a, b in pairs if not (id(a) in obstacles and id(b) in obstacles)
        )


def test_fields_of_the_drawing_do_not_overlap(page: SetupPage) -> None:
    for size in ((560, 400), (900, 640)):
        page.bench.resize(*size)
        assert_nothing_overlaps(page)


@pytest.mark.parametrize("is_hidden", [False, True])
def test_fields_do_not_cover_the_names_of_another_session(
    page: SetupPage, copy_sample: Callable[[str], Path], is_hidden: bool
) -> None:
    page.bench.resize(900, 640)
    for sample in ("gmaw", "five_lines", "concave"):
        page.setVisible(not is_hidden)
        page.workspace.show(Session.open(copy_sample(sample)))
        let_draw()
        page.show()
        assert_nothing_overlaps(page)


def test_fields_are_below_the_drawing_on_a_small_canvas(qtbot: QtBot, page: SetupPage) -> None:
    bench = page.bench
    bench.resize(390, 300)
    let_draw()
    bottom = max(plot.geometry().bottom() for plot in (bench.whole, bench.top))
    for box in bench.boxes.values():
        place = QRect(box.mapTo(bench, QPoint()), box.size())
        assert bench.rect().contains(place)
        assert place.top() > bottom
    letter = next(
        each
        for each in bench.top.items()
        if isinstance(each, pg.TextItem) and each.toPlainText() == "s"
    )
    at = bench.top.mapFromScene(letter.sceneBoundingRect().center())
    QTest.mouseClick(bench.top.viewport(), Qt.MouseButton.LeftButton, pos=at)
    field = bench.boxes["imaging_plane.s_mm"].field
    qtbot.waitUntil(lambda: page.window().focusWidget() is field.editor, timeout=20_000)
    retype(qtbot, field, "44")
    assert page.rig_fields["imaging_plane.s_mm"].value() == 44
    bench.resize(900, 640)
    let_draw()
    assert all(box.parent() is box.plot and box.isVisible() for box in bench.boxes.values())


def test_text_that_cannot_be_stored_stays_marked_and_is_tried_again(
    qtbot: QtBot, page: SetupPage, monkeypatch: pytest.MonkeyPatch
) -> None:
    session, field = page.workspace.session, page.record_fields["operator"]
    assert session is not None

    def full(*_: object) -> None:
        raise InputError("run.labsession", "disk", "no space left", "room on the disk")

    with monkeypatch.context() as patch:
        patch.setattr(Session, "set_record", full)
        retype(qtbot, field, "Ada")
        page.refresh()
    assert field.value() == "Ada"
    assert field.problem.text()
    assert session.record.operator != "Ada"
    field.flush()
    assert session.record.operator == "Ada"
    assert field.problem.text() == ""


def test_record_and_checklist_are_edited_by_hand(qtbot: QtBot, page: SetupPage) -> None:
    session = page.workspace.session
    assert session is not None
    retype(qtbot, page.record_fields["operator"], "Ada")
    retype(qtbot, page.record_fields["thickness_mm"], "3")
    assert (session.record.operator, session.record.thickness_mm) == ("Ada", 3.0)
    item = SAFETY[0][0]
    page.ticks[item].click()
    assert session.record.safety[-1][0] == item
    assert "1/7" in page.tabs.tabText(1)
    page.ticks[item].click()
    assert item not in dict(session.record.safety)
    step = STEPS[0][0]
    page.steps[step].click()
    assert step in dict(session.record.safety)
    assert "0/7" in page.tabs.tabText(1)


def test_invalid_setup_file_is_rejected(page: SetupPage, tmp_path: Path) -> None:
    messages: list[tuple[str, bool]] = []
    page.workspace.notified.connect(lambda words, problem: messages.append((words, problem)))
    bad = tmp_path / "bad.toml"
    bad.write_text("no = [")
    page.load(bad)
    assert messages[-1][1]
    assert "bad.toml" in messages[-1][0]
    page.save(tmp_path / "good.toml")
    assert not messages[-1][1]
    assert page.answer.text().endswith("good.toml")


def test_setup_file_is_loaded_and_saved(page: SetupPage, tmp_path: Path) -> None:
    session = page.workspace.session
    assert session is not None
    presenter.put(session, "imaging_plane.pitch_deg", 2.5)
    before, out = session.setup_text, tmp_path / "out.toml"
    page.save(out)
    assert read_setup(out).text == before
    presenter.put(session, "imaging_plane.pitch_deg", None)
    page.load(out)
    assert session.setup_text == before
    out.write_text("[laser]\nprojection_angle_deg = 95\n")
    page.load(out)
    assert "out.toml" in page.answer.text()
    assert session.setup_text == before
    page.save(tmp_path / "not there" / "out.toml")
    assert "can be written" in page.answer.text()


def test_setup_for_larger_frames_is_reported(page: SetupPage, tmp_path: Path) -> None:
    session = page.workspace.session
    assert session is not None
    page.save(tmp_path / "out.toml")
    small = tmp_path / "small.npy"
    np.save(small, np.zeros((1, 320, 240), np.uint8))
    page.workspace.show(Session.create(tmp_path / "small.labsession"))
    page.session.import_recording(small)
    page.load(tmp_path / "out.toml")
    assert page.answer.text().startswith(PROBLEM)
    assert "frames have 240×320 px" in page.answer.text()


def test_refused_number_is_not_shown_and_refused_text_stays(
    qtbot: QtBot, page: SetupPage, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object) -> None:
        raise InputError("a.labsession", "file", "no space left", "enough of it")

    field, notes = page.rig_fields["laser.distance_mm"], page.record_fields["operator"]
    stored = field.value()
    monkeypatch.setattr(Session, "update_setup", full)
    retype(qtbot, field, "33")
    assert field.value() == stored
    monkeypatch.setattr(Session, "set_record", full)
    retype(qtbot, notes, "Ada")
    box = page.ticks[SAFETY[0][0]]
    box.click()
    assert not box.isChecked()
    assert notes.value() == "Ada"  # what took long to type can be entered again


def test_every_control_has_a_name_and_a_tooltip(page: SetupPage) -> None:
    for field in (*page.rig_fields.values(), *page.record_fields.values()):
        assert field.editor.accessibleName()
        assert field.editor.toolTip()
    for box in page.ticks.values():
        assert box.toolTip()


def test_tabs_are_as_tall_as_their_content(page: SetupPage) -> None:
    heights = []
    for number in range(page.tabs.count()):
        page.tabs.setCurrentIndex(number)
        heights.append(page.tabs.heightForWidth(350))
    assert max(heights[:2]) < heights[2]


def drawn_pixels(view: PatternView) -> np.ndarray:
    """Mask of the foreground pixels of the drawing, shape (height, width)."""
    image = view.grab().toImage().convertToFormat(QImage.Format.Format_Grayscale8)
    grey = np.array(image.bits(), np.uint8).reshape(image.height(), image.bytesPerLine())
    return grey[:, : image.width()] != grey[0, 0]


def test_pattern_drawing_shows_absent_rays_and_rotation(qtbot: QtBot) -> None:
    view = PatternView()
    qtbot.addWidget(view)
    view.resize(132, 132)
    view.show_pattern(DotPattern(5, 5, 1.0), "")
    dots, holes = label(drawn_pixels(view))[1], label(~drawn_pixels(view))[1]
    assert (dots, holes) == (25, 2)  # the ring at the centre has a hole, too
    view.show_pattern(DotPattern(5, 5, 1.0, absent=frozenset({(3, 3), (1, 5)})), "")
    assert label(~drawn_pixels(view))[1] == 3
    view.show_pattern(DotPattern(21, 21, 0.72, kind="hexagonal"), "")
    assert not drawn_pixels(view)[:20, :20].any()
    view.show_pattern(LineRays.of(LinePattern(5, 0.5, 5.0)), "")
    rows, columns = np.nonzero(drawn_pixels(view))
    assert label(drawn_pixels(view))[1] == 5
    assert np.ptp(columns) > np.ptp(rows)
    view.show_pattern(LineRays.of(LinePattern(5, 0.5, 5.0, rotation_deg=30.0)), "")
    rows, columns = np.nonzero(drawn_pixels(view))
    assert rows[columns.argmin()] > rows[columns.argmax()]  # rows rise with X
