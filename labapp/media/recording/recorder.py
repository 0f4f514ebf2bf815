"""Recorder of camera frames with a pre-trigger buffer, which never waits for the disk.

A queue passes frames to a writing thread; queue and ring buffer share a limited memory.
"""

from __future__ import annotations

import itertools
import logging
import os
import re
import sys
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from labapp.errors import InputError
from labapp.media.cameras.base import CameraFrame
from labapp.media.events import Event, Kind, OnEvent, Tally, ignore_event
from labapp.media.recording.nut import TICKS_HZ, Codec, NutWriter, WrongFrame
from labapp.media.recording.take_files import Note, Take, TakeFiles, notes_of
from labapp.text import pluralize

FRAME_BYTE = 200
"""Approximate memory of a frame besides its grey levels."""

SWITCH_S = 5e-4
"""Switch interval of Python's threads, s; with the default of 5 ms, 200 frames/s could not be
written while a window is drawn."""

STALL_S = 1.0
"""Time to write a frame from which the disk is reported as stalled, s."""

RATE_HZ = 25.0
"""Frame rate in the video's header if that of the camera is unknown."""


@dataclass(frozen=True)
class Plan:
    """Settings of a recording.

    Raises
    ------
    InputError
        If a value is out of range.
    """

    before_s: float = 0.0
    """Time recorded before the trigger, s."""
    after_s: float | None = None
    """Duration from the first frame after the trigger, s; None: until stopped."""
    every: int = 1
    """Record every n-th frame."""
    codec: Codec = "raw"
    """``raw``, or ``ffv1``: less than half the size, but some 4 ms of a core per 640×480 frame."""
    memory_mb: float = 512.0
    """Memory for frames from before the trigger and frames not written yet, MB."""

    def __post_init__(self) -> None:
        problems = [
            InputError("recording", name, value, expected)
            for name, value, right, expected in (
                ("before_s", self.before_s, 0 <= self.before_s <= 3600, "0 to 3600 (s)"),
                ("after_s", self.after_s, (self.after_s or 0) >= 0, "0 or more (s), or None"),
                ("every", self.every, self.every >= 1, "1 or more"),
                ("codec", self.codec, self.codec in ("ffv1", "raw"), "ffv1 or raw"),
                ("memory_mb", self.memory_mb, self.memory_mb >= 1, "1 or more (MB)"),
            )
            if not right
        ]
        if problems:
            raise InputError.gather(problems)


_Item = tuple[Take, CameraFrame | Note | None]
"""Task of the writer: a frame or a note of a recording, or None to end it."""


class Recorder:
    """Records frames of a camera, with a buffer of those before the trigger.

    `take` never blocks: frames are queued in memory, and dropped, with an event, only when that is
    full. The methods may be called from any thread.

    Parameters
    ----------
    new_path
        Returns the path of a new recording; it and its notes must not exist.
    writer
        Opens the file of a recording: (path, shape, bit_depth, rate_hz, codec).
    """

    def __init__(
        self,
        new_path: Callable[[], Path],
        plan: Plan,
        bit_depth: int,
        rate_hz: float | None,
        on_event: OnEvent = ignore_event,
        writer: Callable[..., NutWriter] = NutWriter,
    ) -> None:
        self.plan = plan
        self.takes: list[Take] = []
        self._new_path = new_path
        self._bit_depth = bit_depth
        self._rate_hz = (rate_hz or RATE_HZ) / plan.every
        self._on_event = on_event
        self._open = writer
        self._memory_byte = round(plan.memory_mb * 1e6)
        self._condition = threading.Condition()
        self._ring: deque[CameraFrame] = deque()
        self._queue: deque[_Item] = deque()
        self._held_byte = 0
        self._newest_s = 0.0
        self.running: Take | None = None
        """The present recording."""
        self._closing = self._is_short = self._is_behind = False
        self._writing_since_s = float("inf")
        self._lost = Tally(self._emit_lost)
        sys.setswitchinterval(min(sys.getswitchinterval(), SWITCH_S))
        self._thread = threading.Thread(target=self._write_on, name="recorder", daemon=True)
        self._thread.start()

    # --- control ------------------------------------------------------------------------------

    @property
    def waiting_mb(self) -> float:
        """Memory that frames occupy, MB."""
        return self._held_byte / 1e6

    @property
    def ring_s(self) -> float:
        """Length of the pre-trigger buffer, s."""
        with self._condition:
            return self._ring[-1].time_s - self._ring[0].time_s if self._ring else 0.0

    def take(self, frame: CameraFrame) -> None:
        """Accept a frame of the camera; never blocks."""
        events: list[tuple[Kind, str]] = []
        with self._condition:
            self._newest_s = frame.time_s
            if frame.number % self.plan.every or self._closing:
                return
            size = _size(frame)
            while self._ring and (
                self._ring[0].time_s < frame.time_s - self.plan.before_s
                or self._held_byte + size > self._memory_byte
            ):
                if self._ring[0].time_s >= frame.time_s - self.plan.before_s:
                    events += self._ring_is_short(frame)
                self._held_byte -= _size(self._ring.popleft())
            running = self.running
            has_room = self._held_byte + size <= self._memory_byte
            if running is None and has_room and self.plan.before_s > 0:
                self._ring.append(frame)
                self._held_byte += size
            elif running is not None:
                events += self._record(running, frame, size if has_room else None)
        for kind, words in events:
            self._emit(kind, words)
        self._lost.flush()

    def trigger(self) -> Take:
        """Begin a recording, with the frames before the trigger; or return the present one.

        Raises
        ------
        InputError
            If the file or its notes exist already, or the recorder is closed.
        """
        with self._condition:
            if self._closing:
                raise InputError("recording", "trigger", "closed", "one before it is closed")
            if self.running is not None:
                return self.running
            path = self._apart(self._new_path())
            take = self.running = Take(path, triggered_s=self._newest_s)
            self.takes.append(take)
            self._queue.extend((take, frame) for frame in self._ring)
            count = len(self._ring)
            self._ring.clear()
            self._add_note(
                take, Event("recording", "note", f"trigger, {pluralize(count, 'frame')} before it")
            )
            self._condition.notify()
        self._on_event(Event(path.name, "note", "recording"))
        return take

    def stop(self) -> None:
        """End the present recording; queued frames are still written."""
        self._lost.flush(now=True)
        with self._condition:
            if self.running is not None:
                self._end(self.running)

    def note(self, event: Event, time_s: float | None = None) -> None:
        """Add an event to the present notes; ``time_s`` by the camera's clock, None: now."""
        with self._condition:
            if self.running is not None:
                self._add_note(self.running, event, time_s)
                self._condition.notify()

    def close(self) -> None:
        """End the recording, and wait until all of it is written. May be called twice."""
        self.stop()
        with self._condition:
            self._closing = True
            if self.running is not None:  # triggered after `stop`
                self._end(self.running)
            self._held_byte -= sum(_size(frame) for frame in self._ring)
            self._ring.clear()
            self._condition.notify()
        self._thread.join()
        self._lost.flush(now=True)

    def __enter__(self) -> Recorder:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    # --- in the camera's thread ---------------------------------------------------------------

    def _record(self, take: Take, frame: CameraFrame, size: int | None) -> list[tuple[Kind, str]]:
        """Queue a frame; ``size`` None: memory is full."""
        events: list[tuple[Kind, str]] = []
        if take.ends_s is None and self.plan.after_s is not None:
            # Not counted from the trigger, as the camera may have been lost since.
            take.ends_s = frame.time_s + self.plan.after_s
        if take.ends_s is not None and frame.time_s > take.ends_s - 1 / TICKS_HZ:
            self._end(take)
            return events
        if take.trouble or size is None:
            take.lost += 1
            if not take.trouble:
                self._lost.count()
            return events
        self._queue.append((take, frame))
        self._held_byte += size
        events += self._falls_behind()
        self._condition.notify()
        return events

    def _falls_behind(self) -> list[tuple[Kind, str]]:
        """Return an event the first time that writing falls behind."""
        writing_s = time.monotonic() - self._writing_since_s
        if self._is_behind or (self._held_byte <= self._memory_byte / 2 and writing_s < STALL_S):
            return []
        self._is_behind = True
        stalls = f", the disk has stalled for {writing_s:.1f} s" * (writing_s >= STALL_S)
        megabytes = self._held_byte / 1e6
        words = f"writing does not keep up{stalls}: {megabytes:.0f} MB are queued in memory"
        return [("warning", words)]

    def _ring_is_short(self, frame: CameraFrame) -> list[tuple[Kind, str]]:
        if self._is_short:
            return []
        self._is_short = True
        kept_s = frame.time_s - self._ring[0].time_s
        words = (
            f"only {kept_s:.2f} s before the trigger are buffered, not {self.plan.before_s:g} s: "
            f"the memory is limited to {self.plan.memory_mb:g} MB"
        )
        return [("warning", words)]

    def _apart(self, path: Path) -> Path:
        """Return the path, numbered if it is that of an earlier recording."""
        used, wanted = {take.path for take in self.takes}, path
        for number in itertools.count(2):
            if path not in used:
                break
            path = wanted.with_stem(f"{wanted.stem}-{number}")
        for there in (path, notes_of(path)):
            if os.path.lexists(there):
                raise InputError(there, "recording", "is there already", "another name")
        return path

    def _end(self, take: Take) -> None:
        self._queue.append((take, None))
        self.running = None
        self._condition.notify()

    def _add_note(self, take: Take, event: Event, time_s: float | None = None) -> None:
        self._queue.append((take, Note(self._newest_s if time_s is None else time_s, event)))

    def _emit(self, kind: Kind, words: str) -> None:
        event = Event("recording", kind, words)
        self._on_event(event)
        self.note(event)

    def _emit_lost(self, count: int) -> None:
        faster = "; raw is written faster" * (self.plan.codec == "ffv1")
        lost = pluralize(count, "frame")
        self._emit("loss", f"{lost} lost: writing does not keep up, and memory is full{faster}")

    # --- in the writer's thread ---------------------------------------------------------------

    def _write_on(self) -> None:
        video: TakeFiles | None = None
        while True:
            with self._condition:
                self._condition.wait_for(lambda: self._queue or self._closing)
                if not self._queue:
                    break
                take, item = self._queue.popleft()
                self._writing_since_s = time.monotonic()
            if video is None or video.take is not take:
                video = TakeFiles(take, self._new_video, self._on_event)
            try:
                video.process(item)
            except Exception as error:
                if isinstance(item, CameraFrame):
                    with self._condition:
                        take.lost += 1
                if isinstance(error, WrongFrame):
                    video.wrong.add()
                elif not take.trouble:
                    self._give_up(take, error)
            if item is None:
                take.finished.set()
            self._release(item, take)

    def _new_video(self, take: Take, shape: tuple[int, int]) -> NutWriter:
        return self._open(take.path, shape, self._bit_depth, self._rate_hz, self.plan.codec)

    def _release(self, item: CameraFrame | Note | None, take: Take) -> None:
        """Free the memory of a written frame; raise an event when the queue is empty again."""
        caught_up = False
        with self._condition:
            self._writing_since_s = float("inf")
            if isinstance(item, CameraFrame):
                self._held_byte -= _size(item)
            if self._is_behind and not self._queue:
                self._is_behind, caught_up = False, True
        if caught_up:
            self._emit("note", "writing has caught up")
        if item is None:
            self._lost.flush(now=True)
            self._on_event(take.summary)

    def _give_up(self, take: Take, error: Exception) -> None:
        """Mark a recording as failed and raise an event; written frames are intact."""
        if not isinstance(error, OSError | InputError):
            logging.getLogger("labapp").exception("recording %s", take.path)
        reason = (isinstance(error, OSError) and error.strerror) or error
        take.trouble = f"cannot be written: {reason}"
        words = f"{take.trouble}; written so far and intact: {pluralize(take.frames, 'frame')}"
        self._on_event(Event(take.path.name, "loss", words))


def _size(frame: CameraFrame) -> int:
    """Return the memory of a frame, bytes."""
    return frame.image.nbytes + FRAME_BYTE


def recording_path(folder: Path, stem: str) -> Path:
    """Return an unused path for a new recording, with date and time."""
    begun = time.strftime("%Y-%m-%d-%H%M%S")
    path, count = folder / f"{stem}-{begun}.nut", 1
    while os.path.lexists(path) or os.path.lexists(notes_of(path)):
        count += 1
        path = folder / f"{stem}-{begun}-{count}.nut"
    return path


def recordings_beside(folder: Path, stem: str) -> list[Path]:
    """Return the files in a folder named by `recording_path` with this stem, the oldest first.

    Raises
    ------
    OSError
        If the folder cannot be read.
    """
    named = re.compile(rf"{re.escape(stem)}-\d{{4}}-\d\d-\d\d-\d{{6}}(-\d{{1,3}}){{0,2}}\.nut")
    return sorted(path for path in folder.iterdir() if named.fullmatch(path.name))
