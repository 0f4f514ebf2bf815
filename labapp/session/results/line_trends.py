"""Trends of line features over a session's recording, and the pool's states."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from labapp.core.lines.states import LineSeries, State, line_states
from labapp.core.values import BoolArray, FloatArray, IntArray, ReadOnlyArrays
from labapp.errors import InputError
from labapp.session.contents import SessionContents

LINE_QUANTITIES = (
    ("count", "Lines", ""),
    ("area_mm2", "Area of the lines", "mm²"),
    ("curvature_per_mm", "Curvature of the lines", "1/mm"),
    ("asymmetry", "Asymmetry of the lines", ""),
    ("pool_height_mm", "Pool height", "mm"),
)
"""Name, label and unit of the quantities; the height only if the lines determine it."""


TRACK_QUANTITIES = (
    ("shift_px", "Shift of the line", "px"),
    ("tilt_px", "Tilt of the line", "px"),
    ("bend_px", "Bend of the line", "px"),
)
"""The same for a line that is followed (`TrackedLine`)."""

FEWEST = 60
"""Fewest consecutive frames for states, which are determined by changes over tens of frames."""


@dataclass(frozen=True)
class LineTrend(ReadOnlyArrays):
    """Features of the n measured frames of a line pattern."""

    frame: IntArray
    """Numbers of the frames, ascending, shape (n,)."""
    stale: BoolArray
    """Which results are stale, shape (n,)."""
    values: dict[str, FloatArray]
    """Values by the names of `LINE_QUANTITIES`, or of `TRACK_QUANTITIES` if a line is followed,
    shape (n,); NaN if unknown.
    """
    height_sigma_mm: FloatArray
    """σ of the pool's height, without the set-up's part, shape (n,)."""
    states: tuple[State, ...]
    """State of the pool in each frame (`line_states`); empty if fewer than `FEWEST` or
    non-consecutive frames were measured.
    """

    def stretches(self) -> list[tuple[State, int, int]]:
        """Return each state in turn, with its first and last frame."""
        found: list[tuple[State, int, int]] = []
        frames = self.frame.tolist() if self.states else []
        for state, frame in zip(self.states, frames, strict=True):
            if found and found[-1][0] == state:
                found[-1] = (state, found[-1][1], frame)
            else:
                found.append((state, frame, frame))
        return found


def line_trend(session: SessionContents) -> LineTrend:
    """Return the trend of line features over all measured frames, without damaged results."""
    seen = session.overview()
    numbers, stale, found = list[int](), list[bool](), []
    for number, old in zip(seen.frame.tolist(), seen.stale.tolist(), strict=True):
        try:
            result = session.result(number)
        except InputError:
            continue
        if result is not None and result.measurement.lines is not None:
            numbers.append(number)
            stale.append(old)
            found.append(result.measurement.lines)
    frame, is_stale = np.array(numbers, np.int64), np.array(stale, bool)
    if any(one.track is not None for one in found):
        values = {
            name: np.array([getattr(one.track, name, np.nan) for one in found], float)
            for name, *_ in TRACK_QUANTITIES
        }
        return LineTrend(frame, is_stale, values, np.full(len(found), np.nan), states=())
    place = np.searchsorted(seen.frame, frame)
    enough = len(found) >= FEWEST and bool((np.diff(place) == 1).all())
    sure = [one.surface if one.status == "ok" else None for one in found]
    values = {
        name: np.array([getattr(one.features, name) for one in found], float)
        for name, *_ in LINE_QUANTITIES
        if name != "pool_height_mm"
    }
    height = [np.nan if one is None else one.height_mm for one in sure]
    sigma = [np.nan if one is None else one.height_sigma_mm for one in sure]
    values["pool_height_mm"] = np.array(height, float)
    states = line_states(LineSeries.of(found)) if enough else ()
    return LineTrend(frame, is_stale, values, np.array(sigma, float), states)
