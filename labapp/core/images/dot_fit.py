"""Joint fit of all dots to a picture: positions unbiased by neighbouring dots, and their σ.

Every dot is modelled as a round Gaussian; the light of neighbours and background in its window is
subtracted by their models. Speckle, which is proportional to the light, scatters the positions more
than the camera's noise does. Its strength is estimated from the residual light, in modes that are
orthogonal to a shift of the dot.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from labapp.core.images.dots import Grey, Picture
from labapp.core.values import FloatArray, IntArray, ReadOnlyArrays

WINDOW, CLOSE_WINDOW = 1.54, 1.3
"""Largest and smallest width of a dot's window, in dot sizes: of an isolated dot and of a dot with
close neighbours. A wider window reduces the effect of speckle, but increases that of noise and
neighbours."""

WINDOW_SHARE = 0.275
"""Window width over the distance to the nearest dot, between these limits."""

ROUNDS, SETTLED_PX = 12, 0.002
"""Most iterations of the fit; it has converged when positions move by less than this, px."""

ALIKE = 1.0
"""Weight of the common dot size over that of the dot's own light in the estimate of its size."""

MOST_GROWTH, MOST_MOVE = 0.25, 1.0
"""Largest relative change of a size and largest change of a position, px, in one iteration."""

REACH_SIZES = 10.0
"""Dots that are this many sizes apart have no light in each other's windows."""

ASTRAY = 2.0
"""A fitted position farther than this many dot sizes from its start is replaced by the start."""

BLUR_PX, BLUR_POWER = 0.8, 1.8
"""Typical standard deviation of a camera's blur, and the exponent of (1 − blur²/size²) in the ratio
of speckle power in one order of modes to that in the previous one."""

USUAL_PX2 = 0.2
"""Prior strength of speckle, px², which is also its standard uncertainty."""

LEAST_RATIO, RULE_SIGMA = 0.05, 0.8
"""Least ratio of speckle power two orders on; standard uncertainty of its logarithm as predicted
from the blur."""

OVERLAP, OVERLAP_SIZES, MOST_TAKEN = 1.2, 2.35, 0.11
"""Share of a dot's noise that the fit of a neighbour absorbs: a Gaussian of their distance, in
sizes, with this height and width, limited to the last number."""

ALONE = 0.9
"""A dot is isolated if its neighbours' fit leaves more than this share of its noise."""

OUTLIER = 9.0
"""Squares of projections are clipped at this many times their expectation."""


@dataclass(frozen=True)
class FittedDots(ReadOnlyArrays):
    """Fitted dots; every array has shape (n,).

    Parameters
    ----------
    u_px, v_px
        Place.
    u_sigma_px, v_sigma_px
        Its standard uncertainty.
    size_px
        Standard deviation of the dot's light.
    """

    u_px: FloatArray
    v_px: FloatArray
    u_sigma_px: FloatArray
    v_sigma_px: FloatArray
    size_px: FloatArray


def fit_dots(
    picture: Picture,
    around: tuple[Grey, float],
    start: FloatArray,
    noise: FloatArray,
) -> FittedDots:
    """Fit dots to a picture by iterated least squares.

    Parameters
    ----------
    picture
        Shape (height, width).
    around
        The picture, downsampled and blurred by a Gaussian, and that Gaussian's standard deviation
        in pixels of the original picture.
    start
        Initial u, v, peak and size of each dot, shape (n, 4).
    noise
        Standard deviation of the camera's noise at each dot, shape (n,), grey levels.
    """
    from labapp.core.images import dot_fit_kernels as kernels
    from labapp.core.images.band_pass_kernels import next_apart

    dots, median_size = np.array(start, np.float64), float(np.median(start[:, 3]))
    by, blur = picture.shape[1] / around[0].shape[1], around[1]
    number, begin = kernels.neighbours(dots[:, 0], dots[:, 1], REACH_SIZES * median_size)
    move = np.inf
    next_px = next_apart(np.ascontiguousarray(dots[:, :2]))

    for last in range(ROUNDS + 1):
        median_size = float(np.median(dots[:, 3]))
        width = np.clip(WINDOW_SHARE * next_px, CLOSE_WINDOW * median_size, WINDOW * median_size)
        margin = int(np.ceil(2.2 * width.max())) + 1
        rest = kernels.without_dots(around[0], by, blur, dots)
        if last == ROUNDS or move < SETTLED_PX:
            break
        sums = kernels.residual_sums(picture, rest, blur, dots, width, number, begin, margin)
        move = _improve(dots, sums, width)
    modes = kernels.residual_modes(picture, rest, blur, dots, width, number, begin, margin)
    free = _free_share(dots, number, begin)
    speckle = _speckle(modes, dots, noise, free)
    variance = noise**2 * modes[:2, :, 1] + speckle * modes[:2, :, 2]
    sigma = np.sqrt(variance / free) / _pull(dots, width)
    u, v = start[:, :2].T
    most, (high, wide) = ASTRAY * median_size, picture.shape
    # The band-pass reflects the picture at its edges, which draws peaks near them outwards.
    at_rim = np.minimum(np.minimum(u, wide - 1 - u), np.minimum(v, high - 1 - v)) < most
    astray = np.hypot(dots[:, 0] - u, dots[:, 1] - v) > np.where(at_rim, 2 * most, most)
    return FittedDots(
        u_px=np.where(astray, u, dots[:, 0]),
        v_px=np.where(astray, v, dots[:, 1]),
        u_sigma_px=np.where(astray, median_size, sigma[0]),
        v_sigma_px=np.where(astray, median_size, sigma[1]),
        size_px=dots[:, 3].copy(),
    )


def _pull(dots: FloatArray, width: FloatArray) -> FloatArray:
    """Derivative of the first moment in the window with respect to the position, shape (n,)."""
    _, _, peak, size = dots.T
    return np.asarray(peak / size**2 * 2 * np.pi / (1 / width**2 + 1 / size**2) ** 2)


def _improve(dots: FloatArray, sums: FloatArray, width: FloatArray) -> float:
    """Update positions, peaks and sizes by one least-squares step; return the largest move.

    Peak, size and dark level are solved for jointly for each dot. Sizes are regularised towards
    the median of the frame.
    """
    peak, size = dots[:, 2].copy(), dots[:, 3].copy()
    plain, by_u, by_v, by_own, by_wide, window = sums.T
    one, two = 1 / width**2 + 1 / size**2, 1 / width**2 + 2 / size**2
    grown = peak / size**2  # times r² and the profile: the derivative by ln size
    # Normal equations of peak (0), dark level (1) and ln size (2), by integrals over Gaussians.
    n00, n01, n11 = 2 * np.pi / two, 2 * np.pi / one, window
    n02, n12 = grown * 4 * np.pi / two**2, grown * 4 * np.pi / one**2
    n22 = grown**2 * 16 * np.pi / two**3
    g2 = grown * by_wide
    det = n00 * n11 - n01**2
    with np.errstate(divide="ignore", invalid="ignore"):
        coupling = (n11 * n02 - n01 * n12) / det, (n00 * n12 - n01 * n02) / det
        curvature = n22 - n02 * coupling[0] - n12 * coupling[1]
        slope = g2 - by_own * coupling[0] - plain * coupling[1]
    median_size = float(np.median(size))
    pooled = slope.sum() / curvature.sum()
    hold = ALIKE * curvature.mean()
    growth = (slope + hold * (pooled - np.log(size / median_size))) / (curvature + hold)
    growth = np.clip(growth, -MOST_GROWTH, MOST_GROWTH)
    rest_own, rest_plain = by_own - n02 * growth, plain - n12 * growth
    higher = (n11 * rest_own - n01 * rest_plain) / det
    move = np.stack([by_u, by_v]) / _pull(dots, width)
    move = np.clip(np.nan_to_num(move), -MOST_MOVE, MOST_MOVE)
    dots[:, :2] += move.T
    dots[:, 2] = np.maximum(peak + np.nan_to_num(higher), 0.1 * np.median(peak))
    dots[:, 3] = size * np.exp(np.nan_to_num(growth))
    return float(np.abs(move).max())


def _free_share(dots: FloatArray, number: IntArray, begin: IntArray) -> FloatArray:
    """Share of a dot's noise that is not absorbed by the fit of its neighbours, shape (n,)."""
    dot = np.repeat(np.arange(len(dots)), np.diff(begin))
    away = np.hypot(*(dots[number, :2] - dots[dot, :2]).T) / dots[dot, 3]
    taken = np.minimum(MOST_TAKEN, OVERLAP * np.exp(-((away / OVERLAP_SIZES) ** 2)))
    return np.exp(-np.bincount(dot, taken, len(dots)))


def _speckle(modes: FloatArray, dots: FloatArray, noise: FloatArray, free: FloatArray) -> float:
    """Estimate the strength of the speckle in modes of the first order, px².

    If grains are not small compared with a dot, their power falls from order to order, by about
    the same ratio. The ratio is predicted from a typical camera blur and combined with the ratio of
    the fifth and third order of isolated dots. Half of the standard uncertainty is added, since an
    underestimate would make positions seem too certain.
    """
    third, alone = _power(modes[2:4], noise, free), free > ALONE
    sharp = 1 - (BLUR_PX / max(float(np.median(dots[:, 3])), 1.2 * BLUR_PX)) ** 2
    log_ratio = 2 * BLUR_POWER * np.log(sharp)
    if alone.any():
        two = [_power(modes[k : k + 2, alone], noise[alone], free[alone]) for k in (2, 4)]
        (low, low_sigma), (high, high_sigma) = two
        if low > low_sigma and high > 0.5 * high_sigma:
            sigma = np.hypot(low_sigma / low, high_sigma / high)
            weight = RULE_SIGMA**2 / (RULE_SIGMA**2 + sigma**2)
            log_ratio += weight * (np.log(high / low) - log_ratio)
    ratio = np.exp(np.clip(log_ratio, np.log(LEAST_RATIO), 0.0))
    sigma = third[1] / ratio
    weight = USUAL_PX2**2 / (USUAL_PX2**2 + sigma**2)
    known = USUAL_PX2 + weight * (third[0] / ratio - USUAL_PX2)
    return float(max(known, 0.0) + 0.5 * np.sqrt(weight) * sigma)


def _power(modes: FloatArray, noise: FloatArray, free: FloatArray) -> tuple[float, float]:
    """Noise-corrected power of residuals in modes over that of the light, and its σ; px².

    The fit of neighbours absorbs about three times as much of speckle, whose grains are larger
    than pixels, as of noise.
    """
    square, white = modes[..., 0] ** 2 / free, noise**2 * modes[..., 1]
    shone = free**2 * modes[..., 2] + 1e-30
    power = 0.0
    for _ in range(6):
        expected = white + max(power, 0.0) * shone
        capped = np.minimum(square, OUTLIER * expected)
        weight = float(np.sum((shone / expected) ** 2))
        power = float(np.sum((capped - white) * shone / expected**2)) / weight
    return power, float(np.sqrt(2 / weight))
