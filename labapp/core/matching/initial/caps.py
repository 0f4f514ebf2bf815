"""Initial labels from a global model of the pool: caps whose predicted dots match the dots.

A pool is approximately a cap, and the number of its dots gives its size. Where a dip or ripples
leave no visible rows in the image, the dots outside them are still close to those of a cap of
about the right height and position, which suffices as a start.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import product

import numpy as np

from labapp.core.matching.hypothesis import rough_costs
from labapp.core.matching.label_growth import matched_labels
from labapp.core.matching.observation import QUICK, UNLABELLED, Observation, try_fit
from labapp.core.values import FloatArray, IntArray

_ASPECTS = (0.9, 1.1, 1.35)
"""Ratios of length to width that are tried."""

_HEIGHTS = (0.025, 0.035, 0.045, 0.055, 0.07, -0.03, -0.045, -0.06, -0.08, -0.1)
"""Ratios of height to width that are tried; negative for a concave pool."""

_ASIDE, _ALONG = np.linspace(-0.6, 0.6, 5), np.linspace(-1.2, 1.2, 9)
"""Positions of the centre that are tried, X and Y, mm."""

GATE = 0.45
"""A dot matches a ray within this fraction of the distance to the nearest other prediction."""

LEAST_RAYS = 10
"""Minimum number of rays that meet a cap."""

LIT_ABSENT_PENALTY, DARK_PENALTY = 5.0, 0.5
"""Penalty for dots at absent rays, times the share of these that have one, and for a ray without a
dot. Each ray with a dot adds about 1 to the score."""

LIT_GATE = 0.3
"""An absent ray counts as lit if a dot lies within this fraction of the median spacing of
predictions."""

ALIKE, MOST_CAPS = 0.9, 150
"""Two caps are the same hypothesis if this share of the rays with a dot in both have the same dot;
and the number of caps that are examined further. A cap with 29 of 30 rays correct may match fewer
dots than one with 21 of 33: the smoothness of the surface through their dots distinguishes them."""

FIRST_CAPS, FIRST_YIELDED = 40, 8
"""Caps with the smallest residuals that are examined before the others, and number of their labels
that `search_caps` yields first. In 5 frames that only caps explained, the ones that led to a
surface had the 8 smallest residuals, and were among the 6 best of all."""

MOST_YIELDED = 24
"""Number of the best labels of all caps: growing labels takes most of the time."""


def search_caps(observed: Observation) -> Iterator[IntArray]:
    """Find the caps whose predicted dots match the observed dots best.

    The best `MOST_CAPS` are sorted by the cost of a surface fitted to their dots. As the first ones
    usually suffice, those of the `FIRST_CAPS` likeliest are yielded before all caps are sorted.

    Parameters
    ----------
    observed
        The dots and the rig.

    Yields
    ------
    IntArray
        Index of the dot of each ray or `UNLABELLED`, shape (rows, columns), all different.
    """
    from labapp.core.matching.initial import quadric_kernels

    settings = np.array([LEAST_RAYS, GATE, DARK_PENALTY, LIT_GATE, LIT_ABSENT_PENALTY])
    score, found = quadric_kernels.score_caps(
        _caps(observed),
        observed.rays.directions.reshape(-1, 3),
        observed.rig.laser.position_mm,
        observed.rig.imaging_plane.pose_mm,
        observed.plane_mm,
        observed.rays.absent.ravel(),
        settings,
    )
    best = np.full((MOST_CAPS, found.shape[1]), UNLABELLED, np.int64)
    count = 0
    for k in np.argsort(-score, kind="stable"):
        both = (best[:count] != UNLABELLED) & (found[k] != UNLABELLED)
        same = np.sum(both & (best[:count] == found[k]), axis=1)
        if np.isfinite(score[k]) and (same <= ALIKE * both.sum(axis=1)).all():
            best[count], count = found[k], count + 1
            if count == MOST_CAPS:
                break
    labelled = best[:count].reshape(count, *observed.rays.absent.shape)
    misfit_mm = observed.quick_misfits(list(labelled))
    misfit_mm /= np.sqrt(np.count_nonzero(labelled != UNLABELLED, axis=(1, 2)))
    likely = labelled[np.argsort(misfit_mm, kind="stable")]
    matched: list[tuple[float, IntArray]] = []
    known: set[bytes] = set()
    for part, most in ((likely[:FIRST_CAPS], FIRST_YIELDED), (likely[FIRST_CAPS:], MOST_YIELDED)):
        each = (_matched(observed, labels) for labels in part)
        matched = sorted([*matched, *filter(None, each)], key=lambda one: one[0])
        ranked = {labels.tobytes(): labels for _, labels in matched}
        for key, labels in list(ranked.items())[:most]:
            if key not in known:
                known.add(key)
                yield labels


def _matched(observed: Observation, labels: IntArray) -> tuple[float, IntArray] | None:
    """Cost and labels after one prediction from the fit to those of a cap, and a second fit."""
    pool = try_fit(observed, labels, QUICK)
    if pool is None:
        return None
    labels = matched_labels(observed, pool, labels)
    fitted = try_fit(observed, labels, QUICK, pool)
    return None if fitted is None else (rough_costs(observed, labels, fitted)[1], labels)


def _caps(observed: Observation) -> FloatArray:
    """Caps to try, with the area given by the number of dots (`quadric_kernels.score_caps`)."""
    area = len(observed.plane_mm) * observed.rays.spacing_mm.prod()
    caps = []
    for aspect, height, x, y in product(_ASPECTS, _HEIGHTS, _ASIDE, _ALONG):
        across, along = np.sqrt(area / np.pi * np.array([1 / aspect, aspect]))
        caps.append((x, y, across, along, 2 * height * across))
    return np.array(caps)
