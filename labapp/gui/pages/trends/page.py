"""The trends page: plots over time, their statistics, a spectrum, current and voltage."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from PySide6.QtCore import QSignalBlocker, Qt
from PySide6.QtGui import QPixmap
from PySide6.QtWidgets import QCheckBox, QGridLayout, QSplitter

from labapp.gui.dialogs import EVERYTHING, ask_file
from labapp.gui.pages.page import Page
from labapp.gui.pages.trends.presenter import SIGNALS, TrendOptions, TrendsState, first_shown, show
from labapp.gui.tasks import Control
from labapp.gui.views.plots import PlotStack
from labapp.gui.widgets.buttons import button, check_box
from labapp.gui.widgets.fields import ChoiceField, NumberField
from labapp.gui.widgets.labels import Message, heading, keep_room, wrapping_label
from labapp.gui.widgets.layouts import fill, hbox
from labapp.gui.widgets.result_table import ResultTable
from labapp.gui.workspace import Workspace
from labapp.session.results.trends import LABELS
from labapp.session.signals import Signals, read_signals
from labapp.text import pluralize

if TYPE_CHECKING:
    from labapp.core.dynamics.steps import Event

FAR_S = 1e6

TABLES = f"Tables (*.csv *.txt *.tsv *.tdms);;{EVERYTHING}"


class TrendsPage(Page):
    """Changes of the pool over the recording."""

    key = "trends"
    shows_all_frames = True

    def __init__(self, workspace: Workspace) -> None:
        super().__init__(workspace)
        self.options = TrendOptions()
        self.shown: TrendsState | None = None
        self._boxes: dict[str, QCheckBox] = {}
        self._in_view: int | None = None
        self._events: Mapping[str, tuple[Event, ...]] = {}
        self._last_folder = Path()
        self.plots = PlotStack("Trends over the recording")
        self.plots.chosen.connect(workspace.show_frame)
        workspace.opened.connect(self._forget)
        workspace.analysed.connect(lambda found: self._show_events(found.events))
        self.spectrum = PlotStack("Spectrum")
        self.spectrum.hide()
        splitter = QSplitter(Qt.Orientation.Vertical)
        splitter.setChildrenCollapsible(False)
        splitter.addWidget(self.plots)
        splitter.addWidget(self.spectrum)
        splitter.setStretchFactor(0, 3)
        splitter.setStretchFactor(1, 1)
        self.canvas_layout.addWidget(splitter, 1)
        self._make_panel()

    # --- what it shows ------------------------------------------------------------------------

    def refresh(self) -> None:
        """Show the session's results."""
        session, frame = self.session, self.workspace.frame
        if self._in_view not in (None, frame):
            # Only the frame in view changed; stepping must be quick.
            self._in_view = frame
            self._mark(frame)
            return
        self._in_view = frame
        seen = self.workspace.overview()
        if self.options.shown is None and seen is not None:
            for key, box in self._boxes.items():
                with QSignalBlocker(box):  # the operator has not chosen them
                    box.setChecked(key in first_shown(seen))
        self.shown = shown = show(session, self.options, seen, self._events)
        self.plots.show_curves(shown.curves, shown.axis)
        self._mark(frame)
        self.plots.setVisible(bool(shown.curves))
        self.nothing.setVisible(not shown.curves)
        self.counted.setText(shown.words)
        self.setup_words.setText(shown.setup_words)
        self.table.set_rows(shown.rows)
        self.table.setVisible(bool(shown.rows))
        self.table_heading.setVisible(bool(shown.rows))
        self.spectrum.setVisible(bool(shown.spectrum))
        self.spectrum.show_curves(shown.spectrum, shown.spectrum_axis)
        self.spectrum_words.setText(shown.spectrum_words)
        self.signals_words.setText(shown.signals_words)
        self._show_signals(session.signals)
        for key, box in self._boxes.items():
            if key not in SIGNALS:
                box.setVisible(not session.has_lines)
        self.choice_heading.setVisible(not session.has_lines or session.signals is not None)
        for widget in (self.of, self.without):
            widget.setEnabled(not session.has_lines)

    def _mark(self, frame: int) -> None:
        shown = self.shown
        if shown is not None:
            self.plots.set_current(frame, shown.places.get(frame), shown.without.get(frame, ""))

    def _show_events(self, events: Mapping[str, tuple[Event, ...]]) -> None:
        self._events = events
        self.leave()
        if self.isVisible():
            self.refresh()

    def _forget(self) -> None:
        """Remove the events of the previous session."""
        self._events = {}
        self.leave()

    def leave(self) -> None:
        """Refresh everything when the page comes back into view."""
        self._in_view = None

    def picture(self) -> QPixmap:
        """The plots without their surroundings."""
        picture: QPixmap = self.plots.canvas.grab()
        return picture

    def _show_signals(self, signals: Signals | None) -> None:
        self.forget_button.setVisible(signals is not None)
        for widget in (self.start, self.start.label):
            widget.setVisible(signals is not None)
        self.start.set_value(None if signals is None else signals.start_s)
        channels = {} if signals is None else signals.channels
        for key in SIGNALS:
            self._boxes[key].setVisible(key in channels)

    # --- what the operator does ---------------------------------------------------------------

    def _set_options(self, **values: object) -> None:
        self.options = replace(self.options, **values)  # type: ignore[arg-type]
        self._in_view = None
        self.refresh()

    def _chosen(self) -> None:
        self._set_options(shown=tuple(key for key, box in self._boxes.items() if box.isChecked()))

    def _copied(self, copy: Callable[[], None], words: str) -> None:
        copy()
        self.confirm(words, self.copied)

    def choose_signals(self) -> None:
        """Ask for a table with current and voltage."""
        folder = self._last_folder if self._last_folder.name else self.workspace.folder
        if path := ask_file(self, "Read current and voltage", folder, TABLES):
            self._last_folder = path.parent
            self.read_signals(path)

    def read_signals(self, path: Path) -> None:
        """Read a table with current and voltage, and store it in the session."""
        self._keep(f"Reading {path.name}", lambda: read_signals(path))

    def take(self, path: Path, at_once: bool = False) -> None:
        """Read a dropped table with current and voltage."""
        self.read_signals(path)

    def _start_at(self, start_s: object) -> None:
        signals = self.session.signals
        if signals is not None and isinstance(start_s, int | float):
            moved = replace(signals, start_s=float(start_s))
            self._keep("Moving current and voltage", lambda: moved)

    def _keep(self, title: str, signals: Callable[[], Signals]) -> None:
        """Store signals in the session, in the background: there may be half a million samples."""
        session = self.session

        def work(_: Control) -> Signals:
            found = signals()
            session.set_signals(found)
            return found

        def done(kept: Signals) -> None:
            self.confirm(f"{kept.file}: {pluralize(len(kept.time_s), 'sample')}")
            self.workspace.changed.emit()

        self.start_task(title, work, done, kind="Reading current and voltage")

    # --- the panel ----------------------------------------------------------------------------

    def _make_panel(self) -> None:
        self.nothing = wrapping_label(
            "No frame has a value of the measures ticked at the right. Tick others, or see in the "
            "steps Dots and Surface why there is no surface."
        )
        self.nothing.setAlignment(Qt.AlignmentFlag.AlignCenter)
        self.canvas_layout.addWidget(self.nothing, 1)
        self.table = ResultTable("Statistics of the measures")
        self.counted = Message(3)
        self.setup_words = Message(5)
        self.without = check_box(
            "Leave out frames that stand out",
            "Mean, deviation, range and spectrum are of the frames that do not stand out from "
            "their neighbours by size or ARE; open circles mark those that do",
            lambda on: self._set_options(without_doubtful=on),
        )
        values = button(
            "Copy values",
            "Copy the values of all frames shown, for a spreadsheet",
            lambda: self._copied(self.plots.copy_table, "The values are on the clipboard"),
        )
        picture = button(
            "Copy picture",
            "Copy the plots as a picture",
            lambda: self._copied(self.plots.copy_picture, "The picture is on the clipboard"),
        )
        self.copied = Message(1)
        self.choice_heading = heading("Shown")
        self.table_heading = heading("Mean ± standard deviation, range")
        fill(
            self.panel_layout,
            *(self.choice_heading, self._make_choice(), self.table_heading),
            *(self.table, self.counted, self.setup_words, self.without, hbox(values, picture)),
            self.copied,
        )
        self._make_spectrum()
        self._make_signals()

    def _make_choice(self) -> QGridLayout:
        grid = QGridLayout()
        grid.setContentsMargins(0, 0, 0, 0)
        names = LABELS | {key: name for key, (name, _) in SIGNALS.items()}
        for number, (key, name) in enumerate(names.items()):
            box = QCheckBox(name)
            box.setToolTip(f"Show {name.lower() if name != 'ARE' else name} over the recording")
            box.toggled.connect(lambda _: self._chosen())
            self._boxes[key] = box
            grid.addWidget(box, number // 2, number % 2)
        return grid

    def _make_spectrum(self) -> None:
        choices = [("", "none"), *LABELS.items()]
        self.of = ChoiceField("Spectrum of", choices, tooltip="Shows oscillations of a measure")
        self.of.edited.connect(lambda key: self._set_options(spectrum_of=key))
        self.spectrum_words = Message(3)
        of = hbox(self.of.label, (self.of, 1))
        more = button(
            "Pool over time…",
            "Spectrogram, modes, changes and step responses, in a window of their own",
            lambda: self.workspace.action_requested.emit("dynamics"),
        )
        fill(self.panel_layout, heading("Spectrum"), of, self.spectrum_words, more)

    def _make_signals(self) -> None:
        self.signals_words = wrapping_label()
        tip = "Added to the table's times: where its time 0 lies in the recording"
        self.start = NumberField(
            "Starts at", "s", lowest=-FAR_S, highest=FAR_S, step=0.01, decimals=3, tooltip=tip
        )
        self.start.edited.connect(self._start_at)
        tip = "Read current, voltage, wire feed from a table (CSV, TDMS); keep them in the session"
        self.read_button = button("Load table…", tip, self.choose_signals)
        self.forget_button = button(
            "Remove",
            "Remove current and voltage from the session; undo restores them",
            lambda: self.workspace.attempt(lambda session: session.set_signals(None)),
        )
        keep_room(self.start, self.start.label, self.forget_button)
        self.lock_with_session(self.start, self.read_button, self.forget_button)
        fill(
            self.panel_layout,
            *(heading("Current and voltage"), hbox(self.start.label, (self.start, 1))),
            *(hbox(self.read_button, self.forget_button), self.answer, self.signals_words, 1),
        )
