"""Dots without a ray at the rim of the labelled ones: the rim of the pool is left out.

Where a pool is steeper towards its edge than the surface through the other dots, the dots of the
rim lie farther out than predicted and get no ray. Where it becomes flat there, as at a toe, they
lie close to the others, or among them. Their rays would count as dark, and the pool would be
measured too low, by up to 55 %.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from labapp.core.matching.observation import UNLABELLED, Observation, amid
from labapp.core.values import BoolArray, CannotMeasure, FloatArray, IntArray

MOST_LIKELIER = 6.0
"""The rim is left out if the dots without a ray are likelier, by this logarithm, where the dots of
a rim are than anywhere in the frame."""

GROWTH, GROWTH_SPREAD, TURN_SPREAD = 1.5, 0.25, 0.12
"""Where a dot that continues a row or column is: the step to it exceeds the last by this factor
more than the last exceeds that before, as steps grow faster and faster towards a steep rim;
standard deviation of the logarithm of that factor; and of the tangent of the angle to the last
step, less that between the last two. Of 1195 such dots, of pools with a steep rim, nine in ten are
within 0.16 to 0.79 (in the logarithm of growth) and ± 0.12."""

MOST_GROWTH, LEAST_GROWTH, MOST_TURN = 2.0, 0.8, 0.7
"""Limits of the ratio of the last two steps, and of the tangent of the angle between them."""

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
    if len(free_mm) == 0:
        return False
    ends = _Ends.of(observed, labels)
    own_mm = observed.plane_mm[labels[lit]]
    height, width = observed.frame_shape
    u, v = np.meshgrid(np.linspace(0, width - 1, GRID), np.linspace(0, height - 1, GRID))
    places_mm = observed.bench.calibration.to_plane(np.stack([u, v], axis=-1).reshape(-1, 2))

    near_mm = np.vstack([own_mm, ends.last_mm + NEAR_STEPS * ends.steps_mm])
    near, places_near = (_within(near_mm, each).astype(float) for each in (free_mm, places_mm))
    gaps = int(np.count_nonzero(amid(lit) & ~lit & ~observed.without_dot))
    if _log_ratio(near, places_near, gaps) > MOST_LIKELIER:
        return True
    outside_mm, places_mm = (each[~_within(own_mm, each)] for each in (free_mm, places_mm))
    continuing, places = ends.continuation(outside_mm), ends.continuation(places_mm)
    return _log_ratio(continuing, places) > MOST_LIKELIER


def _log_ratio(dots: FloatArray, places: FloatArray, explained: int = 0) -> float:
    """Log likelihood ratio of dots where values are high, in proportion, to dots anywhere.

    The share of the dots to which this applies is the likeliest. Values of dots, shape (n,), and of
    places all over the frame, shape (m,), are 0 to 1. Of the dots with the highest values, that
    many are explained otherwise, and omitted.
    """
    if len(places) == 0 or places.std() < SAME:
        return 0.0
    density = np.sort(dots)[: len(dots) - explained] / places.mean()
    return float(np.log1p(SHARES[:, None] * (density - 1)).sum(axis=1).max())


def _within(hull_mm: FloatArray, places_mm: FloatArray) -> BoolArray:
    """Mask of the places within the convex hull of points, shapes (n, 2) and (m, 2), mm."""
    hull = cv2.convexHull(hull_mm.astype(np.float32))
    return np.array([cv2.pointPolygonTest(hull, place, False) >= 0 for place in places_mm], bool)


@dataclass(frozen=True)
class _Ends:
    """The m ends of rows and columns of at least three labelled dots.

    Parameters
    ----------
    last_mm, steps_mm
        Last dots, and the last steps to them, shape (m, 2), mm.
    growth, turn
        Length of the last step over that of the step before, and tangent of the angle between them,
        shape (m,).
    """

    last_mm: FloatArray
    steps_mm: FloatArray
    growth: FloatArray
    turn: FloatArray

    @classmethod
    def of(cls, observed: Observation, labels: IntArray) -> _Ends:
        """Both ends of each row and column of labels, shape (rows, columns)."""
        dots, apart = [], []
        for line in (*labels, *labels.T):
            at = np.flatnonzero(line != UNLABELLED)
            for three in (at[2::-1], at[-3:]) if len(at) > 2 else ():
                dots.append(line[three])
                apart.append(np.abs(np.diff(three)))
        dots_mm = observed.plane_mm[np.reshape(dots, (-1, 3)).astype(int)]
        steps_mm = np.diff(dots_mm, axis=1) / np.reshape(apart, (-1, 2, 1))
        before, last = steps_mm[:, 0], steps_mm[:, 1]
        growth = np.linalg.norm(last, axis=-1) / np.linalg.norm(before, axis=-1)
        turn = _cross(before, last) / np.maximum(np.sum(before * last, axis=-1), SAME)
        return cls(dots_mm[:, 2], last, growth, turn)

    def continuation(self, places_mm: FloatArray) -> FloatArray:
        """How well places, shape (n, 2), continue a row or column: 0, not at all, to 1, exactly."""
        off, square = places_mm[:, None] - self.last_mm, np.sum(self.steps_mm**2, axis=-1)
        along = np.maximum(
            np.sum(off * self.steps_mm, axis=-1) / square, 0.01
        )  # 0 for those behind
        expected = GROWTH * np.clip(self.growth, LEAST_GROWTH, MOST_GROWTH)
        far = np.log(along / expected) / GROWTH_SPREAD
        turn = _cross(self.steps_mm, off) / square / along
        turned = (turn - np.clip(self.turn, -MOST_TURN, MOST_TURN)) / TURN_SPREAD
        return np.asarray(np.exp(-(far**2 + turned**2).min(axis=1, initial=np.inf) / 2))


def _cross(one: FloatArray, other: FloatArray) -> FloatArray:
    """Component of the cross product normal to the plane, shapes (..., 2)."""
    return np.asarray(one[..., 0] * other[..., 1] - one[..., 1] * other[..., 0])
