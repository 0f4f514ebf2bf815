"""The result of one frame, from what measures it to all that stores, writes or shows it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

from labapp.core.pipeline import Measurement
from labapp.core.recording.residual_check import Residuals


@dataclass(frozen=True)
class FrameResult:
    """The result of one frame."""

    frame: int
    """Its number."""
    time_s: float | None
    """Its time, s; None if the recording has none."""
    measurement: Measurement
    """Status, reason, measures, and what they were computed from."""
    track_lost: str | None = None
    """Why it was not measured from the frame before; None if it was, or was not to be."""
    rows: Mapping[str, str] | None = None
    """Its rows of each table as CSV text (`tables.table_rows`); None: not made yet."""
    residuals: Residuals | None = None
    """Its residuals, where the measurement no longer has them."""
    setup_doubt: str = ""
    """Why the set-up is doubtful, as far as the frames so far show it; empty if it is not."""


def without_surface(measurement: Measurement) -> Measurement:
    """Status, reason and measures alone: little to pass from process to process."""
    return replace(measurement, dots=None, lattice=None, match=None, reconstruction=None)
