"""The imaging-plane page: picture of the target with O′ and the axes, found or dragged."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pyqtgraph as pg

from labapp.config.setup_text import lens_of
from labapp.core.calibration.board_calibration import BoardCalibration
from labapp.core.calibration.boards import BOARDS
from labapp.core.calibration.imaging_plane import Calibration, calibrate_imaging_plane
from labapp.core.calibration.mark_fit import Model
from labapp.core.calibration.plane_calibration import PlaneCalibration
from labapp.files import write_file
from labapp.gui.dialogs import ask_file, ask_save
from labapp.gui.pages.kept_picture import KeptPicture, load_picture
from labapp.gui.pages.page import Page
from labapp.gui.pages.plane import presenter
from labapp.gui.pages.plane.presenter import POINTS
from labapp.gui.shell.steps import Lead, Offer
from labapp.gui.tasks import DONE, Task
from labapp.gui.views.drag_point import DragPoint
from labapp.gui.views.picture import PictureView
from labapp.gui.widgets.buttons import button
from labapp.gui.widgets.fields import ChoiceField, FieldForm, NumberField
from labapp.gui.widgets.labels import Message, offer, plain_label, show_words, wrapping_label
from labapp.gui.widgets.layouts import fill
from labapp.gui.widgets.result_table import ResultTable
from labapp.gui.workspace import Workspace
from labapp.session.file.blobs import fingerprint
from labapp.session.record import PlanePicture
from labapp.simulation.calibration.board import board_pdf, board_svg
from labapp.simulation.calibration.target import Target, target_svg

NO_PICTURE = (
    "Load a picture of the target, or of a board, in the imaging plane, taken by the camera in its "
    "place."
)

IN_USE = f"{DONE} This calibration is in use"

ADD = "A further picture of the same board, tilted or nearer to a corner of the picture"

PRINTS = ("imaging_plane_4_inch", *BOARDS)
"""Targets that can be printed: that of the dissertation, and the boards."""

COLOR = "#ffb000"


class PlanePage(Page):
    """A picture with three points, and the resulting scales and angle."""

    key = "plane"

    def __init__(self, workspace: Workspace) -> None:
        super().__init__(workspace)
        self.view = PictureView("Picture of the target")
        self.view.show_picture(None)
        self.canvas_layout.addWidget(self.view)
        self.found: Calibration | None = None
        self._pictures: tuple[KeptPicture, ...] = ()
        self._stored: tuple[Path, str] | None = None
        self._finding: Task | None = None
        self._axes = pg.PlotDataItem(pen=pg.mkPen(COLOR, width=1.5))
        self._marks = pg.PlotDataItem(
            pen=None, symbol="+", symbolSize=11, symbolPen=pg.mkPen(COLOR, width=1.5)
        )
        self._residuals: list[pg.PlotDataItem] = []
        self.points: list[DragPoint] = []
        self._make_panel()

    def refresh(self) -> None:
        """Show points that did not change on this page, and the values in use."""
        former, entries = self._stored, presenter.entries(self.session)
        self._stored = self.session.path, fingerprint(entries)
        is_same_session = former is not None and former[0] == self.session.path
        # What could not be stored stays.
        if self._stored != former and not (is_same_session and self._is_shown(entries)):
            self._clear()
            if entries is not None:
                self._take(entries)
        none = "The session keeps no picture yet: Apply keeps it"
        offer(self.kept_button, none if self.session.plane_calibration is None else "")
        self.in_use.set_rows(presenter.in_use(self.session))
        self._follow()

    def load(self, path: Path) -> None:
        """Show a picture of the target and find O′ and the axes in it."""
        session = self.session

        def loaded(picture: KeptPicture) -> None:
            self._show((picture,), None)
            self.find_axes()

        self.start_latest(
            "Loading the picture", path, lambda _: load_picture(session, path), loaded
        )

    def add_picture(self, path: Path) -> None:
        """Add a picture of the board in another pose."""
        session = self.session

        def loaded(picture: KeptPicture) -> None:
            self._pictures = (*self._pictures, picture)
            self.find_axes()

        self.start_task("Loading the picture", lambda _: load_picture(session, path), loaded)

    def take_kept(self) -> None:
        """Show the picture and the points in use; those not applied are discarded."""
        kept, waiting = self.session.plane_calibration, self.session.plane_entries
        if waiting is not None and not self.locked:
            self.workspace.attempt(lambda session: session.set_entries("plane", None))
        elif kept is not None:
            self._take(kept)

    def _take(self, stored: PlanePicture) -> None:
        """Show stored points and their pictures."""
        session, since = self.session, self._stored

        def shown(pictures: tuple[KeptPicture, ...]) -> None:
            if self._stored == since:
                is_board = isinstance(stored.found, BoardCalibration)
                (self.square if is_board else self.unit).set_value(stored.unit_mm)
                self._show(pictures, stored.found)

        self.workspace.tasks.start(
            "Showing the calibration picture",
            lambda _: presenter.pictures(session, stored),
            shown,
        )

    def entries(self) -> PlanePicture | None:
        """What is shown, as a session stores it; None if that cannot be stored."""
        if self.found is None or not self._pictures:
            return None
        return presenter.stored(self.found, self._applied_unit(), self._pictures)

    def _store(self) -> None:
        """Store the points until they are applied."""
        entries = self.entries()
        if entries is not None and not self.locked:
            self.workspace.attempt(lambda session: presenter.enter(session, entries))

    def _is_shown(self, entries: PlanePicture | None) -> bool:
        return fingerprint(self.entries()) == fingerprint(entries)

    def leave(self) -> None:
        """Store a point that is being dragged."""
        if not self._is_shown(presenter.entries(self.session)):
            self._store()

    def find_axes(self) -> None:
        """Find O′ and the axes."""
        image = self.view.picture
        if image is None:
            return
        images = tuple(picture.image for picture in self._pictures)
        unit, lens = self._unit(), lens_of(self.session.setup_text)

        def found(calibration: Calibration) -> None:
            if self.view.picture is image:
                if isinstance(calibration, BoardCalibration):
                    self.square.set_value(calibration.board.square_mm)
                self._place(presenter.with_unit(calibration, self._unit()))
                self._store()

        self._finding = self.start_latest(
            "Looking for O′ and the axes",
            (tuple(map(id, images)), unit, lens),
            lambda _: calibrate_imaging_plane(images, unit, lens=lens),
            found,
        )

    def use(self) -> None:
        """Use the displayed calibration."""
        found, unit = self.found, self._applied_unit()
        if found is None or not self._pictures:
            return
        first = self._pictures[0]
        if self.workspace.attempt(
            lambda session: session.use_plane(found, unit, first.image, first.name)
        ):
            words = "The calibration is in use; undo restores the former one"
            self.workspace.notified.emit(words, False)

    def lead(self, found: Lead | None) -> Lead | None:
        """Sources of a picture while there is none."""
        if self.view.picture is not None:
            return found
        load = Offer("&Load picture…", "Of the target, or of a board", self._choose)
        tip = "The target that is chosen at the right"
        return Lead(NO_PICTURE, (load, Offer("&Save for printing…", tip, self._choose_target)))

    # --- the panel --------------------------------------------------------------------------

    def _make_panel(self) -> None:
        tip = "A picture of the target, taken by the camera in its place"
        load = button("Load picture…", tip, self._choose)
        self.kept_button = button("Picture in use", "Show what is in use again", self.take_kept)
        tip = "From one flag of a bar to the next: measure it on the printed target"
        self.unit = NumberField(
            "Unit of the axes", "mm", lowest=0.001, highest=1000, step=0.05, decimals=3, tooltip=tip
        )
        self.unit.set_value(presenter.UNIT_MM)
        self.unit.edited.connect(lambda _: self._unit_changed())
        self._make_board_fields()
        tip = "Look for the dot and the two bars in the picture"
        self.find_button = button("Find O′ and the axes", tip, self.find_axes)
        fill(
            self.panel_layout,
            FieldForm(
                *(load, self.kept_button, self.unit, self.square, self.add_button),
                *(self.find_button, self.answer),
            ),
        )
        self._make_results()
        self.lock_with_session(self.unit, self.square)

    def _make_board_fields(self) -> None:
        self.square = NumberField(
            "Square of the board",
            "mm",
            lowest=0.1,
            highest=1000,
            step=0.05,
            decimals=3,
            tooltip="Edge of a square: measure ten of them on the printed board",
        )
        self.square.edited.connect(lambda _: self._square_changed())
        self.add_button = button("Add picture of the board…", ADD, self._choose_further)

    def _print_form(self) -> FieldForm:
        self.print = ChoiceField(
            "To print",
            tuple((name, name.replace("_", " ")) for name in PRINTS),
            tooltip="The dissertation's target, or a board: ChArUco boards may be seen in part",
        )
        tip = "At true size (SVG or PDF): print it at 100 % and measure its unit or squares"
        save = button("Save for printing…", tip, self._choose_target)
        self.saved = Message(2)
        return FieldForm(self.print, save, self.saved)

    def _make_results(self) -> None:
        tip = "How pixels map to the plane: a fit to the tick marks, or the three points"
        self.model = ChoiceField("Use", presenter.choices(None), tooltip=tip)
        self.model.edited.connect(self.choose_model)
        tip = "Measure with this calibration; undo restores the former one"
        self.use_button, self.applied = button("Apply", tip, self.use), Message(2)
        help_text = wrapping_label(
            "Drag a point that is not right: O′ to the middle of the dot, the others to the "
            "middles of their bars. P chooses the next one, arrow keys move it by 0.1 px."
        )
        self.words, self.why = wrapping_label(), wrapping_label()
        self.result = ResultTable("The calibration computed from points and marks")
        self.in_use = ResultTable("Image calibration in use")
        fill(
            self.panel_layout,
            *(FieldForm(self.model), self.use_button, self.applied, help_text, self._print_form()),
            *(self.words, self.result, self.why, plain_label("In use now"), self.in_use, 1),
        )

    def _choose(self) -> None:
        if path := ask_file(self, "Picture of the target", self.workspace.folder):
            self.load(path)

    def _choose_target(self) -> None:
        proposed = self.workspace.folder / f"{self.print.value()}.svg"
        if path := ask_save(self, "Save for printing", proposed, "SVG (*.svg);;PDF (*.pdf)"):
            self.save_target(path)

    def _choose_further(self) -> None:
        if path := ask_file(self, "Picture of the board", self.workspace.folder):
            self.add_picture(path)

    def save_target(self, path: Path) -> None:
        """Write the target to a file for printing."""
        name = str(self.print.value())

        def content() -> bytes:
            if name not in BOARDS:
                return target_svg(Target()).encode()
            is_pdf = path.suffix.lower() == ".pdf"
            return board_pdf(BOARDS[name]) if is_pdf else board_svg(BOARDS[name]).encode()

        if self.workspace.run_or_report(
            lambda: write_file(path, content()), show_answer=self.saved.setText
        ):
            self.confirm(f"Saved in {path}: print it at 100 %", self.saved)

    # --- the picture ------------------------------------------------------------------------

    def _unit(self) -> float:
        return self.unit.value() or presenter.UNIT_MM

    def _applied_unit(self) -> float:
        """Unit of the target, or square of the board, that is stored with the points, mm."""
        found = self.found
        return found.board.square_mm if isinstance(found, BoardCalibration) else self._unit()

    def _unit_changed(self) -> None:
        if self.found is not None:
            self._place(presenter.with_unit(self.found, self._unit()))
            self._store()

    def _square_changed(self) -> None:
        square = self.square.value()
        if isinstance(self.found, BoardCalibration) and square is not None:
            self._place(self.found.with_square(square))
            self._store()

    def _clear(self) -> None:
        self._pictures = ()
        self.view.show_picture(None)
        self.lead_changed.emit()
        self._place(None)

    def _show(self, pictures: tuple[KeptPicture, ...], found: Calibration | None) -> None:
        self._pictures, image = pictures, pictures[0].image
        self.view.show_picture(image)
        self.lead_changed.emit()
        rows, columns = image.shape
        self._place(found or presenter.first_points((rows, columns), self._unit()))

    def _place(self, found: Calibration | None) -> None:
        self.found = found
        if found is not None and not self.points:
            self.view.add(self._axes)
            self.view.add(self._marks)
            for k, (name, place) in enumerate(zip(POINTS, presenter.places(found), strict=True)):
                point = DragPoint(name, *place, COLOR)
                point.moved.connect(lambda u, v, k=k: self.drag(k, u, v))
                point.placed.connect(self._store)
                self.points.append(point)
                self.view.add_point(point)
        for k, point in enumerate(self.points):
            point.setVisible(isinstance(found, PlaneCalibration))
            if found is not None:
                point.set_place(*presenter.places(found)[k])
        self._follow()

    def drag(self, point: int, u: float, v: float) -> None:
        """Move one of the points."""
        if isinstance(self.found, PlaneCalibration):
            if self._finding is not None:
                self._finding.cancel()  # otherwise it would replace the operator's point
            self.found = presenter.moved(self.found, point, (u, v))
            self._follow()

    def choose_model(self, model: Model) -> None:
        """Use another model than the proposed one."""
        if isinstance(self.found, PlaneCalibration):
            self._place(replace(self.found, model=model))
            self._store()

    def _show_residuals(self) -> None:
        for item in self._residuals:
            self.view.remove(item)
        self._residuals = []
        picture = self.view.picture
        shown = None if picture is None else presenter.residual_map(self.found, picture.shape[0])
        words = (presenter.why(self.found), "" if shown is None else shown.words)
        show_words(self.why, "\n".join(filter(None, words)))
        if shown is None:
            return
        colors = pg.colormap.get("viridis").map(0.3 + 0.7 * shown.share, mode="qcolor")
        for begin, end, color in zip(shown.begin_px, shown.end_px, colors, strict=True):
            u, v = zip(begin, end, strict=True)
            # The dot is at the mark, so that the direction is clear without colour, too.
            item = pg.PlotDataItem(
                u, v, pen=pg.mkPen(color, width=2.5), symbol="o", symbolBrush=color
            )
            item.setSymbolSize([5, 0])
            item.setSymbolPen(None)
            self.view.add(item)
            self._residuals.append(item)

    def _follow(self) -> None:
        """Show the result of the points."""
        result = presenter.result(self.found)
        self.model.set_choices(presenter.choices(self.found))
        is_board = isinstance(self.found, BoardCalibration)
        has_marks = isinstance(self.found, PlaneCalibration) and bool(self.found.marks)
        self.model.setEnabled(has_marks and not self.locked)
        if isinstance(self.found, PlaneCalibration):
            self.model.set_value(self.found.model)
        elif is_board:
            self.model.set_value("homography")
        self.square.setEnabled(is_board and not self.locked)
        no_board = "" if is_board else f"{ADD}: load the one in the plane first"
        offer(self.add_button, self.locked or no_board)
        self.applied.setText(IN_USE if presenter.is_in_use(self.session, self.found) else "")
        self._show_residuals()
        self.result.set_rows(result.rows)
        self.result.setVisible(bool(result.rows))
        why_not = (result.why_not,) if result.why_not else ()
        unlike = presenter.size_warnings(self.session, self.view.picture)
        parts = (f"⚠ {words}" for words in (*why_not, *result.warnings, *unlike))
        show_words(self.words, "\n".join(parts))
        offer(self.use_button, result.why_not or self.locked)
        no_picture = "" if self.view.picture is not None else "Load a picture of the target first"
        offer(self.find_button, self.locked or no_picture)
        for point in self.points:
            point.movable = not self.locked
        self._axes.setVisible(self.found is not None)
        self._marks.setVisible(self.found is not None)
        if self.found is not None:
            try:
                line, marks = presenter.axes(self.found, self._unit())
            except ValueError:  # the three points lie on one line at present
                return
            self._axes.setData(line[:, 0], line[:, 1])
            self._marks.setData(marks[:, 0], marks[:, 1])
