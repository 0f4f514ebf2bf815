"""What is done of a study."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from labapp.config.setup import Setup
from labapp.run.study.plan import StudyRecording
from labapp.run.study.stretches import FoundRecording, Stretch

State = Literal["done", "part", "waiting", "failed"]


@dataclass(frozen=True)
class RecordingStatus:
    """What is done of a recording."""

    recording: StudyRecording
    state: State
    """``done``; ``part`` of it is; ``waiting`` to be begun; or it ``failed``."""
    problem: str
    """Why it failed; empty if it did not."""
    frames: int
    """Frames to be measured; 0 as long as that is not known."""
    frames_done: int


@dataclass(frozen=True)
class Progress:
    """How far a run is."""

    frames_done: int
    frames: int
    """All there are, estimated from the recordings that were looked at."""
    recordings_done: int
    recordings: int
    failed: int


@dataclass(frozen=True)
class Tasks:
    """The tasks that measure one recording."""

    recording: StudyRecording
    setup: Setup
    found: FoundRecording
    frames: range
    stretches: list[Stretch]
