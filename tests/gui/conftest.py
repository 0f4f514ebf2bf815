"""Fixtures of the GUI tests, which run without a screen."""

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
from tests.gui.leaks import LeakCheck
from tests.waiting import PATIENCE_S

SAMPLES = Path(__file__).parents[2] / "sample_sessions"

PATIENCE_MS = round(1000 * PATIENCE_S)

KEPT: list[object] = []
"""Objects that must live until the test ends: Python could delete them earlier."""

CopySample = Callable[[str], Path]


class PatientBot(QtBot):
    """Waits up to `PATIENCE_S`; pytest-qt's five seconds are too short on a busy machine."""

    def waitUntil(self, callback: Callable[[], bool | None], **kwargs: Any) -> None:  # noqa: N802
        super().waitUntil(callback, timeout=kwargs.get("timeout", PATIENCE_MS))

    def waitSignal(self, signal: Any, **kwargs: Any) -> Any:  # noqa: N802
        return super().waitSignal(signal, **{"timeout": PATIENCE_MS, **kwargs})

    def waitExposed(self, widget: QWidget, **kwargs: Any) -> Any:  # noqa: N802
        return super().waitExposed(widget, **{"timeout": PATIENCE_MS, **kwargs})


def let_draw() -> None:
    """Process events until layout and painting are done: each level of nesting takes one event."""
    for _ in range(20):
        QTest.qWait(1)


@pytest.fixture
def qtbot(qapp: QApplication, request: pytest.FixtureRequest) -> QtBot:
    return PatientBot(request)


@pytest.fixture
def copy_sample(tmp_path: Path) -> CopySample:
    """Copy a sample with its recording: (name) -> its session file."""

    def copy(name: str) -> Path:
        folder = tmp_path / "samples" / name
        shutil.copytree(SAMPLES / name, folder)
        return folder / f"{name}.labsession"

    return copy


@pytest.fixture(autouse=True, scope="session")
def garbage_by_hand() -> Iterator[None]:
    """Disable automatic garbage collection, as the app does: no worker may delete a widget."""
    gc.disable()
    yield
    gc.enable()


@pytest.fixture(autouse=True)
def nothing_left(qapp: QApplication, tmp_path: Path) -> Iterator[None]:
    """Fail a test that leaves threads, processes, running timers or open files behind."""
    with pytest.MonkeyPatch.context() as patched:
        check = LeakCheck(tmp_path, patched)
        yield
        leaks = check.leaks()
    assert not leaks, leaks


@pytest.fixture(autouse=True)
def no_windows(nothing_left: None) -> Iterator[None]:
    """Leave no window in view (the app would end when the last one closes) and none in memory."""
    gc.freeze()  # skips the modules: scanning them after each test would take a fifth of its time
    yield
    for widget in QApplication.topLevelWidgets():
        widget.hide()
    for widget in KEPT:
        if isinstance(widget, QWidget) and isValid(widget) and widget.parent() is None:
            for view in widget.findChildren(GraphicsView):
                view.close()  # releases its items, which Python and Qt would both destroy
            widget.deleteLater()
    QCoreApplication.sendPostedEvents(None, QEvent.Type.DeferredDelete)
    KEPT.clear()
    gc.collect()
    gc.unfreeze()  # Hypothesis searches all objects for those that refer to its random numbers


@pytest.fixture
def window(qapp: QApplication, tmp_path: Path, state: Path) -> Iterator[MainWindow]:
    """The window as at the first start; closed after the test."""
    main_window = make_window(Preferences(theme="dark"), tmp_path / "config" / "preferences.json")
    KEPT.append(main_window)
    main_window.resize(1280, 760)
    main_window.show()
    yield main_window
    main_window.close()
    assert not main_window.workspace.tasks.active
