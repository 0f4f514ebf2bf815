"""Base class of the pages of the guided procedure."""

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
from labapp.gui.widgets.labels import Message, offer
from labapp.gui.widgets.layouts import vbox
from labapp.gui.workspace import Workspace

if TYPE_CHECKING:
    from labapp.gui.live.view import LiveView
    from labapp.session.session import Session


class Page(QWidget):
    """Page of a step: its canvas, which is this widget, and the panel at its right.

    The window calls `refresh` when the page comes into view and whenever, while it is in view, the
    session, its results or the frame in view changed. A page stores no data of the session.
    """

    key = ""
    """Key of its step in `steps.STEPS`."""
    lead_changed = Signal()
    """The substitute for the page changed, see `lead`."""
    shows_all_frames = False
    """Whether it shows the results of all frames instead of only the one in view."""

    def __init__(self, workspace: Workspace) -> None:
        super().__init__()
        self.workspace = workspace
        self.panel = QWidget()
        """Parameters and results; the window shows the step's instructions above."""
        self.canvas_layout = vbox(of=self)
        self.panel_layout = QVBoxLayout(self.panel)
        self.setObjectName(f"page-{self.key}")
        self.panel.setObjectName(f"panel-{self.key}")
        self.answer = Message(2)
        """Message at the pressed button: what was done, or why it was not."""
        self._answers = {self.answer}
        self._changing: list[QWidget] = []
        self._latest: dict[str, tuple[Task, object]] = {}
        workspace.opened.connect(self._take_session)
        workspace.stepped.connect(self._clear_answers)

    @property
    def session(self) -> Session:
        """The open session; a page is in view only if there is one."""
        session = self.workspace.session
        assert session is not None
        return session

    @property
    def locked(self) -> str:
        """Reason why the session cannot be changed; empty if it can."""
        return read_only(self.workspace.session)

    def confirm(self, words: str, answer: Message | None = None) -> None:
        """Report the success of an action in `answer` or in another message at the button."""
        self._answer_in(answer).setText(f"{DONE} {words}")
        self.workspace.notified.emit(words, False)

    def start_task(
        self,
        title: str,
        work: Work,
        on_done: Callable[[Any], None],
        kind: str = "",
        answer: Message | None = None,
        once: bool = False,
    ) -> Task:
        """Start work in the background, see `Tasks.start`; a failure is shown in `answer`.

        ``once``: return the running work of this title, if there is any, and start no other.
        """
        running = (task for task in self.workspace.tasks.active if task.title == title)
        if once and (task := next(running, None)) is not None:
            return task
        say = self._answer_in(answer).setText
        return self.workspace.tasks.start(title, work, on_done, show_answer=say, kind=kind)

    def start_latest(
        self,
        title: str,
        given: object,
        work: Work,
        on_done: Callable[[Any], None],
        kind: str = "",
    ) -> Task:
        """Start work on what is now wanted; only the latest of its kind is used.

        ``given``: what the work depends on. Running work with the same is returned, and no other
        is started; with something else, it is cancelled, and what it returns is not used.
        """
        name = kind or title
        task, former = self._latest.get(name, (None, None))
        if task is not None and task in self.workspace.tasks.active:
            if former == given and not task.control.cancelled.is_set():
                return task
            task.cancel()

        def done(made: object) -> None:
            if not begun.control.cancelled.is_set():
                on_done(made)

        begun = self.start_task(title, work, done, kind)
        self._latest[name] = begun, given
        return begun

    def _answer_in(self, answer: Message | None) -> Message:
        """The message for an outcome; it is cleared when another session is opened."""
        message = answer or self.answer
        self._answers.add(message)
        return message

    def change_when_edited(self, field: Field, change: Callable[[Session, Any], object]) -> None:
        """Change the session by a function of it and the new value when a field is edited."""
        field.edited.connect(
            lambda value: self.workspace.attempt(
                lambda session: change(session, value), show_answer=self.answer.setText
            )
        )

    def lock_with_session(self, *widgets: QWidget) -> None:
        """Disable these widgets, which change the session, while it is open read-only."""
        self._changing += widgets
        self._lock()

    def _lock(self) -> None:
        why = self.locked
        for widget in self._changing:
            if isinstance(widget, Field):
                widget.lock(why)
            else:
                offer(widget, why)

    def _take_session(self) -> None:
        """Clear messages about the previous session."""
        self._clear_answers()
        for side in (self, self.panel):
            for field in side.findChildren(Field):
                field.refuse("")
        self._lock()

    def _clear_answers(self) -> None:
        """Clear the outcomes of buttons, which do not hold for another state of the session."""
        for message in self._answers:
            message.setText("")

    def refresh(self) -> None:
        """Show the current contents of the session; ``workspace.session`` is not None."""

    def state(self, found: State) -> State:
        """State of the step: that of the session, unless the page knows better."""
        return found

    def lead(self, found: Lead | None) -> Lead | None:
        """Substitute for the page: that of the session, unless the page knows better."""
        return found

    def leave(self) -> None:
        """Stop all that only this page needs, when it is hidden or the window closes."""

    def take(self, path: Path, at_once: bool = False) -> None:
        """Accept a file dropped on the window or chosen in its menu; see `files.TAKEN_BY`.

        The page is in view. ``at_once``: import the whole recording, and go on to its dots.
        """

    def takes_files(self, paths: Sequence[Path]) -> bool:
        """Accept dropped files that concern this page; return whether it did."""
        return False

    @property
    def camera(self) -> LiveView | None:
        """The page's live camera, even if the page is hidden; None if there is none."""
        return None

    def takes_key(self, event: QKeyEvent) -> bool:
        """Handle a plain key that no visible widget handled; return whether it did."""
        return False

    def picture(self) -> QPixmap:
        """The picture that *Copy picture* copies to the clipboard."""
        return self.grab()
