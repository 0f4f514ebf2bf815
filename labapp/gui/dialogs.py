"""Dialogs that ask for a file or a decision."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from PySide6.QtCore import QMimeData, Qt
from PySide6.QtWidgets import QFileDialog, QMessageBox, QPushButton, QWidget

from labapp.session.file.database import SUFFIX

SESSIONS = f"Sessions (*{SUFFIX})"
SETUP_FILES = "Setup files (*.toml)"
EVERYTHING = "All files (*)"

Role = QMessageBox.ButtonRole


def recordings() -> str:
    """File dialog filter for everything that can be imported."""
    from labapp.media import RECORDING_SUFFIXES
    from labapp.media.formats.images import IMAGE_SUFFIXES
    from labapp.media.formats.tiff import TIFF_SUFFIXES

    suffixes = sorted(RECORDING_SUFFIXES | IMAGE_SUFFIXES | TIFF_SUFFIXES)
    return f"Recordings ({' '.join(f'*{suffix}' for suffix in suffixes)})"


def dropped_paths(data: QMimeData) -> list[Path]:
    """Return the files and folders of this machine among what is dropped on a window."""
    return [Path(url.toLocalFile()) for url in data.urls() if url.isLocalFile()]


def ask_file(parent: QWidget, title: str, folder: Path, kinds: str = "") -> Path | None:
    """Ask for an existing file; ``kinds`` is Qt's filter: "Tables (*.csv)"."""
    name, _ = QFileDialog.getOpenFileName(parent, title, str(folder), kinds)
    return Path(name) if name else None


def ask_folder(parent: QWidget, title: str, folder: Path) -> Path | None:
    """Ask for a folder."""
    name = QFileDialog.getExistingDirectory(parent, title, str(folder))
    return Path(name) if name else None


def ask_save(parent: QWidget, title: str, proposed: Path, kinds: str) -> Path | None:
    """Ask for a file to write, which may already exist."""
    name, _ = QFileDialog.getSaveFileName(parent, title, str(proposed), kinds)
    return Path(name) if name else None


def ask_session(parent: QWidget, folder: Path) -> Path | None:
    """Ask which session to open."""
    return ask_file(parent, "Open a session", folder, f"{SESSIONS};;{EVERYTHING}")


def ask_new_session(parent: QWidget, proposed: Path, title: str = "New session") -> Path | None:
    """Ask for the file of a new session; a missing suffix is added."""
    options = QFileDialog.Option.DontConfirmOverwrite  # no file is ever overwritten
    name, _ = QFileDialog.getSaveFileName(parent, title, str(proposed), SESSIONS, options=options)
    if not name:
        return None
    path = Path(name)
    return path if path.suffix.lower() == SUFFIX else path.with_name(path.name + SUFFIX)


def ask_recording(parent: QWidget, folder: Path, title: str = "Import recording") -> Path | None:
    """Ask for a recording file."""
    return ask_file(parent, title, folder, f"{recordings()};;{EVERYTHING}")


def ask_setup(parent: QWidget, folder: Path) -> Path | None:
    """Ask which setup file to load."""
    return ask_file(parent, "Load set-up", folder, f"{SETUP_FILES};;{EVERYTHING}")


def ask_read_only(parent: QWidget, path: Path, in_use: bool = True) -> bool:
    """Offer to open a session read-only because it is open elsewhere, or cannot be written."""
    if in_use:
        title, why = "The session is in use", "is open in another window or program"
        until = "it is closed there"
    else:
        title, why = "The session cannot be written", "or its folder cannot be written"
        until = "it is copied, with its recording, to another folder"
    more = f"You can look at it read-only: nothing can be changed or measured in it until {until}."
    box = _question(parent, "read-only", title, f"{path.name} {why}.", more)
    tip = "Look at the session without changing it"
    look = _answer(box, "Open &read-only", Role.AcceptRole, tip)
    cancel = box.addButton(QMessageBox.StandardButton.Cancel)
    cancel.setToolTip("Leave it closed (Esc)")
    box.setDefaultButton(look)
    box.exec()
    return box.clickedButton() is look


def ask_delete_draft(parent: QWidget, path: Path) -> bool:
    """Ask whether to delete a draft."""
    words = f"Delete the draft “{path.stem}”?"
    more = "Its set-up, corrections and results are lost. The recording stays where it is."
    box = _question(parent, "delete-draft", "Delete draft", words, more)
    delete = _answer(box, "&Delete", Role.DestructiveRole, "Delete the draft for good")
    keep = _answer(box, "&Keep", Role.RejectRole, "Delete nothing (Esc)")
    box.setDefaultButton(keep)
    box.setEscapeButton(keep)
    box.exec()
    return box.clickedButton() is delete


def ask_recording_end(parent: QWidget, name: str) -> Literal["keep", "discard", "go on"]:
    """Ask what to do with a running recording when its session is to be closed."""
    more = (
        "To close, the recording is ended. A finished one is kept beside the session and listed "
        "in the step Recording."
    )
    words = f"{name} is still being recorded."
    box = _question(parent, "recording-runs", "A recording is running", words, more)
    tip = "End the recording, write all of it, and close"
    keep = _answer(box, "&Finish and keep", Role.AcceptRole, tip)
    tip = "End the recording, delete its file, and close"
    discard = _answer(box, "&Discard", Role.DestructiveRole, tip)
    go_on = _answer(box, "&Go on recording", Role.RejectRole, "Keep everything open (Esc)")
    box.setDefaultButton(keep)
    box.setEscapeButton(go_on)
    box.exec()
    if box.clickedButton() is keep:
        return "keep"
    return "discard" if box.clickedButton() is discard else "go on"


def _question(parent: QWidget, name: str, title: str, words: str, more: str) -> QMessageBox:
    box = QMessageBox(QMessageBox.Icon.Question, title, words, parent=parent)
    box.setObjectName(name)
    box.setTextFormat(Qt.TextFormat.PlainText)
    box.setInformativeText(more)
    return box


def _answer(box: QMessageBox, words: str, role: Role, tip: str) -> QPushButton:
    button = box.addButton(words, role)
    button.setToolTip(tip)
    return button


def new_path(folder: Path, stem: str, suffix: str = SUFFIX) -> Path:
    """A path that does not exist yet, for a session or, without a suffix, for a folder."""
    path, number = folder / f"{stem}{suffix}", 1
    while path.exists():
        number += 1
        path = folder / f"{stem} {number}{suffix}"
    return path
