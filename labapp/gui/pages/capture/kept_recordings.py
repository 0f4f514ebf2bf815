"""Recordings beside a session that are not imported: preview, or use in a new session."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from labapp.gui.drafts import folder_of
from labapp.gui.pages.capture.import_choice import NEXT, NEXT_TIP
from labapp.gui.widgets.buttons import button
from labapp.gui.widgets.fields import ChoiceField, FieldForm
from labapp.gui.widgets.layouts import Group
from labapp.media.recording.recorder import recordings_beside
from labapp.media.recording.take_files import Take
from labapp.session.file.database import SUFFIX
from labapp.session.session import Session


class KeptRecordings(Group):
    """List of these recordings, visible if there are any."""

    def __init__(
        self, look: Callable[[Path], object], begin_next: Callable[[Path], object]
    ) -> None:
        self.choice = ChoiceField("Beside the session", tooltip="Recordings not in the session")
        tip = "Show its frames, and choose which of them to import"
        see = button("Preview", tip, lambda: look(Path(self.choice.value())))
        begin = button(NEXT, NEXT_TIP, lambda: begin_next(Path(self.choice.value())))
        super().__init__("Other recordings", FieldForm(self.choice), see, begin)
        self.hide()

    def list_beside(self, session: Session, running: Take | None) -> None:
        """List the recordings of a session, newest first, without the running one."""
        folder = folder_of(session)
        others = [session.recording_place]
        others += [] if running is None else [running.path]
        try:
            found = recordings_beside(folder, session.path.stem)
        except OSError:
            found = []  # problems of the folder are reported when it is written to
        kept = [path for path in reversed(found) if path not in others]
        self.choice.set_choices([(str(path), _choice_text(path, session)) for path in kept])
        if kept:
            self.choice.set_value(str(kept[0]))
        self.setVisible(bool(kept))


def _choice_text(path: Path, session: Session) -> str:
    """What tells a recording from the others beside the session, and whether it is in another."""
    name = path.name.removeprefix(f"{session.path.stem}-")  # all of them begin like that
    return f"{name}, has its own session" if path.with_suffix(SUFFIX).exists() else name
