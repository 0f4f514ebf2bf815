"""The error-analysis window: the files of the command, its parts, cancelling, copying."""

from __future__ import annotations

import threading
from pathlib import Path
from typing import Any

import pytest
from PySide6.QtCore import Qt
from PySide6.QtTest import QTest
from PySide6.QtWidgets import QApplication, QPushButton
from pytestqt.qtbot import QtBot

from labapp.gui.shell.window import MainWindow
from labapp.gui.tools import analysis_presenter
from labapp.gui.tools.analysis import AnalysisWindow
from labapp.gui.widgets.tables import CellTable
from labapp.session.session import Session
from labapp.studies import error_analysis, predicted_budget
from labapp.studies.analysis import PARTS
from labapp.studies.tables import Table
from tests.conftest import Run
from tests.gui.conftest import CopySample
from tests.waiting import PATIENCE_S


@pytest.fixture
def analysis(
    window: MainWindow, copy_sample: CopySample, qtbot: QtBot, monkeypatch: pytest.MonkeyPatch
) -> AnalysisWindow:
    """The window with a session; few pools and caps, computed in one process."""
    caps = error_analysis.caps_8_3_1()[2::14]
    monkeypatch.setattr(error_analysis, "caps_8_3_1", lambda: caps)
    monkeypatch.setattr("os.cpu_count", lambda: 1)
    monkeypatch.setattr(predicted_budget, "POOLS", 2)
    monkeypatch.setattr(predicted_budget, "MOVED_POOLS", 1)
    assert window.files.open(copy_sample("gtaw"))
    window.do("analysis")
    tool = window.findChild(AnalysisWindow)
    assert tool is not None
    qtbot.waitUntil(tool.isVisible)
    return tool


def click(button: QPushButton) -> None:
    QTest.mouseClick(button, Qt.MouseButton.LeftButton)


def tick(tool: AnalysisWindow, *keys: str) -> None:
    for key, box in tool.parts.items():
        box.setChecked(key in keys)


def run_analysis(tool: AnalysisWindow, qtbot: QtBot) -> None:
    tool.start_button.setFocus()
    QTest.keyClick(tool.start_button, Qt.Key.Key_Space)
    assert tool.working
    assert tool.focusWidget() is tool.cancel_button
    qtbot.waitUntil(lambda: not tool.working)
    assert tool.message.text() == "Done"
    assert tool.focusWidget() is tool.start_button


def check_same(window: Path, command: Path) -> None:
    names = sorted(path.name for path in command.iterdir())
    assert sorted(path.name for path in window.iterdir()) == names
    for name in names:
        assert (window / name).read_bytes() == (command / name).read_bytes(), name


def test_budget_is_computed_for_the_setup_of_the_session(
    analysis: AnalysisWindow, labapp: Run, qtbot: QtBot, tmp_path: Path
):
    session = analysis.workspace.session
    assert session is not None
    assert [field.value() for field in analysis.sizes.values()] == [6.7, 7.4, 0.3]
    run_analysis(analysis, qtbot)
    analysis.save(tmp_path / "window")
    setup = tmp_path / "setup.toml"
    setup.write_text(session.setup_text, "utf-8")
    size = ("--width", "6.7", "--length", "7.4", "--height", "0.3")
    code, stdout, _ = labapp(
        "analyze", "budget", "--setup", setup, *size, "--out", tmp_path / "command"
    )
    assert code == 0
    check_same(tmp_path / "window", tmp_path / "command")
    assert set(analysis.files) == {"error_budget.csv", "error_budget.md", "error_budget.png"}
    assert analysis.words.text() in stdout
    table = analysis.table
    assert table.horizontalHeaderItem(1).text() == "predicted, %"
    assert table.item(table.rowCount() - 1, 0).text() == "everything"
    table.copy_csv()
    expected = (tmp_path / "command" / "error_budget.csv").read_text("utf-8")
    assert QApplication.clipboard().text() == expected
    (tmp_path / "window" / "error_budget.md").write_text("with notes")
    analysis.save(tmp_path / "window")
    assert "error_budget.md" in analysis.message.text()
    assert (tmp_path / "window" / "error_budget.md").read_text() == "with notes"
    analysis.save(setup / "below a file")
    assert "expected one that can be written" in analysis.message.text()
    analysis.which.set_value("error_budget.png")
    analysis.which.edited.emit("error_budget.png")
    assert analysis.stack.currentWidget() is analysis.sheet
    analysis.sheet.copy_picture()
    assert QApplication.clipboard().image().width() > 600


def test_parts_equal_those_of_the_command(
    analysis: AnalysisWindow, labapp: Run, qtbot: QtBot, tmp_path: Path
):
    assert tuple(analysis.parts) == (analysis_presenter.BUDGET, *PARTS)
    tick(analysis, "CE", "LE", "parameters")
    analysis.scheme.set_value("ers")
    analysis.step.set_value(10)
    analysis.draws.set_value(10)
    run_analysis(analysis, qtbot)
    analysis.save(tmp_path / "window")
    options = ("--part", "CE", "--part", "LE", "--part", "parameters", "--scheme", "ers")
    options += ("--step", "10", "--draws", "10")
    assert labapp("analyze", "errors", "--out", tmp_path / "command", *options)[0] == 0
    check_same(tmp_path / "window", tmp_path / "command")
    names = [analysis.which.editor.itemText(n) for n in range(analysis.which.editor.count())]
    assert names == [
        "Errors", "ARE", "Errors by cap", "Parameter deviation", "Figure 8-6: CE",
        "Figure 8-7: CE ARE", "Figure 8-8: LE", "Figure 8-9: LE ARE",
        "Parameter deviation convex, picture", "Parameter deviation concave, picture",
    ]  # fmt: skip


@pytest.mark.parametrize("how", ["escape", "close", "app"])
def test_cancelling_keeps_finished_parts(
    analysis: AnalysisWindow,
    window: MainWindow,
    qtbot: QtBot,
    monkeypatch: pytest.MonkeyPatch,
    how: str,
):
    gate, survey = threading.Event(), error_analysis.survey

    def slow(kind: str, *args: Any, **kwargs: Any) -> object:
        if kind == "LE":
            gate.wait(PATIENCE_S)
        return survey(kind, *args, **kwargs)

    monkeypatch.setattr(error_analysis, "survey", slow)
    tick(analysis, "CE", "LE")
    analysis.scheme.set_value("ers")
    click(analysis.start_button)
    qtbot.waitUntil(lambda: "errors" in analysis.tables)
    threading.Timer(0.1, gate.set).start()
    if how == "escape":
        QTest.keyClick(analysis, Qt.Key.Key_Escape)
    elif how == "close":
        click(analysis.close_button)
    else:
        window.close()
    qtbot.waitUntil(lambda: not analysis.working)
    assert [row[0] for row in analysis.tables["errors"].rows[::3]] == ["CE-D", "CE-B"]
    assert analysis.message.text() == "Stopped"
    assert analysis.save_button.isEnabled()
    assert analysis.isVisible() == (how == "escape")


def test_disabled_buttons_say_why(analysis: AnalysisWindow, qtbot: QtBot):
    enabled = analysis.start_button.toolTip()
    tick(analysis)
    assert not analysis.start_button.isEnabled()
    assert "Tick" in analysis.start_button.toolTip()
    tick(analysis, "budget")
    analysis.start()
    assert not analysis.start_button.isEnabled()
    assert analysis.start_button.toolTip() not in ("", enabled)
    analysis.cancel()
    qtbot.waitUntil(lambda: not analysis.working)
    assert analysis.start_button.toolTip() == enabled
    assert not analysis.cancel_button.isEnabled()


def test_budget_of_a_former_setup_is_marked(analysis: AnalysisWindow, qtbot: QtBot):
    tick(analysis, "budget")
    run_analysis(analysis, qtbot)
    assert not analysis.former.text()
    space = analysis.workspace
    space.attempt(lambda session: session.update_setup({"laser": {"distance_mm": 33.0}}))
    assert "former set-up of gtaw" in analysis.former.text()
    assert analysis.former.isVisible()
    space.undo()
    assert not analysis.former.text()
    space.attempt(lambda session: session.update_setup({"laser": {"distance_mm": 33.0}}))
    run_analysis(analysis, qtbot)
    assert not analysis.former.text()


def test_new_parts_replace_the_previous_ones(analysis: AnalysisWindow, qtbot: QtBot):
    run_analysis(analysis, qtbot)
    tick(analysis)
    assert not analysis.start_button.isEnabled()
    tick(analysis, "CE")
    analysis.scheme.set_value("ers")
    run_analysis(analysis, qtbot)
    assert "error_budget" not in analysis.tables
    assert "error_budget.csv" not in analysis.files


def test_impossible_input_is_rejected(analysis: AnalysisWindow, window: MainWindow, tmp_path: Path):
    analysis.sizes["height"].set_value(0.001)
    click(analysis.start_button)
    assert not analysis.working
    assert "expected 0.01 to 30 mm" in analysis.message.text()
    window.do("close")
    analysis.sizes["height"].set_value(0.3)
    click(analysis.start_button)
    assert not analysis.working
    assert "no session is open" in analysis.message.text().lower()
    window.workspace.show(Session.create(tmp_path / "empty.labsession"))
    click(analysis.start_button)
    assert not analysis.working
    assert "missing" in analysis.message.text()


def test_budget_of_lines_is_not_offered(
    analysis: AnalysisWindow, window: MainWindow, copy_sample: CopySample, qtbot: QtBot
):
    assert analysis.why.isHidden()
    run_analysis(analysis, qtbot)
    click(analysis.close_button)
    assert window.files.open(copy_sample("five_lines"))
    window.do("analysis")
    # Its own set-up has no budget, but that of the dissertation has.
    assert analysis.setup.value() == analysis_presenter.USUAL
    assert analysis.why.isHidden()
    assert analysis.start_button.isEnabled()
    choose_setup(analysis, analysis_presenter.OPENED)
    assert not analysis.why.isHidden()
    assert analysis.why.text().startswith("The session is of a line pattern")
    assert not analysis.start_button.isEnabled()
    tick(analysis, analysis_presenter.BUDGET, "CE")
    assert not analysis.start_button.isEnabled()
    analysis.start()
    assert not analysis.working
    tick(analysis, "CE")
    assert analysis.why.isHidden()
    assert analysis.start_button.isEnabled()


def choose_setup(tool: AnalysisWindow, which: str) -> None:
    tool.setup.set_value(which)
    tool.setup.edited.emit(which)


def test_open_window_follows_to_a_session_of_lines(
    analysis: AnalysisWindow, window: MainWindow, copy_sample: CopySample
):
    assert window.files.open(copy_sample("gmaw"))
    assert analysis.start_button.isEnabled() == analysis.why.isHidden()
    choose_setup(analysis, analysis_presenter.OPENED)
    assert not analysis.start_button.isEnabled()
    assert window.files.open(copy_sample("thumb_tack"))
    assert analysis.why.isHidden()
    assert analysis.start_button.isEnabled()


def test_assumed_uncertainties_are_those_of_each_part(analysis: AnalysisWindow):
    words = analysis.words.text()
    assert "The budget takes the ± of the session's set-up" in words
    assert "0.1 mm, 0.1° and 0.1 px if it has none" in words


def test_budget_of_a_tiny_pool_is_refused(analysis: AnalysisWindow, qtbot: QtBot):
    for key, size in (("width", 1.0), ("length", 1.0), ("height", 0.05)):
        analysis.sizes[key].set_value(size)
    click(analysis.start_button)
    qtbot.waitUntil(lambda: not analysis.working)
    assert "none of 2 pools like it gives a surface" in analysis.message.text()
    assert not analysis.tables


def test_default_size_without_a_setup(copy_sample: CopySample, tmp_path: Path):
    assert not analysis_presenter.has_setup(None)
    assert analysis_presenter.expected_mm(None) == (6.0, 7.0, 0.3)
    with Session.create(tmp_path / "new.labsession") as session:
        assert not analysis_presenter.has_setup(session)
        assert analysis_presenter.expected_mm(session) == (6.0, 7.0, 0.3)
    with Session.open(copy_sample("thumb_tack")) as session:
        assert analysis_presenter.has_setup(session)
        assert analysis_presenter.expected_mm(session) == (9.75, 9.75, 0.91)


def test_values_of_the_dissertation_are_headed_by_its_name(qtbot: QtBot):
    shown = CellTable("Results")
    qtbot.addWidget(shown)
    shown.show_table(Table("errors", "", ("scheme", "text", "text_mean_pct"), (("fit", 1.0, 2.0),)))
    headings = [shown.horizontalHeaderItem(column).text() for column in range(3)]
    assert headings == ["scheme", "dissertation", "dissertation mean, %"]
