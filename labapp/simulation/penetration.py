"""Welds with a known law of penetration: the effect of the current on pool and back side.

The pool follows the current as a first-order lag. Above a limit it melts through: a back-side bead
appears, the pool sinks, and its width, length and convexity change, as in GTA welds of thin plates.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import signal

from labapp.core.dynamics.weld_series import WeldSeries
from labapp.core.values import FloatArray

FEATURES, TARGET = ("width_mm", "length_mm", "convexity_mm"), "back_width_mm"

RATE_HZ, DURATION_S, CURRENT_S = 30.0, 20.0, 2.5
"""Frames per second, duration of a weld, and mean duration of a current."""

POOL_S, BACK_S = 0.6, 0.25
"""Time constants of the pool and of the back side that follows it."""

FULL_MM = 0.5
"""Back-side width from which penetration is called full."""

NOISE = np.array([0.03, 0.05, 0.008])
LEVEL = np.array([0.02, 0.03, 0.004])
"""Standard uncertainties of the features: independent in each frame, and common to a weld, mm."""

SCAN_MM, SCAN_SIGMA_MM, NO_BEAD_SIGMA_MM = 0.25, 0.08, 0.02
"""Spacing of the points of a scan, and its standard uncertainty on a bead and without one."""

SCATTER_MM, SCATTER_S = 0.04, 1.0
"""Scatter of the back side that the pool does not explain: standard deviation, correlation time."""


def back_width_mm(drive: FloatArray) -> FloatArray:
    """Width of the back-side bead as a function of the drive, which is 1 at melt-through."""
    above = np.maximum(drive - 1.0, 0.0)
    return np.asarray(5.0 * above / (0.25 + above))


def pool_features(drive: FloatArray) -> FloatArray:
    """`FEATURES` of the pool as a function of the drive, shape (n, 3), mm."""
    bead = back_width_mm(drive)
    convexity = 0.22 - 0.06 * (drive - 1) - 0.06 * bead
    return np.column_stack([5.5 + 2.5 * (drive - 1), 7.0 + 4.5 * (drive - 1), convexity])


@dataclass(frozen=True)
class SimulatedWeld:
    """A weld and its ground truth.

    Parameters
    ----------
    series
        Measured features and the scan of the back side.
    back_width_mm
        True width of the back-side bead at each frame, shape (n,).
    """

    series: WeldSeries
    back_width_mm: FloatArray


def simulate_welds(count: int, seed: int) -> list[SimulatedWeld]:
    """Simulate welds whose current changes at random times between random values."""
    rng = np.random.default_rng(seed)
    return [_weld(f"weld_{k:02d}", rng) for k in range(1, count + 1)]


def _weld(name: str, rng: np.random.Generator) -> SimulatedWeld:
    time_s = np.arange(round(RATE_HZ * DURATION_S)) / RATE_HZ
    speed = float(rng.uniform(2.0, 3.0))
    edges = np.arange(CURRENT_S, DURATION_S, CURRENT_S) + rng.uniform(-0.5, 0.5)
    levels = rng.uniform(0.75, 1.45, len(edges) + 1)
    drive = first_order_lag(levels[np.searchsorted(edges, time_s)], POOL_S)
    truth, bead = pool_features(drive), back_width_mm(drive)
    share = np.exp(-1 / (SCATTER_S * RATE_HZ))
    white = rng.normal(0, SCATTER_MM * np.sqrt(1 - share**2), len(time_s))
    scatter = signal.lfilter([1.0], [1.0, -share], white)
    back = first_order_lag(bead, BACK_S)
    back = np.where(back > 0.05, np.maximum(back + scatter, 0.0), 0.0)
    measured = truth + rng.normal(0, NOISE, truth.shape) + rng.normal(0, LEVEL)
    place = np.arange(0.0, speed * time_s[-1], SCAN_MM)
    frame = np.unique(np.round(place / speed * RATE_HZ).astype(int))
    target, sigma = np.full((2, len(time_s)), np.nan)
    sigma[frame] = np.where(back[frame] > 0, SCAN_SIGMA_MM, NO_BEAD_SIGMA_MM)
    noise = np.where(back[frame] > 0, rng.normal(0, SCAN_SIGMA_MM, len(frame)), 0.0)
    target[frame] = np.maximum(back[frame] + noise, 0.0)
    parts = np.tile(NOISE, (len(time_s), 1)), np.tile(LEVEL, (len(time_s), 1))
    return SimulatedWeld(WeldSeries(name, time_s, measured, *parts, target, sigma), back)


def first_order_lag(
    values: FloatArray, time_constant_s: float, rate_hz: float = RATE_HZ
) -> FloatArray:
    """Apply a first-order lag that begins at rest."""
    pole = np.exp(-1 / (time_constant_s * rate_hz))
    start = [pole * values[0]]
    return np.asarray(signal.lfilter([1 - pole], [1.0, -pole], values, zi=start)[0])
