"""Correspondence of rays and dots by prediction from the previous frames.

The surface is extrapolated from its oscillation (`prior.predictions`). If no prediction finds the
dots, as at the start, they are tracked from the absent one outwards, ring by ring. The tracked dots
keep their rays; dots next to them get theirs from the surface fitted to the tracked ones. The
result is accepted only if the hole of the absent ray is empty, between lit rays, and if no more is
left unexplained than would be accepted without a prior.

As in `match_rays`, a dot whose ray is ambiguous gets none.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from labapp.core.images import band_pass_kernels
from labapp.core.match import Trial, missing_share
from labapp.core.matching.checks.rim_left_out import RIM_POSSIBLE, rim_evidence
from labapp.core.matching.checks.unexplained import is_scattered, refuse_contradicted
from labapp.core.matching.checks.unsupported_labels import MOST_LEFT_OUT, FittedLabels, unsupported
from labapp.core.matching.label_growth import OUTLIER_SPACINGS, OUTLIER_TIMES
from labapp.core.matching.match_rays import match_of_pairs
from labapp.core.matching.match_settings import MatchSettings
from labapp.core.matching.observation import UNLABELLED, Observation, amid, count_labels, widened
from labapp.core.matching.prediction import RayPaths, covariance_of_dots, sure_pairs
from labapp.core.matching.ray_classes import RayClasses, certain_states, classify_rays
from labapp.core.matching.relabelling import close_pairs
from labapp.core.schemes import LEAST_DOTS
from labapp.core.schemes.fit import UNSETTLED_MM, is_too_smooth
from labapp.core.sequence.prior import MOST_ROUNDS, SETTLED_MM, Prior, Tracked, predictions
from labapp.core.surface.level import (
    BOUNDARY_UNSEEN,
    KnownRays,
    Level,
    LevelSearch,
    boundary_is_seen,
)
from labapp.core.surface.pool_fit import (
    REUSE_FLOORS,
    FitSettings,
    fitted_pool,
    normal_equations,
)
from labapp.core.surface.solver import Rounds
from labapp.core.values import BoolArray, CannotMeasure, FloatArray, IntArray, median

FOUND = 0.85
"""Minimum share of the previous frame's dots that must be found again."""

STEADY = 0.2
"""Maximum median distance of these from their predictions, in spacings of the predicted dots."""

FIRST_RING, GROWING_ROUNDS, GROWN_FROM = 2, 3, 12
"""If no prediction finds the dots: number of rings around the absent one in which they are searched
first, rounds of the fit per ring, and number of past surfaces that are tried."""

GATE, CLEARLY = 0.35, 2.0
"""A dot belongs to a tracked ray if it is the only one within `GATE` spacings of its prediction,
and if every other prediction is farther from it by the factor `CLEARLY`."""

RIVALS = 3
"""Number of nearest rays that are candidates for a dot, and of other dots that are candidates for a
ray: the next ones are farther away by a row or a column."""

WORSE = 2.0
"""Maximum ratio of the residual to that of the frame that was matched without a prior, or to the
least σ of the dots if that is larger."""

HELD = 8
"""Maximum number of frames through which the datum is carried while not all neighbours of the
absent ray are lit."""

PREDICTED = 0.1
"""Maximum median distance of the dots from their predictions, in spacings, for the datum to be
carried: if the pool has moved by a row, other rays are lit, and all of them fit."""

ROUGHLY_MM = 0.03
"""When no reflection point moves by more, further rounds do not change the labels."""

WIDENINGS, MANY = 3, 4
"""Maximum number of rounds in which labels are extended, and the number of new labels in a round
that makes another round worthwhile."""

RAISED_MM = 0.01
"""After a smaller shift of the surface its level is not determined again."""


class TrackLost(CannotMeasure):
    """A frame cannot be measured with the prior; the reason is a sentence."""

    def __init__(self, reason: str) -> None:
        super().__init__("track-lost", reason)


def track(prior: Prior, observed: Observation, limits: MatchSettings) -> Tracked:
    """Find the ray of every dot, and the surface, by prediction from the previous frames.

    Raises
    ------
    TrackLost
        If the prediction does not fit the frame.
    CannotMeasure
        If there is no surface.
    """
    paths, labels, off = _found_again(prior, observed)
    fit = _Fit.of(prior, observed, labels, paths)
    fit.run(ROUGHLY_MM)
    for _ in range(WIDENINGS):
        before, labels = labels, _extended_labels(fit)
        if np.array_equal(labels, before):
            break
        fit = fit.with_labels(labels)
        if count_labels(labels) < count_labels(before) + MANY:
            break
        fit.run(ROUGHLY_MM)
    for _ in range(MOST_LEFT_OUT):
        fit.settle()
        covariance = fit.covariance_around()
        classes, known_rays, level = _with_level(prior, fit, covariance)
        wrong = _unsupported(fit, covariance, classes, level)
        if len(wrong) == 0:
            break
        fit = fit.without_dots(wrong)
    else:
        raise TrackLost("too many dots do not fit one surface")
    dots = fit.labels.ravel()[fit.lit_rays]
    _check_explained(observed, fit.labels, classes, limits)
    pool = fitted_pool(fit.rounds, level, observed.rig, observed.plane_mm[dots], prior.settings)
    usual_mm = max(prior.cold_residual_mm, prior.settings.floor_mm)
    if not pool.residual_rms_mm < WORSE * usual_mm:
        raise TrackLost("the surface no longer explains the dots")
    refuse_contradicted(known_rays, pool)
    if rim_evidence(observed, fit.labels) > RIM_POSSIBLE:
        raise TrackLost("dots without a ray may be those of the rim")
    paths = fit.paths()
    is_seen = _reference_is_seen(observed, paths, off)
    if not is_seen and prior.unseen >= HELD:
        raise TrackLost("the dots beside the absent one have been missing for too long")
    orientation = prior.cold_match.orientation
    others = (trial for trial in prior.cold_match.trials if trial.orientation != orientation)
    trials = (Trial(orientation, pool.residual_rms_mm), *others)
    lit, missed = fit.labels != UNLABELLED, len(classes.missed)
    at = np.argwhere(lit)
    match = match_of_pairs(observed, at, dots, orientation, classes.ray_states, missed, trials)
    if is_too_smooth(pool, match, prior.settings):
        raise TrackLost("the surface bends more than before")
    return Tracked(match, pool, paths, lit, is_seen)


@dataclass
class _Fit:
    """State of an iterative fit to labelled dots.

    Parameters
    ----------
    prior, observed
        The prior, and the frame's dots.
    labels
        Index of each ray's dot or `UNLABELLED`, shape (rows, columns).
    lit_rays
        Flat indices of the n rays that have a dot, shape (n,).
    near
        Paths of all rays for the initial surface.
    """

    prior: Prior
    observed: Observation
    labels: IntArray
    lit_rays: IntArray
    near: RayPaths
    rounds: Rounds
    _paths: tuple[FloatArray, RayPaths] | None = None

    @classmethod
    def of(
        cls,
        prior: Prior,
        observed: Observation,
        labels: IntArray,
        near: RayPaths,
    ) -> _Fit:
        """Start the fit from the surface of ``near``."""
        rays = np.flatnonzero(labels != UNLABELLED)
        if len(rays) < LEAST_DOTS:
            raise TrackLost("too few dots have a ray")
        dots, landing = labels.ravel()[rays], observed.rays.landing_mm.reshape(-1, 3)[rays]
        equations = normal_equations(
            basis=prior.basis,
            rig=observed.rig,
            points_mm=landing,
            plane_mm=observed.plane_mm[dots],
            plane_covariance_mm2=observed.covariance_mm2[dots],
            settings=prior.settings,
        )
        if prior.settings.jerk > FitSettings.jerk:
            # A surface that may bend more is determined less: with an old factor it would diverge.
            equations.reuse_mm = REUSE_FLOORS * prior.settings.floor_mm
        directions = observed.rays.directions.reshape(-1, 3)[rays]
        rounds = Rounds(equations, directions, near.coefficients, near.points_mm[rays])
        return cls(prior, observed, labels, rays, near, rounds)

    def with_labels(self, labels: IntArray) -> _Fit:
        """Start a fit to other labels from the current surface."""
        return _Fit.of(self.prior, self.observed, labels, self.paths())

    def without_dots(self, dots: IntArray) -> _Fit:
        """Start a fit without some dots from the current surface."""
        return self.with_labels(np.where(np.isin(self.labels, dots), UNLABELLED, self.labels))

    def run(self, until_mm: float) -> None:
        """Run rounds until no reflection point moves by more than ``until_mm``."""
        self.rounds.run(MOST_ROUNDS, until_mm)

    def settle(self) -> None:
        """Run rounds until the fit has converged."""
        self.run(SETTLED_MM)
        self.check_settled()

    def check_settled(self) -> None:
        """Raise `TrackLost` if the reflection points still move."""
        if not self.rounds.moved_mm < UNSETTLED_MM:
            raise TrackLost("the surface does not settle")

    def paths(self) -> RayPaths:
        """Paths of all rays for the current surface, cached."""
        coefficients = self.rounds.coefficients
        if self._paths is None or self._paths[0] is not coefficients:
            points = self.near.points_mm.copy()
            points[self.lit_rays] = self.rounds.points_mm
            bench, basis = self.observed.bench, self.prior.basis
            self._paths = coefficients, RayPaths.of(bench, basis, coefficients, points, 1)
        return self._paths[1]

    def covariance_of(self, paths: RayPaths, rays: IntArray) -> FloatArray:
        """Covariance of the dots of m rays due to that of the surface, shape (m, 2, 2), mm²."""
        return covariance_of_dots(
            rig=self.observed.rig,
            basis=self.prior.basis,
            inverse=self.rounds.equations.inverse,
            points_mm=paths.points_mm[rays],
            plane_mm=paths.plane_mm[rays],
        )

    def covariance_around(self) -> FloatArray:
        """Covariance of the dots of lit rays and their neighbours, else NaN, shape (R, 2, 2)."""
        paths = self.paths()
        known = np.isfinite(paths.plane_mm[:, 0])
        rays = np.flatnonzero(widened(self.labels != UNLABELLED, 1).ravel() & known)
        covariance = np.full((len(known), 2, 2), np.nan)
        covariance[rays] = self.covariance_of(paths, rays)
        return covariance


# --- from the prediction to labels --------------------------------------------------------------


def _found_again(prior: Prior, observed: Observation) -> tuple[RayPaths, IntArray, float]:
    """Find the dots again; return ray paths, labels, and the distance of dots from predictions.

    The distance is the median over the dots, in spacings of the predicted dots. If no prediction
    finds the dots, a surface is grown from the last one or an earlier one; the distance then is
    infinite.
    """
    lit, count, last = prior.lit, int(prior.lit.sum()), prior.paths.points_mm
    # Rays between lit ones, whose dots may have been missed, are predicted reliably too.
    tracked, looked_for = (lit | amid(lit)) & ~observed.rays.absent, widened(lit, 2)
    for coefficients in predictions(prior):
        paths = RayPaths.of(observed.bench, prior.basis, coefficients, last, 1)
        labels, off = _labels_near_predictions(observed, paths, tracked, looked_for)
        if len(off) >= FOUND * count and (half := median(off)) < STEADY:
            return paths, labels, half
    found = 0
    for coefficients in prior.past[: -GROWN_FROM - 1 : -1]:
        paths = RayPaths.of(observed.bench, prior.basis, coefficients, last, 2)
        paths, labels = _grown(prior, observed, paths)
        found = max(found, count_labels(labels))
        if found >= max(FOUND * count, LEAST_DOTS):
            return paths, labels, np.inf
    raise TrackLost(f"{found} of {count} dots were found again")


def _grown(prior: Prior, observed: Observation, paths: RayPaths) -> tuple[RayPaths, IntArray]:
    """Find the dots again from the absent one outwards, ring by ring.

    Dots in the middle move least from frame to frame, and their motion predicts that of the others.
    """
    i, j = np.indices(prior.lit.shape) + 1
    marker = observed.rig.pattern.marker
    assert marker is not None
    ring = np.maximum(np.abs(i - marker[0]), np.abs(j - marker[1]))
    looked_for, start = widened(prior.lit, 2), paths.coefficients
    labels = np.full(ring.shape, UNLABELLED)
    for reach in range(FIRST_RING, int(ring[prior.lit].max()) + 2):
        labels, _ = _labels_near_predictions(
            observed, paths, prior.lit & (ring <= reach), looked_for
        )
        if count_labels(labels) < LEAST_DOTS:
            break
        fit = _Fit.of(prior, observed, labels, paths)
        fit.rounds.run(GROWING_ROUNDS, SETTLED_MM, smooth_about=start)
        paths = fit.paths()
    return paths, labels


def _labels_near_predictions(
    observed: Observation, paths: RayPaths, may_label: BoolArray, looked_for: BoolArray
) -> tuple[IntArray, FloatArray]:
    """Label the dots that are close to exactly one prediction.

    Parameters
    ----------
    observed, paths
        The frame's dots, and the predicted ray paths.
    may_label, looked_for
        Masks of the rays that may be labelled, and of these and their rivals, shape
        (rows, columns).

    Returns
    -------
    labels, off
        Index of each ray's dot or `UNLABELLED`, shape (rows, columns); distances of the labelled
        dots from their predictions, in spacings of the predicted dots, shape (found,).
    """
    labels = np.full(may_label.shape, UNLABELLED)
    near = np.flatnonzero(looked_for.ravel() & np.isfinite(paths.plane_mm[:, 0]))
    if len(near) < 2 or len(observed.plane_mm) < 2:
        return labels, np.empty(0)
    plane = paths.plane_mm[near]
    step = band_pass_kernels.next_apart(plane)
    off, ray = band_pass_kernels.two_nearest(observed.plane_mm, plane)
    other, dot = band_pass_kernels.two_nearest(plane, observed.plane_mm)
    own, off_own = ray[:, 0], off[:, 0]
    apart, rays = step[own], near[own]
    gate = GATE * apart
    sure = (off_own < gate) & (apart > observed.resolution_mm) & may_label.ravel()[rays]
    sure &= (dot[own, 0] == np.arange(len(own))) & (off[:, 1] > CLEARLY * off_own)
    sure &= other[own, 1] > gate  # speckle may split a dot in two
    labels.ravel()[rays[sure]] = np.flatnonzero(sure)
    return labels, off_own[sure] / apart[sure]


def _extended_labels(fit: _Fit) -> IntArray:
    """Remove labels with large residuals, and add unambiguous ones next to the remaining labels.

    New labels are determined by `sure_pairs`, as without a prior (`label_growth`).
    """
    observed, paths, lit = fit.observed, fit.paths(), fit.labels != UNLABELLED
    known = np.isfinite(paths.plane_mm[:, 0])
    looked_for = np.flatnonzero(widened(lit, 2).ravel() & known)
    next_mm = np.full(len(known), np.inf)
    next_mm[looked_for] = band_pass_kernels.next_apart(paths.plane_mm[looked_for])
    labels, rays = fit.labels.copy().ravel(), fit.lit_rays
    off = np.hypot(*(paths.plane_mm[rays] - observed.plane_mm[labels[rays]]).T)
    allowed = np.maximum(OUTLIER_TIMES * median(off), OUTLIER_SPACINGS * next_mm[rays])
    labels[rays[off > allowed]] = UNLABELLED
    is_free = np.ones(len(observed.plane_mm), bool)
    is_free[labels[labels != UNLABELLED]] = False
    free = np.flatnonzero(is_free)
    beside = widened(lit, 1) & ~lit & ~observed.rays.absent
    if len(free) and beside.any():
        apart = _apart_mm(paths.plane_mm[looked_for], observed.plane_mm[free])
        near = looked_for[np.unique(np.argsort(apart, axis=0)[:RIVALS])]
        apart = _apart_mm(paths.plane_mm[near], observed.plane_mm)
        dots = np.union1d(free, np.argsort(apart, axis=1)[:, : RIVALS + 1])
        covariance = fit.covariance_of(paths, near)
        dot, ray = sure_pairs(observed, dots, paths.plane_mm[near], covariance)
        ray = near[ray]
        may = beside.ravel()[ray] & (next_mm[ray] > observed.resolution_mm) & is_free[dot]
        labels[ray[may]] = dot[may]
    labels = labels.reshape(lit.shape)
    # In doubt before: the surface through the others may predict two crossed rays exchanged.
    doubtful = amid(fit.prior.lit) & ~fit.prior.lit & (labels != UNLABELLED)
    if np.count_nonzero(doubtful) > 1:
        for one, other in list(close_pairs(observed, labels)):
            if doubtful[one] and doubtful[other]:
                labels[one] = labels[other] = UNLABELLED
    return labels


def _apart_mm(one: FloatArray, other: FloatArray) -> FloatArray:
    """Distances, shape (len(one), len(other))."""
    x, y = one[:, 0, None] - other[:, 0], one[:, 1, None] - other[:, 1]
    return np.asarray(np.sqrt(x * x + y * y))


# --- checks that labels must pass ----------------------------------------------------------------


def _unsupported(fit: _Fit, covariance: FloatArray, classes: RayClasses, level: Level) -> IntArray:
    """Labelled dots that the surface does not support (`unsupported_labels.unsupported`)."""
    fitted = FittedLabels(
        labels=fit.labels,
        basis=fit.prior.basis,
        level=level,
        paths=fit.paths(),
        covariance_mm2=covariance,
        classes=classes,
        floor_mm=fit.prior.settings.floor_mm,
        unsettled_mm=fit.rounds.moved_mm,
        was_lit=fit.prior.lit,
    )
    return unsupported(fit.observed, fitted)


def _with_level(
    prior: Prior, fit: _Fit, covariance: FloatArray
) -> tuple[RayClasses, KnownRays, Level]:
    """Classify the rays, and shift the surface to the level that follows from the known ones."""
    observed, paths = fit.observed, fit.paths()
    found = classify_rays(observed, fit.labels, paths)
    states, labels = found.ray_states, fit.labels
    ray_states = certain_states(observed, labels, states, paths, lambda some: covariance[some])
    if prior.drop_is_free:
        # A missing dot at the rim would be taken for a lower rear. In other frames such rays count
        # as dark: where the rim moves, they tell how far.
        ray_states[prior.lit & (ray_states < 0)] = 0
    if not boundary_is_seen(ray_states):
        raise TrackLost(BOUNDARY_UNSEEN)
    missing = missing_share(len(found.missed), len(fit.lit_rays))
    known_rays = KnownRays.of(observed.rig, ray_states, prior.basis, missing)
    sigma = fit.rounds.height_sigma_mm(known_rays.landing_mm)
    known_rays = replace(known_rays, height_sigma_mm=sigma)
    near = replace(prior.level, shift_mm=0.0)
    search = LevelSearch(known_rays, near, prior.drop_is_free, RAISED_MM)
    level = fit.rounds.run(fit.prior.settings.rounds, SETTLED_MM, search=search)
    fit.check_settled()
    return RayClasses(ray_states, found.missed, found.stray), known_rays, level


def _check_explained(
    observed: Observation, labels: IntArray, classes: RayClasses, limits: MatchSettings
) -> None:
    """Raise `TrackLost` if more is left unexplained than is accepted without a prior."""
    stray, missed = len(classes.stray), len(classes.missed)
    many_strays = stray > limits.most_strays(len(observed.plane_mm))
    if not many_strays and missed <= limits.most_missed(count_labels(labels)):
        return
    missed_rays = np.stack(np.divmod(classes.missed, labels.shape[1]), axis=-1)
    if is_scattered(observed, labels, missed_rays, classes.stray):
        return
    if many_strays:
        raise TrackLost(f"{stray} dots have no ray")
    raise TrackLost(f"{missed} rays between the others have no dot")


def _reference_is_seen(observed: Observation, paths: RayPaths, off: float) -> bool:
    """Whether all four neighbours of the absent ray are lit.

    A dot that the fit rejects (`_unsupported`) still counts as light here.

    Raises
    ------
    TrackLost
        If there is a dot at the absent ray; if a neighbour is dark and the dots are not where they
        were predicted; or if three neighbours are dark, as the hole then does not identify the rows
        (`lattice.find_holes`).
    """
    pattern = observed.rig.pattern
    assert pattern.marker is not None
    (i, j), columns = np.subtract(pattern.marker, 1).tolist(), pattern.columns
    if not (0 < i < pattern.rows - 1 and 0 < j < columns - 1):
        raise TrackLost("the absent ray is at the pool's edge")
    hole = i * columns + j + np.array([0, -1, 1, -columns, columns])
    plane = paths.plane_mm[hole]
    if not np.isfinite(plane).all():
        raise TrackLost("the absent ray is at the pool's edge")
    reach = min(math.dist(plane[1], plane[2]), math.dist(plane[3], plane[4])) / 2
    empty = band_pass_kernels.two_nearest(plane, observed.plane_mm)[0][:, 0] > reach / 2
    if not empty[0]:
        raise TrackLost("a dot is in the hole of the absent one")
    if sum(empty[1:]) > (2 if off < PREDICTED else 0):
        raise TrackLost("the dots beside the absent one are not seen")
    return not empty[1:].any()
