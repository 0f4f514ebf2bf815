"""The set-up page: four tabs at the side of the drawing of the bench."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

from PySide6.QtWidgets import QCheckBox, QLabel, QVBoxLayout, QWidget

from labapp.files import write_file
from labapp.gui.dialogs import SETUP_FILES, ask_save, ask_setup
from labapp.gui.pages.page import Page
from labapp.gui.pages.setup import presenter
from labapp.gui.pages.setup.presenter import (
    DEFAULTS,
    EXPERIMENT,
    KINDS,
    POOL,
    RIG,
    TRAVELS,
    UNCERTAIN_ONLY,
    Entry,
)
from labapp.gui.shell.setups import load_setup
from labapp.gui.tasks import PROBLEM
from labapp.gui.views.drawings.bench import DRAWN, BenchView
from labapp.gui.views.drawings.pattern import PatternView
from labapp.gui.widgets.buttons import button
from labapp.gui.widgets.fields import ChoiceField, FieldForm, NumberField, TextField
from labapp.gui.widgets.labels import Message, heading, show_words, wrapping_label
from labapp.gui.widgets.layouts import column_of, fill, hbox, tabs_of
from labapp.gui.widgets.result_table import ResultTable
from labapp.gui.workspace import Workspace
from labapp.session.checklist import EQUIPMENT, SAFETY, STEPS, Items, tick, ticked
from labapp.text import local_time, now

ENTRIES = {entry.key: entry for _, entries in RIG for entry in entries}

EXPERIMENT_TAB, SAFETY_TAB, BENCH_TAB = range(3)


class SetupPage(Page):
    """Experiment, lists of Appendix II, and bench with its drawing."""

    key = "setup"

    def __init__(self, workspace: Workspace) -> None:
        super().__init__(workspace)
        self.drawn_fields = {key: self._put_field(ENTRIES[key]) for key in DRAWN}
        self.bench = BenchView(self.drawn_fields)
        self.canvas_layout.addWidget(self.bench)
        self.rig_fields: dict[str, NumberField] = {}
        self.sigma_fields: dict[str, NumberField] = {}
        self.record_fields: dict[str, NumberField | TextField] = {}
        self.ticks: dict[str, QCheckBox] = {}
        self.steps: dict[str, QCheckBox] = {}
        self._times: dict[str, QLabel] = {}
        self._drawn: object = None
        self._recorded: object = None
        safety, preparation = self._list(self.ticks, SAFETY), QWidget()
        lists = (("Equipment", EQUIPMENT), ("Steps", STEPS))
        layout = QVBoxLayout(preparation)
        for title, items in lists:
            layout.addWidget(heading(title))
            layout.addWidget(self._list(self.steps, items))
        contents = (self._experiment(), safety, self._bench(), preparation)
        titles = ("Experiment", "Safety", "Bench", "Steps")
        pages = dict(zip(titles, map(_top, contents), strict=True))
        self.tabs = tabs_of("Parts of the set-up", pages)

        def show_tab(number: int) -> None:
            # Otherwise the other tabs could be scrolled to the height of the highest one.
            for tab, content in enumerate(contents):
                content.setVisible(tab == number)

        self.tabs.currentChanged.connect(show_tab)
        show_tab(EXPERIMENT_TAB)
        self.panel_layout.addWidget(self.tabs)
        self.lock_with_session(
            *(*self.rig_fields.values(), *self.sigma_fields.values(), self.kind, self.travel),
            *self.drawn_fields.values(),
            *(*self.record_fields.values(), *self.ticks.values(), *self.steps.values()),
            *self._filling,
        )
        self.panel_layout.setContentsMargins(0, 0, 0, 0)

    def refresh(self) -> None:
        """Show record, safety list and setup of the session."""
        session, shown = self.session, presenter.shown(self.session)
        for key, field in (*self.rig_fields.items(), *self.drawn_fields.items()):
            field.set_value(shown.values[key])
            field.set_placeholder(f"{DEFAULTS[key]:g}")
            if shown.problems.get(key):
                field.set_problem(shown.problems[key])
        for key, field in self.sigma_fields.items():
            field.set_value(shown.sigmas[key])
            field.set_placeholder(f"{shown.usual_sigmas[key]:.2g}")
            if shown.problems.get(key):
                field.set_problem(shown.problems[key])
        self.kind.set_value(shown.kind)
        self._show_kind(shown.kind)
        self.travel.set_value(shown.travel)
        self.status.setText(shown.status)
        self.sigma_words.setText(shown.sigma_words)
        recorded = (session.path, shown.record)
        for name, noted in self.record_fields.items():
            # A text that could not be stored stays: it took long to type.
            if recorded != self._recorded or isinstance(noted, NumberField):
                noted.set_value(getattr(shown.record, name))
        self._recorded = recorded
        times = dict(ticked(shown.record))
        for item, box in (self.ticks | self.steps).items():
            box.setChecked(item in times)
            self._times[item].setText(f"ticked {local_time(times[item])}" if item in times else "")
        self.tabs.setTabText(SAFETY_TAB, f"Safety {len(times.keys() & self.ticks)}/{len(SAFETY)}")
        self.tabs.setTabText(BENCH_TAB, "Bench ⚠" if shown.problems or shown.missing else "Bench")
        show_words(self.others, "\n".join(shown.others))
        basis = (session.setup_text, shown.record)
        if basis != self._drawn:
            self._drawn = basis
            bench = presenter.bench(session)
            self.bench.show_bench(bench.rig, bench.view, bench.words)
            pattern = None if bench.rig is None else bench.rig.pattern
            self.pattern.show_pattern(pattern, bench.pattern_words)
            self.table.set_rows(bench.rows)
            self.table.setVisible(bool(bench.rows))

    def _show_kind(self, kind: str) -> None:
        for _, entries in RIG:
            for entry in entries:
                field, sigma = self.rig_fields[entry.key], presenter.sigma_entry(entry)
                field.setVisible(kind in entry.kinds)
                field.label.setVisible(kind in entry.kinds)
                if sigma is not None:  # its label is not shown
                    self.sigma_fields[sigma.key].setVisible(kind in sigma.kinds)

    def load(self, path: Path) -> None:
        """Load the setup from a file."""
        if self.workspace.attempt(
            lambda session: load_setup(session, path), "Loading", self.answer.setText
        ):
            self.confirm(f"Set-up loaded from {path.name}")
            if unlike := self.workspace.check_size():
                self.answer.setText(f"{PROBLEM} {unlike}")

    def take(self, path: Path, at_once: bool = False) -> None:
        """Load the setup from a dropped file, in the tab that shows it."""
        self.tabs.setCurrentIndex(BENCH_TAB)
        self.load(path)

    def save(self, path: Path) -> None:
        """Write the setup to a file."""
        content = self.session.setup_text.encode()
        if self.workspace.run_or_report(
            lambda: write_file(path, content), "Saving", self.answer.setText
        ):
            self.confirm(f"Set-up saved in {path}")

    # --- within -----------------------------------------------------------------------------

    def _experiment(self) -> QWidget:
        form = FieldForm()
        for entry in EXPERIMENT:
            self._add_noted(form, entry)
        return form

    def _add_noted(self, form: FieldForm, entry: Entry) -> None:
        field: NumberField | TextField
        if entry.lowest < entry.highest:
            field = _number(entry)
        else:
            lines = 4 if entry.key == "notes" else 1
            field = TextField(entry.label, tooltip=entry.tooltip, lines=lines)
        field.edited.connect(partial(self._note, field, entry.key))
        self.record_fields[entry.key] = field
        form.add(field)

    def _note(self, field: NumberField | TextField, key: str, value: Any) -> None:
        stored = self.workspace.attempt(lambda session: presenter.note(session, key, value))
        session = self.workspace.session
        if not stored and session is not None and isinstance(field, TextField):
            field.keep_unstored(getattr(session.record, key))

    def _list(self, boxes: dict[str, QCheckBox], items: Items) -> QWidget:
        page = QWidget()
        layout = QVBoxLayout(page)
        for item, meaning in items:
            box = QCheckBox(item)
            box.setToolTip(f"{meaning} The time of the tick is recorded.")
            box.setAccessibleDescription(meaning)
            box.clicked.connect(lambda on, item=item: self._tick(item, on))
            layout.addWidget(box)
            time, means = Message(1), wrapping_label(meaning)
            for label in (means, time):
                label.setIndent(24)
                layout.addWidget(label)
            layout.addSpacing(4)
            boxes[item], self._times[item] = box, time
        return page

    def _tick(self, item: str, on: bool) -> None:
        self.workspace.attempt(
            lambda session: session.set_record(tick(session.record, item, on, now()))
        )

    def _bench(self) -> QWidget:
        load = button("Load…", "Take all of the set-up from a setup file (TOML)", self._choose_load)
        save = button("Save…", "Write the set-up to a file, for another session", self._choose_save)
        tip = "Enter the dissertation's bench where nothing is entered; check each number"
        usual = button("Use defaults", tip, self._use_defaults)
        self._filling = load, usual
        self.status, self.sigma_words = Message(3), Message(2)
        buttons = column_of(hbox(load, save), usual)
        form = FieldForm(buttons, self.answer, self.status, self.sigma_words)
        for title, entries in RIG:
            form.add(heading(title))
            if title == "Pattern":
                tip = (
                    "Dots, and how they lie to each other, or lines. "
                    "Measured rays come with a setup file: Load…"
                )
                self.kind = ChoiceField("Kind", KINDS, tooltip=tip)
                self.change_when_edited(self.kind, presenter.put_kind)
                self.pattern = PatternView()
                form.add(self.kind, self.pattern)
            for entry in entries:
                field = self.rig_fields[entry.key] = self._put_field(entry)
                sigma = presenter.sigma_entry(entry)
                form.add(field, beside=None if sigma is None else self._sigma_field(sigma))
            if title == "Torch":
                tip = "Where the pool's head is: +Y is the laser's side. The rear may lie lower"
                self.travel = ChoiceField("Welding", TRAVELS, tooltip=tip)
                self.change_when_edited(self.travel, presenter.put_travel)
                form.add(self.travel)
        title, entries = UNCERTAIN_ONLY
        form.add(heading(f"{title}, ±"))
        for entry in entries:
            form.add(self._sigma_field(entry))
        form.add(heading("Expected pool"))
        for entry in POOL:
            self._add_noted(form, entry)
        tip = "Where laser and plane should stand for such pools (Ctrl+Shift+A)"
        advise = button("Advise…", tip, lambda: self.workspace.action_requested.emit("adviser"))
        self.table = ResultTable("Rays that reach the imaging plane")
        self.others = wrapping_label()
        form.add(advise, self.table, self.others)
        return form

    def _put_field(self, entry: Entry) -> NumberField:
        """A field that enters its number in the set-up."""
        field = _number(entry)
        self.change_when_edited(
            field, lambda session, value: presenter.put(session, entry.key, value)
        )
        return field

    def _sigma_field(self, entry: Entry) -> NumberField:
        field = self.sigma_fields[entry.key] = self._put_field(entry)
        return field

    def _use_defaults(self) -> None:
        if self.workspace.attempt(presenter.put_usual, show_answer=self.answer.setText):
            self.confirm("Defaults entered where nothing was; measure what is still grey")

    def _choose_load(self) -> None:
        if path := ask_setup(self, self.workspace.folder):
            self.load(path)

    def _choose_save(self) -> None:
        proposed = self.workspace.folder / "setup.toml"
        if path := ask_save(self, "Save set-up", proposed, SETUP_FILES):
            self.save(path)


def _number(entry: Entry) -> NumberField:
    return NumberField(
        entry.label,
        entry.unit,
        lowest=entry.lowest,
        highest=entry.highest,
        step=entry.step,
        decimals=entry.decimals,
        tooltip=entry.tooltip,
        optional=True,
    )


def _top(content: QWidget) -> QWidget:
    page = QWidget()
    fill(QVBoxLayout(page), content, 1)
    return page
