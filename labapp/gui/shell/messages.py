"""Messages: the status line, which keeps a problem until it is read, and the log."""

from __future__ import annotations

import datetime

from PySide6.QtCore import QSize, Qt, Signal
from PySide6.QtGui import QKeyEvent, QKeySequence
from PySide6.QtWidgets import (
    QAbstractItemView,
    QApplication,
    QHBoxLayout,
    QListWidget,
    QListWidgetItem,
    QProgressBar,
    QWidget,
)

from labapp.gui.tasks import PROBLEM, Tasks
from labapp.gui.widgets.buttons import button
from labapp.gui.widgets.labels import Message, plain_label, set_font
from labapp.gui.widgets.layouts import fill

KEPT_MESSAGES = 1000

TOLD = Qt.ItemDataRole.UserRole
"""Data of a line of the log: its text, the time of its first occurrence, and the count."""


class LogPanel(QListWidget):
    """All messages, the last at the end."""

    def __init__(self) -> None:
        super().__init__()
        self.setAccessibleName("Messages")
        self.setToolTip("All messages since the app was started; Ctrl+C copies those selected")
        self.setSelectionMode(QAbstractItemView.SelectionMode.ExtendedSelection)
        self.setWordWrap(True)
        self.setTextElideMode(Qt.TextElideMode.ElideNone)
        self.setHorizontalScrollBarPolicy(Qt.ScrollBarPolicy.ScrollBarAlwaysOff)
        self.setMinimumHeight(self.fontMetrics().height() * 2)

    def sizeHint(self) -> QSize:
        """Height of some lines; the operator can change it."""
        return QSize(400, self.fontMetrics().height() * 6)

    def add(self, text: str, problem: bool) -> None:
        """Add a message; a repeated one is counted in the same line."""
        now = datetime.datetime.now().strftime("%H:%M:%S")
        message = f"{PROBLEM + ' ' if problem else ''}{text}"
        last = self.item(self.count() - 1) if self.count() else None
        if last is not None and last.data(TOLD)[0] == message:
            _, first, times = last.data(TOLD)
            last.setData(TOLD, (message, first, times + 1))
            last.setText(f"{now}  {message} ({times + 1} times since {first})")
            return
        item = QListWidgetItem(f"{now}  {message}")
        item.setData(TOLD, (message, now, 1))
        set_font(item, bold=problem)
        self.addItem(item)
        if self.count() > KEPT_MESSAGES:
            self.takeItem(0)
        self.scrollToBottom()

    def texts(self) -> list[str]:
        """The displayed messages."""
        return [self.item(row).text() for row in range(self.count())]

    def keyPressEvent(self, event: QKeyEvent) -> None:
        """Copy the selected messages."""
        if event.matches(QKeySequence.StandardKey.Copy):
            chosen = sorted(self.selectedItems(), key=self.row)
            QApplication.clipboard().setText("\n".join(item.text() for item in chosen))
        else:
            super().keyPressEvent(event)


class StatusLine(QWidget):
    """The last message, and the progress of the current work.

    A problem stays until it is dismissed or solved, even if other messages follow.
    """

    messages_requested = Signal()
    """The list of all messages is to be shown or hidden."""

    def __init__(self, tasks: Tasks) -> None:
        super().__init__()
        self._tasks = tasks
        self.unread: list[str] = []
        """Problems; the last one is shown."""
        self._urgent: set[str] = set()
        self.message = Message(1)
        self.message.setAccessibleName("Last message")
        tip = "Remove the problem from this line; it stays among the messages (F4)"
        self.dismiss_button = button("Dismiss", tip, self.mark_read)
        self.dismiss_button.setAccessibleName("Dismiss the problem")
        tip = "Show or hide all messages (F4)"
        self.show_button = button("Messages", tip, self.messages_requested.emit)
        self.show_button.setFocusPolicy(Qt.FocusPolicy.NoFocus)  # it has a keyboard shortcut
        self.title = plain_label()
        self.bar = QProgressBar()
        self.bar.setFixedWidth(180)
        self.bar.setFormat("%v of %m")
        self.bar.setAccessibleName("Progress")
        tip = "Stop the work under way; what is finished is kept (Ctrl+.)"
        self.cancel_button = button("Cancel", tip, self.cancel)
        self.cancel_button.setAccessibleName("Cancel the work under way")
        layout = QHBoxLayout(self)
        layout.setContentsMargins(6, 0, 6, 0)
        right = (self.title, self.bar, self.cancel_button, self.show_button)
        fill(layout, self.dismiss_button, (self.message, 1), *right)
        # Widgets that appear and disappear must not move the window's other parts.
        self.setMinimumHeight(layout.sizeHint().height())
        tasks.changed.connect(self.show_progress)
        tasks.progressed.connect(self.show_progress)
        tasks.stopped.connect(lambda title: self.say(f"{title}: cancelled", False))
        self.show_progress()
        self._show_message("")

    def say(self, text: str, problem: bool) -> None:
        """Show a message unless there is an unread problem; each problem is counted once."""
        if problem:
            unread = [*(each for each in self.unread if each != text), text]
            self.unread[:] = sorted(unread, key=self._urgent.__contains__)
            text = self.unread[-1]
        elif self.unread:
            return
        self._show_message(text)

    def put_first(self, text: str) -> None:
        """Show this problem ahead of those that are not urgent, once it is reported."""
        self._urgent.add(text)

    def settle(self, text: str) -> None:
        """Remove a solved problem from the line, read or not; the log keeps it."""
        if text in self.unread:
            self.unread.remove(text)
            self._show_message(self.unread[-1] if self.unread else "")

    def mark_read(self) -> None:
        """Remove the problems, and any other message, from the line."""
        self.unread.clear()
        self._urgent.clear()
        self._show_message("")

    def cancel(self) -> None:
        """Request all current work to stop."""
        for task in self._tasks.active:
            task.stop()
        self.show_progress()

    def show_progress(self) -> None:
        """Show the progress of the current work, or nothing if there is none."""
        active = self._tasks.active
        for widget in (self.title, self.bar, self.cancel_button):
            widget.setVisible(bool(active))
        if not active:
            return
        task = active[0]
        stopping = task.control.cancelled.is_set()
        others = f" (and {len(active) - 1} more)" if len(active) > 1 else ""
        self.title.setText(f"{task.title}{', stopping…' if stopping else ''}{others}")
        self.bar.setRange(0, task.total)
        self.bar.setValue(task.done)
        self.cancel_button.setEnabled(not all(each.control.cancelled.is_set() for each in active))

    def _show_message(self, text: str) -> None:
        count = len(self.unread)
        more = f" ({count} problems)" if count > 1 else ""
        self.message.setText(f"{PROBLEM} {text}{more}" if count else text)
        set_font(self.message, bold=count > 0)
        self.dismiss_button.setVisible(count > 0)
