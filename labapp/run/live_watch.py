"""Frames of a live camera measured while they come: figures, their trend, alarms, who is told."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from itertools import takewhile
from typing import NamedTuple

import numpy as np

from labapp.config.setup import Setup
from labapp.core.pipeline import Measurement, Settings
from labapp.core.values import BoolArray, FloatArray, IntArray, freeze
from labapp.export.frame_result import FrameResult
from labapp.export.scene import Scene
from labapp.media.cameras import CameraFrame
from labapp.media.events import Event, Kind
from labapp.run.alarms import Alarm, Alarms
from labapp.run.limits import NAMES, Limits, Size, beyond, sizes_of
from labapp.run.live_measuring import LiveMeasurement, LiveMeasuring
from labapp.run.live_queue import FrameQueue
from labapp.run.streams import Stream, live_values

RATE_S = 2.0
"""Rates are those of so long."""

TREND_S = 120.0
"""The trend goes back so far."""

MOST_KEPT = 12_000
"""Frames of the trend at most: a hundred a second."""

SILENT_S = 10.0
"""No figure for so long is an alarm. A frame that is measured by itself takes seconds."""


@dataclass(frozen=True)
class Followed:
    """A frame of the camera, and what it gave.

    Parameters
    ----------
    number, time_s
        The camera's number of it, and its time by the camera's clock, s.
    arrived_s
        `time.monotonic` when it came, s: the figures are as old.
    found
        What it gave.
    """

    number: int
    time_s: float
    arrived_s: float
    found: LiveMeasurement

    @property
    def sizes(self) -> tuple[Size, Size, Size]:
        """Width, length and height."""
        return sizes_of(self.found.measures)


@dataclass(frozen=True)
class Trend:
    """Sizes of the last frames that were tried; n frames, the oldest first.

    Parameters
    ----------
    names
        What the three sizes are: the last is ``height``, or of a hollow pool ``depth``.
    number
        The camera's numbers of them, shape (n,).
    since_s
        When they came, from now on and so negative, shape (n,), s.
    value_mm, sigma_mm
        Of width, length and height, shape (3, n); NaN where they are not known.
    beyond
        Which of them are beyond a limit, shape (3, n).
    """

    names: tuple[str, ...]
    number: IntArray
    since_s: FloatArray
    value_mm: FloatArray
    sigma_mm: FloatArray
    beyond: BoolArray

    def __post_init__(self) -> None:
        freeze(self)


@dataclass(frozen=True)
class Pace:
    """How measuring keeps up, of late.

    Parameters
    ----------
    measured_hz
        Frames measured a second.
    tried, failed
        How many frames were tried, and of them could not be measured.
    """

    measured_hz: float
    tried: int
    failed: int


class _Past(NamedTuple):
    """What the trend keeps of a frame: numbers alone, for there are thousands.

    Sizes are their values and then their σ, shape (6,).
    """

    done_s: float
    arrived_s: float
    number: int
    is_measured: bool
    sizes_mm: tuple[float, ...]


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
        self.alarms = Alarms(limits)
        self._name, self._scheme, self._say = name, settings.scheme, say
        self._measuring = LiveMeasuring(setup, settings, bit_depth)
        self._queue = FrameQueue()
        self._newest: deque[Followed] = deque(maxlen=1)
        self._scene: deque[Scene] = deque(maxlen=1)
        self._past: deque[_Past] = deque(maxlen=MOST_KEPT)
        self._turn = threading.Lock()
        self._streams: dict[str, Stream] = {}
        self._is_closed = False
        self._heard_s, self._last = time.monotonic(), (0, 0.0)
        self._names: tuple[str, ...] = NAMES
        self._is_drawn = threading.Event()

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
            found = self._measuring.measure(frame.image, drawn)
        except Exception as error:
            if not self._is_closed:
                self._fall_silent(f"Nothing is measured any more: {error}")
            raise
        if found is None:
            self._queue.done(False, time.monotonic() - began_s)
            return
        if found.scene is not None:
            self._is_drawn.clear()
            self._scene.append(found.scene)
        self._queue.done(found.followed, time.monotonic() - began_s)
        followed = Followed(frame.number, frame.time_s, frame.arrived_s, found)
        for alarm in self.alarms.judge(frame.number, frame.time_s, found.measures, found.reason):
            self._say(Event(self._name, *_told(alarm)), frame.time_s)
        done_s, sizes = time.monotonic(), followed.sizes
        self._heard_s = done_s
        numbers = (*(s.value_mm for s in sizes), *(s.sigma_mm for s in sizes))
        is_measured = found.measures is not None
        if is_measured:
            self._names = tuple(size.name for size in sizes)
        with self._turn:
            past = _Past(done_s, frame.arrived_s, frame.number, is_measured, numbers)
            self._past.append(past)
            while self._past[0].done_s < done_s - TREND_S:
                self._past.popleft()
        self._newest.append(followed)
        measured = Measurement(found.status, found.reason, self._scheme, measures=found.measures)
        self._last = frame.number, frame.time_s
        self._tell(measured)

    def _heed_silence(self) -> None:
        """Raise an alarm, and tell it, where no figure has come for long."""
        silent_s = time.monotonic() - self._heard_s
        if silent_s > SILENT_S:
            self._heard_s = float("inf")
            self._fall_silent(f"No frame has been measured for {silent_s:.0f} s")

    def _fall_silent(self, words: str) -> None:
        for alarm in self.alarms.silence(words):
            self._say(Event(self._name, *_told(alarm)), None)
        self._tell(Measurement("silent", words, self._scheme))

    def _tell(self, measured: Measurement) -> None:
        values = live_values(FrameResult(*self._last, measured), self.alarms.shown)
        with self._turn:  # one that is told must not be closed meanwhile
            for stream in self._streams.values():
                stream.publish(values)

    # --- to look at ---------------------------------------------------------------------------

    def newest(self) -> Followed | None:
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

    def pace(self) -> Pace:
        """How measuring keeps up."""
        since_s = time.monotonic() - RATE_S
        with self._turn:
            late = list(takewhile(lambda each: each.done_s > since_s, reversed(self._past)))
        failed = sum(not each.is_measured for each in late)
        return Pace((len(late) - failed) / RATE_S, len(late), failed)

    def trend(self, last_s: float) -> Trend:
        """Sizes of the frames that came in the last so many seconds."""
        now_s, limits = time.monotonic(), self.alarms.limits
        with self._turn:
            late = [each for each in self._past if each.arrived_s > now_s - last_s]

        sizes = np.array([each.sizes_mm for each in late], float).reshape(len(late), 6).T
        value, sigma = sizes[:3], sizes[3:]
        return Trend(
            self._names,
            np.array([each.number for each in late], np.int64),
            np.array([each.arrived_s for each in late], float) - now_s,
            value,
            sigma,
            np.array([beyond(value[k], sigma[k], limits.of(n)) for k, n in enumerate(NAMES)]),
        )

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
