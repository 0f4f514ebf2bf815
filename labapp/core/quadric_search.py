"""Hypotheses from the optics: quadrics whose rays round the absent centre fall on dots.

Where rows bow so far that no grid grows on the picture, the surface can still be told from the
few dots round the hole: near its middle a pool is a quadric z = g·x + ½(κ_x x² + κ_y y²). The
hole fixes g, the two dots beside it κ_x, and κ_y is tried out.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from labapp.core.optics import bisecting_gradient, meet_plane, reflect, surface_normal
from labapp.core.ray_growth import UNLABELLED, Scene
from labapp.core.values import FloatArray, IntArray

REACH = 3
"""Rows and columns each way from the reference that a quadric is held against."""

_LIFTS = np.array([0.0, 0.2, -0.2, 0.4, -0.4])
"""How far the hole may lie off the middle of the two dots beside it, in their distance."""

_RATIOS = np.geomspace(0.35, 2.2, 14)
"""κ_y/κ_x that are tried."""

_FLATTEST = 0.004
"""|κ| below which a pool is flat: its dots could not be told apart, mm⁻¹."""

_STEEPEST = 0.6
"""|κ| above which no pool is, mm⁻¹."""


@dataclass(frozen=True)
class QuadricGuess:
    """One quadric and the dots its rays fall on.

    Parameters
    ----------
    curvature
        (κ_x, κ_y), mm⁻¹.
    labels
        Index of each ray's dot or `UNLABELLED`, shape (rows, columns).
    hits
        How many rays found their dot, less those that should have and did not.
    """

    curvature: tuple[float, float]
    labels: IntArray
    hits: float


def search_quadrics(scene: Scene, gate: float, most: int = 12) -> list[QuadricGuess]:
    """Find the quadrics that explain the dots round some hole best, the best first.

    Parameters
    ----------
    scene
        The dots and the rig.
    gate
        A ray finds its dot within this fraction of the spacing of the predicted dots.
    most
        How many to return at most; no two with the same labels.
    """
    i0, j0 = (n - 1 for n in scene.rig.pattern.reference)
    rows = slice(max(i0 - REACH, 0), i0 + REACH + 1)
    columns = slice(max(j0 - REACH, 0), j0 + REACH + 1)
    tree = cKDTree(scene.plane_mm)
    found: dict[bytes, QuadricGuess] = {}
    for hole, half_width in _holes(scene, tree):
        for guess in _fit_hole(scene, tree, hole, half_width, (rows, columns), gate):
            key = guess.labels.tobytes()
            if key not in found or found[key].hits < guess.hits:
                found[key] = guess
    return sorted(found.values(), key=lambda guess: -guess.hits)[:most]


def _holes(scene: Scene, tree: cKDTree) -> Iterator[tuple[FloatArray, float]]:
    """Empty places between two dots, IPCS, and half the dots' distance along X′, mm."""
    dots = scene.plane_mm
    for p, near in enumerate(tree.query(dots, k=min(10, len(dots)))[1]):
        for q in near[1:]:
            step = dots[q] - dots[p]
            if step[0] <= 0 or abs(step[1]) > 0.6 * step[0]:
                continue
            # Where one dot is missing between two, the next one on lies half as far off.
            beyond = tree.query([dots[p] - step / 2, dots[q] + step / 2])[0]
            if beyond.min() > 0.42 * np.linalg.norm(step):
                continue
            for lift in _LIFTS * np.linalg.norm(step):
                hole = (dots[p] + dots[q]) / 2 + [0.0, lift]
                if tree.query(hole)[0] > 0.3 * np.linalg.norm(step):
                    yield hole, step[0] / 2


def _fit_hole(
    scene: Scene,
    tree: cKDTree,
    hole: FloatArray,
    half_width: float,
    window: tuple[slice, slice],
    gate: float,
) -> list[QuadricGuess]:
    """Try every κ_y, and both signs of κ_x that put the neighbouring dots where they are."""
    laser = scene.rig.laser.position_mm
    slope = bisecting_gradient(-laser[None], scene.rig.imaging_plane.to_universal(hole)[None])[0]
    i0, j0 = (n - 1 for n in scene.rig.pattern.reference)
    beside = scene.rays[i0, j0 + 1 : j0 + 2]
    # The dot beside the hole moves linearly with κ_x: two trials give both solutions.
    moved = [
        float(_quadric_dots(scene, slope, np.array([[kappa, kappa]]), beside)[0, 0] - hole[0])
        for kappa in (-0.02, 0.02)
    ]
    rate = (moved[1] - moved[0]) / 0.04
    rays = scene.rays[window]
    shape = rays.shape[:2]
    kappa_x = (np.array([1, -1]) * half_width - (moved[0] + moved[1]) / 2) / rate
    kappa_x = kappa_x[(np.abs(kappa_x) > _FLATTEST) & (np.abs(kappa_x) < _STEEPEST)]
    curvatures = (kappa_x[:, None, None] * np.stack([np.ones_like(_RATIOS), _RATIOS], -1)).reshape(
        -1, 2
    )
    patterns = _quadric_dots(scene, slope, curvatures[:, None], rays.reshape(-1, 3))
    return [
        guess
        for curvature, pattern in zip(curvatures, patterns.reshape(-1, *shape, 2), strict=True)
        if (guess := _score(scene, tree, pattern, window, gate, tuple(curvature))) is not None
    ]


def _quadric_dots(
    scene: Scene, slope: FloatArray, curvature: FloatArray, rays: FloatArray
) -> FloatArray:
    """Dots that quadrics through the origin make of rays, IPCS, shape (…, n, 2), mm.

    ``slope`` has shape (2,), ``curvature`` (…, 1, 2), ``rays`` (n, 3).
    """
    laser = scene.rig.laser.position_mm
    points = laser - laser[2] / rays[:, 2:] * rays
    for _ in range(3):
        xy = points[..., :2]
        gap = points[..., 2] - np.sum((slope + 0.5 * curvature * xy) * xy, axis=-1)
        descent = rays[:, 2] - np.sum((slope + xy * curvature) * rays[:, :2], axis=-1)
        step = np.clip(gap / np.maximum(-descent, 0.05), -1.0, 1.0)
        points = points + step[..., None] * rays
    normal = surface_normal(slope + points[..., :2] * curvature)
    return meet_plane(points, reflect(rays, normal), scene.rig.imaging_plane)


def _score(
    scene: Scene,
    tree: cKDTree,
    dots: FloatArray,
    window: tuple[slice, slice],
    gate: float,
    curvature: tuple[float, float],
) -> QuadricGuess | None:
    """Hold predicted dots, shape (rows, columns, 2), against those found."""
    absent = scene.absent[window]
    sane = np.isfinite(dots).all(axis=-1)
    flat = np.where(sane[..., None], dots, 1e6)
    spacing = np.full(sane.shape, np.inf)
    for axis in (0, 1):
        step = np.linalg.norm(np.diff(flat, axis=axis), axis=-1)
        pad = [(0, 0), (0, 0)]
        for side in ((1, 0), (0, 1)):
            pad[axis] = side
            spacing = np.minimum(spacing, np.pad(step, pad, constant_values=np.inf))
    distance, dot = tree.query(flat)
    hit = (distance < gate * spacing) & ~absent & sane
    middle = tuple(slice(n // 2 - 1, n // 2 + 2) for n in sane.shape)
    if hit[middle].sum() < 6:
        return None
    labels = np.full(scene.rays.shape[:2], UNLABELLED, np.int64)
    part = np.where(hit, dot, UNLABELLED)
    chosen, count = np.unique(part[hit], return_counts=True)
    part[np.isin(part, chosen[count > 1])] = UNLABELLED
    labels[window] = part
    seen = scene.in_view(flat) & ~absent & sane
    # A ray near the hole that should show its dot and does not speaks against the quadric.
    i, j = np.indices(sane.shape)
    close = np.hypot(i - sane.shape[0] // 2, j - sane.shape[1] // 2) < 1.5
    nearness = 1 - np.mean(distance[hit] / (gate * spacing[hit]))
    score = np.sum(part != UNLABELLED) - 3.0 * np.sum(seen & close & ~hit) + 4.0 * nearness
    return QuadricGuess(curvature, labels, float(score))
