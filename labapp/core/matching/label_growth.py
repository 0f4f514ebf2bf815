"""Extend a few labelled dots to all dots: fit the surface, predict each ray's dot, match, repeat.

Predictions come from the surface rather than from neighbouring dots in the image, so that dots are
distinguished even where rows bend, fan out or cross. An ambiguous dot is left unlabelled.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from labapp.core.matching.observation import (
    LEAST_LABELS,
    SOFT,
    STIFF,
    UNLABELLED,
    Observation,
    count_labels,
    neighbours_of,
    try_fit,
)
from labapp.core.matching.prediction import NEWTON_STEPS, sure_limits
from labapp.core.surface.pool_fit import FitSettings, FittedPool
from labapp.core.values import IntArray, median

FEW_UNLABELLED = 0.06
"""Share of the dots that may be false or hidden. If more remain unlabelled, growth is retried."""

FEW_LABELS = 25
"""A complete lattice labels more dots than this; a quadric around a hole labels fewer."""

# Only knots as fine as those of the final fit follow a dent; with few labels, wider knots
# extrapolate farther.
_STIFF_WIDE = replace(STIFF, knot_mm=1.2, jerk=0.036)
_SOFT_WIDE = replace(_STIFF_WIDE, jerk=SOFT.jerk)

MOST_ITERATIONS = 15
"""Maximum number of iterations: labels that still change after these oscillate."""

LEAST_NEIGHBOURS = 4
"""A ray with fewer labelled rays than this among its eight neighbours is at the rim."""

OUTLIER_TIMES, OUTLIER_SPACINGS = 6.0, 0.25
"""A label is an outlier if its residual exceeds both this multiple of the median residual and this
fraction of the distance to the nearest dot; in tracking, to the nearest computed dot."""


def grow_labels(
    observed: Observation, labels: IntArray, knot_mm: float | None = None
) -> IntArray | None:
    """Grow labels by repeated surface fits and predictions until they no longer change.

    Parameters
    ----------
    observed
        The dots and the rig.
    labels
        Index of each ray's dot or `UNLABELLED`, shape (rows, columns).
    knot_mm
        Knot spacing of the surface, mm, if most dots are labelled already and a dip remains. None:
        several settings are tried, and the one that labels most dots is used.

    Returns
    -------
    IntArray or None
        The labels, of the same shape; None if no surface fits them.
    """
    best: IntArray | None = None
    enough = (1 - FEW_UNLABELLED) * len(observed.plane_mm)
    few = count_labels(labels) < FEW_LABELS
    if knot_mm is not None:
        stages = [replace(SOFT, knot_mm=knot_mm)]
    else:
        stages = [_STIFF_WIDE, _SOFT_WIDE, _STIFF_WIDE] if few else [STIFF, SOFT, STIFF]
    settled: dict[tuple[bytes, FitSettings], IntArray | None] = {}
    for attempt in range(2):
        for settings in stages:
            key = labels.tobytes(), settings
            if key not in settled:
                settled[key] = _grown_until_stable(observed, labels, settings)
            if (grown := settled[key]) is not None:
                settled[grown.tobytes(), settings] = grown  # they would not change
            if grown is not None and (best is None or count_labels(grown) > count_labels(best)):
                best = grown
            labels = labels if best is None else best
            if best is not None and count_labels(best) == len(observed.plane_mm):
                return best
        if best is None or count_labels(best) >= enough or attempt:
            break
        # A wrong label at the rim blocks growth and bends the surface to itself: remove the rim
        # once.
        labels = _without_outermost(best)
    return best


def _without_outermost(labels: IntArray) -> IntArray:
    """Keep only the labels of rays of which at least `LEAST_NEIGHBOURS` neighbours are labelled."""
    return np.where(neighbours_of(labels != UNLABELLED) >= LEAST_NEIGHBOURS, labels, UNLABELLED)


def _grown_until_stable(
    observed: Observation, labels: IntArray, settings: FitSettings
) -> IntArray | None:
    """Predict and match until the labels no longer change, or repeat an earlier state."""
    before: list[bytes] = []
    pool: FittedPool | None = None
    while len(before) < MOST_ITERATIONS:
        pool = try_fit(observed, labels, settings, pool)
        if pool is None:
            return None
        key = labels.tobytes(), settings
        if key not in observed.matched:  # different hypotheses often come to the same labels
            observed.matched[key] = matched_labels(observed, pool, labels)
        labels = observed.matched[key]
        state = labels.tobytes()
        if state in before:
            break
        before.append(state)
    labels = _without_far_labels(observed, labels, settings)
    return labels if count_labels(labels) >= LEAST_LABELS else None


def matched_labels(observed: Observation, pool: FittedPool, labels: IntArray) -> IntArray:
    """Label the dots that are uniquely assigned to a ray by `sure_pairs`.

    Rays may be labelled within one ring of the labelled rays. Those of a second ring take part as
    rivals: where the prediction is so uncertain that a dot could belong to the next row but one,
    it stays unlabelled.
    """
    from labapp.core.matching import label_growth_kernels

    rays, rig, surface = observed.rays, observed.rig, pool.surface
    return label_growth_kernels.matched_labels(
        labels,
        (rays.directions, rays.landing_mm, rays.absent),
        (rig.laser.position_mm, rig.imaging_plane.pose_mm),
        (surface.basis.grid, surface.coefficients, pool.factor),
        (observed.plane_mm, observed.covariance_mm2),
        np.array([NEWTON_STEPS, observed.resolution_mm, *sure_limits()]),
    )


def _without_far_labels(observed: Observation, labels: IntArray, settings: FitSettings) -> IntArray:
    """Remove labels whose residual from the surface through all of them is an outlier."""
    if len(observed.plane_mm) < 2:
        return labels
    for _ in range(3):
        pool = try_fit(observed, labels, settings)
        if pool is None:
            return labels
        at = np.argwhere(labels != UNLABELLED)
        off = np.linalg.norm(pool.residual_mm, axis=-1)
        allowed = OUTLIER_SPACINGS * observed.spacing_mm[labels[at[:, 0], at[:, 1]]]
        bad = off > np.maximum(OUTLIER_TIMES * median(off), allowed)
        if not bad.any():
            return labels
        labels = labels.copy()
        labels[at[bad, 0], at[bad, 1]] = UNLABELLED
    return labels
