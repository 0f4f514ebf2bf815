"""Helpers for random actions: files to choose, answers to dialogs, a record of faults."""

from __future__ import annotations

import logging
import os
import random
import shutil
import sys
import threading
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from unittest import mock

from PySide6.QtCore import Qt, QTimer, QtMsgType, qInstallMessageHandler
from PySide6.QtGui import QDesktopServices
from PySide6.QtTest import QTest
from PySide6.QtWidgets import QAbstractButton, QApplication, QFileDialog, QMenu, QWidget

from labapp.log import start_log
from labapp.session.file.database import SUFFIX

SAMPLES = Path(__file__).parents[2] / "sample_sessions"

HOMES = ("XDG_STATE_HOME", "XDG_CONFIG_HOME", "XDG_DATA_HOME", "XDG_DOCUMENTS_DIR")
"""Folders of the app; not all of the home, which contains the slow-to-build caches of others."""

WITHOUT_DESKTOP = ("This plugin does not support",)
"""Messages of Qt on a platform without a desktop."""

POLL_MS = 30


class Files:
    """Valid and invalid files in a folder.

    Parameters
    ----------
    folder
        Empty, or not yet created.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.home = folder / "home"
        self.home.mkdir(parents=True)
        self._made = 0
        self.sessions = [self._sample(name) for name in ("blocked_rows", "concave", "thumb_tack")]
        lost = folder / "lost" / f"lost{SUFFIX}"
        lost.parent.mkdir()
        self.sessions.append(Path(shutil.copyfile(self.sessions[2], lost)))  # without recording
        self.garbage = self._file(f"garbage{SUFFIX}", "SQLite format 3\0 and then nothing")
        times = (f"{k / 100},{75 + k % 3},12\n" for k in range(50))
        self.good = [
            self._file("current.csv", f"time_s,current_a,voltage_v\n{''.join(times)}"),
            *(folder / "blocked_rows" / name for name in ("recording.mkv", "calibration.png")),
            *(folder / "concave" / name for name in ("recording", "setup.toml")),
            *(folder / "thumb_tack" / name for name in ("recording.tif", "setup.toml")),
            folder / "concave" / "recording" / "frame_9.png",
        ]
        self.bad = [
            *(self.garbage, self._file("words.avi", "no video"), self._file("empty.png", "")),
            *(folder / "not there.avi", folder / "none" / f"none{SUFFIX}", self.home),
        ]

    def _sample(self, name: str) -> Path:
        shutil.copytree(SAMPLES / name, self.folder / name)
        return self.folder / name / f"{name}{SUFFIX}"

    def _file(self, name: str, text: str) -> Path:
        path = self.folder / name
        path.write_text(text)
        return path

    def some(self, rng: random.Random) -> Path:
        """A random file to open."""
        return rng.choice(rng.choices([self.good, self.sessions, self.bad], [5, 3, 2])[0])

    def some_new(self, rng: random.Random, proposed: str) -> Path:
        """A random file to write: mostly one that can be written."""
        self._made += 1
        suffix = Path(proposed).suffix
        places = [self.folder, self.folder, self.folder / "no folder"]
        names = [f"new {self._made}{suffix}", f"new {self._made}", "current.csv"]
        return rng.choice(places) / rng.choices(names, [6, 2, 1])[0]

    def some_folder(self, rng: random.Random) -> Path:
        """A random folder to read or write."""
        names = ("concave/recording", "home", "none", "out")
        return self.folder / rng.choice(names)


class Answers:
    """Answers file dialogs, menus and questions of the app.

    Parameters
    ----------
    files
        Files that can be chosen.
    rng
        Returns the random numbers of the current action.
    note
        Called with what was chosen.
    """

    def __init__(
        self, files: Files, rng: Callable[[], random.Random], note: Callable[[str], None]
    ) -> None:
        self._files, self._rng, self._note = files, rng, note

    @contextmanager
    def active(self) -> Iterator[None]:
        """Answer every dialog, open no desktop service, and replace the user's folders."""

        def patched(name: str, answer: Callable[..., object]) -> mock._patch[object]:
            return mock.patch.object(QFileDialog, name, staticmethod(answer))

        def open_name(*_: object, **__: object) -> tuple[str, str]:
            return self._chosen(self._files.some(self._rng())), ""

        def save_name(
            _: object, __: object, proposed: str = "", *___: object, **____: object
        ) -> object:
            return self._chosen(self._files.some_new(self._rng(), proposed)), ""

        timer = QTimer()
        timer.timeout.connect(self._answer)
        timer.start(POLL_MS)
        with (
            patched("getOpenFileName", open_name),
            patched("getSaveFileName", save_name),
            patched(
                "getExistingDirectory",
                lambda *_: self._chosen(self._files.some_folder(self._rng())),
            ),
            mock.patch.object(
                QDesktopServices, "openUrl", staticmethod(lambda _: self._rng().random() < 0.5)
            ),
            mock.patch.dict(os.environ, dict.fromkeys(HOMES, str(self._files.home))),
        ):
            yield
        timer.stop()

    def _chosen(self, path: Path) -> str:
        cancelled = self._rng().random() < 0.1
        self._note("no file" if cancelled else str(path.relative_to(self._files.folder)))
        return "" if cancelled else str(path)

    def _answer(self) -> None:
        """Answer an open menu or question."""
        popup, dialog, rng = (
            QApplication.activePopupWidget(),
            QApplication.activeModalWidget(),
            self._rng(),
        )
        if isinstance(popup, QMenu):
            usable = [each for each in popup.actions() if each.isEnabled() and not each.menu()]
            if usable and rng.random() < 0.7:
                action = rng.choice(usable)
                self._note(action.text())
                popup.setActiveAction(action)
                _soon(popup, lambda: QTest.keyClick(popup, Qt.Key.Key_Return))
            else:
                _soon(popup, lambda: QTest.keyClick(popup, Qt.Key.Key_Escape))
        elif popup is not None:
            popup.close()
        elif dialog is not None:
            buttons = [b for b in dialog.findChildren(QAbstractButton) if b.isVisible()]
            if buttons:
                button = rng.choice(buttons)
                self._note(button.text())
                _soon(button, button.click)
            else:
                dialog.close()


def _soon(widget: QWidget, answer: Callable[[], object]) -> None:
    """Answer after this call: a dialog that opens waits for its own answer in the meantime."""
    QTimer.singleShot(0, widget, answer)


class FaultHandler(logging.Handler):
    """Records all warnings and errors of the log but rejected input, which is no fault.

    Parameters
    ----------
    faults
        The list to append to.
    """

    def __init__(self, faults: list[str]) -> None:
        super().__init__(logging.WARNING)
        self._faults = faults

    def emit(self, record: logging.LogRecord) -> None:
        """Record a message with its traceback."""
        if record.getMessage() != "refused":
            error = record.exc_info[1] if record.exc_info else None
            trace = "" if error is None else "".join(traceback.format_exception(error))
            self._faults.append(f"log: {record.getMessage()}\n{trace}")


@contextmanager
def recorded(faults: list[str]) -> Iterator[None]:
    """Record every uncaught exception, every fault in the log, and the warnings of Qt."""

    def on_qt_message(kind: QtMsgType, _: object, message: str) -> None:
        if kind != QtMsgType.QtInfoMsg and not any(words in message for words in WITHOUT_DESKTOP):
            faults.append(f"Qt: {message}")

    def uncaught(*args: object) -> None:
        faults.append("".join(traceback.format_exception(*args)))  # type: ignore[call-overload]

    handler, log = FaultHandler(faults), start_log()
    log.addHandler(handler)
    previous = qInstallMessageHandler(on_qt_message)
    try:
        with (
            mock.patch.object(sys, "excepthook", uncaught),
            mock.patch.object(threading, "excepthook", lambda args: uncaught(*args[:3])),
        ):
            yield
    finally:
        qInstallMessageHandler(previous)
        log.removeHandler(handler)
