"""Measurer of a recording of one line (`runner.Measurer`)."""

from __future__ import annotations

from collections.abc import Generator, Iterable, Iterator
from dataclasses import dataclass, replace
from itertools import islice

import numpy as np

from labapp.config.setup import Setup
from labapp.core.lines.frame import LineFrame
from labapp.core.lines.track import LineTracker, track_line
from labapp.core.pipeline import Measurement, Settings, setup_status
from labapp.core.values import FloatArray
from labapp.export.frame_result import FrameResult
from labapp.media import Frame
from labapp.run.measurers import Read, read_frame

CLASSIFIED_AT_ONCE = 400
"""The most frames whose pulses are classified together: some tens of periods."""


@dataclass(frozen=True)
class LineMeasurer:
    """Follows the line of a one-line pattern (§3.3), with frames classified by current pulse."""

    read: Read
    setup: Setup
    settings: Settings
    """As for `ColdMeasurer`."""
    current: tuple[FloatArray, FloatArray] | None = None
    """Times in the recording (s) and weld current (A), each shape (n,); None: not recorded."""

    def __call__(self, frames: Iterable[int]) -> Generator[FrameResult]:
        """Measure frames; see `runner.Measurer`. Results come many at a time."""
        tracker = LineTracker()
        for chosen in _classified_together(frames):
            begun = [
                (number, read_frame(self.read, number, self.setup, self.settings))
                for number in chosen
            ]
            seen = [frame for _, frame in begun if isinstance(frame, Frame)]
            time_s = np.array([np.nan if one.time_s is None else one.time_s for one in seen])
            step = float(np.median(np.diff(time_s))) if len(seen) > 1 else 0.0
            rate = 1 / step if step > 0 else None
            images = (one.image for one in seen)
            pulses, tracked = track_line(images, rate, tracker, self._at(time_s))
            followed = zip(tracked, pulses.on.tolist(), pulses.probability.tolist(), strict=True)
            for number, frame in begun:
                if isinstance(frame, FrameResult):
                    yield frame
                    continue
                lines = LineFrame.of_track(*next(followed))
                found = Measurement(lines.status, lines.reason, self.settings.scheme, lines=lines)
                status = setup_status(self.setup.rig)
                yield FrameResult(number, frame.time_s, replace(found, setup_status=status))

    def _at(self, time_s: FloatArray) -> FloatArray | None:
        """Weld current at times, A, NaN beyond the recorded ones; None if there is none."""
        if self.current is None:
            return None
        return np.asarray(np.interp(time_s, *self.current, left=np.nan, right=np.nan))


def _classified_together(frames: Iterable[int]) -> Iterator[list[int]]:
    """Divide frames into parts of `CLASSIFIED_AT_ONCE`; the last two share the remainder equally.

    A few remaining frames alone would not form two classes.
    """
    numbers = iter(frames)
    part = list(islice(numbers, CLASSIFIED_AT_ONCE))
    while len(rest := list(islice(numbers, CLASSIFIED_AT_ONCE))) == CLASSIFIED_AT_ONCE:
        yield part
        part = rest
    both = part + rest
    half = -(-len(both) // 2) if rest else len(both)
    yield from filter(None, (both[:half], both[half:]))
