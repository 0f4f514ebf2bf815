"""Compiled inner loops of `level` (docs/adr/0018)."""

from __future__ import annotations

import numpy as np
from numba import types

from labapp.core.compiled import BOOLS_1, FLOAT, FLOATS_1, FLOATS_2, FLOATS_3, INT, INTS_1
from labapp.core.compiled import compiled as _compiled
from labapp.core.compiled import inner as _inner
from labapp.core.surface.kernels.ray_kernels import rise_per_depth
from labapp.core.surface.kernels.spline_kernels import drop_share
from labapp.core.values import BoolArray, FloatArray, IntArray

_levels = types.Tuple((FLOAT, FLOAT, INT))  # type: ignore[no-untyped-call]

EPS = 1e-12
"""A factor of 1 plus less than this is replaced by 1: a thousand of them do not change the
level."""

FARTHEST = -np.log(EPS)
"""Terms exp(−x) with a larger x are such factors."""

STEPS_PER_REACH = 120
"""Grid steps per unit of reach, over both sides together; `negative_log_evidence` uses as many on
each side."""

NEAR_RISES = 3.0
"""Rays that land farther than this from the boundary, in spacings, are ignored."""

RAYS_PER_LOG = 500
"""Rays after which the product is replaced by its logarithm: even twice as many factors of at most
2 would not overflow."""

SCAN_LEVELS, SCANNED_REACH = 300, 0.6
"""Number of levels that are tried if no estimate is given, and reach of the search around the best
of them."""

MOST_AT_ENDS, MOST_AT_FAR_ENDS = 1e-6, 0.02
"""A wider grid is searched if the probability at the ends of the grid exceeds this: the first for a
narrow grid (reach below 1), the second for a wide one."""

# Blurs: width of the step from inside to outside, in dot spacings, from a sharp boundary to one
# that half of the neighbouring rays contradict; and −log of their prior, nats: sharp is likelier.
BLUR_WIDTHS = np.geomspace(1 / 200, 1 / 4, 9)
BLURS = np.array([BLUR_WIDTHS, 1.2 * np.log(BLUR_WIDTHS)])

# Drops: depths of the rear, mm. Prior: half of all rears lie below the work piece; logarithms of
# their depths are equally likely.
DROPS_MM = np.concatenate([[0.0], np.geomspace(0.005, 0.15, 12)])
SHARE_SUNK = 0.5


def sunk_cost(drops_mm: FloatArray) -> float:
    """−log of the prior of every drop but the first, which is none, over that of none, nats."""
    return -float(np.log(SHARE_SUNK / (1 - SHARE_SUNK) / (len(drops_mm) - 1)))


SUNK_COST = sunk_cost(DROPS_MM)

LIKELY_SUNK = 0.8
"""The rear is on the work piece unless it is below with a larger probability than this. Otherwise
the surface would be extrapolated to a depth that hardly any ray shows."""


@_inner
def _multiply(factors: FloatArray, term: float, ratio: float) -> None:
    """Multiply each entry by 1 + the next term of a geometric progression."""
    for k in range(len(factors)):
        factors[k] *= 1.0 + term
        term *= ratio


@_inner
def _accumulate(
    factors: FloatArray, lines: FloatArray, start: float, slope: float, grows: float, sign: float
) -> None:
    """Add log(1 + exp(−(start + k · slope))) to every level k, with a sign.

    Along the levels the exponential is a geometric progression, with ``grows`` = exp |slope| or its
    inverse. Where its exponent is positive it is taken out of the logarithm, into the sums of
    starts and of slopes, ``lines``.
    """
    count = len(factors)
    if min(start, start + (count - 1) * slope) > FARTHEST:
        return  # nothing to add: most rays land far on the correct side
    turn = -start / slope if slope != 0.0 else np.inf * start
    turn = int(min(max(np.ceil(turn), 0.0), count)) if not np.isnan(turn) else 0
    begins, ends = (0, turn) if slope > 0.0 else (turn, count)
    for at, way in ((begins, -sign), (ends, sign)):
        lines[0, at] += way * start
        lines[1, at] += way * slope
    reach = min(FARTHEST / abs(slope), count)  # number of levels with a term of `EPS` or more
    if turn < count and abs(start + turn * slope) < FARTHEST:
        after = factors[turn : turn + int(reach) + 1]
        _multiply(after, np.exp(-abs(start + turn * slope)), 1.0 / grows)
    if turn > 0 and abs(start + (turn - 1) * slope) < FARTHEST:
        low = max(turn - int(reach) - 1, 0)
        _multiply(factors[low:turn], np.exp(-abs(start + low * slope)), grows)


@_inner
def _sums_of(
    rays: IntArray,
    over: FloatArray,
    sharp: FloatArray,
    dark: BoolArray,
    missing: float,
    levels: tuple[float, float, int],
) -> FloatArray:
    """Sum of the terms of some rays at each level, see `level_negative_log_likelihood`: (d, count).

    A product of factors is kept instead of a sum of logarithms, see `_accumulate`.
    """
    drops, (first, step, count) = len(over), levels
    nats, factors = np.zeros((drops, count)), np.ones((drops, 2, count))
    lines = np.zeros((drops, 2, count + 1))
    for m in range(len(rays)):
        n = rays[m]
        slope = sharp[n] * step
        grows = np.exp(abs(slope))
        for d in range(drops):
            start = sharp[n] * (over[d, n] + first)
            _accumulate(factors[d, 0], lines[d], start, slope, grows, 1.0)
            if dark[n] and missing > 0.0:
                with_dot = start - np.log(missing)
                _accumulate(factors[d, 1], lines[d], with_dot, slope, grows, -1.0)
        if m % RAYS_PER_LOG == RAYS_PER_LOG - 1:
            nats += np.log(factors[:, 0] / factors[:, 1])
            factors[:] = 1.0
    for d in range(drops):
        start, slope = 0.0, 0.0
        for k in range(count):
            start, slope = start + lines[d, 0, k], slope + lines[d, 1, k]
            added = np.log(factors[d, 0, k] / factors[d, 1, k]) + start + k * slope
            nats[d, k] = max(nats[d, k] + added, 0.0)  # rounded
    return nats


@_compiled(FLOATS_2, FLOATS_1, BOOLS_1, FLOATS_1, FLOAT, _levels, FLOATS_2)
def level_negative_log_likelihood(
    over: FloatArray,
    signed_sharpness: FloatArray,
    dark: BoolArray,
    spread: FloatArray,
    missing: float,
    levels: tuple[float, float, int],
    blurs: FloatArray,
) -> FloatArray:
    """−log likelihood of lit and dark rays at levels.

    With x = signed_sharpness · (over + level) / √(blur² + spread), a lit ray has
    P = 1/(1 + exp(−x)), up to a factor common to all levels. A dark ray, of the opposite sign,
    either lands outside, or lands inside and its dot is missing:
    P = (1 + m · exp(−x))/(1 + exp(−x)).

    Parameters
    ----------
    over
        Height of the surface over the boundary where n rays land, for each of d drops of the
        rear, shape (d, n), mm.
    signed_sharpness
        +1 or −1 of each ray, lit or dark, over its rise (`find_level`), shape (n,), mm⁻¹.
    dark
        Which rays are dark, shape (n,).
    spread
        Widens the blur where the height is uncertain (`spread_of`), in squared spacings of the
        rays, shape (n,).
    missing
        m, the share of the dots that are missing, from 0.
    levels
        The first, mm, the step to the next, above 0, and how many.
    blurs
        In ascending order, in spacings of the rays, and −log of their priors, shape (2, b).

    Returns
    -------
    FloatArray
        Nats, shape (d, b, count); may be infinite where negligible.
    """
    drops, (first, step, count) = len(over), levels
    made = np.full((drops, blurs.shape[1], count), np.inf)
    is_same = np.ones(len(signed_sharpness), np.bool_)
    for d in range(1, drops):
        is_same &= over[d] == over[0]
    # Rays at the head lie as high whatever the drop: their terms are added once.
    same, others = np.flatnonzero(is_same), np.flatnonzero(~is_same)
    least = np.inf
    for b in range(blurs.shape[1] - 1, -1, -1):
        sharp = signed_sharpness / np.sqrt(blurs[0, b] * blurs[0, b] + spread)
        common = _sums_of(same, over[:1], sharp, dark, missing, levels)[0]
        # The other rays can only add to it. Negligible levels at the ends are left out.
        likely = np.flatnonzero(~(common + blurs[1, b] > least + FARTHEST))  # NaN, too
        if len(likely) == 0:
            continue
        low, high = likely[0], likely[-1] + 1
        part = first + low * step, step, high - low
        nats = _sums_of(others, over, sharp, dark, missing, part) + common[low:high]
        made[:, b, low:high] = nats
        least = min(least, nats.min() + blurs[1, b])
    return made


@_compiled(FLOATS_3, FLOATS_1, FLOAT, FLOATS_1, FLOAT, FLOAT)
def level_posterior(
    nats: FloatArray,
    blur_cost: FloatArray,
    sunk: float,
    drops: FloatArray,
    first: float,
    step: float,
) -> tuple[float, float, float, float, float, float]:
    """Posterior of the level and of the rear's drop, marginalised over blurs.

    Parameters
    ----------
    nats
        Result of `level_negative_log_likelihood`, shape (d, b, count).
    blur_cost, sunk
        −log of the priors of blurs, shape (b,), and of every drop but the first, nats.
    drops
        The drops, shape (d,), mm; the first is none.
    first, step
        The levels: the first, mm, and the step to the next.

    Returns
    -------
    mean, sigma, drop, drop_sigma, covariance, at_ends
        Expected level and drop, given that there is a drop or none (`LIKELY_SUNK`), and
        their standard deviations over both, mm; their covariance, mm²; probability of the first and
        last levels together.
    """
    depths, blurs, count = nats.shape
    least = np.inf
    for d in range(depths):
        for b in range(blurs):
            for k in range(count):
                least = min(least, nats[d, b, k] + blur_cost[b] + (sunk if d else 0.0))
    share = np.zeros((depths, count))
    for d in range(depths):
        for b in range(blurs):
            for k in range(count):
                against = nats[d, b, k] + blur_cost[b] + (sunk if d else 0.0)
                if against < least + FARTHEST:
                    share[d, k] += np.exp(least - against)
    share /= share.sum()
    start, end = (1, depths) if share[0].sum() < 1.0 - LIKELY_SUNK else (0, 1)
    chosen, drop, mean = share[start:end].sum(), 0.0, 0.0
    for d in range(start, end):
        for k in range(count):
            drop += share[d, k] / chosen * drops[d]
            mean += share[d, k] / chosen * (first + k * step)
    spread, drop_spread, covariance = 0.0, 0.0, 0.0
    for d in range(depths):
        deeper = drops[d] - drop
        for k in range(count):
            higher = first + k * step - mean
            spread += share[d, k] * higher**2
            drop_spread += share[d, k] * deeper**2
            covariance += share[d, k] * higher * deeper
    at_ends = share[:, 0].sum() + share[:, -1].sum()
    return mean, np.sqrt(spread), drop, np.sqrt(drop_spread), covariance, at_ends


@_inner
def rises_of(slope: FloatArray, spacing: FloatArray) -> tuple[FloatArray, float]:
    """Change of a surface's height from one ray to the next along the gradient.

    Returns its values at m landing points, limited to at least a quarter of the median, shape (m,),
    mm, and the median.
    """
    rises = np.empty(len(slope))
    for n in range(len(rises)):
        rises[n] = np.hypot(slope[n, 0] * spacing[0], slope[n, 1] * spacing[1]) + 1e-6
    usual = np.median(rises)
    return np.maximum(rises, usual / 4.0), usual


@_compiled(FLOATS_2, FLOATS_2, INTS_1, FLOATS_1, INT, FLOATS_2)
def scan_levels(
    height: FloatArray,
    slope: FloatArray,
    ray_states: IntArray,
    spacing: FloatArray,
    count: int,
    blur: FloatArray,
) -> tuple[float, int]:
    """Shift, mm, and sign with the largest likelihood, among ``count`` shifts and with one blur.

    The first four arguments are those of `find_level`.
    """
    rises, _ = rises_of(slope, spacing)
    over, first, exact = height[:1].copy(), -height[0].max(), np.zeros(height.shape[1])
    least, shift, pool_sign = np.inf, 0.0, 1
    levels = first, (height[0].max() - height[0].min()) / (count - 1), count
    for way in (1, -1):
        nats = level_negative_log_likelihood(
            over, way * ray_states / rises, ray_states < 0, exact, 0.0, levels, blur
        )[0, 0]
        at = np.argmin(nats)
        if nats[at] < least:
            least, shift, pool_sign = nats[at], first + at * levels[1], way
    return shift, pool_sign


@_inner
def spread_of(sigma: float, rise: float) -> float:
    """Square by which the uncertainty of a height widens the blur, in squared spacings.

    The mean of a logistic function over a normal distribution is close to a logistic function of
    the larger width √(s² + π σ²/8) (Spiegelhalter and Lauritzen 1990, Networks 20, 579–605).
    """
    return np.pi / 8.0 * (sigma / rise) ** 2


@_compiled(FLOATS_2, FLOATS_2, FLOATS_2, INTS_1, FLOATS_1, FLOATS_1, FLOATS_1, FLOATS_2)
def search_level(
    height: FloatArray,
    slope: FloatArray,
    landing: FloatArray,
    ray_states: IntArray,
    spacing: FloatArray,
    search: FloatArray,
    drops: FloatArray,
    blurs: FloatArray,
) -> tuple[FloatArray, float]:
    """Evaluate the posterior of levels, blurs and drops of the rear on a grid.

    Parameters
    ----------
    height, slope, landing, ray_states, spacing
        See `find_level`.
    search
        Sign of the head's side, position of the laser, mm, the level in the middle, mm, its sign,
        how far levels reach from there, in rises, the probability that a dot is missing, and −log
        of the prior of every drop but the first, nats.
    drops
        Drops of the rear, mm.
    blurs
        Blurs, in spacings of the rays, and −log of their priors, shape (2, b).

    Returns
    -------
    found, at_ends
        The level (`find_level`), shape (11,), and its probability at the ends of the grid.
    """
    head_sign, laser, (shift, pool_sign, reach, missing, sunk) = search[0], search[1:4], search[4:]
    rises, usual = rises_of(slope, spacing)
    per_depth = rise_per_depth(slope, landing, laser)
    low, high = np.inf, -np.inf
    for n in range(len(landing)):
        if ray_states[n] > 0:
            low, high = min(low, head_sign * landing[n, 1]), max(high, head_sign * landing[n, 1])
    start = (low + high) / 2.0
    end = min(low, start - 1e-6)  # a single row has no rear
    rear = np.array([0.0, head_sign * start, head_sign * end])
    near = np.flatnonzero(np.abs(height[0] + shift) < NEAR_RISES * rises)
    signed_sharpness, dark, spread = (
        np.empty(len(near)),
        np.empty(len(near), np.bool_),
        np.empty(len(near)),
    )
    for m in range(len(near)):
        at = near[m]
        signed_sharpness[m], dark[m] = pool_sign * ray_states[at] / rises[at], ray_states[at] < 0
        spread[m] = spread_of(height[1, at], rises[at])
    over = np.empty((len(drops), len(near)))
    for m in range(len(near)):
        at = near[m]
        lower = drop_share(rear, landing[at, 1])[0] * per_depth[at]
        for d in range(len(drops)):
            over[d, m] = height[0, at] + drops[d] * lower
    count = int(np.rint(STEPS_PER_REACH * reach)) + 1
    first, step = shift - reach * usual, 2.0 * reach * usual / (count - 1)
    levels = first, step, count
    nats = level_negative_log_likelihood(
        over, signed_sharpness, dark, spread, missing, levels, blurs
    )
    mean, sigma, drop, drop_sigma, covariance, at_ends = level_posterior(
        nats, blurs[1], sunk, drops, first, step
    )
    rear[0] = drop
    seen = nats.min(), float(len(near)), usual
    return np.array([mean, sigma, pool_sign, *rear, *seen, drop_sigma, covariance]), at_ends


@_compiled(FLOATS_2, FLOATS_2, FLOATS_2, INTS_1, FLOATS_1, FLOATS_1, FLOATS_1, FLOAT)
def find_level(
    height: FloatArray,
    slope: FloatArray,
    landing: FloatArray,
    ray_states: IntArray,
    spacing: FloatArray,
    bench: FloatArray,
    about: FloatArray,
    missing: float,
) -> FloatArray:
    """Find the level at which lit rays land inside the boundary and dark ones outside.

    A ray that lands a distance d inside the boundary was reflected with probability
    1/(1 + exp(−d/s)), and then has a dot unless that is missing. The posterior of level, blur s and
    drop of the rear is evaluated on a grid, which gives mean and standard deviation of the level.
    An uncertain height widens s for that ray.

    Parameters
    ----------
    height, slope
        Heights, up to the level, and their standard uncertainty, shape (2, m), mm, and gradients of
        the surface, shape (m, 2), at the landing points of m rays on z = 0.
    landing
        The landing points, shape (m, 3), mm.
    ray_states
        +1 lit, −1 dark, shape (m,).
    spacing
        Distance between neighbouring landing points along X and along Y, shape (2,), mm.
    bench
        +1 where the head lies towards +Y and the rear towards −Y, −1 for the reverse
        (`Rig.head_sign`); and the position of the laser, mm.
    about
        Initial estimate of the level: its shift, mm, its sign, and the reach of the search in
        rises, the typical change of the height from one ray to the next. If the ends of the grid
        are likely, a wider one is searched. A reach of NaN: all levels are tried. Then the depth of
        the rear, mm, or NaN to find it along with the level.
    missing
        Probability that a reflected ray has no dot (`Match.missing`).

    Returns
    -------
    FloatArray
        Shift, mm, its standard uncertainty, mm, and sign; drop, start and end of the rear, mm;
        least −log likelihood, number of rays, and usual rise, mm; standard uncertainty of the drop,
        mm, and its covariance with the shift, mm² (`level.Level`), shape (11,).
    """
    shift, pool_sign, reach, drop = about
    is_tried = False
    while True:
        if np.isnan(reach):
            scanned, way = scan_levels(
                height, slope, ray_states, spacing, SCAN_LEVELS, BLURS[:, -1:]
            )
            shift, pool_sign, reach, is_tried = scanned, float(way), SCANNED_REACH, True
        # Only pools above the work piece have been observed to sink at the rear.
        drops = np.array([0.0 if np.isnan(drop) else drop])
        if np.isnan(drop) and pool_sign > 0.0:
            drops = DROPS_MM.copy()
        more = np.array([shift, pool_sign, reach, missing, SUNK_COST])
        search = np.concatenate((bench, more))
        found, at_ends = search_level(
            height, slope, landing, ray_states, spacing, search, drops, BLURS
        )
        is_wide = reach >= 1.0
        if (is_tried and is_wide) or not at_ends > (MOST_AT_FAR_ENDS if is_wide else MOST_AT_ENDS):
            return found
        reach = np.nan if is_wide else 1.0


@_compiled(FLOATS_1, FLOATS_2, INTS_1, FLOATS_1, FLOATS_1, FLOAT, FLOATS_2)
def negative_log_evidence(
    height: FloatArray,
    slope: FloatArray,
    ray_states: IntArray,
    spacing: FloatArray,
    inside: FloatArray,
    missing: float,
    blurs: FloatArray,
) -> float:
    """−log probability of the states of rays, marginalised over levels near 0 and blurs, nats.

    ``inside`` is the height over the boundary (`Level.height_inside`), shape (m,), mm. ``blurs`` is
    that of `search_level`, ``height`` is taken as exact, shape (m,), mm, and the others are those
    of `find_level`. A constant is omitted.
    """
    rises, usual = rises_of(slope, spacing)
    near = np.flatnonzero(np.abs(height) < NEAR_RISES * rises)
    over, dark = inside[near].reshape(1, -1), ray_states[near] < 0
    signed_sharpness = ray_states[near] / rises[near]
    exact = np.zeros(len(near))
    levels = -usual, usual / STEPS_PER_REACH, 2 * STEPS_PER_REACH + 1
    nats = level_negative_log_likelihood(
        over, signed_sharpness, dark, exact, missing, levels, blurs
    )
    least, total = np.inf, 0.0
    for b in range(blurs.shape[1]):
        least = min(least, nats[0, b].min() + blurs[1, b])
    for b in range(blurs.shape[1]):
        total += np.exp(least - blurs[1, b] - nats[0, b]).sum()
    return float(least - np.log(total))


@_compiled(FLOATS_1, BOOLS_1)
def guess_level(height: FloatArray, outer: BoolArray) -> tuple[float, float, float]:
    """Shift that sets the mean of outer points to 0, std of all heights, mean of inner heights.

    Parameters are the heights up to their level, mm, and the mask of outer points, shape (n,).
    """
    inner = ~outer
    shift, mean = -np.sum(height * outer) / outer.sum(), np.sum(height * inner) / inner.sum()
    return shift, float(np.std(height)), mean
