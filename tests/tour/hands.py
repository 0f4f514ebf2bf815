"""Operate the window in the tour: press, type, wait until it is idle, and take pictures."""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from dataclasses import dataclass, field
from hashlib import sha256
from pathlib import Path
from typing import TypeVar

import numpy as np
from PySide6.QtCore import (
    QDir,
    QElapsedTimer,
    QEventLoop,
    QPoint,
    QPointF,
    QRect,
    Qt,
    QTimer,
)
from PySide6.QtGui import QColor, QImage, QPainter
from PySide6.QtTest import QTest
from PySide6.QtWidgets import (
    QAbstractButton,
    QApplication,
    QComboBox,
    QDialog,
    QFileDialog,
    QLineEdit,
    QListView,
    QMenu,
    QMenuBar,
    QScrollArea,
    QTableWidget,
    QWidget,
)

from labapp.gui.pages.page import Page
from labapp.gui.shell.window import MainWindow
from labapp.gui.views.picture import PictureView
from labapp.gui.views.view3d import View3d
from labapp.gui.views.view3d_kinds import InteractiveView
from labapp.gui.widgets.fields import ChoiceField, Field

LONGEST_MS = 300_000
"""Longest wait before the tour fails."""

LOOK_MS = 5

NESTED = 32
"""More than the depth of nested layouts: each level grows with an event of its own."""

TITLE_PX = 24
"""Height of the title that is drawn over a dialog, whose frame belongs to the desktop."""

LEAST_SPREAD = 3.0
"""A 3-D view with a smaller standard deviation of grey levels is blank."""

NONE, SHIFT, CTRL = (
    Qt.KeyboardModifier.NoModifier,
    Qt.KeyboardModifier.ShiftModifier,
    Qt.KeyboardModifier.ControlModifier,
)
LEFT = Qt.MouseButton.LeftButton

T = TypeVar("T", bound=QWidget)
P = TypeVar("P", bound=Page)


class TourFailed(Exception):
    """The app failed; names the page and the error."""


@dataclass
class Hands:
    """Drives a window as an operator does.

    Parameters
    ----------
    window
        The window.
    out
        Folder for the pictures.
    size_px
        Width and height of the pictures, screen px.

    Attributes
    ----------
    pages
        Keys of the pages that have a picture.
    """

    window: MainWindow
    out: Path
    size_px: tuple[int, int]
    count: int = field(default=0, init=False)
    pictures: dict[bytes, str] = field(default_factory=dict, init=False)
    pages: set[str] = field(default_factory=set, init=False)

    # --- waiting -----------------------------------------------------------------------------

    def fail(self, words: str) -> TourFailed:
        """The exception to raise for an error on the visible page."""
        return TourFailed(f"{self.page}: {words}")

    @property
    def page(self) -> str:
        """Key of the visible page."""
        return "welcome" if self.window.page is None else self.window.page.key

    def wait(self, until: Callable[[], object], what: str) -> None:
        """Process events until a condition is met."""
        QApplication.processEvents()
        if until():
            return
        loop, look, limit = QEventLoop(), QTimer(), QTimer()
        look.timeout.connect(lambda: loop.quit() if until() else None)
        limit.timeout.connect(lambda: loop.exit(1))
        look.start(LOOK_MS)
        limit.start(LONGEST_MS)
        late = loop.exec()
        for timer in (look, limit):
            timer.stop()
        if late:
            working = ", ".join(task.title for task in self.window.workspace.tasks.active)
            running = f" ({working} is under way)" if working else ""
            raise self.fail(f"waited {LONGEST_MS // 1000} s in vain for {what}{running}")

    def settle(self) -> None:
        """Wait until no task is running and no single-shot timer is active."""
        self.wait(self._is_idle, "work to end")

    def _is_idle(self) -> bool:
        for _ in range(NESTED):
            QApplication.sendPostedEvents()
        timers = self.window.findChildren(QTimer)
        due = any(timer.isActive() and timer.isSingleShot() for timer in timers)
        return not due and not self.window.workspace.tasks.active

    # --- actions -----------------------------------------------------------------------------

    def begin(self) -> None:
        """Resize the window to the size of the pictures."""
        ratio = self.window.devicePixelRatioF()
        # At 150 % a screen may end within a layout pixel: the rest is cut off.
        self.window.resize(*(math.ceil(side / ratio) for side in self.size_px))
        self.wait(self.window.isVisible, "the window to be seen")

    def on(self, kind: type[P]) -> P:
        """The visible page, which must be of this type."""
        page = self.window.page
        if not isinstance(page, kind):
            reason = "; ".join(self.window.status_line.unread) or "the page does not come"
            raise TourFailed(f"{kind.key}: {reason}")
        self.settle()
        return page

    def dismiss(self) -> None:
        """Dismiss the problem on the status line."""
        self.press("Dismiss")

    def do(self, name: str) -> None:
        """Trigger a menu action."""
        action = self.window.menus.actions[name]
        if not action.isEnabled():
            raise self.fail(f"“{action.text()}” is greyed out")
        action.trigger()

    def find(self, kind: type[T], words: str, words_of: Callable[[T], str]) -> T:
        """The only visible widget with this text."""
        widgets = [
            widget
            for widget in self.window.findChildren(kind)
            if widget.isVisible() and words_of(widget).replace("&", "") == words
        ]
        if len(widgets) > 1:  # the button of an empty page is in the side panel, too
            widgets = [each for each in widgets if not self.window.empty.isAncestorOf(each)]
        if len(widgets) != 1:
            raise self.fail(f"{len(widgets)} of “{words}” are in view, not one")
        return self.reveal(widgets[0])

    def reveal(self, widget: T) -> T:
        """Scroll to a widget."""
        parent = widget.parentWidget()
        while parent is not None:
            if isinstance(parent, QScrollArea):
                QApplication.processEvents()
                parent.ensureWidgetVisible(widget)
            parent = parent.parentWidget()
        return widget

    def press(self, words: str) -> None:
        """Press the button with this text."""
        button = self.find(QAbstractButton, words, QAbstractButton.text)
        if not button.isEnabled():
            raise self.fail(f"“{words}” cannot be pressed: {button.toolTip()}")
        QTest.mouseClick(
            button, LEFT, pos=QPoint(min(12, button.width() // 2), button.height() // 2)
        )

    def activate(self) -> None:
        """Activate the window, so that it gets key events."""
        if not self.window.isActiveWindow():
            self.window.activateWindow()
            self.wait(self.window.isActiveWindow, "the keys to go to the window")

    def key(self, key: Qt.Key, modifiers: Qt.KeyboardModifier = NONE) -> None:
        """Press a key on the visible page."""
        assert self.window.page is not None
        self.activate()
        QTest.keyClick(self.window.page.focusProxy() or self.window.page, key, modifiers)

    def enter(self, label: str, text: str) -> None:
        """Type a text into the field with this label."""
        editor = self.find(Field, label, lambda one: one.label.text()).editor
        self.activate()
        editor.setFocus()
        QTest.keyClick(editor, Qt.Key.Key_A, CTRL)
        QTest.keyClicks(editor, text)
        QTest.keyClick(editor, Qt.Key.Key_Tab)

    def enter_cell(self, table: QTableWidget, row: int, column: int, text: str) -> None:
        """Type a text into a cell of a table."""
        self.activate()
        table.setFocus()
        table.setCurrentCell(row, column)
        QTest.keyClicks(table, text[0])

        def editors() -> list[QLineEdit]:
            lines = table.viewport().findChildren(QLineEdit)
            return [editor for editor in lines if editor.isVisible()]

        self.wait(editors, "the cell to be opened")
        QTest.keyClicks(editors()[0], text[1:])
        QTest.keyClick(editors()[0], Qt.Key.Key_Return)
        self.wait(lambda: not editors(), "the cell to be left")

    def choose(self, label: str, words: str) -> None:
        """Choose the entry that starts with `words` in the list with this label."""
        combo = self.find(ChoiceField, label, lambda one: one.label.text()).editor
        assert isinstance(combo, QComboBox)
        places = [k for k in range(combo.count()) if combo.itemText(k).startswith(words)]
        if len(places) != 1:
            raise self.fail(f"“{label}” has {len(places)} choices that begin with “{words}”")
        combo.showPopup()
        view = combo.view()
        view.setCurrentIndex(combo.model().index(places[0], 0))
        QTest.keyClick(view, Qt.Key.Key_Return)

    def click_row(self, table: QTableWidget, row: int) -> None:
        """Click a row of a table."""
        self.reveal(table)
        at = table.visualRect(table.model().index(row, 0)).center()
        QTest.mouseClick(table.viewport(), LEFT, pos=at)

    def click(self, view: PictureView, place: tuple[float, float], twice: bool = False) -> None:
        """Click or double-click at (u, v) in a picture, px."""
        at, port = _in_view(view, place), view.canvas.viewport()
        QTest.mouseClick(port, LEFT, pos=at)
        if twice:
            QTest.mouseDClick(port, LEFT, pos=at)
            QTest.mouseRelease(port, LEFT, pos=at)

    def drag(self, view: PictureView, start: tuple[float, float], end: tuple[float, float]) -> None:
        """Drag in a picture from one point (u, v) to another, px."""
        port = view.canvas.viewport()
        first, last = _in_view(view, start), _in_view(view, end)
        QTest.mousePress(port, LEFT, pos=first)
        for part in (0.3, 0.6, 1.0):
            QTest.mouseMove(port, first + (last - first) * part)
            QTest.qWait(LOOK_MS)  # the picture limits the rate of move events
        QTest.mouseRelease(port, LEFT, pos=last)

    # --- pictures ----------------------------------------------------------------------------

    def picture(self, name: str = "", *, trouble: bool = False, busy: bool = False) -> None:
        """Take a picture of the idle window and of the dialogs and menus over it.

        Parameters
        ----------
        name
            What the picture shows, added to the name of the page; ``dialog-…`` for a dialog.
        trouble
            Whether the status line must show a problem; else it must show none.
        busy
            Whether to take the picture while a task is running.
        """
        if busy:
            self.wait(lambda: self.window.workspace.tasks.active, "work to begin")
        else:
            self.settle()
        unread = self.window.status_line.unread
        if bool(unread) != trouble:
            raise self.fail("; ".join(unread) or "a problem that should be told is not")
        image = self._seen()
        wide, high = image.width(), image.height()
        excess = (wide - self.size_px[0], high - self.size_px[1])
        if not all(0 <= px < self.window.devicePixelRatioF() for px in excess):
            raise self.fail(f"the window is {wide}×{high} px large, not as it was asked for")
        image = image.copy(0, 0, *self.size_px)
        self.count += 1
        self.pages.add(self.page)
        part = name if name.startswith("dialog-") else "-".join(filter(None, (self.page, name)))
        file = self.out / f"{self.count:03d}-{part}.png"
        same = self.pictures.setdefault(sha256(image.constBits()).digest(), file.name)
        if same != file.name:
            raise self.fail(f"{file.name} would show the same as {same}")
        if not image.save(str(file)):
            raise self.fail(f"{file} cannot be written")
        titles = [widget.windowTitle() for widget in _over(self.window)]
        print("  ".join(filter(None, (file.name, *titles))), flush=True)

    def _seen(self) -> QImage:
        image = self.window.grab().toImage().convertToFormat(QImage.Format.Format_RGB32)
        with QPainter(image) as painter:
            for view in self.window.findChildren(View3d):
                self._paint_3d(painter, view)
            for widget in _over(self.window):
                self._paint_over(painter, widget)
        return image

    def _paint_3d(self, painter: QPainter, view: View3d) -> None:
        """Paint a 3-D view, which Qt cannot grab; fail if it is blank."""
        if not view.isVisible() or view.scene is None:
            return
        pixels = view.picture()
        if pixels is None or float(np.std(pixels.mean(axis=2))) < LEAST_SPREAD:
            raise self.fail(f"“{view.accessibleName()}” shows nothing")
        if isinstance(view, InteractiveView):
            image = view.image()
            assert image is not None
            inner = view.rect().adjusted(1, 1, -1, -1)  # inside the focus frame
            painter.drawImage(QRect(view.mapTo(self.window, inner.topLeft()), inner.size()), image)

    def _paint_over(self, painter: QPainter, widget: QWidget) -> None:
        """Paint a dialog or a menu at its place; a dialog with a title bar, as on a desktop."""
        is_dialog = isinstance(widget, QDialog)
        top = TITLE_PX if is_dialog else 0
        room = self.window.rect().adjusted(0, top, -widget.width(), -widget.height())
        if room.width() < 1 or room.height() < 1:
            raise self.fail(f"“{widget.windowTitle()}” is larger than the window")
        at = self.window.mapFromGlobal(widget.mapToGlobal(QPoint(0, 0)))
        at = QPoint(
            max(room.left(), min(at.x(), room.right())), max(room.top(), min(at.y(), room.bottom()))
        )
        if is_dialog:
            strip = QRect(at.x(), at.y() - top, widget.width(), top)
            painter.fillRect(strip, widget.palette().highlight())
            painter.setPen(widget.palette().highlightedText().color())
            painter.drawText(strip, Qt.AlignmentFlag.AlignCenter, widget.windowTitle())
        painter.drawPixmap(at, widget.grab())
        painter.setPen(QColor("#808080"))
        painter.drawRect(QRect(at, widget.size()).adjusted(-1, -top - 1, 0, 0))

    # --- menus and dialogs -------------------------------------------------------------------

    def menu(self, words: str) -> None:
        """Open a menu of the menu bar, take its picture, and close it."""
        bar: QMenuBar = self.window.menuBar()
        action = next(a for a in bar.actions() if a.text().replace("&", "") == words)
        menu, at = action.menu(), bar.actionGeometry(action).center()
        assert isinstance(menu, QMenu)
        self.popup(menu, words.lower(), lambda: QTest.mouseClick(bar, LEFT, pos=at))

    def popup(self, menu: QMenu, name: str, show: Callable[[], object]) -> None:
        """Show a menu, take its picture, and close it; ``show`` may block until then."""

        def take_picture(menu: QMenu) -> None:
            self.picture(f"menu-{name}")
            QTest.keyClick(menu, Qt.Key.Key_Escape)
            menu.close()

        self._handle(
            f"the menu {name}", show, lambda: menu if menu.isVisible() else None, take_picture
        )

    def answer_dialog(
        self, name: str, do: Callable[[], object], answer: Callable[[QDialog], object] | None = None
    ) -> None:
        """Open a modal dialog, take its picture, and answer it.

        Parameters
        ----------
        name
            Name of the picture; empty for no picture.
        do
            Opens the dialog; may block until it is closed.
        answer
            Answers the dialog; by default Escape is pressed.
        """
        timer = QElapsedTimer()
        timer.start()

        def dialog_if_filled() -> QDialog | None:
            dialog = QApplication.activeModalWidget()
            if isinstance(dialog, QDialog) and (_is_filled(dialog) or timer.hasExpired(LONGEST_MS)):
                return dialog
            return None

        def handle(dialog: QDialog) -> None:
            if not _is_filled(dialog):
                raise self.fail(f"“{dialog.windowTitle()}” never shows what it is about")
            if name:
                self.picture(f"dialog-{name}")
            if answer is None:
                QTest.keyClick(dialog, Qt.Key.Key_Escape)
            else:
                answer(dialog)
            if dialog.isVisible():
                raise self.fail(f"“{dialog.windowTitle()}” stays open")

        self._handle(f"the dialog {name}", do, dialog_if_filled, handle)

    def _handle(
        self,
        what: str,
        do: Callable[[], object],
        detect: Callable[[], T | None],
        handle: Callable[[T], None],
    ) -> None:
        """Open a dialog or menu, and handle it from within its event loop."""
        ended: list[Exception | None] = []
        look = QTimer()

        def check() -> None:
            widget = detect()
            if widget is None:
                return
            look.stop()
            try:
                handle(widget)
                ended.append(None)
            except Exception as error:
                ended.append(error)
                widget.close()

        look.timeout.connect(check)
        look.start(LOOK_MS)
        do()
        self.wait(lambda: ended, what)
        if ended[0] is not None:
            raise ended[0]


def _in_view(view: PictureView, place: tuple[float, float]) -> QPoint:
    at: QPoint = view.canvas.mapFromScene(view.box.mapViewToScene(QPointF(*place)))
    return at


def enter_path(path: Path) -> Callable[[QDialog], None]:
    """Return a function that enters a path into a file dialog."""

    def answer(dialog: QDialog) -> None:
        line = dialog.findChild(QLineEdit, "fileNameEdit")
        assert isinstance(line, QLineEdit)
        line.selectAll()
        line.insert(str(path))
        QTest.keyClick(line, Qt.Key.Key_Return)

    return answer


def _is_filled(dialog: QDialog) -> bool:
    """Whether a dialog shows its content: the list of files is read in the background."""
    if not dialog.isVisible():
        return False
    files = dialog.findChild(QListView, "listView")
    if not isinstance(dialog, QFileDialog) or files is None:
        return True
    patterns = re.findall(r"\*[^\s)]*", dialog.selectedNameFilter())
    kinds = QDir.Filter.AllDirs | QDir.Filter.NoDotAndDotDot
    if dialog.fileMode() != QFileDialog.FileMode.Directory:
        kinds |= QDir.Filter.Files
    entries = dialog.directory().entryList(patterns, kinds)
    return not entries or files.model().rowCount(files.rootIndex()) > 0


def _over(window: MainWindow) -> list[QWidget]:
    """Dialogs and menus that are open over the window; the active one comes last."""
    over = [
        widget
        for widget in QApplication.topLevelWidgets()
        if widget is not window and widget.isVisible() and isinstance(widget, QDialog | QMenu)
    ]
    active = (QApplication.activeModalWidget(), QApplication.activePopupWidget())
    return sorted(over, key=lambda widget: widget in active)
