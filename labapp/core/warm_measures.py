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
from labapp.core.fit import contour
from labapp.core.pool_fit import Level, Rear
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

_NODE, WEIGHT = np.polynomial.legendre.leggauss(measures.RINGS)
FRACTION = (_NODE + 1) / 2
"""What samples between the centre and the boundary weigh, and where they are, of the way."""

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
    for attempt in range(2):
        radius, climb, over = kernels.follow_rim(
            bed.basis.grid,
            coefficients,
            _numbers(level.rear),
            center_mm,
            way,
            radius,
            STEPS,
            LAST_MM,
        )
        place = center_mm + radius[:, None] * way
        inside = bool(bed.basis.contains(*place.T).all() and (radius > 0).all())
        if inside and np.abs(over).max() < ON_RIM_MM:
            break
        found = contour(SplineSurface(bed.basis, coefficients), center_mm, level)
        if attempt:
            break
        radius = np.linalg.norm(found.points_mm[:, :2] - center_mm, axis=-1)
    height = level.rear.height(place[:, 1])
    return Boundary(center_mm, before.theta_deg, np.column_stack([place, height])), climb


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
    grid, outline, center = bed.basis.grid, boundary.points_mm, boundary.center_mm

    def height(x_mm: FloatArray, y_mm: FloatArray) -> FloatArray:
        place_mm = np.stack([x_mm, y_mm], axis=-1).reshape(-1, 2)
        z = kernels.surface_at(grid, coefficients, place_mm)[0]
        return np.asarray(z.reshape(np.shape(x_mm)))

    samples, over, share = kernels.spokes(
        grid, coefficients, outline, center, FRACTION, WEIGHT, _numbers(level.rear), STRIDE
    )
    extremes, changes = [], np.zeros((2, len(coefficients)))
    for sign, change in zip((1.0, -1.0), changes, strict=True):
        within, extreme = (places[np.argmax(sign * places[:, 2])] for places in (samples, outline))
        # On the rim it is where it is, and its height is given; within it may lie between samples.
        if sign * within[2] >= sign * extreme[2]:
            extreme = measures.refined(height, boundary, within, sign)
            change[:] = kernels.gradient_of_sum(grid, len(change), extreme[None, :2], np.ones(1))
        extremes.append(extreme)
    high, low = extremes
    by_rim = kernels.size_gradients(grid, len(coefficients), samples, share, outline, climb, center)
    width, length = np.ptp(outline[:, :2], axis=0)
    area, volume = share.sum(), share @ samples[:, 2]
    above = (level.sign * over > 0).reshape(-1, len(FRACTION))
    # The middle of a dented pool may lie lower; nothing lies lower farther out than it.
    entered = np.maximum.accumulate(above, axis=1)
    return Sizes(
        np.array([width, length, high[2], low[2], area, volume]),
        (high if abs(high[2]) >= abs(low[2]) else low)[:2],
        np.concatenate([by_rim[:2], changes, by_rim[2:]]),
        bool(above[entered].all() and entered[:, -1].all()),
    )


def _numbers(rear: Rear) -> FloatArray:
    """A rear as compiled functions have it."""
    return np.array([rear.drop_mm, rear.start_mm, rear.end_mm])


def sigma_of(
    lower: FloatArray, gradients: FloatArray, level_at: FloatArray, sigma_mm: float
) -> FloatArray:
    """Standard uncertainty of quantities, shape (m,), from their derivatives, shape (m, p).

    Parameters
    ----------
    lower
        Factor of the normal matrix (`solver.normal_factor`).
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
