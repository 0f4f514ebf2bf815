"""Files of one recording: its video, and a table of notes beside it."""

from __future__ import annotations

import csv
import io
import threading
from bisect import bisect_right
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

from labapp.media.cameras.base import CameraFrame
from labapp.media.events import Event, OnEvent, Tally
from labapp.media.recording.nut import NutWriter
from labapp.text import as_cell, pluralize

NOTES = ("time_s", "frame", "source", "kind", "what")
"""Columns of the notes beside a recording; the frame is the next one at that time."""

NOTED_LATE = 10_000
"""Largest delay of a note, frames; measuring a frame can take seconds."""


@dataclass(frozen=True)
class Note:
    """A row of the notes, with its time by the camera's clock, s."""

    time_s: float
    event: Event


def notes_of(path: Path) -> Path:
    """Return the path of the notes of a recording."""
    return path.with_name(f"{path.stem}-notes.csv")


@dataclass(eq=False)
class Take:
    """One recording, from its trigger on."""

    path: Path
    """Path of the video. Notes are beside it, see `notes`."""
    frames: int = 0
    """Number of frames written."""
    lost: int = 0
    """Number of frames dropped because memory or disk were full, or their format was wrong."""
    trouble: str = ""
    """Why writing ended early; empty if it did not."""
    finished: threading.Event = field(default_factory=threading.Event)
    """Set when writing has ended."""
    triggered_s: float = 0.0
    ends_s: float | None = None
    """Time of the trigger and of the automatic end, by the camera's clock, s; None: unknown yet, or
    never.
    """

    @property
    def summary(self) -> Event:
        """Event with the number of frames recorded and lost."""
        words = f"{pluralize(self.frames, 'frame')} recorded" + f", {self.lost} lost" * (
            self.lost > 0
        )
        return Event(self.path.name, "loss" if self.lost else "note", words)

    @property
    def notes(self) -> Path:
        """Path of the notes (CSV): trigger, marks, frames lost."""
        return notes_of(self.path)


class TakeFiles:
    """Writes video and notes of a recording; used by one thread.

    Parameters
    ----------
    take
        The recording; frames are counted there.
    opener
        Opens its video, for frames of a shape.
    on_event
        Called with faults.
    """

    def __init__(
        self, take: Take, opener: Callable[[Take, tuple[int, int]], NutWriter], on_event: OnEvent
    ) -> None:
        self.take = take
        self.wrong = Tally(self._emit_wrong)
        """Frames of another size or with more bits."""
        self._opener = opener
        self._on_event = on_event
        self._has_notes = True
        self._video: NutWriter | None = None
        self._early: list[Note] = []
        """Notes from before the first frame; their times are relative to it."""
        self._first_s = self._last_s = take.triggered_s
        self._times_s: deque[float] = deque(maxlen=NOTED_LATE)

    def process(self, item: CameraFrame | Note | None) -> None:
        """Write a frame or a note; None: end the recording."""
        if isinstance(item, CameraFrame):
            self._write(item)
        elif item is None:
            try:
                self.wrong.flush(now=True)
                self._note_early()
                if self._video is not None:
                    self._note(Note(self._last_s, self.take.summary))
            finally:
                if self._video is not None:
                    self._video.close()
        elif not self.take.frames:
            self._early.append(item)
        else:
            self._note(item)

    def _write(self, frame: CameraFrame) -> None:
        if self.take.trouble:
            raise OSError(0, self.take.trouble)
        if self._video is None:
            rows, columns = frame.image.shape
            self._video = self._opener(self.take, (rows, columns))
        if not self.take.frames:
            self._first_s = frame.time_s
        self._video.write(frame.image, frame.time_s - self._first_s)
        self._note_early()
        self.wrong.flush()
        self.take.frames += 1
        self._last_s = frame.time_s
        self._times_s.append(frame.time_s)

    def _emit_wrong(self, count: int) -> None:
        frames = pluralize(count, "frame")
        words = f"{frames} discarded: of another size, or with levels above the camera's bits"
        event = Event(self.take.path.name, "loss", words)
        self._on_event(event)
        self.process(Note(self._last_s, event))

    def _note_early(self) -> None:
        early, self._early = self._early, []
        for note in early:
            self._note(note)

    def _note(self, note: Note) -> None:
        """Append a note; if that fails the video continues, with one event."""
        time_s = note.time_s - self._first_s
        event = note.event
        later = len(self._times_s) - bisect_right(self._times_s, note.time_s)
        frame = self.take.frames - later
        row = (f"{time_s:.6f}", frame, as_cell(event.source), event.kind, as_cell(event.words))
        text = io.StringIO(newline="")
        try:
            began = not self.take.notes.exists()  # mode x also fails for a broken link
            csv.writer(text, lineterminator="\n").writerows([NOTES, row] if began else [row])
            with self.take.notes.open("x" if began else "a", encoding="utf-8", newline="") as file:
                file.write(text.getvalue())
        except OSError as error:
            if self._has_notes:
                self._has_notes = False
                words = f"not all notes can be written beside it: {error.strerror}"
                self._on_event(Event(self.take.path.name, "warning", words))
