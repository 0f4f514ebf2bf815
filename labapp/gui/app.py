"""Start of the app: requirements, the window, and error reporting."""

from __future__ import annotations

import contextlib
import gc
import importlib
import itertools
import logging
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING

from PySide6.QtCore import (
    QMessageLogContext,
    QObject,
    Qt,
    QTimer,
    QtMsgType,
    Signal,
    qInstallMessageHandler,
)
from PySide6.QtGui import QIcon
from PySide6.QtWidgets import QApplication

from labapp.bundled import bundled
from labapp.errors import InputError
from labapp.gui import compiling
from labapp.log import NAME, report_crashes, start_log
from labapp.system import has_display
from labapp.version import VERSION

if TYPE_CHECKING:
    from labapp.gui.preferences import Preferences
    from labapp.gui.shell.window import MainWindow
    from labapp.gui.tasks import Tasks

WITHOUT = "labapp --help lists the commands"

BAD_INPUT = 2

LOAD_AFTER_MS = 300
"""Delay, ms, before modules needed later are loaded; the window and a session are shown first."""

NEEDED_LATER = (
    "labapp.session.frames",
    "labapp.run.measurers",
    *(f"labapp.gui.pages.{key}.page" for key in ("surface", "dots", "trends", "capture", "setup")),
    "pyvistaqt",
)
"""Sessions, pages and 3-D drawing, which take one or two seconds to load."""

HEARTBEAT_MS = 300
"""Interval, ms, at which Python can handle Ctrl-C or SIGTERM and free memory."""


def main(arguments: Sequence[str]) -> int:
    """Open the app, and a session or a recording in it; return when its window is closed.

    Raises
    ------
    InputError
        If the file does not exist or there is no display.
    """
    path = Path(arguments[0]).absolute() if arguments else None
    if path is not None and not path.exists():
        raise InputError(path, "file", "does not exist", "a session, or a recording to import")
    report_crashes()
    app = start_app()

    from labapp.gui.preferences import preferences_file, read_preferences

    file = preferences_file()
    preferences, problem = read_preferences(file)
    with open_window(app, preferences, file, path) as window:
        if problem:
            window.say(problem, True)
        return app.exec()


@contextlib.contextmanager
def open_window(
    app: QApplication, preferences: Preferences, file: Path, path: Path | None = None
) -> Iterator[MainWindow]:
    """Show the window; restore signals, error reporting and garbage collection afterwards.

    ``file`` has the preferences; ``path`` is the session or recording to open.
    """
    from labapp.gui.shell.commands import make_window

    window = make_window(preferences, file)
    window.apply_theme()
    app.styleHints().colorSchemeChanged.connect(window.apply_theme)
    faults = ErrorReporter(window.say, window)
    faults.install()
    heartbeat = QTimer(window)
    rounds = itertools.count(1)
    heartbeat.timeout.connect(lambda: collect_garbage(next(rounds)))
    gc.disable()  # see `collect_garbage`
    heartbeat.start(HEARTBEAT_MS)
    stops = (signal.SIGINT, signal.SIGTERM)

    def stop(*_: object) -> None:
        QTimer.singleShot(0, window, window.close)  # not in the middle of what the window does

    former = {number: signal.signal(number, stop) for number in stops}
    window.show()
    first_use = FirstUse(window.workspace.tasks, window)
    closed = threading.Event()
    target = partial(_load_what_is_needed, first_use.found.emit, closed.is_set)
    loading = threading.Thread(target=target, name="loading", daemon=True)
    load = QTimer(window, singleShot=True)
    load.timeout.connect(loading.start)

    def begin() -> None:
        if path is not None:
            window.files.open_path(path)
        load.start(LOAD_AFTER_MS)

    QTimer.singleShot(0, window, begin)
    try:
        yield window
    finally:
        closed.set()
        load.stop()
        heartbeat.stop()
        gc.enable()
        if loading.is_alive():
            loading.join()
        for number, handler in former.items():
            signal.signal(number, handler)
        faults.uninstall()


def collect_garbage(count: int) -> None:
    """Free unreachable objects in the calling thread.

    Python would otherwise do so in whichever thread creates the next object. Unreachable widgets
    would be destroyed in that thread instead of the GUI thread, and the two would deadlock.

    Parameters
    ----------
    count
        Number of this call: every tenth call also collects objects that survived the previous
        collection, every hundredth all objects, as with Python's default thresholds.
    """
    young, limit = gc.get_count()[0], gc.get_threshold()[0]
    if count % 100 == 0:
        gc.collect()
    elif young > limit:
        gc.collect(1 if count % 10 == 0 else 0)


class FirstUse(QObject):
    """Compiles missing modules in the background; the window shows this while it lasts."""

    found = Signal(list)
    """Some modules are not compiled: their names."""

    def __init__(self, tasks: Tasks, parent: QObject) -> None:
        super().__init__(parent)
        self.found.connect(
            lambda modules: tasks.start(
                compiling.TITLE, partial(compiling.compile_aside, modules), is_lasting=True
            )
        )


def _load_what_is_needed(
    not_compiled: Callable[[list[str]], object], is_closed: Callable[[], bool]
) -> None:
    """Load the modules needed later while the operator looks at the first page."""
    if modules := compiling.not_compiled():
        not_compiled(modules)
    with contextlib.suppress(ImportError):  # 3-D drawing may not be installed
        for name in NEEDED_LATER:
            if is_closed():
                return
            importlib.import_module(name)


def start_app() -> QApplication:
    """The Qt application, created if there is none yet.

    Raises
    ------
    InputError
        If there is no display.
    """
    if not (has_display(os.environ) or os.environ.get("QT_QPA_PLATFORM")):
        value = "none: neither DISPLAY nor WAYLAND_DISPLAY is set"
        raise InputError("the app", "display", value, f"a desktop; {WITHOUT}")
    # Set before NumPy is loaded: the matrices are small, and BLAS threads would slow the window.
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    present = QApplication.instance()
    if isinstance(present, QApplication):
        return present
    qInstallMessageHandler(_take_message)
    QApplication.setHighDpiScaleFactorRoundingPolicy(
        Qt.HighDpiScaleFactorRoundingPolicy.PassThrough
    )
    app = QApplication([NAME])
    app.setApplicationName(NAME)
    app.setApplicationDisplayName(NAME)
    app.setApplicationVersion(VERSION)
    app.setDesktopFileName(NAME)
    app.setWindowIcon(QIcon(str(bundled("resources/icons/labapp.svg"))))
    return app


class ErrorReporter(QObject):
    """Logs all uncaught errors and reports them to the operator; the window stays open."""

    _happened = Signal(str, bool)

    def __init__(self, say: Callable[[str, bool], None], parent: QObject | None = None) -> None:
        super().__init__(parent)
        self._happened.connect(say)
        self._former = sys.excepthook, threading.excepthook

    def install(self) -> None:
        """Handle uncaught errors from now on."""
        self._former = sys.excepthook, threading.excepthook
        sys.excepthook = self.take
        threading.excepthook = self._take_in_thread

    def uninstall(self) -> None:
        """Restore the previous exception hooks."""
        sys.excepthook, threading.excepthook = self._former

    def take(
        self, kind: type[BaseException], error: BaseException, trace: TracebackType | None
    ) -> None:
        """Log and report an error; may be called in any thread."""
        start_log().error("fault", exc_info=(kind, error, trace))
        words = f"A fault in the program: {kind.__name__}: {error}. Your session is saved; "
        self._happened.emit(f"{words}details are in the log (Help, Show the log folder)", True)

    def _take_in_thread(self, details: threading.ExceptHookArgs) -> None:
        if details.exc_value is not None:
            self.take(details.exc_type, details.exc_value, details.exc_traceback)


def _take_message(kind: QtMsgType, _context: QMessageLogContext, message: str) -> None:
    """Log a message of Qt; print it to the terminal, too, if no window can be opened."""
    log = start_log()
    if kind == QtMsgType.QtFatalMsg:
        log.critical("Qt: %s", message)
        sys.stderr.write(f"labapp: no window can be opened: {message.strip()}\n{WITHOUT}\n")
        sys.stderr.flush()
        os._exit(BAD_INPUT)  # Qt would abort with a core dump
    log.log(logging.INFO if kind == QtMsgType.QtInfoMsg else logging.WARNING, "Qt: %s", message)
