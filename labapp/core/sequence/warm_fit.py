"""The fit of `pool_fit`, started from the frame before: the same surface in a millisecond.

With one factor of the normal matrix (`solver`) a few rounds suffice. The level is found as ever,
from which rays came back and which did not.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from labapp.core.geometry.optics import intersect_level, landing_spacing, ray_directions
from labapp.core.geometry.rig import Rig
from labapp.core.surface import kernels
from labapp.core.surface.pool_fit import CORRELATED_MM2, FitSettings
from labapp.core.surface.solver import NormalEquations, Rounds
from labapp.core.surface.spline import SplineBasis
from labapp.core.values import BoolArray, FloatArray, IntArray, ReadOnlyArrays

ROUNDS = 8
SETTLED_MM = 3e-4
"""No reflection point moves by more in the last round."""


@dataclass(frozen=True)
class SequenceGeometry(ReadOnlyArrays):
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

    @cached_property
    def flat(self) -> IntArray:
        """Numbers of the rays in the pattern's arrays, row by row, shape (R,)."""
        return np.asarray(self.at @ np.array([self.rig.pattern.columns, 1]))

    @classmethod
    def of(cls, rig: Rig, basis: SplineBasis, settings: FitSettings) -> SequenceGeometry:
        """Lay it out for a rig and the basis of a cold fit."""
        rays = ray_directions(rig.laser, rig.pattern)
        landing = intersect_level(rig.laser.position_mm, rays)
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
class WarmPool(ReadOnlyArrays):
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


def intersect_and_reflect(
    geometry: SequenceGeometry, coefficients: FloatArray, points_mm: FloatArray, steps: int = 2
) -> WarmPool:
    """Meet every ray with a surface, from points nearby, shape (R, 3)."""
    grid, rays = geometry.basis.grid, geometry.rays
    return WarmPool(
        coefficients,
        *kernels.intersect_and_reflect(grid, coefficients, rays, points_mm, steps, geometry.plane),
    )


@dataclass(frozen=True)
class Slopes:
    """Dots with their rays, and what they say of slopes; n of them.

    Parameters
    ----------
    ray
        Number of each one's ray in the geometry, shape (n,).
    dots_mm
        The dots in the UCS, shape (n, 3), mm.
    weights
        Inverse covariance of the slopes, shape (n, 2, 2).
    """

    ray: IntArray
    dots_mm: FloatArray
    weights: FloatArray

    @classmethod
    def of(
        cls, geometry: SequenceGeometry, ray: IntArray, plane_mm: FloatArray, covariance: FloatArray
    ) -> Slopes:
        """Weigh dots on the plane, shape (n, 2), of the covariance given, shape (n, 2, 2)."""
        dots = geometry.rig.imaging_plane.to_universal(plane_mm)
        at = geometry.laser_mm, geometry.plane[1:3], geometry.landing_mm[ray], dots
        return cls(ray, dots, kernels.slope_weights(*at, covariance, geometry.settings.floor_mm))


def fit_slopes_to(
    geometry: SequenceGeometry,
    pool: WarmPool,
    slopes: Slopes,
    rounds: int = ROUNDS,
    rest: FloatArray | float = 0.0,
    until_mm: float = SETTLED_MM,
    lower: FloatArray | None = None,
) -> tuple[WarmPool, FloatArray, float]:
    """Fit the surface to slopes, round by round from a pool that is near.

    Each round takes the slopes where the rays now meet the surface, fits, and meets them anew,
    until no reflection point moves by ``until_mm``. The factor of the first round may be given as
    ``lower``. What is held down is the roughness; of the difference to a surface where
    coefficients ``rest`` are given.

    Returns
    -------
    pool, lower, moved_mm
        The surface; the factor of the normal matrix (`solver.normal_factor`); how far the
        reflection point moved that moved most in the last round.

    Raises
    ------
    CannotMeasure
        ``no-surface`` if the slopes do not settle the surface.
    """
    rays = geometry.rays[slopes.ray]
    equations = NormalEquations(
        geometry.basis, geometry.stiffness, geometry.laser_mm, slopes.dots_mm, slopes.weights, lower
    )
    fit = Rounds(equations, rays, pool.coefficients, pool.points_mm[slopes.ray])
    fit.run(rounds, until_mm, smooth_about=rest)
    every = pool.points_mm.copy()
    every[slopes.ray] = fit.points_mm
    assert equations.factor is not None
    made = intersect_and_reflect(geometry, fit.coefficients, every, 1)
    return made, equations.factor, fit.moved_mm


def evaluate_at_landing_points(
    geometry: SequenceGeometry, coefficients: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Height and slopes of a surface where the rays would land, shapes (R,) and (R, 2)."""
    z, *slope = kernels.surface_at(geometry.basis.grid, coefficients, geometry.landing_mm)
    return z, np.array(slope).T
