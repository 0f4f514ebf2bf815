"""Buttons, and rows of them."""

from __future__ import annotations

from collections.abc import Callable

from PySide6.QtWidgets import QHBoxLayout, QPushButton


def button(text: str, tip: str, work: Callable[[], object]) -> QPushButton:
    """A button that calls ``work``; its tooltip is its description for screen readers, too."""
    button = QPushButton(text)
    button.setToolTip(tip)
    button.setAutoDefault(False)  # in a dialog Enter would press it, and it finishes a field
    button.clicked.connect(lambda _: work())
    return button


def button_row(*buttons: QPushButton) -> QHBoxLayout:
    """Buttons beside each other."""
    row = QHBoxLayout()
    row.setContentsMargins(0, 0, 0, 0)
    for each in buttons:
        row.addWidget(each)
    return row
