"""The dots page: its view of a session, and corrections of a frame by hand."""

from __future__ import annotations

import csv
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from PySide6.QtCore import QEvent, QPoint, QPointF, Qt
from PySide6.QtGui import QMouseEvent
from PySide6.QtTest import QTest
from PySide6.QtWidgets import QAbstractButton, QApplication, QHBoxLayout, QToolButton, QWidget
from pytestqt.qtbot import QtBot

from labapp.core.geometry.coordinates import ImageCalibration
from labapp.core.images.find_dots import DotSettings
from labapp.core.pipeline import start_correction
from labapp.core.rows.correction import Correction, add_dot, delete_dots, shift_row
from labapp.core.rows.find_lattice import LatticeSettings
from labapp.core.rows.lattice import Lattice
from labapp.errors import InputError
from labapp.gui.pages.dots import presenter
from labapp.gui.pages.dots.fitting import Processes, Refit
from labapp.gui.pages.dots.page import DotsPage
from labapp.gui.shell.window import MainWindow
from labapp.gui.tasks import PROBLEM, Cancelled, Control
from labapp.gui.workspace import Workspace
from labapp.session.session import Session
from tests.gui.conftest import KEPT, let_draw
from tests.scenes import as_dots

CopySample = Callable[[str], Path]
SIZE = presenter.NUMBERS[0]
CONTROL, SHIFT = Qt.KeyboardModifier.ControlModifier, Qt.KeyboardModifier.ShiftModifier


@pytest.fixture
def page(qtbot: QtBot) -> Iterator[DotsPage]:
    """The page beside its panel, with the signals connected as in the window."""
    workspace = Workspace()
    page = DotsPage(workspace)
    workspace.changed.connect(lambda: page.refresh() if workspace.session else None)
    workspace.frame_changed.connect(lambda _: page.refresh())
    container = QWidget()
    layout = QHBoxLayout(container)
    layout.addWidget(page, 1)
    layout.addWidget(page.panel)
    KEPT.append(container)
    container.resize(1300, 900)
    container.show()
    container.activateWindow()
    qtbot.waitExposed(container)
    yield page
    page.leave()
    workspace.close()


@pytest.fixture
def unfitted(monkeypatch: pytest.MonkeyPatch) -> list[list[int]]:
    """Record the frames that would have been measured."""
    requested: list[list[int]] = []
    monkeypatch.setattr(
        Workspace, "measure", lambda self, frames=None, **_: requested.append(list(frames))
    )
    monkeypatch.setattr(Refit, "_fit", lambda self, frame: requested.append([frame]))
    monkeypatch.setattr(Processes, "begin", lambda self: None)
    return requested


def show(page: DotsPage, qtbot: QtBot, path: Path, frame: int) -> Session:
    page.workspace.show(Session.open(path))
    page.workspace.show_frame(frame)
    session = page.workspace.session
    assert session is not None
    qtbot.waitUntil(lambda: page.reader.frame == frame and page.editor.correction is not None)
    let_draw()
    return session


def origin(page: DotsPage) -> str:
    return "" if page.seen is None else page.seen.origin


def at(page: DotsPage, u: float, v: float) -> QPoint:
    port: QPoint = page.view.canvas.mapFromScene(page.view.box.mapViewToScene(QPointF(u, v)))
    return port


def click(page: DotsPage, place: np.ndarray, *, shift: bool = False) -> None:
    port = page.view.canvas.viewport()
    modifier = SHIFT if shift else Qt.KeyboardModifier.NoModifier
    QTest.mouseClick(port, Qt.MouseButton.LeftButton, modifier, at(page, *place))


def double_click(page: DotsPage, place: np.ndarray) -> None:
    # As a mouse does; QTest.mouseDClick sends an additional press.
    port, point, left = page.view.canvas.viewport(), at(page, *place), Qt.MouseButton.LeftButton
    click(page, place)
    again = QMouseEvent(
        QEvent.Type.MouseButtonDblClick, QPointF(point), QPointF(port.mapToGlobal(point)),
        left, left, Qt.KeyboardModifier.NoModifier,
    )  # fmt: skip
    QApplication.sendEvent(port, again)
    QTest.mouseRelease(port, left, pos=point)


def drag(page: DotsPage, start: np.ndarray, end: np.ndarray) -> None:
    port = page.view.canvas.viewport()
    first, last = at(page, *start), at(page, *end)
    QTest.mousePress(port, Qt.MouseButton.LeftButton, pos=first)
    for part in (0.25, 0.5, 0.75, 1.0):
        QTest.mouseMove(port, first + (last - first) * part)
        let_draw()
    QTest.mouseRelease(port, Qt.MouseButton.LeftButton, pos=last)


def key(page: DotsPage, which: Qt.Key, modifier: Qt.KeyboardModifier | None = None) -> None:
    QTest.keyClick(page.view, which, modifier or Qt.KeyboardModifier.NoModifier)


def faulty_correction(session: Session, frame: int) -> tuple[Correction, np.ndarray, int]:
    """A correction with faults, the position of its missed dot and its shifted row.

    The faults are a row shifted by one column, two false dots and a missed dot.
    """
    result = session.result(frame)
    assert result is not None
    good = start_correction(result.measurement)
    image = session.frame(frame).image
    lattice = good.lattice
    missed = int(np.flatnonzero((lattice.row == 3) & (lattice.column == 7))[0])
    place = good.dots.image_px[missed]
    bad = delete_dots(good, [missed])
    for u, v in ((60.0, 60.0), (430.0, 90.0)):
        bad = add_dot(bad, image, u, v)
    return shift_row(bad, 5, 1), place, 5


def truth(path: Path, frame: int) -> dict[str, float]:
    with (path.parent / "truth.csv").open() as file:
        return {name: float(value) for name, value in list(csv.DictReader(file))[frame].items()}


def test_missing_recording_is_named_and_cannot_be_measured(
    page: DotsPage, copy_sample: CopySample, qtbot: QtBot
) -> None:
    path = copy_sample("gtaw")
    (path.parent / "recording.avi").unlink()
    page.workspace.show(Session.open(path))
    qtbot.waitUntil(lambda: "⚠ recording.avi is missing" in page.dots_panel.seen.text())
    shown = page.measure_lead.currentWidget()
    assert shown is not None
    assert not any(each.isEnabled() for each in shown.findChildren(QAbstractButton))


def test_frame_with_faults_is_corrected_in_15_actions(
    page: DotsPage, qtbot: QtBot, copy_sample: CopySample
) -> None:
    path = copy_sample("gtaw")
    with Session.open(path) as session:
        bad, missed, row = faulty_correction(session, 0)
        session.correct({0: bad})
        steps = len(session.history)
    session = show(page, qtbot, path, 0)
    actions = 0

    for false in (bad.dots.image_px[-1], bad.dots.image_px[-2]):
        click(page, false)
        key(page, Qt.Key.Key_Delete)
        actions += 2
    double_click(page, missed)
    actions += 1
    in_row = bad.lattice.row == row
    click(page, bad.dots.image_px[np.flatnonzero(in_row)[3]])
    key(page, Qt.Key.Key_Left, CONTROL)
    actions += 2

    assert actions <= 15
    assert len(session.history) == steps + 4
    qtbot.waitUntil(lambda: not presenter.needs_fit(presenter.shown(session, 0, None)))
    result = session.result(0)
    assert result is not None
    assert not result.stale
    assert result.measurement.status == "ok"
    size = result.measurement.measures
    assert size is not None
    expected = truth(path, 0)
    assert size.height_mm == pytest.approx(expected["height_mm"], rel=0.03)
    assert size.width_mm == pytest.approx(expected["width_mm"], rel=0.02)
    assert size.length_mm == pytest.approx(expected["length_mm"], rel=0.02)
    assert size.mre_mm < 0.05
    # The results before and after the edits are shown side by side.
    qtbot.waitUntil(lambda: not page.refit.pending)
    table = {row.name: row.value for row in page.dots_panel.fit.rows}
    assert str(table["Fit"]).endswith("→ ok")


def test_new_edit_ends_the_previous_fit(
    page: DotsPage, qtbot: QtBot, copy_sample: CopySample
) -> None:
    """One fit runs at a time for the last edit; the process of the previous fit is ended."""
    session = show(page, qtbot, copy_sample("gtaw"), 0)
    refit, fitted = page.refit, list[float]()
    qtbot.waitUntil(lambda: refit.processes.ready)

    def nudge() -> None:
        page.editor.selection = np.array([12])
        page.editor.shift_px[:] = 0.2, 0.0
        page.editor.drop()

    def note() -> None:
        result = session.result(0)
        if result is not None and result.measurement.correction is not None:
            fitted.append(float(result.measurement.correction.dots.u_px[12]))

    page.workspace.changed.connect(note)
    initial = float(page.editor.dots_px[12, 0])
    nudge()
    first, pool = refit._task, refit.processes.first
    assert refit.pending
    nudge()
    nudge()  # the spare process is not ready yet, so the second fit runs until it is
    assert first is not None
    assert first.control.cancelled.is_set()
    assert refit.processes.first is not pool
    assert not pool._processes or not any(p.is_alive() for p in pool._processes.values())
    qtbot.waitUntil(
        lambda: not refit.pending and not presenter.needs_fit(presenter.shown(session, 0, None)),
    )
    page.workspace.changed.disconnect(note)
    assert fitted[-1] == pytest.approx(initial + 0.6, abs=1e-9)
    assert initial + 0.2 not in fitted


def test_undo_restores_the_measured_rows(
    page: DotsPage, qtbot: QtBot, copy_sample: CopySample, unfitted: list[list[int]]
) -> None:
    """Detected rows would otherwise become the rows of the frame with the next edit."""
    session = show(page, qtbot, copy_sample("gtaw"), 0)
    before = page.editor.correction
    assert before is not None
    page.editor.selection = np.array([12])
    assert page.editor.put_in_doubt()
    assert len(list(session.measure_each([0]))) == 1
    page.workspace.changed.emit()
    assert unfitted == [[0]]
    page.workspace.undo()
    assert origin(page) == "measured"
    restored = page.editor.correction
    assert restored is not None
    np.testing.assert_array_equal(restored.lattice.row, before.lattice.row)
    np.testing.assert_array_equal(restored.lattice.column, before.lattice.column)
    page.editor.choose_rows([5])
    assert page.editor.block()
    stored = session.correction(0)
    assert stored is not None
    np.testing.assert_array_equal(stored.sited, before.sited)
    page.workspace.undo()
    assert origin(page) == "measured"
    assert unfitted == [[0], [0]]  # after the edits, never after undo


def test_detected_rows_cannot_be_edited_during_a_fit(
    page: DotsPage,
    qtbot: QtBot,
    copy_sample: CopySample,
    unfitted: list[list[int]],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    path = copy_sample("gtaw")
    with Session.open(path) as session:
        result = session.result(0)
        assert result is not None
        session.correct({0: start_correction(result.measurement)})
        assert len(list(session.measure_each([0]))) == 1
    session = show(page, qtbot, path, 0)
    session.undo()  # a newly opened session does not know the previous measurement
    page.workspace.changed.emit()
    qtbot.waitUntil(lambda: origin(page) == "found")
    assert unfitted == [[0]]
    page.editor.choose_rows([5])
    with monkeypatch.context() as patched:
        patched.setattr(Refit, "pending", True)
        assert not page.editor.block()
    assert session.correction(0) is None
    assert page.editor.block()


def test_unmeasured_frame_shows_detected_dots(
    page: DotsPage, qtbot: QtBot, copy_sample: CopySample, unfitted: list[list[int]]
) -> None:
    path = copy_sample("gtaw")
    session = show(page, qtbot, path, 4)
    assert origin(page) == "measured"
    count = len(page.editor.dots_px)
    # With other settings, fewer dots are detected in the background and shown.
    page.dots_panel.numbers[1].edited.emit(40.0)
    assert session.settings.dots.band_pass.threshold == 40
    qtbot.waitUntil(lambda: page.editor.correction is not None)
    assert origin(page) == "found"
    assert 0 < len(page.editor.dots_px) < count
    page.workspace.undo()
    qtbot.waitUntil(lambda: len(page.editor.dots_px) == count)
    assert unfitted == []


def test_buttons_are_enabled_by_the_selection(
    page: DotsPage, qtbot: QtBot, copy_sample: CopySample, unfitted: list[list[int]]
) -> None:
    session = show(page, qtbot, copy_sample("gtaw"), 0)
    panel, editor = page.dots_panel, page.editor
    always = {"Add dot", "Reference", "No reference", "Carry on"}
    dots, row = {"Delete", "Number", "In doubt"}, {"Row left", "Row right", "Blocked"}
    one = {"Split up", "Split down"}

    def enabled() -> set[str]:
        return {words for words, button in panel.buttons.items() if button.isEnabled()}

    assert enabled() == always
    assert not panel.row.editor.isEnabled()
    assert "Select" in panel.buttons["Delete"].toolTip()
    click(page, editor.dots_px[10])
    assert enabled() == always | dots | row | one
    assert panel.row.editor.isEnabled()
    assert "Select" not in panel.buttons["Split up"].toolTip()
    page.choose(editor.choose_rows, [4])
    assert enabled() == always | dots | row
    page.choose(editor.choose_rows, [4, 5])
    assert enabled() == always | dots | row | {"Merge"}
    key(page, Qt.Key.Key_Escape)
    assert enabled() == always

    # The keys still work, and report what is missing.
    messages: list[str] = []
    page.workspace.notified.connect(lambda words, _: messages.append(words))
    key(page, Qt.Key.Key_Delete)
    assert len(messages) == 1
    assert session.correction(0) is None

    click(page, editor.dots_px[10])
    panel.buttons["Delete"].setFocus()
    panel.buttons["Delete"].click()
    assert len(editor.selection) == 0
    assert enabled() == always | {"Back to automatic"}
    assert page.view.hasFocus()  # and not another button


def test_read_only_frame_cannot_be_edited(
    page: DotsPage, qtbot: QtBot, copy_sample: CopySample
) -> None:
    path = copy_sample("gtaw")
    page.workspace.show(Session.open(path, read_only=True))
    qtbot.waitUntil(lambda: page.editor.correction is not None)
    page.refresh()
    let_draw()
    start = page.editor.dots_px.copy()
    click(page, start[10])
    assert page.editor.selection.tolist() == [10]
    drag(page, start[10], start[10] + (6, -4))  # draws a box
    np.testing.assert_array_equal(page.editor.dots_px, start)
    assert not any(button.isEnabled() for button in page.dots_panel.buttons.values())
    assert not page.dots_panel.method.editor.isEnabled()


def test_editing_by_clicks_boxes_drags_and_keys(
    page: DotsPage, qtbot: QtBot, copy_sample: CopySample, unfitted: list[list[int]]
) -> None:
    session = show(page, qtbot, copy_sample("blocked_rows"), 0)
    editor, start = page.editor, page.editor.dots_px.copy()
    steps = len(session.history)
    click(page, start[10])
    assert editor.selection.tolist() == [10]
    click(page, start[11], shift=True)
    assert editor.selection.tolist() == [10, 11]
    click(page, start[10], shift=True)
    assert editor.selection.tolist() == [11]

    drag(page, start[11], start[11] + (6, -4))
    assert len(session.history) == steps + 1
    moved = editor.dots_px[11] - start[11]
    assert moved == pytest.approx((6, -4), abs=0.7)
    correction = session.correction(0)
    assert correction is not None
    np.testing.assert_array_equal(correction.dots.image_px, editor.dots_px)
    assert correction.manual.tolist() == [n == 11 for n in range(len(start))]

    key(page, Qt.Key.Key_Right)
    key(page, Qt.Key.Key_Up, SHIFT)
    assert editor.dots_px[11] - start[11] == pytest.approx(moved + np.array([0.1, -1]))
    assert len(session.history) == steps + 3
    page.workspace.undo()
    page.workspace.undo()
    page.workspace.undo()
    np.testing.assert_array_equal(editor.dots_px, start)
    assert session.correction(0) is None

    low, high = start.min(axis=0) - 8, start.max(axis=0) + 8
    drag(page, low, high)
    assert len(editor.selection) == len(start)
    key(page, Qt.Key.Key_Escape)
    assert len(editor.selection) == 0
    assert unfitted[0] == [0]


def test_drag_that_outlasts_its_frame_moves_nothing(
    page: DotsPage, qtbot: QtBot, copy_sample: CopySample, unfitted: list[list[int]]
) -> None:
    session = show(page, qtbot, copy_sample("blocked_rows"), 0)
    messages: list[str] = []
    page.workspace.notified.connect(lambda words, _: messages.append(words))
    port, place, steps = page.view.canvas.viewport(), page.editor.dots_px[5], len(session.history)
    QTest.mousePress(port, Qt.MouseButton.LeftButton, pos=at(page, *place))
    for moved in (8, 16):
        QTest.mouseMove(port, at(page, *place + moved))
        let_draw()
    assert page.editor.shift_px.any()
    page.workspace.show_frame(1)
    qtbot.waitUntil(lambda: page.reader.frame == 1 and page.editor.correction is not None)
    QTest.mouseRelease(port, Qt.MouseButton.LeftButton, pos=at(page, *place + 16))
    assert messages == []
    assert len(session.history) == steps


def test_rejected_edit_is_reported_and_changes_nothing(
    page: DotsPage, qtbot: QtBot, copy_sample: CopySample, unfitted: list[list[int]]
) -> None:
    session = show(page, qtbot, copy_sample("blocked_rows"), 0)
    steps, messages = len(session.history), []
    page.workspace.notified.connect(lambda words, problem: messages.append((words, problem)))
    for which in (Qt.Key.Key_Delete, Qt.Key.Key_M, Qt.Key.Key_S, Qt.Key.Key_B, Qt.Key.Key_N):
        key(page, which)
    lattice = page.editor.correction.lattice if page.editor.correction else None
    assert lattice is not None
    page.editor.choose_rows([4])
    page.dots_panel.row.edited.emit(5)  # occupied by other dots
    assert [problem for _, problem in messages] == [True] * 6
    assert "Select a dot first" in messages[0][0]
    assert "already assigned" in messages[-1][0]
    assert len(session.history) == steps
    assert unfitted == []
    assert page.dots_panel.chosen.text() == f"{PROBLEM} {messages[-1][0]}"
    key(page, Qt.Key.Key_Period)
    assert PROBLEM not in page.dots_panel.chosen.text()


def test_nothing_to_discard_is_a_note_not_a_problem(
    page: DotsPage, qtbot: QtBot, copy_sample: CopySample, unfitted: list[list[int]]
) -> None:
    show(page, qtbot, copy_sample("blocked_rows"), 0)
    problems = []
    page.workspace.notified.connect(lambda _, problem: problems.append(problem))
    key(page, Qt.Key.Key_Backspace, Qt.KeyboardModifier.ControlModifier)
    assert problems == [False]


def test_rows_are_edited_in_the_list_by_keyboard(
    page: DotsPage, qtbot: QtBot, copy_sample: CopySample, unfitted: list[list[int]]
) -> None:
    session = show(page, qtbot, copy_sample("blocked_rows"), 0)
    rows = page.dots_panel.rows
    before = page.editor.correction
    assert before is not None
    rows.setFocus()
    rows.selectRow(0)
    top = int(before.lattice.row.max())
    assert page.editor.rows == [top]
    QTest.keyClick(rows, Qt.Key.Key_Down)
    assert page.editor.rows == [top - 1]
    QTest.keyClick(rows, Qt.Key.Key_B)
    after = session.correction(0)
    assert after is not None
    assert after.lattice.blocked_rows == before.lattice.blocked_rows | {top - 1}
    assert page.editor.rows == [top - 1]
    note = rows.item(1, 3)
    assert note is not None
    assert "blocked" in note.text()
    QTest.keyClick(rows, Qt.Key.Key_Right, CONTROL)
    after = session.correction(0)
    assert after is not None
    in_row = before.lattice.row == top - 1
    np.testing.assert_array_equal(after.lattice.column[in_row], before.lattice.column[in_row] + 1)
    np.testing.assert_array_equal(after.lattice.column[~in_row], before.lattice.column[~in_row])
    assert [change.label for change in session.history][-2:] == [
        f"block row {top - 1}, frame 0",
        f"shift row {top - 1} right, frame 0",
    ]


def test_split_merge_and_reference(
    page: DotsPage, qtbot: QtBot, copy_sample: CopySample, unfitted: list[list[int]]
) -> None:
    show(page, qtbot, copy_sample("blocked_rows"), 3)
    editor = page.editor
    before = editor.correction
    assert before is not None
    assert before.lattice.reference is None
    # The README of the sample states its position in the picture and its site.
    page.pointer = (278.0, 281.0)
    key(page, Qt.Key.Key_R)
    assert editor.correction is not None
    assert editor.correction.lattice.reference == (6, 8)
    dot = int(np.flatnonzero((before.lattice.row == 4) & (before.lattice.column == 8))[0])
    editor.selection = np.array([dot])
    key(page, Qt.Key.Key_S)
    split = editor.correction.lattice
    assert split.row.max() == before.lattice.row.max() + 1
    assert split.reference == (7, 8)
    editor.choose_rows([4, 5])
    key(page, Qt.Key.Key_M)
    np.testing.assert_array_equal(editor.correction.lattice.row, before.lattice.row)
    assert editor.correction.lattice.reference == (6, 8)


def test_frame_without_dots_does_not_ask_for_the_reference(
    page: DotsPage, qtbot: QtBot, tmp_path: Path
) -> None:
    dark, path = tmp_path / "dark.npy", tmp_path / "dark.labsession"
    np.save(dark, np.zeros((1, 640, 480), np.uint8))
    with Session.create(path) as session:
        session.import_recording(dark)
    show(page, qtbot, path, 0)
    qtbot.waitUntil(lambda: page.seen is not None and bool(page.seen.why))
    assert "blank" in page.dots_panel.seen.text()
    assert "press Reference" not in page.dots_panel.seen.text()


def test_reference_button_waits_for_a_click(
    page: DotsPage, qtbot: QtBot, copy_sample: CopySample, unfitted: list[list[int]]
) -> None:
    session = show(page, qtbot, copy_sample("blocked_rows"), 3)
    panel = page.dots_panel
    assert "press Reference" in panel.seen.text()
    button = next(b for b in panel.findChildren(QToolButton) if b.text() == "Reference")
    place, left = np.array([278.0, 281.0]), button.mapTo(page.panel, QPoint())
    button.click()
    assert panel.chosen.text().startswith("Click where the dark centre of the pattern is")
    key(page, Qt.Key.Key_Escape)
    assert panel.chosen.text().startswith("Nothing selected")
    button.click()
    click(page, place)
    correction = session.correction(3)
    assert correction is not None
    assert correction.lattice.reference == (6, 8)  # as stated in blocked_rows/README.md
    assert panel.chosen.text().startswith("Nothing selected")
    assert "press Reference" not in panel.seen.text()
    assert button.mapTo(page.panel, QPoint()) == left
    assert unfitted == [[3]]


def test_correction_is_carried_to_later_frames_and_undone(
    page: DotsPage, qtbot: QtBot, copy_sample: CopySample, unfitted: list[list[int]]
) -> None:
    session = show(page, qtbot, copy_sample("blocked_rows"), 2)
    messages: list[str] = []
    page.workspace.notified.connect(lambda words, problem: messages.append(words))
    earlier = session.correction(2)
    for _ in range(3):  # a held key repeats
        key(page, Qt.Key.Key_Return, CONTROL)
    qtbot.waitUntil(lambda: bool(messages))
    qtbot.waitUntil(lambda: not page.workspace.tasks.active)
    assert "Carried on over 3 frames, up to frame 5" in messages[0]
    assert session.corrected_frames().tolist() == [2, 3, 4, 5]
    assert unfitted == [[3, 4, 5]]
    for frame in (3, 4, 5):
        carried = session.correction(frame)
        assert carried is not None
        assert carried.lattice.reference == (6, 8)
    page.workspace.undo()
    assert session.corrected_frames().tolist() == [2]
    page.workspace.show_frame(2)
    key(page, Qt.Key.Key_Backspace, CONTROL)
    assert session.correction(2) is None
    page.workspace.undo()
    again = session.correction(2)
    assert again is not None
    assert earlier is not None
    np.testing.assert_array_equal(again.lattice.row, earlier.lattice.row)


def test_cancelled_carrying_keeps_finished_frames(copy_sample: CopySample) -> None:
    with Session.open(copy_sample("blocked_rows")) as session:
        control = Control()

        def progress(done: int, total: int) -> None:
            if done == 2:
                control.cancelled.set()
            control.check()

        control.progress = progress  # type: ignore[method-assign]
        carried, words = presenter.carry(session, presenter.shown(session, 2, None), None, control)
        assert list(carried) == [3, 4]
        assert "stopped before frame 5: it was cancelled" in words


def test_row_search_is_chosen_on_the_page(
    page: DotsPage, qtbot: QtBot, copy_sample: CopySample
) -> None:
    session = Session.open(copy_sample("gtaw"))
    page.workspace.show(session)
    qtbot.waitUntil(lambda: page.editor.correction is not None)
    page.refresh()
    assert page.dots_panel.row_search.value() == "grow"
    page.dots_panel.row_search.edited.emit("rows")
    assert session.settings.lattice.method == "rows"
    assert page.dots_panel.row_search.value() == "rows"
    page.workspace.undo()
    assert page.dots_panel.row_search.value() == "grow"


def test_presenter_of_a_session(copy_sample: CopySample) -> None:
    with Session.open(copy_sample("blocked_rows")) as session:
        shown = presenter.shown(session, 0, None)
        assert shown.origin == "measured"
        assert not presenter.needs_dots(session, 0)
        assert shown.correction is not None
        # Computed dots agree with the captured ones, because the surface fits.
        distances = np.linalg.norm(
            shown.computed_px[:, None] - shown.correction.dots.image_px[None], axis=-1
        ).min(axis=1)
        assert len(distances) > 90
        assert distances.max() < 1.0
        assert presenter.sentence(shown).startswith("As measured: 99 dots in 9 rows")
        lines = presenter.row_lines(shown.correction)
        assert [line.row for line in lines if line.row] == list(range(9, 0, -1))
        assert sum(line.dots for line in lines) == 99
        assert [line.note for line in lines if line.row == 6] == ["reference 8"]
        assert not presenter.needs_fit(presenter.shown(session, 0, None))
        session.correct({0: shift_row(shown.correction, 4, 1)})
        assert presenter.needs_fit(presenter.shown(session, 0, None))
        assert presenter.shown(session, 0, None).origin == "corrected"
        session.correct({0: None})
        assert presenter.shown(session, 0, None).origin == "measured"
        assert not presenter.needs_fit(presenter.shown(session, 0, None))


def test_comparison_of_figures_before_and_after() -> None:
    before = presenter.Figures("no-match", 0, *[float("nan")] * 4)
    after = presenter.Figures("ok", 94, 0.1234, 0.5, 0.25, 0.006)
    rows = {row.name: row.value for row in presenter.compared(before, after)}
    assert rows == {
        "Fit": "no-match → ok",
        "Dots matched": "0 → 94",
        "ARE": "– → 0.123",
        "MRE": "– → 0.500",
        "Height": "– → 0.250 ± 0.006",
    }
    waiting = {row.name: row.value for row in presenter.compared(after, after, "fitting…")}
    assert waiting["ARE"] == "0.123 → fitting…"
    assert presenter.compared(None, after)[0].value == "ok"


def test_fast_frame_changes_show_matching_dots(
    page: DotsPage, qtbot: QtBot, copy_sample: CopySample, unfitted: list[list[int]]
) -> None:
    path = copy_sample("gtaw")
    with Session.open(path) as session:
        numbers = session.frames.tolist()
        images = [session.frame(frame).image for frame in numbers]
        session.set_settings(presenter.with_detector_value(session.settings, SIZE, 1.5))
    show(page, qtbot, path, 0)
    for frame in numbers:
        page.workspace.show_frame(frame)
        let_draw()
        assert page.seen is not None
        np.testing.assert_array_equal(page.view.picture, images[page.seen.frame])
    qtbot.waitUntil(lambda: page.seen is not None and page.seen.frame == numbers[-1])
    # The results have other settings, so dots are detected once, at the end.
    qtbot.waitUntil(lambda: origin(page) == "found")
    assert page.reader.found is not None
    assert page.reader.found.frame == numbers[-1]


def test_damaged_result_is_reported_and_dots_are_detected(
    page: DotsPage,
    qtbot: QtBot,
    copy_sample: CopySample,
    monkeypatch: pytest.MonkeyPatch,
    unfitted: list[list[int]],
) -> None:
    path = copy_sample("blocked_rows")

    def damaged(self: Session, frame: int, scheme: str | None = None) -> None:
        raise InputError(self.path, f"result of frame {frame}", "damaged", "what was written")

    monkeypatch.setattr(Session, "result", damaged)
    session = show(page, qtbot, path, 1)
    assert origin(page) == "found"
    assert "result of frame 1: damaged" in page.dots_panel.seen.text()
    assert page.editor.correction is not None
    session.correct({1: page.editor.correction})
    page.refresh()
    assert unfitted == [[1]]


def test_arrow_keys_move_frames_until_a_dot_is_selected(
    window: MainWindow, qtbot: QtBot, copy_sample: CopySample, unfitted: list[list[int]]
) -> None:
    window.workspace.show(Session.open(copy_sample("gtaw")))
    window.show_step("dots")
    page = window.page
    assert isinstance(page, DotsPage)
    qtbot.waitUntil(lambda: page.editor.correction is not None)
    key(page, Qt.Key.Key_Right)
    assert window.workspace.frame == 1
    qtbot.waitUntil(lambda: page.seen is not None and page.seen.frame == 1)
    before = page.editor.dots_px.copy()
    page.choose(page.editor.choose_next, 1)
    chosen = page.editor.selection
    key(page, Qt.Key.Key_Right)
    assert window.workspace.frame == 1
    moved = page.editor.dots_px - before
    assert moved[chosen] == pytest.approx(np.array([[0.1, 0.0]]))
    assert np.count_nonzero(moved) == 1
    key(page, Qt.Key.Key_Escape)
    key(page, Qt.Key.Key_Left)
    assert window.workspace.frame == 0


def test_rings_grow_with_the_zoom_and_mark_the_reference(
    page: DotsPage, qtbot: QtBot, copy_sample: CopySample, unfitted: list[list[int]]
) -> None:
    show(page, qtbot, copy_sample("gtaw"), 0)
    marks, ring = page.overlay._dots, page.overlay._reference
    size = marks.data["size"].max()
    assert ring.data["size"].tolist() == [2 * size]
    # Row 6 has no dot at column 8: the ring is between its neighbours.
    assert page.editor.correction is not None
    lattice, place = page.editor.correction.lattice, page.editor.dots_px
    beside = place[(lattice.row == 6) & np.isin(lattice.column, [7, 9])]
    assert ring.data["x"][0] == pytest.approx(beside[:, 0].mean(), abs=1)
    page.view.zoom(3)
    let_draw()
    assert marks.data["size"].max() > 1.5 * size
    assert ring.data["size"].tolist() == [2 * marks.data["size"].max()]
    key(page, Qt.Key.Key_H)
    assert not marks.isVisible()
    key(page, Qt.Key.Key_H)
    assert marks.isVisible()


def test_rapid_edits_are_all_stored(
    window: MainWindow, qtbot: QtBot, copy_sample: CopySample, unfitted: list[list[int]]
) -> None:
    window.workspace.show(Session.open(copy_sample("gtaw")))
    window.show_step("dots")
    page, session = window.page, window.workspace.session
    assert isinstance(page, DotsPage)
    assert session is not None
    qtbot.waitUntil(lambda: page.editor.correction is not None)
    before = page.editor.correction
    assert before is not None
    for row in (2, 4, 7):
        page.editor.choose_rows([row])
        assert page.editor.block()
    window.workspace.undo()
    page.editor.choose_rows([5])
    assert page.editor.block()
    correction = session.correction(0)
    assert correction is not None
    assert correction.lattice.blocked_rows == before.lattice.blocked_rows | {2, 4, 5}


def test_frame_without_dots_shows_the_reason(
    page: DotsPage, qtbot: QtBot, copy_sample: CopySample, tmp_path: Path
) -> None:
    dark, sample = tmp_path / "dark.npy", copy_sample("blocked_rows")
    np.save(dark, np.zeros((1, 640, 480), np.uint8))
    with Session.create(tmp_path / "dark.labsession") as session:
        session.import_recording(dark)
        session.set_setup((sample.parent / "setup.toml").read_text())
        session.measure([0])
    session = show(page, qtbot, tmp_path / "dark.labsession", 0)
    result = session.result(0)
    assert result is not None
    assert result.measurement.status == "no-dots"
    assert origin(page) == "measured"
    assert presenter.NO_DOTS in page.dots_panel.seen.text()
    assert result.measurement.reason[1:] in page.dots_panel.seen.text()


def test_all_dots_can_be_deleted_and_restored(
    page: DotsPage, qtbot: QtBot, copy_sample: CopySample, unfitted: list[list[int]]
) -> None:
    show(page, qtbot, copy_sample("blocked_rows"), 0)
    before = len(page.editor.dots_px)
    key(page, Qt.Key.Key_A, Qt.KeyboardModifier.ControlModifier)
    key(page, Qt.Key.Key_Delete)
    # The detector is not used in a frame that is corrected by hand.
    assert presenter.NO_DOTS not in page.dots_panel.seen.text()
    assert "Back to automatic" in page.dots_panel.seen.text()
    page.workspace.undo()
    assert len(page.editor.dots_px) == before


def test_cancelled_detection_looks_for_no_rows(monkeypatch: pytest.MonkeyPatch) -> None:
    control = Control()
    monkeypatch.setattr(presenter, "find_dots", lambda *_: control.cancelled.set())
    monkeypatch.setattr(presenter, "find_lattice", lambda *_: pytest.fail("it goes on"))
    with pytest.raises(Cancelled):
        presenter.detect(np.zeros((8, 8)), 0, (DotSettings(), LatticeSettings()), control)


def test_detected_columns_are_those_of_the_plane_if_the_picture_is_mirrored(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    left_to_right = Lattice(np.array([1, 1]), np.array([1, 2]))
    dots = as_dots(np.array([[10.0, 20.0], [30.0, 20.0]]))
    monkeypatch.setattr(presenter, "find_dots", lambda *_: dots)
    monkeypatch.setattr(presenter, "find_lattice", lambda *_: left_to_right)
    mirrored = ImageCalibration(np.diag([-1.0, -1.0, 1.0]))
    by = DotSettings(), LatticeSettings()
    found = presenter.detect(np.zeros((8, 8)), 0, by, Control())
    assert found.correction(mirrored).lattice.column.tolist() == [2, 1]
    assert found.correction(None).lattice.column.tolist() == [1, 2]


def test_numbering_leaves_out_only_dots_that_cannot_be_numbered(
    page: DotsPage, qtbot: QtBot, copy_sample: CopySample, unfitted: list[list[int]]
) -> None:
    session = show(page, qtbot, copy_sample("blocked_rows"), 0)
    before = page.editor.correction
    assert before is not None
    inside = np.flatnonzero(before.sited)[[60, 61, 90]]
    page.editor.selection = inside
    key(page, Qt.Key.Key_U)
    u, v = before.dots.image_px[inside[:2]].mean(axis=0).tolist()  # between two dots of a row
    page.add_at(u, v + 8)
    steps = len(session.history)
    page.choose(page.editor.choose_none)
    odd = len(page.editor.dots_px) - 1
    page.editor.selection = np.array([*inside, odd])
    key(page, Qt.Key.Key_N)
    after = page.editor.correction
    assert after is not None
    assert len(session.history) == steps + 1
    np.testing.assert_array_equal(after.lattice.row[inside], before.lattice.row[inside])
    np.testing.assert_array_equal(after.lattice.column[inside], before.lattice.column[inside])
    assert not after.sited[odd]
    assert page.editor.selection.tolist() == [odd]
    assert page.dots_panel.chosen.text().startswith(PROBLEM)
    u, v = after.dots.image_px[odd].tolist()
    assert f"({u:.1f}, {v:.1f}) px" in page.dots_panel.chosen.text()
    key(page, Qt.Key.Key_Period)
    assert PROBLEM not in page.dots_panel.chosen.text()
