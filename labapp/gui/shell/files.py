"""Sessions and recordings of the window: new, open, import, copy, the sample, those of before."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from labapp.gui import dialogs
from labapp.gui.shell import filming
from labapp.gui.workspace import MISSING
from labapp.session.file.database import SUFFIX, SessionInUse

if TYPE_CHECKING:
    from labapp.gui.shell.window import MainWindow
    from labapp.session.session import Session


class Files:
    """What the window opens and makes.

    Parameters
    ----------
    window
        Where to show it.
    """

    def __init__(self, window: MainWindow) -> None:
        self._window = window

    def new(self) -> bool:
        """Ask for a file and make a session in it."""
        return self._create(dialogs.new_path(self._window.preferences.folder, "experiment"))

    def choose(self) -> None:
        """Ask for a session and open it."""
        path = dialogs.ask_session(self._window, self._window.preferences.folder)
        if path is not None:
            self.open(path)

    def choose_recording(self) -> None:
        """Ask for a recording and import it."""
        path = dialogs.ask_recording(self._window, self._window.preferences.folder)
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
        present = self._window.workspace.session
        if present is not None and path.absolute() == present.path:
            return True
        if not filming.may_close(self._window):
            return False
        session = self._window.workspace.tried(lambda: self._opened(path))
        if session is None:
            return False
        self._show(session)
        return True

    def take(self, path: Path) -> None:
        """Take a recording to the capture page, in a new session where none is open."""
        if not path.exists():
            self._window.say(f"{path} is not there", True)
        elif self._window.workspace.session is not None or self._create(
            dialogs.new_path(path.parent, path.stem)
        ):
            folder = str(path.parent)
            self._window.remember(lambda before: replace(before, last_folder=folder))
            self._window.show_step("capture")
            if self._window.page is not None:
                self._window.page.take(path)

    def save_copy(self) -> None:
        """Ask for a file and save the session in it as it is now."""
        session = self._window.workspace.session
        if session is None:
            return
        proposed = dialogs.new_path(session.path.parent, f"{session.path.stem} copy")
        path = dialogs.ask_new_session(self._window, proposed, "Save a copy")
        if path is not None:
            from labapp.session.copies import copy_session

            source = session.path
            self._window.workspace.tasks.start(
                "Saving a copy",
                lambda _: copy_session(source, path),
                lambda copied: self._window.say(f"A copy is in {copied}"),
            )

    def begin_next(self, recording: Path) -> None:
        """Ask for a file and make a session like this one in it, for a recording; show it."""
        present = self._window.workspace.session
        if present is None:
            return
        from labapp.session.copies import next_session

        title = "New session from this recording"
        proposed = dialogs.new_path(present.path.parent, recording.stem)
        path = dialogs.ask_new_session(self._window, proposed, title)
        if path is None or not filming.may_close(self._window):
            return
        session = self._window.workspace.tried(lambda: next_session(present, path))
        if session is not None:
            self._show(session)
            self._window.show_step("capture")

    def try_sample(self) -> None:
        """Open a copy of the sample run, in a folder of the user's."""
        from labapp.session.copies import copy_sample

        folder = self._window.preferences.samples_folder / "gtaw"
        path = self._window.workspace.tried(lambda: copy_sample("gtaw", folder))
        if path is not None and self.open(path):
            self._window.say(
                f"This is a copy of the sample, in {path.parent}: change what you like"
            )

    def close(self) -> None:
        """Close the session and go back to the welcome page."""
        if filming.may_close(self._window):
            self._window.workspace.show(None)

    def quit(self) -> None:
        """Close the window."""
        if filming.may_close(self._window):
            self._window.close()

    def forget(self, path: Path) -> None:
        """Take a session off the list of recent ones; the file stays."""
        self._window.remember(lambda before: before.without_recent(path))
        self.list_recent()

    def _create(self, proposed: Path) -> bool:
        from labapp.session.session import Session

        path = dialogs.ask_new_session(self._window, proposed)
        if path is None or not filming.may_close(self._window):
            return False
        session = self._window.workspace.tried(lambda: Session.create(path))
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
        self._window.remember(lambda before: before.with_recent(session.path))
        self._window.workspace.show(session)
        missing = self._window.workspace.tried(lambda: session.missing_recording)
        if missing is not None:
            words = f"The recording is not where it was: {missing}"
            self._window.workspace.say_wrong(MISSING, words)

    def list_recent(self) -> None:
        """List the sessions opened before, in the menu and on the welcome page."""
        self._window.recall()
        self._window.menus.show_recent(self._window.preferences.recent)
        if self._window.workspace.session is None:
            self._window.welcome.show_recent(
                [Path(name) for name in self._window.preferences.recent]
            )


def title(session: Session | None) -> str:
    """Title of a window with a session, or with none."""
    if session is None:
        return "labapp"
    return f"{session.path.stem}{' (read-only)' if session.read_only else ''} — labapp"
