"""Data of the recording page: facts of the recording, choice to import, exposure."""

from __future__ import annotations

import threading
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from labapp.core.images.exposure import Exposure, judge_exposure
from labapp.core.images.find_dots import DotSettings, find_dots
from labapp.core.values import CannotMeasure
from labapp.errors import InputError
from labapp.gui.shell.steps import recording_gone
from labapp.media import GreyImage, open_source
from labapp.media.base import format_frame_rate
from labapp.session.record import Recording
from labapp.session.session import Session
from labapp.text import format_bytes, local_time


@dataclass(frozen=True)
class ShownFrame:
    """A frame to show."""

    title: str
    image: GreyImage | None
    """Grey levels, shape (rows, columns); None if it cannot be read."""
    exposure: Exposure | None
    """Its exposure; None if it cannot be read or is not yet assessed."""
    words: str = ""
    """Reason why it cannot be read; empty if it can."""


class Preview:
    """Preview of a recording for import; frames may be read in any thread.

    Raises
    ------
    InputError
        If it cannot be opened.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._source = open_source(path)
        self._turn = threading.Lock()
        self.frames = len(self._source)
        self.frame_rate_hz = self._source.frame_rate_hz
        self.description = self._source.description
        self.warnings = self._source.warnings

    def look(self, number: int, settings: DotSettings | None) -> ShownFrame:
        """Read a frame, and assess its exposure if there are settings to find dots."""
        title = f"{self.path.name}, frame {number} (of 0 to {self.frames - 1}), not imported yet"
        with self._turn:
            try:
                image = self._source.frame(number).image
            except InputError as error:
                return ShownFrame(title, None, None, str(error))
            depth = self._source.bit_depth
        return ShownFrame(title, image, _judged(image, settings, depth))

    def close(self) -> None:
        """Close the file."""
        with self._turn:
            self._source.close()


def look(session: Session, number: int, judged: bool = True) -> ShownFrame:
    """Read a frame of the session and, if ``judged`` and of dots, assess its exposure."""
    recording = session.recording
    title = f"Frame {number} of the session"
    try:
        image = session.frame(number).image
    except InputError as error:
        return ShownFrame(title, None, None, recording_gone(session, where="") or str(error))
    depth = None if recording is None else recording.bit_depth
    settings = judged_by(session) if judged else None
    return ShownFrame(title, image, _judged(image, settings, depth))


def judged_by(session: Session) -> DotSettings | None:
    """Settings by which exposures are assessed; None for lines, which are not judged as dots."""
    return None if session.has_lines else session.settings.dots


def _judged(
    image: GreyImage, settings: DotSettings | None, bit_depth: int | None
) -> Exposure | None:
    if settings is None:
        return None
    try:
        dots = find_dots(image, settings)
    except CannotMeasure:
        dots = None
    return judge_exposure(image, dots, bit_depth)


@dataclass(frozen=True)
class Choice:
    """Frames of a recording to import, and options."""

    first: int
    last: int
    every: int = 1
    """Frames ``first``, ``first + every`` … up to ``last``."""
    rate_hz: float | None = None
    """Frame rate of the camera, 1/s; None: that stored in the recording."""
    embed: bool = False
    """Whether the frames are stored in the session."""

    @property
    def options(self) -> dict[str, Any]:
        """The choice as arguments of `Session.import_recording`."""
        frames = f"{self.first}:{self.last + 1}:{self.every}"
        return {"frames": frames, "frame_rate_hz": self.rate_hz, "embed": self.embed}

    @property
    def count(self) -> int:
        """Number of frames."""
        return len(range(self.first, self.last + 1, self.every))


def choice_text(preview: Preview, choice: Choice) -> str:
    """Text of what would be imported."""
    count = f"{choice.count} of {preview.frames} frames"
    rate = choice.rate_hz or preview.frame_rate_hz
    if rate is None:
        return f"{count}; without a frame rate there are no times"
    return f"{count}, {choice.count * choice.every / rate:.3f} s at {format_frame_rate(rate)}"


def refusal(session: Session | None, choice: Choice | None, working: bool) -> str:
    """Reason why nothing can be imported now; empty if it can."""
    if session is None:
        return "Open or make a session first"
    if session.read_only:
        return "The session is open read-only"
    if choice is None:
        return "Choose a recording first"
    if working:
        return "A recording is being imported"
    if not choice.count:
        return "The last frame comes before the first"
    return ""


def recording_facts(recording: Recording) -> tuple[tuple[str, str], ...]:
    """Facts read at import: (name, text) pairs."""
    start, stop, step = recording.selected
    used = len(range(start, stop, step))
    which = "all" if used == recording.frames else f"{used}, {start} to {stop - 1}"
    which += f", every {step}." * (step > 1)
    given = " (entered)" if recording.rate_is_given else ""
    rate = recording.frame_rate_hz
    base = f"{format_frame_rate(rate)}{given}" if rate is not None else "none"
    exact = "frame-exact" if recording.frame_exact else "not frame-exact: wrong frames are refused"
    return (
        ("File", Path(recording.path).name),
        ("Format", recording.description),
        ("Picture", f"{recording.columns} × {recording.rows} px, {recording.bit_depth} bit"),
        ("Frames", f"{recording.frames} in the recording, used: {which}"),
        ("Time base", base),
        ("Seeking", exact),
        ("Kept", "in the session itself" if recording.embedded else recording.path),
        ("Size", format_bytes(recording.size)),
        ("SHA-256", recording.sha256),
        ("Imported", local_time(recording.imported)),
    )


def missing_text(session: Session) -> str:
    """Message if the recording is missing or replaced, with the consequences; empty if not."""
    missing, replaced = session.missing_recording, session.replaced_recording
    if missing is not None:
        lost = (
            f"{missing.name} is missing in {missing.parent}. What was measured is still there, "
            "but no frame can be seen or measured. "
        )
    elif replaced is not None:
        lost = (
            f"{replaced.name} in {replaced.parent} is not the recording that was imported: its "
            "size is another one. What was measured is still there, but frames that are not those "
            "imported cannot be seen or measured. "
        )
    else:
        return ""
    if session.read_only:
        return f"{lost}The session is open read-only: open it for changes to locate it."
    return f"{lost}Locate it: only the same recording is accepted, by its size and SHA-256."
