"""Predicted error of a pool's height for a set-up, without simulation: fast enough for a search.

The fit is replaced by one linear step from the truth: the smooth surface is fitted once to the
true slopes at the true reflection points, and the effect of each part of the budget is calculated
from it. This takes about 10 ms per pool, or 50 ms with the calibration's part; the fit itself takes
100 to 200 ms.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from labapp.core.geometry.optics import (
    bisecting_gradient,
    direction_to_dots,
    intersect_level,
    project_rays,
)
from labapp.core.geometry.perturbation import aimed_as, moved_dots, moved_rig
from labapp.core.geometry.rig import Rig
from labapp.core.geometry.uncertainty import QUANTITIES, AxisPoints, RigUncertainty
from labapp.core.surface.pool_fit import CORRELATED_MM2, FitSettings, basis_around
from labapp.core.surface.solver import SlopeFit, fit_slopes
from labapp.core.values import FloatArray, IntArray, ReadOnlyArrays
from labapp.simulation.forward import Reflections, trace
from labapp.simulation.pools import Pool

DOT_SIGMA_MM = 0.053
"""Standard uncertainty of a dot's position on the plane: 0.3 px of a camera that sees all of it."""

LEAST_DOTS = 9
"""Fewest dots to which a surface is fitted."""

RIM_POINTS = 72

DECIDING = 4
"""Number of lit and dark rays nearest the boundary that determine the level."""


@dataclass(frozen=True)
class PredictedError(ReadOnlyArrays):
    """Predicted standard uncertainties of a pool's height, mm."""

    boundary_mm: float
    """Uncertainty of the level: the reflected rays do not determine exactly where the pool ends."""
    shape_mm: float
    """Error of the smooth surface between and beyond the dots, for exact slopes without noise."""
    dots_mm: float
    """Contribution of the dots' uncertainty on the plane."""
    parameters_mm: FloatArray
    """Contribution of the standard uncertainty of each of the bench's `QUANTITIES`, shape (q,);
    zero if not requested.
    """
    setup_mm: float
    """Sum of these contributions with their correlations."""
    dots: int
    """Number of visible dots."""

    @property
    def random_mm(self) -> float:
        """Combined standard uncertainty without the calibration: the part that varies by frame."""
        return float(np.sqrt(self.boundary_mm**2 + self.shape_mm**2 + self.dots_mm**2))

    @property
    def total_mm(self) -> float:
        """Combined standard uncertainty."""
        return float(np.hypot(self.random_mm, self.setup_mm))


def predict_error(
    pool: Pool,
    rig: Rig,
    *,
    dot_sigma_mm: float = DOT_SIGMA_MM,
    uncertainty: RigUncertainty | None = None,
) -> PredictedError:
    """Predict the error of a pool's height by the fit, as a standard uncertainty.

    Parameters
    ----------
    pool
        A pool of the expected kind with its boundary on the work piece.
    dot_sigma_mm
        Standard uncertainty of a dot's position on the plane.
    uncertainty
        Uncertainty of the set-up. None: known exactly.

    Returns
    -------
    PredictedError
        With infinite parts if fewer than nine dots are visible.
    """
    seen = trace(pool, rig)
    counted = PredictedError(
        boundary_mm=np.inf,
        shape_mm=np.inf,
        dots_mm=np.inf,
        parameters_mm=np.zeros(len(QUANTITIES)),
        setup_mm=0.0,
        dots=int(seen.visible.sum()),
    )
    if counted.dots < LEAST_DOTS:
        return counted
    model = _Model(pool, rig, seen, dot_sigma_mm)
    changes = counted.parameters_mm if uncertainty is None else model.parameters(uncertainty)
    return replace(
        counted,
        boundary_mm=model.boundary(),
        shape_mm=abs(model.height(model.fitted, model.rim) - abs(model.peak_mm)),
        dots_mm=model.noise(),
        parameters_mm=changes,
        setup_mm=0.0 if uncertainty is None else float(uncertainty.combined(changes[None])[0]),
    )


class _Model:
    """Smooth surface through the true slopes, and its response to changes in them."""

    def __init__(self, pool: Pool, rig: Rig, seen: Reflections, dot_sigma_mm: float) -> None:
        from labapp.core.surface.kernels import ray_kernels

        settings = FitSettings()
        self.pool, self.rig, self.seen = pool, rig, seen
        self.points = seen.point_mm[seen.visible]
        self.plane = seen.plane_mm[seen.visible]
        size = pool.size
        convex = pool.peak_mm > 0
        self.sign = 1 if convex else -1
        self.peak_xy = np.array(size.peak_mm if convex else size.bottom_mm)
        self.peak_mm = size.height_mm if convex else size.depth_mm
        self.rim = pool.boundary_mm(RIM_POINTS)[:, :2]
        rays = project_rays(rig.laser, rig.pattern)
        ground = rays.landing_mm[..., :2]
        corners = np.vstack([self.points[:, :2], self.rim, self.peak_xy])
        self.basis = basis_around(corners, rays, settings.knot_mm)
        self.stiffness = CORRELATED_MM2 / settings.jerk**2
        # The weights are those of the fit; the noise is the expected one.
        variance = dot_sigma_mm**2 + settings.floor_mm**2
        covariance = np.broadcast_to(variance * np.eye(2), (len(self.points), 2, 2))
        laser, pose = rig.laser.position_mm, rig.imaging_plane.pose_mm
        dots = rig.imaging_plane.to_universal(self.plane)
        self.weights = ray_kernels.slope_weights(laser, pose, self.points, dots, covariance, 0.0)
        self.fitted = self.fit(self.points, pool.gradient(*self.points[:, :2].T))
        self.inward = self._inward(ground)
        self.dark = ~seen.hit & ~seen.absent & self.basis.contains(ground[..., 0], ground[..., 1])
        self.deciding = self._deciding()
        self.level_at = ground[self.deciding]

    def fit(self, points: FloatArray, slopes: FloatArray) -> SlopeFit:
        return fit_slopes(self.basis, points[:, :2], slopes, self.weights, self.stiffness)

    def height(self, fitted: SlopeFit, rim: FloatArray) -> float:
        """Height of the peak above the boundary's mean, mm, positive for both kinds of pool."""
        peak = fitted.surface.height(self.peak_xy[:1], self.peak_xy[1:])[0]
        return self.sign * float(peak - fitted.surface.height(*rim.T).mean())

    def noise(self) -> float:
        """Standard uncertainty of `height` from the dots' noise and the unknown roughness."""
        rows = self.basis.matrix(*self.peak_xy[:, None])[0] - self.basis.matrix(
            *self.level_at.T
        ).mean(0)
        return float(self.fitted.sigma_of(rows[None])[0])

    def boundary(self) -> float:
        """Standard uncertainty of the level: uniform between the last lit and first dark ray."""
        within = self.inward[self.seen.visible].min()
        beyond = self.inward[self.dark].max() if self.dark.any() else -np.inf
        return float((within - beyond) / np.sqrt(12))

    def _inward(self, xy: FloatArray) -> FloatArray:
        """Height of the pool, or of its continuation, above the work piece near its rim.

        Shape (rows, columns) for points of shape (rows, columns, 2), mm; to first order.
        """
        rho = np.sqrt(self.pool.footprint.place(xy[..., 0], xy[..., 1]).rho2)
        center = np.array(self.pool.footprint.center_mm)
        just_inside = center + (self.rim - center) * (1 - 1e-6)
        fall = np.sum(self.pool.gradient(*just_inside.T) * (self.rim - center), axis=-1)
        return np.asarray((1 - rho) * np.abs(fall).mean())

    def _deciding(self) -> tuple[IntArray, ...]:
        """Indices of the rays that determine the level: lit and dark ones nearest the rim."""
        sides = []
        for side in (self.seen.visible, self.dark):
            nearest = np.argsort(np.abs(self.inward[side]))[:DECIDING]
            sides.append(np.argwhere(side)[nearest])
        return tuple(np.concatenate(sides).T)

    def parameters(self, uncertainty: RigUncertainty) -> FloatArray:
        """Change of `height` by the standard uncertainty of each of `QUANTITIES`, shape (q,)."""
        base = self.height(self.fitted, self.level_at)
        change = np.zeros(len(QUANTITIES))
        for k in np.flatnonzero(uncertainty.sigma):
            step = np.diag(uncertainty.sigma)[k]
            change[k] = self._believed(step, uncertainty.axes) - base
        return change

    def _believed(self, offset: FloatArray, axes: AxisPoints) -> float:
        """Height that is measured if the assumed bench deviates by ``offset``."""
        plane = moved_dots(self.plane, self.rig, axes, offset)
        rig = aimed_as(self.rig.laser, moved_rig(self.rig, offset))
        source = rig.laser.position_mm
        directions = project_rays(rig.laser, rig.pattern).directions
        rays = directions[self.seen.visible]
        points = source + (self.points[:, 2:] - source[2]) / rays[:, 2:] * rays
        reflected = direction_to_dots(points, plane, rig.imaging_plane)
        slopes = bisecting_gradient(points - source, reflected)
        rim = intersect_level(source, directions[self.deciding])[:, :2]
        return self.height(self.fit(points, slopes), rim)
