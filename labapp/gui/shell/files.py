"""Sessions and recordings of the window: new, open, import, copy, the sample, those of before."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from PySide6.QtCore import QObject, Signal

from labapp.gui import dialogs
from labapp.gui.workspace import MISSING
from labapp.session.file.database import SUFFIX, SessionInUse

if TYPE_CHECKING:
    from PySide6.QtWidgets import QWidget

    from labapp.gui.live.view import LiveView
    from labapp.gui.preferences import PreferencesStore
    from labapp.gui.workspace import Workspace
    from labapp.session.session import Session


class Files(QObject):
    """What the window opens and makes."""

    recording_requested = Signal(object)
    """The step Recording is to be shown, and to take this file or folder, unless it is None."""

    def __init__(
        self,
        window: QWidget,
        workspace: Workspace,
        preferences: PreferencesStore,
        camera: Callable[[], LiveView | None],
    ) -> None:
        super().__init__(window)
        self._window = window
        self.workspace = workspace
        self.preferences = preferences
        self._camera = camera

    def new(self) -> bool:
        """Ask for a file and make a session in it."""
        return self._create(dialogs.new_path(self.preferences.current.folder, "experiment"))

    def choose(self) -> None:
        """Ask for a session and open it."""
        path = dialogs.ask_session(self._window, self.preferences.current.folder)
        if path is not None:
            self.open(path)

    def choose_recording(self) -> None:
        """Ask for a recording and import it."""
        path = dialogs.ask_recording(self._window, self.preferences.current.folder)
        if path is not None:
            self.take(path)

    def open_path(self, path: Path) -> None:
        """Open a session, or import anything else."""
        if path.suffix.lower() == SUFFIX:
            self.open(path)
        else:
            self.take(path)

    def open(self, path: Path) -> bool:
        """Open a session file, read-only if it is in use elsewhere and the operator agrees."""
        present = self.workspace.session
        if present is not None and path.absolute() == present.path:
            return True
        if not self.may_close():
            return False
        session = self.workspace.run_or_report(lambda: self._opened(path))
        if session is None:
            return False
        self._show(session)
        return True

    def take(self, path: Path) -> None:
        """Take a recording to the capture page, in a new session where none is open."""
        if not path.exists():
            self.workspace.notified.emit(f"{path} is not there", True)
        elif self.workspace.session is not None or self._create(
            dialogs.new_path(path.parent, path.stem)
        ):
            folder = str(path.parent)
            self.preferences.remember(lambda before: replace(before, last_folder=folder))
            self.recording_requested.emit(path)

    def save_copy(self) -> None:
        """Ask for a file and save the session in it as it is now."""
        session = self.workspace.session
        if session is None:
            return
        proposed = dialogs.new_path(session.path.parent, f"{session.path.stem} copy")
        path = dialogs.ask_new_session(self._window, proposed, "Save a copy")
        if path is not None:
            from labapp.session.copies import copy_session

            source = session.path
            self.workspace.tasks.start(
                "Saving a copy",
                lambda _: copy_session(source, path),
                lambda copied: self.workspace.notified.emit(f"A copy is in {copied}", False),
            )

    def begin_next(self, recording: Path) -> None:
        """Ask for a file and make a session like this one in it, for a recording; show it."""
        present = self.workspace.session
        if present is None:
            return
        from labapp.session.copies import next_session

        title = "New session from this recording"
        proposed = dialogs.new_path(present.path.parent, recording.stem)
        path = dialogs.ask_new_session(self._window, proposed, title)
        if path is None or not self.may_close():
            return
        session = self.workspace.run_or_report(lambda: next_session(present, path))
        if session is not None:
            self._show(session)
            self.recording_requested.emit(None)

    def try_sample(self) -> None:
        """Open a copy of the sample run, in a folder of the user's."""
        from labapp.session.copies import copy_sample

        folder = self.preferences.current.samples_folder / "gtaw"
        path = self.workspace.run_or_report(lambda: copy_sample("gtaw", folder))
        if path is not None and self.open(path):
            words = f"This is a copy of the sample, in {path.parent}: change what you like"
            self.workspace.notified.emit(words, False)

    def close(self) -> None:
        """Close the session and go back to the welcome page."""
        if self.may_close():
            self.workspace.show(None)

    def may_close(self) -> bool:
        """Ask what to do with a running recording; False if it continues and nothing is closed."""
        camera = self._camera()
        take = None if camera is None else camera.recording
        if camera is None or take is None:
            return True
        answer = dialogs.ask_recording_end(self._window, take.path.name)
        if answer == "discard":
            camera.discard(take)
        return answer != "go on"

    def _create(self, proposed: Path) -> bool:
        from labapp.session.session import Session

        path = dialogs.ask_new_session(self._window, proposed)
        if path is None or not self.may_close():
            return False
        session = self.workspace.run_or_report(lambda: Session.create(path))
        if session is None:
            return False
        self._show(session)
        return True

    def _opened(self, path: Path) -> Session | None:
        from labapp.session.session import Session

        try:
            return Session.open(path)
        except SessionInUse:
            if not dialogs.ask_read_only(self._window, path):
                return None
            return Session.open(path, read_only=True)

    def _show(self, session: Session) -> None:
        self.preferences.remember(lambda before: before.with_recent(session.path))
        self.workspace.show(session)
        missing = self.workspace.run_or_report(lambda: session.missing_recording)
        if missing is not None:
            words = f"The recording is not where it was: {missing}"
            self.workspace.say_wrong(MISSING, words)


def title(session: Session | None) -> str:
    """Title of a window with a session, or with none."""
    if session is None:
        return "labapp"
    return f"{session.path.stem}{' (read-only)' if session.read_only else ''} — labapp"
