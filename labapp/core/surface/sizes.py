"""Sizes of a fitted surface, and their derivatives by its coefficients for their uncertainty."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from labapp.core.surface import measures
from labapp.core.surface.boundary import Boundary
from labapp.core.surface.level import Level
from labapp.core.surface.spline import SplineBasis
from labapp.core.values import FloatArray

_NODE, WEIGHT = np.polynomial.legendre.leggauss(measures.RINGS)
FRACTION = (_NODE + 1) / 2
"""Gauss–Legendre weights of the samples on a spoke from the centre to a boundary point, and their
positions as fractions of its length. The weights are not halved for the interval 0 … 1: the factor
2 of ∫ 2 f df cancels it."""

STRIDE = 4
"""Stride over boundary points: every fourth one has a spoke, as the surface is smooth."""


@dataclass(frozen=True)
class Sizes:
    """Width, length, height, depth, area and volume, and their derivatives.

    Parameters
    ----------
    values
        The sizes in this order, shape (6,), mm, mm², mm³.
    peak_mm
        (x, y) where the surface is farthest from the work piece, shape (2,).
    gradient
        Derivatives by the p spline coefficients and the drop of the rear, shape (6, p + 1). NaN for
        the depth of a pool above the work piece if the lowest point is on the boundary, whose rear
        is assumed to be a parabola and not measured.
    holds
        Whether the surface is on one side of the boundary's height between centre and boundary.
    """

    values: FloatArray
    peak_mm: FloatArray
    gradient: FloatArray
    holds: bool


def sizes_and_gradients(
    basis: SplineBasis,
    coefficients: FloatArray,
    level: Level,
    boundary: Boundary,
    boundary_slope: FloatArray,
) -> Sizes:
    """Compute `measures.surface_sizes` with fewer samples, and the derivatives.

    ``boundary_slope``, shape (m, 2), is returned by `trace_boundary`.
    """
    from labapp.core.surface.kernels import boundary_kernels, spline_kernels

    grid, outline, center = basis.grid, boundary.points_mm, boundary.center_mm

    def height(x_mm: FloatArray, y_mm: FloatArray) -> FloatArray:
        place_mm = np.array([x_mm, y_mm]).reshape(2, -1).T
        return np.asarray(spline_kernels.surface_at(grid, coefficients, place_mm)[0])

    count, rear = len(coefficients), level.rear.as_array
    samples, over, share = boundary_kernels.spokes(
        grid, coefficients, outline, center, FRACTION, WEIGHT, rear, STRIDE
    )
    extremes, changes = [], np.zeros((2, count + 1))
    for sign, change, of_most in zip((1, -1), changes, (np.argmax, np.argmin), strict=True):
        within, extreme = (places[of_most(places[:, 2])] for places in (samples, outline))
        # An extreme on the boundary is not refined; one within it may lie between samples.
        if sign * within[2] >= sign * extreme[2]:
            extreme = measures.refined(height, boundary, within, sign)
            change[:-1] = spline_kernels.gradient_of_sum(grid, count, extreme[None, :2], np.ones(1))
        elif level.pool_sign > 0:
            change[:] = np.nan
        extremes.append(extreme)
    high, low = extremes
    by_boundary = boundary_kernels.size_gradients(
        grid, count, samples, share, outline, boundary_slope, center, rear
    )
    width, length = np.ptp(outline[:, :2], axis=0)
    area, volume = share.sum(), share @ samples[:, 2]
    above = (level.pool_sign * over > 0).reshape(-1, len(FRACTION))
    # The middle of a dented pool may lie below the boundary's height, but no part farther out may.
    entered = np.maximum.accumulate(above, axis=1)
    return Sizes(
        np.array([width, length, high[2], low[2], area, volume]),
        (high if abs(high[2]) >= abs(low[2]) else low)[:2],
        np.concatenate([by_boundary[:2], changes, by_boundary[2:]]),
        bool(above[entered].all() and entered[:, -1].all()),
    )
