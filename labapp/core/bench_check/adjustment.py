"""Bundle adjustment of the bench and of the mirrors' poses to the reflected dots.

The unknowns are standardised: the offset of the bench's quantities is ``factor @ x``, with
``factor @ factor.T`` their prior covariance, and a pose is the expected pose plus its standard
uncertainties times x. The prior of every unknown is therefore the standard normal distribution. A
quantity that is known exactly has no unknown.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial

import numpy as np

from labapp.core.bench_check.mirrors import Mirror, landing_points, reflected_rays
from labapp.core.geometry.optics import (
    intersect_imaging_plane,
    intersect_level,
    ray_directions,
)
from labapp.core.geometry.perturbation import (
    OF_PICTURE,
    OF_PLANE,
    dots_in_picture,
    dots_on_moved_plane,
    moved_plane,
    moved_rig,
)
from labapp.core.geometry.rig import Rig
from labapp.core.geometry.uncertainty import QUANTITIES
from labapp.core.values import BoolArray, FloatArray, IntArray, ReadOnlyArrays, robust_sigma

FLOOR_MM = 0.02
"""Added in quadrature to the standard uncertainty of every dot on the plane: deviations of the rays
from the lens's ideal pattern, and of the mirror from its ideal shape."""

ROBUST = 3.0
"""Residuals beyond this many standard uncertainties are down-weighted (soft L1)."""

STEP = 1e-5
"""Step of the forward differences, in usual standard uncertainties."""

ROUNDS, FEW_ITERATIONS, MOST_ITERATIONS = 12, 3, 40
"""Iterations that tighten the robust loss; steps in each of them, and in the last."""

SETTLED = 0.95
"""The scale of the residuals has converged if it shrinks to no less than this share."""

DAMPING, MOST_DAMPED = 1e-4, 1e6
"""Initial and largest damping of the steps."""

CONVERGED = 1e-3
"""The iteration stops if a step lowers the cost by less: unknowns move by 0.03 of their standard
uncertainties."""

PLACES = 9
"""Number of initial positions along X and Y of a mirror whose position is free."""

LOST = 50.0
"""Standardised residual of a ray that never meets the plane."""


@dataclass(frozen=True)
class Sighting(ReadOnlyArrays):
    """A mirror and the n dots of the rays that it reflected.

    Parameters
    ----------
    ray
        Row and column of each dot's ray in the pattern's arrays, counted from 0, shape (n, 2).
    plane_mm, covariance_mm2
        The dots by the set-up before the check, IPCS, shape (n, 2), mm, and their covariance, shape
        (n, 2, 2), mm².
    """

    mirror: Mirror
    ray: IntArray
    plane_mm: FloatArray
    covariance_mm2: FloatArray


@dataclass(frozen=True)
class Adjustment(ReadOnlyArrays):
    """The bench and the poses that fit the dots best.

    Parameters
    ----------
    offset
        Estimated offsets of the bench's quantities, shape (q,).
    covariance
        Their covariance after the adjustment, shape (q, q).
    poses, pose_covariances
        Poses of the mirrors and their covariances, each of shape (d,) and (d, d).
    residual_mm
        Observed minus computed dots of each sighting, shapes (n, 2), mm.
    standardised
        Residuals of all sightings over their standard uncertainties, shape (m,).
    weight
        Weight of each of these by the robust loss, shape (m,).
    scale
        Ratio of the scatter of the residuals to their standard uncertainties; at least 1.
    unknown
        The standardised unknowns, shape (p,): those of the bench, then those of the poses.
    jacobian
        Derivatives of ``standardised`` w.r.t. the unknowns, shape (m, p).
    cost
        Robust sum of squares of the residuals, plus the sum of squares of the unknowns.
    """

    offset: FloatArray
    covariance: FloatArray
    poses: tuple[FloatArray, ...]
    pose_covariances: tuple[FloatArray, ...]
    residual_mm: tuple[FloatArray, ...]
    standardised: FloatArray
    weight: FloatArray
    scale: float
    unknown: FloatArray
    jacobian: FloatArray
    cost: float

    def cost_fall(self, columns: FloatArray) -> tuple[float, FloatArray]:
        """Reduction of the cost if further effects are added to the model, to first order.

        Parameters
        ----------
        columns
            Derivatives of ``standardised`` w.r.t. k amplitudes with prior variance 1, shape (m, k).

        Returns
        -------
        cost_fall, amplitudes
            Reduction as a χ² with k degrees of freedom (score test); amplitudes, shape (k,).
        """
        weighted = self.weight[:, None] * columns / self.scale**2
        across = self.jacobian.T @ weighted
        normal = np.eye(len(self.unknown))
        normal += self.jacobian.T @ (self.weight[:, None] * self.jacobian) / self.scale**2
        reduced = columns.T @ weighted + np.eye(columns.shape[1])
        reduced -= across.T @ np.linalg.solve(normal, across)
        slope = weighted.T @ self.standardised
        amplitudes = -np.linalg.solve(reduced, slope)
        return float(-slope @ amplitudes), np.asarray(amplitudes, np.float64)


def adjust(
    rig: Rig,
    sightings: Sequence[Sighting],
    freed: FloatArray | None = None,
    start: FloatArray | None = None,
) -> Adjustment:
    """Adjust the bench and the mirrors' poses to the dots.

    Parameters
    ----------
    rig
        The bench before the check; its uncertainty is the prior.
    freed
        Directions in the space of the bench's quantities along which the prior is widened by their
        length, shape (k, q).
    start
        Initial unknowns, from an adjustment to the same mirrors; None: the expected bench.
    """
    system = System.of(rig, sightings, freed)
    unknown = system.start() if start is None or len(start) != system.size else start
    return system.solve_from(unknown)


@dataclass(frozen=True)
class System:
    """Equations of an adjustment; the unknowns of the bench precede those of each pose."""

    rig: Rig
    sightings: tuple[Sighting, ...]
    factor: FloatArray

    @classmethod
    def of(cls, rig: Rig, sightings: Sequence[Sighting], freed: FloatArray | None) -> System:
        """Set up the equations with the prior widened, see `adjust`."""
        known = rig.uncertainty
        assert known is not None
        root = known.root if freed is None else np.column_stack([known.root, freed.T])
        return cls(rig, tuple(sightings), root)

    def with_free(self, direction: FloatArray) -> System:
        """Return the equations with another direction freed, shape (q,), see `adjust`."""
        return replace(self, factor=np.column_stack([self.factor, direction]))

    def with_mirror(self, k: int, mirror: Mirror) -> System:
        """Return the equations with another mirror in a sighting."""
        sightings = list(self.sightings)
        sightings[k] = replace(sightings[k], mirror=mirror)
        return replace(self, sightings=tuple(sightings))

    @cached_property
    def parts(self) -> list[slice]:
        """Slices of the unknowns: of the bench, then of each pose."""
        count = [self.factor.shape[1], *(len(s.mirror.sigma) for s in self.sightings)]
        ends = np.cumsum(count).tolist()
        return [slice(end - n, end) for n, end in zip(count, ends, strict=True)]

    @property
    def size(self) -> int:
        """Number of unknowns."""
        return int(self.parts[-1].stop)

    @cached_property
    def roots(self) -> list[FloatArray]:
        """Whitening matrices of each sighting's residuals, shapes (n, 2, 2)."""
        made = []
        for one in self.sightings:
            covariance = one.covariance_mm2 + FLOOR_MM**2 * np.eye(2)
            made.append(np.linalg.inv(np.linalg.cholesky(covariance)))
        return made

    @cached_property
    def in_picture(self) -> list[FloatArray]:
        """`dots_in_picture` of each sighting, and of the points 1 mm along X′ and Z′, (3n, 2)."""
        known = self.rig.uncertainty
        assert known is not None
        return [
            dots_in_picture(
                np.concatenate([one.plane_mm, *(one.plane_mm + step for step in np.eye(2))]),
                self.rig,
                known.axes,
            )
            for one in self.sightings
        ]

    def start(self) -> FloatArray:
        """Initial unknowns: the expected bench, each mirror where its dots fit best."""
        unknown = np.zeros(self.size)
        for k, one in enumerate(self.sightings):
            tried = [unknown[self.parts[k + 1]], *_places(one, self.rig)]
            costs = [
                robust_sigma(self.standardised(k, unknown[self.parts[0]], pose)) for pose in tried
            ]
            unknown[self.parts[k + 1]] = tried[int(np.argmin(costs))]
        return unknown

    def pose(self, k: int, unknown: FloatArray) -> FloatArray:
        """Pose of a sighting's mirror from its unknowns."""
        mirror = self.sightings[k].mirror
        return np.asarray(mirror.pose + mirror.sigma * unknown)

    def observed(self, k: int, offset: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Dots of a sighting on the plane for an offset, and the whitening of their residuals.

        The noise of the dots is constant in the picture, so on the plane it changes with the scale.

        Returns
        -------
        plane_mm, whitening
            Shape (n, 2), mm; matrices that make residuals of unit variance, shape (n, 2, 2).
        """
        if not offset[OF_PICTURE].any():
            return self.sightings[k].plane_mm, self.roots[k]
        known = self.rig.uncertainty
        assert known is not None
        moved = dots_on_moved_plane(self.in_picture[k], self.rig, known.axes, offset)
        at, right, above = moved.reshape(3, -1, 2)
        enlargement = np.stack([right - at, above - at], axis=-1)
        return at, self.roots[k] @ np.linalg.inv(enlargement)

    def computed(self, k: int, rig: Rig, pose: FloatArray) -> FloatArray:
        """Computed dots of a sighting on a moved rig, shape (n, 2), mm."""
        one = self.sightings[k]
        return landing_points(one.mirror, self.pose(k, pose), rig, tuple(one.ray.T))[0]

    def residual_mm(self, k: int, bench: FloatArray, pose: FloatArray) -> FloatArray:
        """Observed minus computed dots of a sighting, shape (n, 2), mm."""
        offset = self.factor @ bench
        computed = self.computed(k, moved_rig(self.rig, offset), pose)
        return np.asarray(self.observed(k, offset)[0] - computed)

    def residuals(self, unknown: FloatArray) -> FloatArray:
        """Standardised residuals of all sightings, shape (m,)."""
        bench, *poses = (unknown[part] for part in self.parts)
        return np.concatenate([self.standardised(k, bench, pose) for k, pose in enumerate(poses)])

    def standardised(self, k: int, bench: FloatArray, pose: FloatArray) -> FloatArray:
        """Residuals of a sighting over their standard uncertainties, shape (2n,)."""
        offset = self.factor @ bench
        computed = self.computed(k, moved_rig(self.rig, offset), pose)
        return _standardised(*self.observed(k, offset), computed)

    def jacobian(self, unknown: FloatArray) -> FloatArray:
        """Derivatives of `residuals`, shape (m, p): a pose affects the dots of its mirror only."""
        bench, *poses = (unknown[part] for part in self.parts)
        offset, used = self.factor @ bench, np.asarray(self.factor.any(axis=1))
        rig = moved_rig(self.rig, offset)
        made = np.zeros((2 * sum(len(s.ray) for s in self.sightings), self.size))
        for k, (pose, part) in enumerate(zip(poses, self.parts[1:], strict=True)):
            rows, (plane_mm, whitening) = self._rows(k), self.observed(k, offset)
            made[rows, self.parts[0]] = self.by_quantities(k, offset, pose, used) @ self.factor
            computed = partial(self.computed, k, rig)
            still = _standardised(plane_mm, whitening, computed(pose))
            for p, step in zip(range(part.start, part.stop), STEP * np.eye(len(pose)), strict=True):
                changed = _standardised(plane_mm, whitening, computed(pose + step))
                made[rows, p] = (changed - still) / STEP
        return made

    def by_quantities(
        self, k: int, offset: FloatArray, pose: FloatArray, used: BoolArray
    ) -> FloatArray:
        """Derivatives of a sighting's residuals w.r.t. the used quantities, shape (2n, q); 0 else.

        Quantities of the picture change the observed dots, all others the computed ones; those of
        the imaging plane do so without a change of the reflected rays.
        """
        plane_mm, whitening = self.observed(k, offset)
        one, at = self.sightings[k], self.pose(k, pose)
        rig = moved_rig(self.rig, offset)
        point, direction, _ = reflected_rays(one.mirror, at, rig, tuple(one.ray.T))
        landed = intersect_imaging_plane(point, direction, rig.imaging_plane)
        still = _standardised(plane_mm, whitening, landed)
        made = np.zeros((len(still), len(QUANTITIES)))
        for q in np.flatnonzero(used):
            moved = offset.copy()
            moved[q] += (step := STEP * QUANTITIES[q].assumed)
            if OF_PICTURE[q]:
                changed = _standardised(*self.observed(k, moved), landed)
            elif OF_PLANE[q]:
                plane = moved_plane(self.rig.imaging_plane, moved)
                changed = _standardised(
                    plane_mm, whitening, intersect_imaging_plane(point, direction, plane)
                )
            else:
                moved_computed = self.computed(k, moved_rig(self.rig, moved), pose)
                changed = _standardised(plane_mm, whitening, moved_computed)
            made[:, q] = (changed - still) / step
        return made

    def _rows(self, k: int) -> slice:
        """Slice of a sighting's residuals."""
        first = 2 * sum(len(s.ray) for s in self.sightings[:k])
        return slice(first, first + 2 * len(self.sightings[k].ray))

    def solve_from(self, unknown: FloatArray) -> Adjustment:
        """Iterate from initial unknowns to the adjustment."""
        scale = max(1.0, robust_sigma(self.residuals(unknown)))
        # A large scale first tolerates gross errors; the loss tightens as residuals shrink.
        for most in (FEW_ITERATIONS, MOST_ITERATIONS):
            for _ in range(ROUNDS):
                if most == FEW_ITERATIONS and scale == 1.0:
                    break
                unknown = self.minimise(unknown, scale, most)
                before, scale = scale, max(1.0, robust_sigma(self.residuals(unknown)))
                if scale > SETTLED * before:
                    break
        return self.adjustment(unknown, scale)

    def refitted_with_more_free(self, made: Adjustment) -> Adjustment:
        """Continue from another adjustment to the same dots, with more quantities free.

        The scale of the residuals is the same, so that the costs are comparable.
        """
        extra = self.size - len(made.unknown)
        unknown = np.insert(made.unknown, self.parts[0].stop - extra, np.zeros(extra))
        return self.refined(unknown, made.scale)

    def refined(
        self, unknown: FloatArray, scale: float, steps: int = MOST_ITERATIONS
    ) -> Adjustment:
        """Iterate from unknowns near the adjustment; the scale of the residuals is known."""
        return self.adjustment(self.minimise(unknown, scale, steps), scale)

    def by_bench(self, made: Adjustment) -> FloatArray:
        """Derivatives of the residuals w.r.t. all quantities of the bench, shape (m, q)."""
        every = np.ones(len(made.offset), bool)
        unknown = (made.unknown[part] for part in self.parts[1:])
        return np.concatenate(
            [self.by_quantities(k, made.offset, pose, every) for k, pose in enumerate(unknown)]
        )

    def by_dots(self, k: int, change_mm: FloatArray) -> FloatArray:
        """Expand changes of a sighting's residuals, (n, 2, c), mm, to all standardised, (m, c)."""
        made = np.zeros((2 * sum(len(s.ray) for s in self.sightings), change_mm.shape[2]))
        own = np.einsum("nij,njc->nic", self.roots[k], change_mm)
        made[self._rows(k)] = np.where(np.isfinite(own), own, 0.0).reshape(-1, change_mm.shape[2])
        return made

    def minimise(self, unknown: FloatArray, scale: float, steps: int) -> FloatArray:
        """Minimise the cost, with the dots' standard uncertainties multiplied by a scale.

        Levenberg–Marquardt on the normal equations, which the prior keeps regular.
        The Hessian of the robust loss ρ is approximated by Jᵀ(ρ′ + 2ρ″r²)J (Triggs et al. 2000,
        Bundle adjustment – a modern synthesis, section 4.3); for soft L1 that is Jᵀρ′³J.
        """
        residual = self.residuals(unknown) / scale
        cost, damping = _cost(residual, unknown), DAMPING
        for _ in range(steps):
            jacobian = self.jacobian(unknown) / scale
            weight = soft_l1(residual**2)[1]
            gradient = jacobian.T @ (weight * residual) + unknown
            normal = jacobian.T @ (weight[:, None] ** 3 * jacobian) + np.eye(self.size)
            while True:
                step = -np.linalg.solve(normal + damping * np.diag(np.diag(normal)), gradient)
                tried = self.residuals(unknown + step) / scale
                fall = cost - _cost(tried, unknown + step)
                if fall > 0 or damping > MOST_DAMPED:
                    break
                damping *= 10
            if fall <= 0:
                break
            unknown, residual, cost, damping = unknown + step, tried, cost - fall, damping / 10
            if fall < CONVERGED:
                break
        return unknown

    def adjustment(self, unknown: FloatArray, scale: float) -> Adjustment:
        """Return the result, with covariances from the normal equations."""
        standardised, jacobian = self.residuals(unknown), self.jacobian(unknown)
        square = (standardised / scale) ** 2
        loss, weight = soft_l1(square)
        normal = np.eye(self.size) + jacobian.T @ (weight[:, None] * jacobian) / scale**2
        spread = np.linalg.inv(normal)
        bench, *poses = self.parts
        posed = [(k, unknown[part], part) for k, part in enumerate(poses)]
        return Adjustment(
            offset=self.factor @ unknown[bench],
            covariance=self.factor @ spread[bench, bench] @ self.factor.T,
            poses=tuple(self.pose(k, x) for k, x, _ in posed),
            pose_covariances=tuple(
                np.outer(s := self.sightings[k].mirror.sigma, s) * spread[part, part]
                for k, _, part in posed
            ),
            residual_mm=tuple(self.residual_mm(k, unknown[bench], x) for k, x, _ in posed),
            standardised=standardised,
            weight=weight,
            scale=scale,
            unknown=unknown,
            jacobian=jacobian,
            cost=float(loss.sum() + unknown @ unknown),
        )


def _standardised(
    plane_mm: FloatArray, whitening: FloatArray, computed_mm: FloatArray
) -> FloatArray:
    """Residuals over their standard uncertainties, shape (2n,)."""
    made = (whitening @ (plane_mm - computed_mm)[..., None])[..., 0]
    return np.where(np.isfinite(made), made, LOST).ravel()


def _cost(residual: FloatArray, unknown: FloatArray) -> float:
    """Robust sum of squares of the residuals, plus the sum of squares of the unknowns."""
    return float(soft_l1(residual**2)[0].sum() + unknown @ unknown)


def soft_l1(square: FloatArray) -> FloatArray:
    """Robust loss of squared residuals and its derivative, shape (2, m)."""
    root = np.sqrt(1 + square / ROBUST**2)
    return np.stack([2 * ROBUST**2 * (root - 1), 1 / root])


def _places(sighting: Sighting, rig: Rig) -> list[FloatArray]:
    """Standardised initial poses of a mirror of free position: a grid where the rays pass."""
    mirror = sighting.mirror
    if "x_mm" not in mirror.parameters:
        return []
    rays = ray_directions(rig.laser, rig.pattern)[tuple(sighting.ray.T)]
    passed = intersect_level(rig.laser.position_mm, rays, mirror.pose[2])[:, :2]
    low, high = passed.min(axis=0) - 1.0, passed.max(axis=0) + 1.0
    grid = np.stack(np.meshgrid(*np.linspace(low, high, PLACES).T), axis=-1).reshape(-1, 2)
    made = np.zeros((len(grid), len(mirror.pose)))
    made[:, :2] = (grid - mirror.pose[:2]) / mirror.sigma[:2]
    return list(made)
