"""Buttons and check boxes."""

from __future__ import annotations

from collections.abc import Callable

from PySide6.QtCore import Qt
from PySide6.QtGui import QAction, QKeySequence
from PySide6.QtWidgets import QCheckBox, QPushButton, QToolButton, QWidget


def button(text: str, tip: str, work: Callable[[], object]) -> QPushButton:
    """A button that calls ``work``; its tooltip is also its description for screen readers."""
    button = QPushButton(text)
    button.setToolTip(tip)
    button.setAutoDefault(False)  # in a dialog Enter would press it, but Enter finishes a field
    button.clicked.connect(lambda _: work())
    return button


def tool_button(
    text: str, tip: str, work: Callable[[], object], button: QToolButton | None = None
) -> QToolButton:
    """A small button of a bar, which the keyboard reaches; ``button`` is one made before."""
    button = button or QToolButton()
    button.setText(text)
    button.setToolTip(tip)
    button.setFocusPolicy(Qt.FocusPolicy.StrongFocus)
    button.clicked.connect(lambda _: work())
    return button


def check_box(text: str, tip: str, toggled: Callable[[bool], object]) -> QCheckBox:
    """A check box that calls ``toggled`` with its new state."""
    box = QCheckBox(text)
    box.setToolTip(tip)
    box.toggled.connect(toggled)
    return box


def add_action(
    widget: QWidget, words: str, work: Callable[[], object], key: str = "", tip: str = ""
) -> None:
    """Add an action to a widget; its key works while the widget has the focus."""
    action = QAction(words, widget)
    if tip:
        action.setToolTip(f"{tip} ({key})")
    action.setShortcut(QKeySequence(key))
    action.setShortcutContext(Qt.ShortcutContext.WidgetShortcut)
    action.triggered.connect(lambda *_: work())
    widget.addAction(action)


def add_menu(widget: QWidget, *works: tuple[str, Callable[[], object]]) -> None:
    """Add functions to the context menu of a widget by their texts; Ctrl+C calls its first one."""
    widget.setContextMenuPolicy(Qt.ContextMenuPolicy.ActionsContextMenu)
    for words, work in works:
        add_action(widget, words, work, "" if widget.actions() else "Ctrl+C")
