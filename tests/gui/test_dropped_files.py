"""Files dropped on the window that are no recordings: a set-up, and a table of signals."""

from __future__ import annotations

from pathlib import Path

from pytestqt.qtbot import QtBot

from labapp.gui.shell.window import MainWindow
from labapp.session.session import Session
from tests.gui.conftest import CopySample
from tests.gui.test_window import drop, problems


def test_dropped_setup_is_loaded_and_undone(
    window: MainWindow, copy_sample: CopySample, qtbot: QtBot
) -> None:
    path = copy_sample("gtaw")
    window.files.open(path)
    session = window.workspace.session
    assert session is not None
    former = session.setup_text
    setup = path.with_name("other.toml")
    setup.write_text(former.replace("distance_mm = 50", "distance_mm = 51"))
    assert setup.read_text() != former
    drop(window, qtbot, setup)
    qtbot.waitUntil(lambda: session.setup_text == setup.read_text())
    assert window.page is not None
    assert window.page.key == "setup"
    assert window.page.answer.isVisible()
    assert not problems(window)
    window.workspace.undo()
    assert session.setup_text == former
    setup.write_text("[laser]\nwrong = 1\n")
    drop(window, qtbot, setup)
    qtbot.waitUntil(lambda: bool(problems(window)))
    assert "laser.wrong" in problems(window)[0]
    assert session.setup_text == former


def test_dropped_table_of_signals_is_read_by_trends(
    window: MainWindow, copy_sample: CopySample, qtbot: QtBot, tmp_path: Path
) -> None:
    table = tmp_path / "log.csv"
    table.write_text("time_s,current_a\n0,75\n0.2,80\n0.4,70\n")
    window.files.open(copy_sample("gtaw"))
    session = window.workspace.session
    assert session is not None
    drop(window, qtbot, table)
    qtbot.waitUntil(lambda: session.signals is not None)
    assert window.page is not None
    assert window.page.key == "trends"
    assert not problems(window)


def test_dropped_setup_without_a_session_asks_for_one(
    window: MainWindow, qtbot: QtBot, tmp_path: Path
) -> None:
    (tmp_path / "setup.toml").write_text("[laser]\n")
    drop(window, qtbot, tmp_path / "setup.toml")
    qtbot.waitUntil(lambda: bool(problems(window)))
    assert window.workspace.session is None
    assert "session" in window.welcome.refused.text()
    assert not window.workspace.tasks.active


def test_dropped_files_do_not_change_a_read_only_session(
    window: MainWindow, copy_sample: CopySample, qtbot: QtBot, tmp_path: Path
) -> None:
    path = copy_sample("gtaw")
    session = Session.open(path, read_only=True)
    window.workspace.show(session)
    table = tmp_path / "log.csv"
    table.write_text("time_s,current_a\n0,75\n0.2,80\n0.4,70\n")
    former = session.setup_text
    drop(window, qtbot, path.with_name("setup.toml"))
    qtbot.waitUntil(lambda: len(problems(window)) == 1)
    drop(window, qtbot, table)
    qtbot.waitUntil(lambda: len(problems(window)) == 2)
    assert session.setup_text == former
    assert session.signals is None
