"""Labels of pages and windows: headings, text that wraps, and messages."""

from __future__ import annotations

from PySide6 import QtGui
from PySide6.QtCore import QSize, Qt
from PySide6.QtGui import QPainter, QPaintEvent, QResizeEvent, QTextLayout, QTextOption
from PySide6.QtWidgets import QLabel, QListWidgetItem, QSizePolicy, QTableWidgetItem, QWidget


def plain_label(text: str = "", parent: QWidget | None = None) -> QLabel:
    """A label of plain text: by default a QLabel detects HTML and loads pictures named in it."""
    label = QLabel(parent)
    label.setTextFormat(Qt.TextFormat.PlainText)
    label.setText(text)
    return label


def wrapping_label(text: str = "", parent: QWidget | None = None) -> QLabel:
    """A label of plain text that wraps."""
    label = plain_label(text, parent)
    label.setWordWrap(True)
    return label


def plain_tip(text: str) -> str:
    """Text for a tooltip that shows it literally, even if it looks like HTML."""
    rich = QtGui.Qt.mightBeRichText(text)
    return QtGui.Qt.convertFromPlainText(text) if rich else text


def offer(widget: QWidget, why_not: str) -> None:
    """Enable a widget, with its usual tooltip; or disable it, with the reason as its tooltip."""
    if widget.property("usual tip") is None:
        widget.setProperty("usual tip", widget.toolTip())
    widget.setEnabled(not why_not)
    widget.setToolTip(plain_tip(why_not or widget.property("usual tip")))


def heading(text: str) -> QLabel:
    """A heading above a group of widgets, in bold."""
    label = wrapping_label(text)
    set_font(label)
    return label


def set_font(
    part: QWidget | QListWidgetItem | QTableWidgetItem, *, bold: bool = True, scale: float = 1.0
) -> None:
    """Make the text of a widget or an item bold or not, and its size larger by a factor."""
    font = part.font()
    font.setBold(bold)
    if scale != 1:  # otherwise it would no longer follow the size of the window's text
        font.setPointSizeF(scale * font.pointSizeF())
    part.setFont(font)


def selectable_label(text: str = "") -> QLabel:
    """Text that wraps, even a SHA-256, and can be selected and copied."""
    label = wrapping_label(breakable(text))
    label.setTextInteractionFlags(Qt.TextInteractionFlag.TextSelectableByMouse)
    label.setToolTip(plain_tip(text))
    return label


def breakable(text: str) -> str:
    """Let long words (a checksum, a path) break where they must."""
    return "".join(
        f"{letter}\u200b" if len(text) > 24 and " " not in text else letter for letter in text
    )


def show_words(label: QLabel, words: str) -> None:
    """Show a text; the label is hidden if it is empty."""
    label.setText(words)
    label.setVisible(bool(words))


def keep_room(*widgets: QWidget) -> None:
    """Let hidden widgets keep their space, so that nothing below them moves."""
    for widget in widgets:
        policy = widget.sizePolicy()
        policy.setRetainSizeWhenHidden(True)
        widget.setSizePolicy(policy)


class Message(QLabel):
    """A message of fixed height, so that nothing around it moves.

    Parameters
    ----------
    lines
        Number of lines that fit. A longer text ends in …, and the tooltip contains all of it.
    """

    def __init__(self, lines: int) -> None:
        super().__init__()
        self._lines = lines
        self.setWordWrap(True)
        self.setTextFormat(Qt.TextFormat.PlainText)
        self.setSizePolicy(QSizePolicy.Policy.Preferred, QSizePolicy.Policy.Fixed)

    def sizeHint(self) -> QSize:
        """Height of its lines, and at most the available width."""
        return QSize(40, self._lines * self.fontMetrics().lineSpacing())

    def minimumSizeHint(self) -> QSize:
        """Same as `sizeHint`."""
        return self.sizeHint()

    def hasHeightForWidth(self) -> bool:
        """The height does not depend on the width."""
        return False

    def setText(self, words: str) -> None:
        """Show another text; empty: none."""
        if words != self.text():
            super().setText(words)
            self._update_tip()

    def resizeEvent(self, event: QResizeEvent) -> None:
        """Update the tooltip, which has the full text if it does not fit."""
        super().resizeEvent(event)
        self._update_tip()

    def shown(self) -> list[str]:
        """The visible lines."""
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
        """Draw the lines that fit."""
        with QPainter(self) as painter:
            painter.setPen(self.palette().color(self.foregroundRole()))
            place = self.contentsRect().adjusted(max(self.indent(), 0), 0, 0, 0)
            painter.drawText(place, Qt.AlignmentFlag.AlignTop, "\n".join(self.shown()))

    def _update_tip(self) -> None:
        shown = self.shown()
        self.setToolTip(plain_tip(self.text()) if shown and shown[-1].endswith("…") else "")
