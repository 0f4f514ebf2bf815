"""Window of the error analysis: options at the left, tables and pictures at the right."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING

from PySide6.QtCore import Qt
from PySide6.QtWidgets import QCheckBox, QSizePolicy, QStackedWidget, QWidget

from labapp.export.owned_files import add_owned
from labapp.gui.tasks import Control
from labapp.gui.tools import analysis_presenter as presenter
from labapp.gui.tools.analysis_presenter import BUDGET, OPENED, PARTS, USUAL
from labapp.gui.tools.tool import WORKING, ToolWindow, progress_of
from labapp.gui.widgets.fields import ChoiceField, FieldForm, NumberField, flush_fields, whole
from labapp.gui.widgets.labels import heading, offer, show_words, wrapping_label
from labapp.gui.widgets.layouts import fill
from labapp.gui.widgets.sheet import Sheet
from labapp.gui.widgets.tables import CellTable
from labapp.studies import SCHEME_NAMES
from labapp.studies.analysis import (
    AnalysisOptions,
    AnalysisPart,
    analyze_budget,
    analyze_errors,
    expected_pool,
)
from labapp.studies.tables import Table

if TYPE_CHECKING:
    from labapp.config.setup import Setup
    from labapp.gui.shell.files import Files
    from labapp.simulation.pools import Pool

SIZES = (
    ("width", "Width", 1.0, 30.0, 0.1, "Of the expected pool, along X"),
    ("length", "Length", 1.0, 30.0, 0.1, "Of the expected pool, along Y"),
    ("height", "Height", -30.0, 30.0, 0.01, "Of the expected pool; negative for a concave one"),
)


class AnalysisWindow(ToolWindow):
    """Computes parts of chapter 8 and the uncertainty budget of a set-up, and shows each result."""

    key, command = "analysis", "analyze"
    title = "Error analysis"
    write = staticmethod(add_owned)

    def __init__(self, sessions: Files, window: QWidget) -> None:
        self.tables: dict[str, Table] = {}
        self.pictures: dict[str, bytes] = {}
        """Pictures of the last run, by name."""
        self._anew = False
        self._of: presenter.SetupOf | None = None
        self._basis: object = None
        super().__init__(sessions, window)

    def _make_form(self) -> None:
        self.form.add(heading("What to compute"))
        self.parts: dict[str, QCheckBox] = {}
        for key, words, tip in PARTS:
            box = QCheckBox(words)
            box.setToolTip(tip)
            box.setChecked(key == BUDGET)
            box.toggled.connect(lambda _: self.show_state())
            self.parts[key] = box
            self.form.add(box)
        self.setup = ChoiceField("Set-up", presenter.SETUPS, tooltip="Whose errors are added up")
        self.setup.edited.connect(lambda _: self.show_state())
        self.form.add(heading("For the budget"), self.setup)
        self.sizes: dict[str, NumberField] = {}
        for key, label, lowest, highest, step, tip in SIZES:
            self.sizes[key] = NumberField(
                label, "mm", lowest=lowest, highest=highest, step=step, tooltip=tip
            )
            self.form.add(self.sizes[key])
        self.scheme = ChoiceField(
            "Schemes", presenter.SCHEME_CHOICES, tooltip="By which schemes; the budget is of fit"
        )
        tip = "Between the laser's places: half of it takes four times as long"
        self.step = NumberField(
            "LE, ME: step", "° and mm", lowest=0.25, highest=10, step=0.25, tooltip=tip
        )
        tip = "Of the thumb tack, and of each cap in image processing"
        self.frames = whole("Frames of each", 1, tip, 1000)
        tip = "Of the calibration, in parameter deviation"
        self.draws = whole("Draws", 10, tip, 100_000, step=100)
        usual = AnalysisOptions()
        for field, value in (
            (self.step, usual.step),
            (self.frames, usual.frames),
            (self.draws, usual.draws),
        ):
            field.set_value(value)
        others = heading("For the other parts")
        self.form.add(others, self.scheme, self.step, self.frames, self.draws)

    def _make_results(self) -> None:
        self.which = ChoiceField("Shown", tooltip="Tables and pictures that are done")
        self.which.edited.connect(lambda _: self._show_chosen())
        line = FieldForm(self.which)
        self.words = wrapping_label(
            "Tick what is to be computed, then press Run. All of it is simulated. The budget takes "
            "the ± of the session's set-up, or 0.1 mm, 0.1° and 0.1 px if it has none; the other "
            "parts assume these. A dot is known to 0.3 px."
        )
        self.why, self.former = wrapping_label(), wrapping_label()
        for label in (self.why, self.former):
            label.setSizePolicy(QSizePolicy.Policy.Preferred, QSizePolicy.Policy.Maximum)
            label.hide()
        self.words.setAlignment(Qt.AlignmentFlag.AlignTop)
        self.table = CellTable("Table of the error analysis")
        self.sheet = Sheet("Picture of the error analysis")
        self.stack = QStackedWidget()
        for widget in (self.table, self.sheet):
            self.stack.addWidget(widget)
        fill(self.results, self.why, self.former, line, self.words, (self.stack, 1))
        self.stack.hide()
        self._line = line
        line.hide()

    def _make_buttons(self) -> None:
        self.add_save_button(
            "Save the results…", "Write all tables (CSV, Markdown) and pictures to a folder"
        )
        self.start_button = self.add_button(
            "Run", "Compute what is ticked; each part is shown when it is done", self.start
        )

    # --- what is to be worked out --------------------------------------------------------------

    def prefill(self) -> None:
        """Fill in pool and set-up of the session if they changed since the last time."""
        session = self.workspace.session
        sizes = (
            self.workspace.run_or_report(lambda: presenter.expected_mm(session))
            or presenter.USUAL_MM
        )
        basis = (presenter.has_setup(session), sizes)
        if basis == self._basis:
            return
        self._basis = basis
        self.setup.set_value(OPENED if basis[0] else USUAL)
        for field, value in zip(self.sizes.values(), sizes, strict=True):
            field.set_value(value)

    def start(self) -> None:
        """Compute the ticked parts in the background, one after the other."""
        flush_fields(self.form)
        if self._why_not():
            return
        ticked = tuple(key for key, box in self.parts.items() if box.isChecked())
        scheme = self.scheme.value()
        options = AnalysisOptions(
            parts=tuple(key for key in ticked if key != BUDGET),
            schemes=tuple(one for one in SCHEME_NAMES if scheme in ("", one)),
            step=float(self.step.value() or 0),
            frames=int(self.frames.value() or 0),
            draws=int(self.draws.value() or 0),
        )
        budget = self.workspace.run_or_report(self._budget) if BUDGET in ticked else None
        if BUDGET in ticked and budget is None:
            return
        is_own = budget is not None and budget[0] is not None
        of = presenter.setup_of(self.workspace.session) if is_own else None

        def work(control: Control) -> None:
            if budget is not None:
                control.part(analyze_budget(*budget, progress_of(control)))
            for made in analyze_errors(options, progress_of(control)):
                control.part(made)

        self._anew = True
        self.begin("Computing", work, lambda _: self.say("Done"), partial(self.show_part, of=of))

    def _why_not(self) -> str:
        """Reason why what is ticked cannot be computed; empty if it can."""
        session = self.workspace.session
        is_own = self.parts[BUDGET].isChecked() and self.setup.value() == OPENED
        return presenter.LINES if is_own and session is not None and session.has_lines else ""

    def _budget(self) -> tuple[Setup | None, Pool]:
        """Set-up and pool chosen for the budget."""
        session = self.workspace.session
        pool = expected_pool(*(float(field.value() or 0) for field in self.sizes.values()))
        if self.setup.value() == USUAL:
            return None, pool
        if session is None:
            raise ValueError("no session is open: open one, or take the set-up of §8.3.1")
        return session.setup, pool

    # --- what came out -------------------------------------------------------------------------

    def show_part(self, made: AnalysisPart, of: presenter.SetupOf | None = None) -> None:
        """Show the results of a part; the first one replaces those of an earlier run.

        ``of``: the session's set-up for which the budget is; None for another one.
        """
        if self._anew:
            self._of = of
            self.tables, self.pictures, self.files = {}, {}, {}
            self._anew = False
        self.tables |= {table.name: table for table in made.tables}
        self.pictures |= made.pictures
        self.files |= made.files
        names = (*self.tables, *self.pictures)
        self.which.set_choices([(name, presenter.result_title(name)) for name in names])
        self.which.set_value(made.tables[0].name)
        for widget in (self._line, self.stack):
            widget.show()
        self._show_chosen()
        self.show_state()

    def _show_chosen(self) -> None:
        name = self.which.value()
        if name in self.tables:
            self.words.setText(self.tables[name].caption)
            self.table.show_table(self.tables[name])
            self.stack.setCurrentWidget(self.table)
        else:
            words = presenter.result_title(name)
            self.words.setText(words)
            self.sheet.show_png(self.pictures[name], words)
            self.stack.setCurrentWidget(self.sheet)

    def show_state(self) -> None:
        """Enable the actions that are available now."""
        ticked, why = any(box.isChecked() for box in self.parts.values()), self._why_not()
        show_words(self.why, why)
        show_words(self.former, presenter.of_former_setup(self.workspace.session, self._of))
        unticked = "" if ticked else "Tick what is to be computed"
        offer(self.start_button, why or unticked or (WORKING if self.working else ""))
        offer(self.save_button, "" if self.files else "There are no results yet: press Run")
