"""Change points of a series, and its response to a step of a driving signal.

Events are the change points of a piecewise linear series: the partition with the least sum of
squares plus a penalty for each change, found exactly by dynamic programming (Jackson et al. 2005;
penalty of Yao 1988). A response is that of a first- or second-order system with a delay.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy import ndimage, optimize

from labapp.core.values import FloatArray, ReadOnlyArrays, robust_sigma

BLOCKS = 200
"""A series is averaged to at most this many samples (blocks)."""

LEAST_BLOCKS = 4
"""Shortest time between two events, in blocks."""

PENALTY = 6.0
"""Penalty of an event, in units of the noise variance times ln(samples): it has three
parameters, and pure noise gives an event in 2 of 100 series."""

LAGS = (1, 2, 4, 8)
"""Lags of the second differences from which the noise of a pool's series is estimated, in blocks:
for correlated noise they grow with the lag."""

SECOND_ORDER_GAIN = 10.0
"""Least reduction of the cost, in variances, for a second-order response (BIC)."""


@dataclass(frozen=True)
class Event:
    """A change of a series.

    Parameters
    ----------
    time_s, sigma_s
        Time of the event and its standard uncertainty.
    change
        Step of the series, in its unit; near 0 if only its slope changes.
    slope_change_per_s
        Change of the slope.
    """

    time_s: float
    sigma_s: float
    change: float
    slope_change_per_s: float


RESPONSE_QUANTITIES = ("change", "delay_s", "time_constant_s", "rise_time_s", "overshoot")
"""Quantities of a step response: final change of the series, in its unit; time from the step to the
beginning of the response; τ of the first order, or the settling constant 1/(ζω₀) of the second;
rise time from 10 to 90 % of the change; overshoot as a share of the change, 0 for first order."""


@dataclass(frozen=True)
class StepResponse(ReadOnlyArrays):
    """Response of a series to a step.

    Parameters
    ----------
    before
        Level of the series before the step.
    value, sigma
        Values and standard uncertainties of `RESPONSE_QUANTITIES`, by name.
    order
        1 or 2.
    fitted
        The model at the fitted samples, shape (2, n): time, s, and value.
    """

    before: float
    value: dict[str, float]
    sigma: dict[str, float]
    order: int
    fitted: FloatArray


def find_events(
    time_s: FloatArray,
    values: FloatArray,
    resolution_s: float = 0.0,
    least: float = 0.0,
    lags: tuple[int, ...] = LAGS,
) -> tuple[Event, ...]:
    """Find the change points of a series, in order of time.

    Pure noise gives fewer than one in 1000 frames, even if it is correlated over about 5 of them.

    Parameters
    ----------
    time_s, values
        Times, ascending, s, and values, shape (n,).
    resolution_s
        Time resolution: at least the period of the pool's oscillation, which is averaged out. Never
        less than 1/`BLOCKS` of the series.
    least
        Least range of the fitted lines on both sides of an event; smaller changes are ignored.
    lags
        See `LAGS`; (1,) for a series with white noise that may have many events.
    """
    if len(time_s) < 4 * LEAST_BLOCKS:
        return ()
    step = float(np.median(np.diff(time_s)))
    width = max(resolution_s, (time_s[-1] - time_s[0]) / BLOCKS, step)
    block = ((time_s - time_s[0] + step / 2) / width).astype(int)
    number, place = np.unique(block, return_inverse=True)
    if len(number) < 4 * LEAST_BLOCKS:
        return ()
    at, level = (np.bincount(place, of) / np.bincount(place) for of in (time_s, values))
    noise = _noise(level, lags)
    ends = _partition(at, level, PENALTY * noise * np.log(len(at)))
    pieces = [*pairwise(ends)]
    return tuple(
        _event(at, level, first, last, noise)
        for first, last in pairwise(pieces)
        if _range(at, level, first, last) >= least
    )


def step_response(time_s: FloatArray, values: FloatArray, step_s: float) -> StepResponse | None:
    """Fit the response of a series to a step; None if it is not significant.

    First- and second-order models are fitted by least squares; the latter is chosen if it
    overshoots and fits clearly better. Noise may be correlated: ± are widened by its
    autocorrelation.

    Parameters
    ----------
    time_s, values
        Times, ascending, s, and values, shape (n,).
    step_s
        Time at which the driving signal changed.
    """
    time = time_s - step_s
    after = time > 0
    if after.sum() < 8 or (~after).sum() < 4:
        return None
    span, before = float(time[-1]), float(values[~after].mean())
    change = float(values[time > 0.7 * span].mean()) - before
    fits = []
    for tau in span * np.array([0.02, 0.1, 0.3]):
        start = [before, change, 0.0, tau]
        high = [np.inf, np.inf, span / 2, 3 * span]
        fits.append(_fitted(_first_order, time, values, start, high))
    first = min(fits, key=lambda one: one.cost)
    # Several initial periods, as the cost has local minima.
    fits = []
    for period in span * np.array([0.05, 0.15, 0.4]):
        start = [before, change, 0.0, period / 4, 0.5]
        fits.append(_fitted(_second_order, time, values, start, [*high[:3], 3 * span, 0.99]))
    second = min(fits, key=lambda one: one.cost)
    variance = 2 * second.cost / len(time)
    correlated = _inflation(second.fun)
    gain = 2 * (first.cost - second.cost) / max(variance * correlated, 1e-30)
    order = 2 if gain > SECOND_ORDER_GAIN else 1
    best, model = (second, _second_order) if order == 2 else (first, _first_order)
    variance = 2 * best.cost / max(len(time) - len(best.x), 1) * _inflation(best.fun)
    covariance = np.linalg.pinv(best.jac.T @ best.jac) * variance
    if abs(best.x[1]) < 4 * np.sqrt(covariance[1, 1]):
        return None

    def quantities(x: FloatArray) -> FloatArray:
        tau, over = (x[3], 0.0) if order == 1 else (x[3] / x[4], _overshoot(x[4]))
        return np.array([x[1], x[2], tau, x[3] * _rise(x[4] if order == 2 else None), over])

    steps = 1e-6 * np.maximum(np.abs(best.x), 1e-9)
    slope = np.column_stack(
        [(quantities(best.x + d) - quantities(best.x - d)) / (2 * d.max()) for d in np.diag(steps)]
    )
    sigma = np.sqrt(np.einsum("ij,jk,ik->i", slope, covariance, slope))
    found = dict(zip(RESPONSE_QUANTITIES, quantities(best.x).tolist(), strict=True))
    known = dict(zip(RESPONSE_QUANTITIES, sigma.tolist(), strict=True))
    course = np.stack([time_s, model(best.x, time)])
    return StepResponse(float(best.x[0]), found, known, order, course)


def _noise(level: FloatArray, lags: tuple[int, ...]) -> float:
    """Noise variance of samples from their second differences (robust to changes)."""
    seconds = [
        level[2 * lag :] - 2 * level[lag:-lag] + level[: -2 * lag]
        for lag in lags
        if 4 * lag < len(level)
    ]
    spread = max(map(robust_sigma, seconds)) / np.sqrt(6)
    # Lower limit for noise-free series: a thousandth of the range.
    return float(max(spread**2, (1e-3 * float(np.ptp(level))) ** 2, 1e-30))


def _range(
    at: FloatArray, level: FloatArray, before: tuple[int, int], after: tuple[int, int]
) -> float:
    """Range of the lines through two pieces."""
    lines = [
        np.polyval(np.polyfit(at[a:b], level[a:b], 1), at[[a, b - 1]]) for a, b in (before, after)
    ]
    return float(np.ptp(lines))


def _partition(at: FloatArray, level: FloatArray, penalty: float) -> list[int]:
    """Ends of the optimal pieces, starting with 0 and ending with n.

    The last sample of a piece is excluded from the fit: the change may lie within its block.
    """
    count = len(at)
    best, previous = np.full(count + 1, np.inf), np.zeros(count + 1, int)
    best[0] = -penalty
    cost = _line_costs(at, level)
    for end in range(LEAST_BLOCKS, count + 1):
        begins = np.arange(0, end - LEAST_BLOCKS + 1)
        total = best[begins] + cost(begins, end - 1) + penalty
        previous[end] = begins[np.argmin(total)]
        best[end] = total.min()
    ends = [count]
    while ends[-1]:
        ends.append(int(previous[ends[-1]]))
    return ends[::-1]


def _line_costs(at: FloatArray, level: FloatArray) -> Callable[..., FloatArray]:
    """Return a function for the residual sum of squares of lines from begins, (m,), to an end."""
    x, y = at - at.mean(), level - level.mean()
    sums = np.cumsum(np.stack([np.ones_like(x), x, y, x * x, x * y, y * y]), axis=1)
    sums = np.hstack([np.zeros((6, 1)), sums])

    def cost(begin: FloatArray, end: FloatArray) -> FloatArray:
        n, sx, sy, sxx, sxy, syy = sums[:, end][..., None] - sums[:, begin]
        xx, xy, yy = sxx - sx * sx / n, sxy - sx * sy / n, syy - sy * sy / n
        return np.asarray(yy - np.where(xx > 0, xy**2 / np.maximum(xx, 1e-300), 0))

    return cost


def _event(
    at: FloatArray, level: FloatArray, before: tuple[int, int], after: tuple[int, int], noise: float
) -> Event:
    """Event between two pieces, with the uncertainty of its time from the profile likelihood."""
    cost = _line_costs(at, level)
    middles = np.arange(before[0] + 3, after[1] - 2)
    total = np.array(
        [
            float(cost(np.array(before[:1]), m - 1)[0] + cost(np.array([m]), after[1] - 1)[0])
            for m in middles
        ]
    )
    weight = np.exp(-(total - total.min()) / (2 * noise))
    weight /= weight.sum()
    edge = at[middles - 1]
    time = float(weight @ edge)
    width = float(np.median(np.diff(at)))
    sigma = float(np.sqrt(weight @ (edge - time) ** 2 + width**2 / 12))
    ends = (before[0], before[1] - 1), (after[0], after[1] - 1)
    lines = [np.polyfit(at[a:b] - time, level[a:b], 1) for a, b in ends]
    slope, change = lines[1] - lines[0]
    return Event(time, sigma, float(change), float(slope))


def _first_order(x: FloatArray, time: FloatArray) -> FloatArray:
    """First-order response at times since the step; x: before, change, delay, τ."""
    late = np.maximum(time - x[2], 0)
    return np.asarray(x[0] + x[1] * -np.expm1(-late / x[3]))


def _second_order(x: FloatArray, time: FloatArray) -> FloatArray:
    """Second-order response at times since the step; x: before, change, delay, 1/ω₀, ζ < 1."""
    late = np.maximum(time - x[2], 0) / x[3]
    root = np.sqrt(1 - x[4] ** 2)
    swing = np.cos(root * late) + x[4] / root * np.sin(root * late)
    return np.asarray(x[0] + x[1] * (1 - np.exp(-x[4] * late) * swing))


def _fitted(
    model: Callable[[FloatArray, FloatArray], FloatArray],
    time: FloatArray,
    value: FloatArray,
    start: list[float],
    high: list[float],
) -> optimize.OptimizeResult:
    """Fit a model by least squares, with the delay bounded by about 0, and τ or 1/ω₀ and ζ > 0."""
    tiny = 1e-4 * float(time[-1])
    low = [-np.inf, -np.inf, -tiny, tiny, 0.02][: len(start)]
    scale = max(abs(start[1]), float(value.std()), 1e-12)
    scales = [scale, scale, tiny * 100, start[3], 0.3][: len(start)]
    return optimize.least_squares(
        lambda x: model(x, time) - value, start, bounds=(low, high), x_scale=scales
    )


def _overshoot(zeta: float) -> float:
    return float(np.exp(-np.pi * zeta / np.sqrt(1 - zeta**2)))


def _rise(zeta: float | None) -> float:
    """Rise time from 10 to 90 %, in units of τ or 1/ω₀."""
    if zeta is None:
        return float(np.log(9))
    peak = np.pi / np.sqrt(1 - zeta**2)  # the response is monotonic up to the peak
    unit = np.array([0.0, 1.0, 0.0, 1.0, zeta])
    crossing = [
        optimize.brentq(lambda t, h=height: _second_order(unit, np.array(t)) - h, 0, peak)
        for height in (0.1, 0.9)
    ]
    return float(crossing[1] - crossing[0])


def _inflation(residual: FloatArray) -> float:
    """Factor by which correlated noise increases variances of slow parameters, at least 1.

    Ratio of the residual's low-frequency power to its mean power.
    """
    power = np.abs(np.fft.rfft(residual - residual.mean()))[1:] ** 2
    low = max(len(power) // 20, 5)
    smooth = ndimage.uniform_filter1d(power, low)[low // 2]
    return max(1.0, float(smooth / max(power.mean(), 1e-300)))
