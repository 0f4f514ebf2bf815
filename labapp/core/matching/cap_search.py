"""Hypotheses from the whole pool: caps whose rays fall on the dots.

A pool is nearly a cap, and how many dots it makes says how large it is. Where a dip or ripples
leave no rows on the picture, the dots outside them still lie near to where a cap of about the
right height and place has them: enough to begin with.
"""

from __future__ import annotations

from itertools import product

import numpy as np

from labapp.core.matching.hypothesis import rough_costs
from labapp.core.matching.label_growth import matched_labels
from labapp.core.matching.observation import QUICK, UNLABELLED, Observation, try_fit
from labapp.core.values import FloatArray, IntArray

_ASPECTS = (0.9, 1.1, 1.35)
"""Length over width that are tried."""

_HEIGHTS = (0.025, 0.035, 0.045, 0.055, 0.07, -0.03, -0.045, -0.06, -0.08, -0.1)
"""Height over width; below 0 of a concave pool."""

_ASIDE, _ALONG = np.linspace(-0.6, 0.6, 5), np.linspace(-1.2, 1.2, 9)
"""Where its middle lies, X and Y, mm."""

GATE = 0.45
"""A ray finds its dot within this fraction of the way to the next predicted one."""

LEAST_RAYS = 10
"""Fewer rays than this make no cap."""

LIT_MARKER_PENALTY, DARK_PENALTY = 5.0, 0.5
"""What a dot at the marker's absent ray, and a ray without a dot, take off a score of about 1 for
each ray with a dot."""

LIT_GATE = 0.3
"""The marker is lit by a dot within this fraction of the usual way to the next predicted one."""

ALIKE, MOST_CAPS = 0.9, 150
"""Two caps are one hypothesis where such a share of the rays that find a dot find the same; and so
many are looked at closer. With 29 of 30 rays right, a cap may find fewer dots than one with 21 of
33: what tells them apart is how smooth a surface has their dots."""


def search_caps(observed: Observation, most: int = 24) -> list[IntArray]:
    """Find the caps whose rays fall on the dots best.

    The best of them are sorted by what a surface through their dots explains.

    Parameters
    ----------
    observed
        The dots and the rig.
    most
        How many to return at most, no two the same.

    Returns
    -------
    list of IntArray
        Index of the dot of each ray or `UNLABELLED`, shape (rows, columns); the best first.
    """
    from labapp.core.matching import quadric_kernels

    rig = observed.rig
    bench = (
        rig.laser.position_mm,
        rig.imaging_plane.pose_mm,
        observed.plane_mm,
        observed.absent.ravel(),
    )
    settings = np.array([LEAST_RAYS, GATE, DARK_PENALTY, LIT_GATE, LIT_MARKER_PENALTY])
    score, found = quadric_kernels.score_caps(
        _caps(observed), observed.rays.reshape(-1, 3), *bench, settings
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
    shape = observed.absent.shape
    matched = [one for k in range(count) if (one := _matched(observed, best[k].reshape(shape)))]
    matched.sort(key=lambda one: one[0])
    return list({labels.tobytes(): labels for _, labels in matched}.values())[:most]


def _matched(observed: Observation, labels: IntArray) -> tuple[float, IntArray] | None:
    """Labels of the dots that a surface through those of a cap predicts, and their cost."""
    pool = try_fit(observed, labels, QUICK)
    if pool is None:
        return None
    labels = matched_labels(observed, pool, labels)
    pool = try_fit(observed, labels, QUICK, pool)
    return None if pool is None else (rough_costs(observed, labels, pool)[1], labels)


def _caps(observed: Observation) -> FloatArray:
    """Caps to be tried, each as large as there are dots for: see `quadric_kernels.score_caps`."""
    area = len(observed.plane_mm) * observed.spacing_mm.prod()
    caps = []
    for aspect, height, x, y in product(_ASPECTS, _HEIGHTS, _ASIDE, _ALONG):
        across, along = np.sqrt(area / np.pi * np.array([1 / aspect, aspect]))
        caps.append((x, y, across, along, 2 * height * across))
    return np.array(caps)
