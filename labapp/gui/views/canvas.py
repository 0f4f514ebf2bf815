"""Drawn widgets: a role and a description for screen readers, and a focus frame."""

from __future__ import annotations

from collections.abc import Callable

from PySide6.QtCore import QObject, Qt
from PySide6.QtGui import (
    QAccessible,
    QAccessibleInterface,
    QAction,
    QKeySequence,
    QPainter,
    QPaintEvent,
    QPalette,
)
from PySide6.QtWidgets import QAccessibleWidget, QWidget

from labapp.gui.theme import FollowsTheme


class Drawn(FollowsTheme, QWidget):
    """A drawing to look at; without keys of its own Tab goes past it.

    Parameters
    ----------
    name
        What it shows, for a screen reader.
    keys
        What can be done with the keys, for a screen reader.
    """

    ROLE = QAccessible.Role.Graphic

    def __init__(self, name: str, keys: str = "") -> None:
        super().__init__()
        self._keys = keys
        self.setAccessibleName(name)
        self.describe("")
        if keys:
            self.setFocusPolicy(Qt.FocusPolicy.StrongFocus)

    def describe(self, words: str) -> None:
        """Set the description for screen readers; the keys follow it."""
        parts = (words.strip().rstrip("."), self._keys)
        self.setAccessibleDescription(". ".join(part for part in parts if part))

    def paintEvent(self, _event: QPaintEvent) -> None:
        """Draw the focus frame; what lies on the widget leaves a px at the edge."""
        if self.hasFocus():
            with QPainter(self) as painter:
                self.paint_frame(painter)

    def paint_frame(self, painter: QPainter) -> None:
        """Draw the focus frame."""
        painter.setPen(self.palette().color(QPalette.ColorRole.Highlight))
        painter.drawRect(self.rect().adjusted(0, 0, -1, -1))


class Plotted(Drawn):
    """A drawing that has axes."""

    ROLE = QAccessible.Role.Chart

    def add_menu(self, *works: tuple[str, Callable[[], object]]) -> None:
        """Add a menu for the right button, of words and what they do; Ctrl+C does the first."""
        self.setContextMenuPolicy(Qt.ContextMenuPolicy.ActionsContextMenu)
        for words, work in works:
            action = QAction(words, self)
            action.triggered.connect(lambda *_, do=work: do())
            self.addAction(action)
        copy = self.actions()[0]
        copy.setShortcut(QKeySequence.StandardKey.Copy)
        copy.setShortcutContext(Qt.ShortcutContext.WidgetShortcut)


def _accessible(_class_name: str, thing: QObject) -> QAccessibleInterface | None:
    """Qt has no accessible role for a widget that it does not know."""
    return QAccessibleWidget(thing, thing.ROLE) if isinstance(thing, Drawn) else None


QAccessible.installFactory(_accessible)
