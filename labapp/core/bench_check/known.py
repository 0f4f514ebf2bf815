"""Sizes of known mirrors as measured by the bench: the validation of an adjusted set-up.

Bench and mirrors are adjusted together, so the new set-up depends on a mirror's known size. That
this set-up reproduces the size is therefore only a weak test. Each mirror is also measured without
its known size, from the set-up before the check, the other mirrors and its own dots together. If
the result differs from the known size by more than their uncertainties allow, one of them is wrong.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import chain

import numpy as np

from labapp.core.bench_check.adjustment import Adjustment, Sighting, System, adjust
from labapp.core.bench_check.mirrors import Cap, Mirror, Plate, sphere_radius
from labapp.core.geometry.perturbation import moved_dots, moved_rig
from labapp.core.geometry.rig import Rig
from labapp.core.values import FloatArray

LOOSE = 0.5
"""Relative prior standard uncertainty of a size that is to be measured."""

LOOSE_PLATE_MM = 5.0
"""Prior standard uncertainty of a plate's height that is to be measured, mm."""

STEP_MM = 1e-4
"""Step of the differences that propagate uncertainties to sizes, mm."""

CONTRADICTED = 3.0
"""Limit of the deviation, in standard uncertainties, beyond which size or set-up is wrong."""


@dataclass(frozen=True)
class MeasuredSize:
    """A size of a mirror, known and measured, with standard uncertainties, mm.

    Parameters
    ----------
    name
        ``height`` or ``radius``.
    known_mm, known_sigma_mm
        Given size.
    measured_mm, sigma_mm
        Size measured with the adjusted set-up, and its uncertainty from the noise of the dots. Not
        an independent measurement, as the known size entered the adjustment.
    independent_mm, independent_sigma_mm
        Size measured without the known size; total uncertainty from noise and set-up.
    """

    name: str
    known_mm: float
    known_sigma_mm: float
    measured_mm: float
    sigma_mm: float
    independent_mm: float
    independent_sigma_mm: float

    @property
    def deviation(self) -> float:
        """Independently measured minus known size, in standard uncertainties of the difference."""
        sigma = np.hypot(self.independent_sigma_mm, self.known_sigma_mm)
        return float((self.independent_mm - self.known_mm) / sigma)

    @property
    def noticed_mm(self) -> float:
        """Smallest error of the known size that the dots usually contradict, mm."""
        return CONTRADICTED * float(np.hypot(self.independent_sigma_mm, self.known_sigma_mm))

    @property
    def is_contradicted(self) -> bool:
        """Whether the dots contradict the known size."""
        return abs(self.deviation) > CONTRADICTED


def measure_sizes(system: System, made: Adjustment) -> tuple[tuple[MeasuredSize, ...], ...]:
    """Measure the sizes of each mirror: its height, preceded by the radius of a ball or cap."""
    every = []
    for k, sighting in enumerate(system.sightings):
        mirror = sighting.mirror
        known = mirror.pose, np.diag(mirror.sigma**2)
        by_new = _by_adjusted_bench(system.rig, sighting, made)
        independent = _without_size(system, made, k)
        sizes = []
        for name, size in _sizes(mirror).items():
            pairs = (_propagated(size, *one) for one in (known, by_new, independent))
            sizes.append(MeasuredSize(name, *chain.from_iterable(pairs)))
        every.append(tuple(sizes))
    return tuple(every)


def _by_adjusted_bench(
    rig: Rig, sighting: Sighting, made: Adjustment
) -> tuple[FloatArray, FloatArray]:
    """Pose of a mirror by the adjusted bench, taken as exact, and its covariance."""
    knows = rig.uncertainty
    assert knows is not None
    exact = replace(knows, covariance=np.zeros_like(knows.covariance))
    dots = moved_dots(sighting.plane_mm, rig, knows.axes, made.offset)
    one = replace(sighting, mirror=_loosened(sighting.mirror), plane_mm=dots)
    found = adjust(replace(moved_rig(rig, made.offset), uncertainty=exact), [one])
    return found.poses[0], found.pose_covariances[0]


def _without_size(system: System, made: Adjustment, k: int) -> tuple[FloatArray, FloatArray]:
    """Pose of a mirror, and its covariance, by an adjustment in which its size is free."""
    own = system.sightings[k].mirror
    loose = _loosened(own)
    # A part of the pose that is known exactly is no unknown: its uncertainty stays zero.
    narrower = np.divide(own.sigma, loose.sigma, out=np.ones_like(own.sigma), where=loose.sigma > 0)
    unknown = made.unknown.copy()
    unknown[system.parts[k + 1]] *= narrower
    found = system.with_mirror(k, loose).refined(unknown, made.scale)
    return found.poses[k], found.pose_covariances[k]


def _propagated(
    size: Callable[[FloatArray], float], pose: FloatArray, covariance: FloatArray
) -> tuple[float, float]:
    """Size of a mirror at a pose, and its standard uncertainty."""
    value = size(pose)
    slope = np.array([size(pose + step) - value for step in STEP_MM * np.eye(len(pose))]) / STEP_MM
    return value, float(np.sqrt(slope @ covariance @ slope))


def _sizes(mirror: Mirror) -> dict[str, Callable[[FloatArray], float]]:
    """Sizes of a mirror by their names, as functions of its pose."""
    at = mirror.parameters.index("height_mm")
    height = {"height": lambda pose: float(pose[at])}
    if isinstance(mirror, Plate):
        return height
    if isinstance(mirror, Cap):
        return {"radius": lambda pose: float(sphere_radius(pose[3], pose[2]))} | height
    return {"radius": lambda pose: float(pose[3]) / 2} | height


def _loosened(mirror: Mirror) -> Mirror:
    """Return the mirror with large uncertainties of its sizes."""
    if isinstance(mirror, Plate):
        return replace(mirror, height_sigma_mm=LOOSE_PLATE_MM)
    wide = LOOSE * mirror.diameter_mm
    height = LOOSE * mirror.height_mm if isinstance(mirror, Cap) else wide
    return replace(mirror, height_sigma_mm=height, diameter_sigma_mm=wide)
