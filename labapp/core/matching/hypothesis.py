"""One way to label all dots of a frame with rays, and what speaks against it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import product
from typing import Literal

import numpy as np
from scipy.spatial import cKDTree

from labapp.core.match import Orientation, ways
from labapp.core.matching.ray_growth import (
    AS_LIKELY_FALSE,
    CLEAR,
    FALSE_PER_MM2,
    NEAR,
    UNLABELLED,
    Prediction,
    Scene,
    amid,
    as_likely_false,
    grow_labels,
    neighbours_of,
    predict,
    surprises,
    try_fit,
    widened,
    within_rings,
)
from labapp.core.rows.lattice import Lattice, Site
from labapp.core.surface.pool_fit import FitSettings, FittedPool
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

Marker = Literal["dark", "lit", "unknown"]
"""What shows where the marker's absent ray would make its dot: nothing amid labelled rays, a dot,
or nothing where nothing need be seen."""

CONTESTED = 0.5
"""A label is in doubt where a rival is nearer than this, in spacings of the dots."""

REPAIRED = 2
"""So many rings of labels round what is unexplained are discarded and assigned again."""

MIDDLE = 0.25
"""A dot is in the middle between two that are so many times as far from each other."""

LEAST_ROW, MOST_BEYOND = 3, 0.6
"""A dot or two beyond the last row may be false; so many where one surface has them are not. If a
larger share of all dots than that is left over, it is not for a row that was not reached."""


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
    cost
        χ² of the dots, plus `STRAY`, `MISSED` and `LIT_MARKER` for those.
    """

    labels: IntArray
    pool: FittedPool
    witness: IntArray
    unseen: Prediction
    strays: IntArray
    marker: Marker | None
    cost: float

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
    def misfit(self) -> float:
        """χ² of the dots alone."""
        lit = LIT_MARKER * (self.marker == "lit")
        return self.cost - STRAY * self.stray - MISSED * self.missed - lit

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
    lit = labels != UNLABELLED
    unseen, stray = _unexplained(scene, labels, pool)
    marker = _marker(scene, lit, pool)
    variance = scene.covariance_mm2[labels[lit]].trace(axis1=-2, axis2=-1) / 2 + MODEL_MM**2
    surprise = np.minimum(np.sum(pool.residual_mm**2, axis=-1) / variance, STRAY)
    cost = float(surprise.sum()) + STRAY * len(stray) + MISSED * len(unseen.at)
    cost += LIT_MARKER * (marker == "lit")
    witness = _witness(scene, labels, pool)
    return Hypothesis(labels, pool, witness, unseen, stray, marker, cost)


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
    spacing = median(cKDTree(scene.plane_mm[dots]).query(scene.plane_mm[dots], k=2)[0][:, 1])
    near = cKDTree(rivals).query(scene.plane_mm[dots])[0] < CONTESTED * spacing
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


def with_repaired(scene: Scene, found: list[Hypothesis]) -> list[Hypothesis]:
    """Add what the cheapest leads to without its labels round what it leaves unexplained.

    Where rows cross in a dip, growth may swap them; the swapped labels then bend the surface and
    hold each other up. The surface through the labels round about knows better.
    """
    best = min(found, key=lambda hypothesis: hypothesis.cost, default=None)
    while best is not None:
        labels = np.where(_about_unexplained(scene, best), UNLABELLED, best.labels)
        tried = [labels] if (labels != best.labels).any() else []
        tried += [*_closed_up(best), *_opened_up(scene, best)]
        led = [h for labels in tried if (h := grow_and_score(scene, labels))]
        cheapest = min(led, key=lambda hypothesis: hypothesis.cost, default=best)
        best = cheapest if cheapest.cost < best.cost else None
        found = found if best is None else [*found, best]
    return found


def _closed_up(hypothesis: Hypothesis) -> Iterator[IntArray]:
    """Yield the labels with a row or column that was jumped closed up, from either side.

    It is one in which most of the rays without a dot lie.
    """
    labels = hypothesis.labels
    for axis in (0, 1):
        lines, missed = np.unique(hypothesis.unseen.at[:, axis], return_counts=True)
        for line in lines[missed >= max(LEAST_ROW, 0.5 * hypothesis.missed)]:
            own = labels if axis == 0 else labels.T
            after, before = np.full_like(own, UNLABELLED), np.full_like(own, UNLABELLED)
            after[:line], after[line:-1] = own[:line], own[line + 1 :]
            before[line + 1 :], before[1 : line + 1] = own[line + 1 :], own[:line]
            yield from (after, before) if axis == 0 else (after.T.copy(), before.T.copy())


def _opened_up(scene: Scene, hypothesis: Hypothesis) -> Iterator[IntArray]:
    """Yield the labels with room made for a row or column of dots that was left out between two.

    The dots without a ray are in the middle between those of two rays; the shorter side moves on.
    """
    labels, strays = hypothesis.labels, scene.plane_mm[hypothesis.strays]
    for axis in (0, 1) if len(strays) else ():
        own = labels if axis == 0 else labels.T
        line, place = np.nonzero((own[:-1] != UNLABELLED) & (own[1:] != UNLABELLED))
        ends = scene.plane_mm[own[line, place]], scene.plane_mm[own[line + 1, place]]
        apart = np.linalg.norm(ends[1] - ends[0], axis=-1)
        off = cKDTree(strays).query((ends[0] + ends[1]) / 2)[0]
        lines, between = np.unique(line[off < MIDDLE * apart], return_counts=True)
        for k in lines[between >= FEW]:
            wider = np.full_like(own, UNLABELLED)
            if np.sum(own[: k + 1] != UNLABELLED) < np.sum(own[k + 1 :] != UNLABELLED):
                wider[:k], wider[k + 1 :] = own[1 : k + 1], own[k + 1 :]
            else:
                wider[: k + 1], wider[k + 2 :] = own[: k + 1], own[k + 1 : -1]
            yield wider if axis == 0 else wider.T.copy()


def _about_unexplained(scene: Scene, hypothesis: Hypothesis) -> BoolArray:
    """Rays within `REPAIRED` rings of those that lack a dot, or are nearest to a dot without a ray.

    Shape (rows, columns).
    """
    unseen, stray = hypothesis.unseen, hypothesis.strays
    about = np.zeros(hypothesis.labels.shape, bool)
    about[unseen.at[:, 0], unseen.at[:, 1]] = True
    rays = predict(scene, hypothesis.pool, within_rings(hypothesis.labels, 1))
    if len(stray) and len(rays.at):
        nearest = rays.at[cKDTree(rays.plane_mm).query(scene.plane_mm[stray])[1]]
        about[nearest[:, 0], nearest[:, 1]] = True
    if not about.any():
        return about
    return widened(about, REPAIRED)


def with_rows_beyond(scene: Scene, found: list[Hypothesis]) -> list[Hypothesis]:
    """Add what the cheapest hypotheses lead to if a row that growth did not reach is begun.

    Beyond the last row a surface may be so uncertain that several rays come into question for
    every dot there; then `grow_labels` gives none of them a ray. Here each is tried, and what has
    come of it is a hypothesis to be held against the others: a row given to the wrong rays costs
    the dots of the rays that it jumps, or comes too near to another way to be told from it.
    """
    # The cheapest of all, and of those that have the marker dark: all it lacks may be a row.
    groups = (found, [hypothesis for hypothesis in found if hypothesis.marker == "dark"])
    starts = [min(group, key=lambda hypothesis: hypothesis.cost) for group in groups if group]
    for start in starts[:1] + [start for start in starts[1:] if start is not starts[0]]:
        best: Hypothesis | None = start
        while best is not None:
            most = MOST_BEYOND * len(scene.plane_mm)
            wider = _rows_begun(scene, best) if LEAST_ROW <= best.stray <= most else []
            found = [*found, *wider]
            cheapest = min(wider, key=lambda hypothesis: hypothesis.cost, default=best)
            best = cheapest if cheapest.cost < best.cost else None
    return found


def _rows_begun(scene: Scene, hypothesis: Hypothesis, most: int = 8) -> list[Hypothesis]:
    """Give a dot without a ray to each ray that may have made it, and follow where that leads.

    The ``most`` likeliest pairs are tried, less those that another one has led to. One dot can be
    made to fit: `LEAST_ROW` dots more have to find their rays.
    """
    labels = hypothesis.labels
    found: list[Hypothesis] = []
    stray = np.setdiff1d(np.arange(len(scene.plane_mm)), labels)
    beyond = within_rings(labels, 2) & (labels == UNLABELLED) & ~scene.absent
    rays = predict(scene, hypothesis.pool, beyond)
    if len(stray) == 0 or len(rays.at) == 0:
        return found
    distance, surprise = surprises(scene, hypothesis.pool, rays, stray)
    for pair in np.argsort(surprise, axis=None)[:most]:
        dot, ray = (int(k) for k in np.unravel_index(pair, surprise.shape))
        at = tuple(rays.at[ray])
        vague = surprise[dot, ray] > AS_LIKELY_FALSE
        if vague or distance[dot, ray] > NEAR or any(one.labels[at] == stray[dot] for one in found):
            continue
        more = labels.copy()
        more[at] = stray[dot]
        wider = grow_and_score(scene, more)
        if wider is not None and wider.count >= hypothesis.count + LEAST_ROW:
            found.append(wider)
    return found


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
        off = np.asarray(cKDTree(among.plane_mm[merged]).query(scene.plane_mm[stray])[0])
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
        distance = cKDTree(scene.plane_mm[stray]).query(around.plane_mm)[0]
        doubt = around.at[distance < around.spacing_mm]
        doubt = doubt[witness[doubt[:, 0], doubt[:, 1]] < 0]
        witness[doubt[:, 0], doubt[:, 1]] = 0
    return witness
