"""Base class of tool windows: a form, results, and tasks with progress that can be stopped."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path
from typing import TYPE_CHECKING, Any

from PySide6.QtCore import QSize, Qt
from PySide6.QtGui import QCloseEvent
from PySide6.QtWidgets import QDialog, QHBoxLayout, QProgressBar, QPushButton, QVBoxLayout, QWidget

from labapp.errors import os_errors_as_input
from labapp.export.owned_files import write_owned
from labapp.gui.dialogs import ask_folder
from labapp.gui.tasks import PROBLEM, Control, Task, Tasks
from labapp.gui.widgets.buttons import button
from labapp.gui.widgets.fields import FieldForm
from labapp.gui.widgets.labels import Message, offer
from labapp.gui.widgets.layouts import column_of, fill, hbox, scrolled, vbox
from labapp.simulation.parallel import Progress, low_priority

if TYPE_CHECKING:
    from labapp.gui.shell.files import Files

SIZE_PX = (1120, 760)
PART_OF_SCREEN = 0.9
WORKING = "Wait until the work below is done, or cancel it"

FORM_PX = 336
"""Width of the form: a name and two numbers."""


class ToolWindow(QDialog):
    """A window with a form at the left, results at the right and buttons below.

    Closing it stops its task, and keeps the displayed results.
    """

    key = ""
    title = ""
    command = ""
    """Name in code, name for the operator, and the command whose files Save writes."""

    write = staticmethod(write_owned)

    def __init__(self, sessions: Files, window: QWidget) -> None:
        super().__init__(window)
        self.workspace = sessions.workspace
        self.tasks = Tasks(self)
        """Tasks of the tool."""
        self.files: dict[str, bytes] = {}
        """Results as files: name → content."""
        self._task: Task | None = None
        self._pressed: QWidget | None = None
        self.setObjectName(f"tool-{self.key}")
        self.setWindowTitle(self.title)
        self.setWindowFlag(Qt.WindowType.WindowMaximizeButtonHint)
        self.form = FieldForm()
        found = QWidget()
        self.results = vbox(of=found)
        """Layout of the tool's results; its fields are in `form`."""
        self.message = Message(1)
        self.message.setAccessibleName("Last message")
        self.bar = QProgressBar()
        self.bar.setFixedWidth(180)
        self.bar.setFormat("%v of %m")
        self.bar.setAccessibleName("Progress")
        self.buttons = QHBoxLayout()
        self.cancel_button = self.add_button(
            "Cancel", "Stop the work; what is finished is kept (Esc)", self.cancel
        )
        self.close_button = self.add_button(
            "Close", "Close this window and stop its work; what it found is kept", self.close
        )
        self._lay_out(scrolled(found))  # on a small screen
        self._make_form()
        self._make_results()
        self._make_buttons()
        for signal in (self.tasks.changed, self.tasks.progressed):
            signal.connect(self._show_progress)
        self.tasks.failed.connect(lambda _, why: self.say(why, True))
        self.workspace.opened.connect(self.show_state)
        self.workspace.changed.connect(self.show_state)
        self.workspace.notified.connect(self._repeat_message)
        self._show_progress()
        room = self.screen().availableSize() * PART_OF_SCREEN
        self.resize(QSize(*SIZE_PX).boundedTo(room))

    def _lay_out(self, found: QWidget) -> None:
        fields = column_of(self.form, 1)
        fields.setContentsMargins(0, 0, 8, 0)
        side = scrolled(fields)
        side.setHorizontalScrollBarPolicy(Qt.ScrollBarPolicy.ScrollBarAlwaysOff)
        side.setFocusPolicy(Qt.FocusPolicy.NoFocus)
        side.setFixedWidth(FORM_PX + side.verticalScrollBar().sizeHint().width())
        middle = hbox(side, (found, 1))
        fill(QVBoxLayout(self), (middle, 1), hbox((self.message, 1), self.bar), self.buttons)
        self.buttons.insertStretch(0, 1)

    def add_button(self, words: str, tip: str, do: Callable[[], object]) -> QPushButton:
        """Add a button before the existing ones."""
        made = button(words, tip, do)
        self.buttons.insertWidget(0, made)
        return made

    def add_save_button(self, words: str, tip: str) -> None:
        """Add the button that writes `files` to a folder."""
        self.save_button = self.add_button(words, tip, self.choose_folder)

    def add_to_form(self, words: str, tip: str, do: Callable[[], object]) -> None:
        """Add a button below the existing fields."""
        self.form.add(button(words, tip, do))

    # --- what tools say for themselves ---------------------------------------------------------

    def _make_form(self) -> None:
        """Add the fields to `form`."""

    def _make_results(self) -> None:
        """Add the widgets to `results`."""

    def _make_buttons(self) -> None:
        """Add the tool's own buttons, the first one last."""

    def prefill(self) -> None:
        """Fill in values of the session that changed since the last time."""

    def show_state(self) -> None:
        """Enable the actions that are available now."""

    # --- showing, closing ----------------------------------------------------------------------

    def open_beside(self) -> None:
        """Show the window in front, with the values of the session."""
        self.prefill()
        self.show_state()
        if self.focusWidget() is None:
            self._order_keys()
        self.show()
        self.raise_()
        self.activateWindow()

    def _order_keys(self) -> None:
        """Let Tab go from the form's first field through the results to the buttons."""
        items = [self.buttons.itemAt(n) for n in range(self.buttons.count())]
        buttons = [item.widget() for item in items if item is not None]
        for one, next_one in itertools.pairwise(filter(None, buttons)):
            QWidget.setTabOrder(one, next_one)
        tab = Qt.FocusPolicy.TabFocus
        fields = (each for each in self.form.findChildren(QWidget) if each.focusPolicy() & tab)
        next(fields).setFocus()

    def reject(self) -> None:
        """Handle Esc: stop the running task, or close the window if there is none."""
        if self.tasks.active:
            self.cancel()
        else:
            super().reject()

    def closeEvent(self, event: QCloseEvent) -> None:
        """Stop the task."""
        if self.tasks.active:
            self.tasks.cancel_all()
            self.say("Stopped")
        super().closeEvent(event)

    # --- work ----------------------------------------------------------------------------------

    @property
    def working(self) -> bool:
        """Whether a task is running."""
        return bool(self.tasks.active)

    def begin(
        self,
        title: str,
        work: Callable[[Control], Any],
        done: Callable[[Any], None],
        part: Callable[[Any], None] | None = None,
    ) -> None:
        """Start a task, only one at a time; see `Tasks.start`."""

        def behind(control: Control) -> Any:
            try:
                with low_priority():
                    return work(control)
            except BrokenProcessPool as error:
                raise ValueError("a process that simulates has ended: begin again") from error

        if self.working:
            return
        self.say(f"{title}…")
        self._pressed = self.focusWidget()
        self._task = self.tasks.start(title, behind, done, part)
        if self.focusWidget() is not self._pressed:
            self.cancel_button.setFocus()  # it was disabled, and the focus moved to Close

    def cancel(self) -> None:
        """Request the task to stop."""
        for task in self.tasks.active:
            task.cancel()
        self._show_progress()

    def choose_folder(self) -> None:
        """Ask for the folder of the results."""
        title = f"{self.save_button.text().removesuffix('…')} in"
        if folder := ask_folder(self, title, self.workspace.folder):
            self.save(folder)

    def save(self, folder: Path) -> None:
        """Write the results, as the command does."""

        def write() -> Path:
            with os_errors_as_input(folder, "folder", "one that can be written"):
                folder.mkdir(parents=True, exist_ok=True)
            self.write(folder, self.command, self.files)
            return folder

        if self.workspace.run_or_report(write):
            self.say(f"Saved in {folder}")

    def say(self, text: str, problem: bool = False) -> None:
        """Show a message in the line below."""
        self.message.setText(f"{PROBLEM} {text}" if problem else text)

    def _repeat_message(self, text: str, problem: bool) -> None:
        """Show messages of the main window here, too."""
        if self.isVisible():
            self.say(text, problem)

    def _show_progress(self) -> None:
        task, active = self._task, self.working
        self.bar.setVisible(active)
        on_cancel = self.focusWidget() is self.cancel_button
        offer(self.cancel_button, "" if active else "Nothing is under way")
        self.show_state()
        if on_cancel and not active and self._pressed is not None:
            self._pressed.setFocus()
        if task is None:
            return
        stopping = task.control.cancelled.is_set()
        if active:
            stage = "stopping" if stopping else task.control.stage
            self.say(f"{task.title}: {stage}…" if stage else f"{task.title}…")
            self.bar.setRange(0, task.total)
            self.bar.setValue(task.done)
        else:
            self._task = None
            if stopping:
                self.say("Stopped")


def progress_of(control: Control) -> Progress:
    """Progress callback for `labapp.simulation`; it raises when the task is cancelled."""
    return lambda what, done, total: control.progress(done, total, what)
