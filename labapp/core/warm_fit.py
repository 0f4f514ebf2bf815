"""The fit of `pool_fit`, started from the frame before: the same surface in a millisecond.

The normal matrix of the spline coefficients is a band, so that its factor costs little. With one
factor a few rounds suffice: each takes the slopes where the rays now meet the surface, solves for
what they still ask for, and meets the rays anew. Rounds end at the same surface whatever factor
they are solved with; the level is found as ever, from which rays came back and which did not.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import types
from scipy.linalg.blas import dsbmv
from scipy.linalg.lapack import dpbtrs

from labapp.core import kernels
from labapp.core.compiled import compiled
from labapp.core.optics import meet_level, ray_directions
from labapp.core.pool_fit import CORRELATED_MM2, FitSettings, landing_spacing
from labapp.core.rig import Rig
from labapp.core.spline import SplineBasis, normal_factor
from labapp.core.values import BoolArray, FloatArray, IntArray, freeze

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
    hole
        Numbers of the absent ray that tells the rows and of those on its left and right, below and
        above it, shape (5,); None if one of them lands elsewhere.
    spacing_mm
        Between neighbouring landing points along X and along Y, shape (2,), mm.
    laser_mm, plane
        Where the laser is, shape (3,); origin, axes along X′ and Z′ and normal of the imaging
        plane, shape (4, 3).
    stiffness
        Weight of the roughness times its matrix, lower band, shape (width + 1, p).
    settings
        Of the fit.
    """

    rig: Rig
    basis: SplineBasis
    at: IntArray
    rays: FloatArray
    landing_mm: FloatArray
    absent: BoolArray
    hole: IntArray | None
    spacing_mm: FloatArray
    laser_mm: FloatArray
    plane: FloatArray
    stiffness: FloatArray
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
        number = {(i, j): k for k, (i, j) in enumerate((at + 1).tolist())}
        hole = None
        if rig.pattern.marker is not None:
            i, j = rig.pattern.marker
            five = (i, j), (i, j - 1), (i, j + 1), (i - 1, j), (i + 1, j)
            if all(ray in number for ray in five):
                hole = np.array([number[ray] for ray in five])
        return cls(
            rig=rig,
            basis=basis,
            at=at,
            rays=rays,
            landing_mm=landing,
            absent=np.array([(i, j) in rig.pattern.absent_rays for i, j in (at + 1).tolist()]),
            hole=hole,
            spacing_mm=spacing,
            laser_mm=rig.laser.position_mm,
            plane=rig.imaging_plane.pose_mm,
            stiffness=CORRELATED_MM2 / settings.jerk**2 * basis.roughness,
            settings=settings,
        )


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
    grid, rays = bed.basis.grid, bed.rays
    return WarmPool(
        coefficients, *kernels.meet(grid, coefficients, rays, points_mm, steps, bed.plane)
    )


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
        dots = bed.rig.imaging_plane.to_universal(plane_mm)
        jacobian = kernels.slopes_of_dots(bed.laser_mm, bed.plane[1:3], bed.landing_mm[ray], dots)
        return cls(ray, dots, weights_of(jacobian, covariance, bed.settings.floor_mm))


_matrices = types.Array(types.float64, 3, "A", readonly=True)


@compiled(_matrices, _matrices, types.float64)
def weights_of(jacobian: FloatArray, covariance: FloatArray, floor: float) -> FloatArray:
    """What `pool_fit.slope_weights` gives."""
    made = np.empty(jacobian.shape)
    for k in range(len(jacobian)):
        xx, xy, yy = covariance[k, 0, 0] + floor**2, covariance[k, 0, 1], covariance[k, 1, 1]
        yy += floor**2
        (a, b), (c, d) = jacobian[k, 0], jacobian[k, 1]
        one = a * a * xx + 2.0 * a * b * xy + b * b * yy
        other = c * c * xx + 2.0 * c * d * xy + d * d * yy
        both = a * c * xx + (a * d + b * c) * xy + b * d * yy
        area = one * other - both * both
        made[k, 0, 0], made[k, 1, 1] = other / area, one / area
        made[k, 0, 1] = made[k, 1, 0] = -both / area
    return made


def fit_slopes_to(
    bed: Bed,
    pool: WarmPool,
    slopes: Slopes,
    rounds: int = ROUNDS,
    rest: FloatArray | float = 0.0,
    until_mm: float = SETTLED_MM,
    lower: FloatArray | None = None,
) -> tuple[WarmPool, FloatArray, float]:
    """Fit the surface to slopes, round by round from a pool that is near.

    Each round takes the slopes where the rays now meet the surface, fits, and meets them anew,
    until no reflection point moves by ``until_mm``. A factor serves the next round, too, where
    points hardly move; one that serves for the first may be given as ``lower``. What is held down
    is the roughness; of the difference to a surface where coefficients ``rest`` are given.

    Returns
    -------
    pool, lower, moved_mm
        The surface; the factor of the normal matrix (`spline.normal_factor`); how far the
        reflection point moved that moved most in the last round.

    Raises
    ------
    CannotMeasure
        ``no-surface`` if the slopes do not settle the surface.
    """
    grid, rays, weights = bed.basis.grid, bed.rays[slopes.ray], slopes.weights
    coefficients, points = pool.coefficients, pool.points_mm[slopes.ray]
    width, moved = len(bed.stiffness) - 1, 0.0
    lower = normal_factor(bed.basis, bed.stiffness, points, weights) if lower is None else lower
    for _ in range(rounds):
        if moved > SERVES_MM:
            lower = normal_factor(bed.basis, bed.stiffness, points, weights)
        target = kernels.pull(grid, coefficients, points, weights, bed.laser_mm, slopes.dots_mm)
        target -= dsbmv(width, 1.0, bed.stiffness, coefficients - rest, lower=1)
        coefficients = coefficients + solve(lower, target)
        points, moved = kernels.advance(grid, coefficients, rays, points, 1)
        if moved < until_mm:
            break
    every = pool.points_mm.copy()
    every[slopes.ray] = points
    return met(bed, coefficients, every, 1), lower, moved


def solve(lower: FloatArray, right: FloatArray) -> FloatArray:
    """Solve the normal equations of a factor for right sides, shape (p,) or (p, m)."""
    return np.asarray(dpbtrs(lower, right, lower=1)[0])


def lay(bed: Bed, coefficients: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Height and slopes of a surface where the rays would land, shapes (R,) and (R, 2)."""
    z, *slope = kernels.surface_at(bed.basis.grid, coefficients, bed.landing_mm)
    return z, np.array(slope).T
