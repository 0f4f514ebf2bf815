"""A field placed at its dimension in a drawing."""

from __future__ import annotations

import pyqtgraph as pg
from PySide6.QtCore import QPoint, QPointF, QRect
from PySide6.QtGui import QResizeEvent
from PySide6.QtWidgets import QAbstractSpinBox, QLayout, QWidget

from labapp.core.values import FloatArray
from labapp.gui.widgets.fields import NumberField
from labapp.gui.widgets.labels import plain_label
from labapp.gui.widgets.layouts import hbox

STEPS = sorted(
    ((dx, dy) for dx in range(-240, 241, 20) for dy in range(-160, 161, 4)),
    key=lambda step: (abs(step[1]) + 2 * abs(step[0]), step),
)
"""Displacements, px, of a box that would overlap others, the nearest first."""


class DimensionBox(QWidget):
    """A name and a field on a plot."""

    def __init__(self, name: str, field: NumberField, plot: pg.PlotWidget) -> None:
        super().__init__(plot)
        self.plot = plot
        self.field = field
        self._place = QPoint()
        self.setAutoFillBackground(True)
        editor = field.editor
        assert isinstance(editor, QAbstractSpinBox)
        editor.setButtonSymbols(QAbstractSpinBox.ButtonSymbols.NoButtons)
        editor.setFixedWidth(editor.fontMetrics().horizontalAdvance("−000.00") + 10)
        row = hbox(plain_label(name), field, of=self)
        row.setContentsMargins(3, 1, 3, 1)
        row.setSizeConstraint(QLayout.SizeConstraint.SetFixedSize)

    def put_at(self, place: FloatArray, others: list[QRect]) -> None:
        """Centre the box at a position of the plot, shape (2,), or nearby if that is occupied.

        Parameters
        ----------
        others
            Rectangles occupied on the plot; that of this box is added.
        """
        scene = self.plot.getViewBox().mapViewToScene(QPointF(*place.tolist()))
        rect = QRect(QPoint(), self.sizeHint())
        rect.moveCenter(self.plot.mapFromScene(scene))
        rect, room = self._moved_inside(rect), self._room
        places = (rect.translated(dx, dy) for dx, dy in STEPS)
        free = (
            place
            for place in places
            if room.contains(place) and not any(place.intersects(other) for other in others)
        )
        rect = next(free, rect)
        self._place = rect.topLeft()
        self.move(self._place)
        others.append(rect)

    @property
    def _room(self) -> QRect:
        room: QRect = self.plot.rect().adjusted(2, 2, -2, -2)
        return room

    def _moved_inside(self, rect: QRect) -> QRect:
        """The rectangle, moved so that the plot contains it."""
        room = self._room
        left = max(room.left(), min(rect.left(), room.right() - rect.width()))
        top = max(room.top(), min(rect.top(), room.bottom() - rect.height()))
        return QRect(QPoint(left, top), rect.size())

    def resizeEvent(self, event: QResizeEvent) -> None:
        """Show all of a problem's text: inside the plot, and in front of the other boxes."""
        super().resizeEvent(event)
        self.move(self._moved_inside(QRect(self._place, self.size())).topLeft())
        self.raise_()
