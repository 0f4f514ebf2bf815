"""Smooth paths through points: position, direction and curvature of a line of light."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from labapp.core.values import BoolArray, FloatArray, ReadOnlyArrays, robust_sigma

LEAST_SPEED = 1e-3
"""Least change of the position for a step of 1 px along a path, px."""


@dataclass(frozen=True)
class SmoothPath(ReadOnlyArrays):
    """A smooth path sampled at every pixel of its length, n samples.

    Parameters
    ----------
    place, tangent
        (u, v), px, and unit vectors along the path, shape (n, 2).
    curvature
        Curvature of the path, shape (n,), px⁻¹.
    seen
        Whether there are data points nearby, shape (n,).
    """

    place: FloatArray
    tangent: FloatArray
    curvature: FloatArray
    seen: BoolArray

    @classmethod
    def through(cls, points: FloatArray, smooth_px: float) -> SmoothPath:
        """Fit a smooth path through ordered points, shape (m, 2), px."""
        along = _length_along(points)
        # Scatter makes the polyline of the points longer than the path.
        rough = _local_fit(along, points, along, np.ones(len(along)), smooth_px)[0]
        along = _length_along(rough)
        weights = _robust_weights(points, rough)
        at = np.linspace(0.0, along[-1], max(round(along[-1]) + 1, 3))
        seen = np.min(np.abs(at[:, None] - along), axis=1) < 1.5
        return cls._of(_local_fit(along, points, at, weights, smooth_px), seen)

    @classmethod
    def _of(cls, fit: tuple[FloatArray, FloatArray, FloatArray], seen: BoolArray) -> SmoothPath:
        place, slope, bend = fit
        # A path that collapses to a point has no direction; its values must be finite.
        speed = np.maximum(np.linalg.norm(slope, axis=-1), LEAST_SPEED)
        turn = slope[:, 0] * bend[:, 1] - slope[:, 1] * bend[:, 0]
        return cls(place, slope / speed[:, None], turn / speed**3, seen)

    def part(self, first: int, last: int) -> SmoothPath:
        """Return the samples from one to before another."""
        on = slice(first, last)
        return SmoothPath(self.place[on], self.tangent[on], self.curvature[on], self.seen[on])

    @property
    def across(self) -> FloatArray:
        """Unit vector across the path, to the right of ``tangent`` in the image, shape (n, 2)."""
        return np.stack([-self.tangent[:, 1], self.tangent[:, 0]], axis=-1)

    @property
    def longest_gap(self) -> float:
        """Length of the longest part without data points, px."""
        on = np.flatnonzero(self.seen)
        return float(np.max(np.diff(on), initial=1) - 1)

    def moved(self, off: FloatArray, smooth_px: float) -> SmoothPath:
        """Return the path displaced across its direction by ``off``, shape (n,), px."""
        place = self.place + off[:, None] * self.across
        at = _length_along(place)
        fit = _local_fit(at, place, at, np.ones(len(at)), smooth_px / 2)
        return self._of((place, *fit[1:]), self.seen)


def _length_along(points: FloatArray) -> FloatArray:
    return np.append(0.0, np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=-1)))


def _local_fit(
    along: FloatArray, values: FloatArray, at: FloatArray, weights: FloatArray, width: float
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Value and first two derivatives of locally fitted parabolas, shape (m, 2) each.

    Parameters
    ----------
    along, values, weights
        Position along the line, shape (n,), values, shape (n, 2), and their weights, shape (n,).
    at
        Positions along the line, shape (m,).
    width
        Standard deviation of the Gaussian weights.
    """
    step = (along - at[:, None]) / width
    bell = np.exp(-(step**2) / 2) * weights
    moments = np.stack([(bell * step**k).sum(axis=1) for k in range(5)], axis=-1)
    normal = moments[:, np.add.outer(np.arange(3), np.arange(3))]
    normal = normal + 1e-9 * np.eye(3) * moments[:, :1, None]
    right = np.stack([(bell * step**k) @ values for k in range(3)], axis=1)
    value, slope, half_bend = np.moveaxis(np.linalg.solve(normal, right), 1, 0)
    return value, slope / width, 2 * half_bend / width**2


def _robust_weights(points: FloatArray, smooth: FloatArray) -> FloatArray:
    """Tukey's biweights of points from their distance to the smoothed line, shape (n,)."""
    away = np.linalg.norm(points - smooth, axis=-1)
    limit = 4.685 * robust_sigma(away) + 1e-6
    return np.asarray(np.maximum(1 - (away / limit) ** 2, 0.0) ** 2 + 1e-6)
