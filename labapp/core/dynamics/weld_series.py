"""Time series of a weld's features, regressors of a penetration model, and transitions."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy import signal

from labapp.core.values import FloatArray, IntArray, ReadOnlyArrays

MOST_HELD = 5
"""Largest number of steps without a frame for which the previous features are held."""

MOST_TIME_STEPS = 1_000_000
"""Largest number of steps of a weld."""

LONGEST_MEMORY = 10_000
"""Largest number of steps on which a prediction depends."""

HOLD_S = 0.3
"""Shortest duration of a state, s; shorter ones are noise about the limit."""


@dataclass(frozen=True)
class WeldSeries(ReadOnlyArrays):
    """Features of one weld over time, and its penetration where measured on sections or scans.

    Parameters
    ----------
    name
        Name of the recording.
    time_s
        Times, shape (n,), ascending, s.
    value
        Features, shape (n, k); a row with NaN is ignored.
    noise, level
        Their standard uncertainties from noise, independent from frame to frame, and from the
        level, common to all frames; shape (n, k). The uncertainty from the set-up is common to all
        welds of a bench, and part of the model.
    target, target_sigma
        Measured penetration and its standard uncertainty, shape (n,), mm; NaN where unknown.
    """

    name: str
    time_s: FloatArray
    value: FloatArray
    noise: FloatArray
    level: FloatArray
    target: FloatArray
    target_sigma: FloatArray


def in_steps(weld: WeldSeries, step_s: float) -> WeldSeries:
    """Average a series over equal time steps.

    A step without frames holds the previous features, for at most `MOST_HELD` steps. The steps run
    from the first frame with all features to the last frame.

    Raises
    ------
    ValueError
        If there are no frames, or more than `MOST_TIME_STEPS`.
    """
    there = np.isfinite(weld.value).all(axis=1)
    if not there.any():
        raise ValueError(f"{weld.name} has no frame with all features")
    time_s, value = weld.time_s[there], weld.value[there]
    low, high = np.floor(np.array([time_s[0], weld.time_s[-1]]) / step_s + 1e-9)
    if high - low >= MOST_TIME_STEPS:
        raise ValueError(f"{weld.name} has more than {MOST_TIME_STEPS} steps of {step_s:g} s")
    count = int(high - low) + 1
    place = (np.floor(time_s / step_s + 1e-9) - low).astype(int)

    def summed(of: FloatArray, at: IntArray) -> FloatArray:
        return np.array([np.bincount(at, column, count) for column in of.T]).T

    frames = np.bincount(place, minlength=count)
    last = np.maximum.accumulate(np.where(frames > 0, np.arange(count), 0))
    known = (np.arange(count) - last <= MOST_HELD)[:, None]
    n = np.maximum(frames, 1)[:, None]
    noise, level = (np.nan_to_num(part[there]) for part in (weld.noise, weld.level))
    cut = np.isfinite(weld.target[there])
    target = weld.target[there][cut], np.nan_to_num(weld.target_sigma[there][cut]) ** 2
    sections = np.bincount(place[cut], minlength=count)
    total, variance = (np.bincount(place[cut], of, count) for of in target)
    m = np.where(sections > 0, sections, np.nan)
    return WeldSeries(
        weld.name,
        (low + np.arange(count) + 0.5) * step_s,
        np.where(known, (summed(value, place) / n)[last], np.nan),
        np.where(known, (np.sqrt(summed(noise**2, place)) / n)[last], np.nan),
        np.where(known, (summed(level, place) / n)[last], np.nan),
        total / m,
        np.sqrt(variance) / m,
    )


# --- dynamics -----------------------------------------------------------------------------------


@dataclass(frozen=True)
class Orders:
    """Orders of the dynamics.

    Parameters
    ----------
    poles
        n_a: number of time constants of A(q), 0 to 2.
    lags
        n_b: number of steps of the features used.
    delay
        n_k: delay of the first of them, steps.
    """

    poles: int = 1
    lags: int = 1
    delay: int = 0


def impulse_response(time_constants_s: Sequence[float], step_s: float) -> FloatArray:
    """Finite impulse response of 1/A(q), first-order lags in series, with unit sum, shape (m,)."""
    count = int(np.ceil(8 * sum(time_constants_s) / step_s)) + 1
    response = np.eye(1, count)[0]
    for time_s in time_constants_s:
        response = signal.lfilter([1.0], [1.0, -np.exp(-step_s / time_s)], response)
    return np.asarray(response / response.sum())


def regressors(
    steps: WeldSeries, response: FloatArray, orders: Orders
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return filtered features at each step, and their noise and level; each (n, lags·k).

    At the beginning, and after a gap, the features are assumed to have been constant before.
    """
    count, width = steps.value.shape
    found = np.full((3, count, orders.lags * width), np.nan)
    before = len(response) + orders.delay + orders.lags
    gap = np.flatnonzero(~np.isfinite(steps.value[:, 0]))
    for begin, end in zip([0, *(gap + 1)], [*gap, count], strict=True):
        if begin == end:
            continue
        for k, (of, kernel) in enumerate(
            ((steps.value, response), (steps.noise**2, response**2), (steps.level, response))
        ):
            padded = np.vstack([np.repeat(of[begin : begin + 1], before, 0), of[begin:end]])
            smooth = signal.lfilter(kernel, [1.0], padded, axis=0)
            firsts = before - orders.delay - np.arange(orders.lags)
            found[k, begin:end] = np.hstack([smooth[f : f + end - begin] for f in firsts])
    return found[0], np.sqrt(found[1]), found[2]


def find_transitions(time_s: FloatArray, value: FloatArray, full_mm: float) -> FloatArray:
    """Find the times at which penetration becomes full, shape (k,), s, by linear interpolation.

    States shorter than `HOLD_S` are treated as noise. NaN values are ignored.
    """
    known = np.isfinite(value)
    time_s, value = time_s[known], value[known]
    if not len(value):
        return np.empty(0)
    is_full = value >= full_mm
    for state in (False, True):  # short partial ones first
        edges = np.flatnonzero(np.diff(is_full)) + 1
        for begin, end in pairwise([*edges, len(value)]):
            lasts_s = time_s[min(end, len(value) - 1)] - time_s[begin]
            if is_full[begin] == state and lasts_s < HOLD_S:
                is_full[begin:end] = not state
    at = np.flatnonzero(~is_full[:-1] & is_full[1:])
    rise = value[at + 1] - value[at]
    share = np.where(rise > 0, (full_mm - value[at]) / np.where(rise > 0, rise, 1.0), 0.5)
    return np.asarray(time_s[at] + np.clip(share, 0, 1) * (time_s[at + 1] - time_s[at]))
