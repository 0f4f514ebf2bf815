"""Text from files is shown literally, never as HTML."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PySide6 import QtGui
from PySide6.QtCore import QAbstractItemModel, QAbstractListModel, QModelIndex, Qt
from PySide6.QtGui import QAction
from PySide6.QtWidgets import QAbstractItemView, QComboBox, QLabel, QWidget
from pytestqt.qtbot import QtBot

import labapp.gui
from labapp.gui.shell.steps import STEPS
from labapp.gui.shell.window import MainWindow
from labapp.gui.widgets.labels import plain_label, plain_tip
from labapp.session.file.blobs import pack
from labapp.session.session import Session
from labapp.session.signals import Signals
from tests.gui.conftest import CopySample, let_draw

EVIL = "<b>evil</b><img src=x>"

SOURCES = sorted(Path(labapp.gui.__file__).parent.rglob("*.py"))


@pytest.fixture
def evil(copy_sample: CopySample) -> Path:
    """A measured session with HTML in every text that a session can contain."""
    name = EVIL.replace("/", "∕")
    folder = copy_sample("gtaw").parent
    folder = folder.rename(folder.with_name(name))
    (folder / "recording.avi").rename(folder / f"{name}.avi")
    path = (folder / "gtaw.labsession").rename(folder / f"{name}.labsession")
    with Session.open(path) as session:
        texts = dict.fromkeys(("title", "operator", "material", "gas", "notes"), EVIL)
        ticked = ((EVIL, "2026-01-01T12:00:00+00:00"),)
        session.set_record(replace(session.record, **texts, safety=ticked))
        session.set_settings(session.settings, EVIL)
        time_s = np.linspace(0, 1, 5)
        session.set_signals(Signals(EVIL, time_s, 100 + time_s, 10 + time_s))
        recording, result = session.recording, session.result(1)
        assert recording is not None
        assert result is not None
        doubtful = replace(result.measurement, status="no-match", reason=EVIL)
        basis = session._basis()
        assert basis is not None
        session._results.put(0, replace(doubtful, reconstruction=None, measures=None), basis, None)
        altered = replace(
            recording, path=f"{name}.avi", description=EVIL, warnings=(EVIL,), frame_exact=False
        )
        with session._database.transaction() as connection:
            connection.execute("UPDATE recording SET content = ?", (pack(altered),))
    return path


def is_rendered(words: str) -> bool:
    """Whether Qt by default renders the text as HTML with that picture."""
    return "<img" in words and QtGui.Qt.mightBeRichText(words)


def items(model: QAbstractItemModel, parent: QModelIndex) -> Iterator[QModelIndex]:
    columns = 1 if isinstance(model, QAbstractListModel) else model.columnCount(parent)
    for row in range(model.rowCount(parent)):
        for column in range(columns):
            index = model.index(row, column, parent)
            yield index
            yield from items(model, index)


def tips(window: QWidget) -> Iterator[str]:
    """Every tooltip: of widgets, actions, and the items of lists and tables."""
    for widget in (window, *window.findChildren(QWidget)):
        yield widget.toolTip()
        if isinstance(widget, QAbstractItemView | QComboBox) and widget.model() is not None:
            for index in items(widget.model(), QModelIndex()):
                yield str(index.data(Qt.ItemDataRole.ToolTipRole) or "")
    for action in window.findChildren(QAction):
        yield action.toolTip()


def check(window: MainWindow) -> int:
    """Check that no text is rendered as HTML; return how many places show the text."""
    let_draw()
    labels = window.findChildren(QLabel)
    for label in labels:
        rendered = label.textFormat() != Qt.TextFormat.PlainText and "<img" in label.text()
        assert not rendered, label.text()
    tooltips = list(tips(window))
    assert not [tip for tip in tooltips if is_rendered(tip)]
    return sum("img" in words for words in (*tooltips, *(label.text() for label in labels)))


def test_texts_of_a_session_are_not_rendered_as_html(window: MainWindow, evil: Path, qtbot: QtBot):
    assert window.files.open(evil)
    qtbot.waitUntil(lambda: not window.workspace.tasks.active)
    counts: dict[str, int] = {}
    for step in STEPS:
        window.show_step(step.key)
        window.workspace.show_frame(0)
        qtbot.waitUntil(lambda: not window.workspace.tasks.active)
        counts[step.key] = check(window)
    window.say(EVIL, True)
    assert check(window)
    window.do("close")
    qtbot.waitUntil(lambda: not window.workspace.tasks.active)
    counts["welcome"] = check(window)
    for key in ("setup", "capture", "welcome"):
        assert counts[key], f"it was not to be seen on {key}"


def test_labels_are_created_as_plain_text():
    """A plain `QLabel` guesses whether its text is HTML."""
    for path in SOURCES:
        if path.name != "labels.py":
            calls = [
                n for n in ast.walk(ast.parse(path.read_text("utf-8"))) if isinstance(n, ast.Call)
            ]
            assert "QLabel" not in [getattr(call.func, "id", "") for call in calls], path


@pytest.mark.parametrize("words", [EVIL, "a < b", "x &lt;b&gt;", "plain", "first\n<b>second</b>"])
def test_tooltips_show_their_text_literally(qtbot: QtBot, words: str):
    tip = QLabel(plain_tip(words))  # as QToolTip shows it
    document = QtGui.QTextDocument()
    if QtGui.Qt.mightBeRichText(tip.text()):
        document.setHtml(tip.text())
    else:
        document.setPlainText(tip.text())
    assert document.toPlainText() == words
    assert plain_label(words).textFormat() == Qt.TextFormat.PlainText
