"""The imaging-plane page: points found or placed by hand, results with ±, values in use."""

from __future__ import annotations

import shutil
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from PySide6.QtCore import Qt
from PySide6.QtWidgets import QPushButton
from pytestqt.qtbot import QtBot

from labapp.config.setup_text import lens_of
from labapp.core.calibration.board_calibration import BoardCalibration
from labapp.core.calibration.boards import BOARDS
from labapp.core.calibration.imaging_plane import calibrate_imaging_plane
from labapp.core.calibration.mark_fit import Model
from labapp.core.calibration.plane_calibration import PlaneCalibration
from labapp.core.values import CannotMeasure
from labapp.errors import InputError
from labapp.gui.pages import kept_picture
from labapp.gui.pages.plane import presenter
from labapp.gui.pages.plane.page import PlanePage
from labapp.gui.shell.steps import Mark, states
from labapp.gui.tasks import DONE
from labapp.gui.workspace import Workspace
from labapp.session.calibrations import calibrations_in_use
from labapp.session.file.blobs import fingerprint
from labapp.session.session import Session
from labapp.simulation.calibration.board import board_svg
from labapp.simulation.calibration.target import Target, TargetLook, render_target, target_svg
from labapp.simulation.camera import Lens
from tests.gui.conftest import KEPT
from tests.inked_board import InkedBoard
from tests.posed_view import PosedView

GTAW = Path(__file__).parents[3] / "sample_sessions" / "gtaw"

SQUARE = PlaneCalibration(
    origin_px=(50.0, 400.0),
    x_axis_px=(50.0 + 5.5 * 60, 400.0),
    x_axis_mm=55.0,
    z_axis_px=(50.0, 400.0 - 2.5 * 60),
    z_axis_mm=25.0,
    sigma_px=(0.1, 0.2, 0.3),
    threshold=14.0,
)
"""Scale of 6 px/mm, orthogonal axes, units of 10 mm."""


def test_scales_and_angle_have_the_uncertainty_of_the_points() -> None:
    rows = {row.name: row for row in presenter.result(SQUARE).rows}
    along_x, along_z, angle = (
        rows[name] for name in ("Scale along O′X′", "Scale along O′Z′", "Angle")
    )
    assert (along_x.value, along_z.value, angle.value) == pytest.approx((6.0, 6.0, 90.0))
    assert along_x.sigma == pytest.approx(np.hypot(0.1, 0.2) / 55, rel=1e-3)
    assert along_z.sigma == pytest.approx(np.hypot(0.1, 0.3) / 25, rel=1e-3)
    at_origin = np.hypot(0.1 / 330, 0.1 / 150)
    sigma = np.degrees(np.sqrt((0.2 / 330) ** 2 + (0.3 / 150) ** 2 + at_origin**2))
    assert angle.sigma == pytest.approx(sigma, rel=1e-3)


def test_unusable_and_implausible_points_are_reported() -> None:
    assert "Load a picture" in presenter.result(None).why_not
    line = replace(SQUARE, z_axis_px=SQUARE.x_axis_px)
    assert "one line" in presenter.result(line).why_not
    odd = presenter.result(replace(SQUARE, z_axis_px=(250.0, 300.0)))
    assert not odd.why_not
    assert len(odd.warnings) == 2
    assert not presenter.result(SQUARE).warnings


def with_perspective(perspective: float) -> PlaneCalibration:
    """Target marks with noise and perspective: the far end of O′X′ appears smaller."""
    units = [(0, 0), *((n, 0) for n in range(1, 11)), *((0, n) for n in range(1, 5))]
    plane = 10.0 * np.array(units, float)
    shrink = 1 + perspective * plane[:, :1]
    image_px = ([50.0, 400.0] + plane * [6.0, -6.0]) / shrink
    image_px += np.random.default_rng(4).normal(0, 0.05, image_px.shape)
    marks = tuple((*row, 1.0) for row in np.column_stack([plane, image_px]).tolist())
    return replace(SQUARE, marks=marks, model="affine")


def test_model_is_proposed_with_a_reason_and_can_be_overridden() -> None:
    tilted = with_perspective(1e-3)
    assert [model for model, _ in presenter.choices(tilted)] == [
        "affine",
        "homography",
        "three points",
    ]
    assert dict(presenter.choices(tilted))["homography"].endswith("(proposed)")
    assert "perspective along X′" in presenter.why(tilted)
    assert dict(presenter.choices(with_perspective(0.0)))["affine"].endswith("(proposed)")
    assert "No perspective" in presenter.why(with_perspective(0.0))
    assert presenter.choices(SQUARE) == (("three points", "Three points"),)
    rows = {row.name: row.value for row in presenter.result(tilted).rows}
    assert 0.03 < rows["Homography residual"] < 0.1 < rows["Affine residual"]
    used = replace(tilted, model="homography").image_calibration
    np.testing.assert_allclose(used.to_image(np.array([[100.0, 0.0]])), [[590.9, 363.6]], atol=0.3)
    by_hand = presenter.moved(tilted, 0, (51.0, 400.0))
    assert (by_hand.model, by_hand.marks) == ("three points", ())


def test_residual_map_shows_the_residuals_of_the_model() -> None:
    tilted = with_perspective(1e-3)
    residuals = presenter.residual_map(tilted, 640)
    assert residuals is not None
    assert residuals.share.max() == 1.0
    arrows = np.hypot(*(residuals.end_px - residuals.begin_px).T)
    assert 12 < arrows.max() <= 64
    factor = float(residuals.words.split("×")[1].split(",")[0])
    marks = np.array(tilted.marks)
    places = tilted.image_calibration.to_image(marks[:, :2])
    np.testing.assert_allclose(
        (residuals.end_px - residuals.begin_px) / factor, places - marks[:, 2:4]
    )
    assert presenter.residual_map(SQUARE, 640) is None


def test_point_placed_by_hand_has_a_larger_uncertainty() -> None:
    moved = presenter.moved(SQUARE, 1, (381.0, 401.0))
    assert moved.x_axis_px == (381.0, 401.0)
    assert moved.sigma_px == (0.1, presenter.HAND_SIGMA_PX, 0.3)
    assert moved.origin_px == SQUARE.origin_px


def test_unit_changes_the_scale() -> None:
    twice = presenter.with_unit(SQUARE, 20.0)
    assert twice.px_per_mm == pytest.approx((3.0, 3.0))


def test_unit_marks_lie_on_the_axes() -> None:
    line, marks = presenter.axes(SQUARE, 10.0)
    np.testing.assert_allclose(line, [[650, 400], [50, 400], [50, 160]])
    assert len(marks) == 14
    np.testing.assert_allclose(marks[[0, 10]], [[110, 400], [50, 340]])


def test_first_points_form_a_target_within_the_picture() -> None:
    points = presenter.first_points((480, 640), 6.35)
    assert "Drag O′ and O′X′ and O′Z′" in presenter.result(points).why_not
    for point, place in enumerate(presenter.places(points)):
        points = presenter.moved(points, point, place)
    assert not presenter.result(points).why_not
    assert points.px_per_mm[0] == pytest.approx(points.px_per_mm[1])
    line, _ = presenter.axes(points, 6.35)
    assert (line >= 0).all()
    assert (line < [640, 480]).all()


def test_values_in_use_are_shown_for_either_form(tmp_path: Path) -> None:
    with Session.create(tmp_path / "new.labsession") as session:
        assert all(np.isnan(row.value) for row in presenter.in_use(session))
        image = cv2.imread(str(GTAW / "calibration.png"), cv2.IMREAD_UNCHANGED)
        session.use_plane(SQUARE, 10.0, image, "by hand")
        assert [row.value for row in presenter.in_use(session)] == pytest.approx([6, 6, 90])
        sigmas = [row.sigma for row in presenter.in_use(session)]
        assert sigmas == pytest.approx(SQUARE.scales_and_angle_sigma.tolist())
        assert states(session)["plane"].why == "Calibrated"
        homography = SQUARE.image_calibration.matrix.tolist()
        points = dict.fromkeys(
            ("origin_px", "x_axis_px", "x_axis_mm", "z_axis_px", "z_axis_mm"), None
        )
        session.update_setup({"image_calibration": {**points, "homography": homography}})
        assert [row.value for row in presenter.in_use(session)] == pytest.approx([6, 6, 90])
        assert [row.sigma for row in presenter.in_use(session)] == [None] * 3
        assert states(session)["plane"].why == "Other values were entered after the calibration"


def test_picture_without_a_target_is_rejected() -> None:
    with pytest.raises(CannotMeasure, match="no dark marks"):
        calibrate_imaging_plane([np.full((200, 300), 90, np.uint8)], 6.35, None)


# --- the page ---------------------------------------------------------------------------------


@contextmanager
def page_of(path: Path, qtbot: QtBot) -> Iterator[PlanePage]:
    """The page alone, of a session that is open nowhere else."""
    workspace = Workspace()
    workspace.show(Session.open(path))
    plane_page = PlanePage(workspace)
    KEPT.extend([workspace, plane_page, plane_page.panel])
    workspace.changed.connect(lambda: plane_page.refresh() if workspace.session else None)
    plane_page.refresh()
    plane_page.show()
    plane_page.panel.show()
    qtbot.waitUntil(lambda: not workspace.tasks.active)
    yield plane_page
    plane_page.leave()
    workspace.close()
    plane_page.hide()
    plane_page.panel.hide()


@pytest.fixture
def page(qtbot: QtBot, copy_sample: Callable[[str], Path]) -> Iterator[PlanePage]:
    with page_of(copy_sample("gtaw"), qtbot) as plane_page:
        yield plane_page


def test_target_is_saved_for_printing(page: PlanePage, tmp_path: Path) -> None:
    messages: list[tuple[str, bool]] = []
    page.workspace.notified.connect(lambda text, problem: messages.append((text, problem)))
    page.save_target(tmp_path / "target.svg")
    assert (tmp_path / "target.svg").read_text("utf-8") == target_svg(Target())
    assert not messages[-1][1]
    page.save_target(tmp_path / "not there" / "target.svg")
    assert messages[-1][1]
    assert "can be written" in messages[-1][0]


def test_target_is_found_applied_and_undone(qtbot: QtBot, page: PlanePage) -> None:
    session = page.workspace.session
    assert session is not None
    before = session.setup_text
    page.load(GTAW / "calibration.png")
    qtbot.waitUntil(lambda: page.found is not None and page.found.threshold > 0)
    qtbot.waitUntil(lambda: not page.workspace.tasks.active)
    assert page.found is not None
    page.drag(0, page.found.origin_px[0] + 3.0, page.found.origin_px[1])
    placed = page.found
    page.use_button.click()
    assert session.setup_text != before
    stored = session.plane_calibration
    assert stored is not None
    assert (stored.found, stored.unit_mm) == (placed, 6.35)
    qtbot.waitUntil(lambda: not page.workspace.tasks.active)
    assert page.applied.text().startswith(DONE)
    page.workspace.undo()
    assert session.setup_text == before


def test_only_the_calibration_in_use_is_called_so(qtbot: QtBot, page: PlanePage) -> None:
    kept = page.found
    page.load(GTAW / "calibration.png")  # the picture in use; the last digits may differ
    qtbot.waitUntil(lambda: page.found is not kept and not page.workspace.tasks.active)
    page.use()
    qtbot.waitUntil(lambda: not page.workspace.tasks.active)
    assert page.applied.text().startswith(DONE)
    page.unit.set_value(7.0)
    page.unit.edited.emit(7.0)
    assert page.applied.text() == ""
    page.kept_button.click()
    qtbot.waitUntil(lambda: page.applied.text().startswith(DONE))
    page.load(GTAW / "not there.png")
    qtbot.waitUntil(lambda: page.answer.text() != "")
    assert page.applied.text().startswith(DONE)  # it is still the one that is shown
    page.workspace.attempt(
        lambda session: session.update_setup({"image_calibration": {"x_axis_mm": 50.0}})
    )
    assert page.applied.text() == ""


def test_picture_of_another_size_than_the_frames_is_reported(
    qtbot: QtBot, page: PlanePage, tmp_path: Path
) -> None:
    assert page.words.text() == ""
    image = cv2.imread(str(GTAW / "calibration.png"), cv2.IMREAD_GRAYSCALE)
    assert image is not None
    cv2.imwrite(str(tmp_path / "high.png"), np.pad(image, ((10, 10), (0, 0)), mode="edge"))
    page.load(tmp_path / "high.png")
    qtbot.waitUntil(lambda: "480×660 px, and frames have 480×640 px" in page.words.text())
    qtbot.waitUntil(lambda: not page.workspace.tasks.active)


def test_only_one_search_runs_and_it_replaces_no_dragged_point(
    qtbot: QtBot, page: PlanePage, monkeypatch: pytest.MonkeyPatch
) -> None:
    page.load(GTAW / "calibration.png")
    qtbot.waitUntil(lambda: page.found is not None and page.found.threshold > 0)
    qtbot.waitUntil(lambda: not page.workspace.tasks.active)
    answer, release, begun = page.found, threading.Event(), threading.Semaphore(0)
    searches: list[object] = []

    def slow(*given: object, lens: object) -> object:
        searches.append(given)
        begun.release()
        release.wait()
        return answer

    monkeypatch.setattr("labapp.gui.pages.plane.page.calibrate_imaging_plane", slow)
    page.find_button.click()
    page.find_button.click()
    qtbot.waitUntil(lambda: begun.acquire(blocking=False))
    assert len(page.workspace.tasks.active) == len(searches) == 1
    page.drag(0, 100.0, 200.0)
    release.set()
    qtbot.waitUntil(lambda: not page.workspace.tasks.active)
    assert page.found is not None
    assert page.found.origin_px == (100.0, 200.0)
    page.find_button.click()
    qtbot.waitUntil(lambda: page.found == answer)
    assert len(searches) == 2


def test_the_picture_chosen_last_is_shown(
    qtbot: QtBot, page: PlanePage, monkeypatch: pytest.MonkeyPatch
) -> None:
    first, release = np.zeros((20, 30), np.uint8), threading.Event()
    last = np.ones((20, 30), np.uint8)

    def read(path: Path) -> object:
        if path.name == "first.png":
            release.wait()
            return first
        return last

    monkeypatch.setattr(kept_picture, "read_picture", read)
    page.load(Path("first.png"))
    page.load(Path("last.png"))
    qtbot.waitUntil(lambda: page.view.picture is last)
    release.set()
    qtbot.waitUntil(lambda: not page.workspace.tasks.active)
    assert page.view.picture is last


def test_arrow_keys_move_the_selected_point(qtbot: QtBot, page: PlanePage) -> None:
    page.load(GTAW / "calibration.png")
    qtbot.waitUntil(lambda: not page.workspace.tasks.active)
    assert page.found is not None
    u, v = page.found.x_axis_px
    scale = page.result.rows[0].value
    qtbot.keyClick(page.view, Qt.Key.Key_P)
    qtbot.keyClick(page.view, Qt.Key.Key_Right, Qt.KeyboardModifier.ShiftModifier)
    qtbot.keyClick(page.view, Qt.Key.Key_Up)
    assert page.found.x_axis_px == pytest.approx((u + 1.0, v - 0.1))
    assert page.result.rows[0].value != scale


def test_points_can_be_placed_if_no_target_is_found(
    qtbot: QtBot, page: PlanePage, tmp_path: Path
) -> None:
    cv2.imwrite(str(tmp_path / "bare.png"), np.full((200, 300), 90, np.uint8))
    messages: list[str] = []
    page.workspace.notified.connect(lambda words, _: messages.append(words))
    page.load(tmp_path / "bare.png")
    qtbot.waitUntil(lambda: len(messages) == 1)
    assert "no dark marks" in messages[0]
    assert [point.isVisible() for point in page.points] == [True] * 3
    for k, place in enumerate([(30.0, 180.0), (120.0, 181.0), (31.0, 120.0)]):
        assert not page.use_button.isEnabled()
        page.drag(k, *place)
    assert page.use_button.isEnabled()


def test_new_unit_applies_at_once(qtbot: QtBot, page: PlanePage) -> None:
    page.load(GTAW / "calibration.png")
    qtbot.waitUntil(lambda: not page.workspace.tasks.active)
    scale = page.result.rows[0].value
    page.unit.editor.setFocus()
    page.unit.editor.selectAll()
    qtbot.keyClicks(page.unit.editor, "12.7")
    qtbot.keyClick(page.unit.editor, Qt.Key.Key_Return)
    assert page.result.rows[0].value == pytest.approx(scale / 2)


def test_operator_can_choose_another_model(qtbot: QtBot, page: PlanePage) -> None:
    session = page.workspace.session
    assert session is not None
    page.load(GTAW / "calibration.png")
    qtbot.waitUntil(lambda: page.found is not None and bool(page.found.marks))
    qtbot.waitUntil(lambda: not page.workspace.tasks.active)
    assert page.model.value() == "affine"
    assert "No perspective" in page.why.text()
    assert "Arrows" in page.why.text()
    before = session.setup_text
    page.model.edited.emit("homography")
    chosen = page.found
    assert chosen is not None
    assert chosen.model == "homography"
    page.use_button.click()
    assert "homography = [" in session.setup_text
    assert "origin_px =" not in session.setup_text
    assert "origin_px_sigma" in session.setup_text
    page.workspace.undo()
    assert session.setup_text == before


@pytest.mark.parametrize("model", ["affine", "homography", "three points"])
def test_applied_calibration_equals_the_shown_one_exactly(
    qtbot: QtBot, page: PlanePage, model: Model
) -> None:
    session = page.workspace.session
    assert session is not None
    page.load(GTAW / "calibration.png")
    qtbot.waitUntil(lambda: page.found is not None and bool(page.found.marks))
    qtbot.waitUntil(lambda: not page.workspace.tasks.active)
    page.model.edited.emit(model)
    chosen = page.found
    assert chosen is not None
    page.use_button.click()
    np.testing.assert_array_equal(
        session.setup.calibration.matrix, chosen.image_calibration.matrix, strict=True
    )
    stored = session.plane_calibration
    assert stored is not None
    assert stored.found == chosen
    used = [row.value for row in presenter.in_use(session)]
    shown = [row.value for row in presenter.result(chosen).rows[:3]]
    assert used == pytest.approx(shown, rel=1e-12)


def done_steps(session: Session) -> int:
    return sum(not change.undone for change in session.history)


def load(qtbot: QtBot, page: PlanePage, path: Path) -> None:
    page.load(path)
    qtbot.waitUntil(lambda: page.session.plane_entries is not None)
    qtbot.waitUntil(lambda: not page.workspace.tasks.active)


def test_points_are_stored_with_the_session_until_applied(
    qtbot: QtBot, copy_sample: Callable[[str], Path], tmp_path: Path
) -> None:
    path, picture = copy_sample("gtaw"), tmp_path / "target.png"
    image = cv2.imread(str(GTAW / "calibration.png"), cv2.IMREAD_GRAYSCALE)
    assert image is not None
    cv2.imwrite(str(picture), np.roll(image, 3, axis=1))
    with page_of(path, qtbot) as page:
        setup, applied, steps = page.session.setup_text, page.found, done_steps(page.session)
        load(qtbot, page, picture)
        qtbot.keyClick(page.view, Qt.Key.Key_P)
        for _ in range(3):
            qtbot.keyPress(page.view, Qt.Key.Key_Right)
        qtbot.keyRelease(page.view, Qt.Key.Key_Right)
        placed = page.found
        page.unit.edited.emit(6.35)  # as it was
        assert done_steps(page.session) == steps + 2  # a held key is one step
        page.drag(1, 100.0, 200.0)  # the button is still held
        dragged = page.found
        assert placed is not None
        assert dragged != placed
    picture.unlink()
    with page_of(path, qtbot) as page:
        assert page.found == dragged
        np.testing.assert_array_equal(page.view.picture, np.roll(image, 3, axis=1))
        assert page.session.setup_text == setup
        assert not page.applied.text().startswith(DONE)
        assert states(page.session)["plane"].mark is Mark.READY
        page.workspace.undo()
        qtbot.waitUntil(lambda: page.found == placed)
        page.use_button.click()
        qtbot.waitUntil(lambda: not page.workspace.tasks.active)
        assert page.session.plane_entries is None
        assert page.applied.text().startswith(DONE)
        assert page.found == placed
        page.workspace.undo()  # of Apply: what was placed stays, so that it can be corrected
        qtbot.waitUntil(lambda: not page.workspace.tasks.active)
        assert page.found == placed
        page.kept_button.click()
        qtbot.waitUntil(lambda: page.found == applied)
        assert page.session.plane_entries is None
        assert states(page.session)["plane"].mark is Mark.DONE


def test_unplaced_points_are_stored_as_such(
    qtbot: QtBot, copy_sample: Callable[[str], Path], tmp_path: Path
) -> None:
    path = copy_sample("gtaw")
    cv2.imwrite(str(tmp_path / "bare.png"), np.full((200, 300), 90, np.uint8))
    with page_of(path, qtbot) as page:
        page.load(tmp_path / "bare.png")
        qtbot.waitUntil(lambda: page.answer.text() != "")
        page.points[0].setPos(20.0, 180.0)
        page.points[0].placed.emit()
        waiting = presenter.result(page.found).why_not
        assert waiting
        page.drag(1, 20.0, 180.0)  # on one line, at one place: no calibration
    with page_of(path, qtbot) as page:
        assert page.points[0].place == (20.0, 180.0)
        assert presenter.result(page.found).why_not == waiting
        assert not page.use_button.isEnabled()


def test_points_that_cannot_be_stored_stay(
    qtbot: QtBot, page: PlanePage, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object) -> None:
        raise InputError(page.session.path, "disk", "no space left", "room on the disk")

    with monkeypatch.context() as patch:
        patch.setattr(Session, "set_entries", fail)
        page.points[0].setPos(60.0, 70.0)
        page.points[0].placed.emit()
        assert page.points[0].place == (60.0, 70.0)
    assert page.session.plane_entries is None
    page.points[0].placed.emit()
    assert page.session.plane_entries is not None


def test_nothing_is_stored_in_a_session_that_is_read_only(
    qtbot: QtBot, page: PlanePage, tmp_path: Path
) -> None:
    path = page.session.path
    page.workspace.close()
    before = path.read_bytes()
    page.workspace.show(Session.open(path, read_only=True))
    qtbot.waitUntil(lambda: not page.workspace.tasks.active)
    shutil.copy(GTAW / "calibration.png", tmp_path / "again.png")
    former = page.view.picture
    page.load(tmp_path / "again.png")
    qtbot.waitUntil(lambda: page.view.picture is not former)
    qtbot.waitUntil(lambda: not page.workspace.tasks.active)
    page.leave()
    assert page.answer.text() == ""
    assert path.read_bytes() == before


def test_every_button_has_a_tooltip(page: PlanePage) -> None:
    buttons = page.panel.findChildren(QPushButton)
    assert len(buttons) == 6
    assert all(button.toolTip() for button in buttons)


def board_picture(path: Path, turned_deg: tuple[float, float, float] = (1, -2, 1.3)) -> Path:
    """A picture of a board through a lens with 1 % distortion."""
    view = PosedView.at((40.0, 36.0), 5.0, turned_deg=turned_deg, lens=Lens(1000.0, k1=-0.06))
    printed, rng = InkedBoard(BOARDS["charuco_4_inch"]), np.random.default_rng(1)
    cv2.imwrite(str(path), render_target(printed, view, TargetLook(), rng))
    return path


def test_board_is_detected_applied_and_undone(
    page: PlanePage, tmp_path: Path, qtbot: QtBot
) -> None:
    session = page.workspace.session
    assert session is not None
    before = session.setup_text
    page.load(board_picture(tmp_path / "board.png"))
    qtbot.waitUntil(lambda: isinstance(page.found, BoardCalibration), timeout=30_000)
    board = page.found
    assert isinstance(board, BoardCalibration)
    assert page.square.value() == 8.0
    assert page.add_button.isEnabled()
    assert not any(point.isVisible() for point in page.points)
    rows = {row.name: row for row in presenter.result(board).rows}
    assert rows["Distortion"].value == pytest.approx(-0.96, abs=0.1)
    residuals = presenter.residual_map(board, 640)
    assert residuals is not None
    assert len(residuals.share) == len(board.seen[0].index)
    page.use()
    stored = session.plane_calibration
    assert stored is not None
    assert isinstance(stored.found, BoardCalibration)
    np.testing.assert_array_equal(stored.found.seen[0].image_px, board.seen[0].image_px)
    assert session.setup is not None
    assert session.setup.calibration.lens == board.image_calibration.lens
    assert calibrations_in_use(session)[1]
    assert lens_of(session.setup_text) is not None
    session.undo()
    assert session.setup_text == before


@pytest.mark.slow
def test_all_pictures_of_a_board_are_stored_until_applied(
    qtbot: QtBot, copy_sample: Callable[[str], Path], tmp_path: Path
) -> None:
    path = copy_sample("gtaw")
    with page_of(path, qtbot) as page:
        load(qtbot, page, board_picture(tmp_path / "board.png"))
        first = page.found
        page.add_picture(board_picture(tmp_path / "further.png", turned_deg=(9, -9, 1.3)))
        qtbot.waitUntil(lambda: page.found is not first)
        qtbot.waitUntil(lambda: not page.workspace.tasks.active)
        found = page.found
        assert isinstance(found, BoardCalibration)
        assert len(found.seen) == 2
    with page_of(path, qtbot) as page:
        assert fingerprint(page.found) == fingerprint(found)
        page.find_button.click()  # in both pictures
        qtbot.waitUntil(lambda: not page.workspace.tasks.active)
        assert fingerprint(page.found) == fingerprint(found)
        page.use()
        qtbot.waitUntil(lambda: not page.workspace.tasks.active)
        assert page.applied.text().startswith(DONE)
        page.load(board_picture(tmp_path / "other.png", turned_deg=(3, 2, 0)))
        qtbot.waitUntil(lambda: page.session.plane_entries is not None)
        assert page.applied.text() == ""


def test_board_is_saved_for_printing(page: PlanePage, tmp_path: Path) -> None:
    page.print.set_value("charuco_letter_a4")
    page.save_target(tmp_path / "board.pdf")
    assert (tmp_path / "board.pdf").read_bytes().startswith(b"%PDF")
    page.save_target(tmp_path / "board.svg")
    assert (tmp_path / "board.svg").read_text("utf-8") == board_svg(BOARDS["charuco_letter_a4"])
