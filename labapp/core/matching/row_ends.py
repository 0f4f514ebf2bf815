"""Ends of rows and columns of labelled dots, and the dots that continue them.

Towards a steep rim the steps from dot to dot grow faster and faster, and turn. The last three dots
of a row or column predict the next more closely than the surface through all dots does, which is
expected to be smooth.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from labapp.core.matching.observation import UNLABELLED, Observation, widened
from labapp.core.values import BoolArray, FloatArray, IntArray

GROWTH, GROWTH_SPREAD, TURN_SPREAD = 1.5, 0.25, 0.12
"""Where a dot that continues a row or column is: the step to it exceeds the last by this factor
more than the last exceeds that before; standard deviation of the logarithm of that factor; and of
the tangent of the angle to the last step, less that between the last two. Of 1195 such dots, of
pools with a steep rim, nine in ten are within 0.16 to 0.79 (in the logarithm of growth) and
± 0.12."""

USUAL_SPREAD = 0.15
"""Standard deviation of the logarithm of that factor elsewhere, where it is 1."""

MOST_GROWTH, LEAST_GROWTH, MOST_TURN = 2.0, 0.8, 0.7
"""Limits of the ratio of the last two steps, and of the tangent of the angle between them."""

FIRST_SIGMA2, MOST_SIGMA2, MOST_RINGS = 0.5, 6.0, 3
"""A dot may continue a row or column if its squared distance from where it is expected, in σ, is
below the second; those below the first come first; and by how many dots rows and columns are
continued at most."""

SAME = 1e-9
"""Least product of two steps, mm²."""


@dataclass(frozen=True)
class RowEnds:
    """The m ends of rows and columns of at least three labelled dots.

    Parameters
    ----------
    next_ray
        Row and column of the next ray, counted from 0, shape (m, 2); perhaps beyond the pattern.
    last_mm, steps_mm
        Last dots, and the last steps to them, shape (m, 2), mm.
    growth, turn
        Length of the last step over that of the step before, and tangent of the angle between them,
        shape (m,).
    """

    next_ray: IntArray
    last_mm: FloatArray
    steps_mm: FloatArray
    growth: FloatArray
    turn: FloatArray

    @classmethod
    def of(cls, observed: Observation, labels: IntArray) -> RowEnds:
        """Both ends of each row and column of labels, shape (rows, columns)."""
        at: list[FloatArray] = []
        for across, lines in enumerate((labels, labels.T)):
            for line, dots in enumerate(lines):
                lit = np.flatnonzero(dots != UNLABELLED)
                for three in (lit[2::-1], lit[-3:]) if len(lit) > 2 else ():
                    ray = np.stack([np.full(3, line), three], axis=-1)
                    at.append(ray[:, ::-1] if across else ray)
        rays = np.reshape(at, (-1, 3, 2)).astype(int)
        towards = np.sign(rays[:, 2] - rays[:, 1])
        dots_mm = observed.plane_mm[labels[rays[..., 0], rays[..., 1]]]
        apart = np.abs(np.diff(rays, axis=1)).sum(axis=-1, keepdims=True)
        before, last = np.moveaxis(np.diff(dots_mm, axis=1) / apart, 1, 0)
        growth = np.linalg.norm(last, axis=-1) / np.linalg.norm(before, axis=-1)
        turn = _cross(before, last) / np.maximum(np.sum(before * last, axis=-1), SAME)
        return cls(rays[:, 2] + towards, dots_mm[:, 2], last, growth, turn)

    def distances2(self, places_mm: FloatArray, is_rim: bool = True) -> FloatArray:
        """Squared distances of n places, shape (n, 2), from the next dots, in σ, shape (n, m).

        ``is_rim``: the next dots are those of a steep rim. Otherwise, the steps may also continue
        as before (`USUAL_SPREAD`).
        """
        off, square = places_mm[:, None] - self.last_mm, np.sum(self.steps_mm**2, axis=-1)
        # Places behind the last dot count as just beyond it.
        along = np.maximum(np.sum(off * self.steps_mm, axis=-1) / square, 0.01)
        expected = GROWTH * np.clip(self.growth, LEAST_GROWTH, MOST_GROWTH)
        far = np.log(along / expected) / GROWTH_SPREAD
        if not is_rim:
            usual = np.log(along / self.growth) / USUAL_SPREAD
            far = np.where(np.abs(usual) < np.abs(far), usual, far)
        turn = _cross(self.steps_mm, off) / square / along
        turned = (turn - np.clip(self.turn, -MOST_TURN, MOST_TURN)) / TURN_SPREAD
        return np.asarray(far**2 + turned**2)

    def continuation(self, places_mm: FloatArray) -> FloatArray:
        """How well places, shape (n, 2), continue a row or column: 0, not at all, to 1, exactly."""
        return np.asarray(np.exp(-self.distances2(places_mm).min(axis=1, initial=np.inf) / 2))


def continued_labels(observed: Observation, labels: IntArray) -> IntArray:
    """Label the dots that continue rows and columns, shape (rows, columns).

    A dot gets the ray which it continues best if no other dot continues a row or column to that
    ray better. The dots nearest to where they are expected come first: beyond a missing dot, one
    that continues a row exactly may seem to continue a column.
    """
    near = widened(labels != UNLABELLED, MOST_RINGS)
    for limit in (FIRST_SIGMA2, MOST_SIGMA2):
        while (wider := _with_next_dots(observed, labels, near, limit)) is not None:
            labels = wider
    return labels


def _with_next_dots(
    observed: Observation, labels: IntArray, near: BoolArray, limit: float
) -> IntArray | None:
    """Label the dots that continue a row or column, to rays of a mask; None if there are none.

    ``limit`` is the largest squared distance from where they are expected, in σ.
    """
    free = np.setdiff1d(np.arange(len(observed.plane_mm)), labels)
    ends = RowEnds.of(observed, labels)
    there = np.flatnonzero(((ends.next_ray >= 0) & (ends.next_ray < labels.shape)).all(axis=-1))
    at = tuple(ends.next_ray[there].T)
    there = there[near[at] & ~observed.rays.absent[at] & (labels[at] == UNLABELLED)]
    if len(free) == 0 or len(there) == 0:
        return None
    distances2 = ends.distances2(observed.plane_mm[free], is_rim=False)[:, there]
    rays, end = np.unique(ends.next_ray[there], axis=0, return_inverse=True)
    # A ray may continue a row and a column: the nearer place counts.
    far2 = np.stack([distances2[:, end.ravel() == k].min(axis=1) for k in range(len(rays))], axis=1)
    dot, ray = np.arange(len(free)), far2.argmin(axis=1)
    kept = (far2[dot, ray] < limit) & (far2.argmin(axis=0)[ray] == dot)
    if not kept.any():
        return None
    labels = labels.copy()
    labels[tuple(rays[ray[kept]].T)] = free[kept]
    return labels


def _cross(one: FloatArray, other: FloatArray) -> FloatArray:
    """Component of the cross product normal to the plane, shapes (..., 2)."""
    return np.asarray(one[..., 0] * other[..., 1] - one[..., 1] * other[..., 0])
