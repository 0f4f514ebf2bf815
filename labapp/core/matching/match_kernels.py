"""Compiled inner loops for matching dots with rays (docs/adr/0018)."""

from __future__ import annotations

import numpy as np
from numba import types

from labapp.core.compiled import compiled, inner
from labapp.core.images.band_pass_kernels import next_apart, two_nearest
from labapp.core.images.visibility import GLARE_CELL_PX, View
from labapp.core.surface.kernels.ray_kernels import behind_torch, stopped_by_far_side
from labapp.core.values import BoolArray, FloatArray, IntArray

_f1, _f2, _f3 = (types.Array(types.float64, n, "A", readonly=True) for n in (1, 2, 3))
_dots = types.Tuple((_f2, _f1))  # type: ignore[no-untyped-call]
_uncertain = types.Tuple((_f2, _f3))  # type: ignore[no-untyped-call]
_i1, _i2 = (types.Array(types.int64, n, "A", readonly=True) for n in (1, 2))
_mask = types.Array(types.boolean, 2, "A", readonly=True)
_paths = types.UniTuple(_f2, 3)  # type: ignore[no-untyped-call]
_view = types.Tuple((_f2, _f2, _f2, _mask))  # type: ignore[no-untyped-call]
_surface = types.Tuple((_f2, _f1))  # type: ignore[no-untyped-call]


@inner
def _distance(x: float, y: float, xx: float, xy: float, yy: float) -> tuple[float, float]:
    """Squared Mahalanobis length of a vector, and the determinant of its covariance."""
    area = xx * yy - xy * xy
    return (yy * x * x - 2.0 * xy * x * y + xx * y * y) / area, area


@compiled(_f2, _f3, _f2, _f3)
def pair_deviances(
    places: FloatArray, covariance: FloatArray, predicted: FloatArray, uncertain: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Squared Mahalanobis distances and deviances of n places from m predictions.

    Places and predictions have shapes (n, 2) and (m, 2), their covariances (n, 2, 2) and (m, 2, 2).

    Returns
    -------
    distance, deviance
        Squared distances in σ², and −2 log likelihoods up to a constant, both of shape (n, m).
    """
    distance = np.empty((len(places), len(predicted)))
    deviance = np.empty((len(places), len(predicted)))
    for n in range(len(places)):
        for m in range(len(predicted)):
            x, y = places[n, 0] - predicted[m, 0], places[n, 1] - predicted[m, 1]
            xx = covariance[n, 0, 0] + uncertain[m, 0, 0]
            xy = covariance[n, 0, 1] + uncertain[m, 0, 1]
            yy = covariance[n, 1, 1] + uncertain[m, 1, 1]
            distance[n, m], deviance[n, m] = _distance(x, y, xx, xy, yy)
    deviance[:] = distance + np.log(deviance)
    return distance, deviance


@compiled(_f2, _f3, _f3, types.float64, types.float64)
def left_out(
    residual: FloatArray, dot: FloatArray, computed: FloatArray, unsettled: float, most: float
) -> tuple[FloatArray, FloatArray]:
    """Leave-one-out residuals of n dots, and the covariance of the leave-one-out predictions.

    Residuals to the fit with all dots have shape (n, 2), covariances of the dots and of their
    computed places (n, 2, 2). ``unsettled`` is the standard deviation of the residuals due to
    incomplete convergence of the fit. The leverage of a dot is limited to ``most``.
    """
    off, spread = np.empty((len(residual), 2)), np.empty((len(residual), 2, 2))
    for n in range(len(residual)):
        a, b, c = dot[n, 0, 0], dot[n, 0, 1], dot[n, 1, 1]
        share = most
        for _ in range(100):  # the covariance of the fit may come from an earlier round
            xx, xy = a - share * computed[n, 0, 0], b - share * computed[n, 0, 1]
            yy = c - share * computed[n, 1, 1]
            area = xx * yy - xy * xy
            if xx > 0.0 and area > (1.0 - most) ** 2 * (a * c - b * b):
                break
            share *= 0.98
        # Covariance of the dot times the inverse of that of its residual.
        p, q = (a * yy - b * xy) / area, (b * xx - a * xy) / area
        r, s = (b * yy - c * xy) / area, (c * xx - b * xy) / area
        x, y = residual[n, 0], residual[n, 1]
        off[n, 0], off[n, 1] = p * x + q * y, r * x + s * y
        rest = unsettled * unsettled
        spread[n, 0, 0] = p * a + q * b - a + rest * (p * p + q * q)
        spread[n, 1, 1] = r * b + s * c - c + rest * (r * r + s * s)
        spread[n, 0, 1] = spread[n, 1, 0] = p * b + q * c - b + rest * (p * r + q * s)
    return off, spread


@compiled(_f2, _f2, _view)
def within_view(places: FloatArray, margin: FloatArray, view: View) -> BoolArray:
    """Whether n places on the plane are in view (`Observation.view_with`) even if displaced.

    Places and margins by which they are displaced along either axis have shape (n, 2), mm.
    """
    to_image, plane, image, glare = view
    visible = np.ones(len(places), np.bool_)
    for k in range(len(places)):
        for corner in range(4):
            x = places[k, 0] + (1.0 if corner < 2 else -1.0) * margin[k, 0]
            z = places[k, 1] + (1.0 if corner % 2 else -1.0) * margin[k, 1]
            w = to_image[2, 0] * x + to_image[2, 1] * z + to_image[2, 2]
            u = (to_image[0, 0] * x + to_image[0, 1] * z + to_image[0, 2]) / w
            v = (to_image[1, 0] * x + to_image[1, 1] * z + to_image[1, 2]) / w
            visible[k] &= plane[0, 0] < x < plane[1, 0] and plane[0, 1] < z < plane[1, 1]
            visible[k] &= image[0, 0] < u < image[1, 0] and image[0, 1] < v < image[1, 1]
            if visible[k] and glare.size:
                row, column = (v - image[0, 1]) // GLARE_CELL_PX, (u - image[0, 0]) // GLARE_CELL_PX
                visible[k] = not glare[int(row), int(column)]
    return visible


@compiled(_mask, types.int64)
def widened(mask: BoolArray, rings: int) -> BoolArray:
    """Dilate a mask over rays, shape (rows, columns), by a number of rings."""
    rows, columns = mask.shape
    wider = np.zeros((rows, columns), np.bool_)
    for i in range(rows):
        for j in range(columns):
            if mask[i, j]:
                for k in range(max(i - rings, 0), min(i + rings + 1, rows)):
                    for m in range(max(j - rings, 0), min(j + rings + 1, columns)):
                        wider[k, m] = True
    return wider


@inner
def _spanned(lit: BoolArray, ends: int) -> BoolArray:
    """Mask of rays from the first to the last lit one of a row or column, without so many ends."""
    rows, columns = lit.shape
    mask = np.zeros((rows, columns), np.bool_)
    for i in range(rows):
        at = np.flatnonzero(lit[i])
        if len(at) > ends:
            mask[i, at[0] + ends : at[-1] + 1 - ends] = True
    for j in range(columns):
        at = np.flatnonzero(lit[:, j])
        if len(at) > ends:
            mask[at[0] + ends : at[-1] + 1 - ends, j] = True
    return mask


@compiled(_mask)
def amid(lit: BoolArray) -> BoolArray:
    """Mask of rays that are lit or between lit ones in a row or column, shape (rows, columns)."""
    return _spanned(lit, 0)


@compiled(_mask)
def between(lit: BoolArray) -> BoolArray:
    """Mask of rays with lit ones on both sides in their row or column, shape (rows, columns)."""
    return _spanned(lit, 1)


@compiled(_f2, _f3, _f2, _f3, _f1)
def sure_pairs(
    places: FloatArray,
    covariance: FloatArray,
    predicted: FloatArray,
    uncertain: FloatArray,
    limits: FloatArray,
) -> tuple[IntArray, IntArray]:
    """Find the unambiguous pairs of n places and m predictions (`prediction.sure_pairs`).

    Parameters
    ----------
    places, covariance, predicted
        See `pair_deviances`.
    uncertain
        Covariance of the predictions due to that of the surface, shape (m, 2, 2).
    limits
        Factor applied to it, and variance of the model added to it; largest squared distance of a
        pair; margin over rivals; and the deviance of a false place.

    Returns
    -------
    place, prediction
        Indices of each pair, in the order of the places.
    """
    (
        inflation,
        error,
        gate,
        margin,
        false,
    ) = limits
    count = len(places), len(predicted)
    # Of each place and of each prediction the least deviance and the next one.
    by_place, by_prediction = np.full((2, count[0]), np.inf), np.full((2, count[1]), np.inf)
    prediction, near = np.full(count[0], -1), np.zeros(count[0], np.bool_)
    # The variances of a pair are at least ``error``: beyond this distance it exceeds ``false``.
    farthest = false - 2.0 * np.log(error)
    for n in range(count[0]):
        for m in range(count[1]):
            x, y = places[n, 0] - predicted[m, 0], places[n, 1] - predicted[m, 1]
            xx = covariance[n, 0, 0] + inflation * uncertain[m, 0, 0] + error
            xy = covariance[n, 0, 1] + inflation * uncertain[m, 0, 1]
            yy = covariance[n, 1, 1] + inflation * uncertain[m, 1, 1] + error
            distance, area = _distance(x, y, xx, xy, yy)
            if not distance < farthest:
                continue
            deviance = distance + np.log(area)
            if deviance < by_place[0, n]:
                by_place[1, n], by_place[0, n] = by_place[0, n], deviance
                prediction[n], near[n] = m, distance < gate
            elif deviance < by_place[1, n]:
                by_place[1, n] = deviance
            if deviance < by_prediction[0, m]:
                by_prediction[1, m], by_prediction[0, m] = by_prediction[0, m], deviance
            elif deviance < by_prediction[1, m]:
                by_prediction[1, m] = deviance
    for n in range(count[0]):
        m = prediction[n]
        if m >= 0:
            # If m has a likelier place, by_prediction[1, m] is at most this deviance, which fails.
            rival = min(by_place[1, n], by_prediction[1, m], false)
            if not near[n] or not by_place[0, n] + margin < rival:
                prediction[n] = -1
    sure = np.flatnonzero(prediction >= 0)
    return sure, prediction[sure]


@inner
def _merged(
    dots: IntArray, places: FloatArray, reach: FloatArray, rays: IntArray, shown: FloatArray
) -> tuple[BoolArray, BoolArray]:
    """Masks of the dots that are merged from those of at least two rays, and of all such rays.

    ``dots`` and ``rays`` are candidates; the latter's dots are computed at ``shown``.
    """
    is_merged, is_part = np.zeros(len(dots), np.bool_), np.zeros(len(shown), np.bool_)
    for n in range(len(dots)):
        off = shown[rays] - places[dots[n]]
        within = rays[np.sum(off * off, axis=1) < reach[dots[n]] ** 2]
        if len(within) > 1:
            is_merged[n], is_part[within] = True, True
    return is_merged, is_part


@compiled(_i2, _mask, _surface, _paths, _f2, _dots, _view, _f1)
def classify_rays(
    labels: IntArray,
    without_dot: BoolArray,
    surface: tuple[FloatArray, FloatArray],
    paths: tuple[FloatArray, FloatArray, FloatArray],
    rays: FloatArray,
    dots: tuple[FloatArray, FloatArray],
    view: View,
    limits: FloatArray,
) -> tuple[IntArray, IntArray, IntArray]:
    """Classify all R rays for a surface fitted to labels (`ray_classes.classify_rays`).

    Parameters
    ----------
    labels
        Index of each ray's dot, negative if it has none, shape (rows, columns).
    without_dot
        Mask of the rays that are known to have no dot, shape (rows, columns).
    surface
        Its grid and coefficients.
    paths
        Reflection points of the rays, row by row, shape (R, 3), slopes of the surface there, shape
        (R, 2), and computed dots, shape (R, 2); NaN if unknown.
    rays
        Directions of the rays, shape (R, 3).
    dots
        Observed dots, shape (d, 2), mm, and `Observation.merged_reach_mm`, shape (d,).
    view
        See `Observation.view_with`.
    limits
        Height of the tip of the electrode, distance below which dots merge, and distance from the
        edge of the view within which a predicted dot may be out of view, mm.

    Returns
    -------
    ray_states, missed, stray
        See `ray_classes.RayClasses`; the states have shape (R,).
    """
    (points, slopes, plane), (tip, resolution, near_edge) = paths, limits
    places, merged_reach = dots
    is_lit = labels >= 0
    lit, amid_lit, dotless = is_lit.ravel(), amid(is_lit).ravel(), without_dot.ravel()
    known = np.flatnonzero(np.isfinite(plane[:, 0]))
    shown = plane[known]
    unlabelled = np.ones(len(places), np.bool_)
    for label in labels.ravel():
        if label >= 0:
            unlabelled[label] = False
    stray = np.flatnonzero(unlabelled)
    candidates = places[stray]
    among = np.flatnonzero(amid_lit[known] & ~dotless[known])
    unlit = among[~lit[known[among]]]
    merged, in_merged = _merged(stray, places, merged_reach, unlit, shown)
    if len(stray):
        around = np.flatnonzero(widened(amid(is_lit), 1).ravel()[known] & ~dotless[known])
        around = around[next_apart(shown[around]) < resolution]
        apart = two_nearest(candidates, shown[around])[0][:, 0]
        stray = stray[(apart > resolution) & ~merged]

    known_paths = points[known], rays[known], slopes[known]
    free = ~behind_torch(*known_paths, tip)
    outside = free & ~(amid_lit | dotless)[known]
    spacing = next_apart(shown)
    # A stray dot near a prediction may be the dot of a ray that seems dark.
    outside &= (spacing >= resolution) & (two_nearest(shown, candidates)[0][:, 0] >= spacing)
    next_to_lit = outside & widened(is_lit, 1).ravel()[known]
    next_to_lit &= within_view(shown, np.full_like(shown, near_edge), view)
    free &= ~stopped_by_far_side(surface, *known_paths, lit[known], next_to_lit)
    seen = free & within_view(shown, np.zeros_like(shown), view)

    unlit = unlit[seen[unlit] & ~in_merged[unlit]]
    apart = two_nearest(shown[unlit], shown[among])[0][:, 1]
    missed = known[unlit[apart >= resolution]]

    ray_states = np.zeros(len(plane), np.int64)
    ray_states[known[outside & seen]] = -1
    ray_states[lit] = 1
    return ray_states, missed, stray


@compiled(_f2)
def medians_around(values: FloatArray) -> FloatArray:
    """Median of the values within two rows and columns of each value, without itself.

    Values and medians have shape (rows, columns); NaN stands for no value.
    """
    rows, columns = values.shape
    medians, around = np.full((rows, columns), np.nan), np.empty(24)
    for i in range(rows):
        for j in range(columns):
            if np.isnan(values[i, j]):
                continue
            count = 0
            for k in range(max(i - 2, 0), min(i + 3, rows)):
                for m in range(max(j - 2, 0), min(j + 3, columns)):
                    if (k != i or m != j) and not np.isnan(values[k, m]):
                        at = count  # sorted
                        while at and around[at - 1] > values[k, m]:
                            around[at] = around[at - 1]
                            at -= 1
                        around[at] = values[k, m]
                        count += 1
            if count:
                medians[i, j] = (around[(count - 1) // 2] + around[count // 2]) / 2
    return medians


# --- labels that a surface does not support ----------------------------------------------------


@inner
def _deviances(
    off: FloatArray, covariance: FloatArray, excess: float
) -> tuple[FloatArray, FloatArray]:
    """Squared Mahalanobis lengths and deviances of residuals, shape (n, 2) (`pair_deviances`).

    Covariances, shape (n, 2, 2), are multiplied by ``excess``.
    """
    distance, deviance = np.empty(len(off)), np.empty(len(off))
    for n in range(len(off)):
        x, y, xy = off[n, 0], off[n, 1], excess * covariance[n, 0, 1]
        xx, yy = excess * covariance[n, 0, 0], excess * covariance[n, 1, 1]
        distance[n], area = _distance(x, y, xx, xy, yy)
        deviance[n] = distance[n] + np.log(area)
    return distance, deviance


@inner
def _least_deviance(
    place: FloatArray,
    covariance: FloatArray,
    others: FloatArray,
    of_others: FloatArray,
    excess: float,
) -> float:
    """Smallest deviance of a place from others (`pair_deviances`); infinite if there are none.

    Covariances, shapes (2, 2) and (m, 2, 2), are multiplied by ``excess``; others with NaN are
    ignored.
    """
    least = np.inf
    for m in range(len(others)):
        x, y = place[0] - others[m, 0], place[1] - others[m, 1]
        xx = excess * (covariance[0, 0] + of_others[m, 0, 0])
        xy = excess * (covariance[0, 1] + of_others[m, 0, 1])
        yy = excess * (covariance[1, 1] + of_others[m, 1, 1])
        distance, area = _distance(x, y, xx, xy, yy)
        deviance = distance + np.log(area)
        least = deviance if deviance < least else least
    return least


@inner
def _with_variance(covariance: FloatArray, variance: float) -> FloatArray:
    """Add a variance along both axes to covariances, shape (n, 2, 2)."""
    total = covariance.copy()
    for n in range(len(total)):
        total[n, 0, 0] += variance
        total[n, 1, 1] += variance
    return total


@inner
def _is_worst_around(worst: FloatArray, i: int, j: int) -> bool:
    """Whether none of the eight neighbours of a value, in shape (rows, columns), exceeds it."""
    rows, columns = worst.shape
    for k in range(max(i - 1, 0), min(i + 2, rows)):
        for m in range(max(j - 1, 0), min(j + 2, columns)):
            if worst[k, m] > worst[i, j]:
                return False
    return True


@compiled(_i2, _uncertain, _uncertain, _f1, _i1, _i1, _f1)
def failing_labels(
    labels: IntArray,
    dots: tuple[FloatArray, FloatArray],
    surface: tuple[FloatArray, FloatArray],
    shows: FloatArray,
    missed: IntArray,
    stray: IntArray,
    limits: FloatArray,
) -> BoolArray:
    """Mask of labels that their ray does not explain, the worst of adjacent ones (`unsupported`).

    Labels without a labelled neighbour, also diagonally, are in the mask, too.

    Parameters
    ----------
    labels
        Index of each ray's dot, negative if it has none, shape (rows, columns).
    dots
        Places of dots and their covariances, shapes (d, 2), mm, and (d, 2, 2), mm².
    surface
        Computed dots of all R rays, row by row, and their covariances due to that of the surface,
        shapes (R, 2), mm, and (R, 2, 2), mm²; NaN where unknown.
    shows
        Probability that a labelled ray returned and has a dot, row by row, shape (n,).
    missed, stray
        Flat indices of rays without a dot between lit ones, and indices of dots without a ray.
    limits
        Smallest variance of a dot in the fit, mm²; unsettled part of residuals and largest leverage
        (both `left_out`); inflation of the surface's variance; variance of its model, mm²; median
        of χ²; deviance of a false dot; the largest squared distance; margin over rivals. At the
        rim: the largest number of labelled neighbours; the largest squared distance, absolute and
        as a multiple of the median.

    Returns
    -------
    BoolArray
        Shape (rows, columns).
    """
    (
        floor,
        unsettled,
        leverage,
        inflation,
        error,
        median,
        false,
        gate,
        margin,
        rim_neighbours,
        rim_sigma2,
        rim_times,
    ) = limits
    (places, seen), (predicted, drawn) = dots, surface
    rays = np.flatnonzero(labels.ravel() >= 0)
    number = labels.ravel()[rays]
    own, fitted = places[number], _with_variance(seen[number], floor)
    off, computed = left_out(predicted[rays] - own, fitted, drawn[rays], unsettled, leverage)
    spread = _with_variance(inflation * computed, error)
    both = fitted + spread
    distance, _ = _deviances(off, both, 1.0)
    excess = np.median(distance) / median
    excess = excess if excess > 1.0 else 1.0
    distance, deviance = _deviances(off, both, excess)
    rim_gate = min(max(rim_sigma2, rim_times * np.median(distance)), gate)
    around = _with_variance(inflation * drawn[missed], error)
    worst, fails = np.zeros(labels.shape), np.zeros(labels.shape, np.bool_)
    for n in range(len(rays)):
        i, j = rays[n] // labels.shape[1], rays[n] % labels.shape[1]
        beside = labels[max(i - 1, 0) : i + 2, max(j - 1, 0) : j + 2]
        neighbours = np.sum(beside >= 0) - 1
        at_rim, fails[i, j] = neighbours <= rim_neighbours, neighbours == 0
        # If the dot is false, the ray shows none: odds of ``shows``.
        by_ray = deviance[n] + 2.0 * np.log(1.0 - shows[n]) - 2.0 * np.log(max(shows[n], 1e-300))
        rival = min(
            _least_deviance(own[n] + off[n], spread[n], places[stray], seen[stray], excess),
            _least_deviance(own[n], fitted[n], predicted[missed], around, excess),
        )
        is_far = distance[n] > (rim_gate if at_rim else gate)
        if is_far or by_ray + margin > false or deviance[n] + margin > rival:
            worst[i, j] = distance[n]
    for i in range(len(labels)):
        for j in range(labels.shape[1]):
            fails[i, j] |= worst[i, j] > 0.0 and _is_worst_around(worst, i, j)
    return fails
