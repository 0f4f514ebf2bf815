"""Surfaces of swinging pools whose modes are known, as series: truth for the tests of dynamics."""

from dataclasses import replace

import numpy as np

from labapp.core.dynamics.modes import RHO, SurfaceSeries, bessel_shapes
from labapp.core.surface.boundary import Boundary
from labapp.simulation.pools import Pool

ROUGH = [(0, 1), (1, 1), (2, 1), (0, 2), (3, 1), (1, 2)]


def boundary_of(pool):
    """Boundary of a pool of the twin."""
    points = pool.boundary_mm(360)
    center = (points[:, :2].min(axis=0) + points[:, :2].max(axis=0)) / 2
    theta = np.degrees(np.arctan2(*(points[:, :2] - center).T[::-1]))
    order = np.argsort(theta)
    return Boundary(center, theta[order], points[order])


def series_of(pool, rate_hz, seconds=1.0, rng=None, noise_mm=0.0, lost=0.0):
    """Surfaces of a pool that swings, with noise in shape and level, and frames lost at random."""
    outline = boundary_of(pool)
    frames = [k for k in range(int(rate_hz * seconds)) if rng is None or rng.random() >= lost]
    series = SurfaceSeries.of((k, k / rate_hz, pool.after(k / rate_hz), outline) for k in frames)
    if not noise_mm:
        return series
    shapes = np.vstack([*map(bessel_shapes, ROUGH), np.ones((1, len(RHO)))])
    noise = noise_mm * rng.normal(size=(len(frames), len(shapes))) @ shapes
    return replace(series, height_mm=series.height_mm + noise)


def pool_with(foot, *waves):
    """A convex pool with waves on it."""
    return Pool(foot, 0.29, waves)
