"""Whether another hole could be the marker's if the set-up were off by about its uncertainty.

Where the set-up is off, labels a row or a column off may leave smaller residuals than right ones: a
shift of the labels moves dots much as a set-up that is off by a part of the rays' spacing. So
hypotheses are compared with the set-up free: each is given the one that it is likeliest with, and
costs more the unlikelier that is.
"""

from __future__ import annotations

from dataclasses import replace

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


def another_hole_explains(
    observed: Observation, best: Hypothesis, fit: FitSettings, margin: float
) -> bool:
    """Whether the marker in another hole costs less than a margin more, with the set-up free.

    Its labels are those of the hypothesis up to two rows or columns on. Other shifts put a dot on
    the marker's ray, which no set-up explains. A rig that is known exactly leaves nothing open.

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
    """
    others = [] if observed.rig.uncertainty is None else _labels_by_other_holes(observed, best)
    if not others:
        return False
    own, own_grown = _costs_with_setup_free(observed, best, fit)
    rivals = (rival for labels in others if (rival := evaluate(observed, labels)))
    costs = (_costs_with_setup_free(observed, rival, fit, own + margin) for rival in rivals)
    return any(grown < own_grown + margin for _, grown in costs)


def _labels_by_other_holes(observed: Observation, best: Hypothesis) -> list[IntArray]:
    """The same labels up to two rows or columns on, where the marker is in another hole."""
    marker = observed.rig.pattern.marker
    assert marker is not None
    holes = np.pad(best.labels == UNLABELLED, 2)  # beyond the pattern is no hole
    return [
        shifted_by(observed, best.labels, step)
        for step in STEPS
        if holes[marker[0] + 1 - step[0], marker[1] + 1 - step[1]]
    ]


def _costs_with_setup_free(
    observed: Observation, hypothesis: Hypothesis, fit: FitSettings, most: float = np.inf
) -> tuple[float, float]:
    """Cost of labels and of the set-up that they are likeliest with; of what they grow to there.

    That set-up is found in one Gauss–Newton step, which takes the squares of the residuals and of
    the set-up's deviations, in σ, to their least sum, the surface fitted anew. Costs are infinite
    without a surface, and where that of the labels as they are is not below ``most``.
    """
    labels, known = hypothesis.labels, observed.rig.uncertainty
    pool = try_fit(observed, labels, USUAL_KNOTS, hypothesis.pool)
    if pool is None or known is None:
        return np.inf, np.inf
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
        return np.inf, np.inf
    more = grow_and_evaluate(moved, labels)
    grown = more and evaluate_twice(moved, more.labels, fit, more.pool)
    least = min(found.cost, grown.cost if grown else np.inf)
    return found.cost + setup_cost, least + setup_cost
