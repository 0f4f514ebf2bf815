"""Window of studies: recordings at the left; progress and results at the right."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

from PySide6.QtCore import QUrl
from PySide6.QtGui import QCloseEvent, QDesktopServices, QDragEnterEvent, QDropEvent
from PySide6.QtWidgets import QAbstractItemView, QCheckBox, QHeaderView, QWidget

from labapp.gui.dialogs import SETUP_FILES, ask_file, ask_folder, ask_save, dropped_paths
from labapp.gui.tasks import Control, Tasks
from labapp.gui.tools import study_presenter as presenter
from labapp.gui.tools.study_sessions import BegunSession, begin_session, must_be_closed
from labapp.gui.tools.tool import WORKING, ToolWindow, progress_of
from labapp.gui.widgets.fields import (
    ChoiceField,
    FieldForm,
    TextField,
    flush_fields,
    whole,
)
from labapp.gui.widgets.labels import heading, offer, show_words, wrapping_label
from labapp.gui.widgets.layouts import column_of, fill, tabs_of
from labapp.gui.widgets.path_field import PathField
from labapp.gui.widgets.sheet import Sheet
from labapp.gui.widgets.tables import CellTable, FittingTable
from labapp.run.measurers import measuring_pool
from labapp.run.study.page import condition_picture, varying_conditions
from labapp.run.study.plan import StudyRecording, folder_pattern, write_study
from labapp.run.study.status import RecordingStatus, StudyProgress, count_states
from labapp.run.study.study import Study, require_extra
from labapp.run.study.summary import StudySummary
from labapp.simulation.parallel import end_processes, wait_for
from labapp.text import column_heading

if TYPE_CHECKING:
    from labapp.gui.shell.files import Files

T = TypeVar("T")

STUDIES = "Studies (*.toml *.csv)"

LOOK_S = 1.0
"""Shortest interval, s, between updates of the list while the study runs."""

NONE_YET = (
    "A study is a file that names recordings, each with its set-up and the conditions it was made "
    "under. Open one, or choose a folder with recordings and press Make study. Files and folders "
    "can be dropped on this window, too."
)


class StudyWindow(ToolWindow):
    """Opens or creates a study, runs it, and shows the results."""

    key = "study"
    title = "Study of many recordings"

    def __init__(self, sessions: Files, window: QWidget) -> None:
        self.study: Study | None = None
        """The displayed study; None before one is opened."""
        self.found: list[RecordingStatus] = []
        """Progress of each recording."""
        self.summary: StudySummary | None = None
        """Results of the study; None before there are any."""
        self._look_is_due = False
        super().__init__(sessions, window)
        self._sessions = sessions
        self.looks = Tasks(self)
        self.looks.failed.connect(lambda _, why: self.say(why, True))
        self.looks.changed.connect(self._show)
        self.tasks.changed.connect(self._look_at_end)
        self.setAcceptDrops(True)
        self._show()

    def _make_form(self) -> None:
        self.form.add(heading("Study"))
        self.add_to_form("Open study…", "Choose a study file (TOML or CSV)", self.choose)
        self.recordings = PathField(
            "Recordings",
            tooltip="A pattern that their paths fit: {current_a} is a condition, * any other part "
            "that varies, such as the number of a repetition",
        )
        self.setup = PathField("Set-up", tooltip="The setup file of them all (TOML)")
        self.recordings.edited.connect(lambda _: self._show_matches())
        self.matches = wrapping_label()
        # The pattern is long, so its label is above it.
        recordings = column_of(self.recordings.label, self.recordings)
        self.form.add(heading("New study"), recordings, self.matches)
        self.add_to_form("Choose folder…", "Take all recordings in a folder", self.choose_folder)
        self.form.add(self.setup)
        self.add_to_form("Choose set-up…", "Choose a setup file", self.choose_setup)
        self.add_to_form(
            "Make study…",
            "Write a study file that lists these recordings, and open it",
            self.choose_new,
        )
        self.workers = whole("Processes", 1, "How many recordings at once", 1024)
        self.workers.set_value(os.cpu_count() or 1)
        self.scheduler = TextField(
            "Dask scheduler",
            tooltip="Address of a Dask scheduler, tcp://HOST:8786, whose workers measure instead; "
            "empty: this machine",
        )
        self.surfaces = QCheckBox("Keep surfaces (Zarr)")
        self.surfaces.setToolTip(
            "Write surfaces.zarr, too: what was measured without is measured again"
        )
        self.form.add(heading("Run"), self.workers, self.scheduler, self.surfaces)

    def _make_results(self) -> None:
        self.words = wrapping_label(NONE_YET)
        self.list = CellTable("Recordings of the study")
        by_content = QHeaderView.ResizeMode.ResizeToContents
        self.list.verticalHeader().setSectionResizeMode(by_content)
        self.means = FittingTable("Means of the study")
        self.outliers = CellTable("Outliers")
        self.against = ChoiceField("Against", tooltip="The condition along the plots")
        self.against.edited.connect(lambda _: self._draw())
        self.sheet = Sheet("Plots of the study")
        plots = column_of(FieldForm(self.against), (self.sheet, 1))
        parts = {"Recordings": self.list, "Plots": plots, "Means": self.means}
        self.tabs = tabs_of("Parts of the study", {**parts, "Outliers": self.outliers})
        for table in (self.list, self.outliers):
            table.setSelectionMode(QAbstractItemView.SelectionMode.SingleSelection)
            table.itemSelectionChanged.connect(self.show_state)
            table.cellDoubleClicked.connect(lambda *_: self.open_selected())
        self.tabs.currentChanged.connect(lambda _: self.show_state())
        fill(self.results, self.words, (self.tabs, 1))

    def _make_buttons(self) -> None:
        self.page_button = self.add_button(
            "Show the summary",
            "Show tables and plots in the browser (summary.html)",
            self.show_page,
        )
        self.open_button = self.add_button(
            "Open in a session",
            "Show the frames and surfaces of the selected recording in the main window",
            self.open_selected,
        )
        self.start_button = self.add_button(
            "Run", "Measure what is not measured yet; it can be stopped at any moment", self.start
        )

    # --- which study ---------------------------------------------------------------------------

    def choose(self) -> None:
        """Ask for a study file."""
        folder = self._sessions.preferences.current.folder
        if path := ask_file(self, "Open a study", folder, STUDIES):
            self.show_study(path)

    def choose_folder(self) -> None:
        """Ask for a folder with recordings."""
        if folder := ask_folder(self, "Recordings in", self._sessions.preferences.current.folder):
            self.take_folder(folder)

    def dragEnterEvent(self, event: QDragEnterEvent) -> None:
        """Accept files."""
        if dropped_paths(event.mimeData()):
            event.acceptProposedAction()

    def dropEvent(self, event: QDropEvent) -> None:
        """Open a dropped study, or fill in dropped recordings and their set-up."""
        event.acceptProposedAction()
        for path in dropped_paths(event.mimeData()):
            if path.is_dir():
                self.take_folder(path)
            elif path.suffix.lower() not in (".toml", ".csv"):
                self.recordings.set_value(str(path))
                self._show_matches()
            elif presenter.is_setup(path):
                self.setup.set_value(str(path))
            else:
                self.show_study(path)

    def take_folder(self, folder: Path) -> None:
        """Propose the recordings in a folder, and a setup file beside one of them."""
        pattern = self._try(lambda: folder_pattern(folder))
        if pattern is None:
            return
        self.recordings.set_value(str(pattern))
        self._show_matches()
        beside = sorted(pattern.parent.parent.glob(f"{pattern.parent.name}/setup.toml"))
        if not self.setup.value() and beside:
            self.setup.set_value(str(beside[0]))

    def _show_matches(self) -> None:
        show_words(self.matches, presenter.matches_text(self.recordings.value().strip()))

    def choose_setup(self) -> None:
        """Ask for a setup file."""
        folder = self._sessions.preferences.current.folder
        if path := ask_file(self, "Choose a set-up", folder, SETUP_FILES):
            self.setup.set_value(str(path))

    def choose_new(self) -> None:
        """Ask for the file of a new study, and create it."""
        flush_fields(self.form)
        if not self.recordings.value().strip() or not self.setup.value().strip():
            self.say("Enter the recordings and their set-up first, or choose them", True)
            return
        proposed = Path(self.recordings.value().split("{")[0].split("*")[0]).parent / "study.toml"
        if path := ask_save(self, "New study", proposed, STUDIES):
            self.make(path)

    def make(self, path: Path) -> None:
        """Create the study described by the form, and open it."""
        recordings, setup = self.recordings.value().strip(), self.setup.value().strip()
        # The dialog has asked whether to replace an existing file.
        if self._try(lambda: write_study(path, [recordings], setup, replace=True)):
            self.show_study(path)

    def _try(self, work: Callable[[], T]) -> T | None:
        """Run a short operation; an error is shown here until the next one succeeds."""
        return self.workspace.run_or_report(work, self.title, self.say)

    def show_study(self, path: Path) -> None:
        """Open a study."""
        study = self._try(lambda: Study(path))
        if study is not None:
            self.study, self.found, self.summary = study, [], None
            for table in (self.list, self.outliers):
                table.clearSelection()
            self._draw()
            self.say(f"{path}")
            self._look()

    # --- what is done of it --------------------------------------------------------------------

    def _look(self) -> None:
        """Read the progress in the background, and combine the results."""
        self.looks.cancel_all()
        study, surfaces = self.study, self.surfaces.isChecked()
        if study is None:
            return

        def work(control: Control) -> StudySummary | None:
            found = study.status()
            control.part(found)
            if not any(one.frames_done for one in found):
                return None
            # In a process: a thread would be slow, and would slow down the window.
            pool = measuring_pool(1)
            try:
                begun = pool.submit(_results, study.path, study.folder, surfaces)
                return wait_for(begun, control.check)
            finally:
                end_processes(pool)

        self.looks.start("Reading the study", work, self._show_summary, self._show_part)

    def _look_at_end(self) -> None:
        """Show the progress when a run has ended in any way, unless nobody would see it."""
        if not self.working and self.isVisible():
            self._look()

    def _show_part(self, part: list[RecordingStatus] | str) -> None:
        if isinstance(part, str):
            self.workspace.notified.emit(part, False)
            return
        self.found = part
        self._show()

    def _show_summary(self, summary: StudySummary | None) -> None:
        self.summary = summary
        self._show()
        if summary is not None:
            names = varying_conditions(summary)
            self.against.set_choices(
                [(name, column_heading(name)) for name in names] or [("", "none varies")]
            )
            self._draw()

    def _show(self) -> None:
        if self.study is not None:
            plan = self.study.plan
            reading = ". Reading the results…" * bool(self.looks.active)
            self.words.setText(f"{plan.title}: {count_states(self.found)}{reading}")
            chosen = self.list.currentRow() if self.list.selectedItems() else -1
            self.list.show_table(presenter.recordings_table(plan, self.found))
            if chosen >= 0:
                self.list.selectRow(chosen)
            header = self.list.horizontalHeader()
            header.setSectionResizeMode(QHeaderView.ResizeMode.ResizeToContents)
            # The reason of a failure, wrapped to as many lines as needed.
            header.setSectionResizeMode(header.count() - 1, QHeaderView.ResizeMode.Stretch)
        if self.summary is not None:
            self.means.show_table(presenter.means_table(self.summary))
            self.outliers.show_table(presenter.outliers_table(self.summary))
            found = len(self.summary.outliers)
            self.tabs.setTabText(self.tabs.indexOf(self.outliers), f"Outliers: {found or 'none'}")
        for place in range(1, self.tabs.count()):
            self.tabs.setTabEnabled(place, self.summary is not None)
        self.show_state()

    def _draw(self) -> None:
        summary, condition = self.summary, self.against.value()
        if summary is None or not summary.groups:
            self.sheet.show_words("No frame has a surface" * (summary is not None))
            return
        words = f"Sizes against {column_heading(condition)}"
        self.sheet.show_png(condition_picture(summary, condition), words)

    def show_page(self) -> None:
        """Show the summary in the browser."""
        if self.study is not None:
            page = self.study.folder / "summary.html"
            if not page.exists():
                self.say(f"{page} is no longer there: Run writes it again", True)
                self.start_button.setFocus()
            elif not QDesktopServices.openUrl(QUrl.fromLocalFile(str(page))):
                self.say(f"The summary is {page}")

    # --- running -------------------------------------------------------------------------------

    def start(self) -> None:
        """Run the study in the background."""
        flush_fields(self.form)
        if self.study is None:
            return
        path = self.study.path
        study = self._try(lambda: Study(path))  # as its file is now
        if study is None:
            return
        self.study = study
        self.looks.cancel_all()
        workers, scheduler = int(self.workers.value() or 1), self.scheduler.value().strip() or None
        surfaces = self.surfaces.isChecked()

        def work(control: Control) -> list[RecordingStatus]:
            require_extra()
            looked_s = took_s = 0.0

            def progress(now: StudyProgress) -> None:
                nonlocal looked_s, took_s
                words = f"{now.recordings_done} of {now.recordings} recordings"
                control.progress(now.frames_done, now.frames, words)
                begun_s = time.monotonic()
                if begun_s - looked_s > max(LOOK_S, 20 * took_s):
                    control.part(study.status(surfaces=surfaces))
                    looked_s = time.monotonic()
                    took_s = looked_s - begun_s

            return study.run(
                workers, scheduler, surfaces=surfaces, progress=progress, note=control.part
            )

        def is_shown() -> bool:
            shown = self.study
            return shown is not None and (shown.path, shown.plan) == (study.path, study.plan)

        def part(found: list[RecordingStatus] | str) -> None:
            if isinstance(found, str) or is_shown():
                self._show_part(found)

        def done(found: list[RecordingStatus]) -> None:
            self.say(f"{study.plan.title}: " * (not is_shown()) + count_states(found))

        self.begin(f"Measuring {study.plan.title}", work, done, part)

    # --- one recording -------------------------------------------------------------------------

    def selected(self) -> tuple[StudyRecording, int | None] | None:
        """Recording and frame selected in the visible table; None without a selection."""
        table = next(
            (t for t in (self.list, self.outliers) if t is self.tabs.currentWidget()), None
        )
        if table is None or table.table is None or not table.selectedItems():
            return None
        cells = table.table.rows[table.currentRow()]
        name, frame = str(cells[0]), str(cells[1]) if table is self.outliers else ""
        for one in self.found:
            if one.recording.name == name and one.frames:
                return one.recording, int(frame) if frame.isdecimal() else None
        return None

    def open_selected(self) -> None:
        """Create a session of the selected recording, measured as in the study, and open it."""
        chosen, study = self.selected(), self.study
        if chosen is None or study is None or self.working:
            return
        recording, frame = chosen
        present = self.workspace.session
        if present is not None and must_be_closed(study, recording, present.path):
            self._sessions.close()  # it would be in use, and another made beside it

        def work(control: Control) -> BegunSession:
            return begin_session(study, recording, progress_of(control))

        def opened(begun: BegunSession) -> None:
            if self._sessions.open(begun.path):
                if frame is not None:
                    self.workspace.show_frame(frame)
                self.workspace.action_requested.emit("step_surface")
                # It would cover the main window, above which its desktop keeps it.
                self.close()
                name, kept = begun.path.stem, f"; {begun.kept}" * bool(begun.kept)
                self.say(f"{name} is open in the main window{kept}")
                words = f"{name} is open{kept}; Tools, {self.title} shows the study again"
                self.workspace.notified.emit(words, False)

        self.begin(f"Opening {recording.name}", work, opened)

    def closeEvent(self, event: QCloseEvent) -> None:
        """Also stop reading; it is repeated when the window is shown again."""
        self._look_is_due = self.working or bool(self.looks.active)
        super().closeEvent(event)
        self.looks.cancel_all()

    def prefill(self) -> None:
        """Read the progress again if closing the window stopped a run or the reading."""
        if self._look_is_due:
            self._look_is_due = False
            self._look()

    def show_state(self) -> None:
        """Enable the actions that are available now."""
        working = WORKING if self.working else ""
        chosen = "" if self.study is not None else "Open a study first, or make one"
        offer(self.start_button, chosen or working)
        selected = "" if self.selected() is not None else "Select a recording in the table"
        offer(self.open_button, selected or working)
        offer(self.page_button, "" if self.summary is not None else "There are no results yet")


def _results(path: Path, folder: Path, surfaces: bool) -> StudySummary:
    """Combine the results of a study and write them; called in another process."""
    return Study(path, folder).results(surfaces=surfaces)
