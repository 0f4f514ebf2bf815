"""The recording page: choice, preview and import; facts; exposure of the frame in view."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from PySide6.QtCore import QSignalBlocker, Qt, QTimer
from PySide6.QtGui import QKeyEvent
from PySide6.QtWidgets import QGridLayout, QSlider

from labapp.gui.dialogs import ask_file, ask_folder, ask_recording
from labapp.gui.live.view import LiveView
from labapp.gui.pages.capture.foot_switch import FootSwitchPanel
from labapp.gui.pages.capture.import_choice import ImportChoice
from labapp.gui.pages.capture.kept_recordings import KeptRecordings
from labapp.gui.pages.capture.presenter import (
    Choice,
    Preview,
    ShownFrame,
    judged_by,
    look,
    missing_text,
    recording_facts,
)
from labapp.gui.pages.page import Page
from labapp.gui.shell.steps import Lead, Mark, Offer, State, why_not_measurable
from labapp.gui.tasks import Control, Task
from labapp.gui.views.picture import PictureView
from labapp.gui.widgets.buttons import button
from labapp.gui.widgets.exposure import ExposureBars
from labapp.gui.widgets.labels import keep_room, plain_label, selectable_label, wrapping_label
from labapp.gui.widgets.layouts import Group, fill, hbox
from labapp.gui.workspace import MISSING, Workspace
from labapp.media.recording.take_files import Take
from labapp.session.frame_size import size_warning
from labapp.session.record import Recording
from labapp.session.session import Session
from labapp.text import pluralize

REST_MS = 120
"""Time, ms, that a frame stays in view before its exposure is assessed."""

CAPTURE_SHOWS = "The frames of a video, of images or a stack, or what a camera sees."

KEYPAD = Qt.KeyboardModifier.KeypadModifier


def _nothing() -> None:
    pass


def _warnings(session: Session, recording: Recording) -> tuple[str, ...]:
    """Warnings about a recording, and about its size if the set-up is for another one."""
    return (*recording.warnings, *filter(None, [size_warning(session, recording)]))


class CapturePage(Page):
    """Choice, import and live capture of the recording."""

    key = "capture"

    def __init__(self, workspace: Workspace) -> None:
        super().__init__(workspace)
        self.preview: Preview | None = None
        self._importing: Task | None = None
        self._reading: Task | None = None
        self._wanted: tuple[Preview | None, int] | None = None
        self._seen: tuple[Preview | None, int] | None = None
        self._told: object = None
        self._rest = QTimer(self, singleShot=True, interval=REST_MS)
        self._rest.timeout.connect(self._judge)
        self._last_folder = Path()
        self._listed: Session | None = None
        """Session whose other recordings are listed."""
        self.title = wrapping_label()
        self.title.setContentsMargins(8, 4, 8, 0)
        self.picture_view = PictureView("Frame of the recording")
        self.slider = QSlider(Qt.Orientation.Horizontal)
        self.slider.setAccessibleName("Frame of the preview")
        self.slider.setToolTip("Which frame of the recording to look at before importing it")
        self.slider.valueChanged.connect(lambda _: self._look())
        self.exposure = ExposureBars()
        live = self.live_view = LiveView(workspace, self.picture_view, self.exposure)
        live.changed.connect(self._live_changed)
        live.recorded.connect(self._recorded)
        fill(self.canvas_layout, self.title, (live.canvas, 1), self.slider, live.bar)
        self._make_panel()
        workspace.opened.connect(self._forget)
        workspace.tasks.changed.connect(self._show_import)

    # --- what it shows ------------------------------------------------------------------------

    def refresh(self) -> None:
        """Show the session's recording, or the one to import."""
        session = self.workspace.session
        if session is None:
            return
        recording = session.recording
        missing = missing_text(session)
        self.missing.setText(missing)
        self.find_button.setEnabled(not session.read_only)
        for widget in (self.missing, self.find_button):
            widget.setVisible(bool(missing))
        self._show_recording(recording)
        self._show_import()
        self._look()

    def state(self, found: State) -> State:
        """State of the step, which may have a chosen recording that is not yet imported."""
        session = self.workspace.session
        if self.live_view.recording is not None:
            message = "A recording is running: Ctrl+R or a pedal ends it"
            return State(Mark.ATTENTION, message)
        if self.live_view.live is not None:
            message = "The camera is live: Space, Ctrl+R or a pedal starts and stops a recording"
            return State(Mark.READY, message)
        if self.preview is None or session is None or session.recording is not None:
            return found
        name = self.preview.path.name
        if self._importing in self.workspace.tasks.active:
            return State(Mark.READY, f"{name} is being imported")
        return State(Mark.READY, f"{name} is not imported yet: press Import")

    def lead(self, found: Lead | None) -> Lead | None:
        """Sources of a recording while there is none to show."""
        session = self.workspace.session
        if session is None or session.recording or self.preview or self.live_view.live:
            return found
        file = Offer("Choose &file…", "A video, an image or a stack", self.choose_file)
        folder = Offer("Choose f&older…", "A folder of images in order", self.choose_folder)
        camera = Offer("&Start camera", "See what the camera chosen at the right sees",
                       self.live_view.start)  # fmt: skip
        return Lead(CAPTURE_SHOWS, (file, folder, camera))

    def leave(self) -> None:
        """Stop assessing frames; a camera and its recording continue."""
        if self._rest.isActive():
            self._rest.stop()
            self._seen = None

    # --- live ---------------------------------------------------------------------------------

    @property
    def camera(self) -> LiveView | None:
        """The live camera; None if there is none."""
        return self.live_view if self.live_view.is_live else None

    def takes_key(self, event: QKeyEvent) -> bool:
        """Handle keys of a live camera: Space records, M marks, A acknowledges alarms."""
        plain = event.modifiers() in (Qt.KeyboardModifier.NoModifier, KEYPAD)
        if not plain or self.camera is None:
            return False
        return event.isAutoRepeat() or self.live_view.take_key(Qt.Key(event.key()))

    def _live_changed(self) -> None:
        """Show the camera's picture after its start, or the session's after its stop."""
        live = self.live_view.live
        self._rest.stop()
        self._wanted = self._seen = None
        if live is None:
            self.exposure.hide()
        else:
            self._drop_preview()
            self._show_seen(ShownFrame(f"Live: {live.name}", None, None, "Opening the camera…"))
        self.refresh()
        self.workspace.changed.emit()

    def _recorded(self, take: Take) -> None:
        """Import a finished recording, or report why it is not imported."""
        session, why_kept = self.workspace.session, ""
        if session is None or not take.frames:
            self.workspace.notified.emit(f"{take.path.name}: nothing was recorded", True)
            return
        if session.read_only:
            why_kept = "the session is read-only"
        elif session.recording is not None or self._importing in self.workspace.tasks.active:
            why_kept = "the session has a recording"
        if why_kept:
            self._listed = None
            self._show_import()
            self.confirm(f"{take.path.name} is under Other recordings ({why_kept})")
        else:
            measured = self.live_view.plan_fields.measured.isChecked()
            self._import(take.path, None, self._measure if measured else _nothing)

    def _show_recording(self, recording: Recording | None) -> None:
        self.facts_group.setVisible(recording is not None and self.live_view.live is None)
        session = self.workspace.session
        if recording is None or session is None:
            return
        shown = (recording, session.setup_text, session.plane_calibration)
        if shown == self._told:
            return
        self._told = shown
        while self.facts.count():
            item = self.facts.takeAt(0)
            widget = None if item is None else item.widget()
            if widget is not None:
                widget.hide()  # it is deleted only later
                widget.deleteLater()
        rows = recording_facts(recording)
        for row, (name, words) in enumerate(rows):
            self.facts.addWidget(plain_label(f"{name}:"), row, 0)
            self.facts.addWidget(selectable_label(words), row, 1)
        for row, sentence in enumerate(_warnings(session, recording), len(rows)):
            self.facts.addWidget(selectable_label(f"⚠ {sentence}"), row, 0, 1, 2)

    def _show_import(self) -> None:
        working = self._importing in self.workspace.tasks.active
        session, seen = self.workspace.session, None
        if self.preview is not None:
            seen = self.workspace.run_or_report(self.workspace.overview)
        measured = seen is not None and (any(seen.status) or bool(seen.corrected.any()))
        self.chosen.show_choice(session, self.preview, working, measured)
        self.slider.setVisible(self.preview is not None and self.preview.frames > 1)
        if session is not None and session is not self._listed and not working:
            self._listed = session
            self.kept.list_beside(session, self.live_view.recording)

    def _show_seen(self, seen: ShownFrame) -> None:
        self.title.setText(seen.title)
        self.picture_view.show_picture(seen.image, seen.words)
        if seen.exposure is None:
            session = self.workspace.session
            if seen.image is None or session is None or judged_by(session) is None:
                self.exposure.hide()
            return  # the previous frame's exposure stays until this one is assessed
        self.exposure.show()
        verdict = seen.exposure.verdict
        message = f"{verdict.capitalize()}. {seen.exposure.advice}"
        self.exposure.show_exposure(seen.exposure, message, verdict == "good")

    # --- frames to look at --------------------------------------------------------------------

    def _look(self) -> None:
        """Read the frame in view in the background; only the last of several requests counts."""
        if self.live_view.live is not None:
            return
        session, preview = self.workspace.session, self.preview
        if preview is not None:
            self._wanted = (preview, self.slider.value())
        elif session is not None and session.recording is not None:
            self._wanted = (None, self.workspace.frame)
        else:
            self._wanted = self._seen = None
            self._show_seen(ShownFrame("", None, None))
            return
        if self._wanted != self._seen and self._reading not in self.workspace.tasks.active:
            self._read()

    def _judge(self) -> None:
        """Assess the exposure of the frame in view."""
        if self._wanted == self._seen and self._reading not in self.workspace.tasks.active:
            self._read(judged=True)

    def _read(self, judged: bool = False) -> None:
        session, wanted = self.workspace.session, self._wanted
        if session is None or wanted is None:
            return
        preview, number = wanted

        def work(_: Control) -> ShownFrame:
            if preview is not None:
                return preview.look(number, judged_by(session) if judged else None)
            return look(session, number, judged)

        def done(seen: ShownFrame) -> None:
            if self.workspace.session is not session or self.live_view.live is not None:
                return
            self._seen = wanted
            if self._wanted == wanted or self.slider.isSliderDown():
                self._show_seen(seen)
            if self._wanted not in (None, wanted):
                self._read()
            elif not judged and seen.image is not None and judged_by(session) is not None:
                self._rest.start()

        self._reading = self.workspace.tasks.start("Reading a frame", work, done)

    # --- choosing and importing ---------------------------------------------------------------

    def choose_file(self) -> None:
        """Ask for a recording file."""
        if path := ask_recording(self, self._folder()):
            self.take(path)

    def choose_folder(self) -> None:
        """Ask for a folder of images."""
        if path := ask_folder(self, "Choose a folder of images", self._folder()):
            self.take(path)

    def _folder(self) -> Path:
        return self._last_folder if self._last_folder.name else self.workspace.folder

    def take(self, path: Path, at_once: bool = False) -> None:
        """Preview a recording for import, or import all of it immediately, see `Page.take`."""
        self._last_folder = path.parent
        self.live_view.stop()

        def work(control: Control) -> Preview:
            preview = Preview(path)
            if control.cancelled.is_set():
                preview.close()
            return preview

        def opened(preview: Preview) -> None:
            self._drop_preview()
            self.preview = preview
            last = preview.frames - 1
            with QSignalBlocker(self.slider):
                self.slider.setRange(0, last)
                self.slider.setValue(0)
            self.chosen.begin(preview)
            self._look()
            if at_once:
                self._import(path, None, self._go_to_dots)
            self._show_import()
            self.workspace.changed.emit()

        title, kind = f"Opening {path.name}", "Opening a recording"
        self.start_latest(title, (path, at_once), work, opened, kind)

    def choice(self) -> Choice | None:
        """Choice of frames to import; None before a recording was chosen."""
        return None if self.preview is None else self.chosen.choice()

    def import_chosen(self) -> None:
        """Import the chosen frames in the background."""
        preview, choice = self.preview, self.choice()
        if preview is not None and choice is not None and choice.count:
            self._import(preview.path, choice)

    def begin_next(self) -> None:
        """Import the chosen frames into a new session with the same set-up."""
        preview, choice = self.preview, self.choice()
        if preview is not None and choice is not None and choice.count:
            self._import_next(preview.path, choice)

    def _import_next(self, path: Path, choice: Choice | None) -> None:
        former = self.workspace.session
        self.workspace.next_session_requested.emit(path)
        if self.workspace.session is not former:  # the dialog was not cancelled
            self._import(path, choice)

    def _import(
        self, path: Path, choice: Choice | None, then: Callable[[], None] = _nothing
    ) -> None:
        """Import the chosen frames of a recording in the background; None: all of them."""
        session = self.session
        options = {} if choice is None else choice.options

        def work(control: Control) -> Recording:
            recording = session.import_recording(path, **options, progress=control.progress)
            session.overview()  # read in this thread: the window would wait for it
            return recording

        def done(recording: Recording) -> None:
            self._drop_preview()
            frames = session.frames.tolist()
            if self.workspace.frame not in frames:
                self.workspace.show_frame(frames[0])
            self._seen = None
            message = f"{pluralize(len(frames), 'frame')} of {path.name} imported"
            warnings = (f"⚠ {sentence}" for sentence in _warnings(session, recording))
            self.confirm(" ".join((f"{message}.", *warnings)))
            self.workspace.changed.emit()
            then()

        self._importing = self.start_task(f"Importing {path.name}", work, done, kind="Importing")
        self._listed = None  # one of them may be the session's recording now
        self._show_import()

    def _measure(self) -> None:
        """Measure the recording, each frame starting from the previous one, if possible."""
        if not why_not_measurable(self.session):
            self.workspace.measure(warm=True)

    def _go_to_dots(self) -> None:
        """Go to the dots, unless the operator left this page."""
        if self.isVisible():
            self.workspace.action_requested.emit("step_dots")

    def _drop_preview(self) -> None:
        preview, self.preview = self.preview, None
        self._seen = None
        if preview is not None and self.workspace.session is not None:
            # In a task, as a frame may still be being read.
            self.workspace.tasks.start(f"Closing {preview.path.name}", lambda _: preview.close())
        elif preview is not None:
            preview.close()
        self._show_import()

    def _forget(self) -> None:
        """Discard the choice for the previous session."""
        self._listed = None
        self._drop_preview()

    def cancel_choice(self) -> None:
        """Return to the session's frames without an import."""
        self._drop_preview()
        self.refresh()
        self.workspace.changed.emit()

    def find_recording(self) -> None:
        """Ask for the new location of a recording that is missing or replaced."""
        missing = self.session.missing_recording or self.session.replaced_recording
        if missing is None:
            return
        # A folder of images has no suffix and needs another dialog than a file.
        ask = ask_file if missing.suffix else ask_folder
        if found := ask(self, f"Locate {missing.name}", self._folder()):
            self.relink(found)

    def relink(self, path: Path) -> None:
        """Set the new location of the recording; a different recording is refused."""
        session = self.session

        def done(_: object) -> None:
            self._seen = None
            self.workspace.settle(MISSING)
            self.confirm(f"The recording is found at {path}")
            self.workspace.changed.emit()

        self.start_task(
            f"Comparing {path.name}", lambda _: session.relink(path), done, kind="Comparing"
        )

    # --- the panel ----------------------------------------------------------------------------

    def _make_panel(self) -> None:
        choose = hbox(
            button("Choose file…", "A video, an image or a stack", self.choose_file),
            button("Choose folder…", "A folder of images in order", self.choose_folder),
        )
        self.missing = selectable_label()
        self.find_button = button(
            "Locate…", "Choose the recording where it is now", self.find_recording
        )
        self.chosen = ImportChoice(self.import_chosen, self.begin_next, self.cancel_choice)
        self.chosen.edited.connect(self._show_import)
        self.exposure.hide()
        keep_room(self.exposure)
        self.foot_switch = FootSwitchPanel(self.workspace.foot_switches)
        # Below the other buttons, as it appears when a recording ends.
        self.kept = KeptRecordings(self.take, lambda path: self._import_next(path, None))
        self.facts = QGridLayout()  # a form layout keeps old heights, which cuts off lines
        self.facts.setColumnStretch(1, 1)
        self.facts_group = Group("What was read", self.facts)
        fill(
            self.panel_layout,
            *(choose, self.answer, self.live_view.group, self.missing, self.find_button),
            *(self.chosen, self.exposure, self.foot_switch, self.kept, self.facts_group, 1),
        )
