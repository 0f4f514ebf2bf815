"""Choice among the hypotheses of a frame: accept the cheapest, or refuse all."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from labapp.core.matching.checks.hidden_rows import lines_before, rays_beside_hidden_rows
from labapp.core.matching.checks.rim_left_out import (
    is_rim_left_out,
    refuse_rim_left_out,
)
from labapp.core.matching.checks.unexplained import (
    MOST_SCATTERED,
    any_explains,
    refuse_contradicted,
    refuse_much_in_doubt,
    refuse_unexplained,
)
from labapp.core.matching.checks.unsupported_labels import MOST_LEFT_OUT, FittedLabels, unsupported
from labapp.core.matching.free_setup import FreeHypothesis, holes_left_open, unconfirmed
from labapp.core.matching.hypothesis import (
    FINE_FIT,
    KNOT_ERROR_MM,
    MISSED_COST,
    STRAY_COST,
    USUAL_FIT,
    Hypothesis,
    evaluate,
    evaluate_averaged,
    grow_and_evaluate,
    orientation_of,
    paths_of,
    rough_costs,
    without_doubtful_outermost,
    without_false_ends,
)
from labapp.core.matching.match_settings import MatchSettings
from labapp.core.matching.observation import UNLABELLED, Observation, try_fit
from labapp.core.matching.prediction import covariance_of_dots
from labapp.core.matching.ray_classes import RayClasses
from labapp.core.matching.relabelling import exchanged_labels, reoriented_labels, shifted_labels
from labapp.core.matching.repair import with_rim
from labapp.core.surface.level import KnownRays
from labapp.core.surface.pool_fit import FitSettings
from labapp.core.surface.solver import inverse_of
from labapp.core.values import BoolArray, CannotMeasure, IntArray

HIDDEN, FREE, NEAREST = 3, 4, 6
"""The rows are ambiguous if `HIDDEN` of the four dots beside the absent one have no ray, and `FREE`
of the `NEAREST` dots to its computed place have none."""

MISFIT_MM, MISFIT_TIMES = 0.15, 3.0
"""Labels whose residuals exceed both the first, mm, and this multiple of the best residuals are
discarded: residuals with wrong rays are usually ten times those with the correct ones."""

MOST_DIFFERING = 0.2
"""If hypotheses of nearly equal cost assign different rays to a larger share of the dots, the frame
is ambiguous."""

CLOSE_COST = 40.0
"""A rival whose cost is within this of the lowest is examined further, in units of χ²: a dip under
the torch, or dots that shifted labels have not yet found, may add as much to a cost."""

FOLLOWED_MM, CLOSE_IN_DIP = 0.03, 120.0
"""If the residuals of the best hypothesis are larger than the first, rivals within the second are
examined further: of the residuals of rows that cross in a dip the usual knots can follow less."""

FAR_AHEAD = 60.0
"""A rival that costs more by this in the mean of fine and usual knots is beaten even if it costs
less with fine ones. Wrong rows led the right ones by 35 to 41; right rows led by 71."""

QUICK_MISFIT_TIMES = 4.0
"""Labels whose quick fit has more than this multiple of the best residual are not rivals. Of 700
shifted labels of 160 pools with a dip, those that came close had less than 2.5 times as much."""

FAR_COST = 30.0
"""Labels that cost more than the best by this with rough fits, and by `CLOSE_COST` in addition if
the marker is included, do not come close to it with converged fits."""


def decide(
    observed: Observation,
    found: list[Hypothesis],
    settings: MatchSettings,
    most_scattered: float = MOST_SCATTERED,
) -> tuple[Hypothesis, list[FreeHypothesis]]:
    """Choose the cheapest hypothesis if no other is close and it leaves little unexplained.

    It is compared with the others, with itself shifted by up to two rows or columns (labels grown
    from a wrong hole may end almost at the correct place), and with itself in the other
    orientations. Dots on which hypotheses of nearly equal cost disagree lose their ray.

    Returns
    -------
    best, open_holes
        The hypothesis; and, if several holes can be the marker's, perhaps with the set-up changed
        within its uncertainty, that hypothesis and its rivals (`holes_left_open`).

    Raises
    ------
    CannotMeasure
        ``no-match``, ``no-reference`` or ``ambiguous-orientation``; ``ambiguous-rows`` if there is
        a dot in the only hole, or a part of the rows is ambiguous.
    """
    best, found, neighbours, fit_settings = _cheapest(observed, found, settings.margin)
    cheapest = best  # rivals keep their doubtful labels: they are compared with this one
    if fit_settings == FINE_FIT:
        cheapest = evaluate_averaged(observed, best.labels, fit_settings, best.pool) or best
    ended = without_false_ends(observed, best, fit_settings)
    best = without_doubtful_outermost(observed, ended, fit_settings)
    if fit_settings == FINE_FIT:
        best = evaluate_averaged(observed, best.labels, fit_settings, best.pool) or best
    refuse_unexplained(observed, best, settings, most_scattered)
    orientation = best.orientation(observed)
    _refuse_marker(observed, best, found)
    doubtful = _exchangeable(observed, best, fit_settings, settings.margin)
    rivals: list[tuple[IntArray, float]] = []
    others = (
        reoriented_labels(observed, best.labels, orientation, other)
        for other in settings.orientations
        if other != orientation
    )
    for other in [*found, *neighbours, *_rivals(observed, best, others, fit_settings)]:
        if _clearly_cheaper(observed, cheapest, other, fit_settings, settings):
            continue
        differing, shared = _differing(best, other)
        if len(differing) <= MOST_DIFFERING * shared:
            doubtful += differing
        else:
            rivals.append((other.labels, _excess(other, cheapest)))
    best = supported(observed, _without(observed, best, doubtful, fit_settings), fit_settings)
    best = _with_unknown(observed, best, ended.labels, fit_settings)
    best = with_rim(observed, best)
    all_labels = best.labels  # dots beyond a hidden row lose their rays, but were not left out
    refuse_much_in_doubt(best, ended.labels)
    _refuse_hidden_marker(observed, best)
    best = _without_rays(
        observed, best, rays_beside_hidden_rows(observed, best, fit_settings), fit_settings
    )
    known = KnownRays.of(observed.rig, best.ray_states, best.pool.surface.basis, 0.0)
    sigma = best.pool.height_sigma_mm(known.landing_mm)
    refuse_contradicted(replace(known, height_sigma_mm=sigma), best.pool)
    freed = holes_left_open(observed, best, fit_settings, settings.margin)
    if freed:
        best = _without(observed, best, unconfirmed(freed[0], best.labels), fit_settings)
    open_holes = freed if len(freed) > 1 else []
    open_holes = with_rivals(observed, open_holes, best.labels, rivals)
    if not open_holes and is_rim_left_out(observed, all_labels):
        refuse_rim_left_out()
    return best, open_holes


def _refuse_marker(observed: Observation, best: Hypothesis, found: list[Hypothesis]) -> None:
    """Raise ``no-reference`` or ``ambiguous-rows`` unless the marker is empty between lit rays."""
    if best.marker == "lit":
        others_explain = any_explains(observed, [h for h in found if h.marker == "empty"])
        raise CannotMeasure(
            "ambiguous-rows" if others_explain else "no-reference",
            "the best rows have a dot where the absent centre dot would be",
        )
    if best.marker == "unknown":
        raise CannotMeasure(
            "no-reference", "the absent centre dot is not between dots that have a ray"
        )


def _refuse_hidden_marker(observed: Observation, best: Hypothesis) -> None:
    """Raise ``ambiguous-rows`` if most dots beside the absent one, and others there, have no ray.

    Where rows cross there, any of several holes among their dots may be that of the absent one.
    """
    marker = observed.rig.pattern.marker
    assert marker is not None
    at = np.array(marker) - 1
    beside = np.pad(best.labels, 1, constant_values=UNLABELLED)[
        at[0] + np.array([0, 2, 1, 1]), at[1] + np.array([1, 1, 0, 2])
    ]
    if np.count_nonzero(beside == UNLABELLED) < HIDDEN:
        return
    place = paths_of(observed, best.pool).plane_mm[np.ravel_multi_index(at, best.labels.shape)]
    nearest = np.argsort(np.linalg.norm(observed.plane_mm - place, axis=-1))[:NEAREST]
    free = np.count_nonzero(~np.isin(nearest, best.labels))
    if not np.isfinite(place).all():
        others = "the surface does not reflect its ray onto the plane"
    elif free >= FREE:
        others = f"{free} of the {NEAREST} dots nearest to where it would be have none"
    else:
        return
    raise CannotMeasure(
        "ambiguous-rows", f"most dots beside the absent centre dot have no ray, and {others}"
    )


def _excess(rival: Hypothesis, cheapest: Hypothesis) -> float:
    """How much more a rival costs, with or without the marker.

    It is compared with the best hypothesis before the removal of doubtful labels.
    """
    without_marker = rival.cost_without_marker - cheapest.cost_without_marker
    return min(rival.cost - cheapest.cost, without_marker)


def with_rivals(
    observed: Observation,
    open_holes: list[FreeHypothesis],
    best: IntArray,
    rivals: Iterable[tuple[IntArray, float]],
) -> list[FreeHypothesis]:
    """Add to the open holes those of rivals, given as their labels and how much more they cost.

    Raise ``ambiguous-orientation`` if a rival has another orientation than the best labels, and
    ``ambiguous-rows`` if it differs from them only in a part of the rows.
    """
    orientation = orientation_of(observed, best)
    for labels, excess in rivals:
        other = orientation_of(observed, labels)
        if other != orientation:
            raise CannotMeasure(
                "ambiguous-orientation", f"{orientation} and {other} explain the dots equally well"
            )
        step = _step(best, labels)
        if not any(step):
            raise CannotMeasure("ambiguous-rows", "parts of the rows can be shifted by one")
        open_holes = open_holes or [FreeHypothesis(best, cost=0.0)]
        if step not in {each.step for each in open_holes}:
            cost = open_holes[0].cost + excess
            open_holes = [*open_holes, FreeHypothesis(labels, step, cost)]
    return open_holes


def _step(one: IntArray, other: IntArray) -> tuple[int, int]:
    """Rows and columns by which the rays of most dots are shifted in other labels."""
    rays = _rays_of_dots(one, other)
    at = np.stack(np.divmod(rays[:, (rays >= 0).all(axis=0)], one.shape[1]), axis=-1)
    steps, counts = np.unique(at[1] - at[0], axis=0, return_counts=True)
    row, column = steps[np.argmax(counts)]
    return int(row), int(column)


def supported(observed: Observation, best: Hypothesis, fit_settings: FitSettings) -> Hypothesis:
    """Remove the labels that the surface through the other dots does not support."""
    for _ in range(MOST_LEFT_OUT):
        converged = _converged(observed, best, fit_settings)
        wrong = unsupported(observed, fitted_labels(observed, converged, fit_settings))
        if len(wrong) == 0:
            break
        best = _without(observed, best, wrong, fit_settings)
    return best


def _without(
    observed: Observation, best: Hypothesis, dots: IntArray | list[int], fit_settings: FitSettings
) -> Hypothesis:
    """Remove the labels of some dots; the states of their rays become unknown."""
    certain = np.where(np.isin(best.labels, dots), UNLABELLED, best.labels)
    if (certain == best.labels).all():
        return best
    ray_states = np.where(certain == best.labels, best.ray_states, 0)
    return replace(
        evaluate(observed, certain, fit_settings, initial=best.pool) or best, ray_states=ray_states
    )


def _without_rays(
    observed: Observation, best: Hypothesis, rays: BoolArray, fit_settings: FitSettings
) -> Hypothesis:
    """Remove the labels of some rays, shape (rows, columns); their states become unknown."""
    if not rays.any():
        return best
    before = best.labels
    best = _without(observed, best, before[rays & (before != UNLABELLED)], fit_settings)
    ray_states = np.where(rays, 0, best.ray_states)
    return _refitted(observed, replace(best, ray_states=ray_states), fit_settings)


def _with_unknown(
    observed: Observation, best: Hypothesis, before: IntArray, fit_settings: FitSettings
) -> Hypothesis:
    """Set the rays that lost their label to unknown, and refit: they were fitted as dark."""
    lit = best.labels != UNLABELLED
    lost = (before != UNLABELLED) & ~lit
    if not lost.any():
        return best
    ray_states = np.where(lost | (lines_before(lost, lit) & ~lit), 0, best.ray_states)
    return _refitted(observed, replace(best, ray_states=ray_states), fit_settings)


def _converged(observed: Observation, best: Hypothesis, fit_settings: FitSettings) -> Hypothesis:
    """Continue the fit of a hypothesis until it has converged as for a reconstruction."""
    return _refitted(observed, best, replace(fit_settings, settled_mm=FitSettings().settled_mm))


def _refitted(observed: Observation, best: Hypothesis, fit_settings: FitSettings) -> Hypothesis:
    """Continue the fit of a hypothesis with its ray states, if that is possible."""
    try:
        pool = observed.fit(best.labels, best.ray_states, fit_settings, best.pool)
    except CannotMeasure:
        return best
    return replace(best, pool=pool)


def fitted_labels(
    observed: Observation, best: Hypothesis, fit_settings: FitSettings
) -> FittedLabels:
    """Labels and surface of a hypothesis, as the input of `unsupported`."""
    basis, paths = best.pool.surface.basis, paths_of(observed, best.pool)
    missed = np.ravel_multi_index(tuple(best.missed_rays.T), best.labels.shape)
    classes = RayClasses(best.ray_states, missed, best.stray_dots)
    rays = np.union1d(np.flatnonzero(best.labels != UNLABELLED), missed)
    rays = rays[np.isfinite(paths.plane_mm[rays, 0])]
    inverse = inverse_of(best.pool.factor)
    covariance = np.full((best.labels.size, 2, 2), np.nan)
    covariance[rays] = covariance_of_dots(
        observed.rig, basis, inverse, paths.points_mm[rays], paths.plane_mm[rays]
    )
    return FittedLabels(
        labels=best.labels,
        basis=basis,
        level=best.pool.level,
        paths=paths,
        covariance_mm2=covariance,
        classes=classes,
        floor_mm=fit_settings.floor_mm,
        unsettled_mm=best.pool.unsettled_mm,
    )


def _cheapest(
    observed: Observation, found: list[Hypothesis], margin: float
) -> tuple[Hypothesis, list[Hypothesis], list[Hypothesis], FitSettings]:
    """The cheapest hypothesis, all found, its neighbours by a row or two, and the settings used."""
    best = min(found, key=lambda hypothesis: hypothesis.cost)
    fit_settings = USUAL_FIT
    neighbours: list[Hypothesis] | None = None
    if best.stray_count or best.missed_count:
        neighbours = _rivals(observed, best, shifted_labels(observed, best.labels), fit_settings)
    # Residuals of a dip that this fit cannot follow may decide between rivals this close.
    close = CLOSE_COST if best.residual_rms_mm < FOLLOWED_MM else CLOSE_IN_DIP
    near = any(rival.cost < best.cost + close for rival in neighbours or ())
    if near or best.residual_rms_mm > KNOT_ERROR_MM:
        fit_settings, neighbours = FINE_FIT, None
        fine = evaluate_averaged(observed, best.labels, fit_settings, best.pool)
        # The mean is at least half of the usual cost: hypotheses above this are no rivals.
        most = np.inf if fine is None else 2 * (fine.cost + 2 * margin)
        averaged = (
            each
            if each.cost_without_marker > most
            else evaluate_averaged(observed, each.labels, fit_settings, each.pool)
            for each in found
        )
        found = [hypothesis for hypothesis in averaged if hypothesis]
        best = min(found, key=lambda hypothesis: hypothesis.cost, default=best)
    if neighbours is None and not _beyond_doubt(observed, best, margin):
        best, neighbours = _with_neighbours(observed, best, fit_settings)
    if fit_settings == FINE_FIT:  # labels are removed by comparing costs of this fit alone
        best = evaluate(observed, best.labels, fit_settings, initial=best.pool) or best
    return best, found, neighbours or [], fit_settings


def _clearly_cheaper(
    observed: Observation,
    best: Hypothesis,
    other: Hypothesis,
    fit_settings: FitSettings,
    settings: MatchSettings,
) -> bool:
    """Whether the best hypothesis costs less than another by the margin.

    With fine knots it must be far ahead, or cost less with both kinds of knots, and by the margin
    with one of them, unless the usual knots can follow its surface: where rows cross in a narrow
    dip, wrong rows cost less if they cannot. As the dot at the marker may be false, another
    hypothesis that does not cost more by half the margin without it is a rival.
    """
    if other.cost_without_marker < best.cost_without_marker + settings.margin / 2:
        return False
    # With a wrong set-up and many false dots, wrong rows led by more than one margin.
    many_false = best.stray_count > settings.most_strays(best.label_count + best.stray_count)
    margin = (2 if many_false else 1) * settings.margin
    ahead = other.cost >= best.cost + margin
    if fit_settings != FINE_FIT or other.cost >= best.cost + FAR_AHEAD:
        return ahead
    costs = []
    for each in (best, other):
        fine = evaluate(observed, each.labels, FINE_FIT, initial=each.pool)
        usual = evaluate(observed, each.labels, USUAL_FIT, initial=each.pool)
        if fine is None or usual is None:
            return False
        costs.append((fine.cost, usual.cost))
    own, rival = np.array(costs)
    if ahead and own[1] < own[0] + margin:
        return True
    return bool((rival >= own).all() and (rival >= own + margin).any())


def _exchangeable(
    observed: Observation, best: Hypothesis, fit_settings: FitSettings, margin: float
) -> list[int]:
    """Dots that explain as much if two are exchanged, with a surface that is not much rougher.

    A narrow dip is rougher than expected: with its rows crossed the wrong surface cost 26 less.
    """
    dots: list[int] = []
    rough = try_fit(observed, best.labels, initial=best.pool)
    most = -np.inf if rough is None else rough_costs(observed, best.labels, rough)[1] + FAR_AHEAD
    for labels in exchanged_labels(observed, best.labels):
        pool = try_fit(observed, labels, initial=best.pool)
        if pool is None or rough_costs(observed, labels, pool)[1] > most:
            continue
        other = evaluate_averaged(observed, labels, fit_settings, pool)
        if other is None or other.cost > best.cost + FAR_AHEAD:
            continue
        if min(other.cost - best.cost, other.misfit - best.misfit) < margin:
            dots += labels[labels != best.labels].tolist()
    return dots


def _beyond_doubt(observed: Observation, best: Hypothesis, margin: float) -> bool:
    """Whether every dot has a ray and no ray is missed, so that no shifted labels can come close.

    Any shift places a dot at the marker's absent ray, and a ray without a dot in the hole. A dot
    that is neither labelled nor stray may be the one at the absent ray.
    """
    every_dot = best.label_count == len(observed.plane_mm)
    if not every_dot or best.missed_count or best.marker != "empty":
        return False
    most = STRAY_COST + MISSED_COST - margin
    if best.misfit < most:
        return True
    fine = evaluate(observed, best.labels, FINE_FIT, initial=best.pool)
    return fine is not None and fine.misfit < most


def _with_neighbours(
    observed: Observation, best: Hypothesis, fit_settings: FitSettings
) -> tuple[Hypothesis, list[Hypothesis]]:
    """The cheapest hypothesis that shifts by a row or two lead to, and its neighbours.

    Shifted labels that come close are grown first, as they may lack dots at their ends.
    """
    while True:  # each round is cheaper than the previous one
        neighbours = _rivals(observed, best, shifted_labels(observed, best.labels), fit_settings)
        near = [each.labels for each in neighbours if each.cost < best.cost + CLOSE_COST]
        grown = [h for labels in near if (h := grow_and_evaluate(observed, labels, fit_settings))]
        grown = [
            h
            for each in grown
            if (h := evaluate_averaged(observed, each.labels, fit_settings, each.pool))
        ]
        better = min(grown, key=lambda h: h.cost, default=best)
        if better.cost >= best.cost:
            return best, neighbours + grown
        best = better


def _rivals(
    observed: Observation, best: Hypothesis, labelled: Iterable[IntArray], fit_settings: FitSettings
) -> list[Hypothesis]:
    """Evaluate other labels as rivals of a hypothesis, except those that cannot come close to it.

    Their residuals must be comparable. With the usual knots, their cost with a rough fit must be
    comparable too, unless there is a dip, which the rough fit does not follow.
    """
    most_mm = max(MISFIT_MM, MISFIT_TIMES * best.residual_rms_mm)
    labelled = [best.labels, *labelled]
    quick_mm = observed.quick_misfits(labelled, best.pool)
    far_mm = QUICK_MISFIT_TIMES * quick_mm[0]
    dipped = fit_settings == FINE_FIT or best.residual_rms_mm > FOLLOWED_MM
    rough = None if dipped else try_fit(observed, best.labels, initial=best.pool)
    costs = None if rough is None else rough_costs(observed, best.labels, rough)
    rivals = []
    for labels, off_mm in zip(labelled[1:], quick_mm[1:], strict=True):
        pool = None if off_mm > far_mm else try_fit(observed, labels, initial=best.pool)
        if pool is None or pool.residual_rms_mm >= most_mm:
            continue
        if costs is not None:
            unlit, cost = rough_costs(observed, labels, pool)
            if unlit > costs[0] + FAR_COST and cost > costs[1] + FAR_COST + CLOSE_COST:
                continue
        hypothesis = evaluate_averaged(observed, labels, fit_settings, pool)
        rivals += [] if hypothesis is None else [hypothesis]
    return rivals


def _differing(one: Hypothesis, other: Hypothesis) -> tuple[list[int], int]:
    """Dots with different rays in two hypotheses, and the number of dots with a ray in both."""
    own, others = _rays_of_dots(one.labels, other.labels)
    shared = (own >= 0) & (others >= 0)
    return np.flatnonzero(shared & (own != others)).tolist(), int(np.count_nonzero(shared))


def _rays_of_dots(one: IntArray, other: IntArray) -> IntArray:
    """Flat index of each dot's ray in two sets of labels, or −1, shape (2, dots)."""
    rays = np.full((2, max(one.max(), other.max()) + 1), -1)
    for ray, labels in zip(rays, (one, other), strict=True):
        lit = np.flatnonzero(labels != UNLABELLED)
        ray[labels.flat[lit]] = lit
    return rays
