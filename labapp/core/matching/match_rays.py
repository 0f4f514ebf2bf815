"""Correspondence of rays and dots, and its reliability (§4.2.2, §5.2.3, §7.1).

`match_rays` has three steps:

1. Initial labels. The absent centre dot gives the rays of a complete lattice, for each orientation.
   Where rows bend too much for a lattice to grow, labels come from models of the surface instead:
   quadrics that explain the dots around a hole (`initial.quadrics`), or caps as large as the pool
   (`initial.caps`).
2. Labels are grown (`label_growth`) and evaluated (`hypothesis`): fit the surface to the labelled
   dots, predict the dot of every ray, label the dots with an unambiguous ray, and fit again until
   nothing changes. This labels the dots that the lattice left in doubt and removes wrong labels.
   Swapped, skipped and omitted rows are repaired (`repair`).
3. The cheapest hypothesis is accepted if no other is close (`decision`). If it leaves too much
   unexplained and the set-up is in doubt, labels are found with the likeliest set-up.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace
from itertools import product

import numpy as np

from labapp.core.geometry.rig import Rig
from labapp.core.match import (
    ORIENTATIONS,
    Candidate,
    Match,
    Orientation,
    RowsOpen,
    Trial,
    missing_share,
    signs_of,
)
from labapp.core.matching.checks.rim_left_out import is_rim_left_out
from labapp.core.matching.checks.unexplained import (
    MOST_SCATTERED,
    MOST_SCATTERED_AT_LAST,
    MOST_SCATTERED_OF_ALL,
    NO_BOUNDARY,
    NOTHING_EXPLAINS,
    any_explains,
    explains_half,
    suffices,
)
from labapp.core.matching.decision import (
    MISFIT_MM,
    MISFIT_TIMES,
    QUICK_MISFIT_TIMES,
    decide,
    supported,
    with_rivals,
)
from labapp.core.matching.free_setup import (
    FreeHypothesis,
    holes_left_open,
    mostly_equal,
    shifted_to_holes,
    with_setups_free,
)
from labapp.core.matching.hypothesis import (
    USUAL_FIT,
    Hypothesis,
    evaluate,
    grow_and_evaluate,
    paths_of,
)
from labapp.core.matching.initial.caps import search_caps
from labapp.core.matching.initial.quadrics import search_quadrics
from labapp.core.matching.match_settings import MatchSettings
from labapp.core.matching.observation import (
    LEAST_LABELS,
    UNLABELLED,
    Observation,
    count_labels,
    try_fit,
)
from labapp.core.matching.prediction import covariance_of_dots
from labapp.core.matching.ray_classes import certain_states
from labapp.core.matching.relabelling import (
    BASES,
    extended_over_lattice,
    labels_from_lattice,
    reoriented_labels,
)
from labapp.core.matching.repair import with_repaired, with_rows_beyond
from labapp.core.rows.lattice import Lattice, Site, empty_sites, lattice_of_dots
from labapp.core.surface.solver import inverse_of
from labapp.core.surface.spline import SplineSurface
from labapp.core.values import CannotMeasure, FloatArray, IntArray

MOST_SITES = 8
"""Maximum number of best-fitting sites of the marker in the lattice that become hypotheses."""

FEW_GROWN = 0.92
"""The labels of a lattice are evaluated as they are, too, if growth keeps less than this share."""

MOST_REPAIRED = 4
"""Maximum number of hypotheses from caps that are repaired if none explains the frame."""

MOST_SETUPS = 3
"""Maximum number of set-ups tried if that as entered explains no hypothesis: the likeliest for the
labels, and for those grown with the previous one."""

DOUBTFUL_SHARE = 1 / 3
"""Share of a difference in cost that counts if labels were found with another set-up than that as
entered. In 10 of some 170 such frames wrong labels cost less than the correct ones, by at most 19
units of χ²."""


def match_rays(
    observed: Observation, lattice: Lattice | None, settings: MatchSettings
) -> tuple[Match, SplineSurface]:
    """Find the ray of every dot that has an unambiguous one, and the surface that explains them.

    Parameters
    ----------
    observed, lattice
        Dots of the frame, and their rows and columns; None if no lattice could be grown.
    settings
        See `MatchSettings`.

    Raises
    ------
    CannotMeasure
        ``too-few-dots`` if there are fewer than `LEAST_LABELS`; ``too-many-dots`` if more dots than
        are accepted would have no ray even if every ray made one; ``no-reference`` if the pattern
        has no absent ray or no hole can be the absent dot; ``ambiguous-rows`` if a dot lies in the
        only hole, or a part of the rows can be shifted; ``ambiguous-orientation``; ``no-match`` if
        no surface explains the dots.
    RowsOpen
        ``ambiguous-rows`` if several holes can be the absent dot, perhaps with a set-up that is
        wrong within its uncertainty. Other frames of the recording may decide between them.
    """
    count, pattern = len(observed.plane_mm), observed.rig.pattern
    if count < LEAST_LABELS:
        raise CannotMeasure(
            "too-few-dots", f"only {count} dots found; at least {LEAST_LABELS} are needed"
        )
    rays = pattern.rows * pattern.columns
    if count > rays + max(MOST_SCATTERED_AT_LAST * rays, settings.most_strays(count)):
        # No hypothesis would be accepted, after a search that takes minutes.
        words = f"{count} spots stand out, where the lens makes {rays} dots at most"
        raise CannotMeasure("too-many-dots", words)
    if pattern.marker is None:
        raise CannotMeasure("no-reference", "the pattern has no absent ray to identify the rows by")
    found: list[Hypothesis] = []
    decided: tuple[Hypothesis, list[FreeHypothesis]] | None = None
    for first_labels in (_by_lattice, _by_empty_sites, _by_quadrics, _by_turned_lattice):
        new = first_labels(observed, lattice, settings.orientations)
        found = with_repaired(observed, found, new)
        is_last = first_labels is _by_turned_lattice
        # If no hypothesis explains most dots, caps are tried at once.
        hopeless = bool(found) and not any(explains_half(observed, each) for each in found)
        if hopeless or not (is_last or any(suffices(observed, each) for each in found)):
            continue
        try:
            decided = _decide_among(observed, found, lattice, settings)
            break
        except CannotMeasure as refusal:
            # Rows that contradict the boundary may be turned ones.
            if any_explains(observed, found) and (is_last or refusal.reason != NO_BOUNDARY):
                raise
    if decided is None or (decided[1] and not any_explains(observed, found)):
        decided = _decide_at_last(observed, found + _by_caps(observed), lattice, settings)
    best, open_holes = decided
    match = match_of_hypothesis(observed, best, best.orientation(observed))
    if open_holes:
        raise RowsOpen(
            "several holes in the rows can be the absent centre dot, perhaps because the set-up is "
            "slightly wrong",
            tuple(open_candidates(observed, match, open_holes)),
        )
    return match, best.pool.surface


def open_candidates(
    observed: Observation, own: Match, open_holes: list[FreeHypothesis]
) -> Iterator[Candidate]:
    """Yield the matches of the open hypotheses, that of the likeliest first.

    There is no match where the rim is left out, so that no other frame can decide for it.

    Parameters
    ----------
    observed
        The dots.
    own
        The match of the first hypothesis.
    open_holes
        The hypotheses (`free_setup.holes_left_open`).
    """
    least = open_holes[0]
    labels = np.full(own.ray_states.shape, UNLABELLED)
    labels[tuple(own.ray.T - 1)] = own.dot
    yield Candidate(None if is_rim_left_out(observed, labels) else own, (0, 0), 0.0)
    for each in open_holes[1:]:
        rival, match = evaluate(observed, each.labels), None
        if rival is not None and not is_rim_left_out(observed, each.labels):
            rival = supported(observed, rival, USUAL_FIT)
            match = match_of_hypothesis(observed, rival, own.orientation)
        yield Candidate(match, each.step, each.cost - least.cost)


def _decide_among(
    observed: Observation,
    found: list[Hypothesis],
    lattice: Lattice | None,
    settings: MatchSettings,
    most_scattered: float = MOST_SCATTERED,
) -> tuple[Hypothesis, list[FreeHypothesis]]:
    """Add rows beyond the labelled ones, and `decide`; errors as in `match_rays`."""
    found = with_rows_beyond(observed, found)
    # Labels may have grown into an orientation that the settings exclude.
    allowed = settings.orientations
    found = [hypothesis for hypothesis in found if hypothesis.orientation(observed) in allowed]
    if not found:
        if lattice is not None and not lattice.candidates:
            raise CannotMeasure("no-reference", "no hole in the rows can be the absent dot")
        raise CannotMeasure("no-match", NOTHING_EXPLAINS)
    best, open_holes = decide(observed, found, settings, most_scattered)
    if any(mostly_equal(best.labels, each.labels) for each in found):
        return best, open_holes
    # Shifted labels were chosen, which may lack a row on one side.
    wider = with_rows_beyond(observed, [best])[1:]
    if not wider:
        return best, open_holes
    return decide(observed, found + wider, settings, most_scattered)


def _decide_at_last(
    observed: Observation,
    found: list[Hypothesis],
    lattice: Lattice | None,
    settings: MatchSettings,
) -> tuple[Hypothesis, list[FreeHypothesis]]:
    """Decide among hypotheses of every kind, with another set-up if that as entered explains none.

    If none explains more, the best is accepted with more isolated dots and rays left over. No
    other set-up is tried if all leave most dots without a ray: of 90 frames in which one helped, a
    hypothesis explained half in all. Errors are those of `match_rays`.
    """
    try:
        return _decide_among(observed, found, lattice, settings, MOST_SCATTERED_AT_LAST)
    except CannotMeasure as refusal:
        if refusal.status != "no-match" or not any(explains_half(observed, one) for one in found):
            raise
        decided = _decide_with_other_setup(observed, found, lattice, settings)
        if decided is None and refusal.reason == NOTHING_EXPLAINS:
            raise
        return decided or _decide_among(observed, found, lattice, settings, MOST_SCATTERED_OF_ALL)


def _decide_with_other_setup(
    observed: Observation,
    found: list[Hypothesis],
    lattice: Lattice | None,
    settings: MatchSettings,
) -> tuple[Hypothesis, list[FreeHypothesis]] | None:
    """Decide with the likeliest set-up if that as entered is in doubt; None if it does not help.

    A set-up that is wrong within its uncertainty can leave many dots without a ray, and the correct
    labels may then cost more than others. The set-up is therefore freed for several hypotheses. The
    labels of the cheapest are grown and repaired with its likeliest set-up, then compared with all
    others and with shifted ones, each with its own. The surface is fitted with the set-up as
    entered, as for other frames.
    """
    found = [each for each in found if each.orientation(observed) in settings.orientations]
    if not found:
        return None
    tried = with_setups_free(observed, found, USUAL_FIT)
    free, likelier = min(tried, key=lambda free: free.cost), observed
    for _ in range(MOST_SETUPS):
        moved = free.with_likelier_setup
        start = None if moved is None else grow_and_evaluate(moved, free.labels)
        if moved is None or start is None:
            return None
        likelier, found = moved, with_repaired(moved, [], [start])
        best = min(found, key=lambda hypothesis: hypothesis.cost)
        shifted = shifted_to_holes(observed, best.labels, USUAL_FIT)
        tried += shifted
        free = min(shifted, key=lambda free: free.cost, default=free)
        is_cheapest = not shifted or free is shifted[0]
        if is_cheapest and any(suffices(likelier, each) for each in found):
            break
    try:
        best, rivals = _decide_among(likelier, found, lattice, settings, MOST_SCATTERED_AT_LAST)
    except CannotMeasure:
        return None
    entered = evaluate(observed, best.labels)
    if entered is None:
        return None
    most = settings.margin / DOUBTFUL_SHARE
    freed = holes_left_open(observed, entered, USUAL_FIT, most)
    holes = freed if len(freed) > 1 else rivals
    close, least = [], min(free.cost for free in tried)
    for free in tried:
        excess = free.cost - least
        if excess - free.marker_cost < settings.margin:  # a dot at the absent ray may be false
            excess -= free.marker_cost
        if excess < most and not mostly_equal(best.labels, free.labels):
            close.append((free.labels, excess))
    holes = with_rivals(observed, holes, best.labels, close)
    best = replace(entered, ray_states=best.ray_states, missed_rays=best.missed_rays)
    return best, [replace(each, cost=DOUBTFUL_SHARE * each.cost) for each in holes]


def lattice_of_match(match: Match, rig: Rig, count: int) -> Lattice:
    """Rows and columns of ``count`` dots from their rays, which replace those found in the image.

    They include dots that the image alone leaves in doubt, and exclude dots without a ray.
    """
    way, marker = signs_of(match.orientation), rig.pattern.marker or rig.pattern.center_ray
    k, t = np.array(marker) * way + (match.reflected - match.ray * way)[0]
    return lattice_of_dots(match.reflected, match.dot, count, (int(k), int(t)))


def _by_lattice(
    observed: Observation, lattice: Lattice | None, orientations: tuple[Orientation, ...]
) -> list[Hypothesis]:
    """Hypotheses from the lattice with the marker at each candidate site, in each orientation."""
    if lattice is None:
        return []
    return _by_sites(observed, lattice, product(lattice.candidates, orientations, BASES))


def _by_empty_sites(
    observed: Observation, lattice: Lattice | None, orientations: tuple[Orientation, ...]
) -> list[Hypothesis]:
    """Hypotheses from the lattice with the marker at each empty site in it or next to it.

    Because of false or missing dots, or the torch, the marker may have fewer than three lit
    neighbours.
    """
    if lattice is None:
        return []
    return _by_sites(observed, lattice, product(empty_sites(lattice), orientations, BASES[:1]))


def _by_turned_lattice(
    observed: Observation, lattice: Lattice | None, orientations: tuple[Orientation, ...]
) -> list[Hypothesis]:
    """As `_by_empty_sites`, with rows of the lattice that are not rows of the rays (`BASES`)."""
    if lattice is None:
        return []
    return _by_sites(observed, lattice, product(empty_sites(lattice), orientations, BASES[1:]))


def _by_sites(
    observed: Observation, lattice: Lattice, places: Iterable[tuple[Site, Orientation, IntArray]]
) -> list[Hypothesis]:
    """Hypotheses from the lattice with the marker at given sites, in given orientations and bases.

    Only the best-fitting ones are grown. They are selected first by a quick fit, then by the fit
    with which labels grow.
    """
    pattern = observed.rig.pattern
    assert pattern.marker is not None
    shape = (pattern.rows, pattern.columns)
    labelled = [
        labels_from_lattice(lattice, site, pattern.marker, orientation, shape, basis)
        for site, orientation, basis in places
    ]
    quick_mm = observed.quick_misfits(labelled)
    far_mm = QUICK_MISFIT_TIMES * quick_mm.min(initial=np.inf)
    likely = np.argsort(quick_mm, kind="stable")[: 2 * MOST_SITES]
    rough = _fitting(observed, [labelled[k] for k in likely if quick_mm[k] <= far_mm])[:MOST_SITES]
    most_mm = max(MISFIT_MM, MISFIT_TIMES * rough[0][0]) if rough else 0.0
    found = []
    for off_mm, labels in rough:
        grown = grow_and_evaluate(observed, labels) if off_mm < most_mm else None
        if grown is None:
            continue
        found.append(grown)
        if grown.label_count < FEW_GROWN * count_labels(labels):
            # Where rows lie close together, growth leaves many dots in doubt.
            whole = evaluate(observed, labels)
            found += [whole] if whole is not None and whole.cost < grown.cost else []
    return found


def _fitting(observed: Observation, labelled: list[IntArray]) -> list[tuple[float, IntArray]]:
    """Labels with the root mean square residual of their fit, mm, in ascending order."""
    pools = ((try_fit(observed, labels), labels) for labels in labelled)
    found = [(pool.residual_rms_mm, labels) for pool, labels in pools if pool is not None]
    return sorted(found, key=lambda one: one[0])


def _by_caps(observed: Observation) -> list[Hypothesis]:
    """Hypotheses from the caps that match the dots best; the cheapest of them are repaired."""
    found: list[Hypothesis] = []
    for labels in search_caps(observed):
        hypothesis = grow_and_evaluate(observed, labels)
        if hypothesis is not None:
            found.append(hypothesis)
            if suffices(observed, hypothesis):
                return with_repaired(observed, [], found)
    for start in sorted(found, key=lambda hypothesis: hypothesis.misfit)[:MOST_REPAIRED]:
        found += with_repaired(observed, [], [start])[1:]
        if any(suffices(observed, each) for each in found):
            break
    return found


def _by_quadrics(
    observed: Observation, lattice: Lattice | None, orientations: tuple[Orientation, ...]
) -> list[Hypothesis]:
    """Hypotheses from the quadrics that explain the dots around a hole, extended by the lattice."""
    found = []
    for guess in search_quadrics(observed):
        hypothesis = grow_and_evaluate(observed, guess.labels)
        if hypothesis is None:
            continue
        found.append(hypothesis)
        if lattice is not None:
            labels = extended_over_lattice(
                hypothesis.labels, lattice, hypothesis.orientation(observed)
            )
            wider = None if labels is None else grow_and_evaluate(observed, labels)
            found += [wider] if wider is not None else []
        if suffices(observed, hypothesis):
            break
    return found


def match_of_hypothesis(
    observed: Observation,
    best: Hypothesis,
    orientation: Orientation,
    marker_site: Site | None = None,
) -> Match:
    """Build the match of a hypothesis with its orientation, and try the other orientations.

    Reflected rows and columns count from 1, or so that the marker has the given site (k, t).
    """
    trials = [Trial(orientation, best.residual_rms_mm)]
    for other in ORIENTATIONS:
        if other != orientation:
            pool = try_fit(observed, reoriented_labels(observed, best.labels, orientation, other))
            trials.append(Trial(other, np.inf if pool is None else pool.residual_rms_mm))
    at = np.argwhere(best.labels != UNLABELLED)
    dot = best.labels[at[:, 0], at[:, 1]]
    trials.sort(key=lambda trial: trial.residual_mm)
    paths, surface = paths_of(observed, best.pool), best.pool.surface
    inverse = inverse_of(best.pool.factor)

    def covariance_of(rays: IntArray) -> FloatArray:
        return covariance_of_dots(
            observed.rig, surface.basis, inverse, paths.points_mm[rays], paths.plane_mm[rays]
        )

    ray_states = certain_states(observed, best.labels, best.ray_states, paths, covariance_of)
    missed = best.missed_count
    return match_of_pairs(observed, at, dot, orientation, ray_states, missed, trials, marker_site)


def match_of_pairs(
    observed: Observation,
    at: IntArray,
    dot: IntArray,
    orientation: Orientation,
    ray_states: IntArray,
    missed: int,
    trials: Iterable[Trial],
    marker_site: Site | None = None,
) -> Match:
    """Build the match of n pairs of ray and dot.

    Parameters
    ----------
    observed
        The dots and the bench.
    at
        Row and column of each pair's ray in the pattern's arrays, counted from 0, shape (n, 2).
    dot
        Index of its dot, shape (n,).
    orientation, ray_states, trials
        See `Match`.
    missed
        Number of rays between lit rays that have no dot.
    marker_site
        Reflected row and column (k, t) of the marker. None: rows and columns begin at 1.
    """
    pattern = observed.rig.pattern
    numbers = (at + 1 - (pattern.marker or pattern.center_ray)) * signs_of(orientation)
    least = numbers.min(axis=0)
    numbers += 1 - least if marker_site is None else np.maximum(marker_site, 1 - least)
    return Match(
        orientation=orientation,
        dot=dot,
        ray=at + 1,
        reflected=numbers,
        plane_mm=observed.plane_mm[dot],
        plane_covariance_mm2=observed.covariance_mm2[dot],
        ray_states=ray_states,
        trials=tuple(trials),
        missing=missing_share(missed, len(dot)),
    )
