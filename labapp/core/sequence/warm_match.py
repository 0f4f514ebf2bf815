"""Which ray made which dot, where the surface of the frame before tells where dots should be.

Contract of `correspondence`: a dot that is not sure of its ray gets none.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from labapp.core.images import dot_kernels
from labapp.core.matching import match_kernels
from labapp.core.matching.hypothesis import BEYOND_SPACINGS, FEW_BEYOND
from labapp.core.matching.observation import UNLABELLED, Observation, amid
from labapp.core.matching.prediction import (
    GATE_SIGMA2,
    MODEL_ERROR_MM,
    RIVAL_MARGIN,
    SIGMA_INFLATION,
    covariance_of_dots,
    lines_out_of_view,
)
from labapp.core.sequence.warm_fit import SequenceGeometry, WarmPool, evaluate_at_landing_points
from labapp.core.surface import kernels
from labapp.core.surface.level import Level
from labapp.core.values import BoolArray, FloatArray, IntArray, median

GATE, CLEARLY = 0.35, 2.0
"""A dot is a tracked ray's within this share of the way to the next predicted dot, if no other dot
is, and no other ray within so many times its distance."""

RIVALS = 3
"""So many of the nearest rays contend for a dot, and so many other dots for a ray: the next ones
are farther off by a row or a column."""

ASTRAY = 0.25
"""A dot that far from its fitted place, in shares of the way to the next, is not its ray's."""


_RING = np.ones((3, 3), np.uint8)


def apart_mm(one: FloatArray, other: FloatArray) -> FloatArray:
    """Distances, shape (len(one), len(other))."""
    x, y = one[:, 0, None] - other[:, 0], one[:, 1, None] - other[:, 1]
    return np.asarray(np.sqrt(x * x + y * y))


def next_of(plane_mm: FloatArray, ray: IntArray) -> FloatArray:
    """Distance of some rays' dots from the next of them; infinite for other rays, shape (R,)."""
    distance = np.full(len(plane_mm), np.inf)
    distance[ray] = dot_kernels.next_apart(plane_mm[ray])
    return distance


def around(geometry: SequenceGeometry, lit: BoolArray, rings: int) -> BoolArray:
    """Rays in a mask, shape (R,), and their neighbours, so many rings of them."""
    wide = cv2.dilate(on_pattern(geometry, lit), _RING, iterations=rings)
    return _of_rays(geometry, np.asarray(wide, np.uint8).view(bool))


def on_pattern(geometry: SequenceGeometry, lit: BoolArray) -> npt.NDArray[np.uint8]:
    """A mask of rays, shape (R,), over the whole pattern, shape (rows, columns)."""
    pattern = geometry.rig.pattern
    grid = np.zeros(pattern.rows * pattern.columns, np.uint8)
    grid[geometry.flat] = lit
    return grid.reshape(pattern.rows, pattern.columns)


def _of_rays(geometry: SequenceGeometry, mask: BoolArray) -> BoolArray:
    """What a mask over the pattern says of the rays, shape (R,)."""
    return mask.ravel()[geometry.flat]


def filled(geometry: SequenceGeometry, lit: BoolArray) -> BoolArray:
    """Lit rays and those amid them, whose dots may have been missed: a surface is sure of both."""
    among = _of_rays(geometry, amid(on_pattern(geometry, lit).view(bool)))
    return np.asarray((lit | among) & ~geometry.absent)


def unlabelled(count: int, labels: IntArray) -> IntArray:
    """Dots of so many that no ray has."""
    free = np.ones(count, bool)
    free[labels[labels != UNLABELLED]] = False
    return np.flatnonzero(free)


def tracked(
    observed: Observation, pool: WarmPool, lit: BoolArray, looked_for: BoolArray
) -> tuple[IntArray, FloatArray]:
    """Dots of the rays that were lit before, each by the one prediction that is near.

    Parameters
    ----------
    observed, pool
        The frame's dots, and the surface that predicts them.
    lit, looked_for
        Rays that may have dots, and those and their rivals, shape (R,).

    Returns
    -------
    labels, off
        Index of each ray's dot or `UNLABELLED`, shape (R,); how far those found are from where
        they were predicted, in shares of the way to the next predicted dot, shape (found,).
    """
    labels = np.full(len(lit), UNLABELLED, np.int64)
    near = np.flatnonzero(looked_for & np.isfinite(pool.plane_mm[:, 0]))
    if len(near) < 2 or len(observed.plane_mm) < 2:
        return labels, np.empty(0)
    plane = pool.plane_mm[near]
    step = dot_kernels.next_apart(plane)
    off, ray = dot_kernels.two_nearest(observed.plane_mm, plane)
    other, dot = dot_kernels.two_nearest(plane, observed.plane_mm)
    own, off_own = ray[:, 0], off[:, 0]
    gate = GATE * step[own]
    sure = (off_own < gate) & (step[own] > observed.resolution_mm) & lit[near[own]]
    sure &= (dot[own, 0] == np.arange(len(own))) & (off[:, 1] > CLEARLY * off_own)
    sure &= other[own, 1] > gate  # speckle may split a dot in two
    labels[near[own[sure]]] = np.flatnonzero(sure)
    return labels, off_own[sure] / step[own[sure]]


def widened(
    geometry: SequenceGeometry,
    observed: Observation,
    pool: WarmPool,
    lower: FloatArray,
    labels: IntArray,
) -> IntArray:
    """Labels that the fitted surface bears out, and new ones beside them that it makes sure of.

    A new label stands where it is likelier by far than any other ray for the dot, and any other
    dot for the ray (`label_growth`), with what the prediction is uncertain by.
    """
    lit = labels != UNLABELLED
    looked_for = np.flatnonzero(around(geometry, lit, 2) & np.isfinite(pool.plane_mm[:, 0]))
    next_mm = next_of(pool.plane_mm, looked_for)
    rays = np.flatnonzero(lit)
    off = np.linalg.norm(pool.plane_mm[rays] - observed.plane_mm[labels[rays]], axis=-1)
    astray = off > np.maximum(6.0 * median(off), ASTRAY * next_mm[rays])
    labels = labels.copy()
    labels[rays[astray]] = UNLABELLED
    free = unlabelled(len(observed.plane_mm), labels)
    if len(free) == 0:
        return labels
    beside = np.flatnonzero(around(geometry, lit, 1) & ~lit & ~geometry.absent)
    if len(beside) == 0:
        return labels
    apart = apart_mm(pool.plane_mm[looked_for], observed.plane_mm[free])
    near = looked_for[np.unique(np.argsort(apart, axis=0)[:RIVALS])]
    apart = apart_mm(pool.plane_mm[near], observed.plane_mm)
    dots = np.union1d(free, np.argsort(apart, axis=1)[:, : RIVALS + 1])
    distance, cost = _deviance(geometry, observed, pool, lower, near, dots)
    for dot in np.searchsorted(dots, free).tolist():
        best = int(np.argmin(cost[:, dot]))
        ray = int(near[best])
        rivals = np.delete(cost[:, dot], best), np.delete(cost[best], dot)
        clear = all(len(r) == 0 or r.min() > cost[best, dot] + RIVAL_MARGIN for r in rivals)
        known = ray in beside and next_mm[ray] > observed.resolution_mm
        if clear and known and distance[best, dot] < GATE_SIGMA2:
            labels[ray] = dots[dot]
    return labels


def _deviance(
    geometry: SequenceGeometry,
    observed: Observation,
    pool: WarmPool,
    lower: FloatArray,
    ray: IntArray,
    dot: IntArray,
) -> tuple[FloatArray, FloatArray]:
    """What `match_kernels.pair_deviances` says of rays making dots, shapes (rays, dots)."""
    spread = _covariance_of(geometry, pool, lower, ray)
    made = match_kernels.pair_deviances(
        observed.plane_mm[dot],
        observed.covariance_mm2[dot],
        pool.plane_mm[ray],
        SIGMA_INFLATION**2 * spread + MODEL_ERROR_MM**2 * np.eye(2),
    )
    return made[0].T, made[1].T


def _covariance_of(
    geometry: SequenceGeometry, pool: WarmPool, lower: FloatArray, ray: IntArray
) -> FloatArray:
    """Covariance of some rays' dots, as far as the surface is uncertain, shape (n, 2, 2), mm²."""
    at = pool.points_mm[ray], pool.plane_mm[ray]
    return covariance_of_dots(geometry.rig, geometry.basis, lower, *at)


def covariance_around(
    geometry: SequenceGeometry, pool: WarmPool, lower: FloatArray, labels: IntArray
) -> FloatArray:
    """Covariance of the dots of lit rays and those beside them, NaN of others, (R, 2, 2), mm²."""
    where = around(geometry, labels != UNLABELLED, 1) & np.isfinite(pool.plane_mm[:, 0])
    ray, made = np.flatnonzero(where), np.full((len(labels), 2, 2), np.nan)
    made[ray] = _covariance_of(geometry, pool, lower, ray)
    return made


@dataclass(frozen=True)
class RayClasses:
    """What the rays say with a surface under them.

    Parameters
    ----------
    witness
        +1 came back, −1 did not, 0 cannot tell, shape (R,) (see `Match.witness`).
    stray, missed
        Dots without a ray; rays amid the others without a dot.
    """

    witness: IntArray
    stray: int
    missed: int


def classify_rays(
    geometry: SequenceGeometry,
    observed: Observation,
    pool: WarmPool,
    lower: FloatArray,
    labels: IntArray,
    spread: FloatArray | None = None,
) -> RayClasses:
    """Classify every ray, as `hypothesis` does; ``lower`` is the factor of the pool's fit.

    ``spread`` is what `covariance_around` gives, where that is known.
    """
    if spread is None:
        spread = covariance_around(geometry, pool, lower, labels)
    lit = labels != UNLABELLED
    known = np.isfinite(pool.plane_mm[:, 0])
    next_mm = next_of(pool.plane_mm, np.flatnonzero(known))
    merged = next_mm < observed.resolution_mm
    hidden = kernels.behind_torch(
        pool.points_mm, geometry.rays, pool.slopes, geometry.rig.electrode.height_mm
    )
    seen = known & ~hidden & ~merged
    seen[seen] = observed.in_view(pool.plane_mm[seen])
    among = _of_rays(geometry, amid(on_pattern(geometry, lit).view(bool)))
    missed = int(np.sum(among & ~geometry.absent & ~lit & seen))
    witness = np.where(seen & ~among & ~geometry.absent, -1, 0)
    rim = np.flatnonzero((witness < 0) & around(geometry, lit, 1))
    lost = lines_out_of_view(
        observed,
        geometry.at[rim],
        pool.plane_mm[rim],
        lambda some: spread[rim[some]],
    )
    witness[_of_rays(geometry, lost)] = 0
    witness[lit] = 1
    stray = unlabelled(len(observed.plane_mm), labels)
    if len(stray):
        apart = np.full((len(lit), len(stray)), np.inf)
        apart[known] = apart_mm(pool.plane_mm[known], observed.plane_mm[stray])
        doubt = apart.min(axis=1) < next_mm
        witness[doubt & (witness < 0)] = 0
        run_together = known & merged & among
        if run_together.any():
            stray = stray[apart[run_together].min(axis=0) > observed.resolution_mm]
    return RayClasses(witness, len(stray), missed)


def beyond(
    geometry: SequenceGeometry, pool: WarmPool, level: Level, labels: IntArray, before: BoolArray
) -> IntArray:
    """Lit rays whose dots may be false ones, by where they landed.

    Well beyond the boundary one or two (`hypothesis`); of those not lit ``before``, shape (R,), all
    that are not within it.
    """
    lit = np.flatnonzero(labels != UNLABELLED)
    height, slope = evaluate_at_landing_points(geometry, pool.coefficients)
    over = height[lit] - level.rear.height(geometry.landing_mm[lit, 1])
    rise = np.linalg.norm(slope[lit] * geometry.spacing_mm, axis=-1)
    is_new, inward = ~before[lit], level.sign * over
    far = ~is_new & (inward < -BEYOND_SPACINGS * rise)
    return np.asarray(lit[(is_new & (inward < 0)) | (far & (far.sum() <= FEW_BEYOND))])
