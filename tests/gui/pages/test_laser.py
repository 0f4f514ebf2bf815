"""The laser page: readings typed or dragged in a picture, their result, and values in use."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import cv2
import numpy as np
import pytest
from PySide6.QtCore import QItemSelectionModel, Qt
from PySide6.QtWidgets import QLineEdit
from pytestqt.qtbot import QtBot

from labapp.core.calibration.laser_calibration import calibrate_laser
from labapp.errors import InputError
from labapp.gui.pages.laser import presenter
from labapp.gui.pages.laser.page import LaserPage
from labapp.gui.pages.laser.presenter import ENDS, SCALE, Readings
from labapp.gui.shell.steps import Mark, states
from labapp.gui.shell.window import MainWindow
from labapp.gui.tasks import DONE
from labapp.gui.workspace import Workspace
from labapp.session.record import LaserEntries
from labapp.session.session import Session
from tests.gui.conftest import KEPT
from tests.gui.hand import Hand

CROSS = ((13.676,), (18.561,), (7.874,))


def test_cells_are_parsed_as_readings() -> None:
    cells = ("13,7", "18.5", "x"), (" 13.6", "", "-1")
    readings = presenter.typed(LaserEntries(cells, 10.0, 0.1, 0.05))
    assert readings.lengths_mm == ((13.7, 13.6), (18.5,), ())
    assert readings.wrong == (
        "l₃, reading 1: “x” is not a length",
        "l₃, reading 2: “-1” is not a length",
    )
    assert presenter.result(readings).why_not.startswith("l₃, reading 1")


def test_missing_readings_are_reported() -> None:
    result = presenter.result(Readings(((13.7,), (), ())))
    assert result.found is None
    assert result.why_not == "Enter at least one reading of l₂, l₃"
    assert result.rows[0].value == 13.7


def test_means_spreads_and_laser_values_are_shown() -> None:
    lengths = ((13.6, 13.8), (18.5, 18.6), (7.87, 7.88))
    result = presenter.result(Readings(lengths))
    calibration = calibrate_laser(*lengths)
    rows = {row.name: row for row in result.rows}
    assert rows["l₁, 2 readings"].value == pytest.approx(13.7)
    assert rows["l₁, 2 readings"].sigma == pytest.approx(np.std([13.6, 13.8], ddof=1))
    assert rows["Projection angle"].value == calibration.angle_deg
    assert rows["Distance"].sigma == calibration.distance_sigma_mm
    assert rows["l₁ computed"].value == calibration.expected_l1_mm


def test_contradicting_lengths_are_reported() -> None:
    doubted = presenter.result(Readings(((13.95, 13.95), *(2 * one for one in CROSS[1:]))))
    assert doubted.found is not None
    assert "l₁ = 13.95 differs" in doubted.warnings[0]
    rejected = presenter.result(Readings(((16.0, 16.0), *(2 * one for one in CROSS[1:]))))
    assert rejected.found is None
    assert "l₁ = 16 contradicts l₂ and l₃" in rejected.why_not


def cross_places(turn_deg: float, px_per_mm: float = 12.0) -> dict[str, tuple[float, float]]:
    angle = np.radians(turn_deg)
    along, across = (
        np.array([np.sin(angle), -np.cos(angle)]),
        np.array([np.cos(angle), np.sin(angle)]),
    )
    center = np.array([400.0, 300.0])
    (l1,), (l2,), (l3,) = (np.array(lengths) * px_per_mm for lengths in CROSS)
    ends = center + l1 * along, center - l2 * along, center - l3 * across, center + l3 * across
    scale = np.array([10.0, 20.0]), np.array([10.0, 20.0]) + 25.0 * px_per_mm * across
    places = dict(zip((*ENDS, *SCALE), (*ends, *scale), strict=True))
    return {name: (float(u), float(v)) for name, (u, v) in places.items()}


@pytest.mark.parametrize("turn_deg", [0.0, 33.0, -120.0])
def test_lengths_from_a_picture_do_not_depend_on_its_rotation(turn_deg: float) -> None:
    lengths = presenter.cross_lengths(cross_places(turn_deg), 25.0)
    assert lengths == pytest.approx([length for (length,) in CROSS])


def test_points_that_form_no_cross_are_rejected() -> None:
    places = cross_places(0.0)
    with pytest.raises(ValueError, match="scale"):
        presenter.cross_lengths(places | {SCALE[0]: places[SCALE[1]]}, 25.0)
    with pytest.raises(ValueError, match="between their ends"):
        presenter.cross_lengths(places | {ENDS[0]: (400.0, 350.0)}, 25.0)
    with pytest.raises(ValueError, match="do not cut"):
        presenter.cross_lengths(places | {ENDS[3]: places[ENDS[2]]}, 25.0)


def test_applied_calibration_is_stored_with_its_readings(tmp_path: Path) -> None:
    with Session.create(tmp_path / "new.labsession") as session:
        assert presenter.kept(session) is None
        assert [row.value for row in presenter.in_use(session)] == [None, None]
        readings = Readings(CROSS, 10.0)
        session.calibrate_laser(*readings.lengths_mm, readings.fan_angle_deg)
        assert presenter.kept(session) == readings
        angle, distance = (row.value for row in presenter.in_use(session))
        assert angle == pytest.approx(30.0, abs=0.01)
        assert distance == pytest.approx(90.0, abs=0.01)
        assert all(row.sigma for row in presenter.in_use(session))
        assert states(session)["laser"].why == "Calibrated"
        session.update_setup({"laser": {"projection_angle_deg": 29.0}})
        assert presenter.in_use(session)[0].texts[1:3] == ("29.000", "")
        assert states(session)["laser"].why == "Other values were entered after the calibration"
        session.undo()
        assert states(session)["laser"].why == "Calibrated"
        session.undo()
        assert presenter.kept(session) is None


# --- the page ---------------------------------------------------------------------------------


@contextmanager
def page_of(path: Path) -> Iterator[LaserPage]:
    """The page alone, of a session that is open nowhere else."""
    workspace = Workspace()
    workspace.show(Session.open(path))
    laser_page = LaserPage(workspace)
    KEPT.extend([workspace, laser_page, laser_page.panel])
    workspace.changed.connect(lambda: laser_page.refresh() if workspace.session else None)
    laser_page.refresh()
    laser_page.show()
    laser_page.panel.show()
    yield laser_page
    workspace.close()


@pytest.fixture
def page(qtbot: QtBot, copy_sample: Callable[[str], Path]) -> Iterator[LaserPage]:
    with page_of(copy_sample("gtaw")) as laser_page:
        yield laser_page


def fill(page: LaserPage, row: int, texts: tuple[str, ...]) -> None:
    for column, text in enumerate(texts):
        item = page.table.item(row, column)
        if item is None:
            page.table.setItem(row, column, presenter_cell(text))
        else:
            item.setText(text)


def presenter_cell(text: str):
    from labapp.gui.pages.laser.page import _cell

    return _cell(text)


def done_steps(session: Session) -> int:
    return sum(not change.undone for change in session.history)


def clear(page: LaserPage) -> None:
    page.table.selectAll()
    page.table.setFocus()
    for item in page.table.selectedItems():
        item.setText("")


def test_typed_readings_are_applied_and_undone(qtbot: QtBot, page: LaserPage) -> None:
    session = page.workspace.session
    assert session is not None
    before, steps = (session.setup.rig.laser, page.readings()), done_steps(session)
    clear(page)
    assert not page.use_button.isEnabled()
    assert "Enter at least one reading" in page.words.text()
    fill(page, 0, ("13,676", "18.561", "7.874"))
    assert page.use_button.isEnabled()
    assert "One reading" in page.words.text()
    page.use_button.click()
    assert session.setup.rig.laser.distance_mm == pytest.approx(90.0, abs=0.01)
    assert page.readings().lengths_mm == CROSS
    assert page.applied.text().startswith(DONE)
    fill(page, 0, ("13,5",))
    assert page.applied.text() == ""  # these readings are not in use
    fill(page, 0, ("13,676",))
    assert page.applied.text().startswith(DONE)
    page.workspace.undo()
    assert page.readings().lengths_mm[0] == (13.5,)
    page.workspace.undo()
    assert page.applied.text().startswith(DONE)
    page.workspace.undo()  # of Apply: what was typed stays, so that it can be corrected
    assert page.applied.text() == ""
    assert page.readings().lengths_mm == CROSS
    assert session.setup.rig.laser == before[0]
    while done_steps(session) > steps:
        page.workspace.undo()
    assert (session.setup.rig.laser, page.readings()) == before


TYPED = (("13,7", "18.5", "7.9"), ("13.6", "", "7.8"), ("a", "18.6", ""))
"""Not yet complete: empty cells, and one that is no length."""


@pytest.mark.parametrize("way", ["close", "another session", "quit"])
def test_typed_readings_are_stored_with_the_session_until_applied(
    window: MainWindow, copy_sample: Callable[[str], Path], qtbot: QtBot, way: str
) -> None:
    path, other, hand = copy_sample("thumb_tack"), copy_sample("gtaw"), Hand(window)
    window.activateWindow()
    qtbot.waitUntil(window.isActiveWindow)
    assert window.files.open(path)
    window.show_step("laser")
    typed_in = window.page
    assert isinstance(typed_in, LaserPage)
    clear(typed_in)
    for row, texts in enumerate(TYPED):
        for column, text in enumerate(texts):
            hand.cell(typed_in.table, row, column, text)
    hand.enter(typed_in.resolution, "0.2")
    setup = typed_in.session.setup_text
    place = typed_in.table.visualRect(typed_in.table.model().index(2, 2)).center()
    hand.click(typed_in.table.viewport(), place)
    hand.type("7.7")  # the cell is still being edited
    if way == "close":
        window.do("close")
    elif way == "another session":
        assert window.files.open(other)
        window.show_step("laser")
        assert typed_in.readings() == Readings()
    else:
        window.close()
    with page_of(path) as again:
        shown = [tuple(again.table.item(row, k).text() for k in range(3)) for row in range(3)]
        assert shown == [*TYPED[:2], ("a", "18.6", "7.7")]
        assert again.resolution.value() == 0.2
        assert again.session.setup_text == setup  # nothing is applied
        assert not again.applied.text().startswith(DONE)
        assert not again.use_button.isEnabled()
        fill(again, 2, ("13.65",))
        again.use_button.click()
        assert again.applied.text().startswith(DONE)
        applied = again.readings()
    with page_of(path) as again:
        assert again.readings() == applied
        assert again.applied.text().startswith(DONE)


def enter_in_first_cell(qtbot: QtBot, page: LaserPage, text: str) -> None:
    page.table.setCurrentCell(0, 0)
    page.table.edit(page.table.currentIndex())
    (editor,) = page.table.viewport().findChildren(QLineEdit)
    qtbot.keyClicks(editor, text)
    qtbot.keyClick(editor, Qt.Key.Key_Return)
    qtbot.waitUntil(lambda: not page.table.viewport().findChildren(QLineEdit))


def test_each_entry_is_one_step_of_undo(qtbot: QtBot, page: LaserPage) -> None:
    session, steps = page.session, done_steps(page.session)
    enter_in_first_cell(qtbot, page, "")
    assert done_steps(session) == steps
    enter_in_first_cell(qtbot, page, "13.676")
    assert done_steps(session) == steps + 1
    enter_in_first_cell(qtbot, page, "")  # which leaves the cell as it is
    assert done_steps(session) == steps + 1
    fill(page, 1, ("1", "2", "3"))
    assert done_steps(session) == steps + 4
    page.table.selectAll()
    qtbot.keyClick(page.table, Qt.Key.Key_Delete)
    assert page.readings().lengths_mm == ((), (), ())
    assert done_steps(session) == steps + 5
    page.workspace.undo()
    assert page.readings().lengths_mm == ((13.676, 1.0), (2.0,), (3.0,))
    while done_steps(session) > steps:
        page.workspace.undo()
    assert page.readings().lengths_mm == ((), (), ())


def test_readings_that_cannot_be_stored_stay(
    page: LaserPage, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object) -> None:
        raise InputError(page.session.path, "disk", "no space left", "room on the disk")

    clear(page)
    with monkeypatch.context() as patch:
        patch.setattr(Session, "set_entries", fail)
        fill(page, 0, ("1", "2", ""))
        assert page.readings().lengths_mm == ((1.0,), (2.0,), ())
    fill(page, 0, ("1", "2", "3"))
    stored = page.session.laser_entries
    assert stored is not None
    assert stored.cells == (("1", "2", "3"),)


def test_table_grows_and_delete_clears_cells(qtbot: QtBot, page: LaserPage) -> None:
    clear(page)
    rows = page.table.rowCount()
    fill(page, rows - 1, ("1", "2", "3"))
    assert page.table.rowCount() == rows + 1
    # Explicit, because the default command depends on the last modifier keys.
    select_only = QItemSelectionModel.SelectionFlag.ClearAndSelect
    page.table.setCurrentCell(rows - 1, 0, select_only)
    qtbot.keyClick(page.table, Qt.Key.Key_Delete)
    assert page.readings().lengths_mm[0] == ()


def test_length_in_the_drawing_replaces_the_reading_of_any_row(
    qtbot: QtBot, page: LaserPage
) -> None:
    clear(page)
    fill(page, 1, ("5", "", ""))
    field = page.length_fields[0]
    field.editor.selectAll()
    qtbot.keyClicks(field.editor, "6")
    field.flush()
    assert page.readings().lengths_mm[0] == (6.0,)
    assert field.editor.isEnabled()
    field.editor.clear()
    field.flush()
    assert page.readings().lengths_mm[0] == ()


def test_refresh_keeps_typed_readings(page: LaserPage) -> None:
    clear(page)
    fill(page, 0, ("1", "", ""))
    page.refresh()
    assert page.readings().lengths_mm[0] == (1.0,)


def test_picture_gives_a_reading_and_is_stored(
    qtbot: QtBot, page: LaserPage, tmp_path: Path
) -> None:
    session = page.workspace.session
    assert session is not None
    not_calibrated = states(session)["laser"]
    image = np.full((600, 800), 40, np.uint8)
    cv2.imwrite(str(tmp_path / "cross.png"), image)
    clear(page)
    page.load_picture(tmp_path / "cross.png")
    qtbot.waitUntil(lambda: page.picture_view.picture is not None)
    page.scale.set_value(25.0)
    points = {point.name: point for point in page.picture_view.points}
    for name, (u, v) in cross_places(12.0).items():
        # The first places of the points are no reading of this picture.
        assert not page.add_button.isEnabled()
        assert name in page.lengths.text()
        points[name].setPos(u, v)
    assert page.lengths.text() == "l₁ 13.68 mm,  l₂ 18.56 mm,  l₃ 7.87 mm"
    page.add_button.click()
    assert page.readings().lengths_mm == ((13.68,), (18.56,), (7.87,))
    path = session.path
    page.workspace.close()
    with page_of(path) as again:  # the readings, and the picture, are stored until applied
        assert states(again.session)["laser"].mark is Mark.READY
        assert states(again.session)["laser"] != not_calibrated
        again.use_button.click()
        calibration = again.session.laser_calibration
        assert calibration is not None
        assert calibration.picture_sha256 is not None
        np.testing.assert_array_equal(again.session.picture(calibration.picture_sha256), image)
        assert states(again.session)["laser"].mark is Mark.DONE
        fill(again, 0, ("13.7",))
        assert again.session.laser_entries is not None
        fill(again, 0, ("13.68",))
        assert again.session.laser_entries is not None  # no longer from the picture


def test_picture_and_its_points_are_stored_with_the_session(
    qtbot: QtBot, page: LaserPage, tmp_path: Path
) -> None:
    image = np.arange(480_000, dtype=np.uint32).reshape(600, 800).astype(np.uint8)
    cv2.imwrite(str(tmp_path / "cross.png"), image)
    page.load_picture(tmp_path / "cross.png")
    qtbot.waitUntil(lambda: page.picture_view.picture is not None)
    steps, places = done_steps(page.session), cross_places(12.0)
    for point in page.picture_view.points:
        point.nudge(*np.subtract(places[point.name], point.place))
        point.release()
    page.scale.set_value(25.0)
    page.scale.edited.emit(25.0)
    assert done_steps(page.session) == steps + 7
    path = page.session.path
    page.workspace.close()
    (tmp_path / "cross.png").unlink()
    with page_of(path) as again:
        assert states(again.session)["laser"].mark is Mark.READY
        qtbot.waitUntil(lambda: again.picture_view.picture is not None)
        assert again.picture_view.isVisibleTo(again)
        np.testing.assert_array_equal(again.picture_view.picture, image)
        for name, place in places.items():
            assert again.places()[name] == pytest.approx(place)
        assert again.scale.value() == 25.0
        assert again.add_button.isEnabled()
        again.workspace.undo()
        again.workspace.undo()
        assert again.scale.value() == 10.0
        assert not again.add_button.isEnabled()
        again.workspace.redo()
        assert again.add_button.isEnabled()
        again.add_button.click()
        assert again.session.problems() == []
        again.use_button.click()
        assert again.session.laser_entries is None
        assert again.picture_view.picture is None


def test_picture_of_another_session_is_removed(
    qtbot: QtBot, page: LaserPage, tmp_path: Path
) -> None:
    cv2.imwrite(str(tmp_path / "cross.png"), np.full((600, 800), 40, np.uint8))
    page.load_picture(tmp_path / "cross.png")
    qtbot.waitUntil(lambda: page.picture_view.picture is not None)
    for point in page.picture_view.points:
        point.setPos(*cross_places(12.0)[point.name])
    assert page.add_button.isEnabled()
    page.workspace.show(Session.create(tmp_path / "other.labsession"))
    page.refresh()
    assert page.picture_view.picture is None
    assert not any(point.isVisible() for point in page.picture_view.points)
    assert not page.add_button.isEnabled()
    assert page.lengths.text() == ""


def test_unreadable_picture_is_reported(qtbot: QtBot, page: LaserPage, tmp_path) -> None:
    (tmp_path / "bad.png").write_bytes(b"no picture")
    with qtbot.waitSignal(page.workspace.notified) as signal:
        page.load_picture(tmp_path / "bad.png")
    assert "bad.png" in signal.args[0]
    assert page.picture_view.picture is None
