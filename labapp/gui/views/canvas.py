"""What is drawn rather than written: a role and words for screen readers, a frame with the keys."""

from __future__ import annotations

from PySide6.QtCore import QObject, Qt
from PySide6.QtGui import QAccessible, QAccessibleInterface, QPainter, QPaintEvent, QPalette
from PySide6.QtWidgets import QAccessibleWidget, QWidget


class Drawn(QWidget):
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
        """Say what is to be seen now; the keys are said after it."""
        told = (words.strip().rstrip("."), self._keys)
        self.setAccessibleDescription(". ".join(part for part in told if part))

    def paintEvent(self, _event: QPaintEvent) -> None:
        """Frame it while it has the keys; what lies on it leaves a px at the edge."""
        if self.hasFocus():
            with QPainter(self) as painter:
                self.paint_frame(painter)

    def paint_frame(self, painter: QPainter) -> None:
        """Draw the frame that tells where the keys go."""
        painter.setPen(self.palette().color(QPalette.ColorRole.Highlight))
        painter.drawRect(self.rect().adjusted(0, 0, -1, -1))


class Plotted(Drawn):
    """A drawing that has axes."""

    ROLE = QAccessible.Role.Chart


def _accessible(_class_name: str, thing: QObject) -> QAccessibleInterface | None:
    """Qt tells nothing of a widget that it does not know: not even that it is a picture."""
    return QAccessibleWidget(thing, thing.ROLE) if isinstance(thing, Drawn) else None


QAccessible.installFactory(_accessible)
