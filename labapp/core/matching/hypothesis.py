"""One way to label all dots of a frame with rays, and what speaks against it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import product
from typing import Literal

import numpy as np
import scipy

from labapp.core.match import Orientation, ways
from labapp.core.matching.ray_growth import (
    CLEAR,
    FALSE_PER_MM2,
    UNLABELLED,
    Prediction,
    Scene,
    amid,
    as_likely_false,
    grow_labels,
    lines_out_of_view,
    neighbours_of,
    predict,
    surprises,
    try_fit,
    widened,
)
from labapp.core.rows.lattice import Lattice, Site
from labapp.core.surface.pool_fit import FitSettings, FittedPool, Level
from labapp.core.values import BoolArray, CannotMeasure, IntArray, median

MODEL_MM = 0.045
"""How far the right surface's dots may be off for no fault of theirs, mm: what the knots of the fit
leave of a dent."""

FOLLOWING = FitSettings(settled_mm=1e-3)
FINE, STANDING_OUT = replace(FOLLOWING, knot_mm=0.5), replace(FOLLOWING, knot_mm=1.0)
"""Of the surface that a hypothesis is weighed with: fine enough for a dip under the torch; for a
narrow one, whose residuals would hide what is unexplained; or so wide that a row which somebody
shifted stands out."""

BEYOND, FEW = 0.25, 2
"""A lit ray is beyond the boundary when it lands so far outside, in spacings of the rays; so many
of them are put down to false dots."""

STRAY, MISSED, LIT_MARKER = 16.0, 12.0, 60.0
"""What a dot without a ray, a ray without its dot amid the others, and a dot where the marker's
absent ray would make one, cost in units of χ². The last is rarely a false dot: labels a row or a
column off put one there nearly always."""

RIM_MM, MOST_BOUNDARY = 0.01, 60.0
"""How far the set-up may be off at the boundary, as height, mm; and the most that rays near the
boundary may cost a hypothesis, in units of χ²."""

Marker = Literal["dark", "lit", "unknown"]
"""What shows where the marker's absent ray would make its dot: nothing amid labelled rays, a dot,
or nothing where nothing need be seen."""

CONTESTED = 0.5
"""A label is in doubt where a rival is nearer than this, in spacings of the dots."""


@dataclass(frozen=True)
class Hypothesis:
    """Labels, the surface fitted to them, and what that leaves unexplained.

    Parameters
    ----------
    labels
        Index of each ray's dot or `UNLABELLED`, shape (rows, columns).
    pool
        The surface.
    witness
        See `Match.witness`.
    unseen, strays
        Rays amid the others that have no dot; indices of the dots that have no ray.
    marker
        What shows at the marker's absent ray; None if the pattern has no marker.
    unlit_cost
        χ² of the dots, what the rays near the boundary have against it, `STRAY` and `MISSED`.
    """

    labels: IntArray
    pool: FittedPool
    witness: IntArray
    unseen: Prediction
    strays: IntArray
    marker: Marker | None
    unlit_cost: float

    @property
    def cost(self) -> float:
        """The lower the likelier: `unlit_cost`, and `LIT_MARKER` where a dot is at the marker."""
        return self.unlit_cost + LIT_MARKER * (self.marker == "lit")

    @property
    def stray(self) -> int:
        """How many dots have no ray."""
        return len(self.strays)

    @property
    def missed(self) -> int:
        """How many rays amid the others have no dot."""
        return len(self.unseen.at)

    @property
    def count(self) -> int:
        """How many dots have a ray."""
        return int(np.sum(self.labels != UNLABELLED))

    @property
    def residual_mm(self) -> float:
        """Root mean square distance of computed from captured dots, mm."""
        return self.pool.residual_rms_mm

    def orientation(self, scene: Scene) -> Orientation:
        """Say which correspondence the labels amount to."""
        at = np.argwhere(self.labels != UNLABELLED)
        place = np.full((*self.labels.shape, 2), np.nan)
        place[at[:, 0], at[:, 1]] = scene.plane_mm[self.labels[at[:, 0], at[:, 1]]]
        if np.nansum(np.sign(np.diff(place[..., 1], axis=0))) >= 0:
            return "S/S"
        return "S/I" if np.nansum(np.sign(np.diff(place[..., 0], axis=1))) >= 0 else "I/I"


def grow_and_score(
    scene: Scene, labels: IntArray, settings: FitSettings = FOLLOWING
) -> Hypothesis | None:
    """Follow labels to where the surface leads, and weigh what comes of it."""
    grown = grow_labels(scene, labels)
    hypothesis = None if grown is None else weigh(scene, grown, settings)
    if hypothesis is None:
        return None
    outside = _outside(scene, hypothesis)
    # Many lit rays beyond the contour are a rear that lies low; one or two are false dots.
    if not 0 < len(outside) <= FEW:
        return hypothesis
    labels = hypothesis.labels.copy()
    labels[outside[:, 0], outside[:, 1]] = UNLABELLED
    return weigh(scene, labels, settings)


def _outside(scene: Scene, hypothesis: Hypothesis) -> IntArray:
    """Labelled rays that landed well beyond where all the others put the boundary."""
    at = np.argwhere(hypothesis.labels != UNLABELLED)
    x, y = scene.landing_mm[at[:, 0], at[:, 1], :2].T
    surface, level = hypothesis.pool.surface, hypothesis.pool.level
    slope = surface.gradient(x, y)
    rise = np.linalg.norm(slope * scene.spacing_mm, axis=-1)
    over = surface.height(x, y) - level.rear.height(y)
    return np.asarray(at[level.sign * over < -BEYOND * rise])


def weigh(
    scene: Scene,
    labels: IntArray,
    settings: FitSettings = FOLLOWING,
    near: FittedPool | None = None,
) -> Hypothesis | None:
    """Fit the surface to labels as they are and count what speaks against them.

    A surface that is near saves rounds of the fit.
    """
    pool = try_fit(scene, labels, near=near)
    if pool is None:
        return None
    try:
        pool = scene.fit(labels, _witness(scene, labels, pool), settings, pool)
    except CannotMeasure:
        return None
    unseen, stray, marker, cost = _misfit(scene, labels, pool)
    witness = _witness(scene, labels, pool)
    cost += _boundary_cost(pool.level)
    return Hypothesis(labels, pool, witness, unseen, stray, marker, cost)


def rough_costs(scene: Scene, labels: IntArray, pool: FittedPool) -> tuple[float, float]:
    """What `weigh` would call unlit cost and cost of labels, with a surface as it is.

    The rays near the boundary have no say in it: that needs no further fit.
    """
    _, _, marker, cost = _misfit(scene, labels, pool)
    return cost, cost + LIT_MARKER * (marker == "lit")


def _misfit(
    scene: Scene, labels: IntArray, pool: FittedPool
) -> tuple[Prediction, IntArray, Marker | None, float]:
    """Rays without a dot, dots without a ray, the marker, and χ² with `STRAY` and `MISSED`."""
    lit = labels != UNLABELLED
    unseen, stray = _unexplained(scene, labels, pool)
    marker = _marker(scene, lit, pool)
    variance = scene.covariance_mm2[labels[lit]].trace(axis1=-2, axis2=-1) / 2 + MODEL_MM**2
    surprise = np.minimum(np.sum(pool.residual_mm**2, axis=-1) / variance, STRAY)
    cost = float(surprise.sum()) + STRAY * len(stray) + MISSED * len(unseen.at)
    return unseen, stray, marker, cost


def _boundary_cost(level: Level) -> float:
    """−2 log likelihood of which rays near the boundary are lit, as far as the set-up is known.

    Its errors tilt the surface: of a shallow pool the boundary then says little, and where the
    rays contradict any level, it may be for the set-up.
    """
    share = level.rise_mm**2 / (level.rise_mm**2 + RIM_MM**2)
    return min(2 * share * level.negative_log_likelihood, MOST_BOUNDARY)


def _marker(scene: Scene, lit: BoolArray, pool: FittedPool) -> Marker | None:
    """Look where the marker's absent ray would make its dot."""
    site = scene.rig.pattern.marker
    if site is None:
        return None
    at = (site[0] - 1, site[1] - 1)
    around = np.zeros_like(lit)
    around[max(at[0] - 1, 0) : at[0] + 2, max(at[1] - 1, 0) : at[1] + 2] = True
    predicted = predict(scene, pool, around)
    own = (predicted.at == at).all(axis=-1)
    if not own.any():
        return "unknown"
    place, spacing = predicted.plane_mm[own][0], predicted.spacing_mm[own][0]
    if np.linalg.norm(scene.plane_mm - place, axis=-1).min() < spacing / 3:
        return "lit"
    return "dark" if amid(lit)[at] else "unknown"


def contested(scene: Scene, hypothesis: Hypothesis) -> IntArray:
    """Return the labelled dots next to a dot without a ray, or to where a ray lacks its dot.

    Either may be the right pair there. Indices of dots.
    """
    labels = hypothesis.labels
    dots = labels[labels != UNLABELLED]
    rivals = np.concatenate([hypothesis.unseen.plane_mm, scene.plane_mm[hypothesis.strays]])
    if len(rivals) == 0 or len(dots) < 2:
        return np.zeros(0, np.int64)
    spacing = median(
        scipy.spatial.cKDTree(scene.plane_mm[dots]).query(scene.plane_mm[dots], k=2)[0][:, 1]
    )
    near = scipy.spatial.cKDTree(rivals).query(scene.plane_mm[dots])[0] < CONTESTED * spacing
    return np.asarray(dots[near])


def without_false_ends(
    scene: Scene, hypothesis: Hypothesis, settings: FitSettings = FOLLOWING
) -> Hypothesis:
    """Take labels away that alone put a dark ray amid the lit ones, as far as that costs less.

    Beyond the last row a false dot may lie where a ray's should.
    """
    lit = hypothesis.labels != UNLABELLED
    fewer = []
    for at in {at for ray in hypothesis.unseen.at.tolist() for at in _alone_around(lit, ray)}:
        labels = hypothesis.labels.copy()
        labels[at] = UNLABELLED
        fewer.append(weigh(scene, labels, settings, near=hypothesis.pool))
    best = min((h for h in fewer if h), key=lambda h: h.cost, default=hypothesis)
    if best.cost >= hypothesis.cost:
        return hypothesis
    return without_false_ends(scene, best, settings)


WEAK, LIKELIER = 3, 2 * np.log(10)
"""A label with so few labelled neighbours rests on what lies to one side of it. Its ray is to be so
much likelier than a false dot, in units of −2 log likelihood: beyond the last row most are dark."""


def without_false_rim(
    scene: Scene, hypothesis: Hypothesis, settings: FitSettings = FOLLOWING
) -> Hypothesis:
    """Take labels at the rim away that a false dot explains as well as their ray.

    Each weak label is held against the surface through all that are not weak. How many false dots
    there are, those without a ray tell.
    """
    lit = hypothesis.labels != UNLABELLED
    weak = lit & (neighbours_of(lit) <= WEAK)
    if not weak.any():
        return hypothesis
    strong = np.where(weak, UNLABELLED, hypothesis.labels)
    pool = try_fit(scene, strong, settings, hypothesis.pool)
    if pool is None:
        return hypothesis
    rays = predict(scene, pool, weak)
    surprise = surprises(scene, pool, rays, hypothesis.labels[tuple(rays.at.T)])[1].diagonal()
    false_per_mm2 = max(FALSE_PER_MM2, (hypothesis.stray + 1) / scene.view_mm2)
    certain = surprise + CLEAR + LIKELIER < as_likely_false(false_per_mm2)
    kept = strong.copy()
    at = tuple(rays.at[certain].T)
    kept[at] = hypothesis.labels[at]
    if (kept == hypothesis.labels).all():
        return hypothesis
    return weigh(scene, kept, settings, near=hypothesis.pool) or hypothesis


def _alone_around(lit: BoolArray, ray: list[int]) -> list[tuple[int, int]]:
    """Lit rays, counted from 0, that alone put a dark ray amid the lit ones."""
    i, j = ray
    across = [np.flatnonzero(lit[i, :j]), np.flatnonzero(lit[i, j + 1 :]) + j + 1]
    along = [np.flatnonzero(lit[:i, j]), np.flatnonzero(lit[i + 1 :, j]) + i + 1]
    if min(map(len, across)) and min(map(len, along)):
        return []
    row = [(i, int(side[0])) for side in across if len(side) == 1 and min(map(len, across))]
    column = [(int(side[0]), j) for side in along if len(side) == 1 and min(map(len, along))]
    return row + column


def from_grid(
    lattice: Lattice, hole: Site, ray: Site, orientation: Orientation, shape: tuple[int, int]
) -> IntArray:
    """Label the whole grid with one of its sites taken for an absent ray's."""
    dot = np.nonzero(lattice.row > 0)[0]
    site = np.stack([lattice.row[dot], lattice.column[dot]], axis=-1)
    return _labelled(np.array(ray) + (site - hole) * ways(orientation), dot, shape)


def joined(hypothesis: Hypothesis, lattice: Lattice, orientation: Orientation) -> IntArray | None:
    """Labels for the whole grid where the rays found so far agree with it; None if they do not."""
    labels = hypothesis.labels
    at = np.argwhere(labels != UNLABELLED)
    dot = labels[at[:, 0], at[:, 1]]
    site = np.stack([lattice.row, lattice.column], axis=-1)
    indexed = site[dot, 0] > 0
    offset = (at + 1 - site[dot] * ways(orientation))[indexed]
    if len(offset) == 0:
        return None
    kinds, count = np.unique(offset, axis=0, return_counts=True)
    if count.max() < 0.8 * len(offset):
        return None
    on_grid = np.nonzero(site[:, 0] > 0)[0]
    ray = site[on_grid] * ways(orientation) + kinds[np.argmax(count)]
    grid = _labelled(ray, on_grid, labels.shape)
    others = np.where(np.isin(labels, on_grid), UNLABELLED, labels)
    return np.where(grid != UNLABELLED, grid, others)


def moved(scene: Scene, labels: IntArray) -> Iterator[IntArray]:
    """Yield the same labels up to two rows or columns on: what a single frame tells worst."""
    at = np.argwhere(labels != UNLABELLED)
    dot = labels[at[:, 0], at[:, 1]]
    for step in (
        way for way in product(range(-2, 3), repeat=2) if 0 < abs(way[0]) + abs(way[1]) < 3
    ):
        shifted = _labelled(at + 1 + step, dot, labels.shape)
        shifted[scene.absent] = UNLABELLED
        yield shifted


def turned(scene: Scene, labels: IntArray, before: Orientation, after: Orientation) -> IntArray:
    """Label the same dots the other way round the absent ray."""
    at = np.argwhere(labels != UNLABELLED)
    center = np.array(scene.rig.pattern.marker or scene.rig.pattern.reference)
    ray = center + (at + 1 - center) * ways(before) * ways(after)
    return _labelled(ray, labels[at[:, 0], at[:, 1]], labels.shape)


def _labelled(ray: IntArray, dot: IntArray, shape: tuple[int, ...]) -> IntArray:
    there = ((ray >= 1) & (ray <= shape)).all(axis=-1)
    labels = np.full(shape, UNLABELLED, np.int64)
    labels[ray[there, 0] - 1, ray[there, 1] - 1] = dot[there]
    return labels


def _unexplained(scene: Scene, labels: IntArray, pool: FittedPool) -> tuple[Prediction, IntArray]:
    """Find rays that should have a dot and have none, and the indices of dots that have no ray.

    Where the surface lets dots run into each other there is nothing to be told of either.
    """
    lit = labels != UNLABELLED
    among = predict(scene, pool, amid(lit) & ~scene.absent & ~scene.hidden)
    merged = among.spacing_mm < scene.resolution_mm
    silent = ~lit[tuple(among.at.T)] & ~merged & ~among.blocked(scene)
    unseen = among.part(silent & scene.in_view(among.plane_mm))
    stray = np.setdiff1d(np.arange(len(scene.plane_mm)), labels[lit])
    if merged.any() and len(stray):
        off = np.asarray(
            scipy.spatial.cKDTree(among.plane_mm[merged]).query(scene.plane_mm[stray])[0]
        )
        stray = stray[off > scene.resolution_mm]
    return unseen, stray


def _witness(scene: Scene, labels: IntArray, pool: FittedPool) -> IntArray:
    """Say which rays came back, which did not, and which cannot tell (see `Match.witness`)."""
    lit = labels != UNLABELLED
    witness = np.zeros(lit.shape, np.int64)
    around = predict(scene, pool, np.ones_like(lit))
    merged = around.spacing_mm < scene.resolution_mm
    seen = scene.in_view(around.plane_mm) & ~around.blocked(scene) & ~merged
    witness[around.at[seen, 0], around.at[seen, 1]] = -1
    witness[amid(lit) | scene.absent | scene.hidden] = 0
    witness[lit] = 1
    # A dot that no ray was given may be the dot of a ray that seems dark.
    stray = np.setdiff1d(np.arange(len(scene.plane_mm)), labels[lit])
    if len(stray):
        distance = scipy.spatial.cKDTree(scene.plane_mm[stray]).query(around.plane_mm)[0]
        doubt = around.at[distance < around.spacing_mm]
        doubt = doubt[witness[doubt[:, 0], doubt[:, 1]] < 0]
        witness[doubt[:, 0], doubt[:, 1]] = 0
    return witness


def certain_witness(scene: Scene, hypothesis: Hypothesis) -> IntArray:
    """The witness of a hypothesis without rows that are dark but may have left the view.

    Beside the last row that is seen the fit goes on as smoothly as it can, while a pool's edge
    grows steep: the dots of the next row may lie farther out than they are predicted.
    """
    pool, dark = hypothesis.pool, hypothesis.witness < 0
    rim = predict(scene, pool, dark & widened(hypothesis.labels != UNLABELLED, 1))
    lost = lines_out_of_view(
        scene,
        rim.at,
        rim.plane_mm,
        lambda some: rim.part(some).covariance_mm2(pool, scene.rig),
    )
    return np.where(lost, 0, hypothesis.witness)
