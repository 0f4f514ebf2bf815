"""Bench check: pictures of known mirrors, the check, its display, applying and undoing it."""

from __future__ import annotations

import threading
import tomllib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from PySide6.QtCore import QRectF, Qt
from PySide6.QtWidgets import QPushButton
from pytestqt.qtbot import QtBot

from labapp.config.setup import (
    checked_setup,
    parse_setup,
    read_setup,
    unchecked_setup,
    updated_setup,
)
from labapp.core.bench_check.forecast import CANDIDATES
from labapp.core.bench_check.mirrors import Ball, Cap, Plate
from labapp.core.bench_check.suspects import Suspect
from labapp.core.geometry.uncertainty import INDEX
from labapp.core.images.find_dots import DotSettings
from labapp.core.values import CannotMeasure
from labapp.errors import InputError
from labapp.gui.pages.bench_check import presenter
from labapp.gui.pages.bench_check.page import BenchCheckPage
from labapp.gui.pages.bench_check.presenter import CheckResult, ListedPicture
from labapp.gui.pages.setup import presenter as setup_presenter
from labapp.gui.shell.steps import Mark, states
from labapp.gui.workspace import Workspace
from labapp.media import GreyImage
from labapp.session.session import Session
from labapp.simulation.camera import CameraView
from labapp.simulation.forward import trace
from labapp.simulation.render import Look, render
from labapp.text import SETUP_MARKS, with_sigma
from tests.gui.conftest import KEPT
from tests.mirrors import FlatMirror
from tests.waiting import PATIENCE_S

SETUP = Path(__file__).parents[3] / "sample_sessions" / "gtaw" / "setup.toml"

TRUE_ANGLE_DEG, TRUE_ROTATION_DEG = 31.54, 1.2
"""Values of the simulated bench; the set-up has 31.14 and 0."""


@pytest.fixture(scope="module")
def plate() -> GreyImage:
    """A plate in place of the workpiece, on a bench that deviates slightly from its set-up."""
    calibration = tomllib.loads(SETUP.read_text("utf-8"))["image_calibration"]
    view = CameraView(**{k: tuple(x) if isinstance(x, list) else x for k, x in calibration.items()})
    rig = read_setup(SETUP).rig
    laser = replace(rig.laser, projection_angle_deg=TRUE_ANGLE_DEG)
    rig = replace(rig, laser=laser, pattern=replace(rig.pattern, rotation_deg=TRUE_ROTATION_DEG))
    look, rng = Look(glow=0.0), np.random.default_rng(3)
    return np.asarray(render(trace(FlatMirror(), rig), view, look, rng).image, np.uint8)


@pytest.fixture(scope="module")
def checked(plate: GreyImage) -> CheckResult:
    chosen = [ListedPicture("plate.png", plate)]
    text = SETUP.read_text("utf-8")
    return presenter.check(chosen, (text, SETUP), DotSettings(), lambda *_: None)


# --- the presenter ------------------------------------------------------------------------------


def test_picture_has_the_entered_mirror() -> None:
    one = ListedPicture("a", np.zeros((2, 2), np.uint8))
    assert one.mirror == Plate(0.0)
    cap = replace(one.of_kind("cap"), height_mm=0.5, diameter_mm=8.0)
    assert cap.mirror == Cap(8.0, 0.5)
    assert one.of_kind("ball").mirror == Ball(10.0, 10.0)
    assert not cap.problem
    assert replace(cap, height_mm=0.0).problem
    assert not one.problem


def test_uncertainty_of_a_mirror_is_entered() -> None:
    one = ListedPicture("a", np.zeros((2, 2), np.uint8))
    assert one.usual_height_sigma_mm == Plate.height_sigma_mm
    known = replace(one, height_sigma_mm=0.005, level_sigma_deg=0.03)
    assert known.mirror == Plate(0.0, 0.005, 0.03)
    ball = replace(one.of_kind("ball"), height_sigma_mm=0.005)
    assert ball.mirror == Ball(10.0, 10.0, height_sigma_mm=0.005)
    assert known.of_kind("cap").mirror == Cap(9.75, 0.91)


@pytest.mark.slow
def test_uncertainty_of_a_mirror_is_stored(checked: CheckResult) -> None:
    (picture,), (chosen,) = checked.record.pictures, checked.chosen
    assert ListedPicture.of_kept(picture, chosen.image).mirror == chosen.mirror
    assert chosen.is_of(picture)
    assert chosen.is_of(replace(picture, pose_sigma=()))  # of an earlier version
    level = replace(chosen, level_sigma_deg=0.03)
    assert not level.is_of(picture)
    sigma = tuple(zip(level.mirror.parameters, level.mirror.sigma.tolist(), strict=True))
    picture = replace(picture, pose_sigma=sigma)
    assert ListedPicture.of_kept(picture, chosen.image).mirror == level.mirror


@pytest.mark.slow
def test_undetectable_height_error_is_reported(checked: CheckResult) -> None:
    (spot,) = checked.blind
    assert spot.picture == "plate.png"
    assert f"{spot.noticed_mm:.2g} mm" in checked.words
    assert spot.picture not in replace(checked, blind=()).words


@pytest.mark.slow
def test_check_finds_deviations_and_undetermined_quantities(checked: CheckResult) -> None:
    assert checked.usable
    record = checked.record
    k = INDEX["pattern.rotation_deg"]
    assert abs(record.after[k] - TRUE_ROTATION_DEG) < 3 * record.after_sigma[k]
    rows = {(row.group, row.texts[0]): row for row in presenter.quantity_rows(record)}
    uncertain = record.before_sigma > 0.0
    assert len(rows) == uncertain.sum() == len(INDEX) - 2  # there is no glass
    assert ("Imaging plane", "s") in rows
    rotation = rows["Pattern", "Rotation"]
    assert rotation.texts[-1] == presenter.DETERMINED
    assert " ± " in rotation.texts[2]
    undetermined = {name for name, row in rows.items() if row.texts[-1] == presenter.NOT_DETERMINED}
    share = record.after_sigma[uncertain] / record.before_sigma[uncertain]
    assert len(undetermined) == (share > 0.8).sum() > 0


@pytest.mark.slow
def test_known_mirror_is_measured_with_the_adjusted_bench(checked: CheckResult) -> None:
    ((name, known, measured, sigma),) = checked.record.pictures[0].measured
    assert (name, known) == ("height", 0.0)
    assert 0 < sigma < 0.05
    assert abs(measured) < 0.05
    ((alone, alone_sigma),) = checked.record.pictures[0].independent
    assert presenter.mirror_rows(checked.record) == (
        ("Plate, height 0.000", with_sigma(measured, sigma), with_sigma(alone, alone_sigma)),
    )
    assert alone_sigma > sigma
    ball = replace(
        checked.record.pictures[0],
        kind="ball",
        measured=(("radius", 5.0, 5.003, 0.01),),
        independent=(),
    )
    (row,) = presenter.mirror_rows(replace(checked.record, pictures=(ball,)))
    assert row == ("Ball, radius 5.000", "5.003 ± 0.010", "")


@pytest.mark.slow
def test_overlay_has_dots_in_place_and_enlarged_arrows(checked: CheckResult) -> None:
    (picture,) = checked.record.pictures
    overlay = presenter.overlay(picture, 640)
    factor = float(overlay.words.split("×")[1].split(",")[0])
    begin, end = overlay.arrows_px[::2], overlay.arrows_px[1::2]
    np.testing.assert_allclose(begin, picture.dot_px)
    np.testing.assert_allclose((end - begin) / factor, picture.computed_px - picture.dot_px)
    rows = [text for text, _, _, of_row in overlay.numbers if of_row]
    assert rows == ["i1", "i5", "i10", "i15", "i19"]
    u, v = picture.dot_px[7]
    i, j = picture.ray[7]
    assert f"({i}, {j})" in presenter.ray_words(picture, u + 0.5, v)
    assert presenter.ray_words(picture, -100.0, 0.0) == ""


def test_dark_pictures_are_rejected_with_the_cause() -> None:
    dark = ListedPicture("dark.png", np.zeros((640, 480), np.uint8))
    text = SETUP.read_text("utf-8")
    with pytest.raises(CannotMeasure, match=r"dark\.png"):
        presenter.check([dark], (text, SETUP), DotSettings(), lambda *_: None)


@pytest.mark.slow
def test_predicted_uncertainty_falls_with_more_pictures(tmp_path: Path) -> None:
    with Session.create(tmp_path / "new.labsession") as session:
        record = session.record
    prediction = presenter.predicted(read_setup(SETUP), record)
    values = [float(sigma) for _, sigma in prediction.rows]
    assert len(values) == len(CANDIDATES) + 1
    assert all(value < values[0] for value in values[1:])


@pytest.mark.slow
def test_picture_set_without_dots_is_reported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The imaging plane ends far below the dots of a plate at 90 mm."""
    sets = {"high": (Plate(90.0),), "level": (Plate(0.0),)}
    monkeypatch.setattr(presenter, "CANDIDATES", sets)
    with Session.create(tmp_path / "new.labsession") as session:
        prediction = presenter.predicted(read_setup(SETUP), session.record)
    sigmas = dict(prediction.rows)
    assert len(sigmas) == 3
    assert sigmas["High"] == presenter.NO_DOTS
    assert float(sigmas["Level"]) > 0


def test_picture_of_another_size_is_rejected(tmp_path: Path) -> None:
    one, other = (ListedPicture(str(n), np.zeros((n, 48), np.uint8)) for n in (64, 32))
    with Session.create(tmp_path / "new.labsession") as session:
        presenter.check_sizes(session, [one, one])
        with pytest.raises(CannotMeasure, match="48 × 32"):
            presenter.check_sizes(session, [one, other])


# --- the page -----------------------------------------------------------------------------------


@contextmanager
def page_of(path: Path, qtbot: QtBot) -> Iterator[BenchCheckPage]:
    """The page alone, of a session that is open nowhere else."""
    workspace = Workspace()
    workspace.show(Session.open(path))
    bench_page = BenchCheckPage(workspace)
    KEPT.extend([workspace, bench_page, bench_page.panel])
    workspace.changed.connect(lambda: bench_page.refresh() if workspace.session else None)
    bench_page.refresh()
    bench_page.show()
    bench_page.panel.show()
    qtbot.waitUntil(lambda: not workspace.tasks.active)
    yield bench_page
    workspace.close()
    bench_page.hide()
    bench_page.panel.hide()


@pytest.fixture
def page(qtbot: QtBot, copy_sample: Callable[[str], Path]) -> Iterator[BenchCheckPage]:
    with page_of(copy_sample("gtaw"), qtbot) as bench_page:
        yield bench_page


def add(qtbot: QtBot, page: BenchCheckPage, folder: Path, *images: GreyImage) -> None:
    for n, image in enumerate(images):
        path = folder / f"mirror {n}.png"
        cv2.imwrite(str(path), image)
        page.load(path)
        qtbot.waitUntil(lambda: not page.workspace.tasks.active)


def test_pictures_are_listed_edited_and_removed(
    qtbot: QtBot, page: BenchCheckPage, tmp_path: Path
) -> None:
    assert not page.check_button.isEnabled()
    blank = np.zeros((64, 48), np.uint8)
    add(qtbot, page, tmp_path, blank, blank)
    assert page.list.rowCount() == 2
    assert page.check_button.isEnabled()
    assert not page.use_button.isEnabled()
    page.list.selectRow(1)
    page.mirror_form.kind.edited.emit("cap")
    page.mirror_form.height_field.edited.emit(0.5)
    page.mirror_form.diameter.edited.emit(8.0)
    assert [one.mirror for one in page.chosen] == [Plate(0.0), Cap(8.0, 0.5)]
    page.mirror_form.height_field.edited.emit(0.0)
    assert not page.check_button.isEnabled()
    page.remove_button.click()
    assert [one.mirror for one in page.chosen] == [Plate(0.0)]
    assert not page.mirror_form.diameter.editor.isEnabled()


def test_picture_that_is_not_checked_is_shown_whole(
    qtbot: QtBot, page: BenchCheckPage, tmp_path: Path, plate: GreyImage, checked: CheckResult
) -> None:
    add(qtbot, page, tmp_path, plate)
    rows, columns = plate.shape
    whole = QRectF(0, 0, columns - 1, rows - 1)
    page._show_picture(checked.record.pictures[0])
    assert not page.view.box.viewRect().contains(whole)
    page._show_picture(None)
    assert page.view.box.viewRect().contains(whole)


def test_pictures_are_stored_with_the_session_until_applied(
    qtbot: QtBot, copy_sample: Callable[[str], Path], tmp_path: Path
) -> None:
    path, images = copy_sample("gtaw"), [np.full((64, 48), n, np.uint8) for n in (10, 20)]
    with page_of(path, qtbot) as page:
        add(qtbot, page, tmp_path, *images)
        page.mirror_form.kind.edited.emit("ball")
        page.mirror_form.diameter.edited.emit(8.0)
        page.mirror_form.height_sigma.edited.emit(0.02)
        setup, words = page.session.setup_text, [one.mirror for one in page.chosen]
    for picture in tmp_path.glob("mirror*.png"):
        picture.unlink()
    with page_of(path, qtbot) as page:
        assert [one.mirror for one in page.chosen] == words
        for one, image in zip(page.chosen, images, strict=True):
            np.testing.assert_array_equal(one.image, image)
        assert page.session.setup_text == setup
        assert page.session.bench_check is None
        assert "2 pictures" in states(page.session)["bench_check"].why
        page.workspace.undo()
        qtbot.waitUntil(lambda: page.chosen[1].height_sigma_mm is None)
        page.list.selectRow(0)
        page.remove_button.click()
        page.remove_button.click()
        assert page.session.bench_entries is None
        page.workspace.undo()
        qtbot.waitUntil(lambda: len(page.chosen) == 1)
        np.testing.assert_array_equal(page.chosen[0].image, images[1])


def test_pictures_that_cannot_be_stored_stay(
    qtbot: QtBot, page: BenchCheckPage, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object) -> None:
        raise InputError(page.session.path, "disk", "no space left", "room on the disk")

    monkeypatch.setattr(Session, "set_entries", fail)
    add(qtbot, page, tmp_path, np.zeros((64, 48), np.uint8))
    assert len(page.chosen) == 1


def test_entered_uncertainties_can_be_cleared(
    qtbot: QtBot, page: BenchCheckPage, tmp_path: Path
) -> None:
    add(qtbot, page, tmp_path, np.zeros((64, 48), np.uint8))
    for field in (page.mirror_form.height_sigma, page.mirror_form.level):
        field.editor.selectAll()
        qtbot.keyClicks(field.editor, "0.02")
        field.flush()
    assert (page.chosen[0].height_sigma_mm, page.chosen[0].level_sigma_deg) == (0.02, 0.02)
    for field in (page.mirror_form.height_sigma, page.mirror_form.level):
        field.editor.clear()
        field.flush()
        assert field.problem.isHidden()
    assert (page.chosen[0].height_sigma_mm, page.chosen[0].level_sigma_deg) == (None, None)


def test_only_pictures_can_be_dropped(qtbot: QtBot, page: BenchCheckPage, tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "a.png"), np.zeros((64, 48), np.uint8))
    assert page.takes_files([tmp_path / "a.png"])
    qtbot.waitUntil(lambda: len(page.chosen) == 1)
    assert not page.takes_files([tmp_path / "a.labsession"])


def test_rejection_is_shown_beside_the_button(
    qtbot: QtBot, page: BenchCheckPage, tmp_path: Path
) -> None:
    add(qtbot, page, tmp_path, np.zeros((640, 480), np.uint8))
    page.check_button.click()
    qtbot.waitUntil(lambda: not page.workspace.tasks.active)
    assert page.answer.text()
    assert page.checked is None
    assert not page.use_button.isEnabled()


def test_work_pressed_twice_runs_once(
    qtbot: QtBot, page: BenchCheckPage, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    free, runs = threading.Event(), []

    def wait(chosen: object, *_: object) -> None:
        runs.append(chosen)
        free.wait(PATIENCE_S)
        raise CannotMeasure("no-dots", "no dots")

    monkeypatch.setattr(presenter, "check", wait)
    monkeypatch.setattr(presenter, "predicted", wait)
    shape = page.session.recording
    assert shape is not None
    add(qtbot, page, tmp_path, np.zeros((shape.rows, shape.columns), np.uint8))
    for pressed in (page.check_button, page.predict_button):
        runs.clear()
        pressed.click()
        pressed.click()
        qtbot.waitUntil(lambda: len(runs) > 0)
        assert len(page.workspace.tasks.active) == 1
        free.set()
        qtbot.waitUntil(lambda: not page.workspace.tasks.active)
        free.clear()
    page.check_button.click()
    former = page.workspace.tasks.active[0]
    page.mirror_form.kind.edited.emit("cap")
    page.check_button.click()  # with another mirror
    assert former.control.cancelled.is_set()
    assert len(page.workspace.tasks.active) == 2
    free.set()
    qtbot.waitUntil(lambda: not page.workspace.tasks.active)


@pytest.mark.slow
def test_bench_check_is_applied_stored_and_undone(
    qtbot: QtBot, page: BenchCheckPage, tmp_path: Path, plate: GreyImage
) -> None:
    session = page.session
    before = session.setup_text
    assert states(session)["bench_check"].mark is Mark.READY
    add(qtbot, page, tmp_path, plate)
    page.check_button.click()
    qtbot.waitUntil(lambda: page.checked is not None)
    assert {row.texts[0] for row in presenter.quantity_rows(page.checked.record)} <= {
        page.quantities.item(row, 0).text() for row in range(page.quantities.rowCount())
    }
    assert page.mirrors.rowCount() == 1
    not_used = page.state(states(session)["bench_check"])
    assert not_used.mark is Mark.READY
    assert not_used != states(session)["bench_check"]
    assert session.bench_entries is not None
    page.use_button.click()
    assert session.bench_entries is None
    assert page.state(states(session)["bench_check"]).mark is Mark.DONE
    setup = session.setup
    assert setup.rig.uncertainty is not None
    assert setup.rig.uncertainty.status == "checked"
    assert states(session)["bench_check"].mark is Mark.DONE
    stored = session.bench_check
    assert stored is not None
    (picture,) = stored.pictures
    np.testing.assert_array_equal(session.picture(picture.picture_sha256), plate)
    assert session.problems(recording=False) == []
    assert not page.use_button.isEnabled()
    assert page.answer.text()

    session.update_setup({"laser": {"aim_x_mm": 0.25}})
    assert states(session)["bench_check"].mark is Mark.ATTENTION
    setup_view = setup_presenter.shown(session)
    assert setup_view.usual_sigmas == setup_presenter.ASSUMED
    assert setup_view.status.startswith(SETUP_MARKS["entered"])
    assert stored.date[:10] in setup_view.status
    assert stored.date[:10] in presenter.kept_words(session)
    session.undo()
    assert states(session)["bench_check"].mark is Mark.DONE
    page.workspace.undo()
    assert session.setup_text == before
    assert session.bench_check is None
    assert states(session)["bench_check"].mark is Mark.READY
    assert page.use_button.isEnabled()
    assert not page.answer.text()


@pytest.mark.slow
def test_stored_check_is_shown_when_its_session_is_opened(
    qtbot: QtBot, page: BenchCheckPage, checked: CheckResult
) -> None:
    workspace, path = page.workspace, page.session.path
    image = checked.chosen[0].image
    check = replace(checked.check, before=page.session.setup.rig)
    page.session.use_bench_check(check, checked.record, [image])
    workspace.close()
    workspace.show(Session.open(path))
    page.refresh()
    qtbot.waitUntil(lambda: len(page.chosen) == 1)
    assert page.view.picture is not None
    assert page.quantities.rowCount() > len(INDEX)
    assert page.mirrors.rowCount() == 1
    assert "In use" in page.words.text()


@pytest.mark.slow
def test_rejected_check_shows_suspects_and_no_measured_mirror(
    page: BenchCheckPage, checked: CheckResult
) -> None:
    """Mirrors measured with a rejected bench would look right."""
    page.chosen = list(checked.chosen)
    suspects = (
        Suspect("laser.distance_mm", "laser, distance", 30.0),
        Suspect("imaging_plane.h_mm", "imaging plane, h", 30.0),
    )
    failed = replace(checked.check, status="quantity-off", reason="off", suspects=suspects)
    page.checked = replace(checked, check=failed, setup_text=page.session.setup_text)
    page.refresh()
    assert page.suspect.value() == "laser.distance_mm"
    assert page.mirrors.rowCount() == 0
    assert page.quantities.rowCount() > len(INDEX)
    assert not page.use_button.isEnabled()
    assert page.state(states(page.session)["bench_check"]).mark is Mark.ATTENTION
    failed = replace(failed, suspects=suspects[1:])
    page.checked = replace(page.checked, check=failed)
    page.refresh()
    assert page.suspect.value() == "imaging_plane.h_mm"
    page.checked = replace(page.checked, check=replace(failed, status="size-off"))
    page.refresh()
    assert page.suspect_part.isHidden()
    page.workspace.close()
    assert page.state(states(None)["bench_check"]) == states(None)["bench_check"]


def test_lines_are_not_checked(page: BenchCheckPage, copy_sample: Callable[[str], Path]) -> None:
    plain, dots = states(page.session)["bench_check"], page.session.path
    page.workspace.show(Session.open(copy_sample("five_lines")))
    found = page.state(states(page.session)["bench_check"])
    assert found.mark is Mark.TODO
    assert found.why.startswith("The session is of a line pattern")
    lead = page.lead(None)
    assert lead is not None
    assert (lead.words, lead.actions) == (found.why, ())
    for widget in (page.add_button, page.check_button, page.predict_button, page.use_button):
        assert not widget.isEnabled()
        assert widget.toolTip() == found.why
    dropped = page.workspace.folder / "mirror.png"
    assert page.takes_files([dropped])
    assert not page.workspace.tasks.active
    assert found.why in page.answer.text()
    page.workspace.show(Session.open(dots))
    assert states(page.session)["bench_check"] == plain
    assert page.add_button.isEnabled()
    assert page.predict_button.isEnabled()
    assert page.answer.text() == ""


def test_table_moves_below_the_picture_in_a_narrow_page(
    page: BenchCheckPage,
) -> None:
    page.resize(900, 600)
    assert page.splitter.orientation() == Qt.Orientation.Horizontal
    page.resize(500, 600)
    assert page.splitter.orientation() == Qt.Orientation.Vertical


@pytest.mark.slow
def test_quantity_found_from_pictures_alone_is_reported(checked: CheckResult) -> None:
    free = replace(checked, check=replace(checked.check, free=("laser.distance_mm",)))
    assert "distance" not in checked.words
    assert "distance" in free.words


def test_every_button_has_a_tooltip(page: BenchCheckPage) -> None:
    buttons = page.panel.findChildren(QPushButton)
    assert len(buttons) == 6
    assert all(button.toolTip() for button in buttons)


@pytest.mark.slow
def test_unchecking_restores_the_previous_uncertainty(checked: CheckResult) -> None:
    known = {"projection_angle_deg_sigma": 0.3, "angle_distance_correlation": 0.9}
    text = updated_setup(SETUP.read_text("utf-8"), SETUP, {"laser": known})
    check = replace(checked.check, before=parse_setup(text, SETUP).rig)
    after = checked_setup(text, SETUP, check, "2026-01-31T12:00:00+00:00")
    assert parse_setup(after, SETUP).check_date.startswith("2026-01-31")
    restored = unchecked_setup(after, SETUP)
    assert not parse_setup(restored, SETUP).check_date
    laser = tomllib.loads(restored)["laser"]
    assert laser["projection_angle_deg"] == pytest.approx(31.14)
    assert {key: laser[key] for key in known} == known
