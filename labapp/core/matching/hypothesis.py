"""Hypothesis: one assignment of rays to all dots of a frame, and its cost.

The cost is in units of χ²: squared residuals of the dots over their variance, a fixed cost for each
stray dot and each missed ray, the contradictions of the rays near the boundary, and the roughness
of the surface.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from labapp.core.match import Orientation
from labapp.core.matching.label_growth import grow_labels
from labapp.core.matching.observation import (
    UNLABELLED,
    Observation,
    amid,
    count_labels,
    neighbours_of,
    try_fit,
)
from labapp.core.matching.prediction import (
    FALSE_DOTS_PER_MM2,
    RIVAL_MARGIN,
    RayPaths,
    false_dot_deviance,
    pair_deviances,
    predict,
)
from labapp.core.matching.ray_classes import RayClasses, classify_rays
from labapp.core.surface.level import Level
from labapp.core.surface.pool_fit import (
    CORRELATED_MM2,
    ROUGHNESS_FREEDOM,
    FitSettings,
    FittedPool,
)
from labapp.core.values import BoolArray, CannotMeasure, FloatArray, IntArray

KNOT_ERROR_MM = 0.045
"""Standard error of dots, mm, because the knots of the correct surface cannot follow a dent."""

USUAL_FIT = FitSettings(settled_mm=1e-3)
FINE_FIT, WIDE_FIT = replace(USUAL_FIT, knot_mm=0.5), replace(USUAL_FIT, knot_mm=1.0)
"""Fit settings for the evaluation of a hypothesis. Their knots are those of the final fit; fine
enough for a narrow dip under the torch, whose residuals would mask what is unexplained; or wide
enough that a row which the operator has shifted stands out."""

BEYOND_SPACINGS, FEW_BEYOND = 0.25, 2
"""A lit ray is beyond the boundary if it lands farther outside than this, in spacings of the rays;
up to this number of them is attributed to false dots."""

STRAY_COST, MISSED_COST, LIT_MARKER_COST = 16.0, 12.0, 60.0
"""Costs of a stray dot, of a missed ray, and of a dot at the marker's absent ray, in units of χ².
The last is largest, as such a dot is rarely false: labels shifted by a row or a column nearly
always place a dot there."""

SETUP_ERROR_MM, MOST_BOUNDARY_COST = 0.01, 60.0
"""Error of the height at the boundary due to the set-up, mm; and the largest cost of the rays near
the boundary, in units of χ²."""

Marker = Literal["empty", "lit", "unknown"]
"""State of the place of the marker's absent dot: ``lit``, there is a dot; ``empty``, there is
none, between labelled rays; ``unknown``, there is none, but none need be visible there either."""

WEAK_NEIGHBOURS, FALSE_MARGIN = 3, 2 * np.log(10)
"""A label with at most this number of labelled neighbours is weak: it depends on the dots on one
side of it. Its deviance must be lower than that of a false dot by this additional margin, a factor
of ten in likelihood: beyond the last row most rays are dark."""

MARKER_SPACINGS = 1 / 3
"""The marker is lit if a dot is nearer than this fraction of the distance to the nearest
prediction."""

MOST_KEPT = 50
"""Number of evaluated hypotheses of a frame that are kept: their surfaces have some 20 MB."""


@dataclass(frozen=True)
class Hypothesis:
    """Labels, the surface fitted to them, and what the surface leaves unexplained.

    Parameters
    ----------
    labels
        Index of each ray's dot or `UNLABELLED`, shape (rows, columns).
    pool
        The surface.
    ray_states
        See `Match.ray_states`.
    missed_rays
        Rows and columns of the rays between lit rays that have no dot, counted from 0, shape
        (m, 2).
    stray_dots
        Indices of the dots that have no ray, shape (s,).
    marker
        State of the marker's absent dot; None if the pattern has no marker.
    misfit_without_marker
        χ² of the dots, `STRAY_COST` and `MISSED_COST` for each stray dot and missed ray, and the
        cost of the boundary.
    roughness
        −2 log probability of the third derivatives of the surface.
    """

    labels: IntArray
    pool: FittedPool
    ray_states: IntArray
    missed_rays: IntArray
    stray_dots: IntArray
    marker: Marker | None
    misfit_without_marker: float
    roughness: float

    @property
    def misfit(self) -> float:
        """Cost of what is left unexplained, in units of χ², including a dot at the marker."""
        return self.misfit_without_marker + LIT_MARKER_COST * (self.marker == "lit")

    @property
    def cost(self) -> float:
        """−2 log likelihood of the hypothesis: misfit and roughness."""
        return self.misfit + self.roughness

    @property
    def cost_without_marker(self) -> float:
        """Cost without that of a dot at the marker, which may be a false dot."""
        return self.misfit_without_marker + self.roughness

    @property
    def stray_count(self) -> int:
        """Number of dots without a ray."""
        return len(self.stray_dots)

    @property
    def missed_count(self) -> int:
        """Number of rays between lit rays that have no dot."""
        return len(self.missed_rays)

    @property
    def label_count(self) -> int:
        """Number of dots with a ray."""
        return count_labels(self.labels)

    @property
    def residual_rms_mm(self) -> float:
        """Root mean square distance of computed from captured dots, mm."""
        return self.pool.residual_rms_mm

    def orientation(self, observed: Observation) -> Orientation:
        """Determine the orientation of the labels."""
        return orientation_of(observed, self.labels)


def orientation_of(observed: Observation, labels: IntArray) -> Orientation:
    """Determine the orientation of labels from the directions of their rows and columns."""
    at = np.argwhere(labels != UNLABELLED)
    place = np.full((*labels.shape, 2), np.nan)
    place[at[:, 0], at[:, 1]] = observed.plane_mm[labels[at[:, 0], at[:, 1]]]
    if np.nansum(np.sign(np.diff(place[..., 1], axis=0))) >= 0:
        return "S/S"
    return "S/I" if np.nansum(np.sign(np.diff(place[..., 0], axis=1))) >= 0 else "I/I"


def grow_and_evaluate(
    observed: Observation,
    labels: IntArray,
    fit_settings: FitSettings = USUAL_FIT,
    knot_mm: float | None = None,
    least: int = 0,
) -> Hypothesis | None:
    """Grow labels (`grow_labels`) and evaluate the result.

    None if no surface fits it, or it has fewer labels than ``least``.
    """
    grown = grow_labels(observed, labels, knot_mm)
    if grown is None or count_labels(grown) < least:
        return None
    hypothesis = evaluate(observed, grown, fit_settings)
    if hypothesis is None:
        return None
    outside = _outside(observed, hypothesis)
    # Many lit rays beyond the contour indicate a rear below the work piece; one or two, false dots.
    if not 0 < len(outside) <= FEW_BEYOND:
        return hypothesis
    labels = hypothesis.labels.copy()
    labels[outside[:, 0], outside[:, 1]] = UNLABELLED
    return None if count_labels(labels) < least else evaluate(observed, labels, fit_settings)


def _outside(observed: Observation, hypothesis: Hypothesis) -> IntArray:
    """Labelled rays that land well outside the boundary of the fit."""
    at = np.argwhere(hypothesis.labels != UNLABELLED)
    landing = observed.rays.landing_mm[at[:, 0], at[:, 1]]
    height, slope = hypothesis.pool.surface.height_and_gradient(*landing[:, :2].T)
    level, laser_mm = hypothesis.pool.level, observed.rig.laser.position_mm
    inward = level.height_inside(height, slope, landing, laser_mm)
    far = inward < -BEYOND_SPACINGS * np.linalg.norm(slope * observed.rays.spacing_mm, axis=-1)
    return np.asarray(at[far])


def evaluate(
    observed: Observation,
    labels: IntArray,
    fit_settings: FitSettings = USUAL_FIT,
    initial: FittedPool | None = None,
) -> Hypothesis | None:
    """Fit the surface to given labels and compute their cost; None if no surface fits them.

    The fit starts from ``initial``, which saves rounds if it is close. Different ways often lead to
    the same labels: the last `MOST_KEPT` results are kept.
    """
    known, key = observed.evaluated, (labels.tobytes(), fit_settings)
    if key not in known:
        if len(known) == MOST_KEPT:
            del known[next(iter(known))]
        known[key] = _evaluated(observed, labels, fit_settings, initial)
    found: Hypothesis | None = known[key]
    return found and replace(found)  # a copy, as `repair` compares hypotheses with `is`


def _evaluated(
    observed: Observation, labels: IntArray, fit_settings: FitSettings, initial: FittedPool | None
) -> Hypothesis | None:
    """Fit and evaluate as `evaluate`, without looking at the kept results."""
    pool = try_fit(observed, labels, initial=initial)
    if pool is None:
        return None
    ray_states = classify_rays(observed, labels, paths_of(observed, pool)).ray_states
    try:
        pool = observed.fit(labels, ray_states, fit_settings, pool)
    except CannotMeasure:
        return None
    paths = paths_of(observed, pool)
    classes, marker, cost = _misfit(observed, labels, pool, paths)
    return Hypothesis(
        labels=labels,
        pool=pool,
        ray_states=classes.ray_states,
        missed_rays=np.stack(np.divmod(classes.missed, labels.shape[1]), axis=-1),
        stray_dots=classes.stray,
        marker=marker,
        misfit_without_marker=cost + _boundary_cost(pool.level),
        roughness=_roughness_cost(pool),
    )


def evaluate_averaged(
    observed: Observation, labels: IntArray, fit_settings: FitSettings, initial: FittedPool
) -> Hypothesis | None:
    """Evaluate labels; with fine knots the cost is the mean of those with fine and usual knots.

    The usual knots do not follow a dip; fine ones allow the rough surface that wrong labels need.
    A marker that is lit with the usual knots counts as lit.
    """
    hypothesis = evaluate(observed, labels, fit_settings, initial=initial)
    if hypothesis is None or fit_settings != FINE_FIT:
        return hypothesis
    usual = evaluate(observed, labels, USUAL_FIT, initial=initial)
    if usual is None:
        return None
    marker = "lit" if usual.marker == "lit" else hypothesis.marker
    misfit = (hypothesis.misfit_without_marker + usual.misfit_without_marker) / 2
    roughness = (hypothesis.roughness + usual.roughness) / 2
    return replace(hypothesis, marker=marker, misfit_without_marker=misfit, roughness=roughness)


def paths_of(observed: Observation, pool: FittedPool) -> RayPaths:
    """Paths of all rays for a fitted surface."""
    return RayPaths.of(observed.bench, pool.surface.basis, pool.surface.coefficients)


def rough_costs(observed: Observation, labels: IntArray, pool: FittedPool) -> tuple[float, float]:
    """Misfit of labels for a given surface, without and with the marker (`Hypothesis`).

    The cost of the boundary is not included, as it would need a further fit.
    """
    _, marker, cost = _misfit(observed, labels, pool, paths_of(observed, pool))
    return cost, cost + LIT_MARKER_COST * (marker == "lit")


def _misfit(
    observed: Observation, labels: IntArray, pool: FittedPool, paths: RayPaths
) -> tuple[RayClasses, Marker | None, float]:
    """Ray classes, state of the marker, and cost of residuals, stray dots and missed rays."""
    lit = labels != UNLABELLED
    classes = classify_rays(observed, labels, paths)
    marker = _marker_state(observed, lit, pool)
    square = np.sum(pool.residual_mm**2, axis=-1) / variance_mm2(observed, labels[lit])
    chi2 = np.minimum(square, STRAY_COST)
    cost = float(chi2.sum()) + STRAY_COST * len(classes.stray)
    return classes, marker, cost + MISSED_COST * len(classes.missed)


def variance_mm2(observed: Observation, dots: IntArray) -> FloatArray:
    """Mean variance of dots along the axes of the plane, with `KNOT_ERROR_MM`, shape (n,), mm²."""
    covariance = observed.covariance_mm2[dots]
    return np.asarray(covariance.trace(axis1=-2, axis2=-1) / 2 + KNOT_ERROR_MM**2)


def _boundary_cost(level: Level) -> float:
    """−2 log likelihood of the rays near the boundary, reduced for errors of the set-up.

    Errors of the set-up tilt the surface. The boundary of a shallow pool then gives little
    information, and rays may contradict any level because of the set-up alone.
    """
    share = level.rise_mm**2 / (level.rise_mm**2 + SETUP_ERROR_MM**2)
    return min(2 * share * level.negative_log_likelihood, MOST_BOUNDARY_COST)


def _roughness_cost(pool: FittedPool) -> float:
    """−2 log probability of a surface's third derivatives, whose expected size is uncertain.

    Wrong labels nearly always need a rougher surface than correct ones.
    """
    return ROUGHNESS_FREEDOM * float(np.log1p(pool.roughness_ratio))


def roughness_weight(pool: FittedPool) -> float:
    """Derivative of the cost of a surface's roughness by the roughness, mm²."""
    return CORRELATED_MM2 / pool.settings.jerk**2 / (1 + pool.roughness_ratio)


def _marker_state(observed: Observation, lit: BoolArray, pool: FittedPool) -> Marker | None:
    """State of the place of the marker's absent dot; None without a marker."""
    site = observed.rig.pattern.marker
    if site is None:
        return None
    at = (site[0] - 1, site[1] - 1)
    around = np.zeros_like(lit)
    around[max(at[0] - 1, 0) : at[0] + 2, max(at[1] - 1, 0) : at[1] + 2] = True
    predicted = predict(observed, pool, around)
    is_marker = (predicted.at == at).all(axis=-1)
    if not is_marker.any():
        return "unknown"
    place, spacing = predicted.plane_mm[is_marker][0], predicted.spacing_mm[is_marker][0]
    if np.linalg.norm(observed.plane_mm - place, axis=-1).min() < spacing * MARKER_SPACINGS:
        return "lit"
    return "empty" if amid(lit)[at] else "unknown"


def without_false_ends(
    observed: Observation, hypothesis: Hypothesis, fit_settings: FitSettings = USUAL_FIT
) -> Hypothesis:
    """Remove a label that is the only one on its side of a missed ray, if that costs less.

    Beyond the last row a false dot may lie where the dot of a ray is predicted.
    """
    lit = hypothesis.labels != UNLABELLED
    fewer = []
    for at in {at for ray in hypothesis.missed_rays.tolist() for at in _alone_around(lit, ray)}:
        labels = hypothesis.labels.copy()
        labels[at] = UNLABELLED
        fewer.append(evaluate(observed, labels, fit_settings, initial=hypothesis.pool))
    best = min((h for h in fewer if h), key=lambda h: h.cost, default=hypothesis)
    if best.cost >= hypothesis.cost:
        return hypothesis
    return without_false_ends(observed, best, fit_settings)


def without_doubtful_outermost(
    observed: Observation, hypothesis: Hypothesis, fit_settings: FitSettings = USUAL_FIT
) -> Hypothesis:
    """Remove outermost labels that a false dot explains as well as their ray does.

    Each weak label is compared with the prediction of the surface through all others. The density
    of false dots is estimated from the stray dots.
    """
    lit = hypothesis.labels != UNLABELLED
    weak = lit & (neighbours_of(lit) <= WEAK_NEIGHBOURS)
    if not weak.any():
        return hypothesis
    strong = np.where(weak, UNLABELLED, hypothesis.labels)
    pool = try_fit(observed, strong, fit_settings, hypothesis.pool)
    if pool is None:
        return hypothesis
    rays = predict(observed, pool, weak)
    deviance = pair_deviances(observed, pool, rays, hypothesis.labels[tuple(rays.at.T)])[
        1
    ].diagonal()
    false_per_mm2 = max(FALSE_DOTS_PER_MM2, (hypothesis.stray_count + 1) / observed.frame_area_mm2)
    certain = deviance + RIVAL_MARGIN + FALSE_MARGIN < false_dot_deviance(false_per_mm2)
    kept = strong.copy()
    at = tuple(rays.at[certain].T)
    kept[at] = hypothesis.labels[at]
    if (kept == hypothesis.labels).all():
        return hypothesis
    return evaluate(observed, kept, fit_settings, initial=hypothesis.pool) or hypothesis


def _alone_around(lit: BoolArray, ray: list[int]) -> list[tuple[int, int]]:
    """Lit rays, counted from 0, that are the only ones on their side of a missed ray."""
    i, j = ray
    across = [np.flatnonzero(lit[i, :j]), np.flatnonzero(lit[i, j + 1 :]) + j + 1]
    along = [np.flatnonzero(lit[:i, j]), np.flatnonzero(lit[i + 1 :, j]) + i + 1]
    if min(map(len, across)) and min(map(len, along)):
        return []
    row = [(i, int(side[0])) for side in across if len(side) == 1 and min(map(len, across))]
    column = [(int(side[0]), j) for side in along if len(side) == 1 and min(map(len, along))]
    return row + column
