"""Labels as all pages and windows have them: headings, words that wrap, and messages."""

from __future__ import annotations

from PySide6 import QtGui
from PySide6.QtCore import QSize, Qt
from PySide6.QtGui import QPainter, QPaintEvent, QResizeEvent, QTextLayout, QTextOption
from PySide6.QtWidgets import QLabel, QSizePolicy, QVBoxLayout, QWidget


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


def wrapped(text: str = "") -> QLabel:
    """Words that wrap, even a SHA-256, and can be copied."""
    label = plain_label(breakable(text))
    label.setWordWrap(True)
    label.setTextInteractionFlags(Qt.TextInteractionFlag.TextSelectableByMouse)
    label.setToolTip(plain_tip(text))
    return label


def breakable(text: str) -> str:
    """Let long words (a checksum, a path) break where they must."""
    return "".join(
        f"{letter}\u200b" if len(text) > 24 and " " not in text else letter for letter in text
    )


def keep_room(*widgets: QWidget) -> None:
    """Let widgets that come and go keep their room: what is below them does not move."""
    for widget in widgets:
        policy = widget.sizePolicy()
        policy.setRetainSizeWhenHidden(True)
        widget.setSizePolicy(policy)


class Message(QLabel):
    """Words that come and go in room of their own: nothing round them moves, whatever they say.

    Parameters
    ----------
    lines
        There is room for so many; what is longer ends in …, and the tip has all of it.
    """

    def __init__(self, lines: int) -> None:
        super().__init__()
        self._lines = lines
        self.setWordWrap(True)
        self.setTextFormat(Qt.TextFormat.PlainText)
        self.setSizePolicy(QSizePolicy.Policy.Preferred, QSizePolicy.Policy.Fixed)

    def sizeHint(self) -> QSize:
        """As high as its lines, and no wider than there is room."""
        return QSize(40, self._lines * self.fontMetrics().lineSpacing())

    def minimumSizeHint(self) -> QSize:
        """As `sizeHint`."""
        return self.sizeHint()

    def hasHeightForWidth(self) -> bool:
        """It is as high, however wide."""
        return False

    def setText(self, words: str) -> None:
        """Say something else; empty: nothing."""
        if words != self.text():
            super().setText(words)
            self._tell()

    def resizeEvent(self, event: QResizeEvent) -> None:
        """Tell all of it where not all is shown."""
        super().resizeEvent(event)
        self._tell()

    def shown(self) -> list[str]:
        """The lines that are seen."""
        lines: list[str] = []
        width = max(self.contentsRect().width() - max(self.indent(), 0), 1)
        wrapped = QTextOption()
        wrapped.setWrapMode(QTextOption.WrapMode.WrapAtWordBoundaryOrAnywhere)
        for paragraph in self.text().splitlines():
            layout = QTextLayout(paragraph, self.font())
            layout.setTextOption(wrapped)
            layout.beginLayout()
            while (line := layout.createLine()).isValid():
                line.setLineWidth(width)
                lines.append(paragraph[line.textStart() :][: line.textLength()].rstrip())
            layout.endLayout()
        if len(lines) > self._lines:
            rest = " ".join(lines[self._lines - 1 :])
            elided = self.fontMetrics().elidedText(rest, Qt.TextElideMode.ElideRight, width)
            lines[self._lines - 1 :] = [elided]
        return lines

    def paintEvent(self, _event: QPaintEvent) -> None:
        """Draw the lines that there is room for."""
        with QPainter(self) as painter:
            painter.setPen(self.palette().color(self.foregroundRole()))
            place = self.contentsRect().adjusted(max(self.indent(), 0), 0, 0, 0)
            painter.drawText(place, Qt.AlignmentFlag.AlignTop, "\n".join(self.shown()))

    def _tell(self) -> None:
        shown = self.shown()
        self.setToolTip(plain_tip(self.text()) if shown and shown[-1].endswith("…") else "")
