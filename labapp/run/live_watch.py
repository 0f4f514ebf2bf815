"""Live measurement of a camera's frames: sizes, their trend, alarms, streams.

Data flow: the camera's thread puts a frame into the queue (`live_queue`), from which a thread of
`gui.live.live` takes the next one. It is measured in a process (`live_measuring`) by tracking, and
its `LiveResult` passed to the sinks. The window polls the newest result and surface.
"""

from __future__ import annotations

import logging
import threading
import time
from collections import deque
from collections.abc import Callable
from typing import TYPE_CHECKING

from labapp.config.setup import Setup
from labapp.core.pipeline import Measurement, Settings
from labapp.export.frame_result import FrameResult
from labapp.export.rendering.scene import Scene
from labapp.log import NAME
from labapp.media.cameras import CameraFrame
from labapp.media.events import Event
from labapp.run.alarms import RAISED, Alarm, Alarms
from labapp.run.limits import Limits
from labapp.run.live_measuring import LiveMeasuring, LiveMeasuringEnded, LiveResult
from labapp.run.live_queue import FrameQueue
from labapp.run.live_trend import LiveTrend
from labapp.run.streams import Stream, Values, stream_values

if TYPE_CHECKING:
    from labapp.export.penetration import Predictor

SILENT_S = 10.0
"""Time without a result that raises an alarm, s. Without tracking, a frame takes seconds."""

REMEDY = "To measure again, stop the camera and start it"


class LiveWatch:
    """Measures a camera's frames by tracking, and monitors the sizes.

    `take` never blocks. Call `next_frame` and `measure` from one thread, the rest from any.

    Parameters
    ----------
    on_event
        Called when an alarm is raised, over, or acknowledged, when limits or the set-up change, and
        when measuring ends because of an error, with the event and the time of its frame by the
        camera's clock, s (None: now); from any thread.
    """

    def __init__(
        self,
        name: str,
        setup: Setup,
        settings: Settings,
        bit_depth: int,
        limits: Limits,
        on_event: Callable[[Event, float | None], None],
    ) -> None:
        self.alarms, self.trend = Alarms(limits), LiveTrend()
        """Alarms; sizes of the last frames, and rate of measuring."""
        self._name, self._scheme, self._on_event = name, settings.scheme, on_event
        self._bit_depth = bit_depth
        self._measuring: LiveMeasuring | None = LiveMeasuring(setup, settings, bit_depth)
        self.stopped = ""
        """Why frames are not measured any more, and what to do; empty while they are measured."""
        self.queue = FrameQueue()
        """Frames to be measured."""
        self._newest: deque[LiveResult] = deque(maxlen=1)
        self._scene: deque[Scene] = deque(maxlen=1)
        self._turn, self._handing_on = threading.Lock(), threading.Lock()
        self._streams: dict[str, Stream] = {}
        self._is_closed = False
        self._measured_s = time.monotonic()
        """Time of the last result."""
        self._last: tuple[int, float] | None = None
        """Number and time of its frame, s by the camera's clock; None before the first."""
        self.stream_faults: dict[str, str] = {}
        """Kinds of the streams that were closed because of a fault, and the fault."""
        self._scene_is_due = threading.Event()
        self.predictor: Predictor | None = None
        """Predictor of penetration; may be replaced at any time."""
        self._sinks = (self._judge, self.trend.add, self._predict, self._show, self._publish)

    def take(self, frame: CameraFrame) -> None:
        """Queue a frame of the camera; never blocks."""
        self.queue.put(frame)

    def close(self) -> None:
        """End the measuring, and the streams. May be called twice."""
        with self._turn:
            self._is_closed = True  # no alarm when measuring ends
            streams, self._streams = self._streams, {}
        with self._handing_on:
            measuring, self._measuring = self._measuring, None
        if measuring is not None:
            measuring.close()
        for stream in streams.values():
            stream.close()

    # --- in the measuring thread --------------------------------------------------------------

    def next_frame(self) -> CameraFrame | None:
        """Return the next frame to be measured; None if there is none (`FrameQueue`)."""
        frame = self.queue.next()
        if frame is None:
            self._check_silence()
        return frame

    def measure(self, frame: CameraFrame) -> None:
        """Measure a frame and pass the result to all sinks, or skip it (`LiveMeasuring`).

        After an error, which is reported, nothing is measured until the set-up changes.
        """
        with_scene, began_s = self._scene_is_due.is_set(), time.monotonic()
        measuring = self._measuring
        if measuring is None:
            return
        try:
            result = measuring.measure(frame, with_scene)
            is_tracked = result is not None and result.track_lost is None
            self.queue.done(is_tracked, time.monotonic() - began_s)
            with self._handing_on:
                if result is not None and measuring is self._measuring:
                    for sink in self._sinks:
                        sink(result)
        except Exception as error:
            self._stop(measuring, error)

    def _stop(self, measuring: LiveMeasuring, error: Exception) -> None:
        """End the measuring because of an error, and report it."""
        reason = str(error)
        if not isinstance(error, LiveMeasuringEnded):
            reason = f"a fault in the program: {error!r}; details are in the log"
        words = f"Nothing is measured any more: {reason}. {REMEDY}"
        with self._handing_on:
            if measuring is not self._measuring:
                return  # the set-up was changed, or this was closed
            self._measuring, self.stopped = None, words
            self._measured_s = float("inf")  # this is the reason for the silence
            # Within the lock: a new set-up must not be followed by these.
            self._on_event(Event(self._name, "warning", words), None)
            self._raise_silence(words)
        logging.getLogger(NAME).error("live figures", exc_info=error)
        measuring.close()

    def _judge(self, result: LiveResult) -> None:
        """Raise alarms, or end them."""
        self._measured_s, self._last = time.monotonic(), (result.frame, result.time_s)
        found = result.measurement
        for alarm in self.alarms.judge(
            *self._last, found.measures, found.reason, result.setup_doubt
        ):
            self._on_event(self._changed(alarm), result.time_s)

    def _predict(self, result: LiveResult) -> None:
        predictor = self.predictor
        if predictor is not None:
            predictor.add(result)

    def _show(self, result: LiveResult) -> None:
        """Store the result and its surface for `newest` and `scene`."""
        if result.scene is not None:
            self._scene_is_due.clear()
            self._scene.append(result.scene)
        self._newest.append(result)

    def _check_silence(self) -> None:
        silent_s = time.monotonic() - self._measured_s
        if silent_s > SILENT_S:
            self._measured_s = float("inf")  # once
            self._raise_silence(f"No frame has been measured for {silent_s:.0f} s")

    def _raise_silence(self, words: str) -> None:
        for alarm in self.alarms.silence(words):
            self._on_event(self._changed(alarm), None)
        self._publish_silence(words)

    def _publish_silence(self, reason: str) -> None:
        frame, time_s = self._last or (0, None)
        silence = FrameResult(frame, time_s, Measurement("silent", reason, self._scheme))
        values = stream_values(silence, self.alarms.shown)
        self._send(values if self._last else {**values, "frame": None})

    def _publish(self, result: LiveResult) -> None:
        predictor = self.predictor
        predicted = {} if predictor is None else predictor.values()
        self._send({**stream_values(result, self.alarms.shown), **predicted})

    def _send(self, values: Values) -> None:
        """Send values by all streams; a faulty one is closed, and this is reported."""
        closed: list[Stream] = []
        with self._turn:  # no stream may be closed during this
            for kind, stream in list(self._streams.items()):
                try:
                    stream.publish(values)
                except Exception as error:  # measuring and the other streams continue
                    logging.getLogger(NAME).error("stream %s", kind, exc_info=error)
                    self.stream_faults[kind] = (
                        f"a fault in the program: {error!r}; details are in the log"
                    )
                    closed.append(self._streams.pop(kind))
        for stream in closed:
            words = f"the stream at {stream.address} is closed because of a fault: see the log"
            self._on_event(Event(self._name, "warning", words), None)
            # It may wait for its clients, or not end at all.
            threading.Thread(target=stream.close, name="stream ends", daemon=True).start()

    # --- results ------------------------------------------------------------------------------

    def newest(self) -> LiveResult | None:
        """Return the last result; None if it was returned before."""
        return self._newest.popleft() if self._newest else None

    def ask_for_scene(self) -> None:
        """Request the surface of the next measured frame for drawing."""
        self._scene_is_due.set()

    def scene(self) -> Scene | None:
        """Return the requested surface; None if it is not available yet or was returned before."""
        return self._scene.popleft() if self._scene else None

    def stream(self, kind: str) -> Stream | None:
        """Return the open stream of a kind, if any."""
        return self._streams.get(kind)

    def notes_at_start(self) -> list[tuple[Event, float | None]]:
        """Return events for the notes of a new recording: limits, and alarms that hold."""
        limits = self.alarms.limits
        events: list[tuple[Event, float | None]] = []
        if limits.are_set:
            events.append((Event(self._name, "note", f"limits: {limits.words}"), None))
        for alarm in self.alarms.shown:
            if alarm.holds:
                words = f"{RAISED}{alarm.description}"
                events.append((Event(self._name, "warning", words), alarm.time_s))
        return events

    # --- changes ------------------------------------------------------------------------------

    def set_setup(self, setup: Setup | None, settings: Settings | None) -> None:
        """Measure the next frames with another set-up or other settings; None: measure none.

        Results of the former ones are discarded; recordings, alarms and streams continue. Streams
        are sent that the sizes are unknown until the next result.
        """
        made = None
        if setup is not None and settings is not None:
            made = LiveMeasuring(setup, settings, self._bit_depth)
            self._scheme = settings.scheme
        words = "nothing is measured" if made is None else "frames are measured with the new ones"
        words = f"set-up or settings changed: {words}"
        with self._handing_on:
            former, self._measuring = self._measuring, None if self._is_closed else made
            self._measured_s, self.stopped = time.monotonic(), ""
            self._newest.clear()
            self._scene.clear()
            self.trend.clear()
            self._publish_silence(words)
        for each in (former, made):
            if each is not None and each is not self._measuring:
                # The caller must not wait until the process has ended.
                threading.Thread(target=each.close, name="measuring ends", daemon=True).start()
        self._on_event(Event(self._name, "note", words), None)

    def set_limits(self, limits: Limits) -> None:
        """Replace the limits from the next frame on."""
        if limits != self.alarms.limits:
            for alarm in self.alarms.set_limits(limits):
                self._on_event(self._changed(alarm), None)
            self._on_event(Event(self._name, "note", f"limits now: {limits.words}"), None)

    def acknowledge(self) -> None:
        """Acknowledge all alarms."""
        for alarm in self.alarms.acknowledge():
            words = f"alarm acknowledged: {alarm.description}"
            self._on_event(Event(self._name, "note", words), None)

    def set_stream(self, kind: str, stream: Stream | None) -> None:
        """Replace the stream of a kind, which is closed; None: only close it."""
        with self._turn:
            former = self._streams.pop(kind, None)
            self.stream_faults.pop(kind, None)
            if stream is not None and not self._is_closed:
                self._streams[kind], stream = stream, None
        for each in (former, stream):
            if each is not None:
                each.close()

    def _changed(self, alarm: Alarm) -> Event:
        """Return the event for an alarm that is raised or over."""
        if alarm.holds:
            return Event(self._name, "warning", f"{RAISED}{alarm.words} (frame {alarm.frame})")
        return Event(self._name, "note", f"alarm over: {alarm.description}")
