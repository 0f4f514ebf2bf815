"""Progress of a study."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from labapp.config.setup import Setup
from labapp.run.study.plan import StudyRecording
from labapp.run.study.stretches import FoundRecording, Stretch

State = Literal["done", "part", "waiting", "failed"]


@dataclass(frozen=True)
class RecordingStatus:
    """Progress of a recording."""

    recording: StudyRecording
    state: State
    """``done``, ``part`` (partly done), ``waiting`` (not begun) or ``failed``."""
    problem: str
    """Why it failed; empty if it did not."""
    frames: int
    """Frames to be measured; 0 if not known yet."""
    frames_done: int


@dataclass(frozen=True)
class Progress:
    """Progress of a run."""

    frames_done: int
    frames: int
    """Number of all frames, estimated from the recordings examined so far."""
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
