"""The pool-dynamics window: the tables of the command, events, and missing prerequisites."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from PySide6.QtCore import Qt
from PySide6.QtTest import QTest
from pytestqt.qtbot import QtBot

from labapp.core.rows.correction import Correction, delete_dots
from labapp.errors import InputError
from labapp.gui.pages.trends.page import TrendsPage
from labapp.gui.shell.window import MainWindow
from labapp.gui.tools import dynamics_presenter
from labapp.gui.tools.dynamics import CHANGED, DynamicsWindow
from labapp.session.session import Session
from labapp.session.signals import Signals
from tests.conftest import Run
from tests.core.dynamics_truth import analysed_step
from tests.gui.conftest import CopySample


def opened(window: MainWindow, path: Path) -> DynamicsWindow:
    assert window.files.open(path)
    window.do("dynamics")
    tool = window.findChild(DynamicsWindow)
    assert tool is not None
    return tool


@pytest.fixture
def tool(window: MainWindow, copy_sample: CopySample, qtbot: QtBot) -> DynamicsWindow:
    """The window with a session of 30 frames, which is analysed on opening."""
    dynamics = opened(window, copy_sample("gtaw"))
    qtbot.waitUntil(lambda: not dynamics.working)
    assert dynamics.drawn is not None
    return dynamics


@pytest.mark.slow
def test_files_equal_those_of_the_command(
    tool: DynamicsWindow, labapp: Run, tmp_path: Path, qtbot: QtBot
) -> None:
    tool.save(tmp_path / "window")
    qtbot.waitUntil(lambda: not tool.working)
    session = tool.workspace.session
    assert session is not None
    assert labapp("dynamics", session.path, "--out", tmp_path / "command")[0] == 0
    names = sorted(path.name for path in (tmp_path / "command").iterdir())
    assert sorted(path.name for path in (tmp_path / "window").iterdir()) == names
    for name in (name for name in names if name.endswith(".csv")):
        one, other = ((tmp_path / of / name).read_bytes() for of in ("window", "command"))
        assert one == other, name


@pytest.mark.slow
def test_analysis_uses_the_settings_and_rejects_half_a_band(
    tool: DynamicsWindow, qtbot: QtBot
) -> None:
    before = tool.drawn
    tool.band[0].set_value(5.0)
    tool.start()
    assert not tool.working
    tool.band[1].set_value(25.0)
    tool.of.set_value("asymmetry")
    tool.start()
    qtbot.waitUntil(lambda: not tool.working)
    assert tool.drawn is not None
    assert tool.drawn is not before
    assert tool.drawn.found.settings.of == "asymmetry"
    assert tool.drawn.found.settings.band_hz == (5.0, 25.0)
    tool.close()
    tool.open_beside()
    assert not tool.working  # nothing has changed


@pytest.mark.slow
def test_events_are_marked_in_the_trends_and_select_their_frame(
    tool: DynamicsWindow, window: MainWindow, qtbot: QtBot
) -> None:
    window.do("step_trends")
    (page,) = window.findChildren(TrendsPage)
    analysis = analysed_step()
    tool.show_found(dynamics_presenter.draw(analysis, lambda: None))
    (width,) = [curve for curve in page.plots.curves if curve.name == "Width"]
    assert width.events.tolist() == [one.time_s for one in analysis.events["width_mm"]]
    assert width.events[0] == pytest.approx(0.5, abs=0.05)
    row = [tool.events.item(k, 1).text() for k in range(tool.events.rowCount())].index("Width (mm)")
    tool.events.selectRow(row)
    with qtbot.waitSignal(window.workspace.frame_changed):
        tool._event_frames = (*[20] * (row + 1),)
        tool.frame_button.setFocus()
        QTest.keyClick(tool.frame_button, Qt.Key.Key_Space)
    assert window.workspace.frame == 20
    window.workspace.show(None)
    assert tool.drawn is None
    assert not tool.tabs.isVisible()


def with_current(session: Session, ampere: float = 100.0) -> Signals:
    """Signals with a step of the current in the middle of a session's recording."""
    last_s = float(session.overview().time_s[-1])
    time_s = np.linspace(0, last_s, 200)
    current = np.where(time_s < last_s / 2, ampere, 2 * ampere)
    return Signals("weld.csv", time_s, current, np.full(200, np.nan))


@pytest.mark.slow
def test_stopped_analysis_of_changed_results_keeps_the_warning(
    tool: DynamicsWindow, window: MainWindow, qtbot: QtBot
) -> None:
    session = window.workspace.session
    assert session is not None
    before, result = tool.drawn, session.result(3)
    assert result is not None
    found = result.measurement
    corrected = delete_dots(Correction.of(found.dots, found.lattice), [0])
    assert window.workspace.attempt(lambda of: of.correct({3: corrected}))
    assert tool.words.text().startswith(CHANGED)
    assert not tool.save_button.isEnabled()
    assert tool.save_button.toolTip() == CHANGED
    tool.start()
    tool.reject()
    qtbot.waitUntil(lambda: not tool.working)
    assert tool.drawn is before
    assert tool.words.text().startswith(CHANGED)
    tool.close()
    tool.open_beside()
    assert tool.working
    qtbot.waitUntil(lambda: not tool.working)
    assert tool.drawn is not before
    assert not tool.words.text().startswith(CHANGED)


@pytest.mark.slow
def test_window_closed_during_the_first_analysis_analyses_when_it_is_opened_again(
    window: MainWindow, copy_sample: CopySample, qtbot: QtBot
) -> None:
    tool = opened(window, copy_sample("gtaw"))
    assert tool.working
    tool.close()
    assert tool.drawn is None
    tool.open_beside()
    qtbot.waitUntil(lambda: not tool.working)
    assert tool.drawn is not None


@pytest.mark.slow
def test_changed_signals_are_analysed(
    tool: DynamicsWindow, window: MainWindow, qtbot: QtBot
) -> None:
    session, attempt = window.workspace.session, window.workspace.attempt
    assert session is not None
    assert "no current" in tool.response_words.text()
    signals = with_current(session)
    assert attempt(lambda of: of.set_signals(signals))
    assert tool.words.text().startswith(CHANGED)
    tool.close()
    tool.open_beside()
    qtbot.waitUntil(lambda: not tool.working)
    assert tool.drawn is not None
    assert tool.drawn.found.events["current"]
    assert "no current" not in tool.response_words.text()
    for changed in (None, with_current(session, 120.0), replace(signals, start_s=0.1)):
        assert attempt(partial(Session.set_signals, signals=changed))
        assert tool.words.text().startswith(CHANGED)
    assert attempt(lambda of: of.set_signals(with_current(session)))
    assert not tool.words.text().startswith(CHANGED)


@pytest.mark.slow
def test_mode_is_animated_until_stopped(tool: DynamicsWindow, qtbot: QtBot) -> None:
    tool.tabs.setCurrentIndex(1)
    tool.play()
    qtbot.waitUntil(lambda: not tool.working)
    assert tool._turn.isActive()
    tool.play()
    assert not tool._turn.isActive()
    tool.play()
    tool.modes.selectRow(3)
    assert not tool._turn.isActive()


def test_missing_frame_rate_prevents_the_analysis(
    window: MainWindow, copy_sample: CopySample
) -> None:
    tool = opened(window, copy_sample("concave"))
    assert not tool.working
    assert "frame rate" in tool.words.text()
    assert not tool.start_button.isEnabled()


def test_damaged_session_is_reported(
    tool: DynamicsWindow, window: MainWindow, monkeypatch: pytest.MonkeyPatch
) -> None:
    def damaged(self: Session, scheme: str | None = None) -> None:
        raise InputError(self.path, "table of results", "damaged", "what was written")

    messages: list[tuple[str, bool]] = []
    window.workspace.notified.connect(lambda words, problem: messages.append((words, problem)))
    monkeypatch.setattr(Session, "overview", damaged)
    window.workspace._forget()
    for act in (tool.show_state, tool.prefill, tool.start):
        messages.clear()
        act()
        assert messages
        assert all("table of results: damaged" in words for words, _ in messages)
        assert all(problem for _, problem in messages)
    assert not tool.working
    assert not tool.start_button.isEnabled()


def test_closed_session_leaves_no_message(tool: DynamicsWindow, window: MainWindow) -> None:
    assert tool.message.text()
    window.do("close")
    assert tool.message.text() == ""


def test_frames_to_measure_are_named_only_if_there_are_enough(
    window: MainWindow, copy_sample: CopySample
) -> None:
    assert window.files.open(copy_sample("blocked_rows"))
    words = dynamics_presenter.impossible(window.workspace.session, window.workspace.overview())
    assert "3 of 6" in words
    assert "Measure more" not in words


def test_too_few_frames_are_reported(window: MainWindow, copy_sample: CopySample) -> None:
    assert window.files.open(copy_sample("gtaw"))
    overview = window.workspace.overview()
    assert overview is not None
    session = window.workspace.session
    assert dynamics_presenter.impossible(session, overview) == ""
    few = {**overview.measures, "height_mm": np.where(overview.frame < 15, 0.3, np.nan)}
    object.__setattr__(overview, "measures", few)
    words = dynamics_presenter.impossible(session, overview)
    assert "15 of 30" in words
    assert "Measure more" in words


def test_tables_show_the_simulated_values() -> None:
    analysis = analysed_step()
    rows = {str(row[0]): row for row in dynamics_presenter.modes_table(analysis).rows}
    assert str(rows["(0, 1)"][2]).startswith("31.0")
    assert str(rows["(1, 1)"][2]).startswith("47.0")
    shares = {row[1] for row in rows.values()}
    assert "<1%" in shares
    assert "0%" not in shares  # a mode with figures has a share
    response = dynamics_presenter.responses_table(analysis).rows
    assert {row[1] for row in response} == {"Width (mm)"}
    assert len(response) == 4  # the first order does not overshoot
    change = float(str(response[0][3]).partition(" ")[0])
    assert change == pytest.approx(0.5, abs=0.01)
    table, frames = dynamics_presenter.events_table(analysis)
    assert len(frames) == len(table.rows) >= 2
    assert abs(frames[0] - 100) <= 4
