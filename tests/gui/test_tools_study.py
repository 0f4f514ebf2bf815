"""The study window: creating from a folder, running, stopping, opening a recording."""

from __future__ import annotations

import shutil
import threading
from pathlib import Path
from typing import Any

import pytest
from PySide6.QtCore import QMimeData, QPoint, QPointF, Qt, QUrl
from PySide6.QtGui import QDragEnterEvent, QDropEvent
from PySide6.QtTest import QTest
from PySide6.QtWidgets import QApplication, QPushButton
from pytestqt.qtbot import QtBot

from labapp.core.surface.measures import SIZES
from labapp.gui.shell.window import MainWindow
from labapp.gui.tools.study import StudyWindow
from labapp.run.study.plan import write_study
from labapp.run.study.status import StudyProgress
from labapp.run.study.study import Study
from labapp.run.study.summary import GroupSummary, Mean, RecordingSummary, StudySummary
from labapp.studies.tables import Table
from tests.simulated_recordings import simulated_recording
from tests.waiting import PATIENCE_S

pytestmark = pytest.mark.slow

PATIENCE_MS = round(1000 * PATIENCE_S)
RIGHT = Qt.AlignmentFlag.AlignRight


@pytest.fixture(scope="module")
def simulated(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return simulated_recording(tmp_path_factory.mktemp("simulated"), 3)


@pytest.fixture
def recordings(simulated: Path, tmp_path: Path) -> Path:
    """Two recordings at different currents, and an invalid one."""
    folder = tmp_path / "runs"
    for current in (80, 100):
        shutil.copytree(simulated, folder / f"I{current}_1")
    (folder / "I120_1").mkdir()
    (folder / "I120_1" / "recording.avi").write_bytes(b"RIFF no video at all" * 20)
    return folder


@pytest.fixture
def study(window: MainWindow, qtbot: QtBot) -> StudyWindow:
    window.do("study")
    tool = window.findChild(StudyWindow)
    assert tool is not None
    qtbot.waitUntil(tool.isVisible)
    return tool


def click(button: QPushButton) -> None:
    QTest.mouseClick(button, Qt.MouseButton.LeftButton)


def drop(tool: StudyWindow, *paths: Path) -> None:
    """Drop files on the window, as the desktop does."""
    data = QMimeData()
    data.setUrls([QUrl.fromLocalFile(str(path)) for path in paths])
    button, none = Qt.MouseButton.LeftButton, Qt.KeyboardModifier.NoModifier
    copied = Qt.DropAction.CopyAction, data, button, none
    entered = QDragEnterEvent(QPoint(9, 9), *copied)
    QApplication.sendEvent(tool, entered)
    assert entered.isAccepted()
    QApplication.sendEvent(tool, QDropEvent(QPointF(9, 9), *copied))


def is_idle(tool: StudyWindow) -> bool:
    return not tool.working and not tool.looks.active


def make(tool: StudyWindow, recordings: Path, qtbot: QtBot) -> None:
    tool.take_folder(recordings)
    assert Path(tool.setup.value()).name == "setup.toml"
    tool.recordings.set_value(str(recordings / "I{current_a}_*" / "recording.avi"))
    tool.make(recordings / "study.toml")
    qtbot.waitUntil(lambda: len(tool.found) == 3 and is_idle(tool), timeout=PATIENCE_MS)


def states(tool: StudyWindow) -> dict[str, str]:
    return {one.recording.name: one.state for one in tool.found}


def test_study_is_created_and_run_and_a_recording_opened(
    window: MainWindow, study: StudyWindow, recordings: Path, qtbot: QtBot
):
    assert not study.start_button.isEnabled()
    make(study, recordings, qtbot)
    assert set(states(study).values()) == {"waiting"}
    assert not study.tabs.isTabEnabled(1)
    study.workers.set_value(1)
    click(study.start_button)
    assert study.working
    qtbot.waitUntil(lambda: is_idle(study) and study.summary is not None, timeout=4 * PATIENCE_MS)
    assert states(study) == {"I80_1": "done", "I100_1": "done", "I120_1": "failed"}
    assert [study.means.table.rows[k][0] for k in range(2)] == ["80", "100"]
    assert study.tabs.tabText(3) == "Outliers: none"
    assert (study.study.folder / "measures.parquet" / "I80_1.parquet").exists()
    row = next(k for k, cells in enumerate(study.list.table.rows) if cells[0] == "I120_1")
    assert study.list.table.rows[row][-1]
    study.list.selectRow(row)
    assert not study.open_button.isEnabled()
    study.list.selectRow(next(k for k in range(3) if study.list.table.rows[k][0] == "I100_1"))
    click(study.open_button)
    workspace = study.workspace
    qtbot.waitUntil(
        lambda: workspace.session is not None and is_idle(study), timeout=4 * PATIENCE_MS
    )
    assert workspace.session.record.current_a == 100
    overview = workspace.session.overview()
    assert list(overview.status) == ["ok"] * 3
    assert not study.isVisible()
    window.do("study")
    assert study.isVisible()
    assert study.list.selectedItems()
    assert study.open_button.isEnabled()
    page = study.study.folder / "summary.html"
    page.unlink()
    click(study.page_button)
    assert str(page) in study.message.text()
    qtbot.waitUntil(lambda: is_idle(study))
    click(study.start_button)
    qtbot.waitUntil(lambda: page.exists() and is_idle(study), timeout=4 * PATIENCE_MS)


def test_dropped_files_are_opened_or_filled_in(
    study: StudyWindow, recordings: Path, tmp_path: Path, qtbot: QtBot
):
    recording = recordings / "I80_1" / "recording.avi"
    setup = shutil.copy(recordings / "I80_1" / "setup.toml", tmp_path / "bench.toml")
    drop(study, recording, setup)
    assert [study.recordings.value(), study.setup.value()] == [str(recording), str(setup)]
    assert study.matches.text().startswith("1 recording")
    drop(study, recordings)
    assert study.recordings.value() == str(recordings / "*" / "recording.avi")
    assert study.study is None
    file = tmp_path / "study.toml"
    write_study(file, [str(recordings / "*" / "recording.avi")], setup)
    drop(study, file)
    qtbot.waitUntil(lambda: len(study.found) == 3 and is_idle(study), timeout=PATIENCE_MS)
    assert study.study.path == file


def test_stopped_run_keeps_finished_recordings(study: StudyWindow, recordings: Path, qtbot: QtBot):
    make(study, recordings, qtbot)
    study.workers.set_value(1)
    click(study.start_button)
    folder = study.study.folder / "recordings"
    qtbot.waitUntil(lambda: any(folder.glob("*.json")), timeout=PATIENCE_MS)
    click(study.cancel_button)
    qtbot.waitUntil(lambda: is_idle(study), timeout=PATIENCE_MS)
    assert study.message.text() == "Stopped"
    assert study.start_button.isEnabled()
    assert any(folder.glob("*.json"))
    assert "failed" not in [states(study)[name] for name in ("I80_1", "I100_1")]


def test_means_fit_into_the_window(study: StudyWindow, qtbot: QtBot):
    sizes = [f"{size}_mm" for size in ("width", "length", "height", "depth", "reach", "rise")]
    columns = ("current_a", "gas", "Recordings", "Frames", *sizes)
    row = ("80", "Ar", "5", "1000", *["6.12345 ± 0.00012"] * len(sizes))
    study.resize(1120, 700)
    study.tabs.setTabEnabled(2, True)
    study.tabs.setCurrentWidget(study.means)
    study.means.show_table(Table("summary", "Means", columns, (row,) * 8))
    header = study.means.horizontalHeader()
    qtbot.waitUntil(lambda: header.length() == study.means.viewport().width())
    needed = study.means.fontMetrics().horizontalAdvance("± 0.00012")
    assert min(map(header.sectionSize, range(len(columns)))) > needed
    assert study.means.rowHeight(0) >= 2 * study.means.fontMetrics().height()


def test_invalid_studies_are_rejected(study: StudyWindow, recordings: Path, tmp_path: Path):
    (tmp_path / "wrong.toml").write_text("recordings = 1\n", "utf-8")
    study.show_study(tmp_path / "wrong.toml")
    assert study.study is None
    assert "recordings" in study.message.text()
    study.take_folder(tmp_path)
    assert not study.recordings.value()
    study.recordings.set_value(str(tmp_path / "none_*.avi"))
    study._show_matches()
    assert study.matches.text().startswith("⚠")
    study.recordings.set_value(str(tmp_path / f"{'long' * 80}_*.avi"))
    study._show_matches()
    assert study.matches.text().startswith("⚠")
    study.take_folder(recordings)
    assert not study.message.text()
    study.setup.set_value(str(tmp_path / "none.toml"))
    study.make(tmp_path / "new.toml")
    assert "none.toml" in study.message.text()
    assert not (tmp_path / "new.toml").exists()


def one_recording(recordings: Path) -> Path:
    """Write a study of one recording, without conditions: its table is smaller."""
    path = recordings / "other.toml"
    text = 'setup = "I80_1/setup.toml"\n[[recording]]\nfile = "I80_1/recording.avi"\n'
    path.write_text(text, "utf-8")
    return path


def names(tool: StudyWindow) -> list[str]:
    return [one.recording.name for one in tool.found]


def test_another_study_is_opened_while_a_recording_is_selected(
    study: StudyWindow, recordings: Path, qtbot: QtBot
):
    make(study, recordings, qtbot)
    study.list.selectRow(0)
    study.show_study(one_recording(recordings))
    qtbot.waitUntil(lambda: len(study.found) == 1 and is_idle(study), timeout=PATIENCE_MS)
    assert not study.list.selectedItems()
    assert study.message.text().endswith("other.toml")


def test_plots_of_another_study_are_not_shown(study: StudyWindow, recordings: Path, qtbot: QtBot):
    make(study, recordings, qtbot)
    means = dict.fromkeys(SIZES, Mean(5.0, 0.1, 0.1, 0.1, 0.1, 3))
    name = study.found[0].recording.name
    one = RecordingSummary(study.found[0], {"ok": 3}, "", "", means)
    group = GroupSummary({"current_a": 80.0}, (name,), 3, means)
    study._show_summary(StudySummary("study", ("current_a",), (one,), (group,), ()))
    assert not study.sheet._printed.isNull()
    study.show_study(one_recording(recordings))
    assert study.sheet._printed.isNull()
    study._show_summary(StudySummary("study", ("current_a",), (one,), (group,), ()))
    study._show_summary(StudySummary("other", (), (), (), ()))
    assert study.sheet._printed.isNull()
    assert "surface" in study.sheet._paper.text()


def test_progress_of_a_run_is_not_shown_in_another_study(
    study: StudyWindow, recordings: Path, qtbot: QtBot, monkeypatch: pytest.MonkeyPatch
):
    other_is_shown, end = threading.Event(), threading.Event()

    def run(self: Study, *_: object, progress: Any, note: Any, **__: object) -> Any:
        other_is_shown.wait(PATIENCE_S)
        progress(StudyProgress(1, 6, 0, 3, 0))
        note("reported")
        end.wait(PATIENCE_S)
        return self.status()

    monkeypatch.setattr(Study, "run", run)
    make(study, recordings, qtbot)
    click(study.start_button)
    study.show_study(one_recording(recordings))
    qtbot.waitUntil(lambda: names(study) == ["recording"], timeout=PATIENCE_MS)
    with qtbot.waitSignal(study.workspace.notified, timeout=PATIENCE_MS):
        other_is_shown.set()
    assert names(study) == ["recording"]
    end.set()
    qtbot.waitUntil(lambda: is_idle(study), timeout=PATIENCE_MS)
    assert names(study) == ["recording"]
    assert study.message.text().startswith("study: ")


def test_numbers_of_the_means_are_right_aligned(study: StudyWindow):
    columns = ("current_a", "gas", "repeat", "width_mm", "height_mm")
    rows = (("80", "Ar", "1", "5.003 ± 0.010", "–"), ("–", "CO2", "b", "−5.1", "0.3 ± 0.1"))
    study.means.show_table(Table("summary", "Means", columns, rows))
    right = [
        [bool(study.means.item(row, column).textAlignment() & RIGHT) for column in range(5)]
        for row in range(2)
    ]
    assert right == [[True, False, False, True, True]] * 2
