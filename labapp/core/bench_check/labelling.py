"""Dots of a mirror's picture → their rays.

The rows and columns that the picture shows, with the hole of the absent ray, give the rays of a
grid at once, however wrong the set-up is. Bench and mirror are adjusted to these, predict where
every ray's dot should be, and dots get the rays that they are near; this is repeated until nothing
changes.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import numpy as np
import scipy

from labapp.core.bench_check.adjustment import Adjustment, Sighting, adjust
from labapp.core.bench_check.mirrors import Mirror, landing_points
from labapp.core.geometry.bench import Bench
from labapp.core.geometry.coordinates import ImageCalibration
from labapp.core.geometry.optics import intersect_level
from labapp.core.geometry.perturbation import moved_dots, moved_rig
from labapp.core.geometry.rig import Rig
from labapp.core.geometry.uncertainty import QUANTITIES
from labapp.core.images.dots import Dots
from labapp.core.matching.hypothesis import labels_from_lattice
from labapp.core.matching.observation import UNLABELLED, Observation
from labapp.core.rows.find_lattice import LatticeSettings, find_lattice
from labapp.core.rows.lattice import empty_sites
from labapp.core.values import CannotMeasure, FloatArray, IntArray

LEAST_DOTS = 12
"""Fewer dots with a ray do not determine a bench."""

SURROUNDED = 3
"""A ray is amid others that have so many lit neighbours of four."""

NEAR = 0.3
"""A dot is taken for a ray's where it is nearer to where it should be than this share of the way to
the next ray's."""

STRAY, MISSED = 10.0, 6.0
"""What a dot without a ray costs, and a ray without a dot amid others, in units of −2 log
likelihood."""

MARGIN = 20.0
"""Rays that cost less than so much more than the best are as likely."""

MOST_STARTS = 4
"""So many first labels of a kind are tried, those first that leave fewest dots and rays."""

MOST_WORSE = 40.0
"""First labels that leave dots and rays which cost so much more than the best's are not tried."""

EXPLAINED = 0.85
"""Such a share of the dots has a ray where a mirror explains them."""

GRID_MM, LOOSE = 0.25, 0.45
"""Steps between places where a ball or cap is looked for; `NEAR` there, as the bench may be off."""

ROUNDS = 8
"""Of adjusting and labelling anew, at most."""


@dataclass(frozen=True)
class Picture:
    """Dots that were found in a picture of a mirror.

    Parameters
    ----------
    name
        What it is called, for messages.
    mirror
        What it shows.
    dots
        What `find_dots` found.
    frame_shape
        Height and width of the picture, px.
    """

    name: str
    mirror: Mirror
    dots: Dots
    frame_shape: tuple[int, int]


@dataclass(frozen=True)
class Labelled:
    """Rays of a picture's dots, by themselves.

    Parameters
    ----------
    labels
        Index of each ray's dot, −1 without one, shape (rows, columns).
    adjustment
        Of the bench and this mirror alone.
    cost
        −2 log likelihood but for a constant, dots without rays and rays without dots included.
    """

    labels: IntArray
    adjustment: Adjustment
    cost: float


def label_picture(
    picture: Picture,
    rig: Rig,
    calibration: ImageCalibration,
    released: FloatArray | None = None,
) -> Labelled:
    """Find the ray of every dot of a picture.

    Parameters
    ----------
    picture
        The picture.
    rig, calibration
        The set-up before the check.
    released
        See `adjust`.

    Raises
    ------
    CannotMeasure
        ``too-few-dots``; ``no-reference`` where no gap among the dots can be the absent ray's;
        ``ambiguous-rows`` where several can; ``no-match`` where the mirror explains the dots
        with none.
    """
    pattern = rig.pattern
    if pattern.marker is None:
        raise CannotMeasure(
            "no-reference", "the pattern has no absent ray that would identify rows"
        )
    if len(picture.dots) < LEAST_DOTS:
        raise CannotMeasure(
            "too-few-dots",
            f"{picture.name}: {len(picture.dots)} dots, a bench check needs {LEAST_DOTS}",
        )
    observed = Observation.of(picture.dots, Bench(rig, calibration), picture.frame_shape)
    found: list[Labelled] = []
    for first in (_by_grid, _by_places):
        starts = _likeliest(first(observed, picture), observed)
        grown = (_grown(observed, picture.mirror, released, one) for one in starts)
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
    """The labels that leave fewest dots and rays, none that leaves many more than the best."""
    penalties = np.array([_penalty(labels, observed) for labels in starts])
    order = np.argsort(penalties, kind="stable")[:MOST_STARTS]
    return [starts[k] for k in order if penalties[k] <= penalties.min() + MOST_WORSE]


def _by_grid(observed: Observation, picture: Picture) -> list[IntArray]:
    """Labels by the rows and columns in the picture, the absent ray at each site without a dot."""
    pattern = observed.rig.pattern
    try:
        lattice = find_lattice(picture.dots, picture.frame_shape, LatticeSettings())
    except CannotMeasure:
        return []
    assert pattern.marker is not None
    shape = (pattern.rows, pattern.columns)
    sites = dict.fromkeys([*lattice.candidates, *empty_sites(lattice)])
    return [labels_from_lattice(lattice, s, pattern.marker, "S/S", shape) for s in sites]


def _by_places(observed: Observation, picture: Picture) -> list[IntArray]:
    """Labels by where the expected bench has the dots of a ball or cap, at places all over.

    A row or column on, with the mirror moved as much, they fit a bench that may be off as well: the
    absent ray is put at each hole that the lit ones leave.
    """
    mirror, rig = picture.mirror, observed.rig
    if "x_mm" not in mirror.parameters:
        return []
    passed = intersect_level(rig.laser.position_mm, observed.rays, mirror.pose[2])[..., :2]
    low, high = passed.min(axis=(0, 1)), passed.max(axis=(0, 1))
    x, y = (np.arange(*ends, GRID_MM) for ends in zip(low, high, strict=True))
    still = np.zeros(len(QUANTITIES))
    made = [
        relabelled(observed, mirror, still, np.array([*place, *mirror.pose[2:]]), LOOSE)
        for place in product(x, y)
    ]
    made.sort(key=lambda labels: -int((labels != UNLABELLED).sum()))
    i, j = rig.pattern.marker or rig.pattern.reference
    found: dict[bytes, IntArray] = {}
    for labels in made[: 4 * MOST_STARTS]:
        holes = (labels == UNLABELLED) & (_lit_neighbours(labels) >= SURROUNDED)
        for site in np.argwhere(holes):
            moved = moved_labels(labels, np.array([i - 1, j - 1]) - site)
            found.setdefault(moved.tobytes(), moved)
    return list(found.values())


def moved_labels(labels: IntArray, by: IntArray) -> IntArray:
    """Labels so many rows and columns on; what leaves the pattern gets no ray."""
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
    """Ray–dot pairs of a labelling; on request with dots of rays that should be absent."""
    at = np.argwhere((labels != UNLABELLED) & (with_absent | ~observed.absent))
    dot = labels[tuple(at.T)]
    return Sighting(mirror, at, observed.plane_mm[dot], observed.covariance_mm2[dot])


def relabelled(
    observed: Observation,
    mirror: Mirror,
    offset: FloatArray,
    pose: FloatArray,
    share: float = NEAR,
) -> IntArray:
    """Labels by where a bench that is off and a mirror at a pose put every ray's dot.

    A dot is taken that is nearer to a ray's than a share of the way to the next. An absent ray has
    one where a dot lies in its hole.
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
    distance, dot = scipy.spatial.cKDTree(dots).query(computed[hit])
    back = scipy.spatial.cKDTree(computed[hit]).query(dots)[1]
    mutual = (back[dot] == np.arange(len(at))) & (distance < near)
    labels[tuple(at[mutual].T)] = dot[mutual]
    return labels


def _grown(
    observed: Observation,
    mirror: Mirror,
    released: FloatArray | None,
    labels: IntArray,
) -> Labelled | None:
    """Labels that bench and mirror, adjusted to them, lead to; None where these have no hole."""
    start = None
    for _ in range(ROUNDS):
        if (labels != UNLABELLED).sum() < LEAST_DOTS:
            return None
        made = adjust(observed.rig, [sighting_of(observed, mirror, labels)], released, start)
        start, before = made.unknown, labels
        labels = relabelled(observed, mirror, made.offset, made.poses[0])
        if (labels == before).all():
            break
    i, j = observed.rig.pattern.marker or observed.rig.pattern.reference
    in_hole = labels[i - 1, j - 1] != UNLABELLED
    if in_hole or _lit_neighbours(labels)[i - 1, j - 1] < SURROUNDED:
        return None
    cost = made.cost + _penalty(labels, observed) + _coarse(made)
    return Labelled(np.where(observed.absent, UNLABELLED, labels), made, cost)


def _coarse(made: Adjustment) -> float:
    """−2 log of how much wider than their uncertainty residuals are."""
    return 2 * len(made.standardised) * float(np.log(made.scale))


def _different(found: list[Labelled]) -> list[Labelled]:
    """The cheapest first, each set of labels once."""
    once = {one.labels.tobytes(): one for one in sorted(found, key=lambda one: -one.cost)}
    return sorted(once.values(), key=lambda one: one.cost)


def _penalty(labels: IntArray, observed: Observation) -> float:
    """What dots without a ray cost, and rays without a dot that are amid lit ones."""
    lit = labels != UNLABELLED
    missed = int((~lit & ~observed.absent & (_lit_neighbours(labels) >= SURROUNDED)).sum())
    on_hole = int((lit & observed.absent).sum())
    stray = len(observed.plane_mm) - int(lit.sum()) + on_hole
    return STRAY * stray + MISSED * missed


def _lit_neighbours(labels: IntArray) -> IntArray:
    """How many of the four neighbours of each ray have a dot, shape (rows, columns)."""
    around = np.pad(labels != UNLABELLED, 1).astype(np.int64)
    return np.asarray(around[:-2, 1:-1] + around[2:, 1:-1] + around[1:-1, :-2] + around[1:-1, 2:])


def _step(plane_mm: FloatArray) -> FloatArray:
    """Way to the nearest neighbouring ray's dot, shape (rows, columns); infinite without one."""
    step = np.full(plane_mm.shape[:2], np.inf)
    for axis in (0, 1):
        length = np.linalg.norm(np.diff(plane_mm, axis=axis), axis=-1)
        length = np.where(np.isfinite(length), length, np.inf)
        for part in (np.s_[1:], np.s_[:-1]):
            at = (part, slice(None)) if axis == 0 else (slice(None), part)
            step[at] = np.minimum(step[at], length)
    return step
