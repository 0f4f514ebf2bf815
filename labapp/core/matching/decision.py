"""Which of the hypotheses about a frame's rays stands, and whether any does."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Literal

import cv2
import numpy as np
import scipy

from labapp.core.match import ORIENTATIONS, Orientation
from labapp.core.matching.hypothesis import (
    FINE,
    FOLLOWING,
    MISSED,
    MODEL_MM,
    STRAY,
    Hypothesis,
    contested,
    grow_and_score,
    moved,
    rough_costs,
    turned,
    weigh,
    without_false_ends,
    without_false_rim,
)
from labapp.core.matching.ray_growth import QUICK, UNLABELLED, Scene, try_fit
from labapp.core.surface.pool_fit import FitSettings, FittedPool
from labapp.core.values import CannotMeasure, IntArray, median

MISFIT_MM, MISFIT_TIMES = 0.15, 3.0
"""Labels that leave larger residuals, mm, and so many times those of the best, are not followed:
with wrong rays they are mostly ten times those with the right ones."""


MOST_LEFT = 0.5
"""With a larger share of the dots left over, a hypothesis is not mended but another one looked
for."""


@dataclass(frozen=True)
class MatchSettings:
    """How the correspondence is decided.

    Parameters
    ----------
    correspondence
        ``auto`` tries every orientation; otherwise the one to use.
    margin
        Two hypotheses whose costs differ by less, in units of χ², cannot be told apart.
    stray, missed
        Dots without a ray, and rays without a dot amid the others, that are put up with: a number
        and a share.
    """

    correspondence: Literal["auto", "S/S", "S/I", "I/I"] = "auto"
    margin: float = 14.0
    stray: tuple[int, float] = (4, 0.02)
    missed: tuple[int, float] = (2, 0.06)

    @property
    def orientations(self) -> tuple[Orientation, ...]:
        """Those to be tried."""
        return ORIENTATIONS if self.correspondence == "auto" else (self.correspondence,)

    def most_strays(self, hypothesis: Hypothesis) -> float:
        """Return how many dots without a ray are put up with, wherever they lie."""
        return self.stray[0] + self.stray[1] * (hypothesis.count + hypothesis.stray)

    def leaves_much(self, hypothesis: Hypothesis) -> bool:
        """Whether more is left unexplained than is put up with wherever it lies."""
        most_missed = self.missed[0] + self.missed[1] * hypothesis.count
        return hypothesis.stray > self.most_strays(hypothesis) or hypothesis.missed > most_missed


def explains(scene: Scene, hypothesis: Hypothesis) -> bool:
    """Hardly a dot is left over, few are missing and lie apart, and none is where the marker is."""
    few = max(2, 0.05 * len(scene.plane_mm))
    most = MISSED_APART * hypothesis.count if _missed_lie_apart(hypothesis) else 0.0
    missed = hypothesis.missed <= max(few, most)
    return hypothesis.stray <= few and missed and hypothesis.marker != "lit"


def nearly_explains(scene: Scene, hypothesis: Hypothesis) -> bool:
    """Most dots have their ray: what is left may be a row, or a dip."""
    return hypothesis.stray <= MOST_LEFT * len(scene.plane_mm)


def any_explains(scene: Scene, found: list[Hypothesis]) -> bool:
    """Whether one of several hypotheses does."""
    return any(explains(scene, hypothesis) for hypothesis in found)


def decide(scene: Scene, found: list[Hypothesis], settings: MatchSettings) -> Hypothesis:
    """Take the cheapest hypothesis, if nothing else comes near it and it leaves little open.

    It is held against the others and against itself up to two rows or columns further on: a
    hypothesis that was followed from the wrong hole may lead to almost the right place.
    """
    best, found, neighbours, knots = _cheapest(scene, found, settings.margin)
    best = without_false_rim(scene, without_false_ends(scene, best, knots), knots)
    if knots is FINE:
        best = _judged(scene, best.labels, knots, best.pool) or best
    _refuse_unexplained(scene, best, settings)
    own = best.orientation(scene)
    if best.marker == "lit":
        others_explain = any_explains(scene, [h for h in found if h.marker == "dark"])
        raise CannotMeasure(
            "ambiguous-rows" if others_explain else "no-reference",
            "where the best rows have the absent centre dot, there is a dot",
        )
    if best.marker == "unknown":
        raise CannotMeasure(
            "no-reference", "the absent centre dot is not amid dots that have their ray"
        )
    doubtful: list[int] = contested(scene, best).tolist()
    others = (turned(scene, best.labels, own, way) for way in settings.orientations if way != own)
    for other in [*found, *neighbours, *_rivals(scene, best, others, knots)]:
        if _stands_against(scene, best, other, knots, settings):
            continue
        differing, shared = _differing(best, other)
        if len(differing) <= 0.2 * shared:
            doubtful += differing
        elif other.orientation(scene) != own:
            raise CannotMeasure(
                "ambiguous-orientation",
                f"{own} and {other.orientation(scene)} explain the dots alike",
            )
        else:
            raise CannotMeasure(
                "ambiguous-rows", "several holes in the rows can be the absent centre dot"
            )
    if doubtful:
        certain = np.where(np.isin(best.labels, doubtful), UNLABELLED, best.labels)
        witness = np.where(certain == best.labels, best.witness, 0)
        best = replace(weigh(scene, certain, knots, near=best.pool) or best, witness=witness)
    return best


def _cheapest(
    scene: Scene, found: list[Hypothesis], margin: float
) -> tuple[Hypothesis, list[Hypothesis], list[Hypothesis], FitSettings]:
    """Return the cheapest hypothesis, those found, its neighbours, and the knots they all have."""
    best = min(found, key=lambda hypothesis: hypothesis.cost)
    knots = FOLLOWING
    neighbours: list[Hypothesis] = []
    if best.stray or best.missed:
        neighbours = _rivals(scene, best, moved(scene, best.labels), knots)
    # What these knots leave of a dip may decide between rivals so near.
    near = any(rival.cost < best.cost + INFLATED for rival in neighbours)
    if near or best.residual_mm > MODEL_MM:
        knots, neighbours = FINE, []
        found = [h for each in found if (h := _judged(scene, each.labels, knots, each.pool))]
        best = min(found, key=lambda hypothesis: hypothesis.cost, default=best)
    if not neighbours and not _beyond_doubt(scene, best, margin):
        best, neighbours = _with_neighbours(scene, best, knots)
    if knots is FINE:  # what takes labels away compares costs of these knots alone
        best = weigh(scene, best.labels, knots, near=best.pool) or best
    return best, found, neighbours, knots


def _refuse_unexplained(scene: Scene, best: Hypothesis, settings: MatchSettings) -> None:
    """Raise `CannotMeasure` where too much is left unexplained, or it may be a row."""
    # Missed rays side by side are a hole or a row: then so many dots without a ray may be theirs.
    scattered = (
        best.marker == "dark"
        and _missed_lie_apart(best)
        and (best.stray <= settings.most_strays(best) or _strays_lie_apart(scene, best))
        and best.stray + best.missed <= SCATTERED * best.count
    )
    if not scattered and settings.leaves_much(best):
        raise CannotMeasure(
            "no-match",
            f"the best surface leaves {_counted(best.stray, 'dot')} without a ray and "
            f"{_counted(best.missed, 'ray')} without a dot amid {best.count} pairs",
        )
    if best.pool.level.rays and best.pool.level.disagreement > CONTRADICTED_BITS:
        raise CannotMeasure(
            "no-match",
            "no boundary of the best surface has the rays that came back inside and the others "
            "outside: is the set-up right?",
        )


CONTRADICTED_BITS = 0.5
"""Mean surprise of a ray near the boundary above which the surface is not the pool's: less than 0.3
even where the set-up is a little off, more than 1 where labels are wrong for that."""

INFLATED = 40.0
"""What a dip under the torch, or dots that labels a row on have not yet found, add to a cost."""


def _stands_against(
    scene: Scene, best: Hypothesis, other: Hypothesis, knots: FitSettings, settings: MatchSettings
) -> bool:
    """Whether the best costs less by a margin; with fine knots, less by either, by one clearly.

    A false dot may lie at the marker: what costs less but for that is a rival.
    """
    if other.unlit_cost < best.unlit_cost:
        return False
    if other.cost >= best.cost + settings.margin:
        return True
    if knots is not FINE:
        return False
    ahead = []
    for each in (FINE, FOLLOWING):
        own, rival = (weigh(scene, h.labels, each, near=h.pool) for h in (best, other))
        if own is None or rival is None:
            return False
        ahead.append(rival.cost - own.cost)
    # With the set-up off and many false dots, wrong rows were ahead by more than one margin.
    clearly = (2 if settings.leaves_much(best) else 1) * settings.margin
    return min(ahead) >= 0 and max(ahead) >= clearly


def _beyond_doubt(scene: Scene, best: Hypothesis, margin: float) -> bool:
    """Whether nothing is left unexplained, so that no shift of the labels can come near.

    Any shift puts a dot on the marker's absent ray and leaves the hole to a ray without a dot.
    """
    if best.stray or best.missed or best.marker != "dark":
        return False
    fine = weigh(scene, best.labels, FINE, near=best.pool)
    return fine is not None and fine.cost + margin < STRAY + MISSED


def _with_neighbours(
    scene: Scene, best: Hypothesis, knots: FitSettings
) -> tuple[Hypothesis, list[Hypothesis]]:
    """Return what a hypothesis leads to if one a row or two on is cheaper; and its neighbours.

    One that comes near is followed first: moved, it may lack dots at its ends.
    """
    while True:  # each round is cheaper than the one before
        neighbours = _rivals(scene, best, moved(scene, best.labels), knots)
        near = [each.labels for each in neighbours if each.cost < best.cost + INFLATED]
        grown = [h for labels in near if (h := grow_and_score(scene, labels, knots))]
        grown = [h for each in grown if (h := _judged(scene, each.labels, knots, each.pool))]
        better = min(grown, key=lambda h: h.cost, default=best)
        if better.cost >= best.cost:
            return best, neighbours + grown
        best = better


FAR_OFF = 4.0
"""Labels whose quick surface leaves so many times the residual of the best's are no rivals: those
that came near, of 700 beside 160 pools with a dip, left less than 2.5 times as much."""

FAR_WORSE = 30.0
"""With rough surfaces, labels that cost more than the best by so much, and by `INFLATED` besides
where the marker counts, do not come near it with settled ones."""


def _rivals(
    scene: Scene, best: Hypothesis, labelled: Iterable[IntArray], knots: FitSettings
) -> list[Hypothesis]:
    """Weigh other labels beside a hypothesis, as far as they may come near it.

    A surface has to go through their dots as well; with wide knots they have to explain nearly as
    much with a rough surface. (With fine ones there is a dip, of which that leaves too much.)
    """
    most_mm = max(MISFIT_MM, MISFIT_TIMES * best.residual_mm)
    quick = try_fit(scene, best.labels, QUICK, best.pool)
    rough = try_fit(scene, best.labels, near=best.pool)
    far_mm = np.inf if quick is None else FAR_OFF * quick.residual_rms_mm
    own = None if rough is None or knots is FINE else rough_costs(scene, best.labels, rough)
    rivals = []
    for labels in labelled:
        sketch = try_fit(scene, labels, QUICK, best.pool)
        if sketch is None or sketch.residual_rms_mm > far_mm:
            continue
        pool = try_fit(scene, labels, near=best.pool)
        if pool is None or pool.residual_rms_mm >= most_mm:
            continue
        if own is not None:
            unlit, cost = rough_costs(scene, labels, pool)
            if unlit > own[0] + FAR_WORSE and cost > own[1] + FAR_WORSE + INFLATED:
                continue
        hypothesis = _judged(scene, labels, knots, pool)
        rivals += [] if hypothesis is None else [hypothesis]
    return rivals


def _judged(
    scene: Scene, labels: IntArray, knots: FitSettings, near: FittedPool
) -> Hypothesis | None:
    """Weigh labels; with fine knots the cost is the mean of that and of the cost with wide ones.

    Wide knots leave much of a dip, fine ones let wrong labels have the rough surface they need: a
    marker that either has lit is lit.
    """
    own = weigh(scene, labels, knots, near=near)
    if own is None or knots is not FINE:
        return own
    wide = weigh(scene, labels, FOLLOWING, near=near)
    if wide is None:
        return None
    marker = "lit" if wide.marker == "lit" else own.marker
    return replace(own, marker=marker, unlit_cost=(own.unlit_cost + wide.unlit_cost) / 2)


PAIR, BESIDE = 2, 1.5
"""So many missed rays, or dots without a ray, side by side are no row; dots are where they are
nearer to one another than so many spacings."""

SCATTERED, MISSED_APART = 0.3, 0.12
"""Where dots without a ray and missed rays lie apart, so many of both, as a share of the dots with
a ray, are put up with: false dots lie apart, and those that fail at random; dots of a row that was
left out or jumped do not. With so many missed rays no other hypothesis is looked for."""


def _missed_lie_apart(hypothesis: Hypothesis) -> bool:
    """Whether the rays without a dot are scattered."""
    seen = np.zeros(hypothesis.labels.shape, np.uint8)
    seen[tuple(hypothesis.unseen.at.T)] = 1
    sizes = cv2.connectedComponentsWithStats(seen, connectivity=4)[2][1:, cv2.CC_STAT_AREA]
    return bool((sizes <= PAIR).all())


def _strays_lie_apart(scene: Scene, hypothesis: Hypothesis) -> bool:
    """Whether the dots without a ray are scattered."""
    dots = scene.plane_mm[hypothesis.labels[hypothesis.labels != UNLABELLED]]
    spacing = median(scipy.spatial.cKDTree(dots).query(dots, k=2)[0][:, 1])
    strays = scene.plane_mm[hypothesis.strays]
    beside = scipy.spatial.cKDTree(strays).query_ball_point(
        strays, BESIDE * spacing, return_length=True
    )
    return bool((beside <= PAIR).all())


def _differing(one: Hypothesis, other: Hypothesis) -> tuple[list[int], int]:
    """Dots that have different rays in the two, and how many have a ray in both."""
    rays = [{int(dot): at for at, dot in np.ndenumerate(h.labels)} for h in (one, other)]
    shared = rays[0].keys() & rays[1].keys() - {UNLABELLED}
    return [dot for dot in shared if rays[0][dot] != rays[1][dot]], len(shared)


def _counted(count: int, thing: str) -> str:
    return f"{count} {thing}{'s' * (count != 1)}"
