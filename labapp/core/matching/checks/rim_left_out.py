"""Dots without a ray that continue the labelled rows and columns: the rim of the pool is left out.

Where a pool is steeper towards its edge than the surface through the other dots, the dots of the
rim lie farther out than predicted and get no ray. Their rays would count as dark, and the pool
would be measured too low, by up to 55 %.
"""

from __future__ import annotations

import cv2
import numpy as np

from labapp.core.matching.observation import UNLABELLED, Observation
from labapp.core.values import BoolArray, CannotMeasure, FloatArray, IntArray

LEAST_NEAR = 5
"""Fewer dots without a ray near the continued rows and columns do not show that the rim is left
out."""

STEPS_ON = 1.3
"""Where the dot beyond the last of a row or column is expected, in units of the last step: steps
grow towards a steep rim."""

REACHES, CHANCE = (0.3, 0.5, 0.7, 1.0, 1.5), 0.01
"""The rim is left out if false dots would lie as often within one of these distances of the
continued rows and columns, in units of the last step, with less than this probability. Of 38 pools
that would have been measured over 7 % too low for this reason, it was less in 36; of 70 right
frames of pools of all kinds, with up to 12 false dots and 5 % of the true ones missing, in one."""

LEAST_BESIDE = 2
"""A label with fewer beside it in its row and column ends neither: where most dots of the last row
have no ray, the two that have one lie beyond the others."""

GRID = 30
"""Number of places along each side of the frame with which the dots are compared."""


def refuse_rim_left_out(observed: Observation, labels: IntArray) -> None:
    """Raise ``no-match`` if the rim of the pool is left out (`is_rim_left_out`)."""
    if is_rim_left_out(observed, labels):
        raise CannotMeasure(
            "no-match",
            "dots without a ray continue the rows and columns: without them the pool would be "
            "measured too low",
        )


def is_rim_left_out(observed: Observation, labels: IntArray) -> bool:
    """Whether dots without a ray continue the labelled rows and columns more than false ones would.

    False dots lie anywhere: as large a share of them is near the continued rows and columns as of
    all places outside the labelled dots.

    Parameters
    ----------
    observed
        The dots.
    labels
        Index of each ray's dot or `UNLABELLED`, shape (rows, columns).
    """
    free = np.setdiff1d(np.arange(len(observed.plane_mm)), labels)
    if len(free) < LEAST_NEAR:
        return False
    labels = np.where(_beside(labels != UNLABELLED) < LEAST_BESIDE, UNLABELLED, labels)
    dots = _steps_off(observed, labels, observed.plane_mm[free])
    if np.count_nonzero(dots < REACHES[-1]) < LEAST_NEAR:
        return False
    from scipy.special import bdtrc  # takes a fifth of a second, and few frames need it

    height, width = observed.frame_shape
    u, v = np.meshgrid(np.linspace(0, width - 1, GRID), np.linspace(0, height - 1, GRID))
    places_mm = observed.bench.calibration.to_plane(np.stack([u, v], axis=-1).reshape(-1, 2))
    places = _steps_off(observed, labels, places_mm)
    near = np.array([np.count_nonzero(dots < reach) for reach in REACHES])
    share = np.array([np.mean(places < reach) for reach in REACHES])
    return bool((bdtrc(near - 1, len(dots), share) < CHANCE).any())


def _beside(lit: BoolArray) -> IntArray:
    """Number of lit rays among the four beside each in its row and column, (rows, columns)."""
    around = np.pad(lit.astype(np.int64), 1)
    return around[:-2, 1:-1] + around[2:, 1:-1] + around[1:-1, :-2] + around[1:-1, 2:]


def _steps_off(observed: Observation, labels: IntArray, places_mm: FloatArray) -> FloatArray:
    """Distance of places from the nearest continued row or column, in units of its last step.

    The places have the shape (n, 2), the result (m,): those among the labelled dots are omitted.
    """
    last, steps = _ends(observed, labels)
    hull = cv2.convexHull(observed.plane_mm[labels[labels != UNLABELLED]].astype(np.float32))
    outside = [cv2.pointPolygonTest(hull, place, False) < 0 for place in places_mm]
    off = places_mm[outside, None] - (last + STEPS_ON * steps)
    times = np.linalg.norm(off, axis=-1) / np.linalg.norm(steps, axis=-1)
    return np.asarray(times.min(axis=1))


def _ends(observed: Observation, labels: IntArray) -> tuple[FloatArray, FloatArray]:
    """Last dots of rows and columns, both ways, and the last steps to them, shapes (m, 2), mm."""
    last, steps = [], []
    for line in [*labels, *labels.T]:
        at = np.flatnonzero(line != UNLABELLED)
        for end, before in [(at[0], at[1]), (at[-1], at[-2])] if len(at) > 1 else []:
            dot_mm, before_mm = observed.plane_mm[line[[end, before]]]
            last.append(dot_mm)
            steps.append((dot_mm - before_mm) / abs(end - before))
    return np.array(last), np.array(steps)
