"""What every page of the guided way is to the window."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from PySide6.QtCore import Signal
from PySide6.QtGui import QKeyEvent, QPixmap
from PySide6.QtWidgets import QVBoxLayout, QWidget

from labapp.gui.shell.steps import Lead, State, read_only
from labapp.gui.tasks import DONE, Task, Work
from labapp.gui.widgets.fields import Field
from labapp.gui.widgets.labels import Message
from labapp.gui.widgets.layouts import vbox
from labapp.gui.workspace import Workspace

if TYPE_CHECKING:
    from labapp.gui.live.view import LiveView
    from labapp.session.session import Session


class Page(QWidget):
    """One step: its canvas, which is this widget, and the panel that stands at its right.

    The window calls `refresh` when the page comes into view and whenever, while it is in view, the
    session, its results or the frame in view changed. A page keeps nothing that the session holds.
    """

    key = ""
    """Key of its step in `steps.STEPS`."""
    lead_changed = Signal()
    """What is shown in place of the page changed: see `lead`."""
    shows_all_frames = False
    """Whether it shows what all frames gave, and not only the one in view."""

    def __init__(self, workspace: Workspace) -> None:
        super().__init__()
        self.workspace = workspace
        self.panel = QWidget()
        """Parameters and results; the window puts the step's hint above it."""
        self.canvas_layout = vbox(of=self)
        self.panel_layout = QVBoxLayout(self.panel)
        self.setObjectName(f"page-{self.key}")
        self.panel.setObjectName(f"panel-{self.key}")
        self.answer = Message(2)
        """Says what came of what was pressed: what was done, or why not; stands beside that."""
        self._answers = {self.answer}
        self._changing: list[QWidget] = []
        workspace.opened.connect(self._take_session)

    @property
    def session(self) -> Session:
        """The session that is open; a page is in view only while one is."""
        session = self.workspace.session
        assert session is not None
        return session

    @property
    def locked(self) -> str:
        """Why nothing in the session can be changed; empty if it can."""
        return read_only(self.workspace.session)

    def confirm(self, words: str, beside: Message | None = None) -> None:
        """Say that what was pressed is done: in `answer`, or another message beside that."""
        self._answer_in(beside).setText(f"{DONE} {words}")
        self.workspace.notified.emit(words, False)

    def start_task(
        self,
        title: str,
        work: Work,
        on_done: Callable[[Any], None],
        kind: str = "",
        beside: Message | None = None,
    ) -> Task:
        """Begin work in the background, see `Tasks.start`; `answer` says why it failed."""
        say = self._answer_in(beside).setText
        return self.workspace.tasks.start(title, work, on_done, beside=say, kind=kind)

    def _answer_in(self, beside: Message | None) -> Message:
        """The message that says what came of it; it is emptied with the session."""
        message = beside or self.answer
        self._answers.add(message)
        return message

    def lock_with_session(self, *widgets: QWidget) -> None:
        """Have these, which change the session, be of no use while it is open read-only."""
        self._changing += widgets
        for widget in widgets:
            if not isinstance(widget, Field):
                widget.setProperty("usual tip", widget.toolTip())
        self._lock()

    def _lock(self) -> None:
        why = self.locked
        for widget in self._changing:
            if isinstance(widget, Field):
                widget.lock(why)
            else:
                widget.setEnabled(not why)
                widget.setToolTip(why or widget.property("usual tip"))

    def _take_session(self) -> None:
        """What was said of the former session is of no interest in another."""
        for message in self._answers:
            message.setText("")
        for side in (self, self.panel):
            for field in side.findChildren(Field):
                field.refuse("")
        self._lock()

    def refresh(self) -> None:
        """Show what the session holds now; ``workspace.session`` is not None."""

    def state(self, found: State) -> State:
        """How far the step is, as the session has it or as only the page knows."""
        return found

    def lead(self, found: Lead | None) -> Lead | None:
        """What is shown in place of the page, as the session has it or as only the page knows."""
        return found

    def leave(self) -> None:
        """The page goes out of view, or the window closes: stop what only it needs."""

    def take(self, path: Path, at_once: bool = False) -> None:
        """Take a recording that was dropped on the window or chosen in its menu; for ``capture``.

        The page is in view. ``at_once``: import all of it, and go on to its dots.
        """

    def takes_files(self, paths: Sequence[Path]) -> bool:
        """Take files dropped on the window that are the page's own; whether it did."""
        return False

    @property
    def camera(self) -> LiveView | None:
        """The live camera that the page watches, in view or not; None if it watches none."""
        return None

    def takes_key(self, event: QKeyEvent) -> bool:
        """Do what a plain key means here that nothing in view has taken; whether it did."""
        return False

    def picture(self) -> QPixmap:
        """What *Copy picture* puts on the clipboard."""
        return self.grab()
