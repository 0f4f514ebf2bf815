"""Scenes of known truth for the tests of matching: exact reflections in a simulated camera."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from labapp.core.geometry.coordinates import ImageCalibration
from labapp.core.geometry.rig import DotPattern, Electrode, ImagingPlane, Laser, Rig
from labapp.core.images.dots import Dots
from labapp.core.matching.observation import UNLABELLED
from labapp.core.values import FloatArray, IntArray
from labapp.simulation.forward import PoolSurface, Reflections, trace

# The set-up of Fig. 3-17, with a plane wide enough for every dot and the torch high above.
OPEN_RIG = Rig(
    Laser(31.14, 31.48),
    DotPattern(),
    Electrode(500.0),
    ImagingPlane.vertical(50.0, 500.0, -300.0, 1000.0, 1000.0),
)

# The same set-up with the dimensions of the bench.
BENCH_RIG = Rig(
    Laser(31.14, 31.48), DotPattern(), Electrode(5.0), ImagingPlane.vertical(50.0, 45.0, 3.0)
)
BENCH_VIEW = ImageCalibration.from_three_points(
    (44.0, 590.0), (440.0, 582.3), 69.85, (40.5, 410.0), 31.75
)
FRAME_SHAPE = (640, 480)


@dataclass(frozen=True)
class SeenDots:
    """Dots as a perfect detector would find them, and the ray of each.

    Parameters
    ----------
    dots
        The dots, in random order.
    ray
        Ray (i, j) of each, shape (n, 2); 0 for a dot that no ray made.
    """

    dots: Dots
    ray: IntArray


def gaussian_dots(shape: tuple[int, int], places_px: FloatArray, size_px: float) -> FloatArray:
    """Sum of round Gaussian dots of peak 1 at (u, v), shape (n, 2), px."""
    along, across = (
        np.exp(-((np.arange(length)[:, None] - center) ** 2) / (2 * size_px**2))
        for length, center in zip(shape, places_px.T[::-1], strict=True)
    )
    return np.asarray(along @ across.T)


def see(
    pool: PoolSurface,
    rng: np.random.Generator,
    *,
    sigma_px: float = 0.15,
    missing: int = 0,
    false: int = 0,
    rig: Rig = BENCH_RIG,
) -> SeenDots:
    """Return the dots of a pool in the view of the bench, some missing, some false."""
    reflections = trace(pool, rig)
    image, ray = visible_dots(reflections)
    order = rng.permutation(len(image))[missing:]
    image, ray = image[order] + rng.normal(0.0, sigma_px, (len(order), 2)), ray[order]
    stray = rng.uniform(10.0, np.array(FRAME_SHAPE[::-1]) - 10.0, (false, 2))
    image = np.concatenate([image, stray])
    ray = np.concatenate([ray, np.zeros((false, 2), np.int64)])
    return SeenDots(as_dots(image, sigma_px), ray)


def true_labels(seen: SeenDots) -> IntArray:
    """Return the index of each ray's dot, or `UNLABELLED`, shape (rows, columns)."""
    labels = np.full((BENCH_RIG.pattern.rows, BENCH_RIG.pattern.columns), UNLABELLED, np.int64)
    dot = np.flatnonzero(seen.ray[:, 0] > 0)
    labels[seen.ray[dot, 0] - 1, seen.ray[dot, 1] - 1] = dot
    return labels


def visible_dots(reflections: Reflections) -> tuple[FloatArray, IntArray]:
    """Position of each dot in the view of the bench, px, and its ray."""
    image = BENCH_VIEW.to_image(np.nan_to_num(reflections.plane_mm, nan=-1e3))
    limit = np.array(FRAME_SHAPE[::-1]) - 1
    shown = reflections.visible & ((image > 0) & (image < limit)).all(axis=-1)
    return image[shown], np.argwhere(shown) + 1


def as_dots(image_px: FloatArray, sigma_px: float = 0.15) -> Dots:
    """Dots of equal brightness at given positions, shape (n, 2), px."""
    n = len(image_px)
    sigma = np.full(n, max(sigma_px, 0.02))
    return Dots(
        u_px=image_px[:, 0],
        v_px=image_px[:, 1],
        u_sigma_px=sigma,
        v_sigma_px=sigma,
        size_px=np.full(n, 2.0),
        peak=np.full(n, 50.0),
        snr=np.full(n, 20.0),
    )
