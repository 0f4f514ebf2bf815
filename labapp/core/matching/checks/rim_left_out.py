"""Dots without a ray at the rim of the labelled ones: the rim of the pool is left out.

Where a pool is steeper towards its edge than the surface through the other dots, the dots of the
rim lie farther out than predicted and get no ray. Where it becomes flat there, as at a toe, they
lie close to the others, or among them. Their rays would count as dark, and the pool would be
measured too low, by up to 55 %.
"""

from __future__ import annotations

from typing import NoReturn

import cv2
import numpy as np

from labapp.core.matching.observation import UNLABELLED, Observation, amid
from labapp.core.matching.row_ends import RowEnds
from labapp.core.values import BoolArray, CannotMeasure, FloatArray, IntArray

RIM_POSSIBLE, RIM_LEFT_OUT = 3.0, 6.0
"""The rim may be, or is, left out if the dots without a ray are likelier, by this logarithm, where
the dots of a rim are than anywhere in the frame."""

LEAST_FREE = 5
"""Fewer dots without a ray are no evidence: the last rows of a concave pool fold and merge."""

NEAR_STEPS = 0.5
"""Dots without a ray are near the others if they lie among them, or beyond the last of a row or
column by less than this in units of the last step."""

SAME = 1e-9
"""If the standard deviation of the places' values is less, the dots have nothing to be compared
with: they fill the frame."""

GRID = 30
"""Number of places along each side of the frame with which the dots are compared."""

SHARES = np.linspace(0.05, 0.95, 19)
"""Shares of the dots without a ray that may be the rim's; the others are false."""


def refuse_rim_left_out() -> NoReturn:
    """Raise ``no-match``."""
    raise CannotMeasure(
        "no-match",
        "dots without a ray continue the rows and columns, or lie close to the others: without "
        "them the pool would be measured too low",
    )


def is_rim_left_out(observed: Observation, labels: IntArray) -> bool:
    """Whether the dots without a ray are those of the rim (`rim_evidence`)."""
    return rim_evidence(observed, labels) > RIM_LEFT_OUT


def rim_evidence(observed: Observation, labels: IntArray) -> float:
    """Log likelihood ratio of dots without a ray if they are those of the rim, or false.

    Those of the rim continue the rows and columns, or lie close to the labelled ones. False dots
    lie anywhere: neither is true of more of them than of other places in the frame. As many dots
    among the labelled ones as rays there have none are not counted.

    Parameters
    ----------
    observed
        The dots.
    labels
        Index of each ray's dot or `UNLABELLED`, shape (rows, columns).
    """
    lit = labels != UNLABELLED
    free_mm = observed.plane_mm[np.setdiff1d(np.arange(len(observed.plane_mm)), labels)]
    if len(free_mm) < LEAST_FREE:
        return 0.0
    ends = RowEnds.of(observed, labels)
    own_mm = observed.plane_mm[labels[lit]]
    height, width = observed.frame_shape
    u, v = np.meshgrid(np.linspace(0, width - 1, GRID), np.linspace(0, height - 1, GRID))
    places_mm = observed.bench.calibration.to_plane(np.stack([u, v], axis=-1).reshape(-1, 2))

    near_mm = np.vstack([own_mm, ends.last_mm + NEAR_STEPS * ends.steps_mm])
    near, places_near = (_within(near_mm, each).astype(float) for each in (free_mm, places_mm))
    gaps = int(np.count_nonzero(amid(lit) & ~lit & ~observed.without_dot))
    outside_mm, places_mm = (each[~_within(own_mm, each)] for each in (free_mm, places_mm))
    continuing, places = ends.continuation(outside_mm), ends.continuation(places_mm)
    return max(_log_ratio(near, places_near, gaps), _log_ratio(continuing, places))


def _log_ratio(dots: FloatArray, places: FloatArray, explained: int = 0) -> float:
    """Log likelihood ratio of dots where values are high, in proportion, to dots anywhere.

    The share of the dots to which this applies is the likeliest. Values of dots, shape (n,), and of
    places all over the frame, shape (m,), are 0 to 1. Of the dots with the highest values, that
    many are explained otherwise, and omitted. 0 for fewer than `LEAST_FREE` dots.
    """
    count = len(dots) - explained
    if count < LEAST_FREE or len(places) == 0 or places.std() < SAME:
        return 0.0
    density = np.sort(dots)[:count] / places.mean()
    return float(np.log1p(SHARES[:, None] * (density - 1)).sum(axis=1).max())


def _within(hull_mm: FloatArray, places_mm: FloatArray) -> BoolArray:
    """Mask of the places within the convex hull of points, shapes (n, 2) and (m, 2), mm."""
    hull = cv2.convexHull(hull_mm.astype(np.float32))
    return np.array([cv2.pointPolygonTest(hull, place, False) >= 0 for place in places_mm], bool)
