"""Boundary, sizes and their ± of a surface that is near the one of the frame before.

The ± come from how each size changes with the spline coefficients, to first order, rather than
from surfaces one σ away (`fit`): the covariance is the same.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg.lapack import dtbtrs

from labapp.core import measures
from labapp.core.boundary import Boundary
from labapp.core.fit import boundary_of, contour
from labapp.core.pool_fit import Level
from labapp.core.spline import SplineSurface
from labapp.core.values import FloatArray, IntArray
from labapp.core.warm_fit import Bed, spline_values

STEPS = 4
"""Newton steps from the boundary of the frame before, at most."""

LAST_MM = 3e-3
"""After a step of no more the next one would be of some nanometres."""

ON_RIM_MM = 1e-3
"""Before the last step boundary points are on the rim's height to within this, or the boundary is
looked for anew."""

NODE, WEIGHT = np.polynomial.legendre.leggauss(measures.RINGS)

STRIDE = 4
"""Every so many boundary points there is a spoke of samples: the surface is smooth."""


@dataclass(frozen=True)
class Rim:
    """A boundary, and the surface there; m points.

    Parameters
    ----------
    boundary
        The boundary.
    splines, value
        The splines that are not zero at its points, and their values, shape (m, 16).
    climb
        Gradient of the surface's height over the rim's, shape (m, 2).
    """

    boundary: Boundary
    splines: IntArray
    value: FloatArray
    climb: FloatArray


def follow_rim(
    bed: Bed, coefficients: FloatArray, level: Level, center_mm: FloatArray, before: Boundary
) -> Rim:
    """Move a boundary onto a surface that is near its own.

    Raises
    ------
    CannotMeasure
        ``open-boundary`` if there is none.
    """
    radius = np.linalg.norm(before.points_mm[:, :2] - before.center_mm, axis=-1)
    theta = np.radians(before.theta_deg)
    way = np.stack([np.cos(theta), np.sin(theta)], axis=-1)
    for attempt in range(2):
        for _ in range(STEPS):
            place = center_mm + radius[:, None] * way
            splines, values = spline_values(bed.basis, place)
            z, slope_x, slope_y = np.vecdot(values, coefficients[splines])
            y = place[:, 1]
            climb = np.stack([slope_x, slope_y - level.rear.slope(y)], axis=-1)
            outward = np.vecdot(climb, way)
            over = z - level.rear.height(y)
            change = -over / np.where(np.abs(outward) > 1e-6, outward, np.inf)
            radius = radius + np.minimum(np.maximum(change, -0.3), 0.3)
            if np.abs(change).max() < LAST_MM:
                break
        inside = bool(bed.basis.contains(*place.T).all() and (radius > 0).all())
        if inside and np.abs(over).max() < ON_RIM_MM:
            break
        found = contour(SplineSurface(bed.basis, coefficients), center_mm, level)
        if attempt:
            break
        radius = np.linalg.norm(found.points_mm[:, :2] - center_mm, axis=-1)
    return Rim(boundary_of(level.rear, center_mm, way, radius), splines, values[0], climb)


@dataclass(frozen=True)
class Sizes:
    """Width, length, height, depth, area and volume, and how they change with the splines.

    Parameters
    ----------
    size
        Shape (6,), mm, mm², mm³.
    peak_mm
        Where the surface is farthest from the work piece, shape (2,).
    gradient
        Derivatives by the spline coefficients, shape (6, p).
    holds
        Whether the surface is on one side of the rim all the way from the centre to it.
    """

    size: FloatArray
    peak_mm: FloatArray
    gradient: FloatArray
    holds: bool


def sizes_of(bed: Bed, coefficients: FloatArray, level: Level, rim: Rim) -> Sizes:
    """Measure a surface within its boundary as `measures.size_of` does, with fewer samples."""
    boundary, count = rim.boundary, len(coefficients)
    surface = SplineSurface(bed.basis, coefficients)
    outline, center = boundary.points_mm, boundary.center_mm
    fraction = (NODE + 1) / 2
    spoke = outline[::STRIDE, :2] - center
    place = (center + fraction[:, None] * spoke[:, None]).reshape(-1, 2)
    cells = bed.basis.cells(*place.T)
    value = cells.values()
    z = (value * coefficients[cells.splines]).sum(axis=-1)
    wedge = _gathered(measures.wedges(boundary))
    share = (wedge[:, None] * (WEIGHT * fraction)).ravel()
    samples = np.vstack([np.column_stack([place, z]), outline])
    extremes = [int(np.argmax(samples[:, 2])), int(np.argmin(samples[:, 2]))]
    # An extreme on the rim is where it is; one within may lie between the samples.
    high, low = (
        measures.refined(surface, boundary, samples[at], sign) if at < len(place) else samples[at]
        for at, sign in zip(extremes, (1.0, -1.0), strict=True)
    )
    gradient = np.zeros((6, count))
    right, left = int(np.argmax(outline[:, 0])), int(np.argmin(outline[:, 0]))
    head, tail = int(np.argmax(outline[:, 1])), int(np.argmin(outline[:, 1]))
    for row, ahead, behind in ((0, right, left), (1, head, tail)):
        for at, side in ((ahead, -1.0), (behind, 1.0)):
            np.add.at(gradient[row], rim.splines[at], side * rim.value[at] / rim.climb[at, row])
    for row, at, extreme in ((2, extremes[0], high), (3, extremes[1], low)):
        if at < len(place):  # on the rim, whose height is given, nothing changes
            splines, values = spline_values(bed.basis, extreme[None, :2])
            gradient[row, splines[0]] = values[0, 0]
    way = outline[:, :2] - center
    radius = np.linalg.norm(way, axis=-1)
    outward = np.sum(rim.climb * way, axis=-1) / radius
    moved = -radius * (2 * np.pi / len(outline)) / outward
    at_rim = rim.splines.ravel()
    gradient[4] = np.bincount(at_rim, (moved[:, None] * rim.value).ravel(), count)
    gradient[5] = np.bincount(cells.splines.ravel(), (share[:, None] * value).ravel(), count)
    gradient[5] += np.bincount(
        at_rim, ((moved * outline[:, 2])[:, None] * rim.value).ravel(), count
    )
    width, length = np.ptp(outline[:, :2], axis=0)
    peak = high if abs(high[2]) >= abs(low[2]) else low
    size = np.array([width, length, high[2], low[2], wedge.sum(), share @ z])
    over = level.sign * (z - level.rear.height(place[:, 1])).reshape(len(spoke), -1)
    # The middle of a dented pool may lie lower; nothing lies lower farther out than it.
    entered = np.maximum.accumulate(over > 0, axis=1)
    holds = bool((over > 0)[entered].all() and entered[:, -1].all())
    return Sizes(size, peak[:2], gradient, holds)


def _gathered(wedge: FloatArray) -> FloatArray:
    """What each `STRIDE`-th boundary point stands for: its wedge and its share of those between."""
    parts = wedge.reshape(-1, STRIDE)
    share = np.arange(STRIDE) / STRIDE
    return np.asarray(parts @ (1 - share) + np.roll(parts @ share, 1))


def sigma_of(
    lower: FloatArray, gradients: FloatArray, level_at: FloatArray, sigma_mm: float
) -> FloatArray:
    """Standard uncertainty of quantities, shape (m,), from their derivatives, shape (m, p).

    Parameters
    ----------
    lower
        Factor of the normal matrix (`warm_fit.factor`).
    gradients
        Derivatives by the spline coefficients.
    level_at
        Mean value of each spline over the reflection points, shape (p,): what slopes tell is the
        surface without its mean there.
    sigma_mm
        Uncertainty of the level.
    """
    by_level = gradients.sum(axis=1)
    free = gradients - by_level[:, None] * level_at
    half = dtbtrs(lower, np.asfortranarray(free.T), uplo="L")[0]
    return np.asarray(np.sqrt((half * half).sum(axis=0) + (sigma_mm * by_level) ** 2))
