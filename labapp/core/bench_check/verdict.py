"""Classification of the residuals of a bench check: noise, or a pattern with a known cause.

Each unmodelled cause produces characteristic patterns of residuals. These are fitted to the
residuals of the adjustment, together with bench and mirrors (score test). The cause that explains
most is the verdict, if it is significant.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from labapp.core.bench_check.adjustment import Adjustment, Sighting, System
from labapp.core.bench_check.mirrors import Plate, landing_points
from labapp.core.geometry.optics import intersect_imaging_plane, ray_directions, reflect
from labapp.core.geometry.perturbation import moved_rig
from labapp.core.geometry.rig import Rig
from labapp.core.values import FloatArray

ResidualVerdict = Literal[
    "noise-like", "distortion", "plate-not-flat", "wrong-lens", "row-slipped", "unexplained"
]

PATTERN_MM = 0.012
"""A pattern with a smaller root mean square is ignored."""

SURE = 30.0
"""A pattern is significant if it reduces the cost by this plus its number of amplitudes …"""

SHARE = 0.15
"""… and by more than this share of the cost of the dots."""

COARSE = 2.0
"""Residuals larger than their uncertainty by more than this factor are not noise."""


@dataclass(frozen=True)
class ResidualPattern:
    """A cause, and the part of the residuals that it explains.

    Parameters
    ----------
    cost_fall
        Reduction of the cost, in units of χ².
    rms_mm
        Root mean square of the explained part, mm.
    """

    cause: ResidualVerdict
    cost_fall: float
    rms_mm: float


def judge(system: System, made: Adjustment) -> tuple[ResidualVerdict, tuple[ResidualPattern, ...]]:
    """Classify the residuals of an adjustment: verdict, and patterns, the likeliest first."""
    left = float(np.sum(made.weight * (made.standardised / made.scale) ** 2))
    size = np.sqrt(np.mean(np.concatenate([r.ravel() for r in made.residual_mm]) ** 2))
    unit = float(size / np.sqrt(np.mean(made.standardised**2)))
    found, sure = [], []
    for cause, columns in _causes(system, made):
        cost_fall, amplitudes = made.cost_fall(columns)
        pattern = ResidualPattern(
            cause, cost_fall, float(np.sqrt(np.mean((columns @ amplitudes) ** 2))) * unit
        )
        found.append(pattern)
        if (
            cost_fall > SURE + columns.shape[1]
            and cost_fall > SHARE * left
            and pattern.rms_mm > PATTERN_MM
        ):
            sure.append(pattern)
    found.sort(key=lambda one: -one.cost_fall)
    if sure:
        return max(sure, key=lambda one: one.cost_fall).cause, tuple(found)
    return ("unexplained" if made.scale > COARSE else "noise-like"), tuple(found)


def _causes(system: System, made: Adjustment) -> Iterator[tuple[ResidualVerdict, FloatArray]]:
    """Each cause, with the changes of the standardised residuals per amplitude, shape (m, c)."""
    bench = moved_rig(system.rig, made.offset)
    every = list(enumerate(zip(system.sightings, made.poses, strict=True)))
    bent = [system.by_dots(k, _bent_picture(s, system.rig)) for k, (s, _) in every]
    yield "distortion", np.sum(bent, axis=0)
    other = [system.by_dots(k, _other_lens(s, p, bench)) for k, (s, p) in every]
    yield "wrong-lens", np.sum(other, axis=0)
    for k, (sighting, pose) in every:
        if isinstance(sighting.mirror, Plate):
            yield "plate-not-flat", system.by_dots(k, _bent_plate(sighting, pose, bench))
        yield "row-slipped", system.by_dots(k, _slipped(sighting, pose, bench))


def _bent_picture(sighting: Sighting, rig: Rig) -> FloatArray:
    """Radial distortion of third and fifth order, and decentring, shape (n, 2, 4), mm."""
    half = np.array([rig.imaging_plane.width_mm, rig.imaging_plane.height_mm]) / 2
    reach = float(np.linalg.norm(half))
    x, y = ((sighting.plane_mm - half) / reach).T
    square = x**2 + y**2
    radial = [np.stack([x, y], axis=-1) * (square**n)[:, None] for n in (1, 2)]
    decentred = [
        np.stack([2 * x * y, square + 2 * y**2], axis=-1),
        np.stack([square + 2 * x**2, 2 * x * y], axis=-1),
    ]
    return reach / 10 * np.stack([*radial, *decentred], axis=-1)


def _other_lens(sighting: Sighting, pose: FloatArray, rig: Rig) -> FloatArray:
    """Effect of scaled, sheared or distorted ray tangents, shape (n, 2, c), mm."""
    tangents = rig.pattern.tangents[tuple(sighting.ray.T)]
    reach = float(np.abs(rig.pattern.tangents).max())
    x, y = (tangents / reach).T
    zero, square = np.zeros_like(x), x**2 + y**2
    modes = [(x, -y), (y, x), (x * square, y * square), (x**3, zero), (zero, y**3)]
    axes = rig.laser.axes

    def landed(by: FloatArray) -> FloatArray:
        bent = tangents + reach * by
        rays = axes[0] + bent[:, :1] * axes[1] + bent[:, 1:] * axes[2]
        rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
        source = rig.laser.position_mm
        point, normal, _ = sighting.mirror.meet(source, rays, pose)
        return intersect_imaging_plane(point, reflect(rays, normal), rig.imaging_plane)

    return _changes(landed, [np.stack(mode, axis=-1) for mode in modes]) / 10


def _bent_plate(sighting: Sighting, pose: FloatArray, rig: Rig) -> FloatArray:
    """Effect of a plate bent as a polynomial of second and third order, shape (n, 2, 7), mm."""
    rays = ray_directions(rig.laser, rig.pattern)[tuple(sighting.ray.T)]
    point, normal, _ = sighting.mirror.meet(rig.laser.position_mm, rays, pose)
    reach = float(np.ptp(point[:, :2], axis=0).max()) / 2
    x, y = ((point[:, :2] - point[:, :2].mean(axis=0)) / reach).T
    zero = np.zeros_like(x)
    slopes = [
        (2 * x, zero), (y, x), (zero, 2 * y),
        (3 * x**2, zero), (2 * x * y, x**2), (y**2, 2 * x * y), (zero, 3 * y**2),
    ]  # fmt: skip

    def landed(by: FloatArray) -> FloatArray:
        tilted = normal - np.column_stack([by, zero])
        return intersect_imaging_plane(point, reflect(rays, tilted), rig.imaging_plane)

    return _changes(landed, [np.stack(slope, axis=-1) for slope in slopes]) / 10


def _slipped(sighting: Sighting, pose: FloatArray, rig: Rig) -> FloatArray:
    """Effect of rays shifted by a row or a column, shape (n, 2, 2), mm."""
    plane, _ = landing_points(sighting.mirror, pose, rig)
    along = np.stack([np.gradient(plane, axis=axis) for axis in (0, 1)], axis=-1)
    return np.asarray(along[tuple(sighting.ray.T)])


def _changes(
    landed: Callable[[FloatArray], FloatArray], modes: Sequence[FloatArray], step: float = 1e-4
) -> FloatArray:
    """Negative derivatives of the computed dots w.r.t. the amplitudes of modes, shape (n, 2, c)."""
    return np.stack([(landed(-step * m) - landed(step * m)) / (2 * step) for m in modes], axis=-1)
