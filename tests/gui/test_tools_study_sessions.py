"""Sessions of single recordings that the study window makes, completes, makes anew and keeps."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PySide6.QtCore import Qt
from PySide6.QtTest import QTest
from pytestqt.qtbot import QtBot

from labapp.gui.shell.window import MainWindow
from labapp.gui.tasks import Control
from labapp.gui.tools import study as study_window
from labapp.gui.tools.study import StudyWindow
from labapp.run import measurers
from labapp.run.study.study import Study
from labapp.session.session import Session
from labapp.simulation.parallel import Progress
from tests.simulated_recordings import simulated_recording
from tests.waiting import PATIENCE_S

pytestmark = pytest.mark.slow

PATIENCE_MS = round(1000 * PATIENCE_S)
FRAMES = 5


@pytest.fixture(scope="module")
def simulated(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return simulated_recording(tmp_path_factory.mktemp("simulated"), FRAMES)


@pytest.fixture
def file(simulated: Path, tmp_path: Path) -> Path:
    """A study of one recording."""
    shutil.copytree(simulated, tmp_path / "bench")
    return write(tmp_path / "study.toml")


@pytest.fixture
def short_stretches(monkeypatch: pytest.MonkeyPatch) -> None:
    """Divide recordings into stretches of three frames."""
    monkeypatch.setattr(measurers, "STRETCH", 3)


@pytest.fixture
def tool(window: MainWindow, file: Path, qtbot: QtBot) -> StudyWindow:
    """The window with this study, which was run."""
    window.do("study")
    found = window.findChild(StudyWindow)
    assert found is not None
    run(found, file, qtbot)
    return found


def write(path: Path, top: str = "", conditions: str = "current_a = 80") -> Path:
    one = f'file = "bench/recording.avi"\nname = "I80"\nconditions = {{ {conditions} }}\n'
    path.write_text(f'setup = "bench/setup.toml"\n{top}\n[[recording]]\n{one}', "utf-8")
    return path


def run(tool: StudyWindow, file: Path, qtbot: QtBot) -> None:
    """Measure the study as it is now, and show it."""
    Study(file).run(0)
    tool.open_beside()
    tool.show_study(file)
    qtbot.waitUntil(lambda: [one.state for one in tool.found] == ["done"], timeout=PATIENCE_MS)


def open_it(tool: StudyWindow, qtbot: QtBot) -> Session:
    tool.list.selectRow(0)
    QTest.mouseClick(tool.open_button, Qt.MouseButton.LeftButton)
    qtbot.waitUntil(lambda: not tool.working, timeout=PATIENCE_MS)
    assert tool.workspace.session is not None, tool.message.text()
    return tool.workspace.session


def heights(tool: StudyWindow) -> list[float]:
    """Heights of the frames as the study measured them."""
    tables = Study(tool.study.path).tables()
    return tables["I80"]["height_mm"].tolist()


def shows_what_the_study_measured(tool: StudyWindow) -> bool:
    return tool.workspace.session.overview().measures["height_mm"].tolist() == heights(tool)


def test_session_is_made_anew_after_the_study_was_changed(
    tool: StudyWindow, file: Path, qtbot: QtBot
):
    assert open_it(tool, qtbot).settings.scheme == "fit"
    assert shows_what_the_study_measured(tool)
    fit = heights(tool)
    run(tool, write(file, 'scheme = "ers"'), qtbot)
    session = open_it(tool, qtbot)
    assert session.settings.scheme == "ers"
    assert shows_what_the_study_measured(tool)
    assert heights(tool) != fit
    assert [path.name for path in session.path.parent.glob("*.labsession")] == ["I80.labsession"]
    written = session.path.stat().st_mtime_ns
    tool.open_beside()
    assert open_it(tool, qtbot) is session
    assert session.path.stat().st_mtime_ns == written
    run(tool, write(file, 'scheme = "ers"\nwarm = false', 'gas = "Ar"'), qtbot)
    session = open_it(tool, qtbot)
    assert (session.record.current_a, session.record.gas) == (None, "Ar")
    assert shows_what_the_study_measured(tool)


def test_partial_session_is_completed(
    short_stretches: None, tool: StudyWindow, qtbot: QtBot, monkeypatch: pytest.MonkeyPatch
):
    def cancelled(control: Control) -> Progress:
        def progress(what: str, done: int, total: int) -> None:
            if (what, done) == ("measuring", 2):
                control.cancelled.set()
            control.progress(done, total, what)

        return progress

    with monkeypatch.context() as patched:
        patched.setattr(study_window, "progress_of", cancelled)
        tool.list.selectRow(0)
        QTest.mouseClick(tool.open_button, Qt.MouseButton.LeftButton)
        qtbot.waitUntil(lambda: not tool.working, timeout=PATIENCE_MS)
    assert tool.workspace.session is None
    (path,) = tool.study.folder.glob("sessions/*.labsession")
    with Session.open(path) as partial:
        assert len(partial.stale_frames()) == FRAMES - 2
    session = open_it(tool, qtbot)
    assert session.path == path
    assert not len(session.stale_frames())
    assert shows_what_the_study_measured(tool)


def test_session_with_work_of_the_operator_is_kept(tool: StudyWindow, file: Path, qtbot: QtBot):
    mine = open_it(tool, qtbot)
    mine.set_record(replace(mine.record, notes="look at frame 3"))
    tool.open_beside()
    other = open_it(tool, qtbot)
    assert (mine.path.name, other.path.name) == ("I80.labsession", "I80 2.labsession")
    assert "I80 is kept" in tool.message.text()
    assert shows_what_the_study_measured(tool)
    run(tool, write(file, 'scheme = "ers"'), qtbot)
    assert open_it(tool, qtbot).path == other.path
    assert shows_what_the_study_measured(tool)
    with Session.open(mine.path) as kept:
        assert kept.record.notes == "look at frame 3"
        assert kept.settings.scheme == "fit"
        assert np.isfinite(kept.overview().measures["height_mm"]).all()


def test_session_that_is_in_use_or_cannot_be_read_is_kept(
    tool: StudyWindow, file: Path, qtbot: QtBot
):
    path = open_it(tool, qtbot).path
    tool.workspace.show(None)
    run(tool, write(file, 'scheme = "ers"'), qtbot)
    with Session.open(path):
        assert open_it(tool, qtbot).path.name == "I80 2.labsession"
        assert "I80 is kept" in tool.message.text()
    tool.workspace.show(None)
    path.write_bytes(b"no session")
    tool.open_beside()
    assert open_it(tool, qtbot).path.name == "I80 2.labsession"
    assert path.read_bytes() == b"no session"


def test_changed_recording_is_refused_until_the_study_is_run_again(
    tool: StudyWindow, file: Path, qtbot: QtBot
):
    recording = file.parent / "bench" / "recording.avi"
    recording.write_bytes(recording.read_bytes() + b"\0")
    tool.list.selectRow(0)
    QTest.mouseClick(tool.open_button, Qt.MouseButton.LeftButton)
    qtbot.waitUntil(lambda: not tool.working, timeout=PATIENCE_MS)
    assert tool.workspace.session is None
    assert "run again" in tool.message.text()
    qtbot.waitUntil(lambda: not tool.looks.active, timeout=PATIENCE_MS)


def test_reading_stopped_by_closing_is_repeated(tool: StudyWindow, file: Path, qtbot: QtBot):
    tool.show_study(file)
    tool.close()
    assert not tool.looks.active
    assert tool.summary is None
    tool.open_beside()
    qtbot.waitUntil(lambda: tool.summary is not None, timeout=PATIENCE_MS)
    qtbot.waitUntil(lambda: not tool.looks.active, timeout=PATIENCE_MS)
