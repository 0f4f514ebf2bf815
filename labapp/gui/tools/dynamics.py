"""Window of the pool's dynamics: options at the left; spectra, modes and events."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from PySide6.QtCore import Qt, QTimer
from PySide6.QtGui import QCloseEvent
from PySide6.QtWidgets import QAbstractItemView, QSizePolicy, QWidget

from labapp.gui.tasks import Control
from labapp.gui.tools import dynamics_presenter as presenter
from labapp.gui.tools.tool import WORKING, ToolWindow
from labapp.gui.widgets.buttons import button
from labapp.gui.widgets.fields import ChoiceField, NumberField, flush_fields
from labapp.gui.widgets.labels import heading, offer, wrapping_label
from labapp.gui.widgets.layouts import column_of, fill, hbox, tabs_of
from labapp.gui.widgets.sheet import Sheet
from labapp.gui.widgets.tables import CellTable

if TYPE_CHECKING:
    from labapp.core.dynamics.analysis import Dynamics
    from labapp.export.dynamics import MeasuredSurface
    from labapp.gui.shell.files import Files

FILM_MS = 80
"""Interval of the pictures in the film of a mode."""


CHANGED = "Results or signals have changed since: press Analyse again."


class DynamicsWindow(ToolWindow):
    """Analyses the change of the session's pool over the recording, and shows the results."""

    key, command = "dynamics", "dynamics"
    title = "Pool over time"

    def __init__(self, sessions: Files, window: QWidget) -> None:
        self.drawn: presenter.DrawnDynamics | None = None
        """The displayed analysis; None before the first one."""
        self._of: presenter.Analysed | None = None
        self._event_frames: tuple[int, ...] = ()
        self._film: list[bytes] = []
        super().__init__(sessions, window)
        self._turn = QTimer(self, interval=FILM_MS)
        self._turn.timeout.connect(self._next_picture)
        self.workspace.opened.connect(self._forget)

    def _make_form(self) -> None:
        self.of = ChoiceField(
            "Measure", presenter.SERIES, tooltip="Whose spectra and peak are shown"
        )
        self.of.set_value("height_mm")
        self.segment = NumberField(
            "Segment", "s", lowest=0.001, highest=1e4, step=0.05, decimals=3, optional=True,
            tooltip="Duration of a segment of the spectrogram; empty: an eighth of the recording",
        )  # fmt: skip
        self.form.add(heading("Spectrum"), self.of, self.segment)
        ends = ("From", 0.01, "Lowest"), ("To", 0.01, "Highest")
        self.band = [
            NumberField(
                name, "Hz", lowest=lowest, highest=1e5, decimals=2, optional=True,
                tooltip=f"{end} frequency; both empty: all that the frames resolve",
            )
            for name, lowest, end in ends
        ]  # fmt: skip
        self.form.add(heading("Oscillations looked for"), *self.band)
        for field in (self.segment, *self.band):
            field.set_placeholder("automatic")

    def _make_results(self) -> None:
        self.words = wrapping_label()
        self.peak_words, self.response_words = wrapping_label(), wrapping_label()
        self.spectrum, self.series = Sheet("Spectrogram and spectrum"), Sheet("Series and events")
        self.event_words = wrapping_label("No change exceeds the noise.")
        self.shape = Sheet("Shape and course of the mode")
        self.modes, self.events = CellTable("Modes"), CellTable("Events")
        self.responses = CellTable("Responses")
        tip = "Show one period of this mode as a film; press again to stop"
        self.play_button = button("Play", tip, self.play)
        tip = "Show the frame of this event in the main window"
        self.frame_button = button("Show the frame", tip, self.show_frame)
        for table, changed in ((self.modes, self._show_mode), (self.events, self.show_state)):
            table.setSelectionMode(QAbstractItemView.SelectionMode.SingleSelection)
            table.itemSelectionChanged.connect(changed)
        self.events.cellActivated.connect(lambda *_: self.show_frame())
        play, frame = hbox(self.play_button, 1), hbox(self.frame_button, 1)
        pages = {
            "Spectrum": column_of(self.peak_words, (self.spectrum, 1)),
            "Modes": column_of((self.modes, 4), (self.shape, 7), play),
            "Events": column_of(self.event_words, (self.series, 3), (self.events, 2), frame),
            "Responses": column_of((self.response_words, 1), (self.responses, 1)),
        }
        for page in pages.values():
            page.setContentsMargins(6, 6, 6, 6)
        self.tabs = tabs_of("Parts of the analysis", pages)
        for label in (self.peak_words, self.event_words, self.response_words):
            label.setAlignment(Qt.AlignmentFlag.AlignTop)
        # The sheets scroll: the tabs do not need the height that they would like to have.
        self.tabs.setSizePolicy(QSizePolicy.Policy.Expanding, QSizePolicy.Policy.Ignored)
        self.tabs.setMinimumHeight(self.tabs.minimumSizeHint().height())
        self.tabs.currentChanged.connect(lambda _: self._turn.stop())
        fill(self.results, self.words, (self.tabs, 1), 0)
        self.tabs.hide()

    def _make_buttons(self) -> None:
        self.add_save_button("Save the results…", "Write all tables (CSV) and pictures to a folder")
        self.start_button = self.add_button(
            "Analyse", "Find oscillations, modes, events and responses", self.start
        )

    # --- analysing -----------------------------------------------------------------------------

    def prefill(self) -> None:
        """Analyse the session's results unless they are already shown."""
        if not presenter.same_results(self._present(), self._of):
            self.start()

    def _present(self) -> presenter.Analysed | None:
        """What would be analysed now; None without a session, and if it is damaged: reported."""
        session = self.workspace.session
        seen = self.workspace.run_or_report(self.workspace.overview)
        if session is None or seen is None:
            return None
        return self.workspace.run_or_report(lambda: presenter.Analysed(seen, session.signals))

    def start(self) -> None:
        """Analyse the session's results in the background."""
        flush_fields(self.form)
        session, present = self.workspace.session, self._present()
        why = presenter.impossible(session, None if present is None else present.seen)
        if why or session is None or present is None or self.working:
            self.show_state()
            return
        ends = [value for field in self.band if (value := field.value()) is not None]
        if len(ends) == 1 or ends != sorted(set(ends)):
            self.say("Enter both ends of the frequencies, the lower one first, or neither", True)
            return
        from labapp.core.dynamics.analysis import DynamicsSettings

        band = (ends[0], ends[1]) if ends else None
        settings = DynamicsSettings(self.of.value(), band, self.segment.value())
        signals, count = present.timed_signals, len(present.seen.frame)

        def counted(control: Control) -> Iterator[MeasuredSurface]:
            from labapp.export.dynamics import measured_of

            for done, one in enumerate(measured_of(session.frame_results(stale=False))):
                control.progress(done, count, "reading surfaces")
                yield one
            control.progress(count, count, "analysing")

        def work(control: Control) -> presenter.DrawnDynamics:
            from labapp.export.dynamics import dynamics_of

            found = dynamics_of(counted(control), signals, settings)
            return presenter.draw(found, control.check)

        def done(drawn: presenter.DrawnDynamics) -> None:
            self._of = present
            self.show_found(drawn)

        self.begin("Analysing", work, done)

    def show_found(self, drawn: presenter.DrawnDynamics) -> None:
        """Show an analysis."""
        found = drawn.found
        self.drawn = drawn
        self.say("Done")
        self.peak_words.setText(presenter.peak_text(found))
        self.spectrum.show_png(drawn.spectrum, self.peak_words.text())
        self.series.show_png(drawn.series, "Series with their events as lines")
        self.modes.show_table(presenter.modes_table(found))
        self.modes.selectRow(self._strongest(found))
        table, self._event_frames = presenter.events_table(found)
        self.events.show_table(table)
        self.event_words.setVisible(not table.rows)
        for widget in (self.events, self.frame_button):
            widget.setVisible(bool(table.rows))
        responses = presenter.responses_table(found)
        self.responses.show_table(responses)
        session = self.workspace.session
        has_signals = session is not None and session.signals is not None
        self.response_words.setText(
            "" if responses.rows else presenter.no_responses(found, has_signals)
        )
        self.response_words.setVisible(not responses.rows)
        self.responses.setVisible(bool(responses.rows))
        self.tabs.show()
        self.show_state()
        self.workspace.analysed.emit(found)

    @staticmethod
    def _strongest(found: Dynamics) -> int:
        """Row of the Bessel mode with the largest oscillating share, or of the first."""
        return max(
            range(len(found.modes)),
            key=lambda k: (bool(found.modes[k].oscillations), found.modes[k].share),
        )

    def _forget(self) -> None:
        """Remove the results of a closed session."""
        self.tasks.cancel_all()
        self._turn.stop()
        self.drawn, self._of = None, None
        self.say("")
        self.tabs.hide()

    def save(self, folder: Path) -> None:
        """Write the results, as the command does; first draw the pictures for print."""
        from labapp.export.dynamics import dynamics_files

        assert self.drawn is not None
        found = self.drawn.found

        def write(files: dict[str, bytes]) -> None:
            self.files = files
            super(DynamicsWindow, self).save(folder)

        self.begin("Drawing", lambda _: dynamics_files(found), write)

    # --- one mode, one event -------------------------------------------------------------------

    def _show_mode(self) -> None:
        self._turn.stop()
        self._film = []
        row = self.modes.currentRow()
        if self.drawn is not None and row >= 0:
            name = self.drawn.found.all_modes[row].name
            self.shape.show_png(self.drawn.modes[row], f"Mode {name}")
        self.show_state()

    def play(self) -> None:
        """Play one period of the selected mode repeatedly, or stop."""
        drawn, row = self.drawn, self.modes.currentRow()
        if self._turn.isActive():
            self._turn.stop()
        elif self._film:
            self._turn.start()
        elif drawn is not None:
            mode = drawn.found.all_modes[row]
            turns = presenter.FILM_TURNS

            def work(control: Control) -> list[bytes]:
                pictures = []
                for k in range(turns):
                    control.progress(k, turns, "drawing")
                    pictures.append(presenter.mode_picture(drawn.found, mode, k / turns))
                return pictures

            def done(pictures: list[bytes]) -> None:
                if drawn is self.drawn and row == self.modes.currentRow():
                    self.say(f"One period of mode {mode.name}, slowed down")
                    self._film = pictures
                    self._turn.start()

            self.begin(f"Film of mode {mode.name}", work, done)

    def _next_picture(self) -> None:
        self._film = [*self._film[1:], *self._film[:1]]
        self.shape.show_png(self._film[0], "Film of the mode")

    def show_frame(self) -> None:
        """Show the frame of the selected event in the main window."""
        row = self.events.currentRow()
        if self.events.selectedItems() and row < len(self._event_frames):
            self.workspace.show_frame(self._event_frames[row])
            self.say(f"Frame {self._event_frames[row]} is in view in the main window")

    def closeEvent(self, event: QCloseEvent) -> None:
        """Stop the film, too."""
        self._turn.stop()
        super().closeEvent(event)

    def show_state(self) -> None:
        """Enable the actions that are available now, and show what can be determined."""
        present = self._present()
        seen = None if present is None else present.seen
        why = presenter.impossible(self.workspace.session, seen)
        text = why or (presenter.range_text(seen) if seen is not None else "")
        changed = self.drawn is not None and not presenter.same_results(present, self._of)
        if changed:
            text = f"{CHANGED} {text}"
        self.words.setText(text)
        working = WORKING if self.working else ""
        drawn = "" if self.drawn is not None else "There are no results yet: press Analyse"
        offer(self.start_button, why or working)
        offer(self.save_button, drawn or working or (CHANGED if changed else ""))
        chosen = "" if self.modes.currentRow() >= 0 else "Select a mode in the table"
        offer(self.play_button, chosen or working)
        chosen = "" if self.events.selectedItems() else "Select an event in the table"
        offer(self.frame_button, chosen)
