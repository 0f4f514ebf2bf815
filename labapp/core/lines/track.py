"""Tracking of a single line from frame to frame (§3.3): shift, tilt and bend as time series.

In a strip about the line's previous position, each column gives the position of its brightest
light. A shape is fitted to these with Tukey's biweights. Columns disturbed by spatter, glare,
droplets or bridging are thereby rejected, and the share of accepted columns is reported.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import cv2
import numpy as np

from labapp.core.images.dots import Grey, Image
from labapp.core.lines.detection.find_lines import find_lines
from labapp.core.lines.pulses import Pulses, classify_pulses, frame_brightness
from labapp.core.values import BoolArray, FloatArray, ReadOnlyArrays, robust_sigma

OVERSAMPLE = 8
"""Number of trial frequencies per inverse of the recording's duration."""

RECENT, BLINDED, BLINDED_LEVELS = 40, 4.0, 6.0
"""A frame is blinded if it is brighter than this multiple of the darkest of the recent frames, plus
this many grey levels."""


NEIGHBOURS = 7
"""Number of columns, about each column, most of which must agree for the line to reach there."""

REACH_PX = 14.0
"""Search range above and below the line's position in the previous frame, px."""

COLUMN_PX = 3.0
"""Spacing of the columns that are read, px."""

LEAST_SHARE = 0.5
"""The line is lost if a smaller share of its columns agrees."""

LEAST_CONTRAST = 1.5
"""Least ratio of a column's light over its surroundings to the noise."""

LOWEST_HZ, HIGHEST_HZ = 5.0, 100.0
"""Range of the frequencies of a line's oscillation."""

FRAMES_AT_ONCE = 4096
"""Frames whose sines are computed at once: those of a long recording would not fit in memory."""


@dataclass(frozen=True)
class TrackedLine(ReadOnlyArrays):
    """A line in a frame.

    Parameters
    ----------
    u_px, v_px
        Its columns, from the first to the last where its light is seen, and its fitted position in
        each, shape (n,), px.
    shift_px, tilt_px, bend_px
        Difference of its shape from the reference: mean, rise over half its length, and rise of its
        ends relative to its middle, px downwards.
    share
        Share of the columns that agree with the fit.
    """

    u_px: FloatArray
    v_px: FloatArray
    shift_px: float
    tilt_px: float
    bend_px: float
    share: float


class LineTracker:
    """Tracker of one line; the first frame should show the line."""

    def __init__(self) -> None:
        self._width_px = np.nan  # standard deviation of the line's light across it
        self._columns: FloatArray | None = None
        self._reference = np.zeros(0)
        self._terms = np.zeros((0, 3))
        self._shape = np.zeros(3)
        self._since = 0

    def follow(self, frame: Image) -> TrackedLine | None:
        """Return the line in the next frame, shape (height, width); None if it is lost."""
        picture = np.ascontiguousarray(frame, np.float32)
        if self._columns is None and not self._begin(picture):
            return None
        found = self._read(picture, REACH_PX)
        if found is None and self._since >= 3:  # it may have moved farther
            found = self._read(picture, 2 * REACH_PX)
        self._since = 0 if found is not None else self._since + 1
        return found

    def _begin(self, picture: Grey) -> bool:
        lines = find_lines(picture)
        if not lines:
            return False
        line = max(lines, key=lambda one: one.light * one.length_px)
        u, v = line.image_px.T
        order = np.argsort(u)
        columns = np.arange(np.ceil(u.min()), u.max(), COLUMN_PX)
        if len(columns) < 10:
            return False
        place = (columns - columns.mean()) / (np.ptp(columns) / 2)
        self._terms = np.stack([np.ones_like(place), place, place**2 - 1 / 3], axis=-1)
        self._columns, self._reference = columns, np.interp(columns, u[order], v[order])
        self._shape = np.zeros(3)
        self._width_px = float(np.clip(line.width_px, 1.0, 5.0))
        return True

    def _read(self, picture: Grey, reach: float) -> TrackedLine | None:
        assert self._columns is not None
        middle = self._reference + self._terms @ self._shape
        side = np.arange(-reach, reach + 1.0)
        v = (middle[None] + side[:, None]).astype(np.float32)
        u = np.broadcast_to(self._columns.astype(np.float32), v.shape)
        strip = cv2.remap(picture, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        band = _band(np.asarray(strip), self._width_px)
        inner = slice(2, -2)
        best = np.argmax(band[inner], axis=0) + 2
        columns = np.arange(len(best))
        before, top, after = (band[best + k, columns].astype(float) for k in (-1, 0, 1))
        bend = before - 2 * top + after
        off = side[best] + np.where(bend < 0, (before - after) / (2 * np.minimum(bend, -1e-9)), 0.0)
        noise = robust_sigma(band - np.median(band)) + 1e-6
        clear = top > LEAST_CONTRAST * noise
        if clear.sum() < 6:
            return None
        fit, agrees = _robust_shape(self._terms, off, clear)
        share = float(np.mean(agrees))
        if share < LEAST_SHARE:
            return None
        self._shape = self._shape + fit
        shift, tilt, bend_px = self._shape.tolist()
        fitted, lit = middle + self._terms @ fit, _lit(agrees)
        return TrackedLine(self._columns[lit], fitted[lit], shift, tilt, bend_px, share)


def _band(strip: Grey, width: float) -> Grey:
    """Band-pass filter of each column at the line's width."""
    return np.asarray(_down(strip, width) - _down(strip, 2.5 * width))


def _down(strip: Grey, sigma: float) -> Grey:
    size = (1, 2 * int(np.ceil(3 * sigma)) + 1)
    return np.asarray(cv2.GaussianBlur(strip, size, sigma, borderType=cv2.BORDER_REFLECT))


def _robust_shape(
    terms: FloatArray, off: FloatArray, clear: BoolArray
) -> tuple[FloatArray, BoolArray]:
    """Fit shift, tilt and bend to the columns' positions; also which columns agree."""
    start = float(np.median(off[clear]))
    fit, limit = np.array([start, 0.0, 0.0]), 8.0
    weights = clear.astype(float)
    for _ in range(8):
        away = off - terms @ fit
        weights = np.maximum(1 - (away / limit) ** 2, 0.0) ** 2 * clear
        if weights.sum() < 6:
            return fit, np.zeros(len(off), bool)
        weighted = terms * weights[:, None]
        fit = np.linalg.solve(weighted.T @ terms + 1e-3 * np.eye(3), weighted.T @ off)
        scatter = robust_sigma((off - terms @ fit)[weights > 0])
        limit = float(np.clip(5.0 * scatter, 2.0, 8.0))
    return fit, (np.abs(off - terms @ fit) < limit) & clear


def _lit(agrees: BoolArray) -> slice:
    """Columns from the first to the last that agrees together with most of its neighbours."""
    amid = np.convolve(agrees, np.ones(NEIGHBOURS), "same") > NEIGHBOURS / 2
    lit = np.flatnonzero(agrees & amid)
    return slice(lit[0], lit[-1] + 1) if len(lit) else slice(None)


def track_line(
    frames: Iterable[Image],
    frame_rate_hz: float | None,
    tracker: LineTracker | None = None,
    current_a: FloatArray | None = None,
) -> tuple[Pulses, tuple[TrackedLine | None, ...]]:
    """Classify the frames of a recording by pulse, and track its line in those without a pulse.

    The line is measured in every frame that is not blinded. Results of frames that are later
    classified as having a pulse are discarded. ``tracker`` is that of the preceding frames;
    ``current_a`` as in `classify_pulses`. Returns the frames with and without a pulse, and the line
    in each frame; None if it is lost or a pulse is on.
    """
    tracker = tracker or LineTracker()
    bright, lines = list[float](), list[TrackedLine | None]()
    for frame in frames:
        bright.append(frame_brightness(frame))
        recent = bright[-RECENT:]
        blinded = bright[-1] > BLINDED * min(recent) + BLINDED_LEVELS
        lines.append(None if blinded else tracker.follow(frame))
    pulses = classify_pulses(np.array(bright), frame_rate_hz, current_a)
    return pulses, tuple(None if on else one for one, on in zip(lines, pulses.on, strict=True))


def oscillation_frequency(time_s: FloatArray, values: FloatArray) -> tuple[float, float]:
    """Frequency of the strongest oscillation, Hz, and its share of the values' variance.

    By the Lomb–Scargle periodogram, as frames with a pulse are missing.

    Parameters
    ----------
    time_s, values
        Times, s, and values of the tracked frames, each shape (n,).
    """
    if len(values) < 16:
        return float("nan"), 0.0
    # Remove the drift.
    smooth = np.polynomial.Polynomial.fit(time_s, values, 3)(time_s)
    swing = values - smooth
    limit = 6.0 * robust_sigma(swing) + 1e-9
    kept = np.abs(swing) < limit
    if not np.var(swing[kept]) > 0:
        return float("nan"), 0.0
    step = 1.0 / (OVERSAMPLE * max(float(np.ptp(time_s)), 1e-9))
    rates = np.arange(LOWEST_HZ, HIGHEST_HZ, step)
    power = _variance_shares(time_s[kept], swing[kept], step, len(rates))
    best = int(np.argmax(power))
    if 0 < best < len(power) - 1:
        before, top, after = power[best - 1 : best + 2]
        rates[best] += step * (before - after) / (2 * (before - 2 * top + after))
    return float(rates[best]), float(power[best])


def _variance_shares(
    time_s: FloatArray, swing: FloatArray, step_hz: float, count: int
) -> FloatArray:
    """Share of the variance of n values that an oscillation at each frequency has, (count,).

    The frequencies begin at `LOWEST_HZ`. The periodogram has a free mean (Zechmeister and Kürster,
    Astron. Astrophys. 496, 577, 2009). Each frequency is one of a coarse grid plus a few fine
    steps, so that phases add up, and the sums over the values are matrix products.
    """
    fine = int(np.ceil(np.sqrt(count)))
    coarse_hz = LOWEST_HZ + step_hz * fine * np.arange(-(-count // fine))
    sums = np.zeros((3, len(coarse_hz), fine), complex)
    for first in range(0, len(time_s), FRAMES_AT_ONCE):
        part = slice(first, first + FRAMES_AT_ONCE)
        turn = 2j * np.pi * time_s[part]
        start = np.exp(np.multiply.outer(coarse_hz, turn))
        on = np.exp(np.multiply.outer(turn, step_hz * np.arange(fine)))
        sums += np.stack([(start * swing[part]) @ on, start @ on, start**2 @ on**2])
    with_value, once, twice = sums.reshape(3, -1)[:, :count] / len(time_s)
    mean = float(np.mean(swing))
    by_cos, by_sin = with_value.real - mean * once.real, with_value.imag - mean * once.imag
    cos2 = (1.0 + twice.real) / 2 - once.real**2
    sin2 = (1.0 - twice.real) / 2 - once.imag**2
    mixed = twice.imag / 2 - once.real * once.imag
    explained = sin2 * by_cos**2 + cos2 * by_sin**2 - 2.0 * mixed * by_cos * by_sin
    return np.asarray(explained / ((cos2 * sin2 - mixed**2) * np.var(swing)))
