"""Windows are tested without a screen."""

from __future__ import annotations

import gc
import os

os.environ.setdefault("QT_QPA_PLATFORM", "offscreen")

import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from pyqtgraph import GraphicsView
from PySide6.QtCore import QCoreApplication, QEvent
from PySide6.QtTest import QTest
from PySide6.QtWidgets import QApplication, QWidget
from pytestqt.qtbot import QtBot
from shiboken6 import isValid

from labapp.gui.preferences import Preferences
from labapp.gui.shell.commands import make_window
from labapp.gui.shell.window import MainWindow
from tests.gui.leaks import Left
from tests.waiting import PATIENCE_S

SAMPLES = Path(__file__).parents[2] / "sample_sessions"

PATIENCE_MS = round(1000 * PATIENCE_S)

KEPT: list[object] = []
"""What is to live until its test ends: Python would let go of it when it likes."""

CopySample = Callable[[str], Path]


class PatientBot(QtBot):
    """Waits as long as tests do; pytest-qt's five seconds are short on a busy machine."""

    def waitUntil(self, callback: Callable[[], bool | None], **given: Any) -> None:  # noqa: N802
        super().waitUntil(callback, timeout=given.get("timeout", PATIENCE_MS))

    def waitSignal(self, signal: Any, **given: Any) -> Any:  # noqa: N802
        return super().waitSignal(signal, **{"timeout": PATIENCE_MS, **given})

    def waitExposed(self, widget: QWidget, **given: Any) -> Any:  # noqa: N802
        return super().waitExposed(widget, **{"timeout": PATIENCE_MS, **given})


def let_draw() -> None:
    """Let what is shown be laid out and painted: each level of nesting is an event of its own."""
    for _ in range(20):
        QTest.qWait(1)


@pytest.fixture
def qtbot(qapp: QApplication, request: pytest.FixtureRequest) -> QtBot:
    return PatientBot(request)


@pytest.fixture
def copy_sample(tmp_path: Path) -> CopySample:
    """Copy a sample with its recording: (name) -> its session file."""

    def copied(name: str) -> Path:
        folder = tmp_path / "samples" / name
        shutil.copytree(SAMPLES / name, folder)
        return folder / f"{name}.labsession"

    return copied


@pytest.fixture(autouse=True, scope="session")
def garbage_by_hand() -> Iterator[None]:
    """As in the app: Python collects in no thread of work, where widgets would be destroyed."""
    gc.disable()
    yield
    gc.enable()


@pytest.fixture(autouse=True)
def nothing_left(qapp: QApplication, tmp_path: Path) -> Iterator[None]:
    """Fail a test that leaves threads, processes, ticking timers or open files behind."""
    with pytest.MonkeyPatch.context() as patched:
        left = Left(tmp_path, patched)
        yield
        found = left.found()
    assert not found, found


@pytest.fixture(autouse=True)
def no_windows(nothing_left: None) -> Iterator[None]:
    """Leave none in view: an app that is tested ends when the last one goes. And none in memory."""
    gc.freeze()  # modules: to look through them after each test would take a fifth of its time
    yield
    for widget in QApplication.topLevelWidgets():
        widget.hide()
    for widget in KEPT:
        if isinstance(widget, QWidget) and isValid(widget) and widget.parent() is None:
            for view in widget.findChildren(GraphicsView):
                view.close()  # lets go of its items, which Python and Qt would both destroy
            widget.deleteLater()
    QCoreApplication.sendPostedEvents(None, QEvent.Type.DeferredDelete)
    KEPT.clear()
    gc.collect()


@pytest.fixture
def window(qapp: QApplication, tmp_path: Path, state: Path) -> Iterator[MainWindow]:
    """The window as it is at the first start; closed after the test."""
    made = make_window(Preferences(theme="dark"), tmp_path / "config" / "preferences.json")
    KEPT.append(made)
    made.resize(1280, 760)
    made.show()
    yield made
    made.close()
    assert not made.workspace.tasks.active
