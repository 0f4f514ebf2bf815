"""Assignment of rays to the dots in a picture of a mirror.

The rows and columns in the picture and the hole of the absent ray determine the rays of a lattice
directly, however wrong the set-up is. Bench and mirror are adjusted to these labels and predict the
dot of every ray. Each dot close to a predicted one is assigned to its ray. This is repeated until
no label changes.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import numpy as np
import scipy

from labapp.core.bench_check.adjustment import Adjustment, Sighting, adjust
from labapp.core.bench_check.mirrors import Mirror, landing_points
from labapp.core.geometry.bench import Bench
from labapp.core.geometry.optics import intersect_level
from labapp.core.geometry.perturbation import moved_dots, moved_rig
from labapp.core.geometry.uncertainty import QUANTITIES
from labapp.core.images.dots import Dots
from labapp.core.matching.observation import UNLABELLED, Observation
from labapp.core.matching.relabelling import labels_from_lattice
from labapp.core.rows.find_lattice import LatticeSettings, find_lattice
from labapp.core.rows.lattice import empty_sites, number_on_plane
from labapp.core.values import CannotMeasure, FloatArray, IntArray

LEAST_DOTS = 12
"""Least number of dots with a ray that determines a bench."""

SURROUNDED = 3
"""A ray is surrounded if at least this number of its four neighbours are lit."""

NEAR = 0.3
"""Largest distance of a dot from its predicted position, as a share of the distance to the next
ray's dot."""

STRAY, MISSED = 10.0, 6.0
"""Cost of a dot without a ray, and of a surrounded ray without a dot, in units of −2 log
likelihood."""

MARGIN = 20.0
"""Labels are ambiguous if others cost less than this much more than the best."""

MOST_STARTS = 4
"""Largest number of initial labels of each kind that are tried, those of least penalty first."""

MOST_WORSE = 40.0
"""Initial labels whose penalty exceeds the least one by more than this are not tried."""

EXPLAINED = 0.85
"""Least share of the dots that have a ray if the mirror explains them."""

GRID_MM, LOOSE = 0.25, 0.45
"""Spacing of the trial positions of a ball or cap; `NEAR` for these, as the bench may be off."""

ROUNDS = 8
"""Largest number of iterations of adjusting and relabelling."""


@dataclass(frozen=True)
class MirrorDots:
    """Dots detected in a picture of a mirror.

    Parameters
    ----------
    dots
        Dots from `find_dots`.
    frame_shape
        Height and width of the picture, px.
    """

    name: str
    mirror: Mirror
    dots: Dots
    frame_shape: tuple[int, int]


@dataclass(frozen=True)
class Labelled:
    """Rays of the dots of a single picture.

    Parameters
    ----------
    labels
        Index of each ray's dot, −1 without one, shape (rows, columns).
    adjustment
        Adjustment of the bench and this mirror alone.
    cost
        −2 log likelihood up to a constant, including dots without rays and rays without dots.
    """

    labels: IntArray
    adjustment: Adjustment
    cost: float


def label_picture(picture: MirrorDots, bench: Bench, freed: FloatArray | None = None) -> Labelled:
    """Assign a ray to every dot of a picture.

    Raises
    ------
    CannotMeasure
        ``too-few-dots``; ``no-reference`` if no gap among the dots can be the absent ray's;
        ``ambiguous-rows`` if several can; ``no-match`` if the mirror does not explain the dots
        with any of them.
    """
    if bench.rig.pattern.marker is None:
        raise CannotMeasure(
            "no-reference", "the pattern has no absent ray that would identify rows"
        )
    if len(picture.dots) < LEAST_DOTS:
        raise CannotMeasure(
            "too-few-dots",
            f"{picture.name}: {len(picture.dots)} dots, a bench check needs {LEAST_DOTS}",
        )
    observed = Observation.of(picture.dots, bench, picture.frame_shape)
    found: list[Labelled] = []
    for first in (_by_lattice, _by_places):
        starts = _likeliest(first(observed, picture), observed)
        grown = (_grown(observed, picture.mirror, freed, one) for one in starts)
        found += [one for one in grown if one is not None]
        if any(_explains(observed, one) for one in found):
            break
    if not found:
        raise CannotMeasure(
            "no-reference",
            f"{picture.name}: no gap among the dots can be the absent ray's. Is it the mirror that "
            "was named? Else move the mirror or the plane until it is seen",
        )
    best, *others = _different(found)
    if others and others[0].cost < best.cost + MARGIN:
        raise CannotMeasure(
            "ambiguous-rows",
            f"{picture.name}: several gaps among the dots can be the absent ray's",
        )
    if not _explains(observed, best):
        lit = int((best.labels != UNLABELLED).sum())
        raise CannotMeasure(
            "no-match",
            f"{picture.name}: a {picture.mirror.name} explains {lit} of {len(picture.dots)} dots",
        )
    return best


def _likeliest(starts: list[IntArray], observed: Observation) -> list[IntArray]:
    """Initial labels with the least penalty, without those much worse than the best."""
    penalties = np.array([_penalty(labels, observed) for labels in starts])
    order = np.argsort(penalties, kind="stable")[:MOST_STARTS]
    return [starts[k] for k in order if penalties[k] <= penalties.min() + MOST_WORSE]


def _by_lattice(observed: Observation, picture: MirrorDots) -> list[IntArray]:
    """Labels from the rows and columns of the dots, for the absent ray at each empty site."""
    pattern = observed.rig.pattern
    try:
        lattice = find_lattice(picture.dots, picture.frame_shape, LatticeSettings())
    except CannotMeasure:
        return []
    lattice = number_on_plane(lattice, picture.dots, observed.bench.calibration)
    assert pattern.marker is not None
    shape = (pattern.rows, pattern.columns)
    sites = dict.fromkeys([*lattice.candidates, *empty_sites(lattice)])
    return [labels_from_lattice(lattice, s, pattern.marker, "S/S", shape) for s in sites]


def _by_places(observed: Observation, picture: MirrorDots) -> list[IntArray]:
    """Labels from the dots predicted for a ball or cap on a grid of trial positions.

    Labels shifted by a row or column, with the mirror moved accordingly, fit a bench that may be
    off equally well. The absent ray is therefore tried at each hole among the lit rays.
    """
    mirror, rig = picture.mirror, observed.rig
    if "x_mm" not in mirror.parameters:
        return []
    passed = intersect_level(rig.laser.position_mm, observed.rays.directions, mirror.pose[2])[
        ..., :2
    ]
    low, high = passed.min(axis=(0, 1)), passed.max(axis=(0, 1))
    x, y = (np.arange(*ends, GRID_MM) for ends in zip(low, high, strict=True))
    still = np.zeros(len(QUANTITIES))
    made = [
        relabelled(observed, mirror, still, np.array([*place, *mirror.pose[2:]]), LOOSE)
        for place in product(x, y)
    ]
    made.sort(key=lambda labels: -int((labels != UNLABELLED).sum()))
    i, j = rig.pattern.marker or rig.pattern.center_ray
    found: dict[bytes, IntArray] = {}
    for labels in made[: 4 * MOST_STARTS]:
        holes = (labels == UNLABELLED) & (_lit_neighbours(labels) >= SURROUNDED)
        for site in np.argwhere(holes):
            moved = moved_labels(labels, np.array([i - 1, j - 1]) - site)
            found.setdefault(moved.tobytes(), moved)
    return list(found.values())


def moved_labels(labels: IntArray, by: IntArray) -> IntArray:
    """Shift labels by rows and columns; dots shifted out of the pattern get no ray."""
    made = np.full_like(labels, UNLABELLED)
    at = np.argwhere(labels != UNLABELLED)
    to = at + by
    inside = ((to >= 0) & (to < labels.shape)).all(axis=1)
    made[tuple(to[inside].T)] = labels[tuple(at[inside].T)]
    return made


def _explains(observed: Observation, one: Labelled) -> bool:
    lit = int((one.labels != UNLABELLED).sum())
    return lit >= max(LEAST_DOTS, EXPLAINED * len(observed.plane_mm))


def sighting_of(
    observed: Observation, mirror: Mirror, labels: IntArray, *, with_absent: bool = False
) -> Sighting:
    """Return the ray–dot pairs of labels; optionally with dots of rays that should be absent."""
    at = np.argwhere((labels != UNLABELLED) & (with_absent | ~observed.rays.absent))
    dot = labels[tuple(at.T)]
    return Sighting(mirror, at, observed.plane_mm[dot], observed.covariance_mm2[dot])


def relabelled(
    observed: Observation,
    mirror: Mirror,
    offset: FloatArray,
    pose: FloatArray,
    share: float = NEAR,
) -> IntArray:
    """Label dots by the predicted dots of all rays, for an offset of the bench and a mirror's pose.

    A dot is assigned to a ray if its distance from the predicted dot is less than a share of the
    distance to the next ray's dot. An absent ray gets a label if a dot lies in its hole.
    """
    assert observed.rig.uncertainty is not None
    computed, hit = landing_points(mirror, pose, moved_rig(observed.rig, offset))
    axes = observed.rig.uncertainty.axes
    dots = moved_dots(observed.plane_mm, observed.rig, axes, offset)
    labels = np.full(hit.shape, UNLABELLED)
    at = np.argwhere(hit)
    if len(at) < 2 or not len(dots):
        return labels
    near = share * _step(np.where(hit[..., None], computed, np.nan))[hit]
    apart = scipy.spatial.distance.cdist(computed[hit], dots)
    dot, back = apart.argmin(axis=1), apart.argmin(axis=0)
    ray = np.arange(len(at))
    mutual = (back[dot] == ray) & (apart[ray, dot] < near)
    labels[tuple(at[mutual].T)] = dot[mutual]
    return labels


def _grown(
    observed: Observation,
    mirror: Mirror,
    freed: FloatArray | None,
    labels: IntArray,
) -> Labelled | None:
    """Iterate adjustment and labelling from initial labels; None without the absent ray's hole."""
    start = None
    for _ in range(ROUNDS):
        if (labels != UNLABELLED).sum() < LEAST_DOTS:
            return None
        made = adjust(observed.rig, [sighting_of(observed, mirror, labels)], freed, start)
        start, before = made.unknown, labels
        labels = relabelled(observed, mirror, made.offset, made.poses[0])
        if (labels == before).all():
            break
    i, j = observed.rig.pattern.marker or observed.rig.pattern.center_ray
    in_hole = labels[i - 1, j - 1] != UNLABELLED
    if in_hole or _lit_neighbours(labels)[i - 1, j - 1] < SURROUNDED:
        return None
    cost = made.cost + _penalty(labels, observed) + _coarse(made)
    return Labelled(np.where(observed.rays.absent, UNLABELLED, labels), made, cost)


def _coarse(made: Adjustment) -> float:
    """Cost of residuals that are wider than their uncertainty, −2 log likelihood."""
    return 2 * len(made.standardised) * float(np.log(made.scale))


def _different(found: list[Labelled]) -> list[Labelled]:
    """Sort by cost, each set of labels once."""
    once = {one.labels.tobytes(): one for one in sorted(found, key=lambda one: -one.cost)}
    return sorted(once.values(), key=lambda one: one.cost)


def _penalty(labels: IntArray, observed: Observation) -> float:
    """Cost of dots without a ray, and of surrounded rays without a dot."""
    lit = labels != UNLABELLED
    missed = int((~lit & ~observed.rays.absent & (_lit_neighbours(labels) >= SURROUNDED)).sum())
    on_hole = int((lit & observed.rays.absent).sum())
    stray = len(observed.plane_mm) - int(lit.sum()) + on_hole
    return STRAY * stray + MISSED * missed


def _lit_neighbours(labels: IntArray) -> IntArray:
    """Number of the four neighbours of each ray that have a dot, shape (rows, columns)."""
    around = np.pad(labels != UNLABELLED, 1).astype(np.int64)
    return np.asarray(around[:-2, 1:-1] + around[2:, 1:-1] + around[1:-1, :-2] + around[1:-1, 2:])


def _step(plane_mm: FloatArray) -> FloatArray:
    """Distance to the nearest neighbouring ray's dot, (rows, columns); infinite without one."""
    step = np.full(plane_mm.shape[:2], np.inf)
    for axis in (0, 1):
        length = np.linalg.norm(np.diff(plane_mm, axis=axis), axis=-1)
        length = np.where(np.isfinite(length), length, np.inf)
        for part in (np.s_[1:], np.s_[:-1]):
            at = (part, slice(None)) if axis == 0 else (slice(None), part)
            step[at] = np.minimum(step[at], length)
    return step
