"""The table of results: name, value, ± and unit."""

from __future__ import annotations

from collections.abc import Iterable

from PySide6.QtCore import Qt
from PySide6.QtGui import QCursor, QGuiApplication
from PySide6.QtWidgets import QWhatsThis

from labapp.gui.digits import ResultRow, as_csv
from labapp.gui.widgets.buttons import add_menu
from labapp.gui.widgets.tables import FullTable
from labapp.text import HEIGHT_SIGMA_OF, SIGMA_OF

PLUS_MINUS = (
    "± is one standard uncertainty, 1σ: the true value lies within ± of the one given with a "
    "probability of about 68 %, within 2 ± with 95 %.\n\n"
    f"The ± of a pool's sizes is of {SIGMA_OF}, that of heights in the 3-D view of "
    f"{HEIGHT_SIGMA_OF}. Reflection errors have none."
)


class ResultTable(FullTable):
    """Results: name, value, ±, unit. Copied as text (Ctrl+C) or CSV (its menu)."""

    def __init__(self, name: str) -> None:
        tip = f"{name}: Ctrl+C copies it; right click for CSV, and for what ± is"
        super().__init__(name, tip, ["", "Value", "±", "Unit"])
        self.rows: tuple[ResultRow, ...] = ()
        add_menu(
            self,
            ("Copy table as CSV", self.copy_csv),
            ("What is ±?", lambda: QWhatsThis.showText(QCursor.pos(), PLUS_MINUS, self)),
        )
        way, role = Qt.Orientation.Horizontal, Qt.ItemDataRole.ToolTipRole
        self.model().setHeaderData(2, way, PLUS_MINUS, role)
        self.setWhatsThis(PLUS_MINUS)
        self.set_rows(())

    def set_rows(self, rows: Iterable[ResultRow]) -> None:
        """Show results; cells are changed in place, so that nothing moves."""
        self.rows = tuple(rows)
        self.setRowCount(len(self.rows))
        for k, row in enumerate(self.rows):
            for column, text in enumerate(row.texts):
                tip = row.note or " ".join(row.texts)
                self.set_cell(k, column, text, number=column in (1, 2), tip=tip)
        self.fit_height()

    def copy_text(self) -> None:
        """Copy the selected rows, or all, to the clipboard, separated by tabs."""
        lines = ("\t".join(row.texts) for row in self._chosen())
        QGuiApplication.clipboard().setText("\n".join(lines))

    def copy_csv(self) -> None:
        """Copy all rows to the clipboard as CSV, with all digits."""
        QGuiApplication.clipboard().setText(as_csv(self.rows))

    def _chosen(self) -> list[ResultRow]:
        chosen = sorted({index.row() for index in self.selectedIndexes()})
        return [self.rows[k] for k in chosen] or list(self.rows)
