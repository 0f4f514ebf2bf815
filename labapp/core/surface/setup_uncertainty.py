"""What is not known of the bench, in the sizes of a pool: linear propagation (JCGM 100, 5.1.2).

The bench is off by each column of a root of its covariance, with the rays and the witnesses that
the fit had. A column is a quantity's standard uncertainty or, where quantities are correlated, one
of the independent causes of what they are off by. The surface answers linearly: its coefficients
solve the normal equations, so that their change follows from that of the right-hand side (implicit
differentiation). Where z = 0 lies answers few rays in steps: that level is found anew with the
bench off either way, and half the difference is taken, over the very width that matters.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from labapp.core.geometry.optics import (
    bisecting_gradient,
    direction_to_dots,
    intersect_level,
    project_rays,
)
from labapp.core.geometry.perturbation import aimed_as, moved_dots, moved_rig
from labapp.core.geometry.rig import Rig
from labapp.core.match import Match
from labapp.core.surface.level import Witnesses
from labapp.core.surface.pool_fit import FitSettings, FittedPool, normal_equations
from labapp.core.surface.solver import NormalEquations
from labapp.core.values import FloatArray

ROUNDS = 3
"""Rounds in which the reflection points follow the surface: what they leave is a thousandth."""

SHARE, STEP_MM = 1e-4, 1e-3
"""Share of a column by which the bench is off for the change of the right-hand side: where
reflection points go far from those of the factor, what the dots leave nearly open runs away. And
the step of the differences along the rays."""

REACH = 0.6
"""Reach of the search for the level (`find_level`) about that of the surface as it was."""


def setup_changes(
    match: Match, rig: Rig, settings: FitSettings, pool: FittedPool, gradient: FloatArray
) -> FloatArray:
    """Changes of sizes by each independent cause of what the bench is off by.

    Parameters
    ----------
    match, rig, settings
        What was fitted, with what.
    pool
        What came of it, p splines.
    gradient
        Derivatives of m sizes by the spline coefficients, shape (m, p).

    Returns
    -------
    FloatArray
        Shape (m, q), in the sizes' units; the causes are the columns of `RigUncertainty.root`. None
        where the rig is known exactly.
    """
    known = rig.uncertainty
    if known is None:
        return np.zeros((len(gradient), 0))
    changes = np.zeros((len(gradient), len(known.root)))
    off = np.flatnonzero(known.root.any(axis=0)).tolist()
    benches = [_bench_off(match, rig, SHARE * known.root[:, k]) for k in off]
    change = _Response.of(match, rig, settings, pool).of_benches(benches) / SHARE
    basis, about = pool.surface.basis, (0.0, pool.level.sign, REACH)
    own = project_rays(rig.laser, rig.pattern)
    x, y = own.landing_mm[..., 0], own.landing_mm[..., 1]
    seen = (match.witness != 0) & basis.contains(x, y)
    landing, sign = own.landing_mm[seen], match.witness[seen]
    for k, by, (bench, _) in zip(off, change.T, benches, strict=True):
        aside = (project_rays(bench.laser, bench.pattern).landing_mm[seen] - landing) / SHARE
        more, less = (
            Witnesses(landing + way * aside, sign, own.spacing_mm, rig.head_sign, match.missing)
            .level(basis, pool.surface.coefficients + way * by, pool.level.rear.drop_mm, about)
            .shift_mm
            for way in (1.0, -1.0)
        )
        changes[:, k] = gradient @ (by + (more - less) / 2)
    return changes


@dataclass(frozen=True)
class _Response:
    """The fit's normal equations about where it ended, of n rays and p splines.

    Parameters
    ----------
    match, pool, equations
        What was fitted, what came of it, and the equations that it solves.
    along
        Change of their right-hand side where a reflection point moves along its ray, shape (p, n).
    sinking
        How far a point moves along its ray where a spline rises, shape (n, p).
    values
        Value of each spline at the points, shape (n, p).
    """

    match: Match
    pool: FittedPool
    equations: NormalEquations
    along: FloatArray
    sinking: FloatArray
    values: FloatArray

    @classmethod
    def of(cls, match: Match, rig: Rig, settings: FitSettings, pool: FittedPool) -> _Response:
        """Work it out for a fit that ended."""
        points, surface = pool.points_mm, pool.surface
        dots = match.plane_mm, match.plane_covariance_mm2
        equations = normal_equations(surface.basis, rig, points, *dots, settings)
        rays = project_rays(rig.laser, rig.pattern).directions[tuple(match.ray.T - 1)]

        def pulls(points_mm: FloatArray) -> FloatArray:
            """What each point adds to the right-hand side, shape (n, p)."""
            x, y = points_mm[:, 0], points_mm[:, 1]
            by = np.stack([surface.basis.matrix(x, y, 1), surface.basis.matrix(x, y, 0, 1)], axis=1)
            on = direction_to_dots(points_mm, match.plane_mm, rig.imaging_plane)
            lacking = bisecting_gradient(points_mm - equations.laser_mm, on)
            lacking -= by @ surface.coefficients
            weighed = np.einsum("nab,nb->na", equations.weights, lacking)
            return np.asarray(np.einsum("na,nap->np", weighed, by))

        along = (pulls(points + STEP_MM * rays) - pulls(points - STEP_MM * rays)) / (2 * STEP_MM)
        x, y = points[:, 0], points[:, 1]
        values, slopes = surface.basis.matrix(x, y), surface.gradient(x, y)
        descent = np.vecdot(slopes, rays[:, :2]) - rays[:, 2]
        return cls(match, pool, equations, along.T, -values / descent[:, None], values)

    def of_benches(self, benches: Sequence[tuple[Rig, FloatArray]]) -> FloatArray:
        """Changes of the coefficients on q other benches, shape (p, q), mm.

        A bench is a rig, and where the dots are on its plane, shape (n, 2), mm.
        """
        from labapp.core.surface import kernels

        own = self.equations
        base = self._right_side(own.laser_mm, own.plane, own.dots_mm, None)
        sides = [
            self._right_side(
                bench.laser.position_mm,
                bench.imaging_plane.pose_mm,
                bench.imaging_plane.to_universal(plane_mm),
                project_rays(bench.laser, bench.pattern).directions[tuple(self.match.ray.T - 1)],
            )
            for bench, plane_mm in benches
        ]
        right = np.stack(sides, axis=-1) - base[:, None]
        change = np.zeros_like(right)
        for _ in range(ROUNDS):
            asked = right + self.along @ (self.sinking @ change)
            change = kernels.solve(self.pool.factor, asked.T).T
            change -= (self.values @ change).mean(axis=0)  # slopes leave the level open
        return change

    def _right_side(
        self,
        laser_mm: FloatArray,
        plane: FloatArray,
        dots_mm: FloatArray,
        rays: FloatArray | None,
    ) -> FloatArray:
        """Right-hand side of the equations with the surface as it is, shape (p,)."""
        from labapp.core.surface import kernels

        surface, points = self.pool.surface, self.pool.points_mm
        grid = surface.basis.grid
        if rays is not None:
            start = intersect_level(laser_mm, rays, points[:, 2:])
            points, _ = kernels.newton_along_rays(grid, surface.coefficients, rays, start, 2)
        at = grid, surface.coefficients, points, self.equations.weights
        return kernels.gradient_rhs(*at, laser_mm, plane, dots_mm)


def _bench_off(match: Match, rig: Rig, offset: FloatArray) -> tuple[Rig, FloatArray]:
    """The rig with its quantities off by an offset, shape (q,); the dots on its plane, mm."""
    assert rig.uncertainty is not None
    dots = moved_dots(match.plane_mm, rig, rig.uncertainty.axes, offset)
    return aimed_as(rig.laser, moved_rig(rig, offset)), dots


def setup_sigma(changes: FloatArray) -> FloatArray:
    """Standard uncertainty of sizes, shape (m,), from their `setup_changes`, shape (m, q)."""
    return np.asarray(np.sqrt(np.sum(changes**2, axis=1)))
