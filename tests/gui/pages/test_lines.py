"""Correcting the lines of a frame by hand on the pattern page."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest
from PySide6.QtCore import QEvent, QPoint, QPointF, Qt
from PySide6.QtTest import QTest
from PySide6.QtWidgets import QApplication, QHBoxLayout, QWidget
from pytestqt.qtbot import QtBot

from labapp.export.line_results import line_rows
from labapp.gui.pages.dots.fitting import Processes, Refit
from labapp.gui.pages.dots.line_presenter import show_lines
from labapp.gui.pages.dots.page import DotsPage
from labapp.gui.pages.surface.presenter import EITHER_NUMBERS, shown
from labapp.gui.workspace import Workspace
from labapp.session.session import Session
from tests.gui.conftest import KEPT, SAMPLES, let_draw
from tests.setups import FIVE_LINES as SETUP

SHIFT, NONE = Qt.KeyboardModifier.ShiftModifier, Qt.KeyboardModifier.NoModifier


def arcs() -> np.ndarray:
    """Three arched lines, 60 px apart; the lowest has its apex at v = 400."""
    v, u = np.mgrid[:640, :480].astype(float)
    light = 20 + np.random.default_rng(1).normal(size=v.shape)
    for k in range(3):
        distance = v - (400 - 60 * k) - (u - 240) ** 2 / 900
        light += 70 * np.exp(-(distance**2) / 18) * (abs(u - 240) < 150)
    return np.clip(light, 0, 255).astype(np.uint8)


@pytest.fixture
def page(qtbot: QtBot, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[DotsPage]:
    monkeypatch.setattr(Processes, "begin", lambda self: None)
    monkeypatch.setattr(Refit, "_fit", lambda self, frame: None)
    (tmp_path / "frames").mkdir()
    cv2.imwrite(str(tmp_path / "frames" / "0.png"), arcs())
    with Session.create(tmp_path / "lines.labsession") as session:
        session.set_setup(SETUP)
        session.import_recording(tmp_path / "frames")
        for _ in session.measure():
            pass
    workspace = Workspace()
    page = DotsPage(workspace)
    workspace.changed.connect(lambda: page.refresh() if workspace.session else None)
    container = QWidget()
    layout = QHBoxLayout(container)
    layout.addWidget(page, 1)
    layout.addWidget(page.panel)
    KEPT.append(container)
    container.resize(1300, 900)
    container.show()
    container.activateWindow()
    qtbot.waitExposed(container)
    workspace.show(Session.open(tmp_path / "lines.labsession"))
    page.refresh()
    qtbot.waitUntil(lambda: len(page.line_tool.state.lines) == 3)
    let_draw()
    page.view.setFocus()
    yield page
    page.leave()
    workspace.close()


def click(page: DotsPage, u: float, v: float, modifier: Qt.KeyboardModifier = NONE) -> None:
    port: QPoint = page.view.canvas.mapFromScene(page.view.box.mapViewToScene(QPointF(u, v)))
    QTest.mouseClick(page.view.canvas.viewport(), Qt.MouseButton.LeftButton, modifier, port)
    let_draw()


def press(page: DotsPage, key: Qt.Key, modifier: Qt.KeyboardModifier = NONE) -> None:
    QApplication.sendEvent(page.view.canvas, QEvent(QEvent.Type.Leave))
    QTest.keyClick(page.view, key, modifier)
    let_draw()


def lines(page: DotsPage) -> list[str]:
    return [line.name for line in page.line_tool.state.lines]


def test_cut_join_number_and_delete_can_each_be_undone(page: DotsPage) -> None:
    session, workspace = page.session, page.workspace
    assert session.corrected_frames().tolist() == []
    press(page, Qt.Key.Key_C)
    click(page, 240, 340)
    assert lines(page) == ["(1)", "(2)", "(3)", "(4)"]
    click(page, 170, 345)
    click(page, 310, 345, SHIFT)
    assert len(page.line_tool.chosen) == 2
    press(page, Qt.Key.Key_J)
    assert len(lines(page)) == 3
    click(page, 240, 400)
    page.line_tool.number(2)
    assert lines(page)[0] == "2"
    click(page, 240, 280)
    press(page, Qt.Key.Key_Delete)
    assert len(lines(page)) == 2
    assert session.corrected_frames().tolist() == [0]
    assert page.line_tool.state.due
    assert [change.label.split(",")[0] for change in session.history][-4:] == [
        *("cut a line", "join two lines", "number a line", "delete lines")
    ]
    for count in (3, 3, 4, 3):
        workspace.undo()
        assert len(lines(page)) == count
    assert session.corrected_frames().tolist() == []


def test_buttons_without_their_selection_are_disabled(page: DotsPage) -> None:
    buttons = page.lines_panel.buttons
    assert buttons["Cut"].isEnabled()
    assert not buttons["Join"].isEnabled()
    assert not buttons["Back to automatic"].isEnabled()
    page.lines_panel.lines.selectAll()
    assert page.line_tool.chosen == [0, 1, 2]
    assert buttons["Delete"].isEnabled()
    assert not buttons["Join"].isEnabled()


def test_corrected_frame_is_measured_with_its_correction(page: DotsPage) -> None:
    session = page.session
    click(page, 240, 280)
    press(page, Qt.Key.Key_Delete)
    correction = session.line_correction(0)
    assert correction is not None
    for _ in session.measure():
        pass
    page.refresh()
    assert not page.line_tool.state.due
    assert page.line_tool.state.by_hand
    assert len(lines(page)) == 2
    press(page, Qt.Key.Key_Backspace, Qt.KeyboardModifier.ControlModifier)
    assert len(lines(page)) == 3
    assert session.corrected_frames().tolist() == []


def test_lines_of_a_frame_have_unique_numbers(tmp_path: Path) -> None:
    sample = SAMPLES / "five_lines"
    shutil.copytree(sample, tmp_path / "five_lines")
    with Session.open(tmp_path / "five_lines" / "five_lines.labsession") as session:
        folded = 0
        for frame in range(64):
            lines = show_lines(session, frame).lines
            numbers = [line.name.strip("()") for line in lines if line.name != "–"]
            assert len(set(numbers)) == len(numbers), frame
            folded += any(line.name == "–" for line in lines)
        assert folded


def test_lines_with_open_numbers_have_a_height_and_no_numbers(tmp_path: Path) -> None:
    shutil.copytree(SAMPLES / "five_lines", tmp_path / "five_lines")
    with Session.open(tmp_path / "five_lines" / "five_lines.labsession") as session:
        numbered = {True: 0, False: 0}
        for frame in range(64):
            result = session.result(frame)
            assert result is not None
            assert result.measurement.lines is not None
            found = result.measurement.lines
            if found.status != "ok":
                continue
            assert found.surface is not None
            certain = found.surface.numbered
            numbered[certain] += 1
            state = shown(session, frame)
            assert state.state == "measured"
            assert (EITHER_NUMBERS in state.words) != certain
            assert state.sizes[0].name in ("Height", "Depth")
            names = [line.name for line in show_lines(session, frame).lines]
            assert any("(" in name for name in names) != certain
            rows = line_rows(frame, found, session.setup.calibration)
            assert all((row[2] == "") != certain for row in rows if row[-1] == "0")
    assert min(numbered.values()) > 3
