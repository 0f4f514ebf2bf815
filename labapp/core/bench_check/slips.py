"""Test whether all rays are one row or column off: another hole was taken for the absent ray.

The bench can also be adjusted to rays of the next row: the laser turns by an inter-beam angle, or
its aim and the imaging plane move by a spacing. The residuals are then the same; only the prior and
dots beyond the pattern's edge distinguish the two.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from labapp.core.bench_check.adjustment import Adjustment, System
from labapp.core.bench_check.labelling import (
    LEAST_DOTS,
    STRAY,
    moved_labels,
    relabelled,
    sighting_of,
)
from labapp.core.bench_check.mirrors import Mirror
from labapp.core.matching.observation import UNLABELLED, Observation
from labapp.core.values import IntArray

SLIPS = ((1, 0), (-1, 0), (0, 1), (0, -1))
"""Rows and columns by which rays may be off."""

FEW_STEPS, STEPS = 4, 15
"""Steps of the adjustment to each of these, and to the likeliest."""

Seen = tuple[Observation, Mirror, IntArray]
"""A picture's dots, its mirror, and the index of each ray's dot."""


def slip_cost_fall(system: System, seen: Sequence[Seen], made: Adjustment) -> float:
    """Reduction of the cost with the rays of the next row or column; −inf if there is none.

    Dots without a ray cost as in `label_picture`. An alternative is excluded at once if its
    additional stray dots cost more than could be gained.
    """
    strays = _strays(seen)
    prior = float(made.unknown @ made.unknown)
    excess = prior + max(made.cost - prior - len(made.standardised), 0.0)  # all but the noise
    slipped = (
        [(observed, mirror, moved_labels(labels, by)) for observed, mirror, labels in seen]
        for by in np.array(SLIPS)
    )
    possible = [one for one in slipped if STRAY * (_strays(one) - strays) < excess]
    possible = [one for one in possible if min(map(_lit, one)) >= LEAST_DOTS]
    if not possible:
        return -np.inf
    tried = [(_adjusted(system, one, made.scale), one) for one in possible]
    near, best = min(tried, key=lambda pair: pair[0].cost + STRAY * _strays(pair[1]))
    again = [
        (observed, mirror, relabelled(observed, mirror, near.offset, pose))
        for (observed, mirror, _), pose in zip(best, near.poses, strict=True)
    ]
    best = again if min(map(_lit, again)) >= LEAST_DOTS else best
    found = _adjusted(system, best, made.scale, near)
    return made.cost + STRAY * strays - found.cost - STRAY * _strays(best)


def _adjusted(
    system: System, seen: Sequence[Seen], scale: float, near: Adjustment | None = None
) -> Adjustment:
    """Adjust to labels, roughly or from a similar adjustment; the absent ray may have a dot."""
    sightings = (sighting_of(*one, with_absent=True) for one in seen)
    slipped = replace(system, sightings=tuple(sightings))
    start, steps = (slipped.start(), FEW_STEPS) if near is None else (near.unknown, STEPS)
    return slipped.refined(start, scale, steps)


def _lit(one: Seen) -> int:
    return int((one[2] != UNLABELLED).sum())


def _strays(seen: Sequence[Seen]) -> int:
    """Number of dots without a ray."""
    return sum(len(one[0].plane_mm) - _lit(one) for one in seen)
