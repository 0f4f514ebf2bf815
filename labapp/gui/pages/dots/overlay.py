"""Overlay of dots, rows and columns on a frame: few items for any number of dots.

Every row has a colour and a number. A ring marks a dot, and a square a dot placed by hand. A dashed
ring is doubtful; a hatched one is in a row blocked by the torch, whose line is dashed, too. A small
cross marks a position computed from the measured surface; a large ring marks the reference.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np
import pyqtgraph as pg
import scipy
from PySide6.QtCore import QRectF, Qt
from PySide6.QtGui import QBrush, QColor, QPen

from labapp.core.rows.correction import Correction
from labapp.core.values import FloatArray, IntArray
from labapp.gui.pages.dots import picking
from labapp.gui.theme import faint
from labapp.gui.views.picture import PictureView

ROW_COLORS = ("#e69f00", "#56b4e9", "#2fd39b", "#f0e442", "#6f9bff", "#ff7a3c", "#e58cc0")
"""Colours by Okabe and Ito, safe for the colour-blind, light enough for a dark frame."""

DOUBT = "#ffffff"
CHOSEN = "#ffffff"
COMPUTED = "#ff5c5c"
BLOCKED = "⊘"
"""Sign at the number of a row blocked by the torch."""

TINY, LEAST, MOST, CHOSEN_MORE = 7.0, 13.0, 60.0, 4.0
"""Diameters of rings, points of the screen: for crowded dots, otherwise minimum and maximum, and
increment for selected dots."""

CROSS = 9.0
"""Width of a cross, points of the screen; less in a smaller ring."""

NO_DOTS = Correction.of(None, None)

DOT_WIDTHS = 6.0
"""Diameter of a ring in σ of a dot's light at high zoom, so that it surrounds the dot."""


class DotsOverlay:
    """Marks of the dots page over a picture."""

    def __init__(self, view: PictureView) -> None:
        self._view = view
        self._correction = NO_DOTS
        self._joints = _joints(NO_DOTS)
        self._columns = _line("#ffffff", 70)
        self._rows = _line("#ffffff", 150)
        self._blocked = _line("#ffffff", 200, Qt.PenStyle.DashLine)
        self._dots = _Marks(pxMode=True)
        self._computed = _Marks(pxMode=True, symbol="+", pen=None, brush=QColor(COMPUTED))
        self._reference = _Marks(pxMode=True, pen=pg.mkPen(CHOSEN, width=2), brush=None)
        self._box = pg.QtWidgets.QGraphicsRectItem()
        self._box.setPen(cosmetic_pen(CHOSEN, 1, Qt.PenStyle.DashLine))
        self._box.hide()
        self._labels: list[pg.TextItem] = []
        for item in (self._columns, self._rows, self._blocked, self._computed):
            view.add(item)
        for item in (self._dots, self._reference, self._box):
            view.add(item)
        self._drawn: tuple[FloatArray, IntArray] = (np.zeros((0, 2)), np.zeros(0, np.int64))
        self._size = LEAST
        self._apart_px = np.inf
        view.box.sigXRangeChanged.connect(lambda *_: self._rescale())

    def show(
        self,
        correction: Correction | None,
        dots_px: FloatArray,
        selection: IntArray,
        computed_px: FloatArray,
    ) -> None:
        """Draw dots at positions, shape (n, 2), px: those of the correction unless dragged."""
        correction = NO_DOTS if correction is None else correction
        if correction is not self._correction:
            self._correction = correction
            self._joints = _joints(correction)
            self._apart_px = _apart(dots_px)
        self._drawn = dots_px, selection
        self._size = self._ring()
        for item, joints in zip(
            (self._columns, self._rows, self._blocked), self._joints, strict=True
        ):
            item.setData(*dots_px[joints.ravel()].T, connect="pairs")
        self._draw_dots()
        self._computed.setData(*computed_px.T, size=self._cross())
        self._draw_labels()
        self._draw_reference()

    def _ring(self) -> float:
        """Diameter of a ring at the current zoom, points of the screen."""
        if not len(self._correction.dots):
            return LEAST
        width = DOT_WIDTHS * float(np.median(self._correction.dots.size_px))
        least = float(np.clip(0.9 * self._apart_px / self._view.px_per_point, TINY, LEAST))
        return float(np.clip(width / self._view.px_per_point, least, MOST))

    def _cross(self) -> float:
        return CROSS * min(self._size / LEAST, 1.0)

    def _rescale(self) -> None:
        """Adjust the rings to another zoom."""
        if self._ring() != self._size:
            self._size = self._ring()
            self._draw_dots()
            self._draw_reference()
            self._computed.setSize(self._cross())
        self._draw_labels()

    def toggle(self) -> None:
        """Hide all marks, or show them again."""
        visible = not self._dots.isVisible()
        marks = (self._columns, self._rows, self._blocked, self._dots, self._computed)
        for item in (*marks, self._reference):
            item.setVisible(visible)
        self._draw_labels()

    def show_box(self, one: tuple[float, float], other: tuple[float, float]) -> None:
        """Show the selection box."""
        corners = np.sort(np.array([one, other]), axis=0)
        self._box.setRect(QRectF(*corners[0], *(corners[1] - corners[0])))
        self._box.show()

    def hide_box(self) -> None:
        """Hide the selection box."""
        self._box.hide()

    def _draw_dots(self) -> None:
        correction, (dots_px, selection) = self._correction, self._drawn
        lattice = correction.lattice
        chosen = np.zeros(len(dots_px), bool)
        chosen[selection] = True
        sited, rows = correction.sited.tolist(), lattice.row.tolist()
        looks = [
            _look(row, known, row in lattice.blocked_rows, one)
            for row, known, one in zip(rows, sited, chosen.tolist(), strict=True)
        ]
        self._dots.setData(
            *dots_px.T,
            symbol=["s" if hand else "o" for hand in correction.manual.tolist()],
            size=np.where(chosen, self._size + CHOSEN_MORE, self._size),
            pen=[pen for pen, _ in looks],
            brush=[brush for _, brush in looks],
        )

    def _draw_labels(self) -> None:
        lattice, dots_px = self._correction.lattice, self._drawn[0]
        ends = picking.row_ends(lattice.row, dots_px)
        while len(self._labels) < len(ends):
            label = pg.TextItem(anchor=(1, 0.5), fill=(0, 0, 0, 60))
            self._labels.append(label)
            self._view.add(label)
        beside = (0.6 * self._size + 2) * self._view.px_per_point
        for label, (row, dot) in zip(self._labels, ends, strict=False):
            sign = f" {BLOCKED}" if row in lattice.blocked_rows else ""
            label.setText(f"{row}{sign}", row_color(row))
            label.setPos(dots_px[dot, 0] - beside, dots_px[dot, 1])
        for n, label in enumerate(self._labels):
            label.setVisible(n < len(ends) and self._dots.isVisible())

    def _draw_reference(self) -> None:
        site = self._correction.lattice.reference
        place = None if site is None else picking.site_px(self._correction, site)
        at = np.zeros((0, 2)) if place is None else place[None]
        self._reference.setData(*at.T, size=np.full(len(at), 2 * self._size))


class _Marks(pg.ScatterPlotItem):  # type: ignore[misc]
    """Marks that leave clicks to the picture's tool."""

    def mouseClickEvent(self, event: Any) -> None:
        """Ignore the click."""
        event.ignore()


def row_color(row: int) -> str:
    """Colour of a row."""
    return ROW_COLORS[row % len(ROW_COLORS)]


@lru_cache(maxsize=512)
def _look(row: int, sited: bool, blocked: bool, chosen: bool) -> tuple[QPen, QBrush]:
    """Outline and filling of a dot."""
    color = row_color(row) if row else DOUBT
    style = Qt.PenStyle.SolidLine if sited else Qt.PenStyle.DashLine
    pen = cosmetic_pen(CHOSEN if chosen else color, 2 if chosen else 1.5, style)
    if blocked:
        return pen, QBrush(QColor(color), Qt.BrushStyle.BDiagPattern)
    return pen, QBrush(faint(color, 60 if chosen else 0))


def _apart(dots_px: FloatArray) -> float:
    """Median distance between nearest dots, px; infinite for fewer than two dots."""
    if len(dots_px) < 2:
        return np.inf
    return float(np.median(scipy.spatial.cKDTree(dots_px).query(dots_px, 2)[0][:, 1]))


def _joints(correction: Correction) -> tuple[IntArray, IntArray, IntArray]:
    """Joined dots: along columns, along rows, along blocked rows."""
    lattice = correction.lattice
    along_rows, along_columns = picking.joints(lattice.row, lattice.column)
    blocked = np.isin(lattice.row[along_rows[:, 0]], list(lattice.blocked_rows))
    return along_columns, along_rows[~blocked], along_rows[blocked]


def cosmetic_pen(
    color: str | QColor, width: float, style: Qt.PenStyle = Qt.PenStyle.SolidLine
) -> QPen:
    """A pen whose width, px of the screen, does not grow with the zoom."""
    pen = QPen(QColor(color), width, style)
    pen.setCosmetic(True)
    return pen


def _line(color: str, alpha: int, style: Qt.PenStyle = Qt.PenStyle.SolidLine) -> pg.PlotCurveItem:
    return pg.PlotCurveItem(pen=cosmetic_pen(faint(color, alpha), 1, style))
