"""The sample runs, and sessions created from them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from labapp.bundled import SAMPLE_TEXTS, bundled
from labapp.errors import InputError
from labapp.session.creation import new_session
from labapp.session.record import Record
from labapp.session.session import Session

UNIT_MM = 6.35
"""Unit of the target in the samples' calibration pictures."""


@dataclass(frozen=True)
class SampleSession:
    """Facts about a sample that are not in its folder."""

    recording: str
    """Name of the recording in the folder."""
    record: Record
    frame_rate_hz: float | None = None
    """Frame rate of a recording without a time base."""


def _noted(name: str, notes: str = "", **values: Any) -> Record:
    notes = f"Simulated: labapp.simulation.samples. {notes}".strip()
    return Record(title=SAMPLE_TEXTS[name].title, operator="labapp", notes=notes, **values)


SAMPLES = {
    "gtaw": SampleSession(
        "recording.avi",
        _noted(
            "gtaw",
            current_a=75.0,
            travel_speed_mm_s=3.0,
            expected_width_mm=6.7,
            expected_length_mm=7.4,
            expected_height_mm=0.3,
        ),
    ),
    "thumb_tack": SampleSession(
        "recording.tif",
        _noted(
            "thumb_tack", expected_width_mm=9.75, expected_length_mm=9.75, expected_height_mm=0.91
        ),
    ),
    "blocked_rows": SampleSession(
        "recording.mkv",
        _noted("blocked_rows", "Frame 2 was corrected by hand, frames 3 to 5 were not."),
    ),
    "concave": SampleSession("recording", _noted("concave")),
    "five_lines": SampleSession("recording.avi", _noted("five_lines")),
    "gmaw": SampleSession("recording.tif", _noted("gmaw"), frame_rate_hz=1500.0),
}


def sample_folder(name: str) -> Path:
    """Return the folder of a bundled sample.

    Raises
    ------
    InputError
        If it is missing, because labapp was installed without its data.
    """
    folder = bundled("sample_sessions") / name
    if not folder.is_dir():
        expected = "a folder distributed with labapp; install it again"
        raise InputError(folder, "sample run", "missing", expected)
    return folder


def begin_session(name: str, path: Path) -> Session:
    """Create a session from a sample: record, set-up, calibration, recording, without results.

    Raises
    ------
    InputError
        If the sample is incomplete, or the session exists already or cannot be written; an
        incomplete session is deleted.
    """
    sample, folder = SAMPLES[name], sample_folder(name)
    with new_session(path, sample.record) as session:
        session.set_setup((folder / "setup.toml").read_text("utf-8"))
        if (folder / "calibration.png").exists():
            session.calibrate_plane(folder / "calibration.png", UNIT_MM)
        session.import_recording(folder / sample.recording, frame_rate_hz=sample.frame_rate_hz)
    return session
