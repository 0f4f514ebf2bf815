"""Progress of a study: state of each recording, and of a run."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal

from labapp.config.setup import Setup
from labapp.run.study.plan import StudyRecording
from labapp.run.study.stretches import FoundRecording, Stretch
from labapp.text import pluralize

State = Literal["done", "part", "waiting", "failed"]


@dataclass(frozen=True)
class RecordingStatus:
    """State of one recording."""

    recording: StudyRecording
    state: State
    """``done``, ``part`` (partly measured), ``waiting`` or ``failed``."""
    problem: str
    """Why it failed; empty if it did not."""
    frames: int
    """Number of frames to measure; 0 while unknown."""
    frames_done: int


STATE_WORDS: dict[State, str] = {
    "done": "done",
    "part": "in part",
    "waiting": "waiting",
    "failed": "failed",
}
"""What states are called, in the order in which they are counted."""


def count_states(found: Iterable[RecordingStatus]) -> str:
    """How many recordings are in each state: "3 recordings: 2 done, 1 failed"."""
    states = Counter(one.state for one in found)
    counts = [f"{states[state]} {words}" for state, words in STATE_WORDS.items() if states[state]]
    return f"{pluralize(states.total(), 'recording')}: {', '.join(counts)}"


@dataclass(frozen=True)
class StudyProgress:
    """Progress of a run."""

    frames_done: int
    frames: int
    """Total number, estimated from the recordings opened so far."""
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
