"""Preferences stored between starts. Their file can never prevent a start of the program."""

from __future__ import annotations

import dataclasses
import json
import os
from collections.abc import Callable, Mapping
from contextlib import ExitStack, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import platformdirs
from PySide6.QtCore import QObject, Signal

from labapp.files import as_bytes, write_atomically
from labapp.log import NAME

VERSION = 1
KEPT_RECENT = 12
THEMES = ("system", "light", "dark")
LARGEST_BYTES = 1_000_000
LOCK_S = 2.0
"""Time, s, that a window waits while another one writes."""


@dataclass(frozen=True)
class Preferences:
    """Stored preferences."""

    recent: tuple[str, ...] = ()
    """Session files, the most recently opened first."""
    theme: str = "system"
    geometry: str = ""
    layout: str = ""
    """Geometry and state of the window as returned by Qt, base64; empty for the default."""
    last_folder: str = ""
    """Folder of the last chosen file; empty for the documents folder."""
    foot_switches: tuple[Mapping[str, Any], ...] = ()
    """Actions of their pedals, each as returned by `PedalMap.as_dict`."""

    def with_recent(self, path: Path, folder: Path | None = None) -> Preferences:
        """Copy with a session as the most recent, and its folder (or ``folder``) as the last."""
        name = str(path.absolute())
        others = (other for other in self.recent if other != name)
        last = str(folder or path.parent)
        return replace(self, recent=(name, *others)[:KEPT_RECENT], last_folder=last)

    def without_recent(self, path: Path) -> Preferences:
        """Copy without a session among the recent ones."""
        name = str(path.absolute())
        return replace(self, recent=tuple(other for other in self.recent if other != name))

    @property
    def folder(self) -> Path:
        """Initial folder of a file dialog."""
        last = Path(self.last_folder)
        return last if self.last_folder and last.is_dir() else documents_folder()

    @property
    def samples_folder(self) -> Path:
        """Folder for copies of the samples."""
        documents = platformdirs.user_documents_path()
        if documents.is_dir():
            return documents / NAME
        return platformdirs.user_data_path(NAME, appauthor=False) / "samples"


class PreferencesStore(QObject):
    """Preferences of a window and their file, which other windows change, too."""

    changed = Signal()
    """A preference changed."""
    failed = Signal(str)
    """A preference could not be written: the reason. It still applies to this window."""

    def __init__(self, preferences: Preferences, path: Path) -> None:
        super().__init__()
        self.current = preferences
        """The current preferences."""
        self.path = path

    def remember(self, change: Callable[[Preferences], Preferences]) -> None:
        """Change the stored preferences and write them, one window at a time."""
        from filelock import FileLock, Timeout

        lock = FileLock(self.path.with_name(f".{self.path.name}.lock"), timeout=LOCK_S)
        with ExitStack() as held:
            with suppress(OSError, Timeout):  # better written without the lock than not at all
                self.path.parent.mkdir(parents=True, exist_ok=True)
                held.enter_context(lock)
            self.recall()
            self.current = change(self.current)
            problem = write_preferences(self.path, self.current)
        if problem:
            self.failed.emit(problem)
        self.changed.emit()

    def recall(self) -> None:
        """Read the file, which other windows may have changed; if it is gone, nothing changes."""
        found, problem = read_preferences(self.path)
        if not problem and self.path.exists():
            self.current = found


def documents_folder() -> Path:
    """The user's documents folder, or the home folder if there is none."""
    documents = platformdirs.user_documents_path()
    return documents if documents.is_dir() else Path.home()


def preferences_file() -> Path:
    """Path of the preferences file."""
    return Path(platformdirs.user_config_dir(NAME, appauthor=False)) / "preferences.json"


def read_preferences(path: Path) -> tuple[Preferences, str]:
    """Read preferences, and return them with a message for the operator if there was a problem.

    An unusable file is renamed and the defaults are returned.
    """
    try:
        if path.stat().st_size > LARGEST_BYTES:
            return Preferences(), _keep_aside(path, f"is larger than {LARGEST_BYTES} bytes")
        held = json.loads(path.read_bytes())
    except FileNotFoundError:
        return Preferences(), ""
    except OSError as error:
        return Preferences(), f"Preferences could not be read ({error.strerror}): {path}"
    except (ValueError, RecursionError):
        return Preferences(), _keep_aside(path, "is damaged")
    if not isinstance(held, dict) or held.pop("version", None) != VERSION:
        return Preferences(), _keep_aside(path, "is of another version of labapp")
    try:
        return _checked(held), ""
    except (TypeError, ValueError):
        return Preferences(), _keep_aside(path, "is damaged")


def write_preferences(path: Path, preferences: Preferences) -> str:
    """Write preferences atomically; return the message of a failure, otherwise an empty text."""
    held = {"version": VERSION, **dataclasses.asdict(preferences)}
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_atomically(path, as_bytes(json.dumps(held, indent=1, ensure_ascii=False) + "\n"))
    except OSError as error:
        return f"Preferences could not be saved ({error.strerror}): {path}"
    return ""


def _checked(held: dict[str, Any]) -> Preferences:
    lists = {name: held.get(name, []) for name in ("recent", "foot_switches")}
    if not all(isinstance(each, list) for each in lists.values()):
        raise TypeError("a list")
    recent = lists["recent"]
    found = Preferences(**held | {name: tuple(each) for name, each in lists.items()})
    if not all(isinstance(each, dict) for each in found.foot_switches):
        raise TypeError("a foot switch")
    texts: list[Any] = [*recent, found.theme, found.geometry, found.layout, found.last_folder]
    if not all(isinstance(text, str) and "\0" not in text for text in texts):
        raise TypeError("a text")
    if found.theme not in THEMES:
        raise ValueError(found.theme)
    return replace(found, recent=found.recent[:KEPT_RECENT])


def _keep_aside(path: Path, why: str) -> str:
    aside = path.with_suffix(".kept.json")
    try:
        os.replace(path, aside)
    except OSError:
        return f"The preferences file {why}; the defaults are used: {path}"
    return f"The preferences file {why}; the defaults are used, and it is kept as {aside}"
