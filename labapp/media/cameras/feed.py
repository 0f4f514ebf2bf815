"""Keeps a camera going: frames to whoever takes them, and words for all that goes wrong."""

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
from labapp.media.events import Event, Kind, Say, Tally, silent
from labapp.text import pluralize

WAIT_S = 0.1
"""So long a frame is waited for before it is seen whether the feed is to end."""

SOON_S = 0.01
"""… and so long where the next frame is taken only when it is asked for."""

SILENT_S = 2.0
"""A camera that gives no frame by itself for so long, or for 20 frames, is said to stall."""

HOPELESS_S = 6.0
"""… and after so long it is opened anew."""

RETRY_S = (0.1, 0.2, 0.5, 1.0)
"""Pauses between attempts to open a camera that is gone; the last again and again."""

State = Literal["opening", "running", "stalled", "lost", "ended"]


@dataclass(frozen=True)
class Counts:
    """What a feed has seen so far.

    Parameters
    ----------
    frames
        Whole frames handed on.
    broken
        Frames that were not whole, and were not handed on.
    dropped
        Frames that never arrived, as gaps in the camera's numbers and its driver's count tell.
    lost
        How often the camera was gone.
    """

    frames: int
    broken: int
    dropped: int
    lost: int


class Feed:
    """Frames of a camera in a thread of its own, whatever the camera does.

    A camera that is unplugged or stalls is opened again, set as it was, until `stop`; a frame that
    is not whole, of another size or type, is left out. Each is said.

    Parameters
    ----------
    name
        Of the camera, for what is said.
    opened
        Opens the camera: raises `CameraError` while it cannot.
    take
        Called with every frame, in the feed's thread: it must not wait. Frames are numbered from
        0 on; numbers of frames that did not arrive are left out, and of those there was no time for
        while the camera was set, as far as its rate tells. `CameraFrame.time_s` is the time
        since the first, by the camera's clock, and goes on when the camera is opened again.
    say
        Called with what happens.
    settings
        What the camera is set to whenever it was opened. Where no trigger is asked for it takes
        frames by itself, whatever mode it was left in.

    Raises
    ------
    InputError, CameraError
        If the camera cannot be opened, or set so, the first time.
    """

    def __init__(
        self,
        name: str,
        opened: Callable[[], Camera],
        take: Callable[[CameraFrame], None],
        say: Say = silent,
        settings: CameraSettings | None = None,
    ) -> None:
        self.name = name
        self.state: State = "opening"
        self._opened = opened
        self._take = take
        self._say = say
        wanted = settings or CameraSettings()
        self._wanted = replace(wanted, trigger=wanted.trigger or "free")
        self._ending = threading.Event()
        self._asked: queue.SimpleQueue[tuple[CameraSettings, Future[CameraSettings]]]
        self._asked = queue.SimpleQueue()
        self._pulls = threading.Semaphore(0)
        self._frames = self._lost = 0
        self._broken = Tally(
            lambda n: self._tell("loss", f"{pluralize(n, 'frame')} not whole, left out")
        )
        self._dropped = Tally(
            lambda n: self._tell("loss", f"{pluralize(n, 'frame')} lost on the way")
        )
        self._set_words = ""
        """To be said when frames come again after a setting."""
        self._arrived_s: float | None = None
        self._next = 0
        self._first_s: float | None = None
        self._last_s = 0.0
        self.camera = self._open()
        self._thread = threading.Thread(target=self._run, name=f"feed of {name}", daemon=True)
        self._thread.start()

    @property
    def counts(self) -> Counts:
        """What it has seen so far."""
        return Counts(self._frames, self._broken.total, self._dropped.total, self._lost)

    @property
    def settings(self) -> CameraSettings:
        """What the camera was set to when it was opened or set last."""
        return self._connection.settings

    @property
    def bit_depth(self) -> int:
        """Significant bits of its grey levels."""
        return self.camera.bit_depth

    def apply(self, wanted: CameraSettings) -> Future[CameraSettings]:
        """Set the camera between two frames, now and whenever it is opened again; this is said.

        It gives no frames meanwhile, of some cameras for half a second.

        Returns
        -------
        Future
            What it is set to then. `InputError` or `CameraError` where it refuses: it goes on as
            it was set before. A camera that is away is set when it is back; of a feed that has
            ended it is refused.
        """
        answer: Future[CameraSettings] = Future()
        self._asked.put((wanted, answer))
        if self.state == "ended":
            self._refuse_asked()
        return answer

    def trigger(self) -> None:
        """Have a frame taken now; without effect while it is away, or takes frames otherwise."""
        self._pulls.release()

    def stop(self) -> None:
        """Take no more frames and let go of the camera. Twice does no harm."""
        self._ending.set()
        if self._thread is not threading.current_thread():
            self._thread.join()

    def __enter__(self) -> Feed:
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()

    def _tell(self, kind: Kind, words: str) -> None:
        self._say(Event(self.name, kind, words))

    def _open(self) -> Camera:
        camera = self._opened()
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
                    self._tell_set()
                    self._lost += 1
                    self.state = "lost"
                    self._tell("warning", f"{error}. Trying to get it back")
                    self._reopen()
        except Exception as error:
            logging.getLogger("labapp").exception("feed of %s", self.name)
            self._tell("loss", f"a fault in the program ended its pictures: {error!r}")
        finally:
            self._tell_set()
            for tally in (self._broken, self._dropped):
                tally.flush(now=True)
            self.state = "ended"
            self.camera.close()
            self._refuse_asked()

    def _read_on(self) -> None:
        """Hand frames on until the camera is lost or the feed is to end."""
        heard_s = time.monotonic()
        self.state = "running"
        while not self._ending.is_set():
            self._set_asked()
            told = self._connection.settings.trigger == "software"
            while self._pulls.acquire(blocking=False):
                if told:
                    self.camera.trigger()
            try:
                frame = self.camera.read(SOON_S if told else WAIT_S)
            except BrokenFrame:
                self._leave_out()
                heard_s = time.monotonic()
                continue
            for tally in (self._broken, self._dropped):
                tally.flush()
            if frame is None:
                self._is_silent(heard_s)
                continue
            self._is_heard(frame.arrived_s - heard_s)
            heard_s = frame.arrived_s
            self._hand_on(frame)

    def _set_asked(self) -> None:
        """Set what was asked for meanwhile; numbers and times go on."""
        while not self._asked.empty():
            wanted, answer = self._asked.get()
            self._tell_set()
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
                self._wanted = replace(self._wanted, **wanted.asked())
                answer.set_result(settings)
                found = {name: getattr(settings, name) for name in wanted.asked()}
                words = f"set to {CameraSettings(**found).in_words()}"
            camera.start()
            self._connection = _Connection(camera)
            self._set_words = words
            if former.is_free and self._connection.is_free and self._arrived_s is not None:
                self._connection.former_hz = former.last_hz
            else:
                self._tell_set()

    def _tell_set(self, more: str = "") -> None:
        words, self._set_words = self._set_words, ""
        if words:
            self._tell("note", words + more)

    def _refuse_asked(self) -> None:
        with contextlib.suppress(queue.Empty):
            while True:
                self._asked.get_nowait()[1].set_exception(CameraError(f"{self.name} is closed"))

    def _is_heard(self, silent_s: float) -> None:
        if self.state == "stalled":
            self.state = "running"
            self._tell("note", f"frames come again, after {silent_s:.1f} s without")

    def _is_silent(self, heard_s: float) -> None:
        if not self._connection.is_free:
            return
        silent_s = time.monotonic() - heard_s
        longest_s = max(SILENT_S, 20 / (self._connection.settings.rate_hz or 20))
        if silent_s > longest_s + HOPELESS_S:
            raise CameraLost(f"no frame came for {silent_s:.0f} s")
        if silent_s > longest_s and self.state == "running":
            self.state = "stalled"
            self._tell("warning", f"no frame came for {silent_s:.1f} s; it is still connected")

    def _hand_on(self, frame: CameraFrame) -> None:
        known = self._connection
        if frame.image.shape != known.shape or frame.image.dtype != known.dtype:
            self._leave_out()
            return
        missing = known.missing(frame, self.camera.dropped)
        if missing > known.spoiled:
            self._dropped.add(missing - known.spoiled)
        known.spoiled = 0
        if self._set_words:
            missing += self._end_setting(frame.arrived_s)
        self._arrived_s = frame.arrived_s
        if self._first_s is None:
            self._first_s = frame.arrived_s
        if known.offset_s is None:
            # Goes on where it was: by the computer's clock, but never back.
            since_s = max(frame.arrived_s - self._first_s, self._last_s + 1e-6 * (self._next > 0))
            known.offset_s = since_s - frame.time_s
        time_s = frame.time_s + known.offset_s
        if time_s <= self._last_s and self._next:
            time_s = self._last_s + 1e-6
        number = self._next + missing
        self._next, self._last_s = number + 1, time_s
        self._frames += 1
        self._take(replace(frame, number=number, time_s=time_s))

    def _end_setting(self, arrived_s: float) -> int:
        """Say how long no frames came for a setting; how many there would have been."""
        gap_s = arrived_s - (self._arrived_s or arrived_s)
        self._tell_set(f"; {gap_s:.2f} s without frames")
        return max(0, round(gap_s * (self._connection.former_hz or 0.0)) - 1)

    def _leave_out(self) -> None:
        self._connection.spoiled += 1
        self._broken.add()

    def _reopen(self) -> None:
        """Open the camera again, however long that takes; or until the feed is to end."""
        gone_s = time.monotonic()
        told: set[str] = set()
        self.camera.close()
        for pause_s in itertools.chain(RETRY_S, itertools.repeat(RETRY_S[-1])):
            if self._ending.wait(pause_s):
                return
            try:
                self.camera = self._open()
            except CameraLost:
                continue
            except (CameraError, InputError) as error:
                if str(error) not in told:
                    told.add(str(error))
                    self._tell("warning", str(error))
                continue
            while self._pulls.acquire(blocking=False):
                pass  # of a moment that has gone
            away_s = time.monotonic() - gone_s
            self._tell("note", f"it is back after {away_s:.1f} s, set as before")
            return


class _Connection:
    """What is known of a camera from when it was opened to when it is lost."""

    def __init__(self, camera: Camera) -> None:
        self.settings = camera.settings
        columns, rows = (self.settings.region or (0, 0, *camera.limits.sensor))[2:]
        self.shape = (rows, columns)
        self.dtype = np.uint8 if camera.bit_depth <= 8 else np.uint16
        self.spoiled = 0
        """Frames that were left out since the last whole one."""
        self.offset_s: float | None = None
        self.former_hz: float | None = None
        """The rate at which frames came before it was set."""
        self._number: int | None = None
        self._overrun = 0

    @property
    def is_free(self) -> bool:
        """Whether frames come by themselves."""
        return self.settings.trigger in (None, "free")

    @property
    def last_hz(self) -> float | None:
        """The rate at which frames came last."""
        return self.former_hz if self._number is None else self.settings.rate_hz

    def missing(self, frame: CameraFrame, overrun: int) -> int:
        """How many frames should have come before this one and did not."""
        gap = 0 if self._number is None else max(0, frame.number - self._number - 1)
        more, self._overrun = max(0, overrun - self._overrun), overrun
        self._number = frame.number
        return gap + more
