"""The dots page: what it shows of a session, and a hand that puts a frame right."""

from __future__ import annotations

import csv
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from PySide6.QtCore import QEvent, QPoint, QPointF, Qt
from PySide6.QtGui import QMouseEvent
from PySide6.QtTest import QTest
from PySide6.QtWidgets import QApplication, QHBoxLayout, QToolButton, QWidget
from pytestqt.qtbot import QtBot

from labapp.core.pipeline import start_correction
from labapp.core.rows.correction import Correction, add_dot, delete_dots, shift_row
from labapp.errors import InputError
from labapp.gui.pages.dots import DotsPage, presenter
from labapp.gui.pages.dots.fitting import Processes, Refit
from labapp.gui.shell.window import MainWindow
from labapp.gui.tasks import Control
from labapp.gui.workspace import Workspace
from labapp.session.session import Session
from tests.gui.conftest import KEPT, let_draw

CopySample = Callable[[str], Path]
SIZE = presenter.NUMBERS[0]
CONTROL, SHIFT = Qt.KeyboardModifier.ControlModifier, Qt.KeyboardModifier.ShiftModifier


@pytest.fixture
def page(qtbot: QtBot) -> Iterator[DotsPage]:
    """The page with its panel beside it, and the signals as the window connects them."""
    space = Workspace()
    page = DotsPage(space)
    space.changed.connect(lambda: page.refresh() if space.session else None)
    space.frame_changed.connect(lambda _: page.refresh())
    beside = QWidget()
    layout = QHBoxLayout(beside)
    layout.addWidget(page, 1)
    layout.addWidget(page.panel)
    KEPT.append(beside)
    beside.resize(1300, 900)
    beside.show()
    beside.activateWindow()
    qtbot.waitExposed(beside)
    yield page
    page.leave()
    space.close()


@pytest.fixture
def unfitted(monkeypatch: pytest.MonkeyPatch) -> list[list[int]]:
    """Frames that would have been measured."""
    asked: list[list[int]] = []
    monkeypatch.setattr(
        Workspace, "measure", lambda self, frames=None, **_: asked.append(list(frames))
    )
    monkeypatch.setattr(Refit, "_fit", lambda self, frame: asked.append([frame]))
    monkeypatch.setattr(Processes, "begin", lambda self: None)
    return asked


def show(page: DotsPage, qtbot: QtBot, path: Path, frame: int) -> Session:
    page.workspace.show(Session.open(path))
    page.workspace.show_frame(frame)
    session = page.workspace.session
    assert session is not None
    qtbot.waitUntil(lambda: page.looking.frame == frame and page.editor.correction is not None)
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
    # As a mouse does it; QTest.mouseDClick presses once more in between.
    port, there, left = page.view.canvas.viewport(), at(page, *place), Qt.MouseButton.LeftButton
    click(page, place)
    again = QMouseEvent(
        QEvent.Type.MouseButtonDblClick, QPointF(there), QPointF(port.mapToGlobal(there)),
        left, left, Qt.KeyboardModifier.NoModifier,
    )  # fmt: skip
    QApplication.sendEvent(port, again)
    QTest.mouseRelease(port, left, pos=there)


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


def spoiled(session: Session, frame: int) -> tuple[Correction, np.ndarray, int]:
    """One row off by a column, two false dots, one dot missed: its place, and the row."""
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


def test_a_spoiled_frame_is_put_right_in_fifteen_actions(
    page: DotsPage, qtbot: QtBot, copy_sample: CopySample
) -> None:
    path = copy_sample("gtaw")
    with Session.open(path) as session:
        bad, missed, row = spoiled(session, 0)
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
    own = bad.lattice.row == row
    click(page, bad.dots.image_px[np.flatnonzero(own)[3]])
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
    known = truth(path, 0)
    assert size.height_mm == pytest.approx(known["height_mm"], rel=0.03)
    assert size.width_mm == pytest.approx(known["width_mm"], rel=0.02)
    assert size.length_mm == pytest.approx(known["length_mm"], rel=0.02)
    assert size.mre_mm < 0.05
    # What was before the edits and what is now stand beside each other.
    qtbot.waitUntil(lambda: not page.refit.pending)
    table = {row.name: row.value for row in page.dots_panel.fit.rows}
    assert str(table["Fit"]).endswith("→ ok")


def test_a_newer_edit_ends_the_fit_of_the_one_before(
    page: DotsPage, qtbot: QtBot, copy_sample: CopySample
) -> None:
    """One fit at a time, and the last edit wins: the first one's process does not go on."""
    session = show(page, qtbot, copy_sample("gtaw"), 0)
    refit, kept = page.refit, list[float]()
    qtbot.waitUntil(lambda: refit.processes.ready)

    def nudge() -> None:
        page.editor.selection = np.array([12])
        page.editor.shift_px[:] = 0.2, 0.0
        page.editor.drop()

    def note() -> None:
        result = session.result(0)
        if result is not None and result.measurement.correction is not None:
            kept.append(float(result.measurement.correction.dots.u_px[12]))

    page.workspace.changed.connect(note)
    began = float(page.editor.dots_px[12, 0])
    nudge()
    first, pool = refit._task, refit.processes.first
    assert refit.pending
    nudge()
    nudge()  # the process to take its place is not warm yet: the second's fit goes on until it is
    assert first is not None
    assert first.control.cancelled.is_set()
    assert refit.processes.first is not pool
    assert not pool._processes or not any(p.is_alive() for p in pool._processes.values())
    qtbot.waitUntil(
        lambda: not refit.pending and not presenter.needs_fit(presenter.shown(session, 0, None)),
    )
    page.workspace.changed.disconnect(note)
    assert kept[-1] == pytest.approx(began + 0.6, abs=1e-9)
    assert began + 0.2 not in kept


def test_undo_shows_the_measured_rows_at_once(
    page: DotsPage, qtbot: QtBot, copy_sample: CopySample, unfitted: list[list[int]]
) -> None:
    """Not what the detector alone finds, which the next edit would make the frame's rows."""
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
    seen = page.editor.correction
    assert seen is not None
    np.testing.assert_array_equal(seen.lattice.row, before.lattice.row)
    np.testing.assert_array_equal(seen.lattice.column, before.lattice.column)
    page.editor.choose_rows([5])
    assert page.editor.block()
    kept = session.correction(0)
    assert kept is not None
    np.testing.assert_array_equal(kept.sited, before.sited)
    page.workspace.undo()
    assert origin(page) == "measured"
    assert unfitted == [[0], [0]]  # after the edits, never after undo


def test_what_the_detector_found_is_no_start_while_the_frame_is_measured(
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
    session.undo()  # what was measured before is not known in a session opened anew
    page.workspace.changed.emit()
    qtbot.waitUntil(lambda: origin(page) == "found")
    assert unfitted == [[0]]
    page.editor.choose_rows([5])
    with monkeypatch.context() as patched:
        patched.setattr(Refit, "pending", True)
        assert not page.editor.block()
    assert session.correction(0) is None
    assert page.editor.block()


def test_an_unmeasured_frame_shows_what_is_found_in_it(
    page: DotsPage, qtbot: QtBot, copy_sample: CopySample, unfitted: list[list[int]]
) -> None:
    path = copy_sample("gtaw")
    session = show(page, qtbot, path, 4)
    assert origin(page) == "measured"
    count = len(page.editor.dots_px)
    # Other settings: the dots are found anew, in the background, and the fewer are shown.
    page.dots_panel.numbers[1].edited.emit(40.0)
    assert session.settings.dots.band_pass.threshold == 40
    qtbot.waitUntil(lambda: page.editor.correction is not None)
    assert origin(page) == "found"
    assert 0 < len(page.editor.dots_px) < count
    page.workspace.undo()
    qtbot.waitUntil(lambda: len(page.editor.dots_px) == count)
    assert unfitted == []


def test_buttons_are_of_use_when_what_they_need_is_chosen(
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

    # The keys still answer, and say what is lacking.
    said: list[str] = []
    page.workspace.notified.connect(lambda words, _: said.append(words))
    key(page, Qt.Key.Key_Delete)
    assert len(said) == 1
    assert session.correction(0) is None

    click(page, editor.dots_px[10])
    panel.buttons["Delete"].setFocus()
    panel.buttons["Delete"].click()
    assert len(editor.selection) == 0
    assert enabled() == always | {"Back to automatic"}
    assert page.view.hasFocus()  # not another button


def test_a_read_only_frame_is_looked_at_and_not_edited(
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


def test_clicks_boxes_drags_and_keys(
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
    kept = session.correction(0)
    assert kept is not None
    np.testing.assert_array_equal(kept.dots.image_px, editor.dots_px)
    assert kept.manual.tolist() == [n == 11 for n in range(len(start))]

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


def test_a_refused_edit_says_why_and_changes_nothing(
    page: DotsPage, qtbot: QtBot, copy_sample: CopySample, unfitted: list[list[int]]
) -> None:
    session = show(page, qtbot, copy_sample("blocked_rows"), 0)
    steps, said = len(session.history), []
    page.workspace.notified.connect(lambda words, problem: said.append((words, problem)))
    for which in (Qt.Key.Key_Delete, Qt.Key.Key_M, Qt.Key.Key_S, Qt.Key.Key_B, Qt.Key.Key_N):
        key(page, which)
    lattice = page.editor.correction.lattice if page.editor.correction else None
    assert lattice is not None
    page.editor.choose_rows([4])
    page.dots_panel.row.edited.emit(5)  # where other dots are
    assert [problem for _, problem in said] == [True] * 6
    assert "no dot is selected" in said[0][0]
    assert "already assigned" in said[-1][0]
    assert len(session.history) == steps
    assert unfitted == []


def test_rows_are_edited_from_the_list_by_keyboard(
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
    own = before.lattice.row == top - 1
    np.testing.assert_array_equal(after.lattice.column[own], before.lattice.column[own] + 1)
    np.testing.assert_array_equal(after.lattice.column[~own], before.lattice.column[~own])
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
    # The README of the sample says where it is on the picture, and which site that is.
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


def test_a_button_asks_for_the_click_it_needs(
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
    kept = session.correction(3)
    assert kept is not None
    assert kept.lattice.reference == (6, 8)  # as blocked_rows/README.md has it
    assert panel.chosen.text().startswith("Nothing selected")
    assert "press Reference" not in panel.seen.text()
    assert button.mapTo(page.panel, QPoint()) == left
    assert unfitted == [[3]]


def test_a_correction_is_carried_on_and_taken_back(
    page: DotsPage, qtbot: QtBot, copy_sample: CopySample, unfitted: list[list[int]]
) -> None:
    session = show(page, qtbot, copy_sample("blocked_rows"), 2)
    said: list[str] = []
    page.workspace.notified.connect(lambda words, problem: said.append(words))
    earlier = session.correction(2)
    key(page, Qt.Key.Key_Return, CONTROL)
    qtbot.waitUntil(lambda: bool(said))
    assert "Carried on over 3 frames, up to frame 5" in said[0]
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


def test_carrying_on_keeps_what_was_done_when_it_is_cancelled(copy_sample: CopySample) -> None:
    with Session.open(copy_sample("blocked_rows")) as session:
        control = Control()

        def progress(done: int, total: int) -> None:
            if done == 2:
                control.cancelled.set()
            control.check()

        control.progress = progress  # type: ignore[method-assign]
        carried = presenter.carry(session, presenter.shown(session, 2, None), None, control)
        assert list(carried.corrections) == [3, 4]
        assert "stopped before frame 5: it was cancelled" in carried.words


def test_the_search_for_rows_is_chosen_on_the_page(
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


def test_what_is_shown_without_a_window(copy_sample: CopySample) -> None:
    with Session.open(copy_sample("blocked_rows")) as session:
        seen = presenter.shown(session, 0, None)
        assert seen.origin == "measured"
        assert presenter.wanted(session, 0) is None
        assert seen.correction is not None
        # Computed dots lie on the captured ones: the sample's surface fits.
        near = np.linalg.norm(
            seen.computed_px[:, None] - seen.correction.dots.image_px[None], axis=-1
        ).min(axis=1)
        assert len(near) > 90
        assert near.max() < 1.0
        assert presenter.sentence(seen).startswith("As measured: 99 dots in 9 rows")
        lines = presenter.row_lines(seen.correction)
        assert [line.row for line in lines if line.row] == list(range(9, 0, -1))
        assert sum(line.dots for line in lines) == 99
        assert [line.note for line in lines if line.row == 6] == ["reference 8"]
        assert not presenter.needs_fit(presenter.shown(session, 0, None))
        session.correct({0: shift_row(seen.correction, 4, 1)})
        assert presenter.needs_fit(presenter.shown(session, 0, None))
        assert presenter.shown(session, 0, None).origin == "corrected"
        session.correct({0: None})
        assert presenter.shown(session, 0, None).origin == "measured"
        assert not presenter.needs_fit(presenter.shown(session, 0, None))


def test_figures_before_and_after() -> None:
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


def test_frames_that_rush_by_show_their_own_dots(
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
    # The session's results are by other settings, so the dots are looked for: once, at the end.
    qtbot.waitUntil(lambda: origin(page) == "found")
    assert page.looking.found is not None
    assert page.looking.found.frame == numbers[-1]


def test_a_damaged_result_is_told_and_the_dots_are_looked_for(
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


def test_arrow_keys_go_through_frames_until_a_dot_is_chosen(
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


def test_rings_grow_with_the_dots_and_the_reference_is_ringed(
    page: DotsPage, qtbot: QtBot, copy_sample: CopySample, unfitted: list[list[int]]
) -> None:
    show(page, qtbot, copy_sample("gtaw"), 0)
    marks, ring = page.overlay._dots, page.overlay._reference
    size = marks.data["size"].max()
    assert ring.data["size"].tolist() == [2 * size]
    # Row 6 is dark at column 8: the ring is amid its neighbours there.
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


def test_edits_that_follow_each_other_at_once_all_stand(
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
    kept = session.correction(0)
    assert kept is not None
    assert kept.lattice.blocked_rows == before.lattice.blocked_rows | {2, 4, 5}


def test_a_measured_frame_without_dots_says_so_and_why(
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
