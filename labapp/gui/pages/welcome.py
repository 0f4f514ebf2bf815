"""The welcome page: recently opened sessions, a new one, and samples."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from PySide6.QtCore import QSize, Qt, Signal
from PySide6.QtGui import QColor, QIcon, QImage, QKeyEvent, QPainter, QPixmap
from PySide6.QtWidgets import (
    QCommandLinkButton,
    QFrame,
    QListWidget,
    QListWidgetItem,
    QPushButton,
    QVBoxLayout,
    QWidget,
)

from labapp.bundled import SAMPLE_TEXTS
from labapp.gui.recent import THUMBNAIL_PX, Recent, look_at
from labapp.gui.shell.lead import action_button
from labapp.gui.tasks import Control
from labapp.gui.theme import FollowsTheme
from labapp.gui.widgets.labels import Message, plain_label, plain_tip, set_font, wrapping_label
from labapp.gui.widgets.layouts import fill, hbox, scrolled, vbox
from labapp.gui.workspace import Workspace

BUTTONS = ("open_recording", "open", "new", "study")
"""Actions of the window; the first is the quickest way to a surface."""

WIDTH_PX = 960


class Welcome(FollowsTheme, QWidget):
    """Buttons for a start; recent sessions with thumbnail, date and frames; samples."""

    action_requested = Signal(str)
    """A button was pressed: the name of its action."""
    chosen = Signal(Path)
    """A session of the list was chosen."""
    sample_chosen = Signal(str)
    """A sample was chosen: its name."""
    forgotten = Signal(Path)
    """A session is to be removed from the list."""

    def __init__(self, workspace: Workspace) -> None:
        super().__init__()
        self.setObjectName("page-welcome")
        self._workspace = workspace
        self._shown: tuple[Path, ...] = ()
        self._gone: list[Path] = []
        self.buttons: dict[str, QPushButton] = {}
        self.samples: dict[str, QCommandLinkButton] = {}
        inner = QWidget()
        inner.setMaximumWidth(WIDTH_PX)
        title = plain_label("labapp")
        set_font(title, bold=False, scale=2.2)
        about = wrapping_label(
            "The surface of a molten weld pool, measured from the reflections of a laser "
            "pattern. An experiment is one session file; everything you do is saved in it at once."
        )
        for name in BUTTONS:
            made = self.buttons[name] = action_button(name, self.action_requested.emit)
            made.setMinimumSize(1, made.fontMetrics().height() * 2)  # no wider than other pages
        self.buttons[BUTTONS[0]].setDefault(True)
        self.refused = Message(2)
        self.label = plain_label("&Recent sessions")
        self.list = QListWidget()
        self.list.setAccessibleName("Recent sessions")
        self.list.setToolTip(
            "Enter or a double click opens a session; Delete takes it off the list, or deletes the "
            "draft that it is"
        )
        self.list.setIconSize(QSize(*THUMBNAIL_PX))
        self.list.setTextElideMode(Qt.TextElideMode.ElideMiddle)
        self.list.setHorizontalScrollBarPolicy(Qt.ScrollBarPolicy.ScrollBarAlwaysOff)
        self.list.itemActivated.connect(self._open)
        self.list.setFrameShape(QFrame.Shape.StyledPanel)
        self.list.setAlternatingRowColors(True)
        samples = QWidget()
        for name, text in SAMPLE_TEXTS.items():
            offer = self.samples[name] = QCommandLinkButton(text.title, text.shows)
            offer.setIcon(QIcon())  # the style's arrow is black even on a dark background
            offer.setToolTip("Open a copy of this sample, in a folder of yours")
            offer.setMinimumWidth(1)
            offer.clicked.connect(lambda *_, name=name: self.sample_chosen.emit(name))
        vbox(*self.samples.values(), 1, of=samples).setSpacing(0)
        self.label.setBuddy(self.list)
        self.nothing = wrapping_label(
            "No recent sessions. Open a recording, or drop a video, an image, a folder of "
            "images or a session anywhere on this window; or try a sample."
        )
        recent = vbox(self.label, (self.list, 1), self.nothing, 0)
        offered = vbox(plain_label("Samples"), (scrolled(samples), 1))
        lists = hbox((recent, 3), (offered, 2))
        lists.setSpacing(16)
        buttons = hbox(*self.buttons.values())
        column = fill(QVBoxLayout(inner), title, about, buttons, self.refused, (lists, 1))
        column.setSpacing(12)
        hbox(1, (inner, 100), 1, of=self).setContentsMargins(24, 20, 24, 12)
        self.follow_theme()

    def show_recent(self, paths: Sequence[Path]) -> None:
        """List sessions; their summaries are read in the background."""
        self._shown, self._gone = tuple(paths), []
        self.list.clear()
        for path in paths:
            item = QListWidgetItem(_icon(None), f"{path.stem}\n \n{path.parent}")
            item.setData(Qt.ItemDataRole.UserRole, path)
            item.setToolTip(plain_tip(str(path)))
            self.list.addItem(item)
        for widget in (self.label, self.list):
            widget.setVisible(bool(paths))
        self.nothing.setVisible(not paths)
        if paths:
            self.list.setCurrentRow(0)

            def look(control: Control) -> None:
                for path in paths:
                    control.part(look_at(path))

            self._workspace.tasks.start("Looking at recent sessions", look, on_part=self._show)

    def keyPressEvent(self, event: QKeyEvent) -> None:
        """Remove a session from the list."""
        if event.key() == Qt.Key.Key_Delete and self.list.hasFocus():
            for item in self.list.selectedItems():
                self.forgotten.emit(item.data(Qt.ItemDataRole.UserRole))
        else:
            super().keyPressEvent(event)

    def _show(self, recent: Recent) -> None:
        """Show the summary of a session."""
        if recent.path not in self._shown:
            return
        item = self.list.item(self._shown.index(recent.path))
        item.setText(f"{recent.title}\n{recent.about}\n{recent.path}")
        item.setData(Qt.ItemDataRole.AccessibleTextRole, f"{recent.title}, {recent.about}")
        if not recent.there:
            self._gone.append(recent.path)
            self.take_colours()
        if recent.thumbnail is not None:
            rows, columns = recent.thumbnail.shape
            grey = QImage.Format.Format_Grayscale8
            image = QImage(recent.thumbnail.tobytes(), columns, rows, columns, grey).copy()
            item.setIcon(_icon(image))

    def take_colours(self) -> None:
        """Draw missing sessions in a paler colour."""
        for path in self._gone:
            item = self.list.item(self._shown.index(path))
            item.setForeground(self.palette().placeholderText())

    def _open(self, item: QListWidgetItem) -> None:
        self.chosen.emit(item.data(Qt.ItemDataRole.UserRole))


def _icon(image: QImage | None) -> QIcon:
    """A thumbnail in the middle of a blank of the same size for all: the texts are aligned."""
    picture = QPixmap(*THUMBNAIL_PX)
    picture.fill(QColor(0, 0, 0, 0))
    if image is not None:
        place = image.rect()
        place.moveCenter(picture.rect().center())
        with QPainter(picture) as painter:
            painter.drawImage(place, image)
    return QIcon(picture)
