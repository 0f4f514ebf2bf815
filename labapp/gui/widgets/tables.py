"""Tables of results with columns of their own, and tables as text."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

from PySide6.QtCore import Qt
from PySide6.QtGui import QAction, QGuiApplication, QKeySequence
from PySide6.QtWidgets import (
    QAbstractItemView,
    QHeaderView,
    QTableView,
    QTableWidget,
    QTableWidgetItem,
)

from labapp.gui.digits import cell_text, heading
from labapp.gui.widgets.labels import plain_tip

if TYPE_CHECKING:
    from labapp.studies.tables import Table


class ReadTable(QTableWidget):
    """A table to read: its rows are chosen whole, and copied by keys and menu.

    Parameters
    ----------
    name
        What it shows, for a screen reader.
    copies
        How it can be copied, for the tooltip.
    """

    def __init__(self, name: str, copies: str) -> None:
        super().__init__()
        self.setAccessibleName(name)
        self.setToolTip(f"{name}: {copies}")
        self.verticalHeader().hide()
        self.setEditTriggers(QAbstractItemView.EditTrigger.NoEditTriggers)
        self.setSelectionBehavior(QAbstractItemView.SelectionBehavior.SelectRows)
        self.setTabKeyNavigation(False)
        self.setShowGrid(False)
        header = self.horizontalHeader()
        header.setHighlightSections(False)
        header.setSectionResizeMode(QHeaderView.ResizeMode.ResizeToContents)
        self.setContextMenuPolicy(Qt.ContextMenuPolicy.ActionsContextMenu)

    def offer(self, *copies: tuple[str, Callable[[], None]]) -> None:
        """Put ways to copy into the menu, by their words; Ctrl+C does the first."""
        for words, work in copies:
            action = QAction(words, self)
            action.triggered.connect(work)
            self.addAction(action)
        first = self.actions()[0]
        first.setShortcut(QKeySequence.StandardKey.Copy)
        first.setShortcutContext(Qt.ShortcutContext.WidgetShortcut)


class CellTable(ReadTable):
    """A table of a simulation. Copied as text (Ctrl+C), CSV or Markdown (its menu).

    Parameters
    ----------
    name
        What it shows, for a screen reader.
    """

    def __init__(self, name: str) -> None:
        super().__init__(name, "Ctrl+C copies it; right click for CSV and Markdown")
        self.table: Table | None = None
        self.setAccessibleDescription("Arrow keys move; Ctrl+C copies it")
        self.setAlternatingRowColors(True)
        self.offer(
            ("Copy table", self.copy_text),
            ("Copy table as CSV", self.copy_csv),
            ("Copy table as Markdown", self.copy_markdown),
        )

    def show_table(self, table: Table, columns: Sequence[int] | None = None) -> None:
        """Show a table, or some of its columns."""
        self.table = table
        shown = list(range(len(table.columns))) if columns is None else list(columns)
        self.setAccessibleDescription(f"{table.caption}. Arrow keys move; Ctrl+C copies it")
        self.setColumnCount(len(shown))
        self.setRowCount(len(table.rows))
        self.setHorizontalHeaderLabels([heading(table.columns[k]) for k in shown])
        right = Qt.AlignmentFlag.AlignRight | Qt.AlignmentFlag.AlignVCenter
        for row, cells in enumerate(table.rows):
            for column, cell in enumerate(cells[k] for k in shown):
                item = QTableWidgetItem(cell_text(cell))
                if not isinstance(cell, str):
                    item.setTextAlignment(right)
                item.setToolTip(plain_tip(item.text()))
                self.setItem(row, column, item)
        self.resizeRowsToContents()

    def copy_text(self) -> None:
        """Put what is shown on the clipboard, in tabs."""
        QGuiApplication.clipboard().setText(table_text(self))

    def copy_csv(self) -> None:
        """Put all of it on the clipboard as CSV, as its file has it."""
        if self.table is not None:
            QGuiApplication.clipboard().setText(self.table.csv())

    def copy_markdown(self) -> None:
        """Put all of it on the clipboard as Markdown."""
        if self.table is not None:
            QGuiApplication.clipboard().setText(self.table.markdown())


def table_text(table: QTableView) -> str:
    """What a table shows, tabs between its columns, its header first."""
    model = table.model()
    columns = [n for n in range(model.columnCount()) if not table.isColumnHidden(n)]
    rows = [[model.headerData(n, Qt.Orientation.Horizontal) for n in columns]]
    for row in range(model.rowCount()):
        if not table.isRowHidden(row):
            rows.append([model.index(row, n).data() for n in columns])
    return "\n".join("\t".join("" if v is None else str(v) for v in cells) for cells in rows)
