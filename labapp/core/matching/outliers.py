"""Labels that a fitted surface does not support, whether its frame had a prior or not."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from labapp.core.match import missing_share
from labapp.core.matching.observation import UNLABELLED, Observation, neighbours_of
from labapp.core.matching.prediction import (
    FALSE_DOTS_PER_MM2,
    GATE_SIGMA2,
    MODEL_ERROR_MM,
    RIVAL_MARGIN,
    SIGMA_INFLATION,
    RayPaths,
    false_dot_deviance,
)
from labapp.core.matching.ray_classes import RayClasses
from labapp.core.surface.level import Level, Witnesses
from labapp.core.surface.spline import SplineBasis
from labapp.core.values import BoolArray, FloatArray, IntArray, median

WIDE = 1.45
"""A dot so many times as wide as the median of those around it is two in one. Of 15,000 dots of
rendered frames 17 were as wide: 13 of them were more than 1 px, four at most 0.8 px, off."""

MEDIAN_CHI2 = 2 * np.log(2)
"""Median of χ² with two degrees of freedom."""

RIM_NEIGHBOURS, RIM_SIGMA2, RIM_TIMES = 3, 4.0, 20.0
"""A label with at most so many labelled neighbours may be as many σ² off as the second says, or as
the third times the median of all, whichever is more: of 130 such labels that were right, in pools
of every kind, the farthest was 2.4 σ² off, while a false dot lies anywhere near."""

MOST_LEVERAGE = 0.998
"""A dot to which the surface goes wholly is left out as if it went there by this share."""

MOST_LEFT_OUT = 4
"""So often labels are taken away and the surface is fitted again to the others."""

LEVER = 10.0
"""How far a dot moves when its reflection point does: twice the way to the plane, some 55 mm, times
the surface's curvature, some 0.1 a mm."""


@dataclass(frozen=True)
class FittedLabels:
    """Labels, the surface fitted to them, and what it makes of all R rays.

    Parameters
    ----------
    labels
        Index of each ray's dot or `UNLABELLED`, shape (rows, columns).
    basis, level
        Of the surface: its splines, and the level that it lies at.
    paths
        What it makes of all rays.
    covariance_mm2
        Covariance of the dots of labelled rays, as far as the surface is uncertain, and of missed
        rays, shape (R, 2, 2), mm²; those of others do not count.
    classes
        The rays, classified with this surface.
    floor_mm
        Least uncertainty of a dot in the fit (`FitSettings`), mm.
    unsettled_mm
        How far reflection points still moved in the fit's last round, mm.
    """

    labels: IntArray
    basis: SplineBasis
    level: Level
    paths: RayPaths
    covariance_mm2: FloatArray
    classes: RayClasses
    floor_mm: float
    unsettled_mm: float


def unsupported(observed: Observation, fitted: FittedLabels) -> IntArray:
    """Return the labelled dots that their ray alone does not explain.

    Each is held against the surface fitted to all the others: its ray must be likelier by
    `RIVAL_MARGIN` to have made it than a false dot to lie there, than its ray to have made another
    dot that has no ray, and than another ray amid the others, that has no dot, to have made it. A
    ray that lands outside the boundary of the others is unlikely to have come back at all. Dots
    much wider than those around them are two in one. With few neighbours, at the rim, a label must
    be nearer to its prediction than elsewhere. Where all are farther off than what is known
    of dots and surface explains, these are as much more uncertain.

    A false dot takes its neighbours' predictions along: of neighbours that fail only the one that
    is farthest off, in σ, is returned. The others may stand once it is gone.

    Parameters
    ----------
    observed
        The dots.
    fitted
        Labels and surface.

    Returns
    -------
    IntArray
        Indices of dots.
    """
    from labapp.core.matching import match_kernels

    labels, classes, paths = fitted.labels, fitted.classes, fitted.paths
    lit = labels != UNLABELLED
    dots, rays = labels[lit], np.flatnonzero(lit)
    place, error = observed.plane_mm[dots], MODEL_ERROR_MM**2 * np.eye(2)
    seen = observed.covariance_mm2[dots] + fitted.floor_mm**2 * np.eye(2)
    residual, drawn = paths.plane_mm[rays] - place, fitted.covariance_mm2[rays]
    how = LEVER * fitted.unsettled_mm, MOST_LEVERAGE
    off, computed = match_kernels.left_out(residual, seen, drawn, *how)
    spread = SIGMA_INFLATION**2 * computed + error
    distance, deviance = _deviances(off, seen + spread)
    excess = max(1.0, median(distance) / MEDIAN_CHI2)
    distance, deviance = _deviances(off, excess * (seen + spread))

    share = missing_share(len(classes.missed), len(rays))
    shows = (1 - share) * np.where(_between(lit)[lit], 1.0, _inside(observed, fitted, share))
    own = deviance + 2 * np.log(1 - shows) - 2 * np.log(np.maximum(shows, 1e-300))
    false_per_mm2 = max(FALSE_DOTS_PER_MM2, (len(classes.stray) + 1) / observed.view_mm2)
    rim = neighbours_of(lit)[lit] <= RIM_NEIGHBOURS
    rim_gate = min(max(RIM_SIGMA2, RIM_TIMES * median(distance)), GATE_SIGMA2)
    fails = distance > np.where(rim, rim_gate, GATE_SIGMA2)
    fails |= own + RIVAL_MARGIN > false_dot_deviance(false_per_mm2)

    rival = np.full(len(dots), np.inf)
    if len(classes.stray):
        other = observed.plane_mm[classes.stray], excess * observed.covariance_mm2[classes.stray]
        made = match_kernels.pair_deviances(*other, place + off, excess * spread)[1]
        rival = made.min(axis=0)
    if len(classes.missed):
        missed = classes.missed[np.isfinite(fitted.covariance_mm2[classes.missed, 0, 0])]
        around = SIGMA_INFLATION**2 * fitted.covariance_mm2[missed] + error
        made = match_kernels.pair_deviances(
            place, excess * seen, paths.plane_mm[missed], excess * around
        )[1]
        rival = np.minimum(rival, made.min(axis=1, initial=np.inf))
    fails |= deviance + RIVAL_MARGIN > rival

    worst, size = np.zeros(lit.shape), np.full(lit.shape, np.nan)
    worst[lit], size[lit] = np.where(fails, distance, 0.0), observed.size_mm[dots]
    beside = cv2.dilate(worst, np.array([[1, 1, 1], [1, 0, 1], [1, 1, 1]], np.uint8))
    wide = size > WIDE * match_kernels.medians_around(size)
    return np.asarray(labels[lit & (wide | ((worst > 0.0) & (worst >= beside)))])


def _deviances(off: FloatArray, covariance: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Squared lengths of residuals, shape (n, 2), in σ, and deviances, as of `pair_deviances`."""
    (x, y), (xx, xy, yy) = off.T, covariance[:, [0, 0, 1], [0, 1, 1]].T
    area = xx * yy - xy * xy
    distance = (yy * x * x - 2.0 * xy * x * y + xx * y * y) / area
    return distance, distance + np.log(area)


def _between(lit: BoolArray) -> BoolArray:
    """Rays with lit ones on either side of them in their row or in their column."""
    between = np.zeros_like(lit)
    for axis in (0, 1):
        upto = np.cumsum(lit, axis=axis)
        between |= (upto > lit) & (upto < np.sum(lit, axis=axis, keepdims=True))
    return between


def _inside(observed: Observation, fitted: FittedLabels, missing: float) -> FloatArray:
    """Probability of each of the n labelled rays to land inside the boundary, shape (n,), ≤ 1/2.

    It is that of `level.find_level`, with the level's uncertainty, and as much blur as the rays
    near the boundary contradict it. Where a ray seems to land outside, the level is that which the
    others give.
    """
    from labapp.core.surface import kernels

    at, known, level = np.argwhere(fitted.labels != UNLABELLED), fitted.classes, fitted.level
    landing, coefficients = observed.landing_mm[tuple(at.T)], fitted.paths.coefficients
    height = kernels.surface_at(fitted.basis.grid, coefficients, landing)[0]
    outside = level.sign * (height - level.rear.height(landing[:, 1])) < 0.0
    odds = np.ones(len(at))  # the surface may go up there for the dot alone
    for k in np.flatnonzero(outside):
        nats = []
        for sign in (1, -1):
            witness = known.witness.copy()
            witness[tuple(at[k])] = sign
            rays = observed.bench.rays, observed.rig.head_sign, witness, fitted.basis, missing
            nats.append(
                Witnesses.of(*rays).negative_log_evidence(fitted.basis, coefficients, level)
            )
        odds[k] = np.exp(min(nats[1] - nats[0], 0.0))
    return odds / (1 + odds)
