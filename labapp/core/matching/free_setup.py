"""Whether another hole could be the marker's, given the uncertainty of the set-up.

If the set-up is wrong, labels shifted by a row or a column may have smaller residuals than correct
ones: a shift of the labels moves dots much as an error of the set-up by a fraction of the spacing
of the rays does. Hypotheses are therefore compared with a free set-up: each uses the set-up with
which it is likeliest, and its cost includes the deviation of this set-up from the given one.

Holes are distinguished by the boundary, the smoothness of the surface and the uncertainty of the
set-up. The residuals hardly contribute: the surface follows the dots of either hypothesis about
equally well.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from labapp.core.geometry.bench import Bench
from labapp.core.match import MatchedDots
from labapp.core.matching.hypothesis import (
    SHIFTS,
    USUAL_FIT,
    Hypothesis,
    evaluate,
    evaluate_averaged,
    grow_and_evaluate,
    shifted_by,
    variance_mm2,
)
from labapp.core.matching.observation import UNLABELLED, Observation, try_fit
from labapp.core.surface.pool_fit import FitSettings
from labapp.core.surface.setup_uncertainty import perturbed, residual_changes
from labapp.core.values import IntArray


@dataclass(frozen=True)
class FreeHypothesis:
    """Labels, and their cost with the set-up that makes them likeliest, given its uncertainty.

    Parameters
    ----------
    labels
        The given labels, or those grown from them with that set-up if these cost less.
    step
        Rows and columns by which the labels are shifted from those of the best hypothesis.
    given_cost
        Cost of the given labels, in units of χ²; infinite without a surface.
    cost
        Cost of `labels`, in units of χ²; infinite without a surface.
    """

    labels: IntArray
    step: tuple[int, int] = (0, 0)
    given_cost: float = np.inf
    cost: float = np.inf


def holes_left_open(
    observed: Observation, best: Hypothesis, fit_settings: FitSettings, margin: float
) -> list[FreeHypothesis]:
    """Hypotheses for each hole that may be the marker's, with a free set-up.

    Labels are those of the hypothesis, and those shifted by up to two rows or columns whose cost is
    higher by less than a margin. Shifts that place a dot at the marker's absent ray are omitted, as
    no set-up explains it. If the rig is known exactly, there are none.

    Parameters
    ----------
    observed
        The dots, and the bench with its uncertainty.
    best
        The best hypothesis.
    fit_settings
        Fit settings of the evaluation (`evaluate_averaged`).
    margin
        Largest difference in cost, in units of χ².

    Returns
    -------
    list
        The hypothesis itself first, then its rivals; empty if it has none.
    """
    steps = [] if observed.rig.uncertainty is None else _steps_to_other_holes(observed, best)
    if not steps:
        return []
    own = with_setup_free(observed, best, fit_settings)
    rivals = []
    for step in steps:
        shifted = evaluate(observed, shifted_by(observed, best.labels, step))
        if shifted is not None:
            rival = with_setup_free(observed, shifted, fit_settings, own.given_cost + margin)
            if rival.cost < own.cost + margin:
                rivals.append(replace(rival, step=step))
    return [own, *rivals] if rivals else []


def _steps_to_other_holes(observed: Observation, best: Hypothesis) -> list[tuple[int, int]]:
    """Shifts of the labels, in rows and columns, that place the marker in another hole."""
    marker = observed.rig.pattern.marker
    assert marker is not None
    holes = np.pad(best.labels == UNLABELLED, 2)  # beyond the pattern is no hole
    return [step for step in SHIFTS if holes[marker[0] + 1 - step[0], marker[1] + 1 - step[1]]]


def with_setup_free(
    observed: Observation, hypothesis: Hypothesis, fit_settings: FitSettings, most: float = np.inf
) -> FreeHypothesis:
    """Evaluate labels with the set-up with which they are likeliest.

    One Gauss–Newton step minimises the sum of the squared residuals and squared deviations of the
    set-up, both in σ, while the surface is refitted. It disregards the other parts of the cost: if
    these increase by more, the set-up stays as entered. Costs are infinite without a surface, and
    if the cost of the given labels is not below ``most``.
    """
    labels, uncertainty = hypothesis.labels, observed.rig.uncertainty
    pool = try_fit(observed, labels, USUAL_FIT, hypothesis.pool)
    if pool is None or uncertainty is None:
        return FreeHypothesis(labels)
    at = np.argwhere(labels != UNLABELLED)
    dot = labels[tuple(at.T)]
    sigma = np.repeat(np.sqrt(variance_mm2(observed, dot)), 2)
    matched = MatchedDots(
        at + 1, observed.plane_mm[dot], observed.covariance_mm2[dot], hypothesis.witness
    )
    change = residual_changes(matched, observed.rig, USUAL_FIT, pool).reshape(len(sigma), -1)
    finite = np.isfinite(change).all(axis=1)  # a ray at the rim may leave the splines
    jacobian = change[finite] / sigma[finite, None]
    rhs = -jacobian.T @ (pool.residual_mm.ravel() / sigma)[finite]
    deviation = np.linalg.solve(jacobian.T @ jacobian + np.eye(len(rhs)), rhs)
    rig, plane_mm = perturbed(observed.rig, uncertainty.root @ deviation, observed.plane_mm)
    moved = replace(observed, bench=Bench(rig, observed.bench.calibration), plane_mm=plane_mm)
    setup_cost = float(deviation @ deviation)
    entered = evaluate_averaged(observed, labels, fit_settings, pool)
    found = evaluate_averaged(moved, labels, fit_settings, pool)
    if found is None or entered is None:
        return FreeHypothesis(labels)
    given_cost = min(found.cost + setup_cost, entered.cost)
    if given_cost >= most:
        return FreeHypothesis(labels)
    more = grow_and_evaluate(moved, labels)
    grown = more and evaluate_averaged(moved, more.labels, fit_settings, more.pool)
    if grown and grown.cost + setup_cost < given_cost:
        return FreeHypothesis(grown.labels, given_cost=given_cost, cost=grown.cost + setup_cost)
    return FreeHypothesis(labels, given_cost=given_cost, cost=given_cost)
