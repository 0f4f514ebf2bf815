"""A camera that is watched and recorded, without widgets; its frames arrive in threads."""

from __future__ import annotations

import logging
import queue
import shutil
import threading
import time
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from labapp.config.setup import Setup
from labapp.core.pipeline import Settings
from labapp.core.values import FloatArray
from labapp.errors import InputError
from labapp.gui.live.live_dots import JudgedFrame, LiveDots
from labapp.log import NAME
from labapp.media.cameras import Camera, CameraFrame, CameraInfo, CameraSettings, Feed
from labapp.media.events import Event
from labapp.media.recording.recorder import Plan, Recorder
from labapp.media.recording.take_files import Take
from labapp.run.limits import Limits
from labapp.run.live_queue import newest_of
from labapp.run.live_trend import RATE_S
from labapp.run.live_watch import LiveWatch
from labapp.session.session import Session
from labapp.text import capitalized, format_bytes, pluralize

SIMULATED = "simulated"
"""Id of the simulated camera."""

SHOW_S, LOOK_S = 0.025, 0.25
"""Minimum intervals of detecting dots in a frame and of assessing a frame."""

IDLE_S = 0.005

STATES = {
    "opening": ("○", "Opening the camera…"),
    "running": ("●", "Live"),
    "stalled": ("▲", "No frames arrive, though it is connected: missing frames are not recorded"),
    "lost": ("▲", "Not connected: trying again. What was recorded is kept"),
    "ended": ("▲", "It has ended: start it again"),
}

WAITS = {
    "software": "Live, takes a frame on request",
    "line": "Live, takes a frame at a signal on its input",
}
"""State of a camera that takes frames only when triggered, by its trigger."""


def choices(found: list[CameraInfo]) -> list[tuple[str, str]]:
    """(id, text) of the available cameras: the connected ones and the simulated one."""
    named = [(info.id, f"{info.name} ({info.kind})") for info in found]
    return [*named, (SIMULATED, "Simulated camera")]


@dataclass(frozen=True)
class LiveFrame:
    """A frame to show."""

    frame: CameraFrame
    dots_px: FloatArray | None
    """(u, v) of its dots, shape (n, 2); None if it is not yet known how to find them quickly."""


class Live:
    """A running camera: its newest frame for display, and its recordings.

    `open` and `close` block and must be called in a task. The other methods are fast.

    Parameters
    ----------
    place
        Function that returns the file for a new recording.
    settings
        Settings for frames of dots. None: the frames show lines, whose exposure is not assessed.
    setup
        Rig and image calibration for measuring frames. None: frames are not measured.
    """

    def __init__(
        self,
        name: str,
        place: Callable[[], Path],
        plan: Plan,
        wanted: CameraSettings,
        settings: Settings | None,
        setup: Setup | None = None,
        limits: Limits | None = None,
    ) -> None:
        self.name = name
        self.plan = plan
        self.takes: list[Take] = []
        """The recordings in chronological order."""
        self.feed: Feed | None = None
        self.watch: LiveWatch | None = None
        """Measures the frames; None without a set-up and before the camera is open."""
        self._place, self._folder, self._wanted = place, place().parent, wanted
        self._settings, self._limits = settings, limits or Limits()
        self.setup = setup
        self._dots = LiveDots(None if settings is None else settings.dots)
        self._events: queue.SimpleQueue[Event] = queue.SimpleQueue()
        self._to_show: deque[CameraFrame] = deque(maxlen=1)
        self._to_judge: deque[CameraFrame] = deque(maxlen=1)
        self._newest: deque[LiveFrame] = deque(maxlen=1)
        self._judged: deque[JudgedFrame] = deque(maxlen=1)
        self._recorders: list[Recorder] = []
        self._reported: set[Path] = set()
        self._discarded: list[Take] = []
        self._counted: deque[tuple[float, int]] = deque()
        self._frame_byte = 0
        self.room_byte: int | None = None
        """Free space on the disk; None if unknown."""
        self._is_stale = False
        self._closing = threading.Event()
        self._turn = threading.Lock()
        self._workers: list[threading.Thread] = []

    # --- begin and end ------------------------------------------------------------------------

    def open(self, opened: Callable[[], Camera]) -> None:
        """Open the camera and start it, unless it was closed meanwhile.

        Raises
        ------
        InputError, CameraError
            If it cannot be opened or set.
        """
        feed = Feed(self.name, opened, self._take, self._say, self._wanted)
        with self._turn:
            if not self._closing.is_set():
                self.feed = feed
                self._recorders = [self._recorder(feed)]
                show, judge = (partial(newest_of, each) for each in (self._to_show, self._to_judge))
                self._begin("dots", show, self._find_quickly, SHOW_S)
                self._begin("verdict", judge, self._judge, LOOK_S)
                self._begin_measuring(feed)
                return
        feed.stop()

    def set_setup(self, setup: Setup | None, settings: Settings | None) -> None:
        """Measure the next frames with another set-up or other settings; see `Live`."""
        with self._turn:
            if self.feed is None or self._closing.is_set():
                return
            self.setup, self._settings = setup, settings
            self._dots.settings = None if settings is None else settings.dots
            if self.watch is None:
                self._begin_measuring(self.feed)
            else:
                self.watch.set_setup(setup, settings)

    def close(self) -> None:
        """End the recording, write all of it, and release the camera. May be called twice."""
        with self._turn:
            self._closing.set()
        if self.feed is not None:
            self.feed.stop()
            if self.watch is not None:
                self.watch.close()
            for worker in self._workers:
                worker.join()
        for recorder in self._recorders:
            recorder.close()
        self._delete_discarded()

    def _delete_discarded(self) -> None:
        while self._discarded:
            take = self._discarded.pop()
            for path in (take.path, take.notes):
                try:
                    path.unlink(missing_ok=True)
                except OSError as error:
                    words = f"cannot be deleted: {error.strerror}"
                    self._events.put(Event(path.name, "warning", words))

    @property
    def is_open(self) -> bool:
        """Whether frames arrive, or will arrive once the camera is connected again."""
        return self.feed is not None and not self._closing.is_set()

    def _recorder(self, feed: Feed) -> Recorder:
        self._is_stale = False
        return Recorder(
            self._place, self.plan, feed.bit_depth, feed.settings.rate_hz, self._events.put
        )

    # --- in the camera's thread ---------------------------------------------------------------

    def _take(self, frame: CameraFrame) -> None:
        self._renew()
        for recorder in self._recorders[-1:]:
            recorder.take(frame)
        self._to_show.append(frame)
        self._to_judge.append(frame)
        if self.watch is not None:
            self.watch.take(frame)

    def _say(self, event: Event, time_s: float | None = None) -> None:
        self._events.put(event)
        for recorder in self._recorders[-1:]:
            recorder.note(event, time_s)

    # --- in threads of their own --------------------------------------------------------------

    def _begin_measuring(self, feed: Feed) -> None:
        if self.setup is None or self._settings is None:
            return
        given = (self.setup, self._settings, feed.bit_depth, self._limits)
        self.watch = LiveWatch(self.name, *given, self._say)
        # No pause: the work runs in a process, and skipped frames would lengthen the steps.
        self._begin("figures", self.watch.next_frame, self.watch.measure, 0.0, rest=0.0)

    def _begin(
        self,
        what: str,
        next_frame: Callable[[], CameraFrame | None],
        work: Callable[[CameraFrame], None],
        every_s: float,
        rest: float = 1.0,
    ) -> None:
        """Start a thread that calls ``work`` with one frame after the other.

        ``every_s`` is the minimum interval, ``rest`` the pause as a multiple of the duration.
        """

        def run() -> None:
            try:
                while not self._closing.is_set():
                    frame = next_frame()
                    if frame is None:
                        self._closing.wait(IDLE_S)
                        continue
                    began_s = time.monotonic()
                    work(frame)
                    took_s = time.monotonic() - began_s
                    self._closing.wait(max(every_s - took_s, rest * took_s))
            except Exception as error:
                logging.getLogger(NAME).exception("live %s", what)
                words = f"a fault in the program has ended its {what}: {error!r}"
                self._events.put(Event(self.name, "warning", words))

        worker = threading.Thread(target=run, name=f"live {what}", daemon=True)
        self._workers.append(worker)
        worker.start()

    def _find_quickly(self, frame: CameraFrame) -> None:
        self._newest.append(LiveFrame(frame, self._dots.find_quickly(frame.image)))

    def _judge(self, frame: CameraFrame) -> None:
        self._frame_byte = frame.image.nbytes
        try:
            self.room_byte = shutil.disk_usage(self._folder).free
        except OSError:
            self.room_byte = None
        depth = None if self.feed is None else self.feed.bit_depth
        pattern = None if self.setup is None else self.setup.rig.pattern
        rays = None if pattern is None else pattern.rows * pattern.columns
        self._judged.append(self._dots.judge(frame.image, depth, rays))

    # --- to look at ---------------------------------------------------------------------------

    def newest(self) -> LiveFrame | None:
        """The newest frame; None if it was already returned."""
        return self._newest.popleft() if self._newest else None

    def looked(self) -> JudgedFrame | None:
        """Results for the last assessed frame; None if they were already returned."""
        return self._judged.popleft() if self._judged else None

    def events(self) -> list[Event]:
        """Events since the last call."""
        return [self._events.get() for _ in range(self._events.qsize())]

    def ended_takes(self) -> list[Take]:
        """Recordings that are completely written; each is returned once."""
        ended = [t for t in self.takes if t.finished.is_set() and t.path not in self._reported]
        self._reported |= {take.path for take in ended}
        return ended

    @property
    def running(self) -> Take | None:
        """The current recording."""
        return self._recorders[-1].running if self._recorders else None

    @property
    def is_failing(self) -> bool:
        """Whether frames of the current recording are lost, as it cannot be written."""
        return self.running is not None and bool(self.running.trouble)

    def rate_hz(self) -> float | None:
        """Current frame rate, 1/s; None if unknown."""
        now_s, counted = time.monotonic(), self._counted
        counted.append((now_s, 0 if self.feed is None else self.feed.counts.frames))
        while len(counted) > 2 and counted[1][0] < now_s - RATE_S:
            counted.popleft()
        (first_s, first), (last_s, last) = counted[0], counted[-1]
        return (last - first) / (last_s - first_s) if last_s - first_s > RATE_S / 2 else None

    def state_text(self) -> str:
        """Text of the camera's state and frame rate."""
        state = "opening" if self.feed is None else self.feed.state
        rate = self.rate_hz()
        sign, words = STATES[state]
        if state == "running" and self.feed is not None:
            words = WAITS.get(self.feed.settings.trigger or "", words)
        fast = f", {rate:.1f} frames/s" if state == "running" and rate is not None else ""
        return f"{sign} {words}{fast}"

    def counts_text(self) -> str:
        """Text of the numbers of frames that arrived and that did not."""
        if self.feed is None:
            return ""
        counts = self.feed.counts
        parts = [pluralize(counts.frames, "frame")]
        parts += [f"{counts.dropped} dropped", f"{counts.broken} broken"]
        parts += [f"lost {pluralize(counts.lost, 'time')}"] * (counts.lost > 0)
        return ", ".join(parts)

    def before_trigger(self) -> tuple[float, str]:
        """Fill level of the memory for frames before a trigger, 0 … 1, and its text."""
        recorder = self._recorders[-1] if self._recorders else None
        wanted_s = (recorder or self).plan.before_s
        if not wanted_s:
            return 0.0, "nothing before the trigger"
        kept_s = 0.0 if recorder is None else min(wanted_s, recorder.ring_s)
        return kept_s / wanted_s, f"{kept_s:.1f} of {wanted_s:g} s"

    def recording_text(self) -> str:
        """Text of the current or last recording, and the remaining recording time."""
        take, parts = self.running, []
        if take is not None and take.trouble:
            written = f"{pluralize(take.frames, 'frame')} written before are intact"
            lost = pluralize(take.lost, "frame")
            return f"▲ NOT RECORDED: {lost} lost; {take.trouble}. {written}"
        if take is not None:
            parts = [f"● Recording: {pluralize(take.frames, 'frame')} written, {take.lost} lost"]
        elif self.takes and not self.takes[-1].finished.is_set():
            parts = [f"Writing the rest of {self.takes[-1].path.name}"]
        elif self.takes:
            parts = [f"{self.takes[-1].path.name}: {self.takes[-1].summary.words}"]
        rate = self.rate_hz()
        if self.room_byte is not None and rate:
            room_s = self.room_byte / (self._frame_byte * rate / self.plan.every)
            parts.append(f"room for {_lasting(room_s)} ({format_bytes(self.room_byte)})")
        return capitalized("; ".join(parts))

    # --- to do --------------------------------------------------------------------------------

    def trigger(self) -> None:
        """Begin a recording, or end the current one.

        Raises
        ------
        InputError
            If the file already exists.
        """
        if not self.is_open:
            return
        with self._turn:
            recorder = self._recorders[-1]
            if recorder.running is not None:
                recorder.stop()
                return
            self.takes.append(recorder.trigger())
        if self.watch is not None:
            for event, time_s in self.watch.notes_at_start():
                recorder.note(event, time_s)

    def discard(self, take: Take) -> bool:
        """End a recording, which `close` then deletes; False if it had ended before and is kept."""
        with self._turn:
            if self.running is not take:
                return False
            self._recorders[-1].stop()
        self._reported.add(take.path)
        self._discarded.append(take)
        return True

    def mark(self) -> None:
        """Mark the current frame in the notes of the current recording."""
        self._say(Event(self.name, "note", "marked by hand"))

    def set_plan(self, plan: Plan) -> None:
        """Change the plan and discard earlier frames, now or at the end of the recording."""
        self.plan = plan
        self._is_stale = True
        self._renew()

    def _renew(self) -> None:
        """Replace the recorder if this was requested and there is no recording."""
        if not self._is_stale:
            return
        with self._turn:
            if self.feed is None or self.running is not None or self._closing.is_set():
                return
            former = self._recorders[-1]
            self._recorders.append(self._recorder(self.feed))
        # Another thread waits until it has written everything; `close` waits, too.
        threading.Thread(target=former.close, name="recorder ends", daemon=True).start()

    def apply(self, wanted: CameraSettings) -> Future[CameraSettings] | None:
        """Set the camera between two frames; the future gives the values actually set."""
        return self.feed.apply(wanted) if self.feed is not None and self.is_open else None


def measured_with(session: Session) -> tuple[Setup | None, Settings | None]:
    """Set-up and settings of a session for `Live`; both None if its pattern consists of lines."""
    if session.has_lines:
        return None, None
    try:
        return session.setup, session.settings
    except InputError:
        return None, session.settings


def _lasting(seconds: float) -> str:
    """Text of a duration; longer ones are rounded more coarsely."""
    for unit, size in (("days", 86_400), ("h", 3600), ("min", 60)):
        if seconds >= 2 * size:
            return f"{seconds / size:.0f} {unit}"
    return f"{seconds:.0f} s"
