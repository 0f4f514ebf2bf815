"""Identification of a quantity that is off by far more than its ±.

A wrong prior biases every other quantity. Each quantity, and each common change of the whole
picture, is therefore freed in turn. The one that reduces the cost most is suspected.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from labapp.core.bench_check.adjustment import Adjustment, System
from labapp.core.geometry.perturbation import Direction, directions
from labapp.core.geometry.rig import Rig
from labapp.core.geometry.uncertainty import INDEX, QUANTITIES
from labapp.core.values import FloatArray

FREE = {"°": 20.0, "mm": 30.0, "px": 60.0, "%": 20.0}
"""Standard uncertainty of a quantity that is freed, in its unit."""

FREE_OWN = {
    "pattern.inter_beam_angle_deg": 0.4,
    "imaging_plane.glass_mm": 5.0,
    "imaging_plane.glass_index": 0.5,
    "image_calibration.x_axis_mm": 10.0,
    "image_calibration.z_axis_mm": 10.0,
    "picture.u": 200.0,
    "picture.v": 200.0,
    "picture.scale": 50.0,
}
"""Exceptions to `FREE`, by their keys."""

LIMIT = 20.0
"""A quantity is suspected if freeing it reduces the cost by more than this: 4.5 standard
deviations."""

TRIED = 8
"""Number of suspects tried."""

ALIKE = 6.0
"""Suspects explain the dots equally well if their reductions of the cost differ by less."""


@dataclass(frozen=True)
class Suspect:
    """A quantity that may be off by far more than its ±.

    Parameters
    ----------
    key
        Its key (`Quantity.key`), or ``picture.u``, ``picture.v``, ``picture.scale`` for the whole
        of the image calibration.
    cost_fall
        Reduction of the cost if it is free: the square of its deviation in standard deviations.
    """

    key: str
    name: str
    cost_fall: float


def freed_directions(rig: Rig, keys: Sequence[str]) -> FloatArray:
    """Directions in the space of the quantities that are freed by keys of suspects, shape (k, q).

    Raises
    ------
    KeyError
        If a key is unknown.
    """
    every = {one.key: _free(one) for one in directions(rig)}
    return np.array([every[key] for key in keys]).reshape(-1, len(QUANTITIES))


def suspect_keys() -> tuple[str, ...]:
    """Keys of all quantities that can be freed."""
    return (*INDEX, "picture.u", "picture.v", "picture.scale")


def find_suspects(system: System, made: Adjustment) -> tuple[Suspect, ...]:
    """Find the quantities that reduce the cost most when freed, the likeliest first.

    Quantities that explain the dots equally well are returned together, as the pictures cannot
    distinguish them. Empty if none is suspected.
    """
    every = {one.key: one for one in directions(system.rig)}
    by_bench = system.by_bench(made)
    first = {key: made.cost_fall(by_bench @ _free(one)[:, None])[0] for key, one in every.items()}
    most = max(first.values())
    if most < LIMIT:
        return ()
    # The first-order estimate is poor for large offsets: the likeliest are adjusted in full.
    likely = sorted(first, key=lambda key: -first[key])[:TRIED]
    found = []
    for key in likely:
        freed = system.with_free(_free(every[key])).refitted_with_more_free(made)
        found.append(Suspect(key, every[key].name, made.cost - freed.cost))
    found.sort(key=lambda one: -one.cost_fall)
    if found[0].cost_fall < LIMIT:
        return ()
    return tuple(
        one
        for one in found
        if one.cost_fall > found[0].cost_fall - max(ALIKE, 0.02 * found[0].cost_fall)
    )


def _free(one: Direction) -> FloatArray:
    """Direction of a freed quantity, scaled to its prior standard uncertainty."""
    free = FREE_OWN[one.key] if one.key in FREE_OWN else FREE[one.unit]
    return free * one.vector
