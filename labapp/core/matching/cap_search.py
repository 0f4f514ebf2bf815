"""Hypotheses from the whole pool: caps whose rays fall on the dots.

A pool is nearly a cap, and how many dots it makes says how large it is. Where a dip or ripples
leave no rows on the picture, the dots outside them still lie near to where a cap of about the
right height and place has them: enough to begin with.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import product

import numpy as np

from labapp.core.matching.ray_growth import UNLABELLED, Scene
from labapp.core.values import FloatArray, IntArray, median

_ASPECTS = (0.9, 1.1, 1.35)
"""Length over width that are tried."""

_HEIGHTS = (0.025, 0.035, 0.045, 0.055, 0.07, -0.03, -0.045, -0.06, -0.08, -0.1)
"""Height over width; below 0 of a concave pool."""

_ASIDE, _ALONG = np.linspace(-0.6, 0.6, 5), np.linspace(-1.2, 1.2, 9)
"""Where its middle lies, X and Y, mm."""

GATE = 0.45
"""A ray finds its dot within this fraction of the way to the next predicted one."""

LEAST = 10
"""Fewer rays than this make no cap."""

LIT_MARKER, DARK = 5.0, 0.5
"""What a dot at the marker's absent ray, and a ray without a dot, take off the rays with one."""

ALIKE = 0.7
"""Two caps are one hypothesis where such a share of the rays that find a dot find the same."""


@dataclass(frozen=True)
class _Cap:
    """A paraboloid over an ellipse: semi-axes and middle, X and Y, and height, mm."""

    axes: FloatArray
    middle: FloatArray
    height: float


def search_caps(scene: Scene, most: int = 8) -> list[IntArray]:
    """Find the caps whose rays fall on the dots best.

    Parameters
    ----------
    scene
        The dots and the rig.
    most
        How many to return at most, no two much alike.

    Returns
    -------
    list of IntArray
        Index of the dot of each ray or `UNLABELLED`, shape (rows, columns); the best first.
    """
    judged = [found for cap in _caps(scene) if (found := _judged(scene, cap)) is not None]
    judged.sort(key=lambda one: -one[0])
    best: list[IntArray] = []
    for _, labels in judged:
        if not any(_alike(labels, other) for other in best):
            best.append(labels)
            if len(best) == most:
                break
    return best


def _caps(scene: Scene) -> Iterator[_Cap]:
    """Those to be tried: each as large as there are dots for."""
    area = len(scene.plane_mm) * scene.spacing_mm.prod()
    for aspect, height, x, y in product(_ASPECTS, _HEIGHTS, _ASIDE, _ALONG):
        axes = np.sqrt(area / np.pi * np.array([1 / aspect, aspect]))
        yield _Cap(axes, np.array([x, y]), 2 * height * float(axes[0]))


def _judged(scene: Scene, cap: _Cap) -> tuple[float, IntArray] | None:
    """How well the dots lie where the cap has them, and the labels of those that do."""
    from labapp.core.images.dot_kernels import two_nearest
    from labapp.core.surface import kernels

    down = np.array([0.0, 0.0, cap.height])  # the quadric has its top at 0
    rays, plane = scene.rays.reshape(-1, 3), scene.rig.imaging_plane.pose_mm
    plane = np.vstack([plane[:1] - down, plane[1:]])
    laser = scene.rig.laser.position_mm - down
    curvature = -2 * cap.height / cap.axes**2
    quadric = np.array([[0.0, 0.0, curvature[0], 0.0, curvature[1]]])
    points, dots = (
        part[0] for part in kernels.meet_quadrics(cap.middle, quadric, rays, laser, plane)
    )
    from_middle = np.sum(((points[:, :2] - cap.middle) / cap.axes) ** 2, axis=-1)
    there = (from_middle < 1) & np.isfinite(dots).all(axis=-1)
    own = np.flatnonzero(there & ~scene.absent.ravel())
    if len(own) < LEAST:
        return None
    predicted, captured = dots[own], scene.plane_mm
    spacing = two_nearest(predicted, predicted)[0][:, 1]
    away, dot = (part[:, 0] for part in two_nearest(predicted, captured))
    mutual = two_nearest(captured, predicted)[1][dot, 0] == np.arange(len(own))
    near = mutual & (away < GATE * spacing)
    score = float(np.sum(1 - away[near] / spacing[near]) - DARK * np.sum(~near))
    marker = scene.absent.ravel() & there
    if marker.any():
        off = two_nearest(dots[marker], captured)[0][:, 0]
        score -= LIT_MARKER * float(np.mean(off < 0.3 * median(spacing)))
    labels = np.full(scene.absent.size, UNLABELLED, np.int64)
    labels[own[near]] = dot[near]
    return score, labels.reshape(scene.absent.shape)


def _alike(one: IntArray, other: IntArray) -> bool:
    both = (one != UNLABELLED) & (other != UNLABELLED)
    return bool(both.any() and np.mean(one[both] == other[both]) > ALIKE)
