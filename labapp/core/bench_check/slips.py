"""Whether all rays are one row or column off: the hole of another dot was taken for the absent ray.

The bench adjusts itself to rays of the next row as well: the laser turns by an inter-beam angle, or
its aim and the imaging plane move by a spacing. That leaves the same residuals, and only the prior,
and dots beyond the pattern's edge, tell the two apart.
"""

from __future__ import annotations

from collections.abc import Sequence

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
from labapp.core.geometry.rig import Rig
from labapp.core.matching.observation import UNLABELLED, Observation
from labapp.core.values import FloatArray, IntArray

SLIPS = ((1, 0), (-1, 0), (0, 1), (0, -1))
"""Rows and columns by which rays may have slipped."""

STEPS = 15
"""Of the adjustment to other rays."""


def slip_drop(
    rig: Rig,
    seen: Sequence[tuple[Observation, Mirror, IntArray]],
    made: Adjustment,
    released: FloatArray,
) -> float:
    """By how much the cost falls with the rays of the next row or column; −inf: it cannot.

    Dots without a ray count as in `label_picture`: where all others fit, more of them than the
    prior costs speak against it at once.

    Parameters
    ----------
    rig, released
        What was adjusted, see `adjust`.
    seen
        Each picture's dots, mirror and labels.
    made
        The adjustment to these.
    """
    strays = sum(_strays(observed, labels) for observed, _, labels in seen)
    prior = float(made.unknown @ made.unknown)
    excess = prior + max(made.cost - prior - len(made.standardised), 0.0)  # all that is not noise
    drops = [-np.inf]
    for by in np.array(SLIPS):
        labels = [moved_labels(own, by) for _, _, own in seen]
        more = sum(_strays(o, own) for (o, *_), own in zip(seen, labels, strict=True)) - strays
        if STRAY * more < excess:
            cost = _cost_of_slip(rig, seen, labels, made.scale, released)
            drops.append(made.cost + STRAY * strays - cost)
    return max(drops)


def _cost_of_slip(
    rig: Rig,
    seen: Sequence[tuple[Observation, Mirror, IntArray]],
    labels: list[IntArray],
    scale: float,
    released: FloatArray,
) -> float:
    """Cost with other labels to begin with; the absent ray may have a dot."""
    if any((one != UNLABELLED).sum() < LEAST_DOTS for one in labels):
        return np.inf
    unknown: FloatArray | None = None
    for _ in range(2):
        sightings = [
            sighting_of(observed, mirror, one, with_absent=True)
            for (observed, mirror, _), one in zip(seen, labels, strict=True)
        ]
        system = System.of(rig, sightings, released)
        unknown = system.minimised(system.start() if unknown is None else unknown, scale, STEPS)
        found = system.adjustment(unknown, scale)
        used = labels
        labels = [
            relabelled(observed, mirror, found.offset, pose)
            for (observed, mirror, _), pose in zip(seen, found.poses, strict=True)
        ]
        if all((one == other).all() for one, other in zip(used, labels, strict=True)):
            break
    strays = sum(_strays(one[0], own) for one, own in zip(seen, used, strict=True))
    return found.cost + STRAY * strays


def _strays(observed: Observation, labels: IntArray) -> int:
    return len(observed.plane_mm) - int((labels != UNLABELLED).sum())
