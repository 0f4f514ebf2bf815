"""Sources of a session's set-up: a setup file, another session, or the last one used."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from PySide6.QtCore import QObject, Signal

from labapp.errors import InputError
from labapp.gui import dialogs
from labapp.gui.tasks import DONE, PROBLEM

if TYPE_CHECKING:
    from PySide6.QtWidgets import QWidget

    from labapp.gui.preferences import PreferencesStore
    from labapp.gui.tasks import Control, Task
    from labapp.gui.workspace import Workspace
    from labapp.session.session import Session

CAUSE = "Set-up"
"""Cause of refusals, see `Workspace.say_wrong`."""

NO_LAST = "No session among the recent ones has a complete set-up: load a setup file, or enter it"


class Setups(QObject):
    """Import of a whole set-up into the session, whose frames are then measured with it."""

    answered = Signal(str)
    """Text for display at the pressed button: why a set-up was not taken; empty at first."""

    def __init__(
        self, window: QWidget, workspace: Workspace, preferences: PreferencesStore
    ) -> None:
        super().__init__(window)
        self._window = window
        self.workspace = workspace
        self.preferences = preferences
        self._looking: Task | None = None

    def load(self) -> None:
        """Ask for a setup file and use it."""
        if path := dialogs.ask_setup(self._window, self.workspace.folder):
            self._use(lambda session: load_setup(session, path), path.name)

    def use_other(self) -> None:
        """Ask for another session and use its set-up."""
        if path := dialogs.ask_session(self._window, self.workspace.folder):
            self._use_session(path)

    def use_last(self) -> None:
        """Use the set-up of the last opened session with a complete one."""
        session = self.workspace.session
        if session is None or self._looking in self.workspace.tasks.active:
            return
        paths = [Path(name) for name in self.preferences.current.recent]
        others = [path for path in paths if path != session.path]

        def look(_: Control) -> Path:
            found = next(filter(_is_complete, others), None)
            if found is None:
                raise ValueError(NO_LAST)
            return found

        self._looking = self.workspace.tasks.start(
            "Looking for the last set-up",
            look,
            self._use_session,
            show_answer=self.answered.emit,
            kind=CAUSE,
        )

    def _use_session(self, path: Path) -> None:
        from labapp.session.copies import use_setup_of

        self._use(lambda session: use_setup_of(session, path), path.stem)

    def _use(self, take: Callable[[Session], None], name: str) -> None:
        """Use a set-up, and measure with it unless it was calibrated for another frame size."""
        workspace = self.workspace
        if not workspace.attempt(take, CAUSE, self.answered.emit):
            return
        session = workspace.session
        assert session is not None
        words = f"Set-up of {name} applied; undo restores the former one"
        workspace.notified.emit(words, False)
        self.answered.emit(f"{DONE} {words}")
        if session.recording is None or session.missing_recording is not None:
            return
        if unlike := workspace.check_size():
            self.answered.emit(f"{PROBLEM} {unlike}")
            return
        workspace.measure(show_answer=self.answered.emit)
        workspace.action_requested.emit("step_surface")


def load_setup(session: Session, path: Path) -> None:
    """Use the set-up from a setup file.

    Raises
    ------
    InputError
        If anything in it is unknown, missing or impossible.
    """
    from labapp.config.setup import read_setup

    session.set_setup(read_setup(path, lines=True).text, f"set-up from {path.name}")


def _is_complete(path: Path) -> bool:
    """Whether a session can be opened and its set-up is complete."""
    from labapp.session.session import Session

    try:
        with Session.open(path, read_only=True) as session:
            return not session.setup_problems
    except (InputError, OSError):
        return False
