"""Overlay of reflected lines on a frame, and the panel at its side.

Every line has a colour and a number. A ring marks an end; a square marks an end at the edge of the
picture or of a cut by hand. A dashed line is folded, so that its halves coincide. A selected line
is drawn wider.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pyqtgraph as pg
from PySide6.QtCore import Qt
from PySide6.QtGui import QAction
from PySide6.QtWidgets import QHeaderView, QToolButton, QWidget

from labapp.gui.pages.dots.line_presenter import COLUMNS, DrawnLine, LinesState
from labapp.gui.pages.dots.overlay import cosmetic_pen, row_color
from labapp.gui.pages.dots.panel import button_grid
from labapp.gui.views.picture import PictureView
from labapp.gui.widgets.fields import FieldForm, NumberField
from labapp.gui.widgets.labels import Message, heading, show_words, wrapping_label
from labapp.gui.widgets.layouts import vbox
from labapp.gui.widgets.result_table import ResultTable
from labapp.gui.widgets.tables import ReadTable
from labapp.text import capitalized

END = 11.0
"""Diameter of the mark of an end, points of the screen."""

BESIDE = 14.0
"""Distance of a line's number from its right end, points of the screen."""


class LinesOverlay:
    """Lines drawn over a picture."""

    def __init__(self, view: PictureView) -> None:
        self._view = view
        self._items: list[pg.GraphicsObject] = []
        self._labels: list[tuple[pg.TextItem, DrawnLine]] = []
        view.box.sigXRangeChanged.connect(lambda *_: self._place_labels())

    def show(self, lines: tuple[DrawnLine, ...], chosen: Sequence[int] = ()) -> None:
        """Draw lines instead of the previous ones."""
        for item in (*self._items, *(label for label, _ in self._labels)):
            self._view.box.removeItem(item)
        self._items, self._labels = [], []
        for k, line in enumerate(lines):
            self._draw(line, row_color(k + 1), k in chosen)
        self._place_labels()

    def _draw(self, line: DrawnLine, color: str, chosen: bool) -> None:
        style = Qt.PenStyle.DashLine if line.folded else Qt.PenStyle.SolidLine
        curve = pg.PlotCurveItem(
            *_with_gaps(line.image_px).T, pen=cosmetic_pen(color, 5 if chosen else 2, style)
        )
        ends = pg.ScatterPlotItem(
            *line.ends_px.T,
            symbol=["s" if cut else "o" for cut in line.cut.tolist()],
            size=END,
            pen=cosmetic_pen(color, 2),
            brush=None,
        )
        label = pg.TextItem(line.name, color, anchor=(0, 0.5), fill=(0, 0, 0, 60))
        for item in (curve, ends, label):
            self._view.add(item)
        self._items += [curve, ends]
        self._labels.append((label, line))

    @property
    def px_per_point(self) -> float:
        """Number of picture px per point of the screen."""
        return self._view.px_per_point

    def _place_labels(self) -> None:
        for label, line in self._labels:
            u, v = line.ends_px[1]
            label.setPos(u + BESIDE * self._view.px_per_point, v)


class LinesPanel(QWidget):
    """Panel at the side of a frame of a line pattern."""

    def __init__(self, edits: Sequence[QAction]) -> None:
        super().__init__()
        self.seen, self.why, self.chosen = Message(4), wrapping_label(), Message(2)
        self.rows = ResultTable("What the lines show")
        self.lines = LineList()
        self.buttons: dict[str, QToolButton] = {}
        self.number = NumberField(
            "Number of the selected line", lowest=0, highest=999, decimals=0, optional=True,
            tooltip="Its number in the pattern, growing towards the head; empty: found by the "
            "fit. Pieces of one line have the same",
        )  # fmt: skip
        vbox(
            *(self.seen, self.why, heading("Correct"), self.chosen, FieldForm(self.number)),
            button_grid(edits, self.buttons),
            *(heading("Lines, from the top down"), self.lines),
            *(heading("What they show"), self.rows, 1),
            of=self,
        )

    def show_chosen(self, lines: Sequence[int], asked: str, number: int, why: str) -> None:
        """Show the selected lines, a pending request, and a number set by hand."""
        count = len(lines)
        words = f"{count} selected" if count else "Click a line to select it, Shift adds one"
        self.chosen.setText(asked or words)
        self.number.set_value(number or None)
        self.number.lock(why)
        self.lines.select_rows([self.lines.rowCount() - 1 - k for k in lines])

    def show_frame(self, state: LinesState) -> None:
        """Show the session's data of the frame in view."""
        self.seen.setText(state.words)
        show_words(self.why, f"⚠ {capitalized(state.why)}" if state.why else "")
        self.lines.show_lines(state.listed)
        self.rows.set_rows(state.rows)


class LineList(ReadTable):
    """List of a frame's lines from the top down; selecting a row selects its line."""

    def __init__(self) -> None:
        super().__init__("Lines", "Lines of the frame, from the top down", list(COLUMNS))
        header = self.horizontalHeader()
        header.setSectionResizeMode(len(COLUMNS) - 1, QHeaderView.ResizeMode.Stretch)

    def show_lines(self, listed: tuple[tuple[str, ...], ...]) -> None:
        """Show the rows of the lines."""
        self.show_texts(listed, words=(len(COLUMNS) - 1,))
        self.setFixedHeight(self.full_height)

    @property
    def places(self) -> list[int]:
        """Positions of the selected lines, counted from the lowest up, ascending."""
        rows = {index.row() for index in self.selectedIndexes()}
        return sorted(self.rowCount() - 1 - row for row in rows)


def _with_gaps(points: np.ndarray) -> np.ndarray:
    """Points of a line with NaN in its gaps, where nothing is drawn."""
    gaps = np.flatnonzero(np.linalg.norm(np.diff(points, axis=0), axis=-1) > 3.0) + 1
    return np.insert(points, gaps, np.nan, axis=0)
