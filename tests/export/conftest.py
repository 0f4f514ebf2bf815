from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from labapp.core.geometry.coordinates import ImageCalibration
from labapp.core.images.dots import Dots
from labapp.core.match import Match
from labapp.core.pipeline import Measurement
from labapp.core.rows.lattice import Lattice
from labapp.core.surface.boundary import Boundary
from labapp.core.surface.measures import Measures
from labapp.core.surface.reconstruction import Reconstruction
from labapp.export.results import ResultsWriter

RADIUS_MM, HEIGHT_MM = 3.0, 0.3


class Paraboloid:
    """z = height·(1 − r²/R²): a pool with its boundary on the circle of radius R."""

    def height(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        return HEIGHT_MM * (1 - (x**2 + y**2) / RADIUS_MM**2)

    def gradient(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        return -2 * HEIGHT_MM / RADIUS_MM**2 * np.stack([x, y], axis=-1)


def pool() -> Reconstruction:
    theta = np.arange(-180.0, 180.0, 5.0)
    circle = RADIUS_MM * np.column_stack([np.cos(np.radians(theta)), np.sin(np.radians(theta))])
    points = np.array([[0.0, 0.0, 0.3], [1.0, 0.0, 0.266667]])
    return Reconstruction(
        scheme="fit",
        surface=Paraboloid(),
        boundary=Boundary(np.zeros(2), theta, np.column_stack([circle, np.zeros(len(theta))])),
        ray=np.array([[10, 9], [10, 11]]),
        points_mm=points,
        residual_mm=np.array([[0.3, 0.4], [0.0, -0.01]]),
        sigma_mm=np.array([0.002, np.nan]),
    )


def dots(count: int) -> Dots:
    """Dots at intervals of 20 px along u, from (10, 20) px."""
    equal = (np.full(count, value) for value in (20.0, 0.1, 0.2, 2.0, 40.0, 9.0))
    return Dots(10 + 20.0 * np.arange(count), *equal)


@pytest.fixture
def measured() -> Measurement:
    """Three dots: two with rays, one in doubt; row 2 blocked."""
    sizes = dict.fromkeys(Measures.__dataclass_fields__, 1.25)
    sizes |= {name: 0.0 for name in sizes if "_setup_" in name}
    return Measurement(
        status="ok",
        reason="",
        scheme="fit",
        dots=dots(3),
        lattice=Lattice(np.array([1, 0, 2]), np.array([4, 0, 5]), blocked_rows=frozenset({2})),
        match=Match(
            orientation="I/I",
            dot=np.array([2, 0]),
            ray=np.array([[10, 9], [10, 11]]),
            reflected=np.array([[2, 5], [1, 4]]),
            plane_mm=np.zeros((2, 2)),
            plane_covariance_mm2=np.zeros((2, 2, 2)),
            ray_states=np.zeros((19, 19), int),
        ),
        reconstruction=pool(),
        measures=Measures(**sizes | {"depth_mm": -0.0, "volume_sigma_mm3": np.nan}),
    )


@pytest.fixture
def unmeasured() -> Measurement:
    """A frame with dots and nothing else."""
    return Measurement(
        status="ambiguous-rows",
        reason='two references fit, "a" and "b"',
        scheme="fit",
        dots=dots(1),
        lattice=None,
        match=None,
        reconstruction=None,
        measures=None,
    )


@pytest.fixture
def calibration() -> ImageCalibration:
    """0.5 mm per pixel, O′ at (0, 100) px."""
    return ImageCalibration(np.array([[0.5, 0, 0], [0, -0.5, 50], [0, 0, 1]]))


@pytest.fixture
def writer(calibration: ImageCalibration) -> Callable[[Path], ResultsWriter]:
    """Open a writer of results in a folder."""
    return lambda folder: ResultsWriter(folder, calibration, {"source": {"path": "v.avi"}})
