"""A weld's features over time, filtered to what a penetration model takes, and its transitions."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy import signal

from labapp.core.values import FloatArray, IntArray, ReadOnlyArrays

MOST_HELD = 5
"""Steps without a frame for which the features before them are held."""

MOST_STEPS = 1_000_000
"""Steps of a weld at most."""

LONGEST_MEMORY = 10_000
"""Steps that a prediction depends on at most."""

HOLD_S = 0.3
"""For so long a state lasts at least: what is shorter is noise about the limit."""


@dataclass(frozen=True)
class WeldSeries(ReadOnlyArrays):
    """Features of one weld over time, and its penetration where sections or scans tell it.

    Parameters
    ----------
    name
        The recording's.
    time_s
        Shape (n,), ascending, s.
    value
        Features, shape (n, k); a row with NaN is left out.
    noise, level
        Their standard uncertainties by noise, independent from frame to frame, and by the level,
        the same in all frames; shape (n, k). That by the set-up is the same in all welds of a
        bench, and part of the model.
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
    """Mean over each even step; one without frames has the features before it, for `MOST_HELD`.

    From the first frame with all features to the last of all frames.

    Raises
    ------
    ValueError
        If there are no frames, or more than `MOST_STEPS`.
    """
    there = np.isfinite(weld.value).all(axis=1)
    if not there.any():
        raise ValueError(f"{weld.name} has no frame with all features")
    time_s, value = weld.time_s[there], weld.value[there]
    low, high = np.floor(np.array([time_s[0], weld.time_s[-1]]) / step_s + 1e-9)
    if high - low >= MOST_STEPS:
        raise ValueError(f"{weld.name} has more than {MOST_STEPS} steps of {step_s:g} s")
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
        n_a: how many time constants A(q) has, 0 to 2.
    lags
        n_b: how many steps of the features enter.
    delay
        n_k: how many steps before the present the first of them is.
    """

    poles: int = 1
    lags: int = 1
    delay: int = 0


def impulse_response(time_constants_s: Sequence[float], step_s: float) -> FloatArray:
    """1/A(q) as a finite response whose sum is 1, shape (m,): first-order lags in a row."""
    count = int(np.ceil(8 * sum(time_constants_s) / step_s)) + 1
    response = np.eye(1, count)[0]
    for time_s in time_constants_s:
        response = signal.lfilter([1.0], [1.0, -np.exp(-step_s / time_s)], response)
    return np.asarray(response / response.sum())


def regressors(
    steps: WeldSeries, response: FloatArray, orders: Orders
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Filtered features at each step, and their noise and level; each of shape (n, lags·k).

    Before the first step, and after a gap, the features are taken to have been what they are then.
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
    """Times at which penetration becomes full, shape (k,), s; linear between samples.

    States that last less than `HOLD_S` are taken to be noise. NaN values are left out.
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
