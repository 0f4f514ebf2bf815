"""What a hypothesis leads to where its labels are mended: swapped, jumped or left out rows."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import scipy

from labapp.core.matching.hypothesis import FEW, Hypothesis, grow_and_score
from labapp.core.matching.ray_growth import (
    AS_LIKELY_FALSE,
    NEAR,
    UNLABELLED,
    Scene,
    predict,
    surprises,
    widened,
    within_rings,
)
from labapp.core.values import BoolArray, IntArray

REPAIRED = 2
"""So many rings of labels round what is unexplained are discarded and assigned again."""

MIDDLE = 0.25
"""A dot is in the middle between two that are so many times as far from each other."""

LEAST_ROW, MOST_BEYOND = 3, 0.6
"""A dot or two beyond the last row may be false; so many where one surface has them are not. If a
larger share of all dots than that is left over, it is not for a row that was not reached."""


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
        off = scipy.spatial.cKDTree(strays).query((ends[0] + ends[1]) / 2)[0]
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
        nearest = rays.at[scipy.spatial.cKDTree(rays.plane_mm).query(scene.plane_mm[stray])[1]]
        about[nearest[:, 0], nearest[:, 1]] = True
    if not about.any():
        return about
    return widened(about, REPAIRED)


def with_rows_beyond(scene: Scene, found: list[Hypothesis]) -> list[Hypothesis]:
    """Add what the cheapest hypotheses lead to if a row that growth did not reach is begun.

    Beyond the last row a surface may be so uncertain that several rays come into question for
    every dot there; then `grow_labels` gives none of them a ray. Here each is tried, and what has
    come of it is a hypothesis to be held against the others: a row given to the wrong rays costs
    the dots of the rays that it jumps, or costs nearly as much as another hypothesis.
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
