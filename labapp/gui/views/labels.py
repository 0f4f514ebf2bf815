"""Labels as all pages and windows have them: headings, and words that wrap."""

from __future__ import annotations

from PySide6.QtCore import Qt
from PySide6.QtWidgets import QLabel, QVBoxLayout, QWidget


def heading(words: str) -> QLabel:
    """Words above what belongs together, in bold."""
    label = QLabel(words)
    font = label.font()
    font.setBold(True)
    label.setFont(font)
    label.setWordWrap(True)
    return label


def headed(words: str) -> tuple[QWidget, QVBoxLayout]:
    """A group of widgets under a heading, and its layout."""
    group = QWidget()
    layout = QVBoxLayout(group)
    layout.setContentsMargins(0, 6, 0, 0)
    layout.addWidget(heading(words))
    return group, layout


def plain_words() -> QLabel:
    """Words as they are, wrapped; none yet."""
    label = QLabel()
    label.setWordWrap(True)
    label.setTextFormat(Qt.TextFormat.PlainText)
    return label
