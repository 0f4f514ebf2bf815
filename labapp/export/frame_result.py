"""The result of one frame, passed from measurers to storage, exports and the app."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

from labapp.core.pipeline import Measurement
from labapp.core.recording.residual_check import Residuals


@dataclass(frozen=True, repr=False)
class FrameResult:
    """The result of one frame.

    Parameters
    ----------
    frame
        Its number.
    time_s
        Its time, s; None if the recording has none.
    measurement
        Status, reason, measures, and what they were computed from.
    track_lost
        Why it was not tracked from the previous frame; None if it was, or tracking was off.
    rows
        Its rows of each table as CSV text (`tables.table_rows`); None: not computed yet.
    residuals
        Residuals of its dots, for the check of the set-up, if the measurement came from another
        process without its reconstruction (`without_surface`).
    setup_doubt
        Why the set-up is doubtful according to the frames so far; empty if it is not.
    """

    frame: int
    time_s: float | None
    measurement: Measurement
    track_lost: str | None = None
    rows: Mapping[str, str] | None = None
    residuals: Residuals | None = None
    setup_doubt: str = ""

    def __repr__(self) -> str:
        time = "" if self.time_s is None else f" at {self.time_s:.6g} s"
        return f"<labapp frame {self.frame}{time}: {self.measurement.summary}>"


def without_surface(measurement: Measurement) -> Measurement:
    """Return status, reason and measures only, which processes exchange fast."""
    return replace(measurement, dots=None, lattice=None, match=None, reconstruction=None)
