"""Operate the window by mouse and keyboard alone.

A click is sent to the window at the position of the widget: a widget that covers it gets the click.
A widget out of view is reached with Tab, as by an operator without a mouse.
"""

from __future__ import annotations

from pathlib import Path

from PySide6.QtCore import QPoint, QPointF, QRect, Qt, QTimer
from PySide6.QtTest import QTest
from PySide6.QtWidgets import (
    QAbstractButton,
    QApplication,
    QCheckBox,
    QFileDialog,
    QLineEdit,
    QTableWidget,
    QTabWidget,
    QWidget,
)

from labapp.gui.shell.window import MainWindow
from labapp.gui.views.picture import PictureView
from labapp.gui.widgets.fields import ChoiceField, Field

LEFT, NONE = Qt.MouseButton.LeftButton, Qt.KeyboardModifier.NoModifier
CONTROL, SHIFT = Qt.KeyboardModifier.ControlModifier, Qt.KeyboardModifier.ShiftModifier

MOST_TABS = 120

POLL_MS = 20


class Hand:
    """Operates a window as an operator would.

    Parameters
    ----------
    window
        Visible and active.
    """

    def __init__(self, window: MainWindow) -> None:
        self.window = window

    def press(self, key: Qt.Key, modifiers: Qt.KeyboardModifier = NONE) -> None:
        """Press a key on the widget with the focus."""
        if QApplication.activeWindow() is None:  # after a dialog; a desktop would activate it again
            self.window.activateWindow()
            QApplication.processEvents()
        QTest.keyClick(QApplication.focusWidget() or self.window, key, modifiers)
        QApplication.processEvents()  # as between two key presses

    def write(self, text: str) -> None:
        """Replace the text of the widget with the focus."""
        self.press(Qt.Key.Key_A, CONTROL)
        self.type(text)

    def type(self, text: str) -> None:
        """Type into the widget with the focus; a key may move the focus."""
        for letter in text:
            QTest.keyClicks(_focused(), letter)

    def click(self, widget: QWidget, at: QPoint | None = None) -> None:
        """Click a widget; one out of view gets the focus first, which scrolls it into view."""
        if not _is_clickable(widget, at):
            self.go_to(widget)
        assert _is_clickable(widget, at), f"{_name_of(widget)} cannot be seen"
        assert widget.isEnabled(), f"{_name_of(widget)} cannot be used"
        # Through the window, as the desktop sends it.
        window = widget.window()
        place = widget.mapTo(window, at or _hot_spot(widget))
        QTest.mouseClick(window.windowHandle(), LEFT, NONE, place)

    def go_to(self, widget: QWidget) -> None:
        """Press Tab until a widget has the focus."""
        for _ in range(MOST_TABS):
            present = QApplication.focusWidget()
            if present is not None and (present is widget or widget.isAncestorOf(present)):
                return
            self.press(Qt.Key.Key_Tab)
        raise AssertionError(f"Tab does not lead to {_name_of(widget)}")

    def button(self, words: str) -> None:
        """Click the button with this text."""
        self.click(self.find(words))

    def find(self, words: str) -> QAbstractButton:
        """The only visible button with this text."""
        buttons = [
            button
            for button in self.window.findChildren(QAbstractButton)
            if button.text().replace("&", "") == words and button.isVisible()
        ]
        if len(buttons) > 1:  # the button of an empty page is in the side panel, too
            buttons = [each for each in buttons if not self.window.empty.isAncestorOf(each)]
        assert len(buttons) == 1, f"{len(buttons)} buttons “{words}” are in view"
        return buttons[0]

    def enter(self, field: Field, text: str) -> None:
        """Go to a field, write in it, and finish with Enter."""
        self.go_to(field.editor)
        self.write(text)
        self.press(Qt.Key.Key_Return)

    def choose(self, field: ChoiceField, words: str) -> None:
        """Choose from a list by the arrow keys."""
        self.go_to(field.editor)
        self.press(Qt.Key.Key_Home)
        for _ in range(20):
            if field.editor.currentText() == words:
                return
            self.press(Qt.Key.Key_Down)
        raise AssertionError(f"{_name_of(field)} does not offer “{words}”")

    def tick(self, words: str, on: bool) -> None:
        """Check or uncheck a check box."""
        box = self.find(words)
        assert isinstance(box, QCheckBox)
        if box.isChecked() != on:
            self.click(box)

    def tab(self, tabs: QTabWidget, words: str) -> None:
        """Click a tab."""
        bar = tabs.tabBar()
        place = next(k for k in range(bar.count()) if bar.tabText(k).startswith(words))
        self.click(bar, bar.tabRect(place).center())

    def cell(self, table: QTableWidget, row: int, column: int, text: str) -> None:
        """Write into a cell of a table."""
        place = table.visualRect(table.model().index(row, column)).center()
        self.click(table.viewport(), place)
        self.type(text)
        self.press(Qt.Key.Key_Return)

    def point(self, view: PictureView, u: float, v: float) -> QPoint:
        """The widget position of the picture point (u, v), px."""
        place: QPoint = view.canvas.mapFromScene(view.box.mapViewToScene(QPointF(u, v)))
        return place

    def answer(self, path: Path) -> None:
        """Write a path into the next file dialog and press Enter."""
        timer = QTimer(self.window)
        timer.setInterval(POLL_MS)
        timer.timeout.connect(lambda: self._answer(timer, path))
        timer.start()

    def _answer(self, timer: QTimer, path: Path) -> None:
        """Press Enter until it is accepted: the first may go to the list of completions."""
        dialog = QApplication.activeModalWidget()
        if not isinstance(dialog, QFileDialog):
            return
        line = dialog.findChild(QLineEdit)
        assert line is not None
        if line.text() != str(path):
            line.selectAll()
            QTest.keyClicks(line, str(path))
        dialog.finished.connect(timer.stop)
        popup = QApplication.activePopupWidget()
        if popup is not None:
            QTest.keyClick(popup, Qt.Key.Key_Escape)
        QTest.keyClick(line, Qt.Key.Key_Return)


def _focused() -> QWidget:
    focused = QApplication.focusWidget()
    assert focused is not None, "nothing has the focus"
    return focused


def _hot_spot(widget: QWidget) -> QPoint:
    """Where a click takes effect: the box of a check box, the centre of any other widget."""
    if isinstance(widget, QCheckBox):
        return QPoint(10, widget.height() // 2)
    return widget.rect().center()


def _is_clickable(widget: QWidget, at: QPoint | None) -> bool:
    """Whether a click at that position hits the widget and no other that covers it."""
    place = at or _hot_spot(widget)
    window = widget.window()
    inside = QRect(QPoint(), window.size()).contains(widget.mapTo(window, place))
    if not (widget.isVisible() and inside):
        return False
    target = window.childAt(widget.mapTo(window, place))
    return target is not None and (target is widget or widget.isAncestorOf(target))


def _name_of(widget: QWidget) -> str:
    return widget.accessibleName() or getattr(widget, "text", lambda: "")() or repr(widget)
