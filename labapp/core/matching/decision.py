"""Decide which of the hypotheses about a frame's rays stands, or that none does."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Literal

import cv2
import numpy as np
import scipy

from labapp.core.match import ORIENTATIONS, Orientation
from labapp.core.matching.free_setup import FreeHypothesis, holes_left_open
from labapp.core.matching.hypothesis import (
    FINE_KNOTS,
    KNOT_ERROR_MM,
    MISSED_COST,
    STRAY_COST,
    USUAL_KNOTS,
    Hypothesis,
    evaluate,
    evaluate_twice,
    grow_and_evaluate,
    paths_of,
    reoriented_labels,
    rough_costs,
    shifted_labels,
    without_doubtful_outermost,
    without_false_ends,
)
from labapp.core.matching.observation import QUICK, UNLABELLED, Observation, try_fit
from labapp.core.matching.outliers import MOST_LEFT_OUT, FittedLabels, unsupported
from labapp.core.matching.prediction import covariance_of_dots
from labapp.core.matching.ray_classes import RayClasses
from labapp.core.surface.pool_fit import FitSettings
from labapp.core.values import CannotMeasure, IntArray, median

MISFIT_MM, MISFIT_TIMES = 0.15, 3.0
"""Labels that leave larger residuals, mm, and so many times those of the best, are not followed:
with wrong rays they are mostly ten times those with the right ones."""

FEW_LEFT = 0.05
"""With no larger share of the dots left over, and as few missing, a hypothesis explains a frame: no
other is looked for."""

MOST_STRAY = 0.5
"""With a larger share of the dots left over, a hypothesis is not repaired but another one looked
for."""

MOST_DIFFERING = 0.2
"""Where near-equals have other rays for a larger share of the dots, the whole is ambiguous."""

CONTRADICTED_BITS = 0.5
"""Mean surprise of a ray near the boundary above which the surface is not the pool's: less than 0.3
even where the set-up is a little off, more than 1 where labels are wrong for that."""

CLOSE_COST = 40.0
"""A rival whose cost is within this of the cheapest's is looked at closer, in units of χ²: a dip
under the torch, or dots that labels a row on have not yet found, may add as much to a cost."""

QUICK_MISFIT_TIMES = 4.0
"""Labels whose quick surface leaves so many times the residual of the best's are no rivals: those
that came near, of 700 beside 160 pools with a dip, left less than 2.5 times as much."""

FAR_COST = 30.0
"""With rough surfaces, labels that cost more than the best by so much, and by `CLOSE_COST` besides
where the marker counts, do not come near it with settled ones."""

NOTHING_EXPLAINS = "no surface explains the reflected dots"
"""Why there is no match, where not even most of the dots have a ray."""

PAIR, BESIDE_SPACINGS = 2, 1.5
"""So many missed rays, or dots without a ray, side by side are no row; dots are where they are
nearer to one another than so many spacings."""

MOST_SCATTERED, MOST_MISSED_APART = 0.3, 0.12
"""Where dots without a ray and missed rays lie apart, so many of both, as a share of the dots with
a ray, are put up with: false dots lie apart, and those that fail at random; dots of a row that was
left out or jumped do not. With so many missed rays no other hypothesis is looked for."""


@dataclass(frozen=True)
class MatchSettings:
    """How the correspondence is decided.

    Parameters
    ----------
    correspondence
        ``auto`` tries every orientation; otherwise the one to use. `pipeline.measure` puts
        `Settings.correspondence` here.
    margin
        Two hypotheses whose costs differ by less, in units of χ², cannot be told apart.
    stray, missed
        How many dots without a ray, and rays without a dot amid the others, are put up with: a
        number, and a share of the dots (`most_strays`, `leaves_much`) to be added to it.
    """

    correspondence: Literal["auto", "S/S", "S/I", "I/I"] = "auto"
    margin: float = 14.0
    stray: tuple[int, float] = (4, 0.02)
    missed: tuple[int, float] = (2, 0.06)

    @property
    def orientations(self) -> tuple[Orientation, ...]:
        """Orientations to be tried."""
        return ORIENTATIONS if self.correspondence == "auto" else (self.correspondence,)

    def most_strays(self, hypothesis: Hypothesis) -> float:
        """Return how many dots without a ray are put up with, wherever they lie."""
        return self.stray[0] + self.stray[1] * (hypothesis.label_count + hypothesis.stray_count)

    def leaves_much(self, hypothesis: Hypothesis) -> bool:
        """Whether more is left unexplained than is put up with wherever it lies."""
        most_missed = self.missed[0] + self.missed[1] * hypothesis.label_count
        return (
            hypothesis.stray_count > self.most_strays(hypothesis)
            or hypothesis.missed_count > most_missed
        )


def explains(observed: Observation, hypothesis: Hypothesis) -> bool:
    """Whether few dots are left over, few are missing and lie apart, and the marker is not lit."""
    few = max(2, FEW_LEFT * len(observed.plane_mm))
    most = MOST_MISSED_APART * hypothesis.label_count if _missed_lie_apart(hypothesis) else 0.0
    missed = hypothesis.missed_count <= max(few, most)
    return hypothesis.stray_count <= few and missed and hypothesis.marker != "lit"


def nearly_explains(observed: Observation, hypothesis: Hypothesis) -> bool:
    """Whether most dots have their ray: what is left may be a row, or a dip."""
    return hypothesis.stray_count <= MOST_STRAY * len(observed.plane_mm)


def any_explains(observed: Observation, found: list[Hypothesis]) -> bool:
    """Whether one of several hypotheses `explains` the frame."""
    return any(explains(observed, hypothesis) for hypothesis in found)


def decide(
    observed: Observation, found: list[Hypothesis], settings: MatchSettings
) -> tuple[Hypothesis, list[FreeHypothesis]]:
    """Take the cheapest hypothesis, if nothing else comes near it and it leaves little open.

    It is held against the others, against itself up to two rows or columns further on (labels that
    grew from the wrong hole may come to almost the right place), and against itself with the other
    orientations. Dots on which near-equals disagree lose their ray.

    Returns
    -------
    best, open_holes
        The hypothesis; and where several holes can be the marker's, perhaps with a set-up within
        its uncertainty, that hypothesis and its rivals (`holes_left_open`).

    Raises
    ------
    CannotMeasure
        ``no-match``, ``no-reference`` or ``ambiguous-orientation``; ``ambiguous-rows`` where there
        is a dot in the only hole, or a part of the rows is open.
    """
    best, found, neighbours, fit = _cheapest(observed, found, settings.margin)
    cheapest = best  # compared with others before what is doubtful in it, as in them, is taken away
    if fit is FINE_KNOTS:
        cheapest = evaluate_twice(observed, best.labels, fit, best.pool) or best
    best = without_doubtful_outermost(observed, without_false_ends(observed, best, fit), fit)
    if fit is FINE_KNOTS:
        best = evaluate_twice(observed, best.labels, fit, best.pool) or best
    _refuse_unexplained(observed, best, settings)
    own = best.orientation(observed)
    _refuse_marker(observed, best, found)
    doubtful: list[int] = []
    rivals: list[Hypothesis] = []
    others = (
        reoriented_labels(observed, best.labels, own, way)
        for way in settings.orientations
        if way != own
    )
    for other in [*found, *neighbours, *_rivals(observed, best, others, fit)]:
        if _stands_against(observed, cheapest, other, fit, settings):
            continue
        differing, shared = _differing(best, other)
        if len(differing) <= MOST_DIFFERING * shared:
            doubtful += differing
        elif other.orientation(observed) != own:
            raise CannotMeasure(
                "ambiguous-orientation",
                f"{own} and {other.orientation(observed)} explain the dots alike",
            )
        else:
            rivals.append(other)
    best = _without(observed, best, doubtful, fit)
    best = supported(observed, best, fit)
    open_holes = holes_left_open(observed, best, fit, settings.margin)
    return best, _with_rivals(open_holes, best, cheapest, rivals)


def _refuse_marker(observed: Observation, best: Hypothesis, found: list[Hypothesis]) -> None:
    """Raise ``no-reference`` or ``ambiguous-rows`` where the marker is not dark amid lit rays."""
    if best.marker == "lit":
        others_explain = any_explains(observed, [h for h in found if h.marker == "dark"])
        raise CannotMeasure(
            "ambiguous-rows" if others_explain else "no-reference",
            "where the best rows have the absent centre dot, there is a dot",
        )
    if best.marker == "unknown":
        raise CannotMeasure(
            "no-reference", "the absent centre dot is not amid dots that have their ray"
        )


def _with_rivals(
    open_holes: list[FreeHypothesis],
    best: Hypothesis,
    cheapest: Hypothesis,
    rivals: list[Hypothesis],
) -> list[FreeHypothesis]:
    """The holes left open, with those of rivals that are near with the set-up as it is entered.

    Rivals cost so much more than the cheapest, which is the best before doubtful labels were taken
    away. ``ambiguous-rows`` where one differs in a part of the rows alone.
    """
    if rivals and not open_holes:
        open_holes = [FreeHypothesis(best.labels, cost=best.cost)]
    for rival in rivals:
        step = _step(best, rival)
        if not any(step):
            raise CannotMeasure("ambiguous-rows", "parts of the rows can be one on or not")
        if step not in {each.step for each in open_holes}:
            with_marker = rival.cost - cheapest.cost
            without = rival.cost_without_marker - cheapest.cost_without_marker
            cost = open_holes[0].cost + min(with_marker, without)
            open_holes = [*open_holes, FreeHypothesis(rival.labels, step, cost, cost)]
    return open_holes


def _step(one: Hypothesis, other: Hypothesis) -> tuple[int, int]:
    """Rows and columns by which most dots have their rays on in another hypothesis."""
    count = max(one.labels.max(), other.labels.max()) + 1
    at = np.full((2, count, 2), np.nan)
    for place, labels in zip(at, (one.labels, other.labels), strict=True):
        rays = np.argwhere(labels != UNLABELLED)
        place[labels[tuple(rays.T)]] = rays
    shared = np.isfinite(at).all(axis=(0, 2))
    steps, many = np.unique((at[1] - at[0])[shared], axis=0, return_counts=True)
    row, column = steps[np.argmax(many)]
    return int(row), int(column)


def supported(observed: Observation, best: Hypothesis, fit: FitSettings) -> Hypothesis:
    """The hypothesis without the labels that the surface through the others does not support."""
    for _ in range(MOST_LEFT_OUT):
        settled = _settled(observed, best, fit)
        wrong = unsupported(observed, fitted_labels(observed, settled, fit))
        if len(wrong) == 0:
            break
        best = _without(observed, best, wrong, fit)
    return best


def _without(
    observed: Observation, best: Hypothesis, dots: IntArray | list[int], fit: FitSettings
) -> Hypothesis:
    """The hypothesis without the labels of some dots, whose rays say nothing of the boundary."""
    certain = np.where(np.isin(best.labels, dots), UNLABELLED, best.labels)
    if (certain == best.labels).all():
        return best
    witness = np.where(certain == best.labels, best.witness, 0)
    return replace(evaluate(observed, certain, fit, initial=best.pool) or best, witness=witness)


def _settled(observed: Observation, best: Hypothesis, fit: FitSettings) -> Hypothesis:
    """The hypothesis with its fit run on, as far as that of a reconstruction."""
    fit = replace(fit, settled_mm=FitSettings().settled_mm)
    try:
        return replace(best, pool=observed.fit(best.labels, best.witness, fit, best.pool))
    except CannotMeasure:
        return best


def fitted_labels(observed: Observation, best: Hypothesis, fit: FitSettings) -> FittedLabels:
    """The hypothesis's labels and surface, as `unsupported` takes them."""
    basis, paths = best.pool.surface.basis, paths_of(observed, best.pool)
    missed = np.ravel_multi_index(tuple(best.missed_rays.T), best.labels.shape)
    classes = RayClasses(best.witness, missed, best.stray_dots)
    rays = np.union1d(np.flatnonzero(best.labels != UNLABELLED), missed)
    rays = rays[np.isfinite(paths.plane_mm[rays, 0])]
    at = best.pool.factor, paths.points_mm[rays], paths.plane_mm[rays]
    covariance = np.full((best.labels.size, 2, 2), np.nan)
    covariance[rays] = covariance_of_dots(observed.rig, basis, *at)
    how = fit.floor_mm, best.pool.unsettled_mm
    return FittedLabels(best.labels, basis, best.pool.level, paths, covariance, classes, *how)


def _cheapest(
    observed: Observation, found: list[Hypothesis], margin: float
) -> tuple[Hypothesis, list[Hypothesis], list[Hypothesis], FitSettings]:
    """The cheapest hypothesis, those found, its neighbours a row or two on, and the fit of all."""
    best = min(found, key=lambda hypothesis: hypothesis.cost)
    fit = USUAL_KNOTS
    neighbours: list[Hypothesis] = []
    if best.stray_count or best.missed_count:
        neighbours = _rivals(observed, best, shifted_labels(observed, best.labels), fit)
    # What these knots leave of a dip may decide between rivals so close.
    near = any(rival.cost < best.cost + CLOSE_COST for rival in neighbours)
    if near or best.residual_mm > KNOT_ERROR_MM:
        fit, neighbours = FINE_KNOTS, []
        found = [
            h for each in found if (h := evaluate_twice(observed, each.labels, fit, each.pool))
        ]
        best = min(found, key=lambda hypothesis: hypothesis.cost, default=best)
    if not neighbours and not _beyond_doubt(observed, best, margin):
        best, neighbours = _with_neighbours(observed, best, fit)
    if fit is FINE_KNOTS:  # what takes labels away compares costs of these knots alone
        best = evaluate(observed, best.labels, fit, initial=best.pool) or best
    return best, found, neighbours, fit


def _refuse_unexplained(observed: Observation, best: Hypothesis, settings: MatchSettings) -> None:
    """Raise ``no-match`` where too much is left unexplained, or what is left may be a row."""
    # Missed rays side by side are a hole or a row: then so many dots without a ray may be theirs.
    scattered = (
        best.marker == "dark"
        and _missed_lie_apart(best)
        and (best.stray_count <= settings.most_strays(best) or _strays_lie_apart(observed, best))
        and best.stray_count + best.missed_count <= MOST_SCATTERED * best.label_count
    )
    if not nearly_explains(observed, best):
        raise CannotMeasure("no-match", NOTHING_EXPLAINS)
    if not scattered and settings.leaves_much(best):
        raise CannotMeasure(
            "no-match",
            f"the best surface leaves {_counted(best.stray_count, 'dot')} without a ray and "
            f"{_counted(best.missed_count, 'ray')} without a dot amid {best.label_count} pairs",
        )
    if best.pool.level.rays and best.pool.level.disagreement > CONTRADICTED_BITS:
        raise CannotMeasure(
            "no-match",
            "no boundary of the best surface has the rays that came back inside and the others "
            "outside: is the set-up right?",
        )


def _stands_against(
    observed: Observation,
    best: Hypothesis,
    other: Hypothesis,
    fit: FitSettings,
    settings: MatchSettings,
) -> bool:
    """Whether the best stands against another: it costs less, by a margin.

    With fine knots it may cost less with both kinds of knots, and with one of them by the margin. A
    false dot may lie at the marker: another that costs less but for that is a rival.
    """
    if other.cost_without_marker < best.cost_without_marker:
        return False
    # With the set-up off and many false dots, wrong rows were ahead by more than one margin.
    many_false = best.stray_count > settings.most_strays(best)
    margin = (2 if many_false else 1) * settings.margin
    if other.cost >= best.cost + margin:
        return True
    if fit is not FINE_KNOTS:
        return False
    ahead = []
    for each in (FINE_KNOTS, USUAL_KNOTS):
        own, rival = (evaluate(observed, h.labels, each, initial=h.pool) for h in (best, other))
        if own is None or rival is None:
            return False
        ahead.append(rival.cost - own.cost)
    return min(ahead) >= 0 and max(ahead) >= margin


def _beyond_doubt(observed: Observation, best: Hypothesis, margin: float) -> bool:
    """Whether nothing is left unexplained, so that no shift of the labels can come near.

    Any shift puts a dot on the marker's absent ray and leaves the hole to a ray without a dot.
    """
    if best.stray_count or best.missed_count or best.marker != "dark":
        return False
    fine = evaluate(observed, best.labels, FINE_KNOTS, initial=best.pool)
    return fine is not None and fine.misfit + margin < STRAY_COST + MISSED_COST


def _with_neighbours(
    observed: Observation, best: Hypothesis, fit: FitSettings
) -> tuple[Hypothesis, list[Hypothesis]]:
    """The cheapest hypothesis that shifts by a row or two lead to; and its neighbours.

    The labels of one that comes close grow first: shifted, it may lack dots at its ends.
    """
    while True:  # each round is cheaper than the one before
        neighbours = _rivals(observed, best, shifted_labels(observed, best.labels), fit)
        near = [each.labels for each in neighbours if each.cost < best.cost + CLOSE_COST]
        grown = [h for labels in near if (h := grow_and_evaluate(observed, labels, fit))]
        grown = [
            h for each in grown if (h := evaluate_twice(observed, each.labels, fit, each.pool))
        ]
        better = min(grown, key=lambda h: h.cost, default=best)
        if better.cost >= best.cost:
            return best, neighbours + grown
        best = better


def _rivals(
    observed: Observation, best: Hypothesis, labelled: Iterable[IntArray], fit: FitSettings
) -> list[Hypothesis]:
    """Evaluate other labels beside a hypothesis, as far as they may come near it.

    A surface has to go through their dots as well; with wide knots they have to explain nearly as
    much with a rough surface. (With fine ones there is a dip, of which that leaves too much.)
    """
    most_mm = max(MISFIT_MM, MISFIT_TIMES * best.residual_mm)
    quick = try_fit(observed, best.labels, QUICK, best.pool)
    rough = try_fit(observed, best.labels, initial=best.pool)
    far_mm = np.inf if quick is None else QUICK_MISFIT_TIMES * quick.residual_rms_mm
    own = None if rough is None or fit is FINE_KNOTS else rough_costs(observed, best.labels, rough)
    rivals = []
    for labels in labelled:
        sketch = try_fit(observed, labels, QUICK, best.pool)
        if sketch is None or sketch.residual_rms_mm > far_mm:
            continue
        pool = try_fit(observed, labels, initial=best.pool)
        if pool is None or pool.residual_rms_mm >= most_mm:
            continue
        if own is not None:
            unlit, cost = rough_costs(observed, labels, pool)
            if unlit > own[0] + FAR_COST and cost > own[1] + FAR_COST + CLOSE_COST:
                continue
        hypothesis = evaluate_twice(observed, labels, fit, pool)
        rivals += [] if hypothesis is None else [hypothesis]
    return rivals


def _missed_lie_apart(hypothesis: Hypothesis) -> bool:
    """Whether no more than `PAIR` rays without a dot are together, or one more round a corner."""
    seen = np.zeros(hypothesis.labels.shape, np.uint8)
    seen[tuple(hypothesis.missed_rays.T)] = 1
    found = cv2.connectedComponentsWithStats(seen, connectivity=4)[2][1:]
    count, sides = found[:, cv2.CC_STAT_AREA], found[:, [cv2.CC_STAT_WIDTH, cv2.CC_STAT_HEIGHT]]
    return bool((count <= PAIR + (sides == PAIR).all(axis=1)).all())


def _strays_lie_apart(observed: Observation, hypothesis: Hypothesis) -> bool:
    """Whether no more than `PAIR` dots without a ray are side by side."""
    dots = observed.plane_mm[hypothesis.labels[hypothesis.labels != UNLABELLED]]
    spacing = median(scipy.spatial.cKDTree(dots).query(dots, k=2)[0][:, 1])
    stray_dots = observed.plane_mm[hypothesis.stray_dots]
    beside = scipy.spatial.cKDTree(stray_dots).query_ball_point(
        stray_dots, BESIDE_SPACINGS * spacing, return_length=True
    )
    return bool((beside <= PAIR).all())


def _differing(one: Hypothesis, other: Hypothesis) -> tuple[list[int], int]:
    """Dots that have different rays in the two, and how many have a ray in both."""
    rays = [{int(dot): at for at, dot in np.ndenumerate(h.labels)} for h in (one, other)]
    shared = rays[0].keys() & rays[1].keys() - {UNLABELLED}
    return [dot for dot in shared if rays[0][dot] != rays[1][dot]], len(shared)


def _counted(count: int, thing: str) -> str:
    return f"{count} {thing}{'s' * (count != 1)}"
