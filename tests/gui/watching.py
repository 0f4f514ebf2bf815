"""What random actions need: files to choose, answers where the app asks, ears for faults."""

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
from PySide6.QtWidgets import QAbstractButton, QApplication, QFileDialog, QMenu

from labapp.log import start_log
from labapp.session.file.database import SUFFIX

SAMPLES = Path(__file__).parents[2] / "sample_sessions"

HOMES = ("XDG_STATE_HOME", "XDG_CONFIG_HOME", "XDG_DATA_HOME", "XDG_DOCUMENTS_DIR")
"""Where the app looks for its own; not all of the home, where others keep what is slow to make."""

WITHOUT_DESKTOP = ("This plugin does not support",)
"""What Qt says on a platform without a desktop."""

POLL_MS = 30


class Files:
    """Good files and bad ones, in a folder of their own.

    Parameters
    ----------
    folder
        Empty, or to be made.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.home = folder / "home"
        self.home.mkdir(parents=True)
        self._made = 0
        self.sessions = [self._sample(name) for name in ("blocked_rows", "concave", "thumb_tack")]
        lost = folder / "lost" / f"lost{SUFFIX}"
        lost.parent.mkdir()
        self.sessions.append(Path(shutil.copyfile(self.sessions[2], lost)))  # its recording is gone
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
        """A file to be opened."""
        return rng.choice(rng.choices([self.good, self.sessions, self.bad], [5, 3, 2])[0])

    def some_new(self, rng: random.Random, proposed: str) -> Path:
        """A file to be written: mostly one that can be."""
        self._made += 1
        suffix = Path(proposed).suffix
        places = [self.folder, self.folder, self.folder / "no folder"]
        names = [f"new {self._made}{suffix}", f"new {self._made}", "current.csv"]
        return rng.choice(places) / rng.choices(names, [6, 2, 1])[0]

    def some_folder(self, rng: random.Random) -> Path:
        """A folder to be read or written."""
        names = ("concave/recording", "home", "none", "out")
        return self.folder / rng.choice(names)


class Answers:
    """Answers where the app asks: for a file, in a menu, in a question.

    Parameters
    ----------
    files
        What can be chosen.
    rng
        Gives the source of chance of the action under way.
    note
        Told what was chosen.
    """

    def __init__(
        self, files: Files, rng: Callable[[], random.Random], note: Callable[[str], None]
    ) -> None:
        self._files, self._rng, self._note = files, rng, note

    @contextmanager
    def given(self) -> Iterator[None]:
        """Answer everything from now on; no desktop is opened, the user's folders are others."""

        def asked(name: str, answer: Callable[..., object]) -> mock._patch[object]:
            return mock.patch.object(QFileDialog, name, staticmethod(answer))

        def opened(*_: object, **__: object) -> tuple[str, str]:
            return self._chosen(self._files.some(self._rng())), ""

        def saved(
            _: object, __: object, proposed: str = "", *___: object, **____: object
        ) -> object:
            return self._chosen(self._files.some_new(self._rng(), proposed)), ""

        timer = QTimer()
        timer.timeout.connect(self._answer)
        timer.start(POLL_MS)
        with (
            asked("getOpenFileName", opened),
            asked("getSaveFileName", saved),
            asked(
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
        refused = self._rng().random() < 0.1
        self._note("no file" if refused else str(path.relative_to(self._files.folder)))
        return "" if refused else str(path)

    def _answer(self) -> None:
        """Answer a menu or a question that waits."""
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
                QTest.keyClick(popup, Qt.Key.Key_Return)
            else:
                QTest.keyClick(popup, Qt.Key.Key_Escape)
        elif popup is not None:
            popup.close()
        elif dialog is not None:
            buttons = [b for b in dialog.findChildren(QAbstractButton) if b.isVisible()]
            if buttons:
                button = rng.choice(buttons)
                self._note(button.text())
                button.click()
            else:
                dialog.close()


class Noting(logging.Handler):
    """Notes what the log tells but refusals, which are no faults.

    Parameters
    ----------
    faults
        Where to.
    """

    def __init__(self, faults: list[str]) -> None:
        super().__init__(logging.WARNING)
        self._faults = faults

    def emit(self, record: logging.LogRecord) -> None:
        """Note it with where it came from."""
        if record.getMessage() != "refused":
            error = record.exc_info[1] if record.exc_info else None
            trace = "" if error is None else "".join(traceback.format_exception(error))
            self._faults.append(f"log: {record.getMessage()}\n{trace}")


@contextmanager
def noted(faults: list[str]) -> Iterator[None]:
    """Note every uncaught error, every fault in the log, and what Qt warns of."""

    def said(kind: QtMsgType, _: object, message: str) -> None:
        if kind != QtMsgType.QtInfoMsg and not any(words in message for words in WITHOUT_DESKTOP):
            faults.append(f"Qt: {message}")

    def uncaught(*told: object) -> None:
        faults.append("".join(traceback.format_exception(*told)))  # type: ignore[call-overload]

    handler, log = Noting(faults), start_log()
    log.addHandler(handler)
    former = qInstallMessageHandler(said)
    try:
        with (
            mock.patch.object(sys, "excepthook", uncaught),
            mock.patch.object(threading, "excepthook", lambda told: uncaught(*told[:3])),
        ):
            yield
    finally:
        qInstallMessageHandler(former)
        log.removeHandler(handler)
