"""Sessions and recordings of the window: new, drafts, open, import, copy, the sample."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from PySide6.QtCore import QObject, QTimer, Signal

from labapp.gui import dialogs
from labapp.gui.drafts import folder_of, is_draft, new_draft
from labapp.gui.workspace import MISSING
from labapp.session.file.database import SUFFIX, OnlyReadable, SessionInUse

if TYPE_CHECKING:
    from PySide6.QtWidgets import QWidget

    from labapp.gui.live.view import LiveView
    from labapp.gui.preferences import PreferencesStore
    from labapp.gui.tasks import Control
    from labapp.gui.workspace import Workspace
    from labapp.session.session import Session


TAKEN_BY = {".toml": "setup", **dict.fromkeys((".csv", ".txt", ".tsv", ".tdms"), "trends")}
"""Steps that take the files that are no recordings, by the files' suffixes."""

NO_SESSION = "Open a recording or a session first: the file is for it"


class Files(QObject):
    """Opening and creation of files by the window."""

    step_requested = Signal(str, object, bool)
    """This step is to be shown and to take this file or folder, unless it is None.

    The last argument tells whether a recording is to be imported immediately.
    """
    refused = Signal(str)
    """Reason why an action of the welcome page was refused; empty if it was not."""

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
        """Ask for a file and create a session in it."""
        from labapp.session.session import Session

        proposed = dialogs.new_path(self.preferences.current.folder, "experiment")
        path = dialogs.ask_new_session(self._window, proposed)
        if path is None or not self.may_close():
            return False
        session = self.workspace.run_or_report(lambda: Session.create(path))
        if session is None:
            return False
        self._show(session)
        return True

    def choose(self) -> None:
        """Ask for a session and open it."""
        if path := dialogs.ask_session(self._window, self.preferences.current.folder):
            self.open(path)

    def open_recording(self) -> None:
        """Ask for a recording and show it immediately in a draft."""
        folder = self.preferences.current.folder
        if path := dialogs.ask_recording(self._window, folder, "Open recording"):
            self.begin_draft(path)

    def begin_draft(self, recording: Path) -> None:
        """Show a recording immediately in a session that needs no name yet."""
        if not self.may_close():
            return

        def check(_: Control) -> None:
            from labapp.media import open_source

            open_source(recording).close()

        def opened(_: None) -> None:
            session = self.workspace.run_or_report(
                lambda: new_draft(recording), show_answer=self.refused.emit
            )
            if session is not None:
                self._show(session, recording.parent)
                self.step_requested.emit("capture", recording, True)

        title = f"Opening {recording.name}"
        self.workspace.tasks.start(
            title, check, opened, show_answer=self.refused.emit, kind="Opening a recording"
        )

    def name_draft(self) -> bool:
        """Ask for a file and keep the draft under that name; False if it stays a draft."""
        session = self.workspace.session
        if session is None:
            return False
        draft, folder = session.path, folder_of(session)
        proposed = dialogs.new_path(folder, draft.stem)
        path = dialogs.ask_new_session(self._window, proposed, "Name this session")
        if path is None or not self.may_close():
            return False
        self.workspace.show(None)

        from labapp.session.copies import move_session

        moved = self.workspace.run_or_report(lambda: move_session(draft, path))
        if moved is not None:
            self.preferences.remember(lambda before: before.without_recent(draft))
            self.workspace.notified.emit(f"The session is {path}", False)
        return self.open(moved or draft) and moved is not None

    def forget(self, path: Path) -> None:
        """Remove a session from the recent ones; delete a draft if the operator agrees."""
        if is_draft(path) and path.exists():
            if not dialogs.ask_delete_draft(self._window, path):
                return
            from labapp.session.session import Session

            def delete() -> bool:
                Session.open(path).close()  # refused while another window has it open
                path.unlink()
                return True

            if self.workspace.run_or_report(delete, show_answer=self.refused.emit) is None:
                return
        self.preferences.remember(lambda before: before.without_recent(path))

    def choose_recording(self) -> None:
        """Ask for a recording and import it into the session."""
        if path := dialogs.ask_recording(self._window, self.preferences.current.folder):
            self.take(path)

    def open_path(self, path: Path) -> None:
        """Open a session, pass a set-up or a table to its step, or import anything else."""
        suffix = path.suffix.lower()
        step = TAKEN_BY.get(suffix)
        if suffix == SUFFIX:
            self.open(path)
        elif step is None or path.is_dir():
            self.take(path)
        elif self.workspace.session is None:
            self.refused.emit(NO_SESSION)
            self.workspace.notified.emit(NO_SESSION, True)
        else:
            self.step_requested.emit(step, path, False)

    def open_dropped(self, paths: Sequence[Path]) -> None:
        """Open a dropped file or folder after the other program has got its pointer back."""
        if len(paths) > 1:
            words = "Drop one file, or the folder that holds the images"
            self.workspace.notified.emit(words, True)
        elif paths:
            QTimer.singleShot(0, self, lambda: self.open_path(paths[0]))

    def open(self, path: Path) -> bool:
        """Open a session file, read-only if it is in use elsewhere and the operator agrees."""
        present = self.workspace.session
        if present is not None and path.absolute() == present.path:
            return True
        if not self.may_close():
            return False
        session = self.workspace.run_or_report(
            lambda: self._opened(path), show_answer=self.refused.emit
        )
        if session is None:
            return False
        self._show(session)
        return True

    def take(self, path: Path) -> None:
        """Import a recording into the session, or into a draft if none is open."""
        if not path.exists():
            self.workspace.notified.emit(f"{path} does not exist", True)
        elif self.workspace.session is None:
            self.begin_draft(path)
        else:
            folder = str(path.parent)
            self.preferences.remember(lambda before: replace(before, last_folder=folder))
            self.step_requested.emit("capture", path, False)

    def save_copy(self) -> None:
        """Ask for a file and save a copy of the current session in it."""
        session = self.workspace.session
        if session is None:
            return
        proposed = dialogs.new_path(folder_of(session), f"{session.path.stem} copy")
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
        """Ask for a file, create a session like this one for a recording in it, and show it."""
        present = self.workspace.session
        if present is None:
            return
        from labapp.session.copies import next_session

        title = "New session from this recording"
        proposed = dialogs.new_path(folder_of(present), recording.stem)
        path = dialogs.ask_new_session(self._window, proposed, title)
        if path is None or not self.may_close():
            return
        session = self.workspace.run_or_report(lambda: next_session(present, path))
        if session is not None:
            self._show(session)
            self.step_requested.emit("capture", None, False)

    def try_sample(self, name: str = "gtaw") -> None:
        """Open a copy of a sample session in one of the user's folders."""
        from labapp.session.copies import copy_sample

        folder = self.preferences.current.samples_folder / name
        path = self.workspace.run_or_report(lambda: copy_sample(name, folder))
        if path is not None and self.open(path):
            words = f"This is a copy of the sample, in {path.parent}: change what you like"
            self.workspace.notified.emit(words, False)

    def close(self) -> None:
        """Close the session and go back to the welcome page."""
        if self.may_close():
            self.workspace.show(None)

    def may_close(self) -> bool:
        """Ask what to do with a running recording; False if it continues and nothing closes."""
        camera = self._camera()
        take = None if camera is None else camera.recording
        if camera is None or take is None:
            return True
        answer = dialogs.ask_recording_end(self._window, take.path.name)
        if answer == "discard":
            camera.discard(take)
        return answer != "go on"

    def _opened(self, path: Path) -> Session | None:
        from labapp.session.session import Session

        try:
            return Session.open(path)
        except OnlyReadable as error:
            if not dialogs.ask_read_only(self._window, path, isinstance(error, SessionInUse)):
                return None
            return Session.open(path, read_only=True)

    def _show(self, session: Session, folder: Path | None = None) -> None:
        folder = folder or self.workspace.run_or_report(lambda: folder_of(session))
        self.preferences.remember(lambda before: before.with_recent(session.path, folder))
        self.workspace.show(session)
        missing = self.workspace.run_or_report(lambda: session.missing_recording)
        if missing is not None:
            words = f"The recording is missing: {missing}"
            self.workspace.say_wrong(MISSING, words)
        replaced = self.workspace.run_or_report(lambda: session.replaced_recording)
        if replaced is not None:
            self.workspace.say_wrong(MISSING, f"Not the imported recording: {replaced}")


def title(session: Session | None) -> str:
    """Title of a window with or without a session."""
    if session is None:
        return "labapp"
    notes = (" (draft)" if is_draft(session.path) else "") + " (read-only)" * session.read_only
    return f"{session.path.stem}{notes} — labapp"
