"""Sizes of a live pool over the last seconds, and the rate of measuring."""

from __future__ import annotations

import threading
import time
from collections import deque
from dataclasses import dataclass
from itertools import takewhile
from typing import NamedTuple

import numpy as np

from labapp.core.values import BoolArray, FloatArray, IntArray, ReadOnlyArrays
from labapp.run.limits import NAMES, Limits, beyond, sizes_of
from labapp.run.live_measuring import LiveResult

RATE_S = 2.0
"""Time over which rates are averaged, s."""

TREND_S = 120.0
"""Length of the trend, s."""

MOST_KEPT = 12_000
"""Most frames of the trend: a hundred per second."""


@dataclass(frozen=True)
class LiveSizes(ReadOnlyArrays):
    """Sizes of the last n frames, the oldest first."""

    names: tuple[str, ...]
    """Names of the three sizes: the last is ``height``, or for a concave pool ``depth``."""
    number: IntArray
    """Frame numbers of the camera, shape (n,)."""
    since_s: FloatArray
    """Arrival times relative to now, so negative, shape (n,), s."""
    value_mm: FloatArray
    sigma_mm: FloatArray
    """Width, length and height, and their σ, shape (3, n); NaN if unknown."""
    beyond: BoolArray
    """Which sizes are beyond a limit, shape (3, n)."""


@dataclass(frozen=True)
class Pace:
    """Present rate of measuring."""

    measured_hz: float
    """Frames measured per second."""
    tried: int
    failed: int
    """Number of frames tried, and of those that could not be measured."""


class _Frame(NamedTuple):
    """A frame of the trend.

    Sizes are the three values and their three σ, mm.
    """

    done_s: float
    arrived_s: float
    number: int
    is_measured: bool
    sizes_mm: tuple[float, ...]


class LiveTrend:
    """Sizes of the last frames. Call `add` from one thread, the rest from any."""

    def __init__(self) -> None:
        self._frames: deque[_Frame] = deque(maxlen=MOST_KEPT)
        self._names: tuple[str, ...] = NAMES
        self._turn = threading.Lock()

    def clear(self) -> None:
        """Remove all frames."""
        with self._turn:
            self._frames.clear()

    def add(self, result: LiveResult) -> None:
        """Add the next frame."""
        done_s, measures = time.monotonic(), result.measurement.measures
        sizes = sizes_of(measures)
        numbers = (*(s.value_mm for s in sizes), *(s.sigma_mm for s in sizes))
        frame = _Frame(done_s, result.arrived_s, result.frame, measures is not None, numbers)
        with self._turn:
            if frame.is_measured:
                self._names = tuple(size.name for size in sizes)
            self._frames.append(frame)
            while self._frames[0].done_s < done_s - TREND_S:
                self._frames.popleft()

    def pace(self) -> Pace:
        """Return the present rate of measuring."""
        since_s = time.monotonic() - RATE_S
        with self._turn:
            late = list(takewhile(lambda each: each.done_s > since_s, reversed(self._frames)))
        failed = sum(not each.is_measured for each in late)
        return Pace((len(late) - failed) / RATE_S, len(late), failed)

    def over(self, last_s: float, limits: Limits) -> LiveSizes:
        """Return the sizes of the last seconds' frames, compared with limits."""
        now_s = time.monotonic()
        with self._turn:
            late = [each for each in self._frames if each.arrived_s > now_s - last_s]
        sizes = np.array([each.sizes_mm for each in late], float).reshape(len(late), 6).T
        value, sigma = sizes[:3], sizes[3:]
        return LiveSizes(
            self._names,
            np.array([each.number for each in late], np.int64),
            np.array([each.arrived_s for each in late], float) - now_s,
            value,
            sigma,
            np.array([beyond(value[k], sigma[k], limits.of(n)) for k, n in enumerate(NAMES)]),
        )
