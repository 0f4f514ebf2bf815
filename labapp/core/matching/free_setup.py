"""Whether another hole could be the marker's, given the uncertainty of the set-up.

If the set-up is wrong, labels shifted by a row or a column may have smaller residuals than correct
ones: a shift of the labels moves dots much as an error of the set-up by a fraction of the spacing
of the rays does. Hypotheses are therefore compared with a free set-up: each uses the set-up as
entered or the one with which it is likeliest, which costs more. Rows that fit the set-up as entered
as well as any other are therefore preferred: wrong rows hardly ever do.

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
    MISSED_COST,
    STRAY_COST,
    USUAL_FIT,
    Hypothesis,
    evaluate,
    evaluate_averaged,
    grow_and_evaluate,
    roughness_weight,
    variance_mm2,
)
from labapp.core.matching.observation import UNLABELLED, Observation, amid, try_fit
from labapp.core.matching.relabelling import SHIFTS, shifted_by
from labapp.core.surface.pool_fit import FitSettings, FittedPool
from labapp.core.surface.setup_uncertainty import fit_changes, perturbed
from labapp.core.values import FloatArray, IntArray

MOST_STEPS, LEAST_GAIN, MOST_GAIN = 4, 1.0, 30.0
"""Largest number of steps to the likeliest set-up; decrease of the cost that justifies another; and
the most that all steps after the first were seen to gain, in units of χ²."""

WORTH_SHARE = 0.2
"""The first step is taken only if its expected gain exceeds this share of what another set-up costs
(`with_setup_free`). With less, the actual gain was at most half of that cost in 200 fits of
cluttered frames."""

MOST_STARTS = 8
"""Maximum number of hypotheses whose set-up is freed if that as entered explains none."""

SETUP_GAIN = 80.0
"""If another set-up lowers the cost of a hypothesis by more, the one as entered is in doubt. With
the true one, cluttered frames gained less than 40; with errors of one standard uncertainty, most
gained hundreds."""

LEAST_COST = SETUP_GAIN / 2
"""A hypothesis whose surface and labelled dots cost less does not gain `SETUP_GAIN`: of 80 frames
that gained so much, none cost less than 56. With the true set-up most cost 10 to 40."""


@dataclass(frozen=True)
class FreeHypothesis:
    """Labels, and their cost with the set-up that makes them likeliest, given its uncertainty.

    Parameters
    ----------
    labels
        The given labels, or those grown from them with that set-up if these cost less.
    step
        Rows and columns by which the labels are shifted from those of the best hypothesis.
    cost
        Cost of `labels`, in units of χ²; infinite without a surface.
    observed
        The dots with that set-up; None without a surface.
    gain
        How much less the cost is than with the set-up as entered.
    marker_cost
        Part of the cost for a dot at the marker's absent ray.
    """

    labels: IntArray
    step: tuple[int, int] = (0, 0)
    cost: float = np.inf
    observed: Observation | None = None
    gain: float = 0.0
    marker_cost: float = 0.0

    @property
    def with_likelier_setup(self) -> Observation | None:
        """The dots with that set-up taken as exact; None if the one as entered is not in doubt."""
        if self.observed is None or self.gain <= SETUP_GAIN:
            return None
        rig = replace(self.observed.rig, uncertainty=None)
        return replace(self.observed, bench=Bench(rig, self.observed.bench.calibration))


def holes_left_open(
    observed: Observation, best: Hypothesis, fit_settings: FitSettings, margin: float
) -> list[FreeHypothesis]:
    """A hypothesis with a free set-up, and those for other holes that may be the marker's.

    Labels are those of the hypothesis, and those shifted by up to two rows or columns whose cost is
    higher by less than a margin; if the set-up is in doubt, also those with the marker in any hole
    between labelled rays. Shifts that place a dot at the marker's absent ray are omitted, as no
    set-up explains it.

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
        The hypothesis itself first, then its rivals; empty if the rig is known exactly, the
        hypothesis explains every dot and leaves no hole, or no hole is near and its labelled dots
        put the set-up beyond doubt.
    """
    near, far = _steps_to_near_holes(observed, best.labels), _steps_to_holes(observed, best.labels)
    if observed.rig.uncertainty is None or not (near or far or best.stray_count):
        return []
    unexplained = STRAY_COST * best.stray_count + MISSED_COST * best.missed_count
    if not near and best.cost - unexplained < LEAST_COST:
        return []
    own = with_setup_free(observed, best, fit_settings, grow=bool(near))
    steps, most = near, own.cost + margin
    if own.gain > SETUP_GAIN:
        # Shifted labels may cost much less once they are grown, and the right rows be far.
        steps, most = sorted({*near, *far}), most + MOST_GAIN
    rivals = []
    for step in steps:
        shifted = evaluate(observed, shifted_by(observed, own.labels, step))
        if shifted is not None:
            rival = with_setup_free(observed, shifted, fit_settings, most)
            if rival.cost < own.cost + margin:
                rivals.append(replace(rival, step=step))
    return [own, *rivals]


def unconfirmed(free: FreeHypothesis, labels: IntArray) -> IntArray:
    """Dots that lose or change their ray with the likeliest set-up, if that as entered is in doubt.

    Parameters
    ----------
    free
        The hypothesis with a free set-up.
    labels
        Its labels with the set-up as entered, shape (rows, columns).
    """
    if free.with_likelier_setup is None:
        return np.zeros(0, np.int64)
    return np.asarray(labels[(labels != UNLABELLED) & (labels != free.labels)])


def _steps_to_near_holes(observed: Observation, labels: IntArray) -> list[tuple[int, int]]:
    """Shifts of labels by up to two rows and columns that place the marker in another hole."""
    marker = observed.rig.pattern.marker
    assert marker is not None
    holes = np.pad(labels == UNLABELLED, 2)  # beyond the pattern is no hole
    return [step for step in SHIFTS if holes[marker[0] + 1 - step[0], marker[1] + 1 - step[1]]]


def with_setups_free(
    observed: Observation, found: list[Hypothesis], fit_settings: FitSettings
) -> list[FreeHypothesis]:
    """Free the set-up of the cheapest hypotheses that differ in most labels, `MOST_STARTS` at most.

    With a wrong set-up the correct labels may cost more than others.

    Parameters
    ----------
    observed
        The dots, and the bench with its uncertainty.
    found
        Hypotheses for the set-up as entered, at least one.
    fit_settings
        Fit settings of the evaluation.

    Returns
    -------
    list
        In ascending order of the cost with the set-up as entered.
    """
    distinct: list[Hypothesis] = []
    for each in sorted(found, key=lambda hypothesis: hypothesis.cost):
        if not any(mostly_equal(each.labels, other.labels) for other in distinct):
            distinct.append(each)
    return [with_setup_free(observed, each, fit_settings) for each in distinct[:MOST_STARTS]]


def shifted_to_holes(
    observed: Observation, labels: IntArray, fit_settings: FitSettings
) -> list[FreeHypothesis]:
    """Free the set-up of labels shifted so that the marker is in each hole between labelled rays.

    Parameters
    ----------
    observed
        The dots, and the bench with its uncertainty.
    labels
        Index of each ray's dot or `UNLABELLED`, shape (rows, columns).
    fit_settings
        Fit settings of the evaluation.

    Returns
    -------
    list
        The labels themselves, then the shifted ones; those without a surface are omitted.
    """
    steps = [(0, 0), *_steps_to_holes(observed, labels)]
    shifted = (evaluate(observed, shifted_by(observed, labels, step)) for step in steps)
    return [with_setup_free(observed, each, fit_settings) for each in shifted if each]


def _steps_to_holes(observed: Observation, labels: IntArray) -> list[tuple[int, int]]:
    """Shifts of labels that place the marker in another hole between labelled rays."""
    marker, lit = observed.rig.pattern.marker, labels != UNLABELLED
    assert marker is not None
    steps = marker - np.array([1, 1]) - np.argwhere(amid(lit) & ~lit)
    return [(row, column) for row, column in steps.tolist() if row or column]


def mostly_equal(one: IntArray, other: IntArray) -> bool:
    """Whether most of the labelled rays have the same dot in other labels."""
    lit = one != UNLABELLED
    return bool(np.mean(one[lit] == other[lit]) > 0.5)


def with_setup_free(
    observed: Observation,
    hypothesis: Hypothesis,
    fit_settings: FitSettings,
    most: float = np.inf,
    *,
    grow: bool = True,
) -> FreeHypothesis:
    """Evaluate labels with the set-up as entered or, if that costs less, the likeliest one.

    The likeliest set-up within its uncertainty costs the squared deviation in σ and, as it can fit
    anything better, the logarithm of the determinant of its normal matrix (Laplace's approximation
    of the integral over the deviations). Costs are infinite without a surface, and if the cost of
    the given labels is not below ``most``. Unless ``grow`` is true, labels are grown only with
    another set-up.
    """
    labels, uncertainty = hypothesis.labels, observed.rig.uncertainty
    pool = try_fit(observed, labels, USUAL_FIT, hypothesis.pool)
    if pool is None or uncertainty is None:
        return FreeHypothesis(labels)
    entered = evaluate_averaged(observed, labels, fit_settings, pool)
    if entered is None:
        return FreeHypothesis(labels)
    cost, setup_cost, likeliest = entered.cost, 0.0, observed
    moved = _with_likeliest_setup(observed, hypothesis, pool, entered.cost, fit_settings, most)
    if moved[0] < cost:
        cost, setup_cost, likeliest = moved
    if cost >= most:
        return FreeHypothesis(labels)
    is_regrown = grow or likeliest is not observed
    more = grow_and_evaluate(likeliest, labels) if is_regrown else None
    grown = more and evaluate_averaged(likeliest, more.labels, fit_settings, more.pool)
    if grown and grown.cost + setup_cost < cost:
        labels, cost = grown.labels, grown.cost + setup_cost
    gain = 0.0 if likeliest is observed else entered.cost - cost
    freed = evaluate_averaged(likeliest, labels, fit_settings, pool)
    marker_cost = freed.cost - freed.cost_without_marker if freed else 0.0
    without_fits = replace(likeliest)  # those of many hypotheses would take gigabytes
    return FreeHypothesis(
        labels, cost=cost, observed=without_fits, gain=gain, marker_cost=marker_cost
    )


def _with_likeliest_setup(
    observed: Observation,
    hypothesis: Hypothesis,
    pool: FittedPool,
    cost: float,
    fit_settings: FitSettings,
    most: float,
) -> tuple[float, float, Observation]:
    """Cost of labels with the likeliest set-up, the set-up's share of it, and the dots with it.

    Gauss–Newton steps lead to this set-up, as long as each lowers the cost by `LEAST_GAIN`, and the
    cost may become less than ``most``. The surface and its cost are given for the set-up as
    entered.
    """
    assert observed.rig.uncertainty is not None
    moved, deviation = observed, np.zeros(observed.rig.uncertainty.root.shape[1])
    square = log_determinant = 0.0
    for _ in range(MOST_STEPS):
        step, log_determinant, expected = _step(moved, hypothesis, pool, deviation)
        if moved is observed and expected < WORTH_SHARE * log_determinant:
            break
        further = _with_deviation(observed, deviation + step)
        fitted = try_fit(further, hypothesis.labels, USUAL_FIT, pool)
        if fitted is None:
            break
        found = evaluate_averaged(further, hypothesis.labels, fit_settings, fitted)
        length = float(np.sum((deviation + step) ** 2))
        if found is None or found.cost + length > cost:
            break
        gain = cost - (found.cost + length)
        moved, deviation, pool, square = further, deviation + step, fitted, length
        cost = found.cost + square
        if gain < LEAST_GAIN or cost + log_determinant > most + MOST_GAIN:
            break
    return cost + log_determinant, square + log_determinant, moved


def _with_deviation(observed: Observation, deviation: FloatArray) -> Observation:
    """The dots with the set-up changed by a deviation in σ of its independent errors, (q,)."""
    uncertainty = observed.rig.uncertainty
    assert uncertainty is not None
    rig, plane_mm = perturbed(observed.rig, uncertainty.root @ deviation, observed.plane_mm)
    return replace(observed, bench=Bench(rig, observed.bench.calibration), plane_mm=plane_mm)


def _step(
    observed: Observation, hypothesis: Hypothesis, pool: FittedPool, deviation: FloatArray
) -> tuple[FloatArray, float, float]:
    """Gauss–Newton step of the set-up's deviation from the entered one, in σ.

    It minimises the sum of squared residuals and squared deviations, both in σ, and the cost of the
    roughness, while the surface is refitted. ``pool`` is fitted with the present deviation.

    Returns
    -------
    step, log_determinant, gain
        The step, shape (q,), the logarithm of the determinant of the normal matrix, and the
        expected decrease of the cost, in units of χ².
    """
    at = np.argwhere(hypothesis.labels != UNLABELLED)
    dot = hypothesis.labels[tuple(at.T)]
    sigma = np.repeat(np.sqrt(variance_mm2(observed, dot)), 2)
    matched = MatchedDots(
        at + 1, observed.plane_mm[dot], observed.covariance_mm2[dot], hypothesis.ray_states
    )
    residuals, coefficients = fit_changes(matched, observed.rig, pool)
    change = residuals.reshape(len(sigma), -1)
    finite = np.isfinite(change).all(axis=1)  # a ray at the rim may leave the splines
    jacobian = change[finite] / sigma[finite, None]
    rough = roughness_weight(pool) * pool.surface.basis.roughness_products(coefficients)
    normal = jacobian.T @ jacobian + np.eye(len(deviation)) + coefficients.T @ rough
    rhs = jacobian.T @ (pool.residual_mm.ravel() / sigma)[finite] + deviation
    rhs += rough.T @ pool.surface.coefficients
    # Its eigenvalues are at least 1; for labels that hardly fit, rounding may hide this.
    values, vectors = np.linalg.eigh(normal)
    values = np.maximum(values, 1.0)
    along = vectors.T @ rhs
    gain = float(np.sum(along**2 / values))
    return -vectors @ (along / values), float(np.log(values).sum()), gain
