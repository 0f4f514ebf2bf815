"""Events in a series, and how it responds to a step of what drives it.

Events are changes of a series that is piecewise linear between them: the partition with the least
sum of squares and a penalty for each change, exactly, by dynamic programming (Jackson et al. 2005;
penalty of Yao 1988). A response is that of a first- or second-order system with a delay.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy import ndimage, optimize

from labapp.core.values import FloatArray, ReadOnlyArrays

BLOCKS = 200
"""A series is averaged to so many samples at most."""

LEAST_BLOCKS = 4
"""Shortest time between two events, in these."""

PENALTY = 6.0
"""Cost of an event, in variances of the noise times ln(samples): it has three
parameters, and noise alone has an event in 2 of 100 series."""

LAGS = (1, 2, 4, 8)
"""Lags of the second differences that the noise of a pool's series is taken from, in blocks: that
of correlated noise grows with the lag."""

SECOND_ORDER_GAIN = 10.0
"""Least fall of the cost, in variances, where a response overshoots rather than not (BIC)."""


@dataclass(frozen=True)
class Event:
    """A change of a series.

    Parameters
    ----------
    time_s, sigma_s
        When it is, and the standard uncertainty.
    change
        How much higher the series is after it, in its unit; where its slope changes that is near 0.
    slope_change_per_s
        How much faster it rises after it.
    """

    time_s: float
    sigma_s: float
    change: float
    slope_change_per_s: float


QUANTITIES = ("change", "delay_s", "time_constant_s", "rise_time_s", "overshoot")
"""Quantities of a step response: how much the series changes in the end, in its unit; from the step
to the response's beginning; τ of the first order, of the second 1/(ζω₀), with which it settles;
from 10 to 90 % of the change; largest excess as a share of the change, 0 of the first order."""


@dataclass(frozen=True)
class StepResponse(ReadOnlyArrays):
    """Response of a series to a step.

    Parameters
    ----------
    step_s
        When the driving signal changed.
    before
        The series before it.
    value, sigma
        Of each of `QUANTITIES` by name; standard uncertainties.
    order
        1 or 2.
    fitted
        The model at the samples that were used, shape (2, n): time, s, and value.
    """

    step_s: float
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
    """Change points of a series, in their order.

    Noise alone has less than one in 1000 frames, also where it is correlated over some 5 of them.

    Parameters
    ----------
    time_s, values
        Shape (n,), times ascending, s.
    resolution_s
        Changes within less are not looked for: at least the period of the pool's oscillation, which
        is averaged out. Never less than the `BLOCKS`-th part of the series.
    least
        Least range of the series on both sides of an event, by its lines; what changes by less is
        none.
    lags
        See `LAGS`; (1,) of a series whose noise is white and that may have many events.
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


def step_response(
    time_s: FloatArray, values: FloatArray, step_s: float, until_s: float | None = None
) -> StepResponse | None:
    """Response of a series to a step; None where it does not respond beyond its noise.

    First and second order are fitted by least squares; the latter is taken where it overshoots and
    explains clearly more. Noise may be correlated: ± are widened by its autocorrelation.

    Parameters
    ----------
    time_s, values
        Shape (n,), times ascending, s.
    step_s
        When the driving signal changed.
    until_s
        End of what belongs to the response: the next step. None: that of the series.
    """
    used = time_s <= (time_s[-1] if until_s is None else until_s)
    time, value = time_s[used] - step_s, values[used]
    after = time > 0
    if after.sum() < 8 or (~after).sum() < 4:
        return None
    span, before = float(time[-1]), float(value[~after].mean())
    change = float(value[time > 0.7 * span].mean()) - before
    fits = []
    for tau in span * np.array([0.02, 0.1, 0.3]):
        start = [before, change, 0.0, tau]
        high = [np.inf, np.inf, span / 2, 3 * span]
        fits.append(_fitted(_first_order, time, value, start, high))
    first = min(fits, key=lambda one: one.cost)
    # Starts from several periods: the cost has a minimum near each.
    fits = []
    for period in span * np.array([0.05, 0.15, 0.4]):
        start = [before, change, 0.0, period / 4, 0.5]
        fits.append(_fitted(_second_order, time, value, start, [*high[:3], 3 * span, 0.99]))
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
    found = dict(zip(QUANTITIES, quantities(best.x).tolist(), strict=True))
    known = dict(zip(QUANTITIES, sigma.tolist(), strict=True))
    course = np.stack([time_s[used], model(best.x, time)])
    return StepResponse(step_s, float(best.x[0]), found, known, order, course)


def _noise(level: FloatArray, lags: tuple[int, ...]) -> float:
    """Variance of the noise of samples, from their second differences (robust to changes)."""
    seconds = [
        level[2 * lag :] - 2 * level[lag:-lag] + level[: -2 * lag]
        for lag in lags
        if 4 * lag < len(level)
    ]
    spread = 1.4826 * max(float(np.median(np.abs(one))) for one in seconds) / np.sqrt(6)
    # Without noise, a thousandth of the range stands for it.
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
    """Ends of the optimal pieces, beginning with 0 and ending with n.

    The last sample of a piece counts in none: the change may lie amid what it is the mean of.
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
    """Sum of squares about the straight line of samples from begins, shape (m,), to an end."""
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
    """The change between two pieces, and how well its place is known (profile likelihood)."""
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
    """Value at times from the step; x: before, change, delay, τ."""
    late = np.maximum(time - x[2], 0)
    return np.asarray(x[0] + x[1] * -np.expm1(-late / x[3]))


def _second_order(x: FloatArray, time: FloatArray) -> FloatArray:
    """The same; x: before, change, delay, 1/ω₀, ζ < 1."""
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
    """Least squares with the delay from 0 on, 1/ω₀ or τ and ζ above 0."""
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
    """Time from 10 to 90 %, in τ or 1/ω₀."""
    if zeta is None:
        return float(np.log(9))
    peak = np.pi / np.sqrt(1 - zeta**2)  # it rises all the way to there
    unit = np.array([0.0, 1.0, 0.0, 1.0, zeta])
    crossing = [
        optimize.brentq(lambda t, h=height: _second_order(unit, np.array(t)) - h, 0, peak)
        for height in (0.1, 0.9)
    ]
    return float(crossing[1] - crossing[0])


def _inflation(residual: FloatArray) -> float:
    """By how much correlated noise widens variances of what varies slowly, at least 1.

    The residual's power at low frequency over its mean.
    """
    power = np.abs(np.fft.rfft(residual - residual.mean()))[1:] ** 2
    low = max(len(power) // 20, 5)
    smooth = ndimage.uniform_filter1d(power, low)[low // 2]
    return max(1.0, float(smooth / max(power.mean(), 1e-300)))
