"""Tables of results with arbitrary columns, and tables as text."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import TYPE_CHECKING

from PySide6.QtCore import QItemSelectionModel, QSignalBlocker, Qt, QTimer
from PySide6.QtGui import QGuiApplication
from PySide6.QtWidgets import (
    QAbstractItemView,
    QHeaderView,
    QTableView,
    QTableWidget,
    QTableWidgetItem,
)

from labapp.gui.digits import cell_text
from labapp.gui.widgets.buttons import add_menu
from labapp.gui.widgets.labels import plain_tip
from labapp.text import NOTHING, column_heading

if TYPE_CHECKING:
    from labapp.studies.tables import Table


HEADER_MARGIN_PX = 8
"""Total margin above and below the two lines of a header."""

RIGHT = Qt.AlignmentFlag.AlignRight | Qt.AlignmentFlag.AlignVCenter

NUMBER = re.compile(r"[-−]?\d+(\.\d+)?(e[-+]?\d+)?( ± .+)?", re.IGNORECASE)
"""A number as text, with or without its ±."""


TEXT = "dissertation"
"""Heading of columns that files call ``text``: values published in the dissertation."""


class ReadTable(QTableWidget):
    """A read-only table: whole rows are selected, and copied by keys and menu."""

    def __init__(self, name: str, tip: str, columns: Sequence[str] = ()) -> None:
        super().__init__(0, len(columns))
        self.setHorizontalHeaderLabels(columns)
        self.setAccessibleName(name)
        self.setToolTip(tip)
        self.verticalHeader().hide()
        self.setEditTriggers(QAbstractItemView.EditTrigger.NoEditTriggers)
        self.setSelectionBehavior(QAbstractItemView.SelectionBehavior.SelectRows)
        self.setTabKeyNavigation(False)
        self.setShowGrid(False)
        header = self.horizontalHeader()
        header.setHighlightSections(False)
        header.setSectionResizeMode(QHeaderView.ResizeMode.ResizeToContents)
        add_menu(self, ("Copy table", self.copy_text))

    def show_texts(self, rows: Sequence[Sequence[str]], words: Sequence[int] = (0,)) -> None:
        """Show rows of texts: numbers, except in the columns ``words``."""
        self.setRowCount(len(rows))
        for row, texts in enumerate(rows):
            for column, text in enumerate(texts):
                self.set_cell(row, column, text, number=column not in words)

    def set_cell(self, row: int, column: int, text: str, *, number: bool, tip: str = "") -> None:
        """Show a text in a cell, changed in place so that nothing moves; numbers are right-aligned.

        The tooltip is ``tip``, or the text itself.
        """
        item = self.item(row, column)
        if item is None:
            item = QTableWidgetItem()
            self.setItem(row, column, item)
        if number:
            item.setTextAlignment(RIGHT)
        if item.text() != text:
            item.setText(text)
        item.setToolTip(plain_tip(tip or text))

    def select_rows(self, rows: Sequence[int]) -> None:
        """Select only these rows; emits no signal."""
        if {index.row() for index in self.selectedIndexes()} == set(rows):
            return
        with QSignalBlocker(self):
            self.clearSelection()
            ways = QItemSelectionModel.SelectionFlag
            for row in rows:
                self.selectionModel().select(self.model().index(row, 0), ways.Select | ways.Rows)
        self.viewport().update()

    @property
    def full_height(self) -> int:
        """Height of the header and all rows, px."""
        header = self.horizontalHeader().sizeHint().height() + 2 * self.frameWidth()
        return header + sum(self.rowHeight(row) for row in range(self.rowCount()))

    def copy_text(self) -> None:
        """Copy the shown texts to the clipboard, separated by tabs."""
        QGuiApplication.clipboard().setText(table_text(self))


class FullTable(ReadTable):
    """A table as high as all its rows; long names in its first column take more lines."""

    def __init__(self, name: str, tip: str, columns: Sequence[str]) -> None:
        super().__init__(name, tip, columns)
        self.setVerticalScrollBarPolicy(Qt.ScrollBarPolicy.ScrollBarAlwaysOff)
        self.setHorizontalScrollBarPolicy(Qt.ScrollBarPolicy.ScrollBarAlwaysOff)
        self.horizontalHeader().setSectionResizeMode(0, QHeaderView.ResizeMode.Stretch)
        # The header reports a width before the cells get it.
        self._narrowed = QTimer(self, singleShot=True, interval=0)
        self._narrowed.timeout.connect(self.fit_height)
        self.horizontalHeader().sectionResized.connect(lambda *_: self._narrowed.start())

    def fit_height(self) -> None:
        """Give long names the lines that they need, and the table the height of all rows."""
        self.resizeRowsToContents()
        self.setFixedHeight(self.full_height)

    def show_texts(self, rows: Sequence[Sequence[str]], words: Sequence[int] = (0,)) -> None:
        """Show rows of texts: numbers, except in the columns ``words``."""
        super().show_texts(rows, words)
        self.fit_height()


class CellTable(ReadTable):
    """A table of a simulation. Copied as text (Ctrl+C), CSV or Markdown (its menu)."""

    def __init__(self, name: str) -> None:
        super().__init__(name, f"{name}: Ctrl+C copies it; right click for CSV and Markdown")
        self.table: Table | None = None
        self.setAccessibleDescription("Arrow keys move; Ctrl+C copies it")
        self.setAlternatingRowColors(True)
        add_menu(
            self,
            ("Copy table as CSV", self.copy_csv),
            ("Copy table as Markdown", self.copy_markdown),
        )

    def show_table(self, table: Table) -> None:
        """Show a table."""
        self.setAccessibleDescription(f"{table.caption}. Arrow keys move; Ctrl+C copies it")
        self.setColumnCount(len(table.columns))
        self.setRowCount(len(table.rows))
        self.table = table  # afterwards: fewer rows end a selection, which may be read
        headings = [column_heading(column) for column in table.columns]
        self.setHorizontalHeaderLabels([re.sub(r"^text\b", TEXT, each) for each in headings])
        self.clearContents()  # a column of another table may have been right-aligned
        numbers = [_are_numbers(cells) for cells in zip(*table.rows, strict=True)]
        for row, cells in enumerate(table.rows):
            for column, cell in enumerate(cells):
                number = numbers[column] or not isinstance(cell, str)
                self.set_cell(row, column, cell_text(cell), number=number)
        self.resizeRowsToContents()

    def copy_csv(self) -> None:
        """Copy the whole table to the clipboard as CSV, as in its file."""
        if self.table is not None:
            QGuiApplication.clipboard().setText(self.table.csv())

    def copy_markdown(self) -> None:
        """Copy the whole table to the clipboard as Markdown."""
        if self.table is not None:
            QGuiApplication.clipboard().setText(self.table.markdown())


class FittingTable(CellTable):
    """A table with the available width; if that is narrow, the ± of a value is below the value."""

    def __init__(self, name: str) -> None:
        super().__init__(name)
        header = self.horizontalHeader()
        header.setSectionResizeMode(QHeaderView.ResizeMode.Stretch)
        header.setDefaultAlignment(Qt.AlignmentFlag.AlignCenter | Qt.TextFlag.TextWordWrap)
        header.setMinimumSectionSize(header.fontMetrics().horizontalAdvance("± 0.00000"))
        header.setFixedHeight(2 * header.fontMetrics().lineSpacing() + HEADER_MARGIN_PX)
        self.verticalHeader().setSectionResizeMode(QHeaderView.ResizeMode.ResizeToContents)

    def set_cell(self, row: int, column: int, text: str, *, number: bool, tip: str = "") -> None:
        """Show a text in a cell; a line does not end directly after ±."""
        text = text.replace("± ", "±\N{NO-BREAK SPACE}")
        super().set_cell(row, column, text, number=number, tip=tip)


def _are_numbers(cells: Sequence[str | float | None]) -> bool:
    """Whether the cells of a column are numbers or empty; some may be formatted already."""
    texts = [cell for cell in cells if isinstance(cell, str) and cell not in ("", NOTHING)]
    return bool(texts) and all(NUMBER.fullmatch(text) for text in texts)


def table_text(table: QTableView) -> str:
    """The header and the cells of a table as text, columns separated by tabs."""
    model = table.model()
    columns = [n for n in range(model.columnCount()) if not table.isColumnHidden(n)]
    rows = [[model.headerData(n, Qt.Orientation.Horizontal) for n in columns]]
    for row in range(model.rowCount()):
        if not table.isRowHidden(row):
            rows.append([model.index(row, n).data() for n in columns])
    return "\n".join("\t".join("" if v is None else str(v) for v in cells) for cells in rows)
