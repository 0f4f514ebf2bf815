"""From a few labelled dots to all of them: fit the surface, predict every ray's dot, match, again.

Predicted by the surface rather than by neighbours on the picture, dots are told apart where rows
bow, fan out or cross; a dot that two predictions could claim is given to neither.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import scipy

from labapp.core.matching.observation import (
    LEAST_LABELS,
    SOFT,
    STIFF,
    UNLABELLED,
    Observation,
    count_labels,
    neighbours_of,
    try_fit,
    within_rings,
)
from labapp.core.matching.prediction import predict, sure_pairs
from labapp.core.surface.pool_fit import FitSettings, FittedPool
from labapp.core.values import IntArray, median

FEW_UNLABELLED = 0.06
"""Share of the dots that may be false or hidden: with more than that left over, more is tried."""

FEW_LABELS = 25
"""A whole grid labels more dots than this, a quadric round a hole fewer."""

# Only knots as fine as the final fit's follow a dent; a few labels lead farther with wider ones.
_STIFF_WIDE = replace(STIFF, knot_mm=1.2, jerk=0.036)
_SOFT_WIDE = replace(_STIFF_WIDE, jerk=SOFT.jerk)

MOST_ITERATIONS = 15
"""Labels that still change after so many iterations go to and fro."""

LEAST_NEIGHBOURS = 4
"""Of the eight rays round one: with fewer labelled it is at the edge of the labelled ones."""

OUTLIER_TIMES, OUTLIER_SPACINGS = 6.0, 0.25
"""A label is an outlier where its residual is larger than so many medians of all, and than this
share of the way to the next dot."""


def grow_labels(
    observed: Observation, labels: IntArray, knot_mm: float | None = None
) -> IntArray | None:
    """Follow the surface from the labels given until nothing changes.

    Parameters
    ----------
    observed
        The dots and the rig.
    labels
        Index of each ray's dot or `UNLABELLED`, shape (rows, columns).
    knot_mm
        Spacing of the surface's knots, mm, where most dots are labelled already and a dip is left;
        None: as far as labels lead farthest.

    Returns
    -------
    IntArray or None
        The labels, of the same shape; None if they lead nowhere.
    """
    best: IntArray | None = None
    enough = (1 - FEW_UNLABELLED) * len(observed.plane_mm)
    few = count_labels(labels) < FEW_LABELS
    if knot_mm is not None:
        course = [replace(SOFT, knot_mm=knot_mm)]
    else:
        course = [_STIFF_WIDE, _SOFT_WIDE, _STIFF_WIDE] if few else [STIFF, SOFT, STIFF]
    for attempt in range(2):
        for settings in course:
            grown = _settled(observed, labels, settings)
            if grown is not None and (best is None or count_labels(grown) > count_labels(best)):
                best = grown
            labels = labels if best is None else best
            if best is not None and count_labels(best) == len(observed.plane_mm):
                return best  # there is no more to be had
        if best is None or count_labels(best) >= enough or attempt:
            break
        # A wrong label at the rim bars the way and holds itself up: take the rim off once.
        labels = _without_outermost(best)
    return best


def _without_outermost(labels: IntArray) -> IntArray:
    """Only labels with most of their neighbours labelled."""
    return np.where(neighbours_of(labels != UNLABELLED) >= LEAST_NEIGHBOURS, labels, UNLABELLED)


def _settled(observed: Observation, labels: IntArray, settings: FitSettings) -> IntArray | None:
    """Predict and match until the labels no longer change, or come round again."""
    before: list[bytes] = []
    pool: FittedPool | None = None
    while len(before) < MOST_ITERATIONS:
        pool = try_fit(observed, labels, settings, pool)
        if pool is None:
            return None
        labels = matched_labels(observed, pool, labels)
        state = labels.tobytes()
        if state in before:
            break
        before.append(state)
    labels = _without_outliers(observed, labels, settings)
    return labels if count_labels(labels) >= LEAST_LABELS else None


def matched_labels(observed: Observation, pool: FittedPool, labels: IntArray) -> IntArray:
    """Labels for dots that one ray alone can have made, and rays that made one dot alone.

    Likelihoods are those of `sure_pairs`. Rays a ring farther out than any that is given a dot
    stand as rivals: where the prediction is so uncertain that the dots of the next row but one come
    into question, nobody gets them.
    """
    matched = np.full(labels.shape, UNLABELLED, np.int64)
    far = predict(observed, pool, within_rings(labels, 2))
    if len(far.at) == 0:
        return matched
    dots, covariance = np.arange(len(observed.plane_mm)), far.covariance_mm2(pool, observed.rig)
    dot, ray = sure_pairs(observed, dots, far.plane_mm, covariance)
    at = far.at[ray]
    taken = within_rings(labels, 1)[at[:, 0], at[:, 1]] & ~observed.absent[at[:, 0], at[:, 1]]
    # Dots that run into each other have no place of their own.
    taken &= far.spacing_mm[ray] > observed.resolution_mm
    matched[at[taken, 0], at[taken, 1]] = dot[taken]
    return matched


def _without_outliers(observed: Observation, labels: IntArray, settings: FitSettings) -> IntArray:
    """Drop labels far from where the surface through all of them puts their dot."""
    if len(observed.plane_mm) < 2:
        return labels
    spacing = scipy.spatial.cKDTree(observed.plane_mm).query(observed.plane_mm, k=2)[0][:, 1]
    for _ in range(3):
        pool = try_fit(observed, labels, settings)
        if pool is None:
            return labels
        at = np.argwhere(labels != UNLABELLED)
        off = np.linalg.norm(pool.residual_mm, axis=-1)
        allowed = OUTLIER_SPACINGS * spacing[labels[at[:, 0], at[:, 1]]]
        bad = off > np.maximum(OUTLIER_TIMES * median(off), allowed)
        if not bad.any():
            return labels
        labels = labels.copy()
        labels[at[bad, 0], at[bad, 1]] = UNLABELLED
    return labels
