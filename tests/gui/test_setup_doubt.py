"""Pages warn if the recording of a session contradicts its set-up."""

from __future__ import annotations

from pathlib import Path

import pytest
from PySide6.QtWidgets import QLabel
from pytestqt.qtbot import QtBot

from labapp.gui.pages.setup.presenter import shown
from labapp.gui.shell.window import MainWindow
from labapp.session.session import Session
from tests.setups import GTAW, OFF, closely_known


@pytest.mark.slow
def test_pages_warn_of_a_doubtful_setup_until_it_is_changed(
    window: MainWindow, qtbot: QtBot, tmp_path: Path
):
    path = tmp_path / "one.labsession"
    with Session.create(path) as session:
        session.set_setup(closely_known(OFF))
        session.import_recording(GTAW / "recording.avi", "0:8")
        list(session.measure_each())

    def warnings(step: str) -> list[str]:
        window.show_step(step)
        texts = [label.text() for label in window.findChildren(QLabel) if label.isVisible()]
        return [text for text in texts if "doubtful" in text]

    assert window.files.open(path)
    for step in ("surface", "trends"):
        qtbot.waitUntil(lambda step=step: bool(warnings(step)))
    assert window.workspace.session is not None
    assert "doubtful" in shown(window.workspace.session).status
    window.workspace.session.set_setup(closely_known({}))
    window.workspace.changed.emit()
    qtbot.waitUntil(lambda: not warnings("trends"))
    assert "doubtful" not in shown(window.workspace.session).status
