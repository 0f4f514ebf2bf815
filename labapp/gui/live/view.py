"""The camera on the recording page: its choice, settings and picture; and the recording bar."""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial

from PySide6.QtCore import QObject, Qt, QTimer, Signal

from labapp.core.pipeline import Settings
from labapp.gui.live.camera_fields import CameraFields
from labapp.gui.live.canvas import LiveCanvas
from labapp.gui.live.figures import (
    OLD_S,
    LiveFigures,
    figures,
    live_setup_words,
    pace_text,
    why_unmeasured,
)
from labapp.gui.live.live import SIMULATED, Live, choices, measured_with
from labapp.gui.live.live_picture import LivePicture
from labapp.gui.live.penetration import LivePenetration
from labapp.gui.live.plan_fields import PlanFields
from labapp.gui.live.record_bar import RecordBar
from labapp.gui.tasks import DONE, PROBLEM, Control, Task
from labapp.gui.views.picture import PictureView
from labapp.gui.widgets.buttons import button
from labapp.gui.widgets.exposure import ExposureBars
from labapp.gui.widgets.fields import ChoiceField, FieldForm
from labapp.gui.widgets.labels import Message, offer
from labapp.gui.widgets.layouts import Group, column_of, hbox
from labapp.gui.workspace import Workspace
from labapp.media.cameras import (
    Camera,
    CameraError,
    CameraInfo,
    CameraSettings,
    SimulatedDevice,
    find_cameras,
    open_camera,
)
from labapp.media.events import Event
from labapp.media.recording.recorder import recording_path
from labapp.media.recording.take_files import Take
from labapp.run.alarms import RAISED
from labapp.run.live_measuring import LiveResult
from labapp.run.live_watch import LiveWatch
from labapp.session.frame_size import calibrated_px
from labapp.session.session import Session
from labapp.simulated.simulated_pool import pool_camera, simulated_pool
from labapp.text import pluralize

TICK_MS = 33
"""Minimum interval of updates of the picture; it is longer if an update takes long."""

SLOW_MS = 300
"""Maximum interval of updates of the picture."""

STATUS_S = 0.2
"""Minimum interval of updates of the figures."""

CONNECTION = "Camera"
"""Cause of the problem that a camera sends no frames, see `Workspace.say_wrong`."""

NO_LINES = "The simulated camera shows dots, and this session is of lines: choose another camera"


class LiveView(QObject):
    """A camera that is shown in the page's picture and recorded.

    Attributes
    ----------
    group
        Choice and settings, for the panel.
    canvas
        The picture and the other views of the camera.
    picture
        Frames in the page's picture.
    bar
        Recording bar below the canvas; visible while live.
    live
        The running camera; None without one.
    measured_s
        `time.monotonic` at the last update of the figures; 0 before the first.
    """

    changed = Signal()
    """A camera was started or stopped."""
    recorded = Signal(object)
    """A recording was completely written: a `Take`."""

    def __init__(self, workspace: Workspace, picture: PictureView, exposure: ExposureBars) -> None:
        super().__init__(picture)
        self.workspace = workspace
        self.live: Live | None = None
        self.updates = 0
        """Number of times that a live frame was shown, as a picture or as a surface."""
        self._ending: list[Live] = []
        self._pools: dict[str, SimulatedDevice] = {}
        self._raised: list[str] = []
        """Reports of alarms that are not acknowledged."""
        self._opening: Task | None = None
        self._finding: Task | None = None
        self._status_s = self.measured_s = 0.0
        self._result: LiveResult | None = None
        self._basis: tuple[str, Settings] | None = None
        """Set-up, as text, and settings of the measuring."""
        self._timer = QTimer(self, interval=TICK_MS)
        self._timer.timeout.connect(self._tick)
        self.picture = LivePicture(picture, exposure)
        self.canvas = LiveCanvas(workspace, picture, self._watch, self.acknowledge)
        self._make_group()
        self.bar = RecordBar(self.trigger, self.mark, self.stop)
        workspace.changed.connect(self._set_limits)
        workspace.changed.connect(self._follow_session)
        workspace.changed.connect(self._show_state)
        workspace.closing.connect(self._session_closes)
        workspace.tasks.changed.connect(self._show_state)
        self._show_state()

    # --- cameras ------------------------------------------------------------------------------

    def find(self) -> None:
        """Search for connected cameras in the background."""

        def done(answer: tuple[list[CameraInfo], list[str]]) -> None:
            found, problems = answer
            self._choices = choices(found)
            self.camera.set_choices(self._choices)
            message = f"{pluralize(len(found), 'camera')} found"
            words = ". ".join([message, *problems])
            self.workspace.notified.emit(words, False)
            self.answer.setText(f"{DONE} {words}")

        if self._finding not in self.workspace.tasks.active:
            self._finding = self.workspace.tasks.start(
                "Looking for cameras",
                lambda _: find_cameras(),
                done,
                show_answer=self.answer.setText,
            )

    def start(self) -> None:
        """Show the picture of the chosen camera."""
        session = self.workspace.session
        if session is None or self.live is not None:
            return
        if why := self._why_not():
            self.answer.setText(f"{PROBLEM} {why}")
            self.workspace.notified.emit(why, True)
            return
        chosen = self.camera.value()
        name = dict(self._choices)[chosen]
        folder, stem = self.workspace.folder, session.path.stem
        self._basis = session.setup_text, session.settings
        setup, settings = measured_with(session)
        live = Live(
            name,
            lambda: recording_path(folder, stem),
            self.plan_fields.plan(),
            CameraSettings(),
            settings,
            setup,
            session.limits,
        )
        opener = self._opener(chosen, session)

        def work(control: Control) -> None:
            try:
                live.open(opener(control))
            except CameraError as error:
                raise ValueError(str(error)) from error

        self._opening = self.workspace.tasks.start(
            f"Opening {name}",
            work,
            lambda _: self._opened(live),
            show_answer=self.answer.setText,
            kind="Opening the camera",
        )
        self.live = live
        self._show_state()
        self.changed.emit()

    def _why_not(self) -> str:
        """Reason why the chosen camera cannot be started here; empty if it can."""
        session = self.workspace.session
        is_simulated = self.camera.value() == SIMULATED
        return NO_LINES if is_simulated and session is not None and session.has_lines else ""

    def _opener(self, chosen: str, session: Session) -> Callable[[Control], Callable[[], Camera]]:
        """Function that makes the opener of a camera; the pool is rendered only the first time."""
        if chosen != SIMULATED:
            return lambda _: partial(open_camera, chosen)
        text = simulated_pool(session)

        def rendered(control: Control) -> Callable[[], Camera]:
            if text not in self._pools:
                self._pools[text] = pool_camera(text, control.progress)
            return self._pools[text].open

        return rendered

    def _opened(self, live: Live) -> None:
        if self.live is not live or live.feed is None:
            return
        session = self.workspace.session
        self.camera_fields.show_camera(
            live.feed, None if session is None else calibrated_px(session)
        )
        self._begin_figures(live)
        self._follow_session()
        self.picture.begin()
        self._timer.start(TICK_MS)
        self._show_state()
        # Here Space records, also as the key of the focused widget.
        self.bar.record_button.setFocus()

    def _begin_figures(self, live: Live) -> None:
        """Show that nothing is measured yet, or why nothing is."""
        session, is_measured = self.workspace.session, live.setup is not None
        self.penetration.begin()
        self.penetration.setVisible(live.watch is not None)
        self.measured_s, self._result = 0.0, None
        self.figures.show_figures(figures(None) if is_measured else ())
        why = "" if is_measured or session is None else why_unmeasured(session)
        self.figures.words.setText(why)
        self.figures.setup_words.setText("")
        self.canvas.set_live(live.watch is not None)

    def _follow_session(self) -> None:
        """Measure with the session's set-up and settings, which may have changed."""
        session, live = self.workspace.session, self.live
        if session is None or live is None or not live.is_open:
            return
        if (basis := (session.setup_text, session.settings)) != self._basis:
            self._basis = basis
            live.set_setup(*measured_with(session))
            self._set_limits()  # measuring may have begun only now
            self.camera_fields.set_calibrated(calibrated_px(session))
            self._begin_figures(live)

    def stop(self) -> None:
        """Stop the camera after finishing a current recording."""
        live, self.live = self.live, None
        if live is None:
            return
        if self._opening is not None:
            self._opening.cancel()  # otherwise a simulated pool would still be rendered
        self._timer.stop()
        self.picture.end()
        if live.watch is not None:
            self.canvas.show_status(live.watch)  # shows the last alarms
        self.canvas.set_live(False)
        self._ending.append(live)
        title = "Stopping the camera" if live.running is None else "Finishing the recording"

        def done(_: object) -> None:
            self._ending.remove(live)
            self._report_events(live)
            self.workspace.settle(CONNECTION)

        self.workspace.tasks.start(title, lambda _: live.close(), done)
        self._show_state()
        self.changed.emit()

    def _session_closes(self) -> None:
        """Complete a current recording before the session closes."""
        for live in (*self._ending, *([self.live] if self.live is not None else [])):
            live.close()
            for event in live.events():
                self._report(event, live)
            for take in live.ended_takes():
                self.workspace.notified.emit(
                    f"Recorded beside the session: {take.path.name}", False
                )
        self._ending.clear()
        self.answer.setText("")
        self.live = None
        self.canvas.set_live(False)
        self.canvas.alarms.clear()
        self._timer.stop()
        self.picture.end()
        self._show_state()

    # --- recording ----------------------------------------------------------------------------

    @property
    def is_live(self) -> bool:
        """Whether frames arrive, or will arrive once the camera is connected again."""
        return self.live is not None and self.live.is_open

    @property
    def recording(self) -> Take | None:
        """The current recording; None if there is none."""
        return None if self.live is None else self.live.running

    def trigger(self) -> None:
        """Begin a recording, or end the current one."""
        live = self.live
        if live is not None and live.is_open:
            self.workspace.run_or_report(live.trigger)
            self._show_status(live)
            self._show_state()

    def discard(self, take: Take) -> None:
        """Delete a current recording as soon as the camera has stopped."""
        if self.live is not None and not self.live.discard(take):
            self.workspace.notified.emit(f"{take.path.name} had ended and is kept", False)

    def mark(self) -> bool:
        """Mark the current frame in the notes of the recording; False if there is none."""
        if self.live is None or self.recording is None:
            return False
        self.live.mark()
        return True

    def acknowledge(self) -> None:
        """Acknowledge the alarms for the operator."""
        watch = self._watch()
        self.canvas.alarms.clear()
        while self._raised:
            self.workspace.settled.emit(self._raised.pop())
        if watch is not None:
            watch.acknowledge()
            self.canvas.show_status(watch)

    def _watch(self) -> LiveWatch | None:
        return None if self.live is None else self.live.watch

    def _set_limits(self) -> None:
        """Use the session's limits, which may have changed."""
        session, watch = self.workspace.session, self._watch()
        if session is not None and watch is not None:
            watch.set_limits(session.limits)
            if self.live is not None and self.live.setup is not None:
                self._show_figures(watch)
            self.canvas.show_status(watch)

    def _replan(self) -> None:
        plan = self.plan_fields.plan()
        if self.live is not None and plan != self.live.plan:
            self.live.set_plan(plan)

    def _begin_anew(self) -> None:
        """Discard frames from before a change of the camera's settings."""
        if self.live is not None:
            self.live.set_plan(self.live.plan)

    # --- while it runs ------------------------------------------------------------------------

    def _tick(self) -> None:
        live, began_s = self.live, time.perf_counter()
        if live is None:
            return
        is_measured = self._result is not None and self._age_s <= OLD_S
        self.updates += self.picture.follow(live, is_measured)
        if live.watch is not None:
            self._follow(live.watch)
        if time.monotonic() - self._status_s > STATUS_S:
            self._show_status(live)
        self._report_events(live)
        if live.feed is not None and live.feed.state == "running":
            self.workspace.settle(CONNECTION)
        self.camera_fields.take_answers()
        took_ms = (time.perf_counter() - began_s) * 1000
        wanted = min(max(TICK_MS, round(2 * took_ms)), SLOW_MS)
        if abs(wanted - self._timer.interval()) > TICK_MS / 4:
            self._timer.setInterval(wanted)

    def _follow(self, watch: LiveWatch) -> None:
        """Show the results since the last call."""
        result = watch.newest()
        if result is not None:
            former, was_old = self._result, self._age_s > OLD_S
            self._result, self.measured_s = result, time.monotonic()
            self._show_figures(watch)
            if was_old or former is None or former.measurement.status != result.measurement.status:
                self._status_s = 0.0  # the text about the figures is cleared with them
            if self._age_s <= OLD_S:  # otherwise it does not describe the visible pool
                self.picture.show_quality(result.quality)
        self.updates += self.canvas.follow(result, watch)

    def _show_figures(self, watch: LiveWatch) -> None:
        sizes = figures(self._result, watch.alarms.limits, self._age_s)
        self.figures.show_figures((*sizes, *self.penetration.figures(self._age_s > OLD_S)))

    @property
    def _age_s(self) -> float:
        result = self._result
        return 0.0 if result is None else time.monotonic() - result.arrived_s

    def _report_events(self, live: Live) -> None:
        """Report events, and emit recordings that have ended."""
        for event in live.events():
            self._report(event, live)
        for take in live.ended_takes():
            self.recorded.emit(take)

    def _report(self, event: Event, live: Live) -> None:
        """Report an event; lost frames are a problem only while they are recorded."""
        if event.passes:
            self.workspace.say_wrong(CONNECTION, str(event))
            return
        recorded = live.running is not None or event.source != live.name
        if event.words.startswith(RAISED):
            self._raised.append(str(event))
        problem = event.kind == "warning" or (event.kind == "loss" and recorded)
        if problem and event.kind == "loss":
            self.workspace.urgent.emit(str(event))
        self.workspace.notified.emit(str(event), problem)

    def _show_status(self, live: Live) -> None:
        self._status_s = time.monotonic()
        self.bar.show_status(live)
        self.counts.setText(live.counts_text())
        if live.watch is not None:
            pace, skipped = live.watch.trend.pace(), live.watch.queue.skipped
            if live.setup is not None:
                self._show_figures(live.watch)
                words = pace_text(self._result, pace, live.rate_hz(), self._age_s, skipped)
                stopped = live.watch.stopped
                self.figures.words.setText(f"▲ {stopped}" if stopped else words)
                words = live_setup_words(self._result, live.setup.check_date)
                words += f"\n{self.camera_fields.part_words.text()}"
                self.figures.setup_words.setText(words.strip())
            self.canvas.show_status(live.watch)
        frame_byte = self.picture.frame_byte
        if live.feed is not None and frame_byte is not None:
            set_to = live.feed.settings
            rate_hz = set_to.rate_hz if set_to.trigger == "free" else None
            self.plan_fields.show_cost(frame_byte, rate_hz or live.rate_hz())
        if self._shown != (live.running is not None):
            self.workspace.changed.emit()  # the list of steps shows on every page that it records

    # --- widgets ------------------------------------------------------------------------------

    def _show_state(self) -> None:
        """Show the actions that are available now."""
        active = self.workspace.tasks.active
        if self.live is not None and self.live.feed is None and self._opening not in active:
            self.live = None  # it could not be opened, or that was cancelled
            self.changed.emit()
        live = self.live
        runs = live is not None and live.is_open
        self._shown = recording = self.recording is not None
        self.camera.setEnabled(live is None)
        for each in (self.start_button, self.find_button):
            each.setVisible(live is None)
        offer(self.start_button, self._why_not())
        self.camera.refuse(self._why_not())
        if self.workspace.session is None or self._ending:
            self.start_button.setEnabled(False)
        self.settings.setVisible(runs)
        self.bar.setVisible(runs)
        self.plan_fields.set_enabled(not recording)
        self.camera_fields.set_recording(recording)
        self.bar.show_recording(recording)

    def _make_group(self) -> None:
        self._choices = choices([])
        tip = "Which camera to watch; the simulated one films a pool on this bench"
        self.camera = ChoiceField("Camera", self._choices, tooltip=tip)
        self.camera.edited.connect(lambda _: self._show_state())
        self.start_button = button("Start", "Show live what the camera sees", self.start)
        self.find_button = button("Find cameras", "List the cameras that are connected", self.find)
        self.answer, self.counts = Message(2), Message(2)
        self.figures, self.penetration = LiveFigures(), LivePenetration(self.workspace, self._watch)
        fields = FieldForm()
        self.camera_fields = CameraFields(
            fields, lambda wanted: None if self.live is None else self.live.apply(wanted)
        )
        self.camera_fields.reset.connect(self._begin_anew)
        self.plan_fields = PlanFields(fields)
        self.plan_fields.edited.connect(self._replan)
        self.settings = column_of(self.figures, self.penetration, self.counts, fields)
        buttons = hbox(self.start_button, self.find_button)
        self.group = Group("Capture", FieldForm(self.camera), buttons, self.answer, self.settings)

    def take_key(self, key: Qt.Key) -> bool:
        """Run the action of a plain key while live; returns whether it has one."""
        works = {
            Qt.Key.Key_Space: self.trigger,
            Qt.Key.Key_M: self.mark,
            Qt.Key.Key_A: self.acknowledge,
        }
        if not self.is_live or key not in works:
            return False
        works[key]()
        return True
