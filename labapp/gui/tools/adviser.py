"""Window of the configuration adviser: pools and bench at the left, advice at the right."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from PySide6.QtWidgets import QVBoxLayout, QWidget

from labapp.gui.tasks import Control
from labapp.gui.tools import adviser_presenter as presenter
from labapp.gui.tools.tool import WORKING, ToolWindow, progress_of
from labapp.gui.views.ranges import RangeField
from labapp.gui.widgets.fields import ChoiceField, NumberField, flush_fields
from labapp.gui.widgets.labels import heading, offer, wrapping_label
from labapp.gui.widgets.layouts import Group, fill, scrolled, tabs_of
from labapp.gui.widgets.result_table import ResultTable
from labapp.gui.widgets.sheet import Sheet
from labapp.gui.widgets.tables import CellTable
from labapp.studies.adviser import search as adviser
from labapp.studies.adviser.files import advice_files
from labapp.studies.adviser.keys import parse_request
from labapp.studies.adviser.report import cost_table
from labapp.studies.adviser.search import Advice, Effort, advise

if TYPE_CHECKING:
    from labapp.gui.shell.files import Files

RANGES = (
    ("pools.width_mm", "Width", "mm", 1, 50, 0.1, "Of the pools, along X"),
    ("pools.length_mm", "Length", "mm", 1, 50, 0.1, "Of the pools, along Y"),
    ("pools.height_mm", "Height or depth", "mm", 0.01, 10, 0.01, "Of the pools, above 0"),
    ("bench.projection_angle_deg", "Laser, angle", "°", 5, 80, 1, "Where the laser can stand"),
    ("bench.distance_mm", "Laser, distance", "mm", 10, 500, 1, "Where the laser can stand"),
    ("bench.plane_distance_mm", "Plane, distance", "mm", 10, 1000, 1, "Where it can stand"),
    ("bench.s_mm", "Plane, s", "mm", -500, 500, 1, "How far to the left O′ can be"),
    ("bench.h_mm", "Plane, h", "mm", -500, 500, 1, "How high O′ can be"),
)
NUMBERS = (
    ("pools.shift_mm", "Offset from electrode", 0, 5, 0.1,
        "How far a pool's middle is off it at most"),
    ("bench.width_mm", "Plane's width", 10, 1000, 1, "Along O′X′"),
    ("bench.height_mm", "Plane's height", 10, 1000, 1, "Along O′Z′"),
    ("bench.edge_mm", "Edge", 0, 50, 0.5, "How far dots stay within the plane's edges"),
    ("bench.electrode_height_mm", "Electrode height", 0, 50, 0.5, "Work piece to the tip"),
)  # fmt: skip


class AdviserWindow(ToolWindow):
    """Asks for pools and limits, searches a set-up, and offers it to the session."""

    key, command = "adviser", "advise"
    title = "Configuration adviser"

    def __init__(self, sessions: Files, window: QWidget) -> None:
        self.advice: Advice | None = None
        self._sought_for: Path | None = None
        self._basis: object = None
        self._asked: presenter.Values = {}
        super().__init__(sessions, window)
        self.workspace.opened.connect(self._follow_session)

    def _make_form(self) -> None:
        self.ranges: dict[str, RangeField] = {}
        self.numbers: dict[str, NumberField] = {}
        kinds = (("convex", "convex"), ("concave", "concave"))
        self.kind = ChoiceField("Kind", kinds, tooltip="Above the work piece, or below it")
        efforts = (("thorough", "thorough: minutes"), ("quick", "quick: a tenth of the time"))
        self.effort = ChoiceField("Search", efforts, tooltip="Quick: the error is known to 20 %")
        self.form.add(heading("Expected pools: min., max."), self.kind)
        for key, label, unit, lowest, highest, step, tip in RANGES:
            if key == "bench.projection_angle_deg":
                self.form.add(heading("Limits of the bench: min., max."))
            self.ranges[key] = RangeField(
                label, unit, lowest=lowest, highest=highest, step=step, tooltip=tip
            )
            self.form.add(self.ranges[key])
        self.form.add(heading("Fixed"))
        for key, label, lowest, highest, step, tip in NUMBERS:
            self.numbers[key] = NumberField(
                label, "mm", lowest=lowest, highest=highest, step=step, tooltip=tip
            )
            self.form.add(self.numbers[key])
        self.form.add(self.effort)

    def _make_results(self) -> None:
        self.headline = wrapping_label()
        self.place = ResultTable("Recommended set-up")
        self.kept = ResultTable("Constraints, and their margins")
        self.costs = CellTable("Added error per mm and degree")
        self.sheet = Sheet("Bench, places of the laser, and cost curves")
        self.words = QWidget()
        tables = (self.place, self.kept, self.costs)
        self.groups = [Group(table.accessibleName(), table) for table in tables]
        fill(QVBoxLayout(self.words), self.headline, *self.groups, 1)
        for group in self.groups:
            group.hide()
        parts = {"Advice": scrolled(self.words, "Advice"), "Picture": self.sheet}
        self.tabs = tabs_of("Parts of the advice", parts)
        self.results.addWidget(self.tabs)

    def _make_buttons(self) -> None:
        self.add_save_button(
            "Save the advice…", "Write words, tables, picture and set-up file to a folder"
        )
        self.use_button = self.add_button(
            "Apply", "Apply this set-up to the session; undo restores the former one", self.use
        )
        self.start_button = self.add_button(
            "Advise", "Search for the set-up with the least error of the height", self.start
        )

    # --- asking ------------------------------------------------------------------------------

    def prefill(self) -> None:
        """Fill in pool and rig of the session if they changed since the last time."""
        values = self.workspace.run_or_report(lambda: presenter.question(self.workspace.session))
        if values is None or values == self._basis:
            return
        self._basis = values
        self._asked = {table: dict(keys) for table, keys in values.items()}
        self.kind.set_value(values["pools"]["kind"])
        for key, field in self.ranges.items():
            table, _, name = key.partition(".")
            field.set_value(tuple(values[table][name]))
        for key, number in self.numbers.items():
            table, _, name = key.partition(".")
            number.set_value(values[table][name])

    def values(self) -> presenter.Values:
        """The request in the fields."""
        flush_fields(self.form)
        self._ask_for_bench()
        values = {table: dict(keys) for table, keys in self._asked.items()}
        values["pools"]["kind"] = self.kind.value()
        for key, field in self.ranges.items():
            table, _, name = key.partition(".")
            values[table][name] = list(field.value())
        for key, number in self.numbers.items():
            table, _, name = key.partition(".")
            values[table][name] = number.value()
        return values

    def _ask_for_bench(self) -> None:
        """Ask for pattern and calibration of the session, which have no fields."""
        now = self.workspace.run_or_report(lambda: presenter.question(self.workspace.session))
        if now is not None:
            shown = {table: self._asked[table] for table in ("pools", "bench")}
            self._asked = {**now, **shown}

    def _follow_session(self) -> None:
        """Ask for the pool and bench of another session, even if the window is already open."""
        if self.isVisible():
            self.prefill()
            self.show_state()

    def start(self) -> None:
        """Search in the background."""
        session = self.workspace.session
        if presenter.why_not_advised(session):
            return
        sought_for = None if session is None else session.path
        request = self.workspace.run_or_report(lambda: parse_request(self.values(), "the adviser"))
        if request is None:
            return
        effort = adviser.QUICK if self.effort.value() == "quick" else Effort()

        def work(control: Control) -> tuple[Advice, dict[str, bytes]]:
            advice = advise(*request, effort, progress=progress_of(control))
            return advice, advice_files(advice)

        def found(made: tuple[Advice, dict[str, bytes]]) -> None:
            self._sought_for = sought_for
            self.show_advice(*made)

        self.begin("Advising", work, found)

    # --- what was found ------------------------------------------------------------------------

    def show_advice(self, advice: Advice, files: dict[str, bytes]) -> None:
        """Show an advice, and enable saving of its files."""
        self.advice, self.files = advice, files
        self.place.set_rows(presenter.place_rows(advice))
        self.kept.set_rows(presenter.kept_rows(advice))
        if advice.possible:
            self.costs.show_table(cost_table(advice))
            bar = self.costs.horizontalScrollBar().sizeHint().height()
            self.costs.setFixedHeight(self.costs.full_height + bar)  # the surrounding area scrolls
        for group, shown in zip(self.groups, (True, True, advice.possible), strict=True):
            group.setVisible(shown)
        self.sheet.show_png(files["advice.png"], presenter.headline(advice))
        self.say("Done")
        self.show_state()

    def show_state(self) -> None:
        """Enable the actions that are available now."""
        session, advice = self.workspace.session, self.advice
        lines, other = presenter.why_not_advised(session), ""
        words = "" if lines else "Enter pools and limits, then press Advise."
        if advice is not None:
            other = presenter.why_not_applied(session, advice, self._sought_for)
            words = presenter.headline(advice)
        self.headline.setText(" ".join(filter(None, (lines, other, words))))
        offer(self.start_button, lines or (WORKING if self.working else ""))
        offer(self.use_button, lines or other or presenter.why_not_usable(session, advice))
        offer(self.save_button, "" if self.files else presenter.NO_ADVICE)

    def use(self) -> None:
        """Use the recommended set-up in the session."""
        advice, session = self.advice, self.workspace.session
        if advice is None or presenter.why_not_advised(session):
            return
        if presenter.why_not_applied(session, advice, self._sought_for):
            return
        if self.workspace.attempt(lambda s: presenter.use(s, advice)):
            self.workspace.notified.emit(
                "The advised set-up is applied: calibrate its laser and imaging plane", False
            )
