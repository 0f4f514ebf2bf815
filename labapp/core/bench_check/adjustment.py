"""Bundle adjustment of the bench and of the mirrors' poses to the dots that the mirrors made.

The unknowns are standardised: an offset of the bench's quantities is ``factor @ x``, with
``factor @ factor.T`` their prior covariance, and a pose is its expected one plus its standard
uncertainties times x. So the prior of every unknown is a normal distribution of mean 0 and
variance 1, and a quantity that is known exactly has none.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, partial

import numpy as np

from labapp.core.bench_check.mirrors import Mirror, landing_points
from labapp.core.geometry.optics import intersect_level, ray_directions
from labapp.core.geometry.perturbation import OF_PICTURE, moved_dots, moved_rig
from labapp.core.geometry.rig import Rig
from labapp.core.geometry.uncertainty import QUANTITIES
from labapp.core.values import BoolArray, FloatArray, IntArray, ReadOnlyArrays

FLOOR_MM = 0.02
"""Added to the standard uncertainty of every dot on the plane, in squares: what rays depart from
the lens's ideal pattern, and the mirror from its ideal shape."""

ROBUST = 3.0
"""Residuals beyond this many standard uncertainties count less than by their squares (soft L1)."""

STEP = 1e-5
"""Of the forward differences, in usual standard uncertainties."""

ROUNDS, FEW_STEPS, MOST_STEPS = 12, 3, 40
"""Of tightening the robust loss; steps in each of them, and in the last."""

SETTLED = 0.95
"""A scale of the residuals has settled that shrinks by no more than to this share."""

DAMPING, MOST_DAMPED = 1e-4, 1e6
"""Of the steps: at first, and at most."""

CONVERGED = 1e-3
"""A step that the cost falls by less with is the last: unknowns move by 0.03 of their standard
uncertainties."""

PLACES = 9
"""Along X and Y, where a mirror whose place is free may be at first."""

LOST = 50.0
"""Standardised residual of a ray that never meets the plane."""


@dataclass(frozen=True)
class Sighting(ReadOnlyArrays):
    """A mirror, and the n dots that its reflections made.

    Parameters
    ----------
    mirror
        The mirror.
    ray
        Row and column of each dot's ray in the pattern's arrays, counted from 0, shape (n, 2).
    plane_mm, covariance_mm2
        The dots by the set-up before the check, IPCS, shape (n, 2), mm, and their covariance, shape
        (n, 2, 2).
    """

    mirror: Mirror
    ray: IntArray
    plane_mm: FloatArray
    covariance_mm2: FloatArray


@dataclass(frozen=True)
class Adjustment(ReadOnlyArrays):
    """The bench and the poses that explain the dots best.

    Parameters
    ----------
    offset
        By how much the bench's quantities are off, shape (q,).
    covariance
        Of them after the adjustment, shape (q, q).
    poses, pose_covariances
        Of the mirrors, each of shape (d,) and (d, d).
    residual_mm
        Observed minus computed dots of each sighting, shapes (n, 2), mm.
    standardised
        The same over the standard uncertainties, of all sightings, shape (m,).
    weight
        Of each of these by the robust loss, shape (m,).
    scale
        By how much the dots' residuals exceed their standard uncertainties; at least 1.
    unknown
        The standardised unknowns, shape (p,): those of the bench, then those of the poses.
    jacobian
        Derivatives of ``standardised`` by them, shape (m, p).
    cost
        Sum of squares of residuals, robust, and of the unknowns.
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

    def drop(self, columns: FloatArray) -> tuple[float, FloatArray]:
        """By how much the cost would fall, and with what amplitudes, with effects left out so far.

        Parameters
        ----------
        columns
            Derivatives of ``standardised`` by k amplitudes whose prior variance is 1, shape (m, k).

        Returns
        -------
        drop, amplitudes
            In units of a χ² with k degrees of freedom; shape (k,). To first order (score test).
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
    released: FloatArray | None = None,
    start: FloatArray | None = None,
) -> Adjustment:
    """Adjust the bench and the mirrors' poses to the dots.

    Parameters
    ----------
    rig
        The bench before the check; its uncertainty is the prior.
    sightings
        The mirrors and their dots.
    released
        Directions in the space of the bench's quantities that the prior is widened along, by their
        length, shape (k, q).
    start
        Unknowns to begin with, of an adjustment to the same mirrors; None: the expected bench.
    """
    system = System.of(rig, sightings, released)
    unknown = system.start() if start is None or len(start) != system.size else start
    return system.solved_from(unknown)


@dataclass(frozen=True)
class System:
    """The equations of an adjustment: the bench's unknowns, and then those of each pose."""

    rig: Rig
    sightings: tuple[Sighting, ...]
    factor: FloatArray

    @classmethod
    def of(cls, rig: Rig, sightings: Sequence[Sighting], released: FloatArray | None) -> System:
        """The equations with the prior widened, see `adjust`."""
        known = rig.uncertainty
        assert known is not None
        root = known.root if released is None else np.column_stack([known.root, released.T])
        return cls(rig, tuple(sightings), root)

    @cached_property
    def parts(self) -> list[slice]:
        """Of the unknowns: the bench's, and those of each pose."""
        count = [self.factor.shape[1], *(len(s.mirror.sigma) for s in self.sightings)]
        ends = np.cumsum(count).tolist()
        return [slice(end - n, end) for n, end in zip(count, ends, strict=True)]

    @property
    def size(self) -> int:
        """Number of unknowns."""
        return int(self.parts[-1].stop)

    @cached_property
    def roots(self) -> list[FloatArray]:
        """What makes each sighting's residuals standardised, shapes (n, 2, 2)."""
        made = []
        for one in self.sightings:
            covariance = one.covariance_mm2 + FLOOR_MM**2 * np.eye(2)
            made.append(np.linalg.inv(np.linalg.cholesky(covariance)))
        return made

    def start(self) -> FloatArray:
        """The expected bench, each mirror placed where its dots fit best."""
        unknown = np.zeros(self.size)
        for k, one in enumerate(self.sightings):
            tried = [unknown[self.parts[k + 1]], *_places(one, self.rig)]
            costs = [_spread(self.standardised(k, unknown[self.parts[0]], pose)) for pose in tried]
            unknown[self.parts[k + 1]] = tried[int(np.argmin(costs))]
        return unknown

    def pose(self, k: int, unknown: FloatArray) -> FloatArray:
        """Pose of a sighting's mirror, of its unknowns."""
        mirror = self.sightings[k].mirror
        return np.asarray(mirror.pose + mirror.sigma * unknown)

    def observed(self, k: int, offset: FloatArray) -> tuple[FloatArray, FloatArray]:
        """A sighting's dots on the plane with its picture off, and what whitens residuals there.

        The dots' noise is that of the picture: it does not shrink on a plane of another scale.

        Returns
        -------
        plane_mm, whitening
            Shape (n, 2), mm; matrices that make residuals of unit variance, shape (n, 2, 2).
        """
        known, seen = self.rig.uncertainty, self.sightings[k].plane_mm
        assert known is not None
        places = np.concatenate([seen, *(seen + step for step in np.eye(2))])
        moved = moved_dots(places, self.rig, known.axes, offset).reshape(3, -1, 2)
        enlargement = np.stack([moved[1] - moved[0], moved[2] - moved[0]], axis=-1)
        return moved[0], self.roots[k] @ np.linalg.inv(enlargement)

    def computed(self, k: int, offset: FloatArray, pose: FloatArray) -> FloatArray:
        """Where a bench that is off has the dots of a sighting, shape (n, 2), mm."""
        one = self.sightings[k]
        rig = moved_rig(self.rig, offset)
        return landing_points(one.mirror, self.pose(k, pose), rig, tuple(one.ray.T))[0]

    def residual_mm(self, k: int, bench: FloatArray, pose: FloatArray) -> FloatArray:
        """Observed minus computed dots of a sighting, shape (n, 2), mm."""
        offset = self.factor @ bench
        return np.asarray(self.observed(k, offset)[0] - self.computed(k, offset, pose))

    def residuals(self, unknown: FloatArray) -> FloatArray:
        """Standardised residuals of all sightings, shape (m,)."""
        bench, *poses = (unknown[part] for part in self.parts)
        return np.concatenate([self.standardised(k, bench, pose) for k, pose in enumerate(poses)])

    def standardised(self, k: int, bench: FloatArray, pose: FloatArray) -> FloatArray:
        """Residuals of a sighting over their standard uncertainties, shape (2n,)."""
        offset = self.factor @ bench
        return _standardised(*self.observed(k, offset), self.computed(k, offset, pose))

    def jacobian(self, unknown: FloatArray) -> FloatArray:
        """Their derivatives, shape (m, p): a pose moves the dots of its own mirror alone."""
        bench, *poses = (unknown[part] for part in self.parts)
        offset, used = self.factor @ bench, np.asarray(self.factor.any(axis=1))
        made = np.zeros((2 * sum(len(s.ray) for s in self.sightings), self.size))
        for k, (pose, part) in enumerate(zip(poses, self.parts[1:], strict=True)):
            rows, dots = self._rows(k), self.observed(k, offset)
            made[rows, self.parts[0]] = self.by_quantities(k, offset, pose, used) @ self.factor
            computed = partial(self.computed, k, offset)
            still = _standardised(*dots, computed(pose))
            for p, step in zip(range(part.start, part.stop), STEP * np.eye(len(pose)), strict=True):
                made[rows, p] = (_standardised(*dots, computed(pose + step)) - still) / STEP
        return made

    def by_quantities(
        self, k: int, offset: FloatArray, pose: FloatArray, used: BoolArray
    ) -> FloatArray:
        """Derivatives of a sighting's residuals by some quantities, shape (2n, q); 0 by the others.

        Quantities of the picture move the observed dots, all others the computed ones.
        """
        dots, landed = self.observed(k, offset), self.computed(k, offset, pose)
        still = _standardised(*dots, landed)
        made = np.zeros((len(still), len(QUANTITIES)))
        for q in np.flatnonzero(used):
            moved = offset.copy()
            moved[q] += (step := STEP * QUANTITIES[q].assumed)
            if OF_PICTURE[q]:
                changed = _standardised(*self.observed(k, moved), landed)
            else:
                changed = _standardised(*dots, self.computed(k, moved, pose))
            made[:, q] = (changed - still) / step
        return made

    def _rows(self, k: int) -> slice:
        """Of all residuals: those of a sighting."""
        first = 2 * sum(len(s.ray) for s in self.sightings[:k])
        return slice(first, first + 2 * len(self.sightings[k].ray))

    def solved_from(self, unknown: FloatArray) -> Adjustment:
        """The adjustment that unknowns lead to."""
        scale = max(1.0, _spread(self.residuals(unknown)))
        for _ in range(ROUNDS):
            # Gross errors first: the loss tightens as the residuals shrink.
            if scale == 1.0:
                break
            unknown = self.minimised(unknown, scale, FEW_STEPS)
            before, scale = scale, max(1.0, _spread(self.residuals(unknown)))
            if scale > SETTLED * before:
                break
        for _ in range(ROUNDS):
            unknown = self.minimised(unknown, scale, MOST_STEPS)
            before, scale = scale, max(1.0, _spread(self.residuals(unknown)))
            if scale > SETTLED * before:
                break
        return self.adjustment(unknown, scale)

    def solved(self, made: Adjustment) -> Adjustment:
        """The adjustment that another of the same dots leads to, with more quantities free.

        Their costs can be compared: the scale of the residuals stays.
        """
        extra = self.size - len(made.unknown)
        unknown = np.insert(made.unknown, self.parts[0].stop - extra, np.zeros(extra))
        return self.adjustment(self.minimised(unknown, made.scale, MOST_STEPS), made.scale)

    def by_bench(self, made: Adjustment) -> FloatArray:
        """Derivatives of the residuals by all quantities of the bench, shape (m, q)."""
        every = np.ones(len(made.offset), bool)
        unknown = (made.unknown[part] for part in self.parts[1:])
        return np.concatenate(
            [self.by_quantities(k, made.offset, pose, every) for k, pose in enumerate(unknown)]
        )

    def by_dots(self, k: int, change_mm: FloatArray) -> FloatArray:
        """What changes of a sighting's residuals, shape (n, 2, c), mm, are to all, shape (m, c)."""
        made = np.zeros((2 * sum(len(s.ray) for s in self.sightings), change_mm.shape[2]))
        own = np.einsum("nij,njc->nic", self.roots[k], change_mm)
        made[self._rows(k)] = np.where(np.isfinite(own), own, 0.0).reshape(-1, change_mm.shape[2])
        return made

    def minimised(self, unknown: FloatArray, scale: float, steps: int) -> FloatArray:
        """Unknowns of least cost, with the dots' standard uncertainties times a scale.

        By Levenberg and Marquardt's method on the normal equations, which the prior keeps regular.
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
        """The result, with the covariances that follow from the normal equations."""
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
    """Sum of squares of residuals, robust, and of the unknowns."""
    return float(soft_l1(residual**2)[0].sum() + unknown @ unknown)


def soft_l1(square: FloatArray) -> FloatArray:
    """Robust loss of squared residuals and its derivative, shape (2, m)."""
    root = np.sqrt(1 + square / ROBUST**2)
    return np.stack([2 * ROBUST**2 * (root - 1), 1 / root])


def _spread(standardised: FloatArray) -> float:
    """Robust standard deviation of residuals about 0."""
    return float(1.4826 * np.median(np.abs(standardised)))


def _places(sighting: Sighting, rig: Rig) -> list[FloatArray]:
    """Standardised poses of a mirror whose place is free: its top where rays pass, roughly."""
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
