"""Boundary, sizes and their ± of a surface that is near the one of the frame before.

The ± come from how each size changes with the spline coefficients, to first order, rather than
from surfaces one σ away (`fit`): the covariance is the same.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg.lapack import dtbtrs

from labapp.core import kernels, measures
from labapp.core.boundary import Boundary
from labapp.core.fit import boundary_of, contour
from labapp.core.pool_fit import Level
from labapp.core.spline import SplineSurface
from labapp.core.values import FloatArray
from labapp.core.warm_fit import Bed

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


def follow_rim(
    bed: Bed, coefficients: FloatArray, level: Level, center_mm: FloatArray, before: Boundary
) -> tuple[Boundary, FloatArray]:
    """Move a boundary onto a surface that is near its own.

    Returns
    -------
    boundary, climb
        The boundary of m points, and the gradient there of the surface's height over the rim's,
        shape (m, 2).

    Raises
    ------
    CannotMeasure
        ``open-boundary`` if there is none.
    """
    radius = np.linalg.norm(before.points_mm[:, :2] - before.center_mm, axis=-1)
    theta = np.radians(before.theta_deg)
    way = np.stack([np.cos(theta), np.sin(theta)], axis=-1)
    rear = np.array([level.rear.drop_mm, level.rear.start_mm, level.rear.end_mm])
    for attempt in range(2):
        radius, climb, over = kernels.follow_rim(
            bed.basis.grid, coefficients, rear, center_mm, way, radius, STEPS, LAST_MM
        )
        place = center_mm + radius[:, None] * way
        inside = bool(bed.basis.contains(*place.T).all() and (radius > 0).all())
        if inside and np.abs(over).max() < ON_RIM_MM:
            break
        found = contour(SplineSurface(bed.basis, coefficients), center_mm, level)
        if attempt:
            break
        radius = np.linalg.norm(found.points_mm[:, :2] - center_mm, axis=-1)
    return boundary_of(level.rear, center_mm, way, radius), climb


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


def sizes_of(
    bed: Bed, coefficients: FloatArray, level: Level, boundary: Boundary, climb: FloatArray
) -> Sizes:
    """Measure a surface within its boundary as `measures.size_of` does, with fewer samples."""

    def height(x_mm: FloatArray, y_mm: FloatArray) -> FloatArray:
        place_mm = np.stack([x_mm, y_mm], axis=-1).reshape(-1, 2)
        z = kernels.surface_at(bed.basis.grid, coefficients, place_mm)[0]
        return np.asarray(z.reshape(np.shape(x_mm)))

    def gradient_of(place_mm: FloatArray, share: FloatArray) -> FloatArray:
        return kernels.gradient_of_sum(bed.basis.grid, len(coefficients), place_mm, share)

    outline, center = boundary.points_mm, boundary.center_mm
    fraction = (NODE + 1) / 2
    spoke = outline[::STRIDE, :2] - center
    place = (center + fraction[:, None] * spoke[:, None]).reshape(-1, 2)
    z = kernels.surface_at(bed.basis.grid, coefficients, place)[0]
    wedge = _gathered(measures.wedges(boundary))
    share = (wedge[:, None] * (WEIGHT * fraction)).ravel()
    samples = np.vstack([np.column_stack([place, z]), outline])
    extremes = [int(np.argmax(samples[:, 2])), int(np.argmin(samples[:, 2]))]
    # An extreme on the rim is where it is; one within may lie between the samples.
    high, low = (
        measures.refined(height, boundary, samples[at], sign) if at < len(place) else samples[at]
        for at, sign in zip(extremes, (1.0, -1.0), strict=True)
    )
    gradient = np.zeros((6, len(coefficients)))
    ends = outline[:, :2].argmax(axis=0), outline[:, :2].argmin(axis=0)
    for axis, end in enumerate(np.transpose(ends)):
        gradient[axis] = gradient_of(outline[end, :2], np.array([-1.0, 1.0]) / climb[end, axis])
    for row, at, extreme in ((2, extremes[0], high), (3, extremes[1], low)):
        if at < len(place):  # on the rim, whose height is given, nothing changes
            gradient[row] = gradient_of(extreme[None, :2], np.ones(1))
    way = outline[:, :2] - center
    radius = np.linalg.norm(way, axis=-1)
    outward = np.sum(climb * way, axis=-1) / radius
    moved = -radius * (2 * np.pi / len(outline)) / outward
    gradient[4] = gradient_of(outline[:, :2], moved)
    gradient[5] = gradient_of(place, share) + gradient_of(outline[:, :2], moved * outline[:, 2])
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
