"""Drawing of a pattern of dots or lines, as directions about the beam axis."""

from __future__ import annotations

import numpy as np
from PySide6.QtCore import QPointF, QSize
from PySide6.QtGui import QPainter, QPaintEvent, QPalette, QPen, QPolygonF

from labapp.core.geometry.line_pattern import LineRays
from labapp.core.geometry.rig import DotPattern
from labapp.core.values import FloatArray
from labapp.gui.views.canvas import Drawn

SIDE_PX, MARGIN_PX = 132, 8
"""Height of the drawing, and its margin."""

LARGEST_PX, SMALLEST_PX, SHARE = 3.0, 0.7, 0.3
"""Limits of a dot's radius; between them it is this share of the distance to the next one."""


class PatternView(Drawn):
    """The pattern as the camera would see it come out of the laser: X to the right, row 1 on top.

    Rings are rays that the lens does not make. Lines have their length and spacing to the same
    scale.
    """

    def __init__(self) -> None:
        super().__init__("Drawing of the pattern")
        self._pattern: DotPattern | None = None
        self.setFixedHeight(SIDE_PX)

    def sizeHint(self) -> QSize:
        """As wide as high."""
        return QSize(SIDE_PX, SIDE_PX)

    def show_pattern(self, pattern: DotPattern | None, words: str) -> None:
        """Draw a pattern, or none, and describe it."""
        self._pattern = pattern
        self.describe(words)
        self.setToolTip(words)
        self.update()

    def paintEvent(self, event: QPaintEvent) -> None:
        """Draw the rays."""
        super().paintEvent(event)
        if self._pattern is None:
            return
        place = self._placed(self._pattern.tangents)
        with QPainter(self) as painter:
            painter.setRenderHint(QPainter.RenderHint.Antialiasing)
            ink = self.palette().color(QPalette.ColorRole.Text)
            if isinstance(self._pattern, LineRays):
                painter.setPen(QPen(ink, 2.0))
                for line in place:
                    painter.drawPolyline(QPolygonF([QPointF(*point) for point in line.tolist()]))
                return
            radius = _radius(place)
            painter.setPen(QPen(ink, 1.0))
            for i, j in sorted(self._pattern.absent or ()):
                painter.drawEllipse(QPointF(*place[i - 1, j - 1].tolist()), radius, radius)
            painter.setBrush(ink)
            for point in place[~self._pattern.is_absent].tolist():
                painter.drawEllipse(QPointF(*point), radius, radius)

    def _placed(self, tangents: FloatArray) -> FloatArray:
        """Positions of rays in the drawing, px, of the same shape."""
        largest = np.nanmax(np.abs(tangents).reshape(-1, 2), axis=0) + 1e-9
        middle = np.array([self.width(), self.height()]) / 2
        scale = float(((middle - MARGIN_PX) / largest).min())
        return np.asarray(middle + scale * tangents * np.array([1.0, -1.0]))


def _radius(place: FloatArray) -> float:
    step = np.linalg.norm(np.diff(place, axis=1), axis=-1)
    return float(np.clip(SHARE * np.nanmedian(step), SMALLEST_PX, LARGEST_PX))
