"""Clock offset of a data logger, from the correlation of a signal with the frames' brightness."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import optimize, signal

from labapp.core.values import FloatArray

LEAST_CORRELATION = 0.5
"""Least absolute correlation of signal and light that is accepted."""

LEAST_OVERLAP = 0.25
"""Least overlap of signal and light, as a share of the largest possible one."""

LONGEST = 20_000_000
"""Longest signal and light that are correlated, in quarters of a frame: what fits into memory."""

RIVAL = 0.8
"""Another offset is ambiguous above this share of the best squared correlation: periodic pulses."""


@dataclass(frozen=True)
class Offset:
    """Offset of a signal on the recording's clock.

    Parameters
    ----------
    start_s, sigma_s
        Offset to add to the signal's times to obtain the recording's, and its standard uncertainty
        from the scatter of the light.
    correlation
        Correlation of signal and light at this offset; negative if more current gives less light.
    rival_s
        Another offset that fits about as well; None if there is none.
    """

    start_s: float
    sigma_s: float
    correlation: float
    rival_s: float | None


def find_offset(
    signal_s: FloatArray, values: FloatArray, light_s: FloatArray, light: FloatArray
) -> Offset | None:
    """Estimate the offset of a signal's clock by correlation with the mean brightness of frames.

    The light is modelled as a linear function of the signal averaged over a frame, which holds
    approximately for current and arc light. Frames may be missing.

    Parameters
    ----------
    signal_s, values
        Times of the signal's samples, ascending, shape (m,), s, and its values.
    light_s, light
        Times of the frames, ascending, shape (n,), s, and their mean brightness.

    Returns
    -------
    Offset or None
        None if the two do not correlate (`LEAST_CORRELATION`).

    Raises
    ------
    ValueError
        If one of them is longer than `LONGEST` quarters of a frame: a unit of time may be wrong.
    """
    there = np.isfinite(values)
    signal_s, values = signal_s[there], values[there]
    if len(values) < 8 or len(light) < 8 or np.ptp(values) == 0 or np.ptp(light) == 0:
        return None
    step = float(np.median(np.diff(light_s)))
    longest_s = max(float(np.ptp(signal_s)), float(np.ptp(light_s)))
    if longest_s > LONGEST * step / 4:
        raise ValueError(f"{longest_s:g} s, at {1 / step:g} frames/s")
    even_s = np.arange(signal_s[0], signal_s[-1], step / 4)
    # Mean of the signal over each frame's duration.
    area = np.concatenate([[0], np.cumsum(np.diff(signal_s) * (values[1:] + values[:-1]) / 2)])
    ends = np.clip(np.stack([even_s, even_s + step]), signal_s[0], signal_s[-1])
    first, last = np.interp(ends, signal_s, area)
    mean = (last - first) / np.maximum(ends[1] - ends[0], 1e-12)
    lags_s, share = _correlations(even_s, mean, light_s, light, step / 4)
    if not len(share) or np.max(np.abs(share)) < LEAST_CORRELATION:
        return None
    best = int(np.argmax(np.abs(share)))

    def rest(start_s: float) -> FloatArray:
        shifted = np.interp(light_s - start_s, even_s, mean)
        within = (light_s - start_s >= even_s[0]) & (light_s - start_s <= even_s[-1])
        columns = np.column_stack([np.ones_like(shifted), shifted])[within]
        weights = np.linalg.lstsq(columns, light[within], rcond=None)[0]
        return np.asarray(light[within] - columns @ weights)

    def cost(start_s: float) -> float:
        return float(np.mean(rest(start_s) ** 2))

    near = lags_s[best] + np.array([-step, step])
    start = float(optimize.minimize_scalar(cost, near, bounds=near, method="bounded").x)
    residual = rest(start)
    least, beside = cost(start), cost(start + step / 2) + cost(start - step / 2)
    curvature = (beside - 2 * least) / (step / 2) ** 2
    power = max(float(residual @ residual), 1e-30)
    lag1 = float(np.clip(float(residual[1:] @ residual[:-1]) / power, 0, 0.99))
    variance = 2 * least / (len(residual) * max(curvature, 1e-30)) * (1 + lag1) / (1 - lag1)
    others = signal.find_peaks(np.abs(share))[0]
    others = others[np.abs(lags_s[others] - start) > 2 * step]
    rivals = others[share[others] ** 2 > RIVAL * share[best] ** 2]
    rival = rivals[np.argsort(-np.abs(share[rivals]))][:1]
    return Offset(
        start,
        float(np.sqrt(variance + (step / 12) ** 2)),
        float(share[best]),
        float(lags_s[rival[0]]) if len(rival) else None,
    )


def _correlations(
    even_s: FloatArray, mean: FloatArray, light_s: FloatArray, light: FloatArray, step: float
) -> tuple[FloatArray, FloatArray]:
    """Offsets, shape (k,), s, and the correlation of signal and light at each."""
    place = np.round((light_s - light_s[0]) / step).astype(int)
    lit, mask = np.zeros(place[-1] + 1), np.zeros(place[-1] + 1)
    lit[place], mask[place] = light - light.mean(), 1.0
    one, x = np.ones_like(mean), mean - mean.mean()

    def sums(of_light: FloatArray, of_signal: FloatArray) -> FloatArray:
        return np.asarray(signal.correlate(of_light, of_signal, "full", "fft"))

    n = np.maximum(sums(mask, one), 1e-9)
    sx, sxx, sy, syy = sums(mask, x), sums(mask, x * x), sums(lit, one), sums(lit * lit, one)
    covariance = sums(lit, x) - sx * sy / n
    variances = np.maximum(sxx - sx**2 / n, 1e-9 * sxx) * np.maximum(syy - sy**2 / n, 1e-9 * syy)
    share = covariance / np.sqrt(np.maximum(variances, 1e-300))
    lags = signal.correlation_lags(len(lit), len(mean))
    enough = n >= LEAST_OVERLAP * n.max()
    return (light_s[0] - even_s[0] + lags * step)[enough], share[enough]
