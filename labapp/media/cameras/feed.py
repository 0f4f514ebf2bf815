"""Continuous acquisition from a camera, with reconnection after faults."""

from __future__ import annotations

import contextlib
import itertools
import logging
import queue
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from labapp.errors import InputError
from labapp.media.cameras.base import (
    BrokenFrame,
    Camera,
    CameraError,
    CameraFrame,
    CameraLost,
    CameraSettings,
)
from labapp.media.events import Event, Kind, OnEvent, Tally, ignore_event
from labapp.text import pluralize

WAIT_S = 0.1
"""Timeout for a frame before `stop` is checked, s."""

SOON_S = 0.01
"""The same with a software trigger, s."""

SILENT_S = 2.0
"""Time without a frame after which a free-running camera is stalled, s; at least 20 frames."""

HOPELESS_S = 6.0
"""Further time after which it is opened again, s."""

RETRY_S = (0.1, 0.2, 0.5, 1.0)
"""Pauses between attempts to open a lost camera; the last is repeated."""

State = Literal["opening", "running", "stalled", "lost", "ended"]


@dataclass(frozen=True)
class Counts:
    """Counts of a feed so far."""

    frames: int
    """Complete frames delivered."""
    broken: int
    """Incomplete frames, which were discarded."""
    dropped: int
    """Frames that never arrived, by gaps in the camera's numbers and its driver's count."""
    lost: int
    """Number of times that the camera was lost."""


class Feed:
    """Acquisition thread of a camera.

    A camera that is unplugged or stalls is opened again with the same settings, until `stop`;
    incomplete frames, or frames of another size or type, are discarded. Each raises an event.

    Parameters
    ----------
    opener
        Opens the camera, or raises `CameraError`.
    on_frame
        Called with every frame, in the feed's thread; it must not block. Frames are numbered from
        0 on; the numbers of frames that did not arrive are skipped, and those of the frames missed
        during a change of settings, if the rate is known. `CameraFrame.time_s` is the time since
        the first frame, by the camera's clock, continued when the camera is opened again.
    settings
        Settings applied whenever the camera is opened. Without a trigger it is free-running,
        whatever its previous mode.

    Raises
    ------
    InputError, CameraError
        If the camera cannot be opened or set the first time.
    """

    def __init__(
        self,
        name: str,
        opener: Callable[[], Camera],
        on_frame: Callable[[CameraFrame], None],
        on_event: OnEvent = ignore_event,
        settings: CameraSettings | None = None,
    ) -> None:
        self.name = name
        self.state: State = "opening"
        self._opener = opener
        self._on_frame = on_frame
        self._on_event = on_event
        wanted = settings or CameraSettings()
        self._wanted = replace(wanted, trigger=wanted.trigger or "free")
        self._ending = threading.Event()
        self._requests: queue.SimpleQueue[tuple[CameraSettings, Future[CameraSettings]]]
        self._requests = queue.SimpleQueue()
        self._triggers = threading.Semaphore(0)
        self._frames = self._lost = 0
        self._broken = Tally(
            lambda n: self._emit("loss", f"{pluralize(n, 'frame')} incomplete, discarded")
        )
        self._dropped = Tally(
            lambda n: self._emit("loss", f"{pluralize(n, 'frame')} lost in transfer")
        )
        self._setting_message = ""
        """Event to be raised when frames arrive after a change of settings."""
        self._arrived_s: float | None = None
        self._next = 0
        self._first_s: float | None = None
        self._last_s = 0.0
        self.camera = self._open()
        self._thread = threading.Thread(target=self._run, name=f"feed of {name}", daemon=True)
        self._thread.start()

    @property
    def counts(self) -> Counts:
        """Counts so far."""
        return Counts(self._frames, self._broken.total, self._dropped.total, self._lost)

    @property
    def settings(self) -> CameraSettings:
        """Settings of the camera when it was last opened or set."""
        return self._connection.settings

    @property
    def bit_depth(self) -> int:
        """Significant bits of its grey levels."""
        return self.camera.bit_depth

    def apply(self, wanted: CameraSettings) -> Future[CameraSettings]:
        """Apply settings between two frames, and again whenever the camera is opened.

        Acquisition is interrupted, with some cameras for half a second.

        Returns
        -------
        Future
            The resulting settings; or `InputError` or `CameraError` if they are rejected, in which
            case the former settings remain. A lost camera is set when it is back. After the end of
            the feed it is a `CameraError`.
        """
        answer: Future[CameraSettings] = Future()
        self._requests.put((wanted, answer))
        if self.state == "ended":
            self._refuse_requests()
        return answer

    def trigger(self) -> None:
        """Trigger a frame; no effect while the camera is lost or not triggered by software."""
        self._triggers.release()

    def stop(self) -> None:
        """Stop and close the camera. May be called twice."""
        self._ending.set()
        if self._thread is not threading.current_thread():
            self._thread.join()

    def __enter__(self) -> Feed:
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()

    def _emit(self, kind: Kind, words: str, passes: bool = False) -> None:
        self._on_event(Event(self.name, kind, words, passes))

    def _open(self) -> Camera:
        camera = self._opener()
        try:
            camera.apply(self._wanted)
            camera.start()
        except BaseException:
            camera.close()
            raise
        self._connection = _Connection(camera)
        return camera

    def _run(self) -> None:
        try:
            while not self._ending.is_set():
                try:
                    self._read_on()
                except CameraError as error:
                    self._emit_set()
                    self._lost += 1
                    self.state = "lost"
                    self._emit("warning", f"{error}. Trying to get it back", passes=True)
                    self._reopen()
        except Exception as error:
            logging.getLogger("labapp").exception("feed of %s", self.name)
            self._emit("loss", f"a fault in the program ended its pictures: {error!r}")
        finally:
            self._emit_set()
            for tally in (self._broken, self._dropped):
                tally.flush(now=True)
            self.state = "ended"
            self.camera.close()
            self._refuse_requests()

    def _read_on(self) -> None:
        """Deliver frames until the camera is lost or the feed is stopped."""
        last_s = time.monotonic()
        self.state = "running"
        while not self._ending.is_set():
            self._apply_requests()
            by_software = self._connection.settings.trigger == "software"
            while self._triggers.acquire(blocking=False):
                if by_software:
                    self.camera.trigger()
            try:
                frame = self.camera.read(SOON_S if by_software else WAIT_S)
            except BrokenFrame:
                self._leave_out()
                last_s = time.monotonic()
                continue
            for tally in (self._broken, self._dropped):
                tally.flush()
            if frame is None:
                self._check_stall(last_s)
                continue
            self._end_stall(frame.arrived_s - last_s)
            last_s = frame.arrived_s
            self._deliver(frame)

    def _apply_requests(self) -> None:
        """Apply requested settings; frame numbers and times continue."""
        while not self._requests.empty():
            wanted, answer = self._requests.get()
            self._emit_set()
            camera, former = self.camera, self._connection
            camera.stop()
            try:
                settings = camera.apply(wanted)
            except (CameraError, InputError) as error:
                answer.set_exception(error)
                if isinstance(error, CameraLost):
                    raise
                words = "it could not be set, and goes on as it was"
            else:
                self._wanted = replace(self._wanted, **wanted.specified())
                answer.set_result(settings)
                found = {name: getattr(settings, name) for name in wanted.specified()}
                words = f"set to {CameraSettings(**found).describe()}"
            camera.start()
            self._connection = _Connection(camera)
            self._setting_message = words
            if former.is_free and self._connection.is_free and self._arrived_s is not None:
                self._connection.former_hz = former.last_hz
            else:
                self._emit_set()

    def _emit_set(self, more: str = "") -> None:
        words, self._setting_message = self._setting_message, ""
        if words:
            self._emit("note", words + more)

    def _refuse_requests(self) -> None:
        with contextlib.suppress(queue.Empty):
            while True:
                self._requests.get_nowait()[1].set_exception(CameraError(f"{self.name} is closed"))

    def _end_stall(self, silent_s: float) -> None:
        if self.state == "stalled":
            self.state = "running"
            self._emit("note", f"frames come again, after {silent_s:.1f} s without")

    def _check_stall(self, last_s: float) -> None:
        if not self._connection.is_free:
            return
        silent_s = time.monotonic() - last_s
        longest_s = max(SILENT_S, 20 / (self._connection.settings.rate_hz or 20))
        if silent_s > longest_s + HOPELESS_S:
            raise CameraLost(f"no frame came for {silent_s:.0f} s")
        if silent_s > longest_s and self.state == "running":
            self.state = "stalled"
            words = f"no frame came for {silent_s:.1f} s; it is still connected"
            self._emit("warning", words, passes=True)

    def _deliver(self, frame: CameraFrame) -> None:
        known = self._connection
        if frame.image.shape != known.shape or frame.image.dtype != known.dtype:
            self._leave_out()
            return
        missing = known.missing(frame, self.camera.dropped)
        if missing > known.spoiled:
            self._dropped.add(missing - known.spoiled)
        known.spoiled = 0
        if self._setting_message:
            missing += self._end_setting(frame.arrived_s)
        self._arrived_s = frame.arrived_s
        if self._first_s is None:
            self._first_s = frame.arrived_s
        if known.offset_s is None:
            # Continued by the computer's clock, but never backwards.
            since_s = max(frame.arrived_s - self._first_s, self._last_s + 1e-6 * (self._next > 0))
            known.offset_s = since_s - frame.time_s
        time_s = frame.time_s + known.offset_s
        if time_s <= self._last_s and self._next:
            time_s = self._last_s + 1e-6
        number = self._next + missing
        self._next, self._last_s = number + 1, time_s
        self._frames += 1
        self._on_frame(replace(frame, number=number, time_s=time_s))

    def _end_setting(self, arrived_s: float) -> int:
        """Raise the event of a change of settings; returns the number of frames missed."""
        gap_s = arrived_s - (self._arrived_s or arrived_s)
        self._emit_set(f"; {gap_s:.2f} s without frames")
        return max(0, round(gap_s * (self._connection.former_hz or 0.0)) - 1)

    def _leave_out(self) -> None:
        self._connection.spoiled += 1
        self._broken.add()

    def _reopen(self) -> None:
        """Open the camera again, with retries until it succeeds or the feed is stopped."""
        gone_s = time.monotonic()
        reported: set[str] = set()
        self.camera.close()
        for pause_s in itertools.chain(RETRY_S, itertools.repeat(RETRY_S[-1])):
            if self._ending.wait(pause_s):
                return
            try:
                self.camera = self._open()
            except CameraLost:
                continue
            except (CameraError, InputError) as error:
                if str(error) not in reported:
                    reported.add(str(error))
                    self._emit("warning", str(error), passes=True)
                continue
            while self._triggers.acquire(blocking=False):
                pass  # outdated triggers
            away_s = time.monotonic() - gone_s
            self._emit("note", f"it is back after {away_s:.1f} s, set as before")
            return


class _Connection:
    """State of a camera from its opening to its loss."""

    def __init__(self, camera: Camera) -> None:
        self.settings = camera.settings
        columns, rows = (self.settings.region or (0, 0, *camera.limits.sensor))[2:]
        self.shape = (rows, columns)
        self.dtype = np.uint8 if camera.bit_depth <= 8 else np.uint16
        self.spoiled = 0
        """Frames discarded since the last complete one."""
        self.offset_s: float | None = None
        self.former_hz: float | None = None
        """Frame rate before the change of settings."""
        self._number: int | None = None
        self._overrun = 0

    @property
    def is_free(self) -> bool:
        """Whether the camera is free-running."""
        return self.settings.trigger in (None, "free")

    @property
    def last_hz(self) -> float | None:
        """Last frame rate, Hz."""
        return self.former_hz if self._number is None else self.settings.rate_hz

    def missing(self, frame: CameraFrame, overrun: int) -> int:
        """Return the number of frames missing before this one."""
        gap = 0 if self._number is None else max(0, frame.number - self._number - 1)
        more, self._overrun = max(0, overrun - self._overrun), overrun
        self._number = frame.number
        return gap + more
