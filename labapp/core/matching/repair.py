"""Repair of labels that leave dots or rays unexplained: rows, and the rim of a steep pool."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import scipy

from labapp.core.matching.checks.rim_left_out import (
    RIM_POSSIBLE,
    refuse_rim_left_out,
    rim_evidence,
)
from labapp.core.matching.checks.unexplained import explains, few_left, suffices
from labapp.core.matching.hypothesis import (
    FINE_FIT,
    KNOT_ERROR_MM,
    WEAK_NEIGHBOURS,
    Hypothesis,
    evaluate_averaged,
    grow_and_evaluate,
)
from labapp.core.matching.observation import (
    UNLABELLED,
    Observation,
    neighbours_of,
    widened,
    within_rings,
)
from labapp.core.matching.prediction import (
    GATE_SIGMA2,
    RIVAL_MARGIN,
    false_dot_deviance,
    pair_deviances,
    predict,
)
from labapp.core.matching.row_ends import continued_labels
from labapp.core.values import BoolArray, IntArray

DISCARDED_RINGS = 2
"""Number of rings of labels around unexplained rays and dots that are discarded and reassigned."""

MIDDLE = 0.25
"""A dot is midway between two others if it is nearer to their midpoint than this fraction of their
distance."""

LEAST_ROW, MOST_BEYOND = 3, 0.6
"""One or two dots beyond the last row may be false; three that one surface explains are not. If
more than this share of all dots is stray, the cause is not a row that growth did not reach."""

MOST_PAIRS = 8
"""Number of pairs of a stray dot and a ray beyond the labelled ones that are tried."""

LEAST_BETWEEN = 2
"""Two dots midway between those of two rows belong to a row that was omitted."""


def with_repaired(
    observed: Observation, found: list[Hypothesis], new: list[Hypothesis]
) -> list[Hypothesis]:
    """Add new hypotheses, and repaired versions of the cheapest of all as long as each is cheaper.

    If none of the new ones is the cheapest, nothing is repaired: the cheapest was repaired before.

    Labels around unexplained rays and dots are discarded, gaps of skipped rows are closed, omitted
    rows are inserted, and a dip is followed with finer knots.

    Labels that still need repair bend the surface, so its roughness is not included in the
    comparison yet. If only isolated dots are left over, which are probably false, nothing is
    repaired.

    Where rows cross in a dip, growth may swap them; the swapped labels then bend the surface and
    support each other. The surface through the surrounding labels is more reliable, and follows
    the dip with finer knots. These are not needed where the usual ones fit and the discarded labels
    are found again.
    """
    found = found + new
    best = min(found, key=lambda hypothesis: hypothesis.misfit, default=None)
    if not any(best is each for each in new):
        return found
    while best is not None and (best.missed_count or not suffices(observed, best)):
        labels = np.where(_about_unexplained(observed, best), UNLABELLED, best.labels)
        tried = [*_closed_up(best), *_opened_up(observed, best)]
        finer = [] if explains(observed, best) else [best.labels]
        if (labels != best.labels).any():
            # Dots of swapped rows usually leave missed rays, too; false dots leave none.
            tried, finer = [labels, *tried], [labels, *finer] if best.missed_count else finer
        grown = [grow_and_evaluate(observed, labels) for labels in tried]
        if best.residual_rms_mm <= KNOT_ERROR_MM and _found_again(best, grown):
            finer = []
        knot_mm = FINE_FIT.knot_mm
        grown += [grow_and_evaluate(observed, labels, knot_mm=knot_mm) for labels in finer]
        repaired = [hypothesis for hypothesis in grown if hypothesis is not None]
        cheapest = min(repaired, key=lambda hypothesis: hypothesis.misfit, default=best)
        best = cheapest if cheapest.misfit < best.misfit else None
        found = found if best is None else [*found, best]
    return found


def _found_again(hypothesis: Hypothesis, grown: list[Hypothesis | None]) -> bool:
    """Whether growth led to the labels of a hypothesis again."""
    return any(each is not None and (each.labels == hypothesis.labels).all() for each in grown)


def _closed_up(hypothesis: Hypothesis) -> Iterator[IntArray]:
    """Yield labels with the gap of a skipped row or column closed, from either side.

    A row of rays was skipped if most of the missed rays are in it.
    """
    labels = hypothesis.labels
    for axis in (0, 1):
        lines, missed = np.unique(hypothesis.missed_rays[:, axis], return_counts=True)
        for line in lines[missed >= max(LEAST_ROW, 0.5 * hypothesis.missed_count)]:
            own = labels if axis == 0 else labels.T
            after, before = np.full_like(own, UNLABELLED), np.full_like(own, UNLABELLED)
            after[:line], after[line:-1] = own[:line], own[line + 1 :]
            before[line + 1 :], before[1 : line + 1] = own[line + 1 :], own[:line]
            yield from (after, before) if axis == 0 else (after.T.copy(), before.T.copy())


def _opened_up(observed: Observation, hypothesis: Hypothesis) -> Iterator[IntArray]:
    """Yield labels with a gap for a row or column of dots that was omitted between two.

    The stray dots are midway between those of two rays; the smaller part of the labels is shifted.
    """
    labels, stray_dots = hypothesis.labels, observed.plane_mm[hypothesis.stray_dots]
    for axis in (0, 1) if len(stray_dots) else ():
        own = labels if axis == 0 else labels.T
        line, place = np.nonzero((own[:-1] != UNLABELLED) & (own[1:] != UNLABELLED))
        ends = observed.plane_mm[own[line, place]], observed.plane_mm[own[line + 1, place]]
        apart = np.linalg.norm(ends[1] - ends[0], axis=-1)
        off = scipy.spatial.cKDTree(stray_dots).query((ends[0] + ends[1]) / 2)[0]
        lines, between = np.unique(line[off < MIDDLE * apart], return_counts=True)
        for k in lines[between >= LEAST_BETWEEN]:
            wider = np.full_like(own, UNLABELLED)
            if np.sum(own[: k + 1] != UNLABELLED) < np.sum(own[k + 1 :] != UNLABELLED):
                wider[:k], wider[k + 1 :] = own[1 : k + 1], own[k + 1 :]
            else:
                wider[: k + 1], wider[k + 2 :] = own[: k + 1], own[k + 1 : -1]
            yield wider if axis == 0 else wider.T.copy()


def _about_unexplained(observed: Observation, hypothesis: Hypothesis) -> BoolArray:
    """Mask of missed rays, of rays nearest to stray dots, and of `DISCARDED_RINGS` around them."""
    missed_rays, stray = hypothesis.missed_rays, hypothesis.stray_dots
    about = np.zeros(hypothesis.labels.shape, bool)
    about[tuple(missed_rays.T)] = True
    rays = predict(observed, hypothesis.pool, within_rings(hypothesis.labels, 1))
    if len(stray) and len(rays.at):
        nearest = rays.at[scipy.spatial.cKDTree(rays.plane_mm).query(observed.plane_mm[stray])[1]]
        about[nearest[:, 0], nearest[:, 1]] = True
    if not about.any():
        return about
    return widened(about, DISCARDED_RINGS)


def with_rows_beyond(observed: Observation, found: list[Hypothesis]) -> list[Hypothesis]:
    """Extend the cheapest hypotheses by a row that growth did not reach, and add the results.

    Beyond the last row a surface may be so uncertain that each dot there has several candidate
    rays; `grow_labels` then labels none. Here each candidate is tried, and the result is a
    hypothesis like the others: a row assigned to the wrong rays is penalised for the rays that it
    skips, or costs nearly as much as another hypothesis.
    """
    # The cheapest of all, and the cheapest with an empty marker, which may lack only a row.
    groups = (found, [hypothesis for hypothesis in found if hypothesis.marker == "empty"])
    starts = [min(group, key=lambda hypothesis: hypothesis.misfit) for group in groups if group]
    for start in starts[:1] + [start for start in starts[1:] if start is not starts[0]]:
        best: Hypothesis | None = start
        while best is not None:
            most = MOST_BEYOND * len(observed.plane_mm)
            wider = _rows_begun(observed, best) if LEAST_ROW <= best.stray_count <= most else []
            found = [*found, *wider]
            cheapest = min(wider, key=lambda hypothesis: hypothesis.misfit, default=best)
            best = cheapest if cheapest.misfit < best.misfit else None
    return found


def _rows_begun(observed: Observation, hypothesis: Hypothesis) -> list[Hypothesis]:
    """Assign a stray dot to each candidate ray beyond the labelled ones, and grow the labels.

    The `MOST_PAIRS` likeliest pairs are tried, except those that an earlier one has led to. As a
    surface can fit any single dot, the labels must grow by at least `LEAST_ROW` dots.
    """
    labels = hypothesis.labels
    found: list[Hypothesis] = []
    stray = np.setdiff1d(np.arange(len(observed.plane_mm)), labels)
    beyond = within_rings(labels, 2) & (labels == UNLABELLED) & ~observed.rays.absent
    rays = predict(observed, hypothesis.pool, beyond)
    if len(stray) == 0 or len(rays.at) == 0:
        return found
    distance, deviance = pair_deviances(observed, hypothesis.pool, rays, stray)
    for pair in np.argsort(deviance, axis=None)[:MOST_PAIRS]:
        dot, ray = (int(k) for k in np.unravel_index(pair, deviance.shape))
        at = tuple(rays.at[ray])
        vague = deviance[dot, ray] > false_dot_deviance()
        if (
            vague
            or distance[dot, ray] > GATE_SIGMA2
            or any(one.labels[at] == stray[dot] for one in found)
        ):
            continue
        more = labels.copy()
        more[at] = stray[dot]
        wider = grow_and_evaluate(observed, more, least=hypothesis.label_count + LEAST_ROW)
        if wider is not None:
            found.append(wider)
    return found


def _with_missing(observed: Observation, wider: Hypothesis, new: BoolArray) -> Hypothesis:
    """Correct new labels that continue a row or column although the next dot is missing.

    Such a dot is that of the ray after the next. It loses its label if it may be.

    Parameters
    ----------
    observed
        The dots.
    wider
        Hypothesis with the new labels.
    new
        Mask of these, shape (rows, columns).
    """
    rows, columns = new.shape
    for i, j in np.argwhere(new).tolist():
        for k, t in ((i - 1, j), (i + 1, j), (i, j - 1), (i, j + 1)):
            before = (2 * i - k, 2 * j - t)
            if not (0 <= k < rows and 0 <= t < columns and min(before) >= 0):
                continue
            if before[0] >= rows or before[1] >= columns or wider.labels[before] == UNLABELLED:
                continue
            if wider.labels[k, t] != UNLABELLED or observed.rays.absent[k, t]:
                continue
            labels = wider.labels.copy()
            labels[k, t], labels[i, j] = labels[i, j], UNLABELLED
            moved = evaluate_averaged(observed, labels, FINE_FIT, wider.pool)
            if moved is not None and moved.cost < wider.cost + RIVAL_MARGIN:
                labels[k, t] = UNLABELLED
                wider = evaluate_averaged(observed, labels, FINE_FIT, wider.pool) or wider
                break
    return wider


def with_rim(observed: Observation, best: Hypothesis) -> Hypothesis:
    """Label the dots of a steep rim, if this costs less than that they are false.

    The surface through the others is too smooth to predict them. Fine knots follow a steep rim.
    Nothing is labelled if many dots would still have no ray: among false dots some continue rows.

    Raises
    ------
    CannotMeasure
        ``no-match`` if it costs more, but only because the surface is rough; or if many of these
        dots, or of the others, may be false.
    """
    evidence = rim_evidence(observed, best.labels)
    if evidence <= RIM_POSSIBLE:
        return best
    own = evaluate_averaged(observed, best.labels, FINE_FIT, best.pool)
    labels = continued_labels(observed, best.labels)
    wider = evaluate_averaged(observed, labels, FINE_FIT, best.pool)
    if own is None or wider is None:
        return best
    new = (best.labels == UNLABELLED) & (labels != UNLABELLED)
    are_few = wider.stray_count <= few_left(observed)
    if are_few and wider.cost <= own.cost + 2 * evidence:
        wider = _with_missing(observed, wider, new)
        if wider.stray_count:  # among false dots, one that stands alone may be false, too
            alone = new & (neighbours_of(wider.labels != UNLABELLED) <= WEAK_NEIGHBOURS)
            if np.count_nonzero(alone) > few_left(observed):
                refuse_rim_left_out()
            labels = np.where(alone, UNLABELLED, wider.labels)
            wider = evaluate_averaged(observed, labels, FINE_FIT, wider.pool) or wider
        # A ray that lost its label as doubtful is not known to be dark.
        unknown = ((best.ray_states == 0) | new) & (wider.labels == UNLABELLED)
        return replace(wider, ray_states=np.where(unknown, 0, wider.ray_states))
    if wider.misfit < own.misfit:
        refuse_rim_left_out()
    return best
