"""Drawn widgets: a role and a description for screen readers, and a focus frame."""

from __future__ import annotations

from typing import TYPE_CHECKING

from PySide6.QtCore import QObject, Qt
from PySide6.QtGui import (
    QAccessible,
    QAccessibleInterface,
    QGuiApplication,
    QKeyEvent,
    QPainter,
    QPaintEvent,
    QPalette,
)
from PySide6.QtWidgets import QAccessibleWidget, QWidget

from labapp.gui.theme import FollowsTheme

if TYPE_CHECKING:
    import pyqtgraph as pg

ZOOM = 1.25
"""Factor of a zoom by a key."""


class Drawn(FollowsTheme, QWidget):
    """A drawing, with its name and its keys for a screen reader; without keys it gets no focus."""

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
        """Draw the focus frame, in a margin of 1 px that child widgets leave free."""
        if self.hasFocus():
            with QPainter(self) as painter:
                self.paint_frame(painter)

    def paint_frame(self, painter: QPainter) -> None:
        """Draw the focus frame."""
        painter.setPen(self.palette().color(QPalette.ColorRole.Highlight))
        painter.drawRect(self.rect().adjusted(0, 0, -1, -1))


class Plotted(Drawn):
    """A drawing with axes in its ``canvas``: + and − zoom, F shows all."""

    ROLE = QAccessible.Role.Chart
    canvas: pg.GraphicsView

    def copy_picture(self) -> None:
        """Copy the visible picture to the clipboard."""
        QGuiApplication.clipboard().setPixmap(self.canvas.grab())

    def fit(self) -> None:
        """Show all."""

    def zoom(self, factor: float) -> None:
        """Zoom about the centre; a factor above 1 enlarges."""

    def keyPressEvent(self, event: QKeyEvent) -> None:
        """Zoom, or show all."""
        if event.key() in (Qt.Key.Key_Plus, Qt.Key.Key_Equal):
            self.zoom(ZOOM)
        elif event.key() == Qt.Key.Key_Minus:
            self.zoom(1 / ZOOM)
        elif event.key() == Qt.Key.Key_F:
            self.fit()
        else:
            super().keyPressEvent(event)


def _accessible(_class_name: str, thing: QObject) -> QAccessibleInterface | None:
    """Accessible interface with the role of a drawing, which Qt cannot know."""
    return QAccessibleWidget(thing, thing.ROLE) if isinstance(thing, Drawn) else None


QAccessible.installFactory(_accessible)
