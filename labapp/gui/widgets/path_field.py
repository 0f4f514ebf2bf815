"""A field for a path that shows both ends of the path while it is not edited."""

from __future__ import annotations

from PySide6.QtCore import QRect, Qt
from PySide6.QtGui import QPainter, QPaintEvent
from PySide6.QtWidgets import QLineEdit, QStyle, QStyleOptionFrame

from labapp.gui.widgets.fields import TextField
from labapp.gui.widgets.labels import plain_tip

TEXT_MARGIN_PX = 2
"""Margin between the frame's contents and the text: that of QLineEdit, which is not public."""


class PathField(TextField):
    """A file's or folder's path; its tooltip has the full path."""

    def __init__(self, label: str, *, tooltip: str = "") -> None:
        line = PathLine()
        super().__init__(label, tooltip=tooltip, line=line)
        self._purpose = tooltip
        line.textChanged.connect(self._show_whole_path)

    def _show_whole_path(self, path: str) -> None:
        self._tooltip = f"{path}\n{self._purpose}" if path else self._purpose
        self.editor.setToolTip(plain_tip(self._tooltip))
        self._show_problem()


class PathLine(QLineEdit):
    """A line that omits the middle of a text that is too long while it does not have the focus."""

    def __init__(self) -> None:
        super().__init__()
        self.setAcceptDrops(False)  # a dropped file is for the window; a line takes its URL as text

    def shown(self) -> str:
        """The text as painted."""
        if self.hasFocus():
            return self.text()
        width = self._contents().width()
        # What varies in a pattern is near its end.
        is_pattern = bool(set("*{") & set(self.text()))
        mode = Qt.TextElideMode.ElideLeft if is_pattern else Qt.TextElideMode.ElideMiddle
        return self.fontMetrics().elidedText(self.text(), mode, width)

    def paintEvent(self, event: QPaintEvent) -> None:
        """Paint the two ends of a text that is too long, otherwise the whole text."""
        shown = self.shown()
        if shown == self.text():
            super().paintEvent(event)
            return
        with QPainter(self) as painter:
            panel = QStyle.PrimitiveElement.PE_PanelLineEdit
            self.style().drawPrimitive(panel, self._option(), painter, self)
            painter.setPen(self.palette().text().color())
            painter.drawText(self._contents(), Qt.AlignmentFlag.AlignVCenter, shown)

    def _option(self) -> QStyleOptionFrame:
        option = QStyleOptionFrame()
        self.initStyleOption(option)
        return option

    def _contents(self) -> QRect:
        inner = QStyle.SubElement.SE_LineEditContents
        room = self.style().subElementRect(inner, self._option(), self)
        return room.adjusted(TEXT_MARGIN_PX, 0, -TEXT_MARGIN_PX, 0)
