"""Modules that the first window loads, and modules that are loaded later."""

from __future__ import annotations

import importlib
import os
import subprocess
import sys
from pathlib import Path

import pytest

from labapp.gui import app, compiling
from tests.gui.conftest import CopySample

pytestmark = pytest.mark.usefixtures("state")  # the user's drafts load more modules

FOR_LATER = {
    *("scipy", "cv2", "av", "pyqtgraph", "matplotlib", "pyvista", "vtkmodules"),
    *("h5py", "tifffile", "pywt", "reportlab", "labapp.core.pipeline", "labapp.session.session"),
}
"""Modules that each take from some hundredths of a second to one second to load."""

NOT_FOR_A_SURFACE = {"h5py", "tifffile", "pywt", "reportlab"}

FIRST_WINDOW = """
import sys
from pathlib import Path
from labapp import cli
from labapp.gui.app import start_app
from labapp.gui.preferences import Preferences
app = start_app()
from labapp.gui.shell.commands import make_window
window = make_window(Preferences(), Path(sys.argv[1]))
window.show()
app.processEvents()
print(*sys.modules)
"""

SURFACE_PAGE = """
import sys
import labapp.session.session
import labapp.gui.pages.surface.page
print(*sys.modules)
"""

STOPPED = """
import os, signal, sys
from pathlib import Path
from labapp.gui.app import open_window, start_app
from labapp.gui.preferences import Preferences
app = start_app()
from PySide6.QtCore import QTimer
with open_window(app, Preferences(), Path(sys.argv[1])) as window:
    QTimer.singleShot(0, window, lambda: os.kill(os.getpid(), signal.SIGTERM))
    ended = app.exec()
print(ended, window.isVisible(), Path(sys.argv[1]).exists())
"""

STOPPED_WHILE_OPENING = """
import os, signal, sys
from pathlib import Path
from labapp.gui.app import open_window, start_app
from labapp.gui.preferences import Preferences
app = start_app()
with open_window(app, Preferences(), Path(sys.argv[1]), Path(sys.argv[2])) as window:
    window.workspace.notified.connect(lambda text, _: print("said", text))
    window.workspace.opened.connect(lambda: os.kill(os.getpid(), signal.SIGTERM))
    ended = app.exec()
print(ended, window.isVisible())
"""

GARBAGE = """
import sys, threading
from pathlib import Path
from labapp.gui.app import open_window, start_app
from labapp.gui.preferences import Preferences
app = start_app()
from PySide6.QtCore import QTimer
threads = []

class Circle:
    def __init__(self):
        self.self = self
    def __del__(self):
        threads.append(threading.current_thread().name)

def work():
    Circle()
    objects = [[] for _ in range(100_000)]  # Python would collect at one of them

with open_window(app, Preferences(), Path(sys.argv[1])) as window:
    worker = threading.Thread(target=work, name="worker")
    worker.start()
    worker.join()
    print(*threads or ["none"])
    look = QTimer(window)
    look.timeout.connect(lambda: threads and window.close())
    look.start(10)
    app.exec()
print(*threads)
"""


def words_of(program: str, *arguments: object) -> set[str]:
    """Words that a program prints, such as the names of the modules it has loaded."""
    process = subprocess.run(
        [sys.executable, "-c", program, *map(str, arguments)],
        capture_output=True,
        text=True,
        check=True,
        env={**os.environ, "QT_QPA_PLATFORM": "offscreen"},
    )
    return set(process.stdout.split())


def test_first_window_loads_no_module_of_the_pages(tmp_path: Path):
    modules = words_of(FIRST_WINDOW, tmp_path / "preferences.json")
    assert "labapp.gui.pages.welcome" in modules
    assert modules & FOR_LATER == set()


def test_surface_page_loads_no_modules_for_other_files():
    modules = words_of(SURFACE_PAGE)
    assert "scipy" in modules
    assert modules & NOT_FOR_A_SURFACE == set()


def test_sigterm_closes_the_window(tmp_path: Path):
    assert words_of(STOPPED, tmp_path / "preferences.json") == {"0", "False", "True"}


def test_stop_signal_waits_until_a_session_is_open(tmp_path: Path, copy_sample: CopySample):
    arguments = (tmp_path / "preferences.json", copy_sample("gtaw"))
    assert words_of(STOPPED_WHILE_OPENING, *arguments) == {"0", "False"}


def test_widgets_are_deleted_in_the_main_thread_only(tmp_path: Path):
    """A widget that a worker thread deletes can deadlock with the window."""
    assert words_of(GARBAGE, tmp_path / "preferences.json") == {"none", "MainThread"}


def test_closed_app_loads_no_more_modules(monkeypatch: pytest.MonkeyPatch) -> None:
    loaded: list[str] = []
    monkeypatch.setattr(app, "NEEDED_LATER", ("first", "second", "third"))
    monkeypatch.setattr(importlib, "import_module", loaded.append)
    monkeypatch.setattr(compiling, "not_compiled", list)
    app._load_what_is_needed(lambda _: None, lambda: len(loaded) == 2)
    assert loaded == ["first", "second"]
