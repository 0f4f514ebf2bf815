"""The simulator window: first frame, the files of the command, cancelling, opening a session."""

from __future__ import annotations

import csv
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path

import numpy as np
import pytest
from PySide6.QtCore import Qt
from PySide6.QtTest import QTest
from PySide6.QtWidgets import QPushButton
from pytestqt.qtbot import QtBot

from labapp.config.scenario import shipped_scenarios
from labapp.gui.dialogs import new_path
from labapp.gui.shell.window import MainWindow
from labapp.gui.tools.simulator import SimulatorWindow
from tests.conftest import Run


@pytest.fixture
def simulator(window: MainWindow, qtbot: QtBot) -> SimulatorWindow:
    """The simulator window with its first scenario drawn."""
    window.do("simulator")
    tool = window.findChild(SimulatorWindow)
    assert tool is not None
    qtbot.waitUntil(lambda: tool.preview is not None)
    return tool


def choose(tool: SimulatorWindow, name: str, qtbot: QtBot) -> Path:
    """Choose a shipped scenario, and wait until it is drawn."""
    path = next(path for path in shipped_scenarios() if path.stem == name)
    tool.scenario.set_value(str(path))
    tool.scenario.edited.emit(str(path))
    assert not tool.start_button.isEnabled()
    qtbot.waitUntil(lambda: tool.preview is not None)
    return path


def click(button: QPushButton) -> None:
    QTest.mouseClick(button, Qt.MouseButton.LeftButton)


def test_first_frame_is_shown_with_its_true_dots(
    simulator: SimulatorWindow, qtbot: QtBot, labapp: Run, tmp_path: Path
):
    path = choose(simulator, "mode_11", qtbot)
    assert (simulator.frames.value(), simulator.seed.value()) == (30, 5007)
    assert simulator.words.text() == "Sloshes to and fro along the weld: mode (1, 1)"
    assert labapp("simulate", path, "--out", tmp_path / "out", "--frames", 1)[0] == 0
    with (tmp_path / "out" / "dots_truth.csv").open(encoding="utf-8") as file:
        lines = [row for row in csv.DictReader(file) if row["visible"] == "1"]
    true = np.array([[float(row["u_px"]), float(row["v_px"])] for row in lines])
    ringed = np.column_stack(simulator._rings.getData())
    np.testing.assert_allclose(ringed, true, atol=6e-4)
    assert f"{len(true)} dots" in simulator.picture.accessibleDescription()
    rows = {row.name: row for row in simulator.table.rows}
    assert rows["Dots in the picture"].value == len(true)
    assert rows["Recording lasts"].texts[1:] == ("0.50", "", "s")
    before = simulator.picture.picture
    simulator.seed.set_value(1)
    simulator.seed.edited.emit(1)
    qtbot.waitUntil(lambda: simulator.preview is not None)
    assert (simulator.picture.picture != before).mean() > 0.3
    assert simulator.seed.value() == 1


def test_recording_equals_that_of_the_command_and_is_opened(
    simulator: SimulatorWindow, window: MainWindow, labapp: Run, qtbot: QtBot, tmp_path: Path
):
    path = choose(simulator, "low_rear", qtbot)
    out = tmp_path / "window" / "low_rear"
    simulator.frames.set_value(3)
    simulator.seed.set_value(8)
    simulator.folder.editor.setText(str(out))
    assert not simulator.open_button.isEnabled()
    click(simulator.start_button)
    qtbot.waitUntil(lambda: simulator.made is not None)
    assert "3 frames" in simulator.message.text()
    options = ("--frames", 3, "--seed", 8)
    assert labapp("simulate", path, "--out", tmp_path / "command", *options)[0] == 0
    names = sorted(file.name for file in (tmp_path / "command").iterdir())
    assert names == sorted(file.name for file in out.iterdir())
    for name in names:
        assert (tmp_path / "command" / name).read_bytes() == (out / name).read_bytes(), name
    click(simulator.open_button)
    qtbot.waitUntil(lambda: window.workspace.session is not None)
    session = window.workspace.session
    assert session is not None
    assert session.path == out / "low_rear.labsession"
    assert session.setup_text == (out / "setup.toml").read_text("utf-8")
    assert session.frames.tolist() == [0, 1, 2]
    assert session.record.title == "The tail ends below the work piece (§7.2)"
    assert session.record.expected_width_mm == pytest.approx(6.66, rel=0.1)
    assert not simulator.isVisible()
    assert "is open" in simulator.message.text()
    for _, result in session.measure_each([0]):
        assert result.status == "ok"


def test_tiff_stack_has_a_time_base(simulator: SimulatorWindow, window: MainWindow,
                                    qtbot: QtBot, tmp_path: Path):  # fmt: skip
    shipped = next(path for path in shipped_scenarios() if path.stem == "cap")
    scenario = tmp_path / "stack.toml"
    scenario.write_text(shipped.read_text("utf-8") + 'format = "tif"\n', "utf-8")
    simulator.take(scenario)
    qtbot.waitUntil(lambda: simulator.preview is not None)
    simulator.frames.set_value(2)
    simulator.folder.editor.setText(str(tmp_path / "out"))
    click(simulator.start_button)
    qtbot.waitUntil(lambda: simulator.made is not None)
    click(simulator.open_button)
    qtbot.waitUntil(lambda: window.workspace.session is not None)
    session = window.workspace.session
    assert session is not None
    assert session.frame(1).time_s == pytest.approx(1 / 60)


def test_invalid_input_is_reported_and_nothing_written(
    simulator: SimulatorWindow, qtbot: QtBot, tmp_path: Path
):
    scenario = tmp_path / "own.toml"
    scenario.write_text("[pool]\nshape = 'eg'\n", "utf-8")
    simulator.take(scenario)
    qtbot.waitUntil(lambda: "pool.shape" in simulator.picture.accessibleDescription())
    assert not simulator.start_button.isEnabled()
    assert simulator.table.rows == ()
    simulator.say("Stopped")
    choose(simulator, "cap", qtbot)
    assert not simulator.message.text()
    folder = tmp_path / "folder"
    folder.mkdir()
    (folder / "mine.txt").write_text("mine")
    simulator.folder.editor.setText(str(folder))
    click(simulator.start_button)
    qtbot.waitUntil(lambda: "folder: holds mine.txt" in simulator.message.text())
    assert [path.name for path in folder.iterdir()] == ["mine.txt"]
    assert not simulator.open_button.isEnabled()


def test_dead_process_is_reported_and_a_restart_works(
    simulator: SimulatorWindow, qtbot: QtBot, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
):
    def crash(*_: object, **__: object) -> None:
        raise BrokenProcessPool

    with monkeypatch.context() as patched:
        patched.setattr("labapp.gui.tools.simulator.simulate", crash)
        simulator.folder.editor.setText(str(tmp_path / "out"))
        click(simulator.start_button)
        qtbot.waitUntil(lambda: not simulator.working)
    assert "a process that simulates has ended" in simulator.message.text()
    simulator.frames.set_value(1)
    click(simulator.start_button)
    qtbot.waitUntil(lambda: simulator.made is not None)


@pytest.mark.parametrize("how", ["escape", "close", "app"])
def test_stopped_simulation_leaves_no_files(
    simulator: SimulatorWindow, window: MainWindow, qtbot: QtBot, tmp_path: Path, how: str
):
    simulator.frames.set_value(5000)
    (tmp_path / "results").mkdir()
    simulator.folder.editor.setText(str(tmp_path / "results" / "out"))
    click(simulator.start_button)
    qtbot.waitUntil(lambda: simulator.bar.value() > 0)
    if how == "escape":
        QTest.keyClick(simulator, Qt.Key.Key_Escape)
        assert simulator.isVisible()
    elif how == "close":
        click(simulator.close_button)
        assert not simulator.isVisible()
    else:
        window.close()
    qtbot.waitUntil(lambda: not simulator.working)
    assert list((tmp_path / "results").iterdir()) == []
    assert simulator.made is None


def test_last_chosen_scenario_is_shown(simulator: SimulatorWindow, qtbot: QtBot):
    for path in shipped_scenarios()[:6]:
        simulator.scenario.set_value(str(path))
        simulator.scenario.edited.emit(str(path))
    qtbot.waitUntil(lambda: simulator.preview is not None)
    qtbot.waitUntil(lambda: not simulator.previews.active)
    assert simulator.preview is not None
    assert simulator.preview.scenario.text == path.read_text("utf-8")


def test_proposed_folder_does_not_exist_yet(tmp_path: Path):
    assert new_path(tmp_path, "egg", suffix="") == tmp_path / "egg"
    (tmp_path / "egg").mkdir()
    (tmp_path / "egg 2").mkdir()
    assert new_path(tmp_path, "egg", suffix="") == tmp_path / "egg 3"


def test_typed_seed_and_frames_stay_when_the_window_is_closed_while_it_draws(
    simulator: SimulatorWindow, qtbot: QtBot
):
    simulator.frames.set_value(4)
    simulator.seed.set_value(77)
    simulator.seed.edited.emit(77)
    assert simulator.preview is None
    simulator.close()
    simulator.open_beside()
    qtbot.waitUntil(lambda: simulator.preview is not None)
    assert (simulator.frames.value(), simulator.seed.value()) == (4, 77)
    assert simulator.preview.scenario.recording.seed == 77
