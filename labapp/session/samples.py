"""The sample sessions: made from the sample recordings by the calls that a script would make.

``python -m labapp.session.samples [NAME …]`` makes those in `sample_sessions` anew.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from labapp.core.correction import block_row, set_reference
from labapp.core.pipeline import start_correction
from labapp.session.demo import sample_folder
from labapp.session.record import Record
from labapp.session.session import Session

UNIT_MM = 6.35
"""Of the target in the samples' calibration pictures."""


@dataclass(frozen=True)
class SampleSession:
    """What is known of a sample besides its folder.

    Parameters
    ----------
    recording
        The recording's name in the folder.
    record
        The experiment record.
    finish
        What somebody did after the first measuring.
    """

    recording: str
    record: Record
    finish: Callable[[Session], None] = lambda _: None


def correct_frame_2(session: Session) -> None:
    """Name the reference and the blocked rows of frame 2; the frames after it are left to you."""
    result = session.result(2)
    assert result is not None
    correction = set_reference(start_correction(result.measurement), (6, 8))
    for row in (1, 2, 6, 7, 8):
        correction = block_row(correction, row)
    session.correct({2: correction}, "reference and blocked rows of frame 2")
    for _ in session.measure([2]):
        pass


SIMULATED = "Simulated: labapp.simulation.samples."

SAMPLES = {
    "gtaw": SampleSession(
        "recording.avi",
        Record(
            title="GTAW run of §7.3",
            operator="labapp",
            current_a=75.0,
            travel_speed_mm_s=3.0,
            expected_width_mm=6.7,
            expected_length_mm=7.4,
            expected_height_mm=0.3,
            notes=SIMULATED,
        ),
    ),
    "thumb_tack": SampleSession(
        "recording.tif",
        Record(
            title="Thumb tack of §8.2",
            operator="labapp",
            expected_width_mm=9.75,
            expected_length_mm=9.75,
            expected_height_mm=0.91,
            notes=SIMULATED,
        ),
    ),
    "blocked_rows": SampleSession(
        "recording.mkv",
        Record(
            title="Rows blocked by the torch",
            operator="labapp",
            notes=f"{SIMULATED} Frame 2 was corrected by hand, frames 3 to 5 were not.",
        ),
        correct_frame_2,
    ),
    "concave": SampleSession(
        "recording",
        Record(title="A concave pool", operator="labapp", notes=SIMULATED),
    ),
}


def make_session(name: str, folder: Path) -> Path:
    """Make the session of a sample in its folder; one that is there is replaced.

    Raises
    ------
    InputError
        If the folder lacks a part of the sample, or cannot be written.
    """
    sample, path = SAMPLES[name], folder / f"{name}.labsession"
    path.unlink(missing_ok=True)
    with Session.create(path, sample.record) as session:
        session.set_setup((folder / "setup.toml").read_text("utf-8"))
        session.calibrate_plane(folder / "calibration.png", UNIT_MM)
        session.import_recording(folder / sample.recording)
        for _ in session.measure():
            pass
        sample.finish(session)
    return path


def main(names: Sequence[str]) -> None:
    """Make the sessions named, or all."""
    for name in names or SAMPLES:
        make_session(name, sample_folder().parent / name)


if __name__ == "__main__":
    main(sys.argv[1:])
