"""The fit of `pool_fit`, started from the frame before: the same surface in a millisecond.

The normal matrix of the spline coefficients is a band, so that its factor costs little. With one
factor a few rounds suffice: each takes the slopes where the rays now meet the surface, solves for
what they still ask for, and meets the rays anew. Rounds end at the same surface whatever factor
they are solved with; the level is found as ever, from which rays came back and which did not.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg.blas import dsbmv
from scipy.linalg.lapack import dpbtrf, dpbtrs

from labapp.core.optics import (
    bisecting_gradient,
    meet_level,
    meet_plane,
    ray_directions,
    reflect,
    surface_normal,
)
from labapp.core.pool_fit import (
    CORRELATED_MM2,
    FitSettings,
    landing_spacing,
    slope_weights,
)
from labapp.core.rig import Rig
from labapp.core.spline import DEGREE, SplineBasis
from labapp.core.values import BoolArray, CannotMeasure, FloatArray, IntArray, freeze

SIDE = DEGREE + 1
COLUMN, ROW = np.tril_indices(SIDE**2)[::-1]
LOWER = ROW * SIDE**2 + COLUMN
"""Products of two of a cell's splines: the lower triangle, and its flat places in the square."""

ROUNDS = 8
SETTLED_MM, SERVES_MM = 3e-4, 5e-3
"""No reflection point moves by more in the last round; a factor serves for moves that are small
beside the splines' cells."""


@dataclass(frozen=True)
class Bed:
    """What stays the same along a track: the splines, and the R rays that land among them.

    Parameters
    ----------
    rig
        The bench.
    basis
        The splines.
    at
        Rows and columns of the rays in the pattern's arrays, counted from 0, shape (R, 2).
    rays, landing_mm
        Unit directions, and where they would land on z = 0, shape (R, 3).
    absent
        Rays that the lens does not make, shape (R,).
    spacing_mm
        Between neighbouring landing points along X and along Y, shape (2,), mm.
    splines, values
        The splines that are not zero where rays land, and their value and derivatives by x and y
        there, shapes (R, 16) and (3, R, 16).
    stiffness
        Weight of the roughness times its matrix, lower band, shape (width + 1, p).
    pairs
        Flat place in the band of each product of two of a cell's splines, less its first spline.
    settings
        Of the fit.
    """

    rig: Rig
    basis: SplineBasis
    at: IntArray
    rays: FloatArray
    landing_mm: FloatArray
    absent: BoolArray
    spacing_mm: FloatArray
    splines: IntArray
    values: FloatArray
    stiffness: FloatArray
    pairs: IntArray
    settings: FitSettings

    def __post_init__(self) -> None:
        freeze(self)

    @classmethod
    def of(cls, rig: Rig, basis: SplineBasis, settings: FitSettings) -> Bed:
        """Lay it out for a rig and the basis of a cold fit."""
        rays = ray_directions(rig.laser, rig.pattern)
        landing = meet_level(rig.laser.position_mm, rays)
        spacing = landing_spacing(landing)
        at = np.argwhere(basis.contains(landing[..., 0], landing[..., 1]))
        rays, landing = rays[at[:, 0], at[:, 1]], landing[at[:, 0], at[:, 1]]
        corner = basis.cells(np.zeros(1), np.zeros(1)).splines[0]
        corner = corner - corner[0]
        count, width = basis.shape[0] * basis.shape[1], int(corner[-1])
        stiffness = np.zeros((width + 1, count))
        matrix = CORRELATED_MM2 / settings.jerk**2 * basis.roughness
        for k in range(width + 1):
            stiffness[k, : count - k] = np.diagonal(matrix, -k)
        splines, values = spline_values(basis, landing[:, :2])
        return cls(
            rig=rig,
            basis=basis,
            at=at,
            rays=rays,
            landing_mm=landing,
            absent=np.array([(i, j) in rig.pattern.absent_rays for i, j in (at + 1).tolist()]),
            spacing_mm=spacing,
            splines=splines,
            values=values,
            stiffness=stiffness,
            pairs=(corner[ROW] - corner[COLUMN]) * count + corner[COLUMN],
            settings=settings,
        )


def spline_values(basis: SplineBasis, place_mm: FloatArray) -> tuple[IntArray, FloatArray]:
    """Splines that are not zero at places, shape (n, 2), held to the rectangle.

    Returns
    -------
    splines, values
        Their numbers, shape (n, 16); value and derivatives by x and by y, shape (3, n, 16).
    """
    x, y = np.minimum(np.maximum(place_mm, basis.low_mm), basis.high_mm).T
    cells = basis.cells(x, y)
    return cells.splines, cells.value_and_slopes()


@dataclass(frozen=True)
class WarmPool:
    """A surface, and what it makes of all rays.

    Parameters
    ----------
    coefficients
        Of the splines, z = 0 at the boundary as far as it is known, shape (p,), mm.
    points_mm
        Where the rays meet it, shape (R, 3), mm.
    slopes
        Its gradient there, shape (R, 2).
    plane_mm
        The dots it makes, IPCS, shape (R, 2), mm; NaN for rays that leave the rectangle or never
        meet the plane.
    """

    coefficients: FloatArray
    points_mm: FloatArray
    slopes: FloatArray
    plane_mm: FloatArray

    def __post_init__(self) -> None:
        freeze(self)


def met(bed: Bed, coefficients: FloatArray, points_mm: FloatArray, steps: int = 2) -> WarmPool:
    """Meet every ray with a surface, from points nearby, shape (R, 3)."""
    points, slope = points_mm, [np.empty(0)] * 2
    for _ in range(steps):
        splines, values = spline_values(bed.basis, points[:, :2])
        z, *slope = np.vecdot(values, coefficients[splines])
        points = points + _step(bed.rays, points[:, 2] - z, *slope)[:, None] * bed.rays
    slopes = np.array(slope).T
    plane = meet_plane(points, reflect(bed.rays, surface_normal(slopes)), bed.rig.imaging_plane)
    plane[~bed.basis.contains(*points[:, :2].T)] = np.nan
    return WarmPool(coefficients, points, slopes, plane)


def _step(
    rays: FloatArray, gap: FloatArray, slope_x: FloatArray, slope_y: FloatArray
) -> FloatArray:
    """Bounded Newton step along rays that are ``gap`` above the surface (`meet_surface`)."""
    descent = slope_x * rays[:, 0] + slope_y * rays[:, 1] - rays[:, 2]
    return np.minimum(np.maximum(gap / np.maximum(descent, 0.05), -0.5), 0.5)


@dataclass(frozen=True)
class Slopes:
    """Dots with their rays, and what they say of slopes; n of them.

    Parameters
    ----------
    ray
        Number of each one's ray in the bed, shape (n,).
    dots_mm
        The dots in the UCS, shape (n, 3), mm.
    weights
        Inverse covariance of the slopes, shape (n, 2, 2).
    """

    ray: IntArray
    dots_mm: FloatArray
    weights: FloatArray

    @classmethod
    def of(cls, bed: Bed, ray: IntArray, plane_mm: FloatArray, covariance: FloatArray) -> Slopes:
        """Weigh dots on the plane, shape (n, 2), of the covariance given, shape (n, 2, 2)."""
        landing, floor = bed.landing_mm[ray], bed.settings.floor_mm
        weights = slope_weights(landing, plane_mm, covariance, bed.rig, floor)
        return cls(ray, bed.rig.imaging_plane.to_universal(plane_mm), weights)


def fit_slopes_to(
    bed: Bed,
    pool: WarmPool,
    slopes: Slopes,
    rounds: int = ROUNDS,
    rest: FloatArray | float = 0.0,
    until_mm: float = SETTLED_MM,
) -> tuple[WarmPool, FloatArray, float]:
    """Fit the surface to slopes, round by round from a pool that is near.

    Each round takes the slopes where the rays now meet the surface, fits, and meets them anew,
    until no reflection point moves by ``until_mm``. A factor serves the next round, too, where
    points hardly move. What is held down is the roughness; of the difference to a surface where
    coefficients ``rest`` are given.

    Returns
    -------
    pool, lower, moved_mm
        The surface; the factor of the normal matrix (`factor`); how far the reflection point moved
        that moved most in the last round.

    Raises
    ------
    CannotMeasure
        ``no-surface`` if the slopes do not settle the surface.
    """
    laser, rays = bed.rig.laser.position_mm, bed.rays[slopes.ray]
    coefficients, points = pool.coefficients, pool.points_mm[slopes.ray]
    count, width = len(coefficients), len(bed.stiffness) - 1
    lower, moved = np.empty(0), np.inf
    for _ in range(rounds):
        splines, values = spline_values(bed.basis, points[:, :2])
        if moved > SERVES_MM:
            lower = factor(bed, splines, values, slopes.weights)
        slope = np.vecdot(values[1:], coefficients[splines]).T
        asked = bisecting_gradient(points - laser, slopes.dots_mm - points)
        pull = (slopes.weights @ (asked - slope)[:, :, None])[:, :, 0]
        right = pull[:, 0, None] * values[1] + pull[:, 1, None] * values[2]
        target = np.bincount(splines.ravel(), right.ravel(), count).astype(float)
        target -= dsbmv(width, 1.0, bed.stiffness, coefficients - rest, lower=1)
        change = solve(lower, target)
        coefficients = coefficients + change
        z, *slope = np.vecdot(values, coefficients[splines])
        step = _step(rays, points[:, 2] - z, *slope)
        points = points + step[:, None] * rays
        moved = float(np.abs(step).max())
        if moved < until_mm:
            break
    every = pool.points_mm.copy()
    every[slopes.ray] = points
    return met(bed, coefficients, every, 1), lower, moved


def factor(bed: Bed, splines: IntArray, values: FloatArray, weights: FloatArray) -> FloatArray:
    """Cholesky factor of the normal matrix, lower band, shape (width + 1, p).

    Slopes leave the level open; it is held by one spline in the middle, which moves nothing else.

    Raises
    ------
    CannotMeasure
        ``no-surface`` if there is none.
    """
    by = np.moveaxis(values[1:], 0, 1)
    square = np.swapaxes(by, 1, 2) @ (weights @ by)
    at = (splines[:, :1] + bed.pairs).ravel()
    gram = np.bincount(at, square.reshape(len(by), -1)[:, LOWER].ravel(), bed.stiffness.size)
    band = gram.reshape(bed.stiffness.shape) + bed.stiffness
    band[0, splines[len(splines) // 2, 5]] += band[0].mean()
    lower, info = dpbtrf(band, lower=1, overwrite_ab=1)
    if info:
        raise CannotMeasure("no-surface", "no surface has the slopes that the dots ask for")
    return np.asarray(lower)


def solve(lower: FloatArray, right: FloatArray) -> FloatArray:
    """Solve the normal equations of a `factor` for right sides, shape (p,) or (p, m)."""
    return np.asarray(dpbtrs(lower, right, lower=1)[0])


def lay(bed: Bed, coefficients: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Height and slopes of a surface where the rays would land, shapes (R,) and (R, 2)."""
    z, *slope = np.vecdot(bed.values, coefficients[bed.splines])
    return z, np.array(slope).T
