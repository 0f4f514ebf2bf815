"""The laser page: readings of the cross, or a picture of it, and the resulting laser."""

from __future__ import annotations

from pathlib import Path

from PySide6.QtCore import QSignalBlocker, Qt
from PySide6.QtGui import QKeyEvent
from PySide6.QtWidgets import QHeaderView, QStackedWidget, QTableWidget, QTableWidgetItem, QWidget

from labapp.gui.dialogs import ask_file
from labapp.gui.pages.kept_picture import KeptPicture, load_picture
from labapp.gui.pages.laser import presenter
from labapp.gui.pages.laser.presenter import ENDS, MEANINGS, NAMES, SCALE, Place, Readings
from labapp.gui.pages.page import Page
from labapp.gui.tasks import DONE
from labapp.gui.views.drag_point import DragPoint
from labapp.gui.views.drawings.cross_hair import CrossHairView
from labapp.gui.views.picture import PictureView
from labapp.gui.widgets.buttons import button
from labapp.gui.widgets.fields import ChoiceField, FieldForm, NumberField
from labapp.gui.widgets.labels import Message, offer, plain_label, wrapping_label
from labapp.gui.widgets.layouts import fill
from labapp.gui.widgets.result_table import ResultTable
from labapp.gui.widgets.tables import RIGHT
from labapp.gui.workspace import Workspace
from labapp.session.record import CrossPicture, LaserEntries

WAYS = (("callipers", "by callipers"), ("picture", "from a picture"))

DRAWN_WORDS = "To scale: the beam, the edges of the fan, and the cross on the work piece."

IN_USE = f"{DONE} In the set-up"

SEVERAL = "The mean of several readings: change them in the table"

NO_PICTURE = "Take a picture of the cross beside a scale, square from above, and load it here."

LEAST_ROWS = 4


class LaserPage(Page):
    """Lengths of the cross in a table, typed or from a picture, and the resulting laser."""

    key = "laser"

    def __init__(self, workspace: Workspace) -> None:
        super().__init__(workspace)
        self.length_fields = [_length_field(k) for k in range(3)]
        for k, field in enumerate(self.length_fields):
            field.edited.connect(lambda value, k=k: self._enter_length(k, value))
        self.drawing = CrossHairView(NAMES, self.length_fields)
        self.picture_view = PictureView("Picture of the cross hair")
        self.picture_view.show_picture(None, NO_PICTURE)
        self.canvas = QStackedWidget()
        for view in (self.drawing, self.picture_view):
            self.canvas.addWidget(view)
        self.canvas_layout.addWidget(self.canvas)
        self._points: dict[str, DragPoint] = {}
        self._picture: KeptPicture | None = None
        self._awaited: CrossPicture | None = None
        self._from_sha256: str | None = None
        self._stored: tuple[Path, LaserEntries] | None = None
        self._make_panel()
        self._show_way("callipers")

    def refresh(self) -> None:
        """Show readings that did not change on this page, and the values in use."""
        former, entries = self._stored, presenter.entries(self.session)
        self._stored = self.session.path, entries
        is_same_session = former is not None and former[0] == self.session.path
        # What could not be stored stays.
        if self._stored != former and not (is_same_session and entries == self.entries()):
            self._fill(entries)
        self.in_use.set_rows(presenter.in_use(self.session))
        self._follow()

    def _take_session(self) -> None:
        """Also remove the picture of the previous session."""
        super()._take_session()
        self._awaited = None
        self._show_picture(None)

    def readings(self) -> Readings:
        """Readings in the table."""
        return presenter.typed(self.entries())

    def entries(self) -> LaserEntries:
        """All that is entered: the cells of the table without empty rows at the end, the fields."""
        cells = [self._line(row) for row in range(self.table.rowCount())]
        while cells and not any(cells[-1]):
            cells.pop()
        fan_angle_deg = self.fan.value() or presenter.FAN_ANGLE_DEG
        known = self.fan_sigma.value() or 0.0, self.resolution.value() or 0.0
        return LaserEntries(tuple(cells), fan_angle_deg, *known, self._from_sha256, self._cross())

    def load_picture(self, path: Path) -> None:
        """Show a picture of the cross with points to drag."""
        session = self.session

        def loaded(picture: KeptPicture) -> None:
            self._awaited = None
            self._show_picture(picture)
            if not self.locked:
                self._store()

        self.start_latest(
            "Loading the picture", path, lambda _: load_picture(session, path), loaded
        )

    def add_reading(self) -> None:
        """Add the lengths from the picture to the table as another reading."""
        lengths = self._cross_lengths()
        if lengths is None or self._picture is None:
            return
        rows = range(self.table.rowCount())
        row = next(r for r in rows if not any(self._line(r)))
        self._put(row, [f"{length:.2f}" for length in lengths])
        self._from_sha256 = self._picture.sha256
        self._store()

    def use(self) -> None:
        """Use the resulting laser in the rig."""
        readings, sha256 = self.readings(), self._from_sha256
        if self.workspace.attempt(lambda session: presenter.apply(session, readings, sha256)):
            words = "Applied to the set-up; undo restores the former laser"
            self.workspace.notified.emit(words, False)

    # --- the panel --------------------------------------------------------------------------

    def _make_panel(self) -> None:
        self.way = ChoiceField("Lengths", WAYS, tooltip="Where the lengths of the cross come from")
        self.way.edited.connect(self._show_way)
        tip = "Full angle from one edge of the fan to the other, as the lens' maker gives it"
        self.fan = NumberField(
            "Fan angle, full", "°", lowest=0.1, highest=89.9, step=0.5, decimals=2, tooltip=tip
        )
        tip = "Standard uncertainty of the fan angle; 0.1° is assumed where its maker says nothing"
        self.fan_sigma = NumberField(
            "Fan angle ±", "°", lowest=0, highest=10, step=0.05, decimals=2, tooltip=tip
        )
        tip = "Smallest step of the callipers or ruler: no length is known better than that"
        self.resolution = NumberField(
            "Resolution", "mm", lowest=0, highest=10, step=0.01, decimals=2, tooltip=tip
        )
        for each in (self.fan, self.fan_sigma, self.resolution):
            each.edited.connect(lambda _: self._store())
        form = FieldForm(self.way, self.fan, self.fan_sigma, self.resolution)
        self.table = _ReadingsTable()
        self.table.itemChanged.connect(self._cell_changed)
        readings = wrapping_label("Readings, mm: three lines or more")
        tip = "Put angle and distance into the set-up; undo restores the former ones"
        self.use_button, self.applied = button("Apply", tip, self.use), Message(2)
        self.words = wrapping_label()
        self.result = ResultTable("The laser computed from the lengths")
        self.in_use = ResultTable("Laser in use")
        fill(
            self.panel_layout,
            *(form, self._picture_part(), readings, self.table, self.use_button, self.applied),
            *(self.words, self.result, plain_label("In the set-up now"), self.in_use, 1),
        )
        self.lock_with_session(self.fan, self.fan_sigma, self.resolution, self.table)

    def _picture_part(self) -> QWidget:
        tip = "A picture of the cross hair beside a scale"
        load = button("Load picture…", tip, self._choose_picture)
        tip = "Distance between the two points marked on the scale"
        self.scale = NumberField(
            "Scale length", "mm", lowest=0.1, highest=10_000, step=1, decimals=2, tooltip=tip
        )
        self.scale.set_value(10.0)
        self.scale.edited.connect(lambda _: self._placed())
        self.lengths = Message(2)
        tip = "Add these lengths to the table as a further reading"
        self.add_button = button("Add as a reading", tip, self.add_reading)
        self.picture_part = FieldForm(load, self.answer, self.scale, self.lengths, self.add_button)
        return self.picture_part

    def _show_way(self, way: str) -> None:
        picture = way == "picture"
        self.picture_part.setVisible(picture)
        self.canvas.setCurrentIndex(int(picture))
        self._dragged()

    # --- the readings -----------------------------------------------------------------------

    def _fill(self, entries: LaserEntries) -> None:
        self._from_sha256 = entries.picture_sha256
        with QSignalBlocker(self.table):
            self.table.setRowCount(0)
            self.table.setRowCount(max(LEAST_ROWS, len(entries.cells) + 1))
            for row, texts in enumerate(entries.cells):
                for column, text in enumerate(texts):
                    self.table.setItem(row, column, _cell(text))
        self.table.fit()
        self.fan.set_value(entries.fan_angle_deg)
        self.fan_sigma.set_value(entries.fan_angle_sigma_deg)
        self.resolution.set_value(entries.resolution_mm)
        self._take_cross(entries.cross)

    def _store(self) -> None:
        """Show the result of changed entries, and store them until they are applied."""
        self._follow()
        entries = self.entries()
        self.workspace.attempt(lambda session: presenter.enter(session, entries))

    def _put(self, row: int, texts: list[str]) -> None:
        with QSignalBlocker(self.table):
            for column, text in enumerate(texts):
                self.table.setItem(row, column, _cell(text))
        self._grow()

    def _cell_changed(self, item: QTableWidgetItem) -> None:
        with QSignalBlocker(self.table):
            item.setTextAlignment(RIGHT)
        self._from_sha256 = None
        self._grow()
        self._store()

    def _grow(self) -> None:
        """Keep an empty row at the end."""
        last = self.table.rowCount() - 1
        if any(self._line(last)):
            self.table.setRowCount(last + 2)
            self.table.fit()

    def _line(self, row: int) -> tuple[str, str, str]:
        return self._text(row, 0), self._text(row, 1), self._text(row, 2)

    def _text(self, row: int, column: int) -> str:
        item = self.table.item(row, column)
        return "" if item is None else item.text().strip()

    def _follow(self) -> None:
        """Show the result of the readings."""
        readings = self.readings()
        result = presenter.result(readings)
        self.result.set_rows(result.rows)
        warnings = [f"⚠ {words}" for words in result.warnings]
        refused = [f"⚠ {result.why_not}"] if result.why_not else []
        self.words.setText("\n".join(refused or warnings or ["✓ The three lengths agree."]))
        offer(self.use_button, result.why_not or self.locked)
        self.applied.setText(IN_USE if presenter.is_in_use(self.session, readings) else "")
        example = f"{result.why_not}. The drawing shows an example"
        words = example if result.found is None else DRAWN_WORDS
        self.drawing.show_laser(*presenter.drawn(readings, result.found), words)
        self._show_lengths(readings)

    def _show_lengths(self, readings: Readings) -> None:
        """Show the lengths, or means of several readings, in the drawing."""
        several = max(map(len, readings.lengths_mm)) > 1
        for field, lengths in zip(self.length_fields, readings.lengths_mm, strict=True):
            field.set_value(sum(lengths) / len(lengths) if lengths else None)
            field.lock(self.locked or (SEVERAL if several else ""))

    def _enter_length(self, column: int, value: float | None) -> None:
        """Write a length entered in the drawing to the row of the reading that it replaces."""
        rows = range(self.table.rowCount())
        known = (row for row in rows if presenter.length_mm(self._text(row, column)) is not None)
        text = "" if value is None else presenter.length_text(value)
        self.table.setItem(next(known, 0), column, _cell(text))

    # --- the picture ------------------------------------------------------------------------

    def _choose_picture(self) -> None:
        if path := ask_file(self, "Picture of the cross hair", self.workspace.folder):
            self.load_picture(path)

    def _show_picture(self, picture: KeptPicture | None) -> None:
        self._picture, former = picture, self.picture_view.picture
        image = None if picture is None else picture.image
        self.picture_view.show_picture(image, NO_PICTURE)
        for point in self._points.values():
            point.setVisible(image is not None)
        if image is None:
            self._dragged()
            return
        rows, columns = image.shape
        places = presenter.first_places((rows, columns))
        if not self._points:
            for name in (*ENDS, *SCALE):
                color = "#ffb000" if name in ENDS else "#40c4ff"
                point = DragPoint(name, *places[name], color)
                point.moved.connect(lambda *_: self._dragged())
                point.placed.connect(self._placed)
                self._points[name] = point
                self.picture_view.add_point(point)
        elif former is None or former.shape != image.shape:
            for name, point in self._points.items():
                point.set_place(*places[name])
        self._dragged()

    def _take_cross(self, cross: CrossPicture | None) -> None:
        """Show a stored picture with its points; None removes the picture."""
        self._awaited, shown = cross, self._picture
        if cross is None:
            self._show_picture(None)
        elif shown is not None and shown.sha256 == cross.picture_sha256:
            self._place(shown)
        else:
            session, key = self.session, cross.picture_sha256
            self.workspace.tasks.start(
                "Showing the picture of the cross",
                lambda _: KeptPicture("picture", session.picture(key), key),
                self._place,
            )

    def _place(self, picture: KeptPicture) -> None:
        """Show a stored picture that is still awaited, with its points in their places."""
        cross = self._awaited
        if cross is None or cross.picture_sha256 != picture.sha256:
            return
        self._awaited = None
        if self._picture is None:
            self.way.set_value("picture")
            self._show_way("picture")
        self.scale.set_value(cross.scale_mm)
        self._show_picture(picture)
        for name, place in zip((*ENDS, *SCALE), cross.places_px, strict=True):
            self._points[name].set_place(*place)
        self._dragged()

    def _cross(self) -> CrossPicture | None:
        """Picture and points as a session stores them; None without any."""
        if self._picture is None or not self._picture.sha256:
            return self._awaited
        places = tuple(self._points[name].place for name in (*ENDS, *SCALE))
        return CrossPicture(self._picture.sha256, places, self.scale.value() or 0.0)

    def _placed(self) -> None:
        """Store the points and the length of the scale."""
        self._dragged()
        if self._picture is not None and not self.locked:
            self._store()

    def places(self) -> dict[str, Place]:
        """(u, v) of the points by name, px."""
        return {name: point.place for name, point in self._points.items()}

    def _cross_lengths(self) -> tuple[float, float, float] | None:
        picture = self.picture_view.picture
        if not self._points or picture is None:
            self.lengths.setText("")
            return None
        first = presenter.first_places(picture.shape)
        left = [name for name, place in self.places().items() if place == first[name]]
        if left:
            self.lengths.setText(f"⚠ Still to be dragged: {', '.join(left)}")
            return None
        try:
            lengths = presenter.cross_lengths(self.places(), self.scale.value() or 0.0)
        except ValueError as error:
            self.lengths.setText(f"⚠ {error}")
            return None
        parts = (f"{name} {length:.2f} mm" for name, length in zip(NAMES, lengths, strict=True))
        self.lengths.setText(",  ".join(parts))
        return lengths

    def _dragged(self) -> None:
        is_marked = self._cross_lengths() is not None
        unmarked = "" if is_marked else "Place the points on the cross first"
        offer(self.add_button, self.locked or unmarked)


def _length_field(column: int) -> NumberField:
    name, tip = NAMES[column], MEANINGS[column]
    field = NumberField(name, "mm", lowest=0.01, highest=1000, step=0.1, tooltip=tip, optional=True)
    field.set_placeholder(f"{presenter.EXAMPLE_MM[column]:g}")
    return field


class _ReadingsTable(QTableWidget):
    """Three columns of readings; Delete empties the selected ones."""

    def __init__(self) -> None:
        super().__init__(LEAST_ROWS, 3)
        self.setHorizontalHeaderLabels(NAMES)
        for column, (name, meaning) in enumerate(zip(NAMES, MEANINGS, strict=True)):
            header = self.horizontalHeaderItem(column)
            assert header is not None, name
            header.setToolTip(meaning)
        self.setAccessibleName("Readings of l₁, l₂ and l₃ in mm")
        self.setToolTip("; ".join(f"{n}: {m}" for n, m in zip(NAMES, MEANINGS, strict=True)))
        self.horizontalHeader().setSectionResizeMode(QHeaderView.ResizeMode.Stretch)
        self.setTabKeyNavigation(False)  # while a number is edited, Tab still goes to the next cell
        self.fit()

    def fit(self) -> None:
        """Fit the height to the rows, at most eight."""
        header = self.horizontalHeader().sizeHint().height() + 2 * self.frameWidth()
        self.setFixedHeight(header + min(self.rowCount(), 8) * self.rowHeight(0))

    def keyPressEvent(self, event: QKeyEvent) -> None:
        """Clear the selected cells with Delete."""
        if event.key() in (Qt.Key.Key_Delete, Qt.Key.Key_Backspace):
            items = self.selectedItems()
            with QSignalBlocker(self):
                for item in items:
                    item.setText("")
            if items:
                self.itemChanged.emit(items[-1])  # one change, which undo reverts as a whole
        else:
            super().keyPressEvent(event)


def _cell(text: str) -> QTableWidgetItem:
    item = QTableWidgetItem(text)
    item.setTextAlignment(RIGHT)
    return item
