"""Level: height of z = 0 on a surface that slopes determine up to a constant.

It is estimated from the rays that are known to be lit or dark: a lit ray landed inside the
boundary, a dark one outside. The boundary is on the work piece, except at the
pool's rear, which may lie below it (§7.2).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from labapp.core.geometry.optics import project_rays
from labapp.core.geometry.rig import Rig
from labapp.core.surface.spline import SplineBasis
from labapp.core.values import BoolArray, FloatArray, IntArray, ReadOnlyArrays

LEAST_DARK = 3
"""Minimum number of dark rays that show the boundary. Where the pool is larger than the pattern,
one or two may be missing dots at its corners: of 210 frames 3 had a single one, and one of these
was 28 % too low, by 2.9 σ."""

BOUNDARY_UNSEEN = f"fewer than {LEAST_DARK} rays in view are dark: the boundary is not seen"

_LevelInput = tuple[BoolArray, FloatArray, IntArray, FloatArray, FloatArray]


def boundary_is_seen(ray_states: IntArray) -> bool:
    """Whether enough rays are dark (`Match.ray_states`) to show where the pool ends."""
    return int(np.count_nonzero(ray_states < 0)) >= LEAST_DARK


@dataclass(frozen=True)
class Rear:
    """Depth of the boundary below the work piece at the pool's rear (§7.2).

    Parameters
    ----------
    drop_mm
        Depth at the end, mm; 0 if the entire boundary is on the work piece.
    start_mm, end_mm
        Y where the boundary leaves the work piece, and where the pool's rear ends, mm.
    """

    drop_mm: float = 0.0
    start_mm: float = 0.0
    end_mm: float = -1.0

    @property
    def as_array(self) -> FloatArray:
        """Drop, start and end as an array for compiled functions, shape (3,), mm."""
        return np.array([self.drop_mm, self.start_mm, self.end_mm], float)

    def height(self, y_mm: FloatArray) -> FloatArray:
        """Height of the boundary at Y (`spline_kernels.drop_share`), shape as ``y_mm``, mm."""
        from labapp.core.surface.kernels import spline_kernels

        return spline_kernels.rear_heights(self.as_array, y_mm.ravel()).reshape(y_mm.shape)


@dataclass(frozen=True)
class Level:
    """Level of a surface that is known up to a constant.

    Parameters
    ----------
    shift_mm
        Shift to add to the surface's height, mm.
    sigma_mm
        Its standard uncertainty, mm.
    pool_sign
        +1 for a pool above the work piece inside its boundary, −1 for one below.
    rear
        Part of the boundary below the work piece.
    negative_log_likelihood
        −log likelihood of the lit and dark rays near the boundary: 0 if every lit one lands inside
        and every dark one outside, or if no ray is known to be dark.
    ray_count, rise_mm
        Number of these rays; typical change of the height there from one ray to the next, mm.
    drop_sigma_mm, drop_covariance_mm2
        Standard uncertainty of the rear's drop, mm, and its covariance with the shift, mm².
    """

    shift_mm: float
    sigma_mm: float
    pool_sign: int
    rear: Rear
    negative_log_likelihood: float
    ray_count: int = 0
    rise_mm: float = 0.0
    drop_sigma_mm: float = 0.0
    drop_covariance_mm2: float = 0.0

    @classmethod
    def of(cls, values: FloatArray) -> Level:
        """Build a level from the result of `level_kernels.find_level`, shape (11,)."""
        shift, sigma, sign, drop, start, end, least, rays, *others = values.tolist()
        return cls(shift, sigma, int(sign), Rear(drop, start, end), least, int(rays), *others)

    @property
    def as_array(self) -> FloatArray:
        """Values as an array for compiled functions (`of`), shape (11,)."""
        rear = self.rear
        first = self.shift_mm, self.sigma_mm, self.pool_sign
        found = self.negative_log_likelihood, self.ray_count, self.rise_mm
        by_drop = self.drop_sigma_mm, self.drop_covariance_mm2
        values = (*first, rear.drop_mm, rear.start_mm, rear.end_mm, *found, *by_drop)
        return np.array(values, float)

    def sigma_of(self, by_shift: FloatArray, by_drop: FloatArray) -> FloatArray:
        """Standard uncertainty of quantities due to that of the level, shape (m,).

        Parameters are their derivatives by the shift and by the rear's drop, shape (m,).
        """
        both = 2 * self.drop_covariance_mm2 * by_shift * by_drop
        variance = (self.sigma_mm * by_shift) ** 2 + both + (self.drop_sigma_mm * by_drop) ** 2
        return np.sqrt(np.maximum(variance, 0.0))

    def height_inside(
        self, height_mm: FloatArray, slope: FloatArray, landing_mm: FloatArray, laser_mm: FloatArray
    ) -> FloatArray:
        """Height of the surface, on the pool's side, over the boundary where rays pass it.

        It is above 0 for rays that land inside.

        Parameters
        ----------
        height_mm, slope
            The surface and its gradient at the landing points, shapes (m,), mm, and (m, 2).
        landing_mm, laser_mm
            Landing points on z = 0, shape (m, 3), and position of the laser, shape (3,), mm.

        Returns
        -------
        ndarray
            Shape (m,), mm.
        """
        from labapp.core.surface.kernels import ray_kernels

        per_depth = ray_kernels.rise_per_depth(slope, landing_mm, laser_mm)
        over_mm = height_mm - self.rear.height(landing_mm[:, 1]) * per_depth
        return np.asarray(self.pool_sign * over_mm)

    @property
    def disagreement_bits(self) -> float:
        """Mean −log₂ likelihood of the rays near the boundary; infinite if there are none."""
        return (
            self.negative_log_likelihood / np.log(2) / self.ray_count if self.ray_count else np.inf
        )


@dataclass(frozen=True)
class KnownRays(ReadOnlyArrays):
    """The m rays that are known to be lit or dark.

    Parameters
    ----------
    landing_mm
        Landing points on z = 0, shape (m, 3), mm.
    ray_states
        +1 lit, −1 dark, shape (m,).
    spacing_mm
        Distance between neighbouring landing points along X and along Y, shape (2,), mm.
    head_sign, laser_mm
        +1 where the pool's head lies towards +Y, −1 for the reverse (`Rig.head_sign`); position of
        the laser, shape (3,), mm.
    missing
        Probability that a reflected ray has no dot (`Match.missing`).
    height_sigma_mm
        Standard uncertainty of the surface's height there, apart from its level, shape (m,), mm.
        None: it is taken as exact.
    """

    landing_mm: FloatArray
    ray_states: IntArray
    spacing_mm: FloatArray
    head_sign: int
    laser_mm: FloatArray
    missing: float = 0.0
    height_sigma_mm: FloatArray | None = None

    @classmethod
    def of(cls, rig: Rig, ray_states: IntArray, basis: SplineBasis, missing: float) -> KnownRays:
        """Select the known ones of a rig's rays, shape (rows, columns), in the spline domain."""
        rays = project_rays(rig.laser, rig.pattern)
        landing, known = rays.landing_mm, ray_states != 0
        if known.any():
            known &= basis.contains(landing[..., 0], landing[..., 1])
        bench = rays.spacing_mm, rig.head_sign, rig.laser.position_mm
        return cls(landing[known], ray_states[known], *bench, missing)

    def negative_log_evidence(
        self, basis: SplineBasis, coefficients: FloatArray, level: Level
    ) -> float:
        """−log probability of their states, marginalised over levels near one and blurs, nats.

        The surface is at that level, and its rear is fixed. A constant is omitted.
        """
        from labapp.core.surface.kernels import level_kernels

        height, slope, inside = self.surface_there(basis, coefficients, level)
        return level_kernels.negative_log_evidence(
            height,
            slope,
            self.ray_states,
            self.spacing_mm,
            inside,
            self.missing,
            level_kernels.BLURS,
        )

    def surface_there(
        self, basis: SplineBasis, coefficients: FloatArray, level: Level
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Height of a surface where the rays land, its gradient, and its height over the boundary.

        Shapes (m,), mm, (m, 2), and (m,), mm, as `Level.height_inside`.
        """
        from labapp.core.surface.kernels import spline_kernels

        there = spline_kernels.surface_at(basis.grid, coefficients, self.landing_mm)
        height, slope = there[0], there[1:].T
        return height, slope, level.height_inside(height, slope, self.landing_mm, self.laser_mm)


@dataclass(frozen=True)
class LevelSearch:
    """How rounds of a fit determine the level (`solver.Rounds.run`).

    Parameters
    ----------
    known_rays
        Rays that determine the level.
    near
        Initial estimate of the level for the first search. None: all levels are tried.
    drop_is_free
        Whether the drop of the rear is found along with the level, in the first half of the rounds.
        While it is fixed, its part of the uncertainty of the level stays the same.
    level_settled_mm
        After a shift of the surface by less, the level is not determined again.
    """

    known_rays: KnownRays
    near: Level | None = None
    drop_is_free: bool = True
    level_settled_mm: float = 0.0

    @cached_property
    def for_kernel(self) -> tuple[_LevelInput, FloatArray, tuple[float, float, bool, bool, float]]:
        """The level's arguments of `rounds_kernels.run_rounds`, and the last five limits."""
        known_rays, near = self.known_rays, self.near
        sigma = known_rays.height_sigma_mm
        level_input = (
            np.empty(0, bool),
            known_rays.landing_mm,
            known_rays.ray_states,
            np.zeros(len(known_rays.ray_states)) if sigma is None else sigma,
            known_rays.spacing_mm,
        )
        level = near or Level(0.0, np.inf, 1, Rear(), 0.0)
        flags = self.drop_is_free, near is not None
        limits = (known_rays.head_sign, known_rays.missing, *flags, self.level_settled_mm)
        return level_input, level.as_array, limits


NO_SEARCH = LevelSearch(
    KnownRays(np.empty((0, 3)), np.empty(0, np.int64), np.ones(2), 1, np.ones(3))
)
"""The mean height of the reflection points stays."""
