"""Series of oscillating pool surfaces with known modes: ground truth for the dynamics tests."""

from dataclasses import replace

import numpy as np

from labapp.core.dynamics.analysis import DynamicsSettings, analyse
from labapp.core.dynamics.modes import RHO, SurfaceSeries, bessel_shapes
from labapp.core.surface.boundary import Boundary
from labapp.core.surface.measures import WITH_SIGMA
from labapp.simulation.pools import Footprint, Pool, Wave

ROUGH = [(0, 1), (1, 1), (2, 1), (0, 2), (3, 1), (1, 2)]


def boundary_of(pool):
    """Return the boundary of a simulated pool."""
    points = pool.boundary_mm(360)
    center = (points[:, :2].min(axis=0) + points[:, :2].max(axis=0)) / 2
    theta = np.degrees(np.arctan2(*(points[:, :2] - center).T[::-1]))
    order = np.argsort(theta)
    return Boundary(center, theta[order], points[order])


def series_of(pool, rate_hz, seconds=1.0, rng=None, noise_mm=0.0, lost=0.0):
    """Sample an oscillating pool, with noise in shape and level, and randomly lost frames."""
    outline = boundary_of(pool)
    frames = [k for k in range(int(rate_hz * seconds)) if rng is None or rng.random() >= lost]
    series = SurfaceSeries.of((k, k / rate_hz, pool.after(k / rate_hz), outline) for k in frames)
    if not noise_mm:
        return series
    shapes = np.vstack([*map(bessel_shapes, ROUGH), np.ones((1, len(RHO)))])
    noise = noise_mm * rng.normal(size=(len(frames), len(shapes))) @ shapes
    return replace(series, height_mm=series.height_mm + noise)


def analysed_step():
    """Analyse a pool with two modes whose width grows after a current step at 0.5 s."""
    foot, rng = Footprint(6.6, 3.7, 3.7), np.random.default_rng(1)
    waves = Wave((0, 1), 0.02, 31.0), Wave((1, 1), 0.01, 47.0)
    surfaces = series_of(pool_with(foot, *waves), 200)
    time_s = surfaces.time_s
    series = dict.fromkeys(WITH_SIGMA, surfaces.height_mm[:, 0])
    grown = 0.5 * -np.expm1(-np.maximum(time_s - 0.5, 0) / 0.05)
    series["width_mm"] = 6.6 + grown + rng.normal(0, 0.01, len(time_s))
    current = np.where(time_s < 0.5, 70.0, 90.0)
    return analyse(surfaces, series, {"current": (time_s, current)}, DynamicsSettings())


def pool_with(foot, *waves):
    """Return a convex pool with waves on it."""
    return Pool(foot, 0.29, waves)
