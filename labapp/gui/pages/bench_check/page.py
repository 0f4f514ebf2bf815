"""The bench-check page: pictures of known mirrors, their dots, and the resulting quantities."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import pyqtgraph as pg
from PySide6.QtCore import Qt, QTimer
from PySide6.QtGui import QResizeEvent
from PySide6.QtWidgets import (
    QAbstractItemView,
    QHeaderView,
    QSplitter,
    QTableWidgetItem,
    QWidget,
)

from labapp.gui.dialogs import ask_file
from labapp.gui.pages.bench_check import presenter
from labapp.gui.pages.bench_check.listed_picture import ListedPicture, enter, stored_pictures
from labapp.gui.pages.bench_check.mirror_form import MirrorForm
from labapp.gui.pages.bench_check.presenter import COLUMNS, CheckResult, Predicted
from labapp.gui.pages.kept_picture import KeptPicture, load_picture
from labapp.gui.pages.page import Page
from labapp.gui.shell.steps import Lead, Mark, Offer, State, no_bench_check, setup_to_do
from labapp.gui.tasks import Control
from labapp.gui.views.picture import PictureView
from labapp.gui.widgets.buttons import button
from labapp.gui.widgets.fields import ChoiceField
from labapp.gui.widgets.labels import (
    Message,
    heading,
    offer,
    set_font,
    show_words,
    wrapping_label,
)
from labapp.gui.widgets.layouts import column_of, fill, hbox
from labapp.gui.widgets.tables import FullTable, ReadTable
from labapp.gui.workspace import Workspace
from labapp.media.formats.images import IMAGE_SUFFIXES
from labapp.session.record import BenchCheckRecord, BenchEntries, MirrorPicture

NO_PICTURE = "Put a known mirror where the pool will be; add a picture of its dots, or drop it."

NAME_LETTERS = 14
"""Minimum width, letters, of a quantity's name in the table: the longest takes two lines."""

COLOR = "#ffb000"
LIST_ROWS, ROW_PX = 3, 24
TABLE_PX, WIDE_PX = 400, 720
"""Width of the table of quantities, and page width at which it fits beside the picture."""


class BenchCheckPage(Page):
    """A list of pictures with their mirrors; Check adjusts the set-up to them."""

    key = "bench_check"

    def __init__(self, workspace: Workspace) -> None:
        super().__init__(workspace)
        self.chosen: list[ListedPicture] = []
        self.checked: CheckResult | None = None
        self.answer = Message(4)
        self._path: Path | None = None
        self._entries: BenchEntries | None = None
        self._kept: BenchCheckRecord | None = None
        self._found: MirrorPicture | None = None
        self.view = PictureView("Picture of the mirror")
        self.view.pointed.connect(lambda u, v, _: self._point(u, v))
        self._overlays: list[pg.GraphicsObject] = []
        self.legend, self.pointed = Message(2), Message(1)
        self.quantities = _QuantityTable()
        left = column_of((self.view, 1), self.legend, self.pointed)
        self.found = column_of((self.quantities, 1), wrapping_label(presenter.LEGEND))
        self.splitter = QSplitter(Qt.Orientation.Horizontal)
        self.splitter.setChildrenCollapsible(False)
        self.splitter.addWidget(left)
        self.splitter.addWidget(self.found)
        self.splitter.setStretchFactor(0, 1)
        self.splitter.setSizes([WIDE_PX - TABLE_PX, TABLE_PX])
        # The splitter is resized only after the page.
        self._arranged = QTimer(self, singleShot=True, interval=0)
        self._arranged.timeout.connect(self._arrange)
        self.canvas_layout.addWidget(self.splitter)
        self._make_panel()

    def resizeEvent(self, event: QResizeEvent) -> None:
        """Place the table below the picture if there is no space beside it."""
        super().resizeEvent(event)
        wide = self.width() >= WIDE_PX
        way = Qt.Orientation.Horizontal if wide else Qt.Orientation.Vertical
        if self.splitter.orientation() != way:
            self.splitter.setOrientation(way)
            self._arranged.start()

    def _arrange(self) -> None:
        wide = self.splitter.orientation() == Qt.Orientation.Horizontal
        size, table = (self.width(), TABLE_PX) if wide else (self.height(), self.height() * 2 // 5)
        self.splitter.setSizes([size - table, table])

    def refresh(self) -> None:
        """Show pictures that did not change on this page, and the stored check."""
        session = self.session
        entries, kept = session.bench_entries, session.bench_check
        if session.path != self._path:
            self._path, self._entries, self._kept = session.path, None, None
            self.checked = None
            self._show_predicted(None)
            self._list(())
        is_changed = kept is not self._kept or entries != self._entries
        if kept is not self._kept:
            self.answer.setText("")
        self._entries, self._kept = entries, kept
        # What could not be stored stays.
        if is_changed and not self._is_stored():
            self._take_stored()
        self._follow()

    def _is_stored(self) -> bool:
        """Whether the list is that of the session."""
        if self._entries is None:
            return self._is_kept() or not (self._kept or self.chosen)
        return self._entries.pictures == tuple(one.entry for one in self.chosen)

    @property
    def locked(self) -> str:
        """Reason why nothing can be checked or changed; empty if it can."""
        return no_bench_check(self.workspace.session) or super().locked

    def state(self, found: State) -> State:
        """State of the step, which may have a check that is not yet in use."""
        made, session = self.checked, self.workspace.session
        if made is None or session is None or self._is_kept():
            return found
        if made.setup_text != session.setup_text:
            return found
        if made.usable:
            return State(Mark.READY, "Checked; the adjusted set-up is not in use yet")
        return State(Mark.ATTENTION, "The pictures contradict the set-up")

    def lead(self, found: Lead | None) -> Lead | None:
        """Sources of a picture while there is none; for lines the reason why none is needed."""
        if why := no_bench_check(self.workspace.session):
            return Lead(why, ())
        add = Offer("&Add picture…", "Of a mirror of known shape", self._choose)
        return found if self.chosen else Lead(NO_PICTURE, (add,))

    def _is_kept(self) -> bool:
        """Whether the displayed check is the stored one."""
        kept = self._kept
        return bool(self.checked and kept and self.checked.record.date == kept.date)

    def _take_stored(self) -> None:
        session, entries, kept = self.session, self._entries, self._kept

        def shown(chosen: Sequence[ListedPicture]) -> None:
            if self._entries is entries and self._kept is kept:
                self._list(chosen)

        title = "Showing the pictures of the check"
        self.workspace.tasks.start(title, lambda _: stored_pictures(session), shown)

    def _enter(self, chosen: Sequence[ListedPicture], at: int = 0) -> None:
        """Show a list that the operator changed, and store it until it is applied."""
        self._list(chosen, at)
        self.workspace.attempt(lambda session: enter(session, chosen))

    # --- the list -----------------------------------------------------------------------------

    def load(self, *paths: Path) -> None:
        """Add pictures, initially of a plate."""
        session = self.session

        def loaded(pictures: Sequence[KeptPicture]) -> None:
            added = [ListedPicture(one.name, one.image, sha256=one.sha256) for one in pictures]
            self._enter([*self.chosen, *added], len(self.chosen))

        self.start_task(
            "Loading the picture", lambda _: [load_picture(session, path) for path in paths], loaded
        )

    def takes_files(self, paths: Sequence[Path]) -> bool:
        """Add dropped pictures."""
        pictures = [path for path in paths if path.suffix.lower() in IMAGE_SUFFIXES]
        if why := no_bench_check(self.workspace.session):
            self._answer_in(self.answer).setText(why)
            return len(pictures) == len(paths)
        if self.locked or len(pictures) < len(paths):
            return False
        self.load(*pictures)
        return True

    def remove(self) -> None:
        """Remove the selected picture from the list."""
        if self.chosen:
            at = self._at()
            self._enter([one for k, one in enumerate(self.chosen) if k != at], max(0, at - 1))

    def change(self, one: ListedPicture) -> None:
        """Change the mirror of the selected picture."""
        at = self._at()
        self._enter([one if k == at else other for k, other in enumerate(self.chosen)], at)

    def _at(self) -> int:
        return max(0, min(self.list.currentRow(), len(self.chosen) - 1))

    def _list(self, chosen: Sequence[ListedPicture], at: int = 0) -> None:
        """Show a list of pictures; results of another list are discarded."""
        self.chosen = list(chosen)
        dropped = self.checked is not None and self.checked.chosen != tuple(chosen)
        if dropped:
            self.checked = None
            self.answer.setText("")
        texts = [(f"{n}  {one.name}", one.mirror_words) for n, one in enumerate(chosen, 1)]
        self.list.show_texts(texts, words=(0, 1))
        if chosen:
            self.list.selectRow(min(at, len(chosen) - 1))
        if dropped:
            self.workspace.changed.emit()
        else:
            self._follow()
            self.lead_changed.emit()

    # --- the check ----------------------------------------------------------------------------

    def check(self, free: Sequence[str] = ()) -> None:
        """Adjust the set-up to the pictures."""
        session, chosen = self.session, tuple(self.chosen)
        text, path, settings = session.setup_text, session.path, session.settings.dots
        pool = presenter.expected_cap(session.record)

        def work(control: Control) -> CheckResult:
            presenter.check_sizes(session, chosen)
            return presenter.check(chosen, (text, path), settings, control.progress, free, pool)

        def found(made: CheckResult) -> None:
            if tuple(self.chosen) == chosen:
                self.checked = made
                self.workspace.changed.emit()
                self.answer.setText("")
                if made.usable:
                    self.confirm("The pictures are checked")

        self._show_predicted(None)
        given = chosen, text, path, settings, tuple(free), pool
        self.start_latest("Checking the bench", given, work, found)

    def use(self) -> None:
        """Use the adjusted set-up."""
        made = self.checked
        if made is None or not made.usable:
            return
        images = [one.image for one in made.chosen]
        if self.workspace.attempt(
            lambda session: session.use_bench_check(made.check, made.record, images)
        ):
            self.confirm("The adjusted set-up is in use; undo restores the former one")

    def predict(self) -> None:
        """Predict the effect of pictures on the ± of the pool's height."""
        session = self.session
        setup, record = session.setup, session.record
        self.start_latest(
            "Predicting the effect of pictures",
            (session.setup_text, session.path, record),
            lambda _: presenter.predicted(setup, record),
            self._show_predicted,
        )

    def _show_predicted(self, made: Predicted | None) -> None:
        show_words(self.predicted_words, "" if made is None else made.words)
        self.predicted.show_texts(() if made is None else made.rows)
        self.predicted.setVisible(made is not None)

    # --- the panel ----------------------------------------------------------------------------

    def _make_panel(self) -> None:
        tip = "Predicted ± of the height of the expected pool, after each set of pictures"
        self.predict_button = button("Predict ± by pictures", tip, self.predict)
        name = "Predicted ± of the pool's height"
        self.predicted = FullTable(
            name, f"{name}: Ctrl+C copies it", ("After a check with", "±, mm")
        )
        self.predicted_words = wrapping_label()
        tip = "Add pictures of a mirror's dots, taken by the camera in its place"
        self.add_button = button("Add picture…", tip, self._choose)
        self.remove_button = button("Remove", "Remove it from the list", self.remove)
        tip = "Pictures and the mirrors that they show"
        self.list = ReadTable("Pictures of mirrors", tip, ("Picture", "Mirror"))
        self.list.setSelectionMode(QAbstractItemView.SelectionMode.SingleSelection)
        self.list.horizontalHeader().setSectionResizeMode(1, QHeaderView.ResizeMode.Stretch)
        self.list.itemSelectionChanged.connect(self._follow)
        self.list.verticalHeader().setDefaultSectionSize(ROW_PX)
        self.list.setFixedHeight(ROW_PX * (LIST_ROWS + 1) + 8)
        self.mirror_form = MirrorForm(self._selected, self.change)
        tip = "Find the dots' rays and adjust the set-up to the known mirrors"
        self.check_button = button("Check", tip, self.check)
        tip = "Measure with the adjusted set-up; undo restores the former one"
        self.use_button = button("Apply", tip, self.use)
        self.words = wrapping_label()
        self.mirrors_words = heading("Known mirrors, measured")
        tip = (
            "Each size as the adjusted set-up measures it (±: noise of the dots), and as it is "
            "measured without its true value (±: noise and set-up). "
            "Ctrl+C copies the table"
        )
        self.mirrors = FullTable("Known mirrors, measured", tip, presenter.MIRROR_COLUMNS)
        fill(
            self.panel_layout,
            *(self.predict_button, self.predicted_words, self.predicted),
            *(hbox((self.add_button, 1), self.remove_button), self.list, self.mirror_form),
            *(hbox((self.check_button, 1), (self.use_button, 1)), self.answer),
            *(self.words, self._suspect_part(), self.mirrors_words, self.mirrors, 1),
        )
        self.lock_with_session(self.add_button)
        self._show_predicted(None)

    def _suspect_part(self) -> QWidget:
        tip = "Which quantity is off; those in the list explain the dots equally well"
        self.suspect = ChoiceField("What is off", tooltip=tip)
        tip = "Check again with this quantity free: its entered value is ignored"
        find = button("Find it from the pictures", tip, lambda: self.check([self.suspect.value()]))
        # Names are long, so the label is above them.
        self.suspect_part = column_of(self.suspect.label, self.suspect, find)
        return self.suspect_part

    def _choose(self) -> None:
        if path := ask_file(self, "Picture of a mirror", self.workspace.folder):
            self.load(path)

    def _selected(self) -> ListedPicture:
        return self.chosen[self._at()]

    # --- what is shown ------------------------------------------------------------------------

    def _record(self) -> BenchCheckRecord | None:
        """The displayed check: a new one, or the stored one of the same pictures."""
        if self.checked is not None:
            return self.checked.record
        kept = self._kept
        if kept is None or len(kept.pictures) != len(self.chosen):
            return None
        same = all(other.is_of(one) for one, other in zip(kept.pictures, self.chosen, strict=True))
        return kept if same else None

    def _follow(self) -> None:
        """Show the results of the list and the check."""
        if self.workspace.session is None:
            return
        if self.checked is not None and not self._is_kept():
            same = self.checked.setup_text == self.session.setup_text
            self.checked = self.checked if same else None
        record, made = self._record(), self.checked
        self.mirror_form.show_mirror(self._selected() if self.chosen else None, self.locked)
        self._show_picture(None if record is None else record.pictures[self._at()])
        self.quantities.show_rows(() if record is None else presenter.quantity_rows(record))
        self.found.setVisible(record is not None)
        # A rejected bench measures nothing.
        stands = record is not None and (made is None or made.usable)
        self.mirrors.show_texts(presenter.mirror_rows(record) if record and stands else ())
        for shown in (self.mirrors_words, self.mirrors):
            shown.setVisible(stands)
        used = record is not None and (made is None or self._is_kept())
        words = presenter.kept_words(self.session) if used else made.words if made else ""
        show_words(self.words, words)
        suspects = made.suspects if made else ()
        self.suspect.set_choices(suspects)
        if suspects and not self.suspect.value():  # the previous one is not among them
            self.suspect.set_value(suspects[0][0])
        self.suspect_part.setVisible(bool(suspects))
        self._enable(used)

    def _enable(self, used: bool) -> None:
        to_do = setup_to_do(self.session.setup_problems)
        lacking = self.locked or (f"Set-up: {to_do}" if to_do else "")
        wrong = next((one.problem for one in self.chosen if one.problem), "")
        why_not = lacking or wrong or ("" if self.chosen else "Add a picture of a mirror first")
        offer(self.check_button, why_not)
        made = self.checked
        if used:
            unusable = "It is in use"
        elif made is None:
            unusable = "Check the pictures first"
        else:
            unusable = "" if made.usable else "What is wrong must be corrected first"
        offer(self.use_button, self.locked or unusable)
        offer(self.predict_button, lacking)
        offer(self.remove_button, self.locked or ("" if self.chosen else "No picture"))

    def _show_picture(self, found: MirrorPicture | None) -> None:
        image = self._selected().image if self.chosen else None
        if image is not self.view.picture or image is None:
            self.view.show_picture(image)
        for item in self._overlays:
            self.view.remove(item)
        former, self._found, self._overlays = self._found, found, []
        self.pointed.setText("")
        if image is None or found is None:
            self.legend.setText("")
            if former is not None:
                self.view.fit()  # no longer the dots of a checked picture
            return
        shown = presenter.overlay(found, image.shape[0])
        arrows = pg.PlotDataItem(
            *shown.arrows_px.T, connect="pairs", pen=pg.mkPen(COLOR, width=1), symbol=None
        )
        dots = pg.PlotDataItem(
            *shown.dot_px.T, pen=None, symbol="o", symbolSize=5, symbolBrush=None
        )
        dots.setSymbolPen(pg.mkPen("#45a5ff", width=1))
        self._overlays = [arrows, dots]
        for text, u, v, of_row in shown.numbers:
            anchor = (1.2, 0.5) if of_row else (0.5, -0.1)
            number = pg.TextItem(text, color="#8fd0ff", anchor=anchor)
            number.setPos(u, v)
            self._overlays.append(number)
        for item in self._overlays:
            self.view.add(item)
        self.legend.setText(shown.words)
        if found is not former:
            low, high = shown.dot_px.min(axis=0).tolist(), shown.dot_px.max(axis=0).tolist()
            self.view.show_region((low[0], low[1]), (high[0], high[1]))

    def _point(self, u: float, v: float) -> None:
        if self._found is not None:
            self.pointed.setText(presenter.ray_words(self._found, u, v))


class _QuantityTable(ReadTable):
    """Quantities before and after, in groups."""

    def __init__(self) -> None:
        name = "Quantities of the set-up, before and after the check"
        super().__init__(name, f"{name}: Ctrl+C copies it", COLUMNS)
        self.horizontalHeader().setSectionResizeMode(0, QHeaderView.ResizeMode.Fixed)
        # Long names are wrapped; the header reports a width before the cells have it.
        self._narrowed = QTimer(self, singleShot=True, interval=0)
        self._narrowed.timeout.connect(self._fit_names)
        self.horizontalHeader().sectionResized.connect(lambda *_: self._narrowed.start())

    def resizeEvent(self, event: QResizeEvent) -> None:
        """Use the remaining width for the names, but at least the width for two lines."""
        super().resizeEvent(event)
        self._narrowed.start()

    def _fit_names(self) -> None:
        taken = sum(self.columnWidth(column) for column in range(1, self.columnCount()))
        least = NAME_LETTERS * self.fontMetrics().averageCharWidth()
        self.setColumnWidth(0, max(least, self.viewport().width() - taken))
        self.resizeRowsToContents()

    def show_rows(self, rows: Sequence[presenter.QuantityRow]) -> None:
        """Show quantities in groups with headings."""
        self.setRowCount(0)
        group = ""
        for row in rows:
            if row.group != group:
                group = row.group
                self._add_heading(group)
            at = self.rowCount()
            self.setRowCount(at + 1)
            for column, text in enumerate(row.texts):
                tip = presenter.LEGEND if column == len(row.texts) - 1 else ""
                self.set_cell(at, column, text, number=column in (1, 2), tip=tip)
        self.resizeRowsToContents()

    def _add_heading(self, words: str) -> None:
        item = QTableWidgetItem(words)
        set_font(item)
        at = self.rowCount()
        self.setRowCount(at + 1)
        self.setItem(at, 0, item)
        self.setSpan(at, 0, 1, len(COLUMNS))
