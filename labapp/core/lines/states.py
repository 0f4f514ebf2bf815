"""State of the pool over time from reflected lines (§3.2.1).

| state | dissertation | rule |
| --- | --- | --- |
| ``no-pool`` | "a blurred plane without any lines" at point A (Fig. 3-11) | no line is seen |
| ``growing`` | from A to B "the weld pool grows" (Fig. 3-11) | the pool's width increases, or lines have appeared but do not yet determine it |
| ``concave`` | full penetration, steady (Fig. 3-12) | turn below zero, not changing |
| ``flattening`` | "from being concave towards being convex", the size falls (Fig. 3-13) | turn rises from below zero |
| ``convex`` | partial penetration, images larger, lines fewer (Fig. 3-14) | turn above zero, not changing |

The dissertation judges shapes by eye; here width and turn are those of the fitted surface. The turn
is its curvature times its width, the angle between its normals at both ends of the lines. The lines
determine it better than either factor, as a wider and flatter surface reflects them almost equally.
"""  # noqa: E501

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.ndimage import find_objects, label

from labapp.core.lines.fit import LEAST_LINES
from labapp.core.lines.frame import LineFrame
from labapp.core.values import BoolArray, FloatArray, IntArray, ReadOnlyArrays, robust_sigma

State = Literal["no-pool", "growing", "concave", "flattening", "convex"]

SURE_MARGIN = 6.0
"""Least margin of the other sign at which a frame's curvature is used (`LineSurface.margin`)."""

BETWEEN = 6
"""Interruptions of a change up to this distance between frames are closed."""

STEADY_FRAMES, SLOPING_FRAMES, CORNER_REACH = 25, 12, 8
"""Numbers of frames before and in a change that determine its corner, and the search range about
its first estimate, frames."""

RAMP_REACH = 16
"""Search range about the first estimates of a ramp's begin and end, frames."""

LEAST_KNOWN, MOST_OFF = 5, 6.0
"""Least number of frames on both sides of a ramp; and largest cost of a frame, −log likelihood."""

UNEVEN = 0.05
"""Standard deviation of frames from a straight ramp, relative to its height."""

APPEARING_FRAMES = 15
"""Growth detected within this many frames of the first known width is taken to begin with the first
lines."""

LEAST_FRAMES = 8
"""Shortest change, frames."""

LASTING_FRAMES = 3
"""Number of frames after which another number of lines is lasting."""

TUKEY = 3.0
"""Values farther than this many standard deviations from the local line have little weight."""

WINDOW = 5.0
"""Standard deviation of the weights of the local fit over time, frames."""

LASTING_SHARE, SURE_SIGMAS = 0.55, 4.0
"""A change lasts while its rate exceeds this share of the largest rate (about half, as a local fit
at a corner gives half the rate beyond it) and this many of its standard uncertainties."""

LEAST_GROWTH_MM, LEAST_TURN = 0.1, 0.03
"""Least change of width and turn over a window, mm and rad."""


@dataclass(frozen=True)
class LineSeries(ReadOnlyArrays):
    """Time series of a recording, each array with one entry per frame.

    Parameters
    ----------
    count
        Number of visible lines.
    width_mm
        Width of the pool along X, between the lines' ends; NaN if unknown.
    turn
        Angle between the surface's normals across the pool, rad, positive if convex; NaN if unknown
        or if its sign is uncertain.
    """

    count: IntArray
    width_mm: FloatArray
    turn: FloatArray

    @classmethod
    def of(cls, frames: Sequence[LineFrame]) -> LineSeries:
        """Collect the series from consecutive frames."""
        count = np.array([one.features.count for one in frames], np.int64)
        width, turn = np.full(len(frames), np.nan), np.full(len(frames), np.nan)
        for k, one in enumerate(frames):
            surface = one.surface
            if surface is None or len(surface.numbers) < LEAST_LINES:
                continue
            if surface.margin >= SURE_MARGIN:
                width[k] = surface.width_mm if surface.bulges else np.nan
                turn[k] = surface.curvature_per_mm * surface.width_mm
        return cls(count, width, turn)


def line_states(series: LineSeries) -> tuple[State, ...]:
    """State of the pool in each frame; see the module's table."""
    lit = _steady(series.count > 0)
    _, growth, growth_sigma = local_line(series.width_mm, lit)
    turn, turning, turning_sigma = local_line(series.turn, lit)
    grows = _changes(growth, growth_sigma, LEAST_GROWTH_MM)
    grows = _well_known(grows, series.width_mm)
    grows = lit & _with_corners(grows, series.width_mm, lit)
    grows |= _just_appeared(lit, np.isfinite(series.width_mm), grows)
    flattens = _from_below_zero(_changes(turning, turning_sigma, LEAST_TURN), turn)
    flattens = lit & ~grows & _ramps(flattens, series.turn, lit & ~grows)
    known = np.flatnonzero(np.isfinite(turn))
    # The first lines may be too few for a surface; later, interpolation bridges unknown frames.
    unknown = np.arange(len(lit)) < known.min(initial=len(lit))
    turn = np.interp(np.arange(len(lit)), known, turn[known]) if len(known) else turn
    states: list[State] = []
    for k in range(len(lit)):
        if not lit[k]:
            states.append("no-pool")
        elif grows[k] or unknown[k]:
            states.append("growing")
        elif flattens[k]:
            states.append("flattening")
        else:
            states.append("convex" if turn[k] > 0 else "concave")
    return tuple(states)


def line_changes(series: LineSeries) -> list[tuple[int, int, int]]:
    """Lasting changes of the number of lines: (frame, before, after) of each (Fig. 3-14)."""
    changes: list[tuple[int, int, int]] = []
    now, since, before = -1, 0, -1
    for frame, count in enumerate(series.count.tolist()):
        if count != now:
            now, since = count, frame
        if frame - since + 1 == LASTING_FRAMES and now != before:
            if before >= 0:
                changes.append((since, before, now))
            before = now
    return changes


def local_line(values: FloatArray, on: BoolArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Fit robust local lines: value, rate per `WINDOW` and σ of the rate, each shape (n,).

    Parameters
    ----------
    values
        One value per frame, shape (n,), NaN if unknown.
    on
        Frames to use, shape (n,); elsewhere the result is NaN.
    """
    frames = np.arange(len(values), dtype=float)
    known = on & np.isfinite(values)
    result = np.full((3, len(values)), np.nan)
    if known.sum() < 3:
        return result[0], result[1], result[2]
    y = np.where(known, values, 0.0)
    step = (frames - frames[:, None]) / WINDOW
    weights = np.exp(-(step**2) / 2) * known
    base, noise = weights, np.full(len(values), np.inf)
    for _ in range(4):
        s0, s1, s2 = (np.sum(weights * step**k, axis=1) for k in range(3))
        t0, t1 = weights @ y, (weights * step) @ y
        determinant = np.maximum(s0 * s2 - s1**2, 1e-9)
        value, rate = (s2 * t0 - s1 * t1) / determinant, (s0 * t1 - s1 * t0) / determinant
        off = y - (value[:, None] + rate[:, None] * step)
        typical = np.sqrt(np.sum(base * np.minimum(off, noise[:, None]) ** 2, axis=1) / (s0 + 1e-9))
        noise = TUKEY * np.minimum(typical, noise) + 1e-9
        weights = base * np.maximum(1 - (off / (2 * noise[:, None])) ** 2, 0.0) ** 2 + 1e-9 * base
    typical = np.median(noise[on & np.isfinite(noise)])
    sigma = typical / TUKEY * np.sqrt(np.sum(weights**2 * step**2, axis=1)) / np.maximum(s2, 1e-9)
    enough = on & (s0 > 3) & (determinant > 1e-3)
    result[:, enough] = np.stack([value, rate, sigma])[:, enough]
    return result[0], result[1], result[2]


def _changes(rate: FloatArray, sigma: FloatArray, least: float) -> BoolArray:
    """Frames in which a value increases at about its largest rate."""
    known = np.isfinite(rate)
    if not known.any():
        return known
    real = known & (rate > np.maximum(SURE_SIGMAS * np.nan_to_num(sigma), least))
    if not real.any():
        return real
    largest = float(np.quantile(rate[real], 0.7))
    # At the ends of a change its rate is halved and less certain: include adjacent frames.
    fast = np.nan_to_num(rate) > LASTING_SHARE * largest
    parts, _ = label(known & (fast | _closed(fast)))
    sure = [part for part in np.unique(parts[real]) if np.sum(parts == part) >= LEAST_FRAMES]
    return np.asarray(np.isin(parts, sure) & (parts > 0))


def _well_known(change: BoolArray, values: FloatArray) -> BoolArray:
    """Keep changes in which at least half of the frames have a value."""
    parts, count = label(change)
    known = np.isfinite(values)
    kept = [part for part in range(1, count + 1) if known[parts == part].mean() >= 0.5]
    return np.asarray(np.isin(parts, kept) & change)


def _from_below_zero(change: BoolArray, turn: FloatArray) -> BoolArray:
    """Keep changes before which the pool was not clearly convex.

    That is judged from the last known values, as the sign of a small turn is often unknown.
    """
    result = change.copy()
    for (span,) in find_objects(label(change)[0]):
        before = turn[: span.start + 1]
        before = before[np.isfinite(before)][-SLOPING_FRAMES:]
        result[span] = len(before) < SLOPING_FRAMES or before.min() < 0
    return result


def _with_corners(change: BoolArray, values: FloatArray, on: BoolArray) -> BoolArray:
    """Adjust the ends of changes to corners of the values: constant outside, a line inside."""
    result = np.zeros(len(change), bool)
    for (span,) in find_objects(label(change)[0]):
        begin = _corner(values, on, span.start)
        end = _corner(values[::-1], on[::-1], len(values) - span.stop)
        result[begin : len(values) - end] = True
    return result


def _ramps(change: BoolArray, values: FloatArray, on: BoolArray) -> BoolArray:
    """Adjust the ends of changes by fitting ramps between two levels."""
    result = np.zeros(len(change), bool)
    for (span,) in find_objects(label(change)[0]):
        begin, end = _ramp(values, on, span.start, span.stop)
        result[_gap_before(begin, on & np.isfinite(values)) : end] = True
    return result


def _gap_before(begin: int, known: BoolArray) -> int:
    """First frame of a gap in front of a change; ``begin`` if there is none.

    A steady pool whose value was known does not cease to show it: it has begun to change.
    """
    before = np.flatnonzero(known[:begin])
    if not len(before):
        return begin
    first = int(before[-1]) + 1
    return first if known[max(first - LEAST_FRAMES, 0) : first].mean() > 0.5 else begin


def _ramp(values: FloatArray, on: BoolArray, begin: int, end: int) -> tuple[int, int]:
    """First frame of a change near ``begin``, and first after it, by a ramp between two levels."""
    known = on & np.isfinite(values)
    known[: max(begin - STEADY_FRAMES, 0)] = known[end + STEADY_FRAMES :] = False
    frames = np.flatnonzero(known)
    seen = values[frames]
    sides = [seen[frames < begin - RAMP_REACH // 2], seen[frames >= end + RAMP_REACH // 2]]
    if min(map(len, sides)) < LEAST_KNOWN:
        return begin, end
    low, high = (float(np.median(side)) for side in sides)
    scatter = [robust_sigma(side - np.median(side)) for side in sides]
    best, least = (begin, end), np.inf
    for first in range(max(begin - RAMP_REACH, 0), begin + RAMP_REACH + 1):
        for last in range(max(end - RAMP_REACH, first + LEAST_FRAMES), end + RAMP_REACH + 1):
            share = np.clip((frames - first + 0.5) / (last - first), 0.0, 1.0)
            off = np.abs(seen - low - share * (high - low))
            typical = scatter[0] + share * (scatter[1] - scatter[0]) + 1e-9
            inside = (share > 0) & (share < 1)
            typical = np.hypot(typical, inside * UNEVEN * abs(high - low))
            cost = float(np.sum(np.minimum((off / typical) ** 2 / 2, MOST_OFF) + np.log(typical)))
            if cost < least:
                best, least = (first, last), cost
    return best


def _corner(values: FloatArray, on: BoolArray, near: int) -> int:
    """First frame of a change near ``near``: values are constant before and linear after."""
    window = np.arange(max(near - STEADY_FRAMES, 0), min(near + SLOPING_FRAMES, len(values)))
    window = window[on[window] & np.isfinite(values[window])]
    if np.sum(window < near) < 5 or np.sum(window >= near) < 5:
        return near
    best, least = near, np.inf
    for corner in range(near - CORNER_REACH, near + CORNER_REACH + 1):
        terms = np.stack([np.ones(len(window)), np.maximum(window - corner + 0.5, 0.0)], axis=-1)
        weights = np.ones(len(window))
        for _ in range(3):
            fit = np.linalg.lstsq(terms * weights[:, None], values[window] * weights, rcond=None)[0]
            off = np.abs(values[window] - terms @ fit)
            limit = TUKEY * robust_sigma(off) + 1e-9
            weights = np.sqrt(np.minimum(1.0, limit / np.maximum(off, 1e-12)))
        cost = float(np.sum(np.minimum(off, limit)))
        if cost < least:
            best, least = corner, cost
    return max(best, 0)


def _closed(on: BoolArray) -> BoolArray:
    """Close gaps between frames that are on and at most `BETWEEN` apart."""
    frames = np.arange(len(on))
    last = np.maximum.accumulate(np.where(on, frames, -BETWEEN))
    after = np.minimum.accumulate(np.where(on, frames, len(on) + BETWEEN)[::-1])[::-1]
    return np.asarray(after - last <= BETWEEN)


def _just_appeared(lit: BoolArray, known: BoolArray, grows: BoolArray) -> BoolArray:
    """Frames between the first lines of a pool and the first detection of its growth.

    The first lines may be too few for a width, so that the growth is detected from the first known
    width on.
    """
    result = np.zeros(len(lit), bool)
    for first in np.flatnonzero(np.diff(lit.astype(int)) == 1) + 1:
        begun = first + int(np.argmax(known[first:]))
        later = np.flatnonzero(grows[first : begun + APPEARING_FRAMES])
        if len(later):
            result[first : first + later[0]] = True
    return result


def _steady(on: BoolArray) -> BoolArray:
    """Majority filter over five frames."""
    padded = np.pad(on.astype(float), 2, mode="edge")
    return np.asarray(np.convolve(padded, np.ones(5), "valid") >= 3)
