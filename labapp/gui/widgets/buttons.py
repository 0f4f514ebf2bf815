"""Buttons."""

from __future__ import annotations

from collections.abc import Callable

from PySide6.QtWidgets import QPushButton


def button(words: str, tip: str, work: Callable[[], object]) -> QPushButton:
    """A button that does something."""
    button = QPushButton(words)
    button.setToolTip(tip)
    button.clicked.connect(lambda _: work())
    return button
