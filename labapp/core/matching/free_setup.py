"""Hypotheses with the set-up free within its standard uncertainties.

Where the set-up is off, labels a row or a column off may leave smaller residuals than right ones: a
shift of the labels moves dots much as a set-up that is off by a part of the rays' spacing. So each
hypothesis is given the set-up that it is likeliest with, and costs more the unlikelier that is.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from labapp.core.geometry.bench import Bench
from labapp.core.matching.hypothesis import (
    STEPS,
    USUAL_KNOTS,
    Hypothesis,
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
class Adjusted:
    """A hypothesis with the set-up that it is likeliest with.

    Parameters
    ----------
    observed
        The frame's dots with that set-up.
    hypothesis
        Labels and surface there.
    setup_cost
        −2 log prior probability of the set-up, but for a constant.
    """

    observed: Observation
    hypothesis: Hypothesis
    setup_cost: float

    @property
    def cost(self) -> float:
        """−2 log likelihood of the hypothesis and its set-up."""
        return self.hypothesis.cost + self.setup_cost

    def grown(self, fit: FitSettings) -> Adjusted:
        """The same with what its labels grow to, where that costs less."""
        led = grow_and_evaluate(self.observed, self.hypothesis.labels)
        led = led and evaluate_twice(self.observed, led.labels, fit, led.pool)
        return replace(self, hypothesis=led) if led and led.cost < self.hypothesis.cost else self


def adjusted(observed: Observation, hypothesis: Hypothesis, fit: FitSettings) -> Adjusted | None:
    """Return a hypothesis with its likeliest set-up; None if no surface has its labels there.

    The set-up is found in one Gauss–Newton step, which takes the squares of the residuals and of
    the set-up's deviations to their least sum, the surface fitted anew.

    Parameters
    ----------
    observed
        The dots, and the bench with its uncertainty.
    hypothesis
        Labels, and a surface through them.
    fit
        How it is evaluated (`evaluate_twice`).
    """
    labels, known = hypothesis.labels, observed.rig.uncertainty
    pool = try_fit(observed, labels, USUAL_KNOTS, hypothesis.pool)
    if pool is None or known is None:
        return None
    at = np.argwhere(labels != UNLABELLED)
    dot = labels[tuple(at.T)]
    pairs = at + 1, observed.plane_mm[dot], observed.covariance_mm2[dot]
    sigma = np.repeat(np.sqrt(variance_mm2(observed, dot)), 2)
    change = residual_changes(*pairs, observed.rig, USUAL_KNOTS, pool).reshape(len(sigma), -1)
    met = np.isfinite(change).all(axis=1)  # a ray at the rim may leave the splines
    rows = change[met] / sigma[met, None]
    rhs = -rows.T @ (pool.residual_mm.ravel() / sigma)[met]
    deviates = np.linalg.solve(rows.T @ rows + np.eye(len(rhs)), rhs)
    setup_cost = float(deviates @ deviates)
    if setup_cost > hypothesis.cost:
        return None
    rig, plane_mm = bench_off(observed.rig, known.root @ deviates, observed.plane_mm)
    moved = replace(observed, bench=Bench(rig, observed.bench.calibration), plane_mm=plane_mm)
    found = evaluate_twice(moved, labels, fit, pool)
    return None if found is None else Adjusted(moved, found, setup_cost)


def labels_by_other_holes(observed: Observation, labels: IntArray) -> list[IntArray]:
    """The same labels up to two rows or columns on, where the marker is in another hole there.

    Any other shift puts a dot on the marker's ray, which no set-up explains.
    """
    marker = observed.rig.pattern.marker
    assert marker is not None
    holes = np.pad(labels == UNLABELLED, 2)  # beyond the pattern is no hole
    return [
        shifted_by(observed, labels, step)
        for step in STEPS
        if holes[marker[0] + 1 - step[0], marker[1] + 1 - step[1]]
    ]
