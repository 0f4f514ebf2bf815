"""Panel of the dots page: description of the frame, edits, fit, rows, detector."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

from PySide6.QtCore import QSignalBlocker, Qt
from PySide6.QtGui import QAction
from PySide6.QtWidgets import (
    QAbstractButton,
    QGridLayout,
    QHeaderView,
    QSizePolicy,
    QStackedWidget,
    QToolButton,
    QWidget,
)

from labapp.core.pipeline import Settings
from labapp.core.rows.lattice import Site
from labapp.gui.digits import ResultRow
from labapp.gui.pages.dots.presenter import (
    METHODS,
    NUMBERS,
    ROW_SEARCHES,
    RowLine,
    detector_value,
)
from labapp.gui.shell.lead import action_grid
from labapp.gui.shell.steps import MEASURE_ACTIONS, SETUP_ACTIONS
from labapp.gui.widgets.fields import ChoiceField, FieldForm, NumberField
from labapp.gui.widgets.labels import Message, heading, offer, plain_label
from labapp.gui.widgets.layouts import Group, vbox
from labapp.gui.widgets.result_table import ResultTable
from labapp.gui.widgets.tables import ReadTable
from labapp.text import capitalized

LEADS = (("Measure", MEASURE_ACTIONS), ("To measure, the set-up is missing", SETUP_ACTIONS))

MOST_ROWS = 60
COLUMNS_OF_BUTTONS = 3


class MeasureLead(QStackedWidget):
    """Buttons for measuring, or for getting a set-up; of constant height, so that nothing moves."""

    def __init__(self, do: Callable[[str], object]) -> None:
        super().__init__()
        for words, names in LEADS:
            self.addWidget(Group(words, action_grid(names, do), 1))
        self.setSizePolicy(QSizePolicy.Policy.Preferred, QSizePolicy.Policy.Fixed)

    def offer(self, without_setup: bool, why_not: str) -> None:
        """Offer one of the two; disabled if neither is possible."""
        self.setCurrentIndex(int(without_setup))
        for each in self.findChildren(QAbstractButton):
            offer(each, why_not)


class DotsPanel(QWidget):
    """Panel at the side of the frame; the page uses the signals of its fields and list of rows."""

    def __init__(
        self,
        edits: Sequence[QAction],
        frames: Sequence[QAction],
    ) -> None:
        super().__init__()
        # The buttons do not move, whatever the texts are.
        self.seen, self.chosen = Message(5), Message(2)
        self.carried = Message(2)
        self.fit = ResultTable("Fit before the last edit and after it")
        self.buttons: dict[str, QToolButton] = {}
        self.most = NumberField(
            "At most", "frames", lowest=1, highest=1_000_000, decimals=0, optional=True,
            tooltip="Carry on over no more frames than this; empty: to the end of the recording",
        )  # fmt: skip
        self.rows = _RowList()
        self.rows.addActions(edits)
        vbox(
            *(self.seen, heading("Correct"), self.chosen, self._sites()),
            button_grid(edits, self.buttons),
            *(
                heading("Following frames"),
                FieldForm(self.most),
                button_grid(frames, self.buttons),
                self.carried,
            ),
            *(heading("Fit"), self.fit, heading("Rows"), self.rows),
            *(heading("Detector"), self._detector(), 1),
            of=self,
        )
        self.edit_buttons = [self.buttons[action.text()] for action in edits]

    def show_frame(
        self, seen: str, why: str, fit: Sequence[ResultRow], rows: Sequence[RowLine] | None
    ) -> None:
        """Show the session's data of the frame in view; None keeps the list of rows."""
        self.seen.setText(f"{seen}\n⚠ {capitalized(why)}." if why else seen)
        self.fit.set_rows(fit)
        if rows is not None:
            self.rows.show_lines(rows)

    def show_chosen(self, words: str, rows: Sequence[int], site: tuple[int, int]) -> None:
        """Show the selection: text, rows, and the site of a single dot (0: none)."""
        self.chosen.setText(words)
        self.rows.choose(rows)
        self.row.set_value(site[0] or None)
        self.column.set_value(site[1] or None)

    def show_unmet_needs(self, unmet_need: Mapping[str, str]) -> bool:
        """Disable the buttons of edits with unmet needs, given by the buttons' texts.

        Returns whether the button with the focus is among them.
        """
        focused = False
        for words, button in self.buttons.items():
            why = unmet_need[words]
            focused |= bool(why) and button.hasFocus()
            offer(button, f"{why}. {button.defaultAction().toolTip()}" if why else "")
        return focused

    def lock_sites(self, dots: str, reference: str) -> None:
        """Lock row and column of the dots, or of the reference, with a reason; empty: unlock."""
        for why, fields in (
            (dots, (self.row, self.column)),
            (reference, (self.reference_row, self.reference_column)),
        ):
            for field in fields:
                field.lock(why)

    def show_reference(self, site: tuple[int, int] | None) -> None:
        """Show the site of the reference."""
        row, column = site or (None, None)
        self.reference_row.set_value(row)
        self.reference_column.set_value(column)

    def show_settings(self, settings: Settings) -> None:
        """Show the settings of the detector."""
        self.method.set_value(settings.dots.method)
        self.row_search.set_value(settings.lattice.method)
        for number, field in zip(NUMBERS, self.numbers, strict=True):
            field.set_value(detector_value(settings, number))
            field.setVisible(number.method == settings.dots.method)
            field.label.setVisible(number.method == settings.dots.method)

    def _sites(self) -> QGridLayout:
        """Fields for row and column of the selected dots, and of the reference."""

        def field(label: str, tip: str) -> NumberField:
            made = NumberField(
                label, lowest=-99, highest=999, decimals=0, optional=True, tooltip=tip
            )
            made.editor.setMinimumWidth(made.fontMetrics().horizontalAdvance("0000") + 34)
            return made

        self.row = field("Row of the selected dots", "Their row, counted from the bottom up (T)")
        self.column = field("Column of the selected dots", "Their column, counted from the left")
        self.reference_row = field("Row of the reference", "Row of the pattern's dark centre")
        self.reference_column = field("Column of the reference", "Column of that dark centre")
        grid = QGridLayout()
        for k, words in enumerate(("", "Row", "Column")):
            grid.addWidget(plain_label(words), 0, k)
        lines = (
            ("Selected dots", self.row, self.column),
            ("Reference", self.reference_row, self.reference_column),
        )
        for line, (words, *pair) in enumerate(lines, 1):
            grid.addWidget(plain_label(words), line, 0)
            for k, one in enumerate(pair, 1):
                grid.addWidget(one, line, k)
        return grid

    @property
    def reference(self) -> Site | None:
        """Entered row and column of the reference; None if either is missing."""
        row, column = self.reference_row.value(), self.reference_column.value()
        return None if row is None or column is None else (int(row), int(column))

    def _detector(self) -> FieldForm:
        self.method = ChoiceField(
            "Method", METHODS, tooltip="How dots are found in frames not corrected by hand"
        )
        self.row_search = ChoiceField(
            "Rows", ROW_SEARCHES, tooltip="How rows are found in frames not corrected by hand"
        )
        self.numbers = []
        for number in NUMBERS:
            field = NumberField(
                number.label, number.unit, lowest=number.lowest, highest=number.highest,
                step=number.step, decimals=number.decimals, tooltip=number.tooltip,
                optional=number.optional,
            )  # fmt: skip
            self.numbers.append(field)
        return FieldForm(self.method, self.row_search, *self.numbers)


def button_grid(actions: Sequence[QAction], buttons: dict[str, QToolButton]) -> QGridLayout:
    """Grid with a button for each action; ``buttons`` is filled with them by their texts."""
    grid = QGridLayout()
    grid.setSpacing(3)
    for k, action in enumerate(actions):
        button = buttons[action.text()] = QToolButton()
        button.setDefaultAction(action)
        button.setAccessibleName(action.text())
        button.setFocusPolicy(Qt.FocusPolicy.StrongFocus)
        button.setSizePolicy(QSizePolicy.Policy.Expanding, QSizePolicy.Policy.Fixed)
        grid.addWidget(button, k // COLUMNS_OF_BUTTONS, k % COLUMNS_OF_BUTTONS)
    return grid


class _RowList(ReadTable):
    """List of rows from the top down; selecting a line selects its dots."""

    def __init__(self) -> None:
        tip = (
            "The rows as they lie in the frame: ↑ and ↓ select one, Shift adds; then shift it "
            "(Ctrl+← →), block it (B), merge two (M)"
        )
        super().__init__("Rows", tip, ("Row", "Dots", "Columns", ""))
        self._numbers: list[int] = []
        self.setWordWrap(False)
        self.horizontalHeader().setSectionResizeMode(3, QHeaderView.ResizeMode.Stretch)
        self.setHorizontalScrollBarPolicy(Qt.ScrollBarPolicy.ScrollBarAlwaysOff)
        self.show_lines(())

    def show_lines(self, lines: Sequence[RowLine]) -> None:
        """Show rows; the selection is kept by row."""
        lines = lines[:MOST_ROWS]
        chosen = self.chosen()
        with QSignalBlocker(self):
            self._numbers = [line.row for line in lines]
            texts = [(str(x.row or "–"), str(x.dots), x.columns, x.note) for x in lines]
            self.show_texts(texts, words=(3,))
        self.choose(chosen)
        self.resizeRowsToContents()
        # Widgets below must not jump from frame to frame.
        self.setFixedHeight(max(self.full_height, self.minimumHeight() if lines else 0))

    def chosen(self) -> list[int]:
        """Rows of the selected lines."""
        lines = sorted({index.row() for index in self.selectedIndexes()})
        return [self._numbers[k] for k in lines if k < len(self._numbers)]

    def choose(self, rows: Sequence[int]) -> None:
        """Select the lines of rows without a signal."""
        self.select_rows([k for k, row in enumerate(self._numbers) if row in rows])
