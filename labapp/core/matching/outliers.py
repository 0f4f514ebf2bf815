"""Labels that a fitted surface does not support, whether its frame had a prior or not."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from labapp.core.match import missing_share
from labapp.core.matching.observation import UNLABELLED, Observation
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
from labapp.core.values import BoolArray, FloatArray, IntArray

WIDE = 1.45
"""A dot so many times as wide as the median of those around it is two in one. Of 15,000 dots of
rendered frames 17 were as wide: 13 of them were more than 1 px, four at most 0.8 px, off. Of a
stricter rule, 1.35, known frames lost right labels at the rim and a tenth of their accuracy."""

WIDE_BESIDE, BESIDE_RESOLUTIONS = 1.3, 1.5
"""Where a ray that has no dot would make one nearer than the second, times
`Observation.resolution_mm`, a dot so many times as wide as the first may be both, and lie between.
"""

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
    much wider than those around them are two in one, also less wide ones where a ray
    without a dot would make its own beside them. With few neighbours, at the rim, a label must
    be nearer to its prediction than elsewhere, and one without any may as well be the next ray's:
    nothing beside it fixes its place in the row. Where all are farther off than what is known
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

    labels, classes = fitted.labels, fitted.classes
    lit, stray = labels != UNLABELLED, classes.stray
    share = missing_share(len(classes.missed), int(lit.sum()))
    false_per_mm2 = max(FALSE_DOTS_PER_MM2, (len(stray) + 1) / observed.view_mm2)
    limits = np.array(
        [
            fitted.floor_mm**2,
            LEVER * fitted.unsettled_mm,
            MOST_LEVERAGE,
            SIGMA_INFLATION**2,
            MODEL_ERROR_MM**2,
            MEDIAN_CHI2,
            false_dot_deviance(false_per_mm2),
            GATE_SIGMA2,
            RIVAL_MARGIN,
            RIM_NEIGHBOURS,
            RIM_SIGMA2,
            RIM_TIMES,
        ]
    )
    fails = match_kernels.failing_labels(
        labels,
        (observed.plane_mm, observed.covariance_mm2),
        (fitted.paths.plane_mm, fitted.covariance_mm2),
        (1 - share) * _inside(observed, fitted, share),
        classes.missed,
        stray,
        limits,
    )
    return np.asarray(labels[fails | _wide(observed, fitted) | isolated(lit)])


def isolated(lit: BoolArray) -> BoolArray:
    """Labelled rays without a labelled one beside them, also diagonally, shape (rows, columns)."""
    blocks = np.lib.stride_tricks.sliding_window_view(np.pad(lit, 1), (3, 3))
    return np.asarray(lit & (blocks.sum(axis=(2, 3)) == 1))


def _wide(observed: Observation, fitted: FittedLabels) -> BoolArray:
    """Labels whose dots may be two in one, for their width, shape (rows, columns)."""
    from labapp.core.matching import match_kernels

    lit, plane_mm = fitted.labels != UNLABELLED, fitted.paths.plane_mm
    dark_mm = plane_mm[np.flatnonzero(~lit & ~observed.absent)]
    size = np.full(lit.shape, np.nan)
    size[lit] = observed.size_mm[fitted.labels[lit]]
    times = size / match_kernels.medians_around(size)
    wide = times > WIDE
    for ray in np.flatnonzero(~wide & (times > WIDE_BESIDE)):
        apart_mm = np.linalg.norm(dark_mm - plane_mm[ray], axis=-1)
        wide.flat[ray] = (apart_mm < BESIDE_RESOLUTIONS * observed.resolution_mm).any()
    return wide


def _inside(observed: Observation, fitted: FittedLabels, missing: float) -> FloatArray:
    """Probability of each of the n labelled rays to land inside the boundary, shape (n,).

    That of rays between others is 1, that of others at most 1/2: that of `level.find_level`, with
    the level's uncertainty, and as much blur as the rays near the boundary contradict it. Where a
    ray seems to land outside, the level is that which the others give.
    """
    from labapp.core.matching import match_kernels
    from labapp.core.surface.kernels import spline_kernels

    lit, known, level = fitted.labels != UNLABELLED, fitted.classes, fitted.level
    inside = np.ones(lit.shape)
    at = np.argwhere(lit & ~match_kernels.between(lit))
    landing, coefficients = observed.landing_mm[tuple(at.T)], fitted.paths.coefficients
    height = spline_kernels.surface_at(fitted.basis.grid, coefficients, landing)[0]
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
    inside[tuple(at.T)] = odds / (1 + odds)
    return np.asarray(inside[lit])
