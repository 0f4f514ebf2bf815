"""Layouts that are filled in one call."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TypeVar

from PySide6.QtCore import Qt
from PySide6.QtWidgets import (
    QApplication,
    QBoxLayout,
    QFrame,
    QHBoxLayout,
    QLayout,
    QScrollArea,
    QTabWidget,
    QVBoxLayout,
    QWidget,
)

from labapp.gui.widgets.labels import heading

Part = QWidget | QLayout | int | tuple[QWidget | QLayout, int]
"""A widget or a layout, alone or with its stretch; a number is an empty stretch."""

L = TypeVar("L", bound=QBoxLayout)


def fill(layout: L, *parts: Part) -> L:
    """Append parts to a layout; returns the layout."""
    for part in parts:
        if isinstance(part, int):
            layout.addStretch(part)
            continue
        each, stretch = part if isinstance(part, tuple) else (part, 0)
        if isinstance(each, QWidget):
            layout.addWidget(each, stretch)
        else:
            layout.addLayout(each, stretch)
    return layout


def vbox(*parts: Part, of: QWidget | None = None) -> QVBoxLayout:
    """Parts one below the other, without margins; ``of`` is the widget with this layout."""
    return _bare(QVBoxLayout() if of is None else QVBoxLayout(of), parts)


def hbox(*parts: Part, of: QWidget | None = None) -> QHBoxLayout:
    """Parts side by side, without margins; ``of`` is the widget with this layout."""
    return _bare(QHBoxLayout() if of is None else QHBoxLayout(of), parts)


def column_of(*parts: Part) -> QWidget:
    """A widget of parts one below the other, without margins."""
    made = QWidget()
    vbox(*parts, of=made)
    return made


def row_of(*parts: Part) -> QWidget:
    """A widget of parts side by side, without margins."""
    made = QWidget()
    hbox(*parts, of=made)
    return made


def tabs_of(name: str, pages: Mapping[str, QWidget]) -> QTabWidget:
    """Tabs of pages, by their titles; ``name`` is for a screen reader."""
    tabs = QTabWidget()
    tabs.tabBar().setAccessibleName(name)
    for title, page in pages.items():
        tabs.addTab(page, title)
    return tabs


class _ScrollArea(QScrollArea):
    """Scrolls to the widget that Tab leads to, and stays where it is if a widget is disabled.

    Qt passes the focus of a disabled widget on as if Tab were pressed. The button that was clicked
    would move away from the pointer.
    """

    def focusNextPrevChild(self, forward: bool) -> bool:
        """Move the focus; scroll only if the widget that had it can still have it."""
        bar, focus = self.verticalScrollBar(), QApplication.focusWidget()
        before = bar.value()
        moved = super().focusNextPrevChild(forward)
        if focus is not None and not focus.isEnabled():
            bar.setValue(before)
        return moved


def scrolled(widget: QWidget, name: str = "") -> QScrollArea:
    """An area that scrolls a widget; with a name, it can also be scrolled by keys."""
    area = _ScrollArea()
    area.setWidget(widget)
    area.setWidgetResizable(True)
    area.setFrameShape(QFrame.Shape.NoFrame)
    if name:
        area.setAccessibleName(name)
        area.setAccessibleDescription("Arrow keys and Page Up and Down move it")
    else:
        area.setFocusPolicy(Qt.FocusPolicy.NoFocus)
    return area


def reveal(*widgets: QWidget) -> None:
    """Scroll the area around widgets until they are in view, the first one in any case."""
    area = widgets[0].parentWidget()
    while area is not None and not isinstance(area, QScrollArea):
        area = area.parentWidget()
    if area is not None:
        for widget in reversed(widgets):
            area.ensureWidgetVisible(widget, 0, 0)


class Group(QWidget):
    """Parts under a heading; ``column`` is its layout."""

    def __init__(self, words: str, *parts: Part) -> None:
        super().__init__()
        self.column = vbox(heading(words), *parts, of=self)
        self.column.setContentsMargins(0, 6, 0, 0)


def _bare(layout: L, parts: tuple[Part, ...]) -> L:
    layout.setContentsMargins(0, 0, 0, 0)
    return fill(layout, *parts)
