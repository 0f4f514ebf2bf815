"""Dots without a ray at the rim of the labelled ones: the rim of the pool is left out.

Where a pool is steeper towards its edge than the surface through the other dots, the dots of the
rim lie farther out than predicted and get no ray. Where it becomes flat there, as at a toe, they
lie close to the others, or among them. Their rays would count as dark, and the pool would be
measured too low, by up to 55 %.
"""

from __future__ import annotations

import cv2
import numpy as np

from labapp.core.matching.observation import UNLABELLED, Observation, amid
from labapp.core.values import BoolArray, CannotMeasure, FloatArray, IntArray

LEAST_FREE = 5
"""Fewer dots without a ray do not show that the rim is left out."""

STEP, STEP_SPREAD, TURN = 1.6, 0.7, 0.4
"""Where a dot that continues a row or column is: farther on than its last dot by this multiple of
the last step, as steps grow towards a steep rim; standard deviation of the logarithm of that
multiple; and of the tangent of the angle to the last step."""

MOST_SIGMAS = 2.7
"""The rim is left out if the dots continue the rows and columns better than places anywhere do by
this number of σ of their mean."""

NEAR_STEPS, MOST_NEAR_SIGMAS = 0.5, 3.0
"""Dots without a ray are near the others if they lie among them, or beyond the last of a row or
column by less than the first in units of the last step. The rim is left out, too, if more are near
than of places anywhere by this number of σ. Of 75 pools with a steep rim or a toe that would have
been measured over 6 % too low, 69 exceed one of the two limits, and 3 of the others had fewer than
`LEAST_FREE` dots without a ray; of 109 right frames with up to 12 false dots, 2."""

SAME = 1e-9
"""If the standard deviation of the places' values is less, the dots have nothing to be compared
with: they fill the frame."""

GRID = 30
"""Number of places along each side of the frame with which the dots are compared."""


def refuse_rim_left_out(observed: Observation, labels: IntArray) -> None:
    """Raise ``no-match`` if the rim of the pool is left out (`is_rim_left_out`)."""
    if is_rim_left_out(observed, labels):
        raise CannotMeasure(
            "no-match",
            "dots without a ray continue the rows and columns, or lie close to the others: without "
            "them the pool would be measured too low",
        )


def is_rim_left_out(observed: Observation, labels: IntArray) -> bool:
    """Whether dots without a ray continue the rows and columns, or lie close to the labelled ones.

    False dots lie anywhere: neither is true of more of them than of other places in the frame. As
    many dots among the labelled ones as rays there have none are not counted.

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
        return False
    last_mm, steps_mm = _ends(observed, labels)
    own_mm = observed.plane_mm[labels[lit]]
    height, width = observed.frame_shape
    u, v = np.meshgrid(np.linspace(0, width - 1, GRID), np.linspace(0, height - 1, GRID))
    places_mm = observed.bench.calibration.to_plane(np.stack([u, v], axis=-1).reshape(-1, 2))

    near_mm = np.vstack([own_mm, last_mm + NEAR_STEPS * steps_mm])
    near, places_near = (_within(near_mm, each).astype(float) for each in (free_mm, places_mm))
    gaps = int(np.count_nonzero(amid(lit) & ~lit & ~observed.without_dot))
    if _ahead(near, places_near, gaps) > MOST_NEAR_SIGMAS:
        return True
    outside_mm, places_mm = (each[~_within(own_mm, each)] for each in (free_mm, places_mm))
    continuing = _continuation(last_mm, steps_mm, outside_mm)
    return _ahead(continuing, _continuation(last_mm, steps_mm, places_mm)) > MOST_SIGMAS


def _ahead(dots: FloatArray, places: FloatArray, explained: int = 0) -> float:
    """By how many σ the mean over dots exceeds that over places; −∞ for less than `LEAST_FREE`.

    Both have values from 0 to 1, shapes (n,) and (m,). That many dots of value 1 are explained
    otherwise, and omitted.
    """
    count, spread = len(dots) - explained, places.std() if len(places) else 0.0
    if count < LEAST_FREE or spread < SAME:
        return -np.inf
    ahead = (dots.sum() - explained) / count - places.mean()
    return float(ahead / spread * np.sqrt(count))


def _within(hull_mm: FloatArray, places_mm: FloatArray) -> BoolArray:
    """Mask of the places within the convex hull of points, shapes (n, 2) and (m, 2), mm."""
    hull = cv2.convexHull(hull_mm.astype(np.float32))
    return np.array([cv2.pointPolygonTest(hull, place, False) >= 0 for place in places_mm], bool)


def _continuation(last_mm: FloatArray, steps_mm: FloatArray, places_mm: FloatArray) -> FloatArray:
    """How well places continue a row or column: 0, not at all, to 1, exactly.

    The last dots of these, and the last steps to them, have the shape (m, 2), the places (n, 2).
    """
    off, square = places_mm[:, None] - last_mm, np.sum(steps_mm**2, axis=-1)
    along = np.maximum(np.sum(off * steps_mm, axis=-1) / square, 0.01)  # 0 for those behind
    across = (off[..., 0] * steps_mm[:, 1] - off[..., 1] * steps_mm[:, 0]) / square
    far, turned = np.log(along / STEP) / STEP_SPREAD, across / along / TURN
    return np.asarray(np.exp(-(far**2 + turned**2).min(axis=1, initial=np.inf) / 2))


def _ends(observed: Observation, labels: IntArray) -> tuple[FloatArray, FloatArray]:
    """Last dots of rows and columns, both ways, and the last steps to them, shapes (m, 2), mm."""
    last, steps = [], []
    for line in [*labels, *labels.T]:
        at = np.flatnonzero(line != UNLABELLED)
        for end, before in [(at[0], at[1]), (at[-1], at[-2])] if len(at) > 1 else []:
            dot_mm, before_mm = observed.plane_mm[line[[end, before]]]
            last.append(dot_mm)
            steps.append((dot_mm - before_mm) / abs(end - before))
    return np.reshape(last, (-1, 2)), np.reshape(steps, (-1, 2))
