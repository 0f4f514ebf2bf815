"""Labels as all pages and windows have them: headings, and words that wrap."""

from __future__ import annotations

from PySide6 import QtGui
from PySide6.QtCore import Qt
from PySide6.QtWidgets import QLabel, QVBoxLayout, QWidget


def plain_label(words: str = "", parent: QWidget | None = None) -> QLabel:
    """Words as they are: by itself a label would take some for HTML, and load its pictures."""
    label = QLabel(parent)
    label.setTextFormat(Qt.TextFormat.PlainText)
    label.setText(words)
    return label


def plain_tip(words: str) -> str:
    """What a tooltip says to show words as they are, HTML or not."""
    rich = QtGui.Qt.mightBeRichText(words)
    return QtGui.Qt.convertFromPlainText(words) if rich else words


def heading(words: str) -> QLabel:
    """Words above what belongs together, in bold."""
    label = plain_label(words)
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
    label = plain_label()
    label.setWordWrap(True)
    return label
