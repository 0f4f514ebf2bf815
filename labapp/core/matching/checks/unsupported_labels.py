"""Labels that a fitted surface does not support, for frames with and without a prior."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from labapp.core.match import missing_share
from labapp.core.matching.observation import UNLABELLED, Observation, amid, neighbours_of, widened
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
from labapp.core.surface.level import KnownRays, Level
from labapp.core.surface.spline import SplineBasis
from labapp.core.values import BoolArray, FloatArray, IntArray

WIDE = 1.45
"""A dot wider than the median of its neighbours by this factor is taken for two merged dots. Of
15,000 dots of rendered frames, 17 were as wide: 13 of them were more than 1 px off, four at most
0.8 px. With a stricter limit, 1.35, known frames lost correct labels at the rim and a tenth of
their accuracy."""

WIDE_BESIDE, BESIDE_RESOLUTIONS = 1.3, 1.5
"""Limit of the width if the predicted dot of a ray without a dot is nearer than the second, in
units of `Observation.resolution_mm`: the dot may be that of both rays, and lie between them."""

MEDIAN_CHI2 = 2 * np.log(2)
"""Median of χ² with two degrees of freedom."""

RIM_NEIGHBOURS, RIM_SIGMA2, RIM_TIMES = 3, 4.0, 20.0
"""For a label with at most `RIM_NEIGHBOURS` labelled neighbours, the squared distance in σ² may be
at most `RIM_SIGMA2`, or `RIM_TIMES` times the median of all, whichever is larger. Of 130 correct
labels of this kind, in pools of every kind, the largest was 2.4 σ²; false dots are at any
distance."""

LONE_ODDS = np.array([3e-4, 3e-4, 5e-3, 0.02, 1.0])
"""Odds that a ray at the rim is lit if no ray beside it in its row, or in its column, has a dot: by
the number of its eight neighbours that have one, 4 for more. They are a third of those of 280 pools
of every kind on different benches, of whose dots 2.5 % were missing: a wrong label there costs more
than the loss of a right one, as it alone extends the surface."""

STEADY_TIMES = 3.0
"""The odds of a ray that was lit in the previous frame are multiplied by this; `LONE_ODDS` of one
that was dark are divided by it."""

MOST_LEVERAGE = 0.998
"""Upper limit of the leverage when the residual of a dot to a fit without it is computed."""

MOST_LEFT_OUT = 4
"""Maximum number of rounds in which labels are removed and the surface is refitted."""

LEVER = 10.0
"""Displacement of a dot per displacement of its reflection point: twice the distance to the plane,
about 55 mm, times the curvature of the surface, about 0.1 mm⁻¹."""


@dataclass(frozen=True)
class FittedLabels:
    """Labels, the surface fitted to them, and the paths of all R rays.

    Parameters
    ----------
    labels
        Index of each ray's dot or `UNLABELLED`, shape (rows, columns).
    basis, level
        Splines and level of the surface.
    paths
        Paths of all rays for this surface.
    covariance_mm2
        Covariance of the dots of labelled and missed rays due to that of the surface, shape
        (R, 2, 2), mm²; entries of other rays are ignored.
    classes
        The rays, classified with this surface.
    floor_mm
        Lower limit of the uncertainty of a dot in the fit (`FitSettings`), mm.
    unsettled_mm
        Largest displacement of a reflection point in the last round of the fit, mm.
    was_lit
        Rays that had a dot in the previous frame, shape (rows, columns); None without a prior.
    """

    labels: IntArray
    basis: SplineBasis
    level: Level
    paths: RayPaths
    covariance_mm2: FloatArray
    classes: RayClasses
    floor_mm: float
    unsettled_mm: float
    was_lit: BoolArray | None = None


def unsupported(observed: Observation, fitted: FittedLabels) -> IntArray:
    """Return the labelled dots that are not explained by their ray.

    Each label is compared with the surface fitted to all the others. It is kept if it is likelier
    by `RIVAL_MARGIN` than each of these explanations:

    * the dot is false;
    * its ray made another dot, which has no ray;
    * another ray between the others, which has no dot, made it.

    A ray that lands outside the boundary of the others is unlikely to be reflected; so is one at
    the rim with no dot beside it in its row, or in its column (`LONE_ODDS`). A dot much wider than
    those around it is two merged dots; a less wide one counts as merged if a ray without a dot is
    predicted beside it. With few neighbours, at the rim, a label must be nearer to its prediction
    than elsewhere. One without neighbours may be that of the next ray, since nothing determines its
    place in the row; nor is one kept beside rays and dots that have none (`_beside_free_dots`). If
    all labels are farther from their predictions than the uncertainty of dots and surface explains,
    that uncertainty is increased accordingly.

    A false dot shifts the predictions of its neighbours. Of adjacent labels that fail, only the one
    with the largest distance in σ is returned, as the others may pass after its removal.

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
    false_per_mm2 = max(FALSE_DOTS_PER_MM2, (len(stray) + 1) / observed.frame_area_mm2)
    limits = np.array(
        [
            fitted.floor_mm**2,  # floor
            LEVER * fitted.unsettled_mm,  # unsettled
            MOST_LEVERAGE,  # leverage
            SIGMA_INFLATION**2,  # inflation
            MODEL_ERROR_MM**2,  # error
            MEDIAN_CHI2,  # median
            false_dot_deviance(false_per_mm2),  # false
            GATE_SIGMA2,  # gate
            RIVAL_MARGIN,  # margin
            RIM_NEIGHBOURS,  # rim_neighbours
            RIM_SIGMA2,  # rim_sigma2
            RIM_TIMES,  # rim_times
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
    return np.asarray(labels[fails | _wide(observed, fitted) | _beside_free_dots(observed, labels)])


def _wide(observed: Observation, fitted: FittedLabels) -> BoolArray:
    """Mask of labels whose dots may be two merged dots because of their width, (rows, columns)."""
    from labapp.core.matching import match_kernels

    lit, plane_mm = fitted.labels != UNLABELLED, fitted.paths.plane_mm
    size = np.full(lit.shape, np.nan)
    size[lit] = observed.size_mm[fitted.labels[lit]]
    times = size / match_kernels.medians_around(size)
    wide = times > WIDE
    for ray in np.flatnonzero(~wide & (times > WIDE_BESIDE)):
        dark_mm = plane_mm[~(lit | observed.without_dot).ravel()]
        apart_mm = np.linalg.norm(dark_mm - plane_mm[ray], axis=-1)
        wide.flat[ray] = (apart_mm < BESIDE_RESOLUTIONS * observed.resolution_mm).any()
    return wide


def _beside_free_dots(observed: Observation, labels: IntArray) -> BoolArray:
    """Mask of labels that may be those of adjacent rays without a dot, shape (rows, columns).

    Where rows cross in a dip their dots get no ray, and the surface bends towards a wrong one
    beside them. Such a label has at least two adjacent rays without a dot, and two dots without a
    ray are nearer to it than any other labelled dot.
    """
    from labapp.core.images import band_pass_kernels

    lit = labels != UNLABELLED
    dark = np.pad(amid(lit) & ~(lit | observed.without_dot), 1).astype(np.int64)
    adjacent = dark[:-2, 1:-1] + dark[2:, 1:-1] + dark[1:-1, :-2] + dark[1:-1, 2:]
    beside: BoolArray = lit & (adjacent > 1)
    if beside.any():
        free = np.setdiff1d(np.arange(len(observed.plane_mm)), labels)
        dots = observed.plane_mm[labels[beside]]
        to_free = band_pass_kernels.two_nearest(dots, observed.plane_mm[free])[0][:, 1]
        to_lit = band_pass_kernels.two_nearest(dots, observed.plane_mm[labels[lit]])[0][:, 1]
        beside[beside] = to_free < to_lit
    return beside


def _rim_odds(observed: Observation, fitted: FittedLabels, at: IntArray) -> FloatArray:
    """Odds that labelled rays at the rim are lit, shape (n,); ``at`` is their place, shape (n, 2).

    They are 1 or `LONE_ODDS`, times `STEADY_TIMES`. Neighbours count as lit if they are between lit
    rays or were lit in the previous frame, as their dots may be missing, or if a dot without a ray
    is near theirs.
    """
    lit, was_lit = fitted.labels != UNLABELLED, fitted.was_lit
    beside = lit if was_lit is None else lit | was_lit
    odds, lone = np.ones(len(at)), np.flatnonzero(_without_row_or_column(beside)[tuple(at.T)])
    if len(lone):
        beside = beside | _near_free_dots(observed, fitted)
    for k in lone:
        others = beside.copy()
        others[tuple(at[k])] = False
        others = amid(others)
        if _without_row_or_column(others)[tuple(at[k])]:
            odds[k] = LONE_ODDS[min(neighbours_of(others)[tuple(at[k])], 4)]
    if was_lit is not None:
        was_dark = ~was_lit[tuple(at.T)]
        odds[~was_dark] *= STEADY_TIMES
        odds[was_dark & (odds < 1.0)] /= STEADY_TIMES
    return odds


def _without_row_or_column(lit: BoolArray) -> BoolArray:
    """Mask of rays with no lit one beside them in their row, or none in their column."""
    wider = np.pad(lit, 1)
    in_row, in_column = wider[1:-1, :-2] | wider[1:-1, 2:], wider[:-2, 1:-1] | wider[2:, 1:-1]
    return ~(in_row & in_column)


def _near_free_dots(observed: Observation, fitted: FittedLabels) -> BoolArray:
    """Mask of rays next to labelled ones whose prediction is near a dot without a ray."""
    from labapp.core.images import band_pass_kernels

    near = widened(fitted.labels != UNLABELLED, 1)
    rays = np.flatnonzero(near.ravel() & np.isfinite(fitted.paths.plane_mm[:, 0]))
    free = np.setdiff1d(np.arange(len(observed.plane_mm)), fitted.labels)
    plane_mm = fitted.paths.plane_mm[rays]
    to_free = band_pass_kernels.two_nearest(plane_mm, observed.plane_mm[free])[0][:, 0]
    near[:] = False
    near.flat[rays[to_free < band_pass_kernels.next_apart(plane_mm) / 2]] = True
    return near


def _inside(observed: Observation, fitted: FittedLabels, missing: float) -> FloatArray:
    """Probability that each of the n labelled rays landed inside the boundary, shape (n,).

    It is 1 for rays between other lit rays. For the others the odds are those of `_rim_odds`. If
    such a ray seems to land outside, they are lower by those of the model of
    `level_kernels.find_level`, marginalised over the levels and blurs that the other rays allow.
    """
    from labapp.core.matching import match_kernels
    from labapp.core.surface.kernels import spline_kernels

    lit, known, level = fitted.labels != UNLABELLED, fitted.classes, fitted.level
    inside = np.ones(lit.shape)
    at = np.argwhere(lit & ~match_kernels.between(lit))
    landing, coefficients = observed.rays.landing_mm[tuple(at.T)], fitted.paths.coefficients
    height, *slope = spline_kernels.surface_at(fitted.basis.grid, coefficients, landing)
    laser_mm = observed.rig.laser.position_mm
    outside = level.height_inside(height, np.stack(slope, axis=-1), landing, laser_mm) < 0.0
    odds = _rim_odds(observed, fitted, at)
    for k in np.flatnonzero(outside):
        nats = []
        for sign in (1, -1):
            ray_states = known.ray_states.copy()
            ray_states[tuple(at[k])] = sign
            known_rays = KnownRays.of(observed.rig, ray_states, fitted.basis, missing)
            nats.append(known_rays.negative_log_evidence(fitted.basis, coefficients, level))
        odds[k] *= np.exp(min(nats[1] - nats[0], 0.0))
    inside[tuple(at.T)] = odds / (1 + odds)
    return np.asarray(inside[lit])
