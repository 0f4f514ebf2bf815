"""What is not known of the bench, in the sizes of a pool: linear propagation (JCGM 100, 5.1.2).

The fit is done anew with the bench off either way by each column of a root of its covariance, from
where it ended, and with the rays and the witnesses that it had. A column is a quantity's standard
uncertainty, or where quantities are correlated, one of the independent causes of what they are off
by. Half the difference is what a size changes by: over the very width that matters, as the level
answers few rays in steps.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from labapp.core.geometry.optics import intersect_level, ray_directions
from labapp.core.geometry.perturbation import aimed_as, moved_dots, moved_rig
from labapp.core.geometry.rig import Rig
from labapp.core.match import Match
from labapp.core.surface.level import Level, find_level
from labapp.core.surface.pool_fit import CORRELATED_MM2, FitSettings, landing_spacing
from labapp.core.surface.solver import NormalEquations
from labapp.core.surface.spline import SplineSurface
from labapp.core.values import BoolArray, CannotMeasure, FloatArray

ROUNDS = 3
"""Rounds of the fit with a quantity off: what they leave is a thousandth of a millimetre."""

REACH = 0.6
"""Reach of the search for the level (`find_level`) about that of the surface as it was."""


@dataclass(frozen=True)
class Fitted:
    """A fit that ended, to be done again with the bench off.

    Parameters
    ----------
    match, rig, settings
        What was fitted, with what.
    surface, points_mm, level
        What came of it: the surface of p splines, where the rays meet it, shape (n, 3), mm, and
        its level.
    """

    match: Match
    rig: Rig
    settings: FitSettings
    surface: SplineSurface
    points_mm: FloatArray
    level: Level

    def setup_changes(self, gradient: FloatArray) -> FloatArray:
        """Changes of sizes by each independent cause of what the bench is off by.

        Parameters
        ----------
        gradient
            Derivatives of m sizes by the spline coefficients, shape (m, p).

        Returns
        -------
        FloatArray
            Shape (m, q), in the sizes' units; the causes are the columns of `RigUncertainty.root`.
            None where the rig is known exactly; NaN where no surface would be left.

        """
        known = self.rig.uncertainty
        if known is None:
            return np.zeros((len(gradient), 0))
        changes = np.zeros((len(gradient), len(known.root)))
        for k, offset in enumerate(known.root.T):
            if not offset.any():
                continue
            try:
                apart = self._refitted(offset) - self._refitted(-offset)
            except CannotMeasure:
                changes[:, k] = np.nan
                continue
            changes[:, k] = gradient @ apart / 2
        return changes

    def _refitted(self, offset: FloatArray) -> FloatArray:
        """Coefficients with the quantities off by an offset, shape (p,), mm."""
        from labapp.core.surface import kernels

        assert self.rig.uncertainty is not None
        match, basis = self.match, self.surface.basis
        rig = aimed_as(self.rig.laser, moved_rig(self.rig, offset))
        laser, pattern = rig.laser.position_mm, ray_directions(rig.laser, rig.pattern)
        rays, ground = pattern[tuple(match.ray.T - 1)], intersect_level(laser, pattern)
        dots = moved_dots(match.plane_mm, self.rig, self.rig.uncertainty.axes, offset)
        dots = rig.imaging_plane.to_universal(dots)
        plane = rig.imaging_plane.pose_mm
        equations = NormalEquations(basis, self._stiffness, laser, plane, dots, self._weights)
        coefficients, moved = self.surface.coefficients, 0.0
        points = intersect_level(laser, rays, self.points_mm[:, 2:])
        for _ in range(ROUNDS):
            met, _ = kernels.newton_along_rays(basis.grid, coefficients, rays, points, 2)
            moved, points = float(np.abs(met - points).max()), met
            coefficients = equations.step(coefficients, points, moved)
        lit = self._witnesses
        height, *slope = kernels.surface_at(basis.grid, coefficients, ground[lit])
        seen = np.array(slope).T, ground[lit, 1], match.witness[lit], landing_spacing(ground)
        about, rear = (0.0, self.level.sign, REACH), (rig.head_sign, self.level.rear.drop_mm)
        level = find_level(height, *seen, rear, about, match.missing)
        return np.asarray(coefficients + level.shift_mm)

    @cached_property
    def _stiffness(self) -> FloatArray:
        return CORRELATED_MM2 / self.settings.jerk**2 * self.surface.basis.roughness

    @cached_property
    def _weights(self) -> FloatArray:
        """Of the slopes: these hardly change with the bench."""
        from labapp.core.surface import kernels

        plane, match = self.rig.imaging_plane, self.match
        dots = plane.to_universal(match.plane_mm), match.plane_covariance_mm2
        at = self.rig.laser.position_mm, plane.pose_mm, self.points_mm
        return kernels.slope_weights(*at, *dots, self.settings.floor_mm)

    @cached_property
    def _witnesses(self) -> BoolArray:
        """Rays that tell of the level, shape (rows, columns)."""
        laser = self.rig.laser
        ground = intersect_level(laser.position_mm, ray_directions(laser, self.rig.pattern))
        inside = self.surface.basis.contains(ground[..., 0], ground[..., 1])
        return np.asarray((self.match.witness != 0) & inside)


def setup_sigma(changes: FloatArray) -> FloatArray:
    """Standard uncertainty of sizes, shape (m,), from their `Fitted.setup_changes`."""
    return np.asarray(np.sqrt(np.sum(changes**2, axis=1)))
