"""Frames one after the other: each measured from where the one before left off.

The cold chain (`pipeline.measure`) looks for dots, rows and rays in every frame as if it were the
first. Here the surface of the frames before predicts where every ray's dot should be; found there,
the dots have their rays, and the fit starts from that surface. An answer is given only where the
absent ray's place is dark amid lit ones, and where no more is left unexplained than the cold chain
puts up with. Anything else, and the cold chain measures the frame.

The same frames give the same answers: nothing depends on the clock or on how many are measured at
once.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from labapp.core.geometry.coordinates import ImageCalibration
from labapp.core.geometry.rig import Rig
from labapp.core.images.band_pass import quick_dots
from labapp.core.images.dot_size import estimate_size
from labapp.core.images.dots import Image
from labapp.core.match import Match, Trial, missing_share
from labapp.core.matching.correspondence import lattice_of_match, match_of_pairs
from labapp.core.matching.decision import MatchSettings
from labapp.core.matching.observation import UNLABELLED, Observation
from labapp.core.matching.outliers import unsupported
from labapp.core.pipeline import Measurement, Settings, measure, setup_status
from labapp.core.schemes.fit import LEAST_DOTS, UNSETTLED_MM
from labapp.core.sequence.track import MEMORY, Track, TrackLost, begin, found_again, rms
from labapp.core.sequence.warm_fit import (
    SequenceGeometry,
    Slopes,
    WarmPool,
    evaluate_at_landing_points,
    fit_slopes_to,
    intersect_and_reflect,
)
from labapp.core.sequence.warm_match import (
    RayClasses,
    beyond,
    classify_rays,
    covariance_around,
    widened,
)
from labapp.core.surface import kernels, measures
from labapp.core.surface.boundary_trace import retrace_boundary
from labapp.core.surface.level import Level, find_level
from labapp.core.surface.measures import scaled_errors
from labapp.core.surface.reconstruction import Reconstruction
from labapp.core.surface.setup_uncertainty import Fitted, setup_sigma
from labapp.core.surface.sizes import sizes_and_gradients
from labapp.core.surface.solver import REUSE_MM, propagate_sigma
from labapp.core.surface.spline import SplineSurface
from labapp.core.values import CannotMeasure, FloatArray, IntArray

WORSE = 2.0
"""The residual of a track is at most so many times that of its first frame."""

HELD = 8
"""For so many frames the datum is carried on while a dot beside the absent one is not seen."""

FORESEEN = 0.1
"""So near half of the dots must be to where they were foreseen, of the way to the next one, for the
datum to be carried on: a pool that has gone on by a row lights other rays, and all of them fit."""

SINKS_EVERY = 16
"""Every so many frames it is asked anew whether the rear sinks."""

WINDOW = 0.4
"""How far from the last frame's level it is looked for first (`find_level`)."""

POINTS_EVERY = 8
"""Every so many frames the uncertainty of the reflection points is worked out anew."""

SETUP_EVERY = 64
"""Every so many frames the sizes' uncertainty by the set-up is worked out anew."""

ROUGHLY_MM = 0.03
"""Where no reflection point moved by more, what is left to move does not change which dots have
which rays."""

WIDENINGS, MANY = 3, 4
"""Where so many dots at once are found to have rays, others beyond them may: it is looked again, so
often at most."""

RAISED_MM = 0.01
"""After a shift of the level by more, the slopes are fitted once more."""

Passed = Callable[[str], None]


class WarmChain:
    """Measures the frames of one recording in their order.

    Parameters
    ----------
    rig, calibration
        The bench, and how the camera sees the imaging plane.
    settings
        Of the cold chain. Only the fit to band-passed dots, the default, can be followed.
    passed
        Told the name of each step of a followed frame when it is done: dots, match, fit, level,
        measures.

    Attributes
    ----------
    track_lost
        Why the last frame was measured by the cold chain; None where it was followed.
    """

    def __init__(
        self,
        rig: Rig,
        calibration: ImageCalibration,
        settings: Settings,
        passed: Passed = lambda _: None,
    ) -> None:
        self.rig, self.calibration, self.settings = rig, calibration, settings
        self._passed = passed
        self.track_lost: str | None = None
        self._track: Track | None = None

    def follow(self, image: Image) -> Measurement | None:
        """Measure the next frame from those before; None where they do not lead to it.

        That takes no longer, and a frame after it may be followed again.
        """
        try:
            if self._track is None:
                raise TrackLost("no frame before it was measured")
            measurement, self._track = follow(
                image, self._track, self.calibration, self.settings, self._passed
            )
            self.track_lost = None
            return measurement
        except (TrackLost, CannotMeasure, np.linalg.LinAlgError) as reason:
            self.track_lost = str(reason)
            return None

    def measure(self, image: Image) -> Measurement:
        """Measure the next frame from those before, or else by itself (`search`)."""
        return self.follow(image) or self.search(image)

    def search(self, image: Image) -> Measurement:
        """Measure the next frame as if it were the first (`pipeline.measure`).

        Where that succeeds, those after it may be followed from it.
        """
        self.track_lost = self.track_lost or "it was measured by itself"
        settings = _with_size(self.settings, image)
        measurement = measure(image, self.rig, self.calibration, settings)
        if measurement.status == "ok":
            self._track = begin(image, measurement, self.rig, settings, self._track)
        elif self._track is not None:
            track, unseen = self._track, self._track.unseen + 1
            past, slopes = track.past[-1:], track.slopes[-1:]
            kept = replace(track, unseen=unseen, past=past, slopes=slopes)
            self._track = kept if unseen <= HELD else None
        return measurement


def _with_size(settings: Settings, image: Image) -> Settings:
    """The settings with the size of the frame's dots, which a search and a track ask for alike."""
    dots = settings.dots
    if dots.method != "band-pass" or dots.band_pass.size_px:
        return settings
    size = estimate_size(image)
    band_pass = replace(dots.band_pass, size_px=size)
    return replace(settings, dots=replace(dots, band_pass=band_pass))


# --- one frame ----------------------------------------------------------------------------------


def follow(
    image: Image,
    track: Track,
    calibration: ImageCalibration,
    settings: Settings,
    passed: Passed = lambda _: None,
) -> tuple[Measurement, Track]:
    """Measure a frame from the one before.

    Raises
    ------
    TrackLost
        If the track does not lead here.
    CannotMeasure
        If there are no dots, or no surface.
    """
    geometry = track.geometry
    if image.shape != track.tuning.noise.shape:
        raise TrackLost("the frame has another size than the one before")
    dots = quick_dots(image, track.tuning, settings.dots.band_pass)
    passed("dots")
    observed = Observation.of(dots, geometry.rig, calibration, (image.shape[0], image.shape[1]))
    pool, labels, off = found_again(track, observed)
    passed("match")
    pool, labels, lower, spread = _fitted(geometry, observed, pool, labels)
    passed("fit")
    classes = classify_rays(geometry, observed, pool, lower, labels, spread)
    level, open_mm = _level(track, pool, classes, labels)
    outside = beyond(geometry, _shifted(pool, level), level, labels, track.lit)
    if len(outside) or abs(level.shift_mm) > RAISED_MM:
        labels[outside] = UNLABELLED
        pool, lower = _settled(geometry, _shifted(pool, level), _slopes(geometry, observed, labels))
        classes = classify_rays(geometry, observed, pool, lower, labels)
        level, open_mm = _level(track, pool, classes, labels)
    pool = intersect_and_reflect(geometry, pool.coefficients + level.shift_mm, pool.points_mm, 1)
    passed("level")
    ray = np.flatnonzero(labels != UNLABELLED)
    dot = labels[ray]
    residual = pool.plane_mm[ray] - observed.plane_mm[dot]
    _check_explained(classes, settings.match, len(dots), len(ray))
    if not rms(residual) < WORSE * track.residual_mm:
        raise TrackLost("the surface no longer has the dots")
    unseen = 0 if _datum_seen(geometry, observed, pool, off) else track.unseen + 1
    if unseen > HELD:
        raise TrackLost("the dots beside the absent one have not been seen for long")
    match = _match(track, observed, classes, ray, dot, rms(residual))
    track = _with_uncertainty(track, pool, ray, lower)
    reconstruction, size = _sized(track, pool, level, lower, match, residual, ray)
    after = replace(
        track,
        pool=pool,
        lit=labels != UNLABELLED,
        boundary=reconstruction.boundary,
        level=level,
        size_sigma_setup=reconstruction.size_sigma_setup,
        past=np.vstack([track.past[1 - MEMORY :], pool.coefficients]),
        slopes=np.concatenate([track.slopes[1 - MEMORY :], pool.slopes[None]]),
        open_mm=open_mm,
        unseen=unseen,
        count=track.count + 1,
    )
    lattice = lattice_of_match(match, geometry.rig, len(dots))
    found = dots, lattice, match, reconstruction, size
    told = Measurement("ok", "", "fit", *found, setup_status=setup_status(geometry.rig))
    passed("measures")
    return told, after


def _check_explained(classes: RayClasses, limits: MatchSettings, dots: int, rays: int) -> None:
    if classes.stray > limits.stray[0] + limits.stray[1] * dots:
        raise TrackLost(f"{classes.stray} dots have no ray")
    if classes.missed > limits.missed[0] + limits.missed[1] * rays:
        raise TrackLost(f"{classes.missed} rays amid the others have no dot")


def _shifted(pool: WarmPool, level: Level) -> WarmPool:
    return replace(pool, coefficients=pool.coefficients + level.shift_mm)


def _fitted(
    geometry: SequenceGeometry, observed: Observation, pool: WarmPool, labels: IntArray
) -> tuple[WarmPool, IntArray, FloatArray, FloatArray]:
    """Fit the surface, roughly first, and then with the labels that it bears out.

    Returns the surface and the labels, the factor of the normal matrix, and the covariance of the
    dots that follows from it (`covariance_around`).
    """
    slopes, factor = _slopes(geometry, observed, labels), None
    for _ in range(WIDENINGS):
        pool, lower, moved = fit_slopes_to(geometry, pool, slopes, until_mm=ROUGHLY_MM)
        factor = lower if moved < REUSE_MM else None
        before, labels = labels, widened(geometry, observed, pool, lower, labels)
        if np.array_equal(labels, before):
            break
        slopes, factor = _slopes(geometry, observed, labels), None
        if np.sum(labels != UNLABELLED) < np.sum(before != UNLABELLED) + MANY:
            break
    pool, lower = _settled(geometry, pool, slopes, factor)
    spread = covariance_around(geometry, pool, lower, labels)
    off = _unsupported(geometry, observed, pool, spread, labels)
    if len(off):
        labels = np.where(np.isin(labels, off), UNLABELLED, labels)
        pool, lower = _settled(geometry, pool, _slopes(geometry, observed, labels))
        spread = covariance_around(geometry, pool, lower, labels)
    return pool, labels, lower, spread


def _unsupported(
    geometry: SequenceGeometry,
    observed: Observation,
    pool: WarmPool,
    spread: FloatArray,
    labels: IntArray,
) -> IntArray:
    """Labelled dots that the surface does not support (`outliers.unsupported`)."""
    ray, every = np.flatnonzero(labels != UNLABELLED), np.full(observed.absent.shape, UNLABELLED)
    every[tuple(geometry.at.T)] = labels
    residual = pool.plane_mm[ray] - observed.plane_mm[labels[ray]]
    return unsupported(observed, every, residual, spread[ray], geometry.settings.floor_mm)


def _settled(
    geometry: SequenceGeometry, pool: WarmPool, slopes: Slopes, lower: FloatArray | None = None
) -> tuple[WarmPool, FloatArray]:
    pool, lower, moved = fit_slopes_to(geometry, pool, slopes, lower=lower)
    if not moved < UNSETTLED_MM:
        raise TrackLost("the surface does not settle")
    return pool, lower


def _slopes(geometry: SequenceGeometry, observed: Observation, labels: IntArray) -> Slopes:
    ray = np.flatnonzero(labels != UNLABELLED)
    if len(ray) < LEAST_DOTS:
        raise TrackLost("hardly a dot is left that has a ray")
    dot = labels[ray]
    return Slopes.of(geometry, ray, observed.plane_mm[dot], observed.covariance_mm2[dot])


def _level(
    track: Track, pool: WarmPool, classes: RayClasses, labels: IntArray
) -> tuple[Level, float]:
    """Where z = 0 lies on the fitted surface, and how far that was open when the rear was free.

    How deep the rear lies is not asked every time; in between the level is known no better.
    """
    witness = classes.witness
    witnesses = witness != 0
    if not (witness < 0).any():
        raise TrackLost("no ray that would show stayed away")
    geometry, before = track.geometry, track.level
    height, slope = evaluate_at_landing_points(geometry, pool.coefficients)
    free = track.count % SINKS_EVERY == SINKS_EVERY - 1
    drop = None if free else before.rear.drop_mm
    y, about = geometry.landing_mm[witnesses, 1], (0.0, before.sign, WINDOW)
    at_witnesses = height[witnesses], slope[witnesses], y, witness[witnesses]
    missing = missing_share(classes.missed, int(np.sum(labels != UNLABELLED)))
    rear = geometry.rig.head_sign, drop
    level = find_level(*at_witnesses, geometry.spacing_mm, rear, about, missing)
    open_mm = level.sigma_mm if free else track.open_mm
    return replace(level, sigma_mm=max(level.sigma_mm, open_mm)), open_mm


def _datum_seen(
    geometry: SequenceGeometry, observed: Observation, pool: WarmPool, off: float
) -> bool:
    """Whether all four neighbours of the absent ray are lit.

    A dot too far off for the fit (`_unsupported`) is still light in its place.

    Raises
    ------
    TrackLost
        If the absent ray's place is lit; or a neighbour is dark and the dots are not where they
        were foreseen, or three are: no hole tells the rows then (`lattice.find_holes`).
    """
    if geometry.hole is None:
        raise TrackLost("the absent ray is at the pool's edge")
    beside = geometry.hole[1:]
    reach = min(
        float(np.linalg.norm(pool.plane_mm[a] - pool.plane_mm[b])) / 2
        for a, b in beside.reshape(2, 2)
    )
    between = observed.plane_mm - pool.plane_mm[geometry.hole][:, None]
    dark = np.linalg.norm(between, axis=-1).min(axis=1) > reach / 2
    if not dark[0]:
        raise TrackLost("a dot is where the absent one should be dark")
    if sum(dark[1:]) > (2 if off < FORESEEN else 0):
        raise TrackLost("the dots beside the absent one are not seen")
    return not dark[1:].any()


# --- what is told of it -------------------------------------------------------------------------


def _match(
    track: Track,
    observed: Observation,
    classes: RayClasses,
    ray: IntArray,
    dot: IntArray,
    residual_mm: float,
) -> Match:
    geometry, orientation = track.geometry, track.match.orientation
    every = np.zeros(observed.absent.shape, np.int64)
    every[tuple(geometry.at.T)] = classes.witness
    others = (t for t in track.match.trials if t.orientation != orientation)
    trials = (Trial(orientation, residual_mm), *others)
    return match_of_pairs(
        observed, geometry.at[ray], dot, orientation, every, classes.missed, trials
    )


def _with_uncertainty(track: Track, pool: WarmPool, ray: IntArray, lower: FloatArray) -> Track:
    """Work out how uncertain reflection points are, every now and then or where it is not known."""
    if track.count % POINTS_EVERY and np.isfinite(track.free_mm[ray]).all():
        return track
    splines, values = kernels.splines_at(track.geometry.basis.grid, pool.points_mm[ray, :2])
    at_points = np.zeros((len(ray), len(pool.coefficients)))
    np.put_along_axis(at_points, splines, values[0], axis=1)
    free = track.free_mm.copy()
    free[ray] = propagate_sigma(lower, at_points, at_points.mean(axis=0), 0.0)
    return replace(track, free_mm=free)


def _sized(
    track: Track,
    pool: WarmPool,
    level: Level,
    lower: FloatArray,
    match: Match,
    residual: FloatArray,
    ray: IntArray,
) -> tuple[Reconstruction, measures.Measures]:
    """Boundary, sizes and all their ±."""
    geometry, coefficients = track.geometry, pool.coefficients
    points = pool.points_mm[ray]
    center = (points[:, :2].min(axis=0) + points[:, :2].max(axis=0)) / 2
    boundary, boundary_slope = retrace_boundary(
        geometry.basis, coefficients, level, center, track.boundary
    )
    sizes = sizes_and_gradients(geometry.basis, coefficients, level, boundary, boundary_slope)
    if not sizes.holds:
        raise TrackLost("the surface comes down to the work piece within its boundary")
    surface, by_setup = SplineSurface(geometry.basis, coefficients), track.size_sigma_setup
    if track.count % SETUP_EVERY == SETUP_EVERY - 1:
        fitted = Fitted(match, geometry.rig, geometry.settings, surface, points, level)
        by_setup = setup_sigma(fitted.setup_changes(sizes.gradient))
    share = np.full(len(ray), 1 / len(ray))
    level_at = kernels.gradient_of_sum(geometry.basis.grid, len(coefficients), points[:, :2], share)
    by_rays = propagate_sigma(lower, sizes.gradient, level_at, level.sigma_mm)
    made = Reconstruction(
        scheme="fit",
        surface=surface,
        boundary=boundary,
        ray=match.ray,
        points_mm=points,
        residual_mm=residual,
        sigma_mm=np.hypot(track.free_mm[ray], level.sigma_mm),
        size_sigma=np.hypot(by_rays, by_setup),
        size_sigma_level=np.abs(sizes.by_level) * level.sigma_mm,
        size_sigma_setup=by_setup,
    )
    # As `measures.reflection_scale` has it; where the rays land is known.
    scale = np.ptp(geometry.landing_mm[ray, :2], axis=0) / np.ptp(match.plane_mm, axis=0)
    errors = scaled_errors(made, scale)
    return made, measures.assemble_measures(errors, sizes.size, sizes.peak_mm, center, made)
