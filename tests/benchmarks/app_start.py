"""The app in its own process, for `app.py`: prints when it is usable, and when 3-D is drawn.

``app_start.py BEGAN bare|app|file|later [SESSION]``, BEGAN by `time.monotonic`, s.
"""

from __future__ import annotations

import sys
import time
from pathlib import Path
from typing import Any

POLL_MS = 2
LATER_MS = 3000


def print_time(name: str, since: float, cpu_start: float = 0.0) -> None:
    """Print the elapsed time and the processor time, s."""
    print(name, time.monotonic() - since)
    print(f"{name}_cpu", time.process_time() - cpu_start)
    sys.stdout.flush()


def bare(began: float) -> None:
    """Show an empty Qt window."""
    from PySide6.QtCore import QTimer
    from PySide6.QtWidgets import QApplication, QMainWindow

    app = QApplication([])
    window = QMainWindow()
    window.resize(1600, 1000)
    window.show()

    def look() -> None:
        handle = window.windowHandle()
        if handle is not None and handle.isExposed():
            timer.stop()
            QTimer.singleShot(0, lambda: (print_time("usable", began), app.quit()))

    timer = QTimer()
    timer.timeout.connect(look)
    timer.start(POLL_MS)
    app.exec()


class WindowWatcher:
    """Checks the app's window every 2 ms."""

    def __init__(self, app: Any, began: float, kind: str, session: Path | None) -> None:
        from PySide6.QtCore import QTimer

        self._app, self._kind, self._session = app, kind, session
        self._since = began, 0.0
        self._usable = False
        self._timer = QTimer(app)
        self._timer.timeout.connect(self._look)
        self._timer.start(POLL_MS)

    def _look(self) -> None:
        from labapp.gui.shell.window import MainWindow

        for window in self._app.topLevelWidgets():
            if isinstance(window, MainWindow):
                handle = window.windowHandle()
                if self._usable:
                    self._look_for_surface(window)
                elif handle is not None and handle.isExposed():
                    self._report_usable(window)

    def _report_usable(self, window: Any) -> None:
        from PySide6.QtCore import QTimer

        self._usable = True
        print_time("usable", *self._since)
        if self._kind == "app":
            window.close()
        elif self._kind == "later":
            QTimer.singleShot(LATER_MS, self._app, lambda: self._open(window))

    def _open(self, window: Any) -> None:
        self._since = time.monotonic(), time.process_time()
        window.files.open(self._session)

    def _look_for_surface(self, window: Any) -> None:
        drawing = getattr(getattr(window.page, "view", None), "_drawing", None)
        if drawing and drawing.plotter.renderer.GetLastRenderTimeInSeconds() > 0:
            self._timer.stop()
            print_time("drawn", *self._since)
            window.close()


def start(began: float, kind: str, session: Path | None) -> None:
    """Run the command with a watcher."""
    from labapp import cli
    from labapp.gui import app as gui_app

    start_original = gui_app.start_app
    watchers = []

    def start_app() -> Any:
        app = start_original()
        watchers.append(WindowWatcher(app, began, kind, session))
        return app

    gui_app.start_app = start_app
    cli.main([str(session)] if kind == "file" else [])


if __name__ == "__main__":
    first, how, *others = sys.argv[1:]
    if how == "bare":
        bare(float(first))
    else:
        start(float(first), how, Path(others[0]) if others else None)
