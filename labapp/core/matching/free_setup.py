"""Whether another hole could be the marker's if the set-up were off by about its uncertainty.

Where the set-up is off, labels a row or a column off may leave smaller residuals than right ones: a
shift of the labels moves dots much as a set-up that is off by a part of the rays' spacing. So
hypotheses are compared with the set-up free: each is given the one that it is likeliest with, and
costs more the unlikelier that is.

What tells holes apart is the boundary, the smoothness of the surface and the uncertainty of the
set-up. The residuals hardly do: the surface follows the dots of either hypothesis about as well.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from labapp.core.geometry.bench import Bench
from labapp.core.matching.hypothesis import (
    STEPS,
    USUAL_KNOTS,
    Hypothesis,
    evaluate,
    evaluate_twice,
    grow_and_evaluate,
    shifted_by,
    variance_mm2,
)
from labapp.core.matching.observation import UNLABELLED, Observation, try_fit
from labapp.core.surface.pool_fit import FitSettings
from labapp.core.surface.setup_uncertainty import bench_off, residual_changes
from labapp.core.values import IntArray


@dataclass(frozen=True)
class FreeHypothesis:
    """Labels with the set-up that they are likeliest with, within its uncertainty.

    Parameters
    ----------
    labels
        They, or what they grow to there where that costs less.
    step
        Rows and columns by which the labels are on from those of the best hypothesis.
    given_cost
        Cost of the labels as they were given, in units of χ².
    cost
        That of `labels`; infinite, as the one before, without a surface.
    """

    labels: IntArray
    step: tuple[int, int] = (0, 0)
    given_cost: float = np.inf
    cost: float = np.inf


def holes_left_open(
    observed: Observation, best: Hypothesis, fit: FitSettings, margin: float
) -> list[FreeHypothesis]:
    """Hypotheses with the marker in each hole that it may be in, with the set-up free.

    Labels are those of the hypothesis, and the same up to two rows or columns on which cost less
    than a margin more. Other shifts put a dot on the marker's ray, which no set-up explains. A rig
    that is known exactly leaves nothing open.

    Parameters
    ----------
    observed
        The dots, and the bench with its uncertainty.
    best
        The hypothesis that is compared.
    fit
        How it is evaluated (`evaluate_twice`).
    margin
        In units of χ².

    Returns
    -------
    list
        The hypothesis itself first, then its rivals; empty where it has none.
    """
    steps = [] if observed.rig.uncertainty is None else _steps_to_other_holes(observed, best)
    if not steps:
        return []
    own = _with_setup_free(observed, best, fit)
    rivals = []
    for step in steps:
        shifted = evaluate(observed, shifted_by(observed, best.labels, step))
        if shifted is not None:
            rival = _with_setup_free(observed, shifted, fit, own.given_cost + margin)
            if rival.cost < own.cost + margin:
                rivals.append(replace(rival, step=step))
    return [own, *rivals] if rivals else []


def _steps_to_other_holes(observed: Observation, best: Hypothesis) -> list[tuple[int, int]]:
    """Rows and columns by which labels are shifted for the marker to be in another hole."""
    marker = observed.rig.pattern.marker
    assert marker is not None
    holes = np.pad(best.labels == UNLABELLED, 2)  # beyond the pattern is no hole
    return [step for step in STEPS if holes[marker[0] + 1 - step[0], marker[1] + 1 - step[1]]]


def _with_setup_free(
    observed: Observation, hypothesis: Hypothesis, fit: FitSettings, most: float = np.inf
) -> FreeHypothesis:
    """Labels with the set-up that they are likeliest with.

    That set-up is found in one Gauss–Newton step, which takes the squares of the residuals and of
    the set-up's deviations, in σ, to their least sum, the surface fitted anew. Costs are infinite
    without a surface, and where that of the labels as they are is not below ``most``.
    """
    labels, known = hypothesis.labels, observed.rig.uncertainty
    pool = try_fit(observed, labels, USUAL_KNOTS, hypothesis.pool)
    if pool is None or known is None:
        return FreeHypothesis(labels)
    at = np.argwhere(labels != UNLABELLED)
    dot = labels[tuple(at.T)]
    pairs = at + 1, observed.plane_mm[dot], observed.covariance_mm2[dot]
    sigma = np.repeat(np.sqrt(variance_mm2(observed, dot)), 2)
    change = residual_changes(*pairs, observed.rig, USUAL_KNOTS, pool).reshape(len(sigma), -1)
    met = np.isfinite(change).all(axis=1)  # a ray at the rim may leave the splines
    jacobian = change[met] / sigma[met, None]
    rhs = -jacobian.T @ (pool.residual_mm.ravel() / sigma)[met]
    deviates = np.linalg.solve(jacobian.T @ jacobian + np.eye(len(rhs)), rhs)
    rig, plane_mm = bench_off(observed.rig, known.root @ deviates, observed.plane_mm)
    moved = replace(observed, bench=Bench(rig, observed.bench.calibration), plane_mm=plane_mm)
    found, setup_cost = evaluate_twice(moved, labels, fit, pool), float(deviates @ deviates)
    if found is None or found.cost + setup_cost >= most:
        return FreeHypothesis(labels)
    more = grow_and_evaluate(moved, labels)
    grown = more and evaluate_twice(moved, more.labels, fit, more.pool)
    least = grown if grown and grown.cost < found.cost else found
    return FreeHypothesis(
        least.labels, given_cost=found.cost + setup_cost, cost=least.cost + setup_cost
    )
