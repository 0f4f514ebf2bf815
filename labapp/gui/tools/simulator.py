"""Window of the simulator: a scenario at the left, its first frame with true dots at the right."""

from __future__ import annotations

import os
import threading
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from PySide6.QtGui import QCloseEvent
from PySide6.QtWidgets import QWidget

from labapp.config.scenario import Scenario, read_scenario
from labapp.gui.dialogs import ask_file, ask_folder, new_path
from labapp.gui.tasks import Control, Tasks
from labapp.gui.tools import simulator_presenter as presenter
from labapp.gui.tools.simulator_presenter import ScenarioPreview
from labapp.gui.tools.tool import WORKING, ToolWindow, progress_of
from labapp.gui.views.picture import PictureView, rings
from labapp.gui.widgets.fields import ChoiceField, flush_fields, whole
from labapp.gui.widgets.labels import heading, offer, wrapping_label
from labapp.gui.widgets.path_field import PathField
from labapp.gui.widgets.result_table import ResultTable
from labapp.simulated.simulate import begin_session, simulate
from labapp.text import pluralize

if TYPE_CHECKING:
    from labapp.gui.shell.files import Files


class SimulatorWindow(ToolWindow):
    """Shows a scenario, writes its recording with the true values, and opens it as a session."""

    key = "simulator"
    title = "Simulator"

    def __init__(self, sessions: Files, window: QWidget) -> None:
        self.preview: ScenarioPreview | None = None
        """The displayed scenario; None until its first frame is drawn."""
        self.made: tuple[Scenario, Path] | None = None
        """The last written scenario, and its folder."""
        self._proposed = ""
        self._seed: int | None = None
        self._turn = threading.Lock()
        super().__init__(sessions, window)
        self._sessions = sessions
        self._preferences = sessions.preferences
        self.previews = Tasks(self)
        self.previews.failed.connect(lambda _, why: self._show_refusal(why))

    def _make_form(self) -> None:
        self.scenario = ChoiceField(
            "Scenario", presenter.choices(None), tooltip="The pool, the bench and the camera"
        )
        self.scenario.edited.connect(lambda _: self.show_scenario())
        self.words = wrapping_label()
        self.frames = whole("Frames", 1, "How many are rendered", 1_000_000)
        self.frames.edited.connect(lambda _: self._show_rows())
        tip = "Seed of the random numbers: the same seed gives the same frames"
        self.seed = whole("Seed", 0, tip, 2**31 - 1)
        self.seed.edited.connect(lambda seed: self._draw(int(seed)))
        self.folder = PathField(
            "Folder",
            tooltip="A new or empty folder, or a former simulation, which is replaced",
        )
        self.table = ResultTable("True values of the first frame")
        self.form.add(self.scenario, self.words)
        self.add_to_form(
            "Load scenario…", "Load a scenario of your own (TOML)", self.choose_scenario
        )
        self.form.add(self.frames, self.seed, self.folder)
        self.add_to_form(
            "Choose folder…", "The simulation goes into a new one in it", self.choose_folder
        )
        self.form.add(heading("First frame"), self.table)

    def _make_results(self) -> None:
        self.picture = PictureView("First frame with its true dots ringed")
        self._rings = rings()
        self.picture.add(self._rings)
        self.results.addWidget(self.picture)

    def _make_buttons(self) -> None:
        self.open_button = self.add_button(
            "Open as a new session",
            "Make a session of the recording that was written, with its set-up, and open it",
            self.open_session,
        )
        self.start_button = self.add_button(
            "Simulate", "Write recording and truth to the folder", self.start
        )

    # --- what is to be simulated ---------------------------------------------------------------

    def prefill(self) -> None:
        """Propose a folder the first time; draw what was to be drawn, unless it is already."""
        if not self._proposed:
            self._propose(self._preferences.current.folder)
        if self.preview is None and not self.previews.active:
            self._draw(self._seed)

    def show_scenario(self) -> None:
        """Draw the chosen scenario, and show its seed and number of frames."""
        if not self.working:
            self.say("")  # the last message is about the former one
        if self.folder.value() == self._proposed:
            self._propose(Path(self._proposed).parent)
        self._draw(None)

    def take(self, path: Path) -> None:
        """Choose the operator's own scenario."""
        self.scenario.set_choices(presenter.choices(path))
        self.scenario.set_value(str(path))
        self.show_scenario()

    def choose_scenario(self) -> None:
        """Ask for a scenario."""
        folder = self._preferences.current.folder
        if path := ask_file(self, "Choose a scenario", folder, "Scenarios (*.toml)"):
            self.take(path)

    def choose_folder(self) -> None:
        """Ask for the folder of the simulation."""
        start = Path(self.folder.value()).parent
        if folder := ask_folder(self, "Folder for the simulation", start):
            self._propose(folder)

    def _propose(self, parent: Path) -> None:
        folder = new_path(parent, Path(self.scenario.value() or "simulation").stem, suffix="")
        self._proposed = str(folder)
        self.folder.set_value(self._proposed)

    # --- its first frame -----------------------------------------------------------------------

    def _draw(self, seed: int | None) -> None:
        """Draw the first frame in the background; only the last request is shown.

        Without a seed it is the scenario's, which is then shown with its number of frames.
        """
        self._seed = seed
        path = self.scenario.value()
        for task in self.previews.active:
            task.cancel()
        self.preview = None
        if not path:
            self._show_refusal("No scenario comes with this installation: choose one of your own")
            return

        def work(control: Control) -> ScenarioPreview:
            with self._turn:
                control.check()
                found = presenter.preview(Path(path), seed)
                control.check()
            return found

        self.previews.start("Drawing the first frame", work, lambda found: self._show(found, seed))
        self.show_state()

    def _show(self, found: ScenarioPreview, seed: int | None) -> None:
        self.preview = found
        if seed is None:
            self.frames.set_value(found.frames)
            self.seed.set_value(found.scenario.recording.seed)
        self.words.setText(found.scenario.title)
        self.picture.show_picture(found.frame.image)
        self._rings.setData(*found.dots_px.T)
        dots = len(found.dots_px)
        self.picture.describe(f"{found.scenario.title}: {dots} dots, each ringed at its true place")
        self._show_rows()
        self.show_state()

    def _show_refusal(self, why: str) -> None:
        self.words.setText("")
        self._rings.setData([], [])
        self.picture.show_picture(None, why)
        self._show_rows()
        self.show_state()

    def _show_rows(self) -> None:
        frames = int(self.frames.value() or 1)
        self.table.set_rows(() if self.preview is None else presenter.rows(self.preview, frames))

    # --- writing, opening ----------------------------------------------------------------------

    def show_state(self) -> None:
        """Enable the actions that are available now."""
        working = WORKING if self.working else ""
        drawn = "" if self.preview is not None else "The first frame of the scenario is not drawn"
        offer(self.start_button, drawn or working)
        written = "" if self.made is not None else "Simulate a recording first"
        offer(self.open_button, written or working)

    def start(self) -> None:
        """Write recording and true values in the background; the folder is complete or absent."""
        flush_fields(self.form)
        path, seed = Path(self.scenario.value()), int(self.seed.value() or 0)
        frames = int(self.frames.value() or 1)
        if not self.folder.value().strip():
            self.say("Enter a folder first, or choose one", True)
            return
        folder = Path(os.path.expanduser(self.folder.value().strip())).absolute()

        def work(control: Control) -> Scenario:
            scenario = read_scenario(path, frames, seed)
            simulate(scenario, folder, progress=progress_of(control))
            return scenario

        self.begin("Simulating", work, lambda scenario: self._written(scenario, folder))

    def _written(self, scenario: Scenario, folder: Path) -> None:
        self.made = scenario, folder
        frames = pluralize(len(scenario.recording.pools), "frame")
        self.say(f"{frames}, set-up and truth are in {folder}")
        self._preferences.remember(lambda before: replace(before, last_folder=str(folder.parent)))
        self.show_state()

    def open_session(self) -> None:
        """Create a session of the last written recording, in its folder, and open it."""
        if self.made is None:
            return
        scenario, folder = self.made
        path = new_path(folder, folder.name)

        def work(control: Control) -> Path:
            begin_session(scenario, folder, path, control.progress)
            return path

        self.begin("Importing", work, self._open)

    def _open(self, path: Path) -> None:
        if self._sessions.open(path):
            self._propose(path.parent.parent)  # the next recording must not replace the open one
            self.close()
            self.say(f"{path.stem} is open in the main window")

    def closeEvent(self, event: QCloseEvent) -> None:
        """Also stop drawing."""
        self.previews.cancel_all()
        super().closeEvent(event)
