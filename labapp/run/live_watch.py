"""Frames of a live camera measured while they come: figures, their trend, alarms, who is told."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable

from labapp.config.setup import Setup
from labapp.core.pipeline import Measurement, Settings
from labapp.export.frame_result import FrameResult
from labapp.export.scene import Scene
from labapp.media.cameras import CameraFrame
from labapp.media.events import Event, Kind
from labapp.run.alarms import Alarm, Alarms
from labapp.run.limits import Limits
from labapp.run.live_measuring import LiveMeasuring, LiveResult
from labapp.run.live_queue import FrameQueue
from labapp.run.live_trend import LiveTrend
from labapp.run.streams import Stream, live_values

SILENT_S = 10.0
"""No figure for so long is an alarm. A frame that is measured by itself takes seconds."""


class LiveWatch:
    """Measures a camera's frames as they come, each from the one before, and watches the sizes.

    `take` never waits. `next_frame` and `measure` belong into one thread; what is looked at may be
    looked at from any.

    Parameters
    ----------
    name
        Of the camera, for what is said.
    setup, settings, bit_depth
        As of `LiveMeasuring`.
    limits
        Of the sizes.
    say
        Called with alarms that are raised, over, or acknowledged, and with other limits, and the
        time of the frame by the camera's clock, s (None: now); from any thread.

    Attributes
    ----------
    alarms
        What is watched, and what the operator must see.
    trend
        Sizes of the last frames, and how measuring keeps up.
    """

    def __init__(
        self,
        name: str,
        setup: Setup,
        settings: Settings,
        bit_depth: int,
        limits: Limits,
        say: Callable[[Event, float | None], None],
    ) -> None:
        self.alarms, self.trend = Alarms(limits), LiveTrend()
        self._name, self._scheme, self._say = name, settings.scheme, say
        self._measuring = LiveMeasuring(setup, settings, bit_depth)
        self._queue = FrameQueue()
        self._newest: deque[LiveResult] = deque(maxlen=1)
        self._scene: deque[Scene] = deque(maxlen=1)
        self._turn = threading.Lock()
        self._streams: dict[str, Stream] = {}
        self._is_closed = False
        self._heard_s, self._last = time.monotonic(), (0, 0.0)
        self._is_drawn = threading.Event()
        self._sinks = (self._judge, self.trend.add, self._show, self._tell)

    def take(self, frame: CameraFrame) -> None:
        """Take a frame of the camera; never waits."""
        self._queue.put(frame)

    def close(self) -> None:
        """End the measuring, whatever it is at, and who is told is told so. Twice does no harm."""
        with self._turn:
            self._is_closed = True  # that measuring ends now is no alarm
            streams, self._streams = self._streams, {}
        self._measuring.close()
        for stream in streams.values():
            stream.close()

    # --- in a thread of its own ---------------------------------------------------------------

    def next_frame(self) -> CameraFrame | None:
        """The next frame to be measured; None while there is none (`FrameQueue`)."""
        frame = self._queue.next()
        if frame is None:
            self._heed_silence()
        return frame

    def measure(self, frame: CameraFrame) -> None:
        """Measure a frame, watch its sizes, and tell them; or leave it out (`LiveMeasuring`).

        Raises
        ------
        LiveMeasuringEnded
            If the process that measures has ended.
        """
        drawn, began_s = self._is_drawn.is_set(), time.monotonic()
        try:
            result = self._measuring.measure(frame, drawn)
        except Exception as error:
            if not self._is_closed:
                self._fall_silent(f"Nothing is measured any more: {error}")
            raise
        is_followed = result is not None and result.track_lost is None
        self._queue.done(is_followed, time.monotonic() - began_s)
        if result is not None:
            for sink in self._sinks:
                sink(result)

    def _judge(self, result: LiveResult) -> None:
        """Raise alarms, or end them."""
        self._heard_s, self._last = time.monotonic(), (result.frame, result.time_s)
        found = result.measurement
        for alarm in self.alarms.judge(*self._last, found.measures, found.reason):
            self._say(Event(self._name, *_told(alarm)), result.time_s)

    def _show(self, result: LiveResult) -> None:
        """Keep the result, and its surface, until they are looked at."""
        if result.scene is not None:
            self._is_drawn.clear()
            self._scene.append(result.scene)
        self._newest.append(result)

    def _heed_silence(self) -> None:
        """Raise an alarm, and tell it, where no figure has come for long."""
        silent_s = time.monotonic() - self._heard_s
        if silent_s > SILENT_S:
            self._heard_s = float("inf")
            self._fall_silent(f"No frame has been measured for {silent_s:.0f} s")

    def _fall_silent(self, words: str) -> None:
        for alarm in self.alarms.silence(words):
            self._say(Event(self._name, *_told(alarm)), None)
        self._tell(FrameResult(*self._last, Measurement("silent", words, self._scheme)))

    def _tell(self, result: FrameResult) -> None:
        values = live_values(result, self.alarms.shown)
        with self._turn:  # one that is told must not be closed meanwhile
            for stream in self._streams.values():
                stream.publish(values)

    # --- to look at ---------------------------------------------------------------------------

    def newest(self) -> LiveResult | None:
        """The frame measured last; None if it was given already."""
        return self._newest.popleft() if self._newest else None

    def ask_for_scene(self) -> None:
        """Have the surface of the next frame that is measured be drawn, too: once."""
        self._is_drawn.set()

    def scene(self) -> Scene | None:
        """The surface that was asked for; None before it is there, and if it was given already."""
        return self._scene.popleft() if self._scene else None

    def stream(self, kind: str) -> Stream | None:
        """What tells by this kind; None: nothing does."""
        return self._streams.get(kind)

    # --- to do --------------------------------------------------------------------------------

    def standing(self) -> list[tuple[Event, float | None]]:
        """What a recording that begins is to be told: the limits, and the alarms that hold."""
        limits = self.alarms.limits
        told: list[tuple[Event, float | None]] = []
        if limits.are_set:
            told.append((Event(self._name, "note", f"limits: {limits.words}"), None))
        for alarm in self.alarms.shown:
            if alarm.holds:
                told.append((Event(self._name, "warning", f"ALARM: {alarm.told}"), alarm.time_s))
        return told

    def set_limits(self, limits: Limits) -> None:
        """Watch other limits from the next frame on, which is said."""
        if limits != self.alarms.limits:
            for alarm in self.alarms.set_limits(limits):
                self._say(Event(self._name, *_told(alarm)), None)
            self._say(Event(self._name, "note", f"limits now: {limits.words}"), None)

    def acknowledge(self) -> None:
        """Take it that the operator has seen all alarms."""
        for alarm in self.alarms.acknowledge():
            self._say(Event(self._name, "note", f"alarm acknowledged: {alarm.told}"), None)

    def tell_by(self, kind: str, stream: Stream | None) -> None:
        """Tell every frame that is measured by a stream in place of the one of its kind.

        That one is closed; `close` closes all. None tells no more by that kind.
        """
        with self._turn:
            former = self._streams.pop(kind, None)
            if stream is not None and not self._is_closed:
                self._streams[kind], stream = stream, None
        for each in (former, stream):
            if each is not None:
                each.close()


def _told(alarm: Alarm) -> tuple[Kind, str]:
    """How bad it is that an alarm has changed, and that in words."""
    if alarm.holds:
        return "warning", f"ALARM: {alarm.words} (frame {alarm.frame})"
    return "note", f"alarm over: {alarm.told}"
