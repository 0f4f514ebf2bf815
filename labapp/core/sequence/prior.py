"""Prior of a frame from the previous ones, and prediction of its surface."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numba import types

from labapp.core.compiled import compiled
from labapp.core.geometry.bench import Bench
from labapp.core.images.peaks import DetectorTuning
from labapp.core.match import Match
from labapp.core.matching.prediction import RayPaths
from labapp.core.schemes.fit import UNSETTLED_MM, FromPrevious, SetupPart, parts_after
from labapp.core.surface.boundary import Boundary
from labapp.core.surface.level import Level
from labapp.core.surface.measures import Measures
from labapp.core.surface.pool_fit import FitSettings, FittedPool, normal_equations
from labapp.core.surface.reconstruction import Reconstruction
from labapp.core.surface.solver import NEWTON_STEPS, Rounds
from labapp.core.surface.spline import SplineBasis
from labapp.core.values import BoolArray, CannotMeasure, FloatArray, IntArray

MEMORY, ORDER, STRIDE = 32, 8, 3
"""Number of past frames from which the recurrence is estimated, its maximum order, and the stride
over lit rays: every third one is sufficient."""

RIDGE = 1e-4
"""Penalty on the coefficients of the recurrence, as a share of the trace of its normal matrix."""

MOST_ROUNDS, SETTLED_MM = 8, 3e-4
"""Maximum number of rounds of a fit that starts from a close surface, and its convergence limit."""

DROP_EVERY = 16
"""Interval in frames after which the drop of the rear is fitted again."""


@dataclass(frozen=True)
class Tracked:
    """A frame matched and fitted from its prior.

    Parameters
    ----------
    match, pool, paths
        The pairs, the surface fitted to them, and the paths of all rays.
    lit
        Rays that have a dot, shape (rows, columns).
    reference_is_seen
        Whether the absent ray is dark and all its four neighbours are lit.
    """

    match: Match
    pool: FittedPool
    paths: RayPaths
    lit: BoolArray
    reference_is_seen: bool


@dataclass(frozen=True)
class Prior:
    """Information of a measured frame for the next one.

    Parameters
    ----------
    tuning
        Size of dots and noise.
    cold_match, cold_residual_mm
        Match of the last frame that was measured without a prior, and its root mean square
        residual, mm.
    basis, settings
        Splines of the surface, and the settings with which it was fitted.
    paths, lit, boundary, level
        Paths of the R rays of the pattern for the last surface; which of them had dots, shape
        (rows, columns); boundary and level of the pool.
    past, slopes
        Spline coefficients of the last frames, newest last, shape (frames, p), mm, and the slopes
        of those surfaces at the reflection points, shape (frames, R, 2).
    setup_parts
        Parts of the set-up in the uncertainty of sizes, each with the sizes for which it was
        computed: the sizes of a pool that oscillates recur.
    unseen
        Number of frames since `Tracked.reference_is_seen` was last true.
    """

    tuning: DetectorTuning
    cold_match: Match
    cold_residual_mm: float
    basis: SplineBasis
    settings: FitSettings
    paths: RayPaths
    lit: BoolArray
    boundary: Boundary
    level: Level
    past: FloatArray
    slopes: FloatArray
    setup_parts: tuple[SetupPart, ...]
    unseen: int = 0
    count: int = 0

    @classmethod
    def of(
        cls,
        bench: Bench,
        tuning: DetectorTuning,
        match: Match,
        pool: FittedPool,
        reconstruction: Reconstruction,
        measures: Measures,
    ) -> Prior:
        """Build the prior from a frame that was matched without one."""
        basis, coefficients = pool.surface.basis, pool.surface.coefficients
        paths = RayPaths.of(bench, basis, coefficients)
        return cls(
            tuning=tuning,
            cold_match=match,
            cold_residual_mm=pool.residual_rms_mm,
            basis=basis,
            settings=pool.settings,
            paths=paths,
            lit=match.ray_states > 0,
            boundary=reconstruction.boundary,
            level=pool.level,
            past=coefficients[None],
            slopes=paths.slopes[None],
            setup_parts=(SetupPart(reconstruction.size_sigma_setup, measures.sizes),),
        )

    def after(self, tracked: Tracked, reconstruction: Reconstruction, measures: Measures) -> Prior:
        """Build the prior for the frame after one that was tracked with this one."""
        of_setup = reconstruction.size_sigma_setup
        paths, lit, pool = tracked.paths, tracked.lit, tracked.pool
        return replace(
            self,
            paths=paths,
            lit=lit,
            boundary=reconstruction.boundary,
            level=pool.level,
            past=np.vstack([self.past[1 - MEMORY :], paths.coefficients]),
            slopes=np.concatenate([self.slopes[1 - MEMORY :], paths.slopes[None]]),
            setup_parts=parts_after(self.setup_parts, of_setup, measures.sizes),
            unseen=0 if tracked.reference_is_seen else self.unseen + 1,
            count=self.count + 1,
        )

    @property
    def drop_is_free(self) -> bool:
        """Whether the drop of the rear is fitted with the level in the next frame."""
        return self.count % DROP_EVERY == DROP_EVERY - 1

    def carried_over(self) -> FromPrevious:
        """Return what `fit.bound_and_measure` takes over."""
        return FromPrevious(self.boundary, self.setup_parts)

    def after_gap(self) -> Prior:
        """Build the prior after a frame that was not measured: only the last surface is kept."""
        past, slopes = self.past[-1:], self.slopes[-1:]
        return replace(self, unseen=self.unseen + 1, past=past, slopes=slopes)

    def with_past_of(self, former: Prior, bench: Bench) -> Prior:
        """Convert the prior to the splines of a former one and adopt its past, if possible."""
        if self.settings != former.settings:
            return self
        x, y = bench.rays.landing_mm[..., 0], bench.rays.landing_mm[..., 1]
        if (self.basis.contains(x, y) != former.basis.contains(x, y)).any():
            return self
        paths = self._in_splines(former, bench)
        if paths is None:
            return self
        return replace(
            self,
            basis=former.basis,
            paths=paths,
            past=np.vstack([former.past[1 - MEMORY :], paths.coefficients]),
            slopes=np.concatenate([former.slopes[1 - MEMORY :], paths.slopes[None]]),
        )

    def _in_splines(self, former: Prior, bench: Bench) -> RayPaths | None:
        """Refit the surface in the splines of a former prior; None if it does not converge."""
        match, basis = self.cold_match, former.basis
        at = tuple(match.ray.T - 1)
        ray = np.ravel_multi_index(at, self.lit.shape)
        points = self.paths.points_mm[ray]
        equations = normal_equations(
            basis, bench.rig, points, match.plane_mm, match.plane_covariance_mm2, self.settings
        )
        fit = Rounds(equations, bench.rays.directions[at], former.past[-1], points)
        try:
            fit.run(MOST_ROUNDS, SETTLED_MM)
        except CannotMeasure:
            return None
        if not fit.moved_mm < UNSETTLED_MM:
            return None
        raised = fit.coefficients + float(np.mean(points[:, 2] - fit.points_mm[:, 2]))
        return RayPaths.of(bench, basis, raised, self.paths.points_mm, NEWTON_STEPS)


def predictions(prior: Prior) -> Iterator[FloatArray]:
    """Yield predicted spline coefficients of the next frame, likeliest first.

    A linear recurrence, estimated from the slopes at lit rays in the previous frames, extrapolates
    a sum of a few oscillations.
    """
    past, order = prior.past, min(ORDER, len(prior.past) // 2)
    if order > 2:
        rays = np.flatnonzero(prior.lit)[::STRIDE]
        ratio, mean = recurrence(prior.slopes, rays, order), past.mean(axis=0)
        yield mean + ratio @ (past[: -order - 1 : -1] - mean)
    if len(past) > 1:
        yield 2 * past[-1] - past[-2]
    yield past[-1]


@compiled(
    types.Array(types.float64, 3, "A", readonly=True),
    types.Array(types.int64, 1, "A", readonly=True),
    types.int64,
)
def recurrence(slopes: FloatArray, rays: IntArray, order: int) -> FloatArray:
    """Coefficients of the linear recurrence over frames, newest frame first, shape (order,).

    They are estimated by ridge regression of the slopes of some rays in M frames, shape (M, R, 2),
    relative to their means.
    """
    gram, right = np.zeros((order, order)), np.zeros(order)
    series = np.empty(len(slopes))
    targets = series[order:]
    for ray in rays:
        for axis in range(2):
            mean = 0.0
            for m in range(len(slopes)):
                series[m] = slopes[m, ray, axis]
                mean += series[m] / len(slopes)
            for m in range(len(slopes)):
                series[m] -= mean
            for k in range(order):
                one, product = series[order - 1 - k :], 0.0
                for m in range(len(targets)):
                    product += one[m] * targets[m]
                right[k] += product
                for other in range(k + 1):
                    two, product = series[order - 1 - other :], 0.0
                    for m in range(len(targets)):
                        product += one[m] * two[m]
                    gram[k, other] += product
    for k in range(order):
        for other in range(k):
            gram[other, k] = gram[k, other]
    penalty = RIDGE * np.trace(gram)
    for k in range(order):
        gram[k, k] += penalty
    return np.linalg.solve(gram, right).astype(np.float64)
