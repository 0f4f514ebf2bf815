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

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np

from labapp.core import measures
from labapp.core.boundary import Boundary
from labapp.core.coordinates import ImageCalibration
from labapp.core.correspondence import Match, Trial
from labapp.core.dots import Image
from labapp.core.fit import LEAST_DOTS, UNSETTLED_MM
from labapp.core.lattice import Lattice
from labapp.core.measures import reflection_errors
from labapp.core.orientation import ways
from labapp.core.pipeline import Measurement, Settings, measure
from labapp.core.pool_fit import Level, find_level, place_level
from labapp.core.quick_dots import Exposure, quick_dots
from labapp.core.ray_growth import UNLABELLED, Scene
from labapp.core.reconstruction import Reconstruction
from labapp.core.rig import Rig
from labapp.core.spline import SplineSurface
from labapp.core.values import BoolArray, CannotMeasure, FloatArray, IntArray
from labapp.core.warm_fit import Bed, Slopes, WarmPool, fit_slopes_to, lay, met, spline_values
from labapp.core.warm_match import around, beyond, testimony, tracked, widened
from labapp.core.warm_measures import follow_rim, sigma_of, sizes_of

FOUND = 0.85
"""Share of the dots of the frame before that must be found again."""

STEADY = 0.2
"""… and half of them within this share of the way to the next dot of where they were predicted."""

FIRST_RING, GROWING_ROUNDS, GROWN_FROM = 2, 3, 12
"""Where no prediction finds the dots, they are first looked for so near the absent one, in so many
rounds a ring, from so many surfaces of the past."""

WORSE = 2.0
"""The residual of a track is at most so many times that of its first frame."""

HELD = 8
"""For so many frames the datum is carried on while a dot beside the absent one is not seen."""

SINKS_EVERY = 16
"""Every so many frames it is asked anew whether the rear sinks."""

POINTS_EVERY = 8
"""Every so many frames the uncertainty of the reflection points is worked out anew."""

RAISED_MM = 0.01
"""After a shift of the level by more, the slopes are fitted once more."""

MEMORY, ORDER = 48, 4
"""Frames that predictions are learnt from, and how many of them one is made from."""


Passed = Callable[[str], None]


class Broken(Exception):
    """A track does not lead to this frame; says why in a sentence."""


@dataclass(frozen=True)
class Track:
    """What a frame leaves to the next.

    Parameters
    ----------
    bed
        Splines and rays.
    exposure
        Size of dots and noise.
    match
        Of the cold chain, where the track began.
    residual_mm
        Root mean square residual there, mm.
    pool, labels, boundary, level
        The last surface, the dots' rays, where the pool ends, and z = 0.
    past
        Spline coefficients of the last frames, the newest last, shape (frames, p), mm.
    open_mm
        How far the level was left open when it was last asked how deep the rear lies, mm.
    free_mm
        Uncertainty of the height where each ray meets the surface, its level apart, as it was last
        worked out, shape (R,), mm; NaN where it never was. It changes slowly.
    unseen
        Frames since the absent ray's place was last seen dark amid four lit ones.
    count
        Frames that were followed.
    """

    bed: Bed
    exposure: Exposure
    match: Match
    residual_mm: float
    pool: WarmPool
    lit: BoolArray
    boundary: Boundary
    level: Level
    past: FloatArray
    open_mm: float
    free_mm: FloatArray
    unseen: int = 0
    count: int = 0


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
    broke
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
        self.broke: str | None = None
        self._track: Track | None = None

    def measure(self, image: Image) -> Measurement:
        """Measure the next frame; see `pipeline.measure`."""
        try:
            if self._track is None:
                raise Broken("no frame before it was measured")
            measurement, self._track = follow(
                image, self._track, self.calibration, self.settings, self._passed
            )
            self.broke = None
            return measurement
        except (Broken, CannotMeasure, np.linalg.LinAlgError) as reason:
            self.broke = str(reason)
        measurement = measure(image, self.rig, self.calibration, self.settings)
        if measurement.status == "ok":
            self._track = begin(image, measurement, self.rig, self.settings, self._track)
        elif self._track is not None:
            track, unseen = self._track, self._track.unseen + 1
            kept = replace(track, unseen=unseen, past=track.past[-1:])
            self._track = kept if unseen <= HELD else None
        return measurement


def begin(
    image: Image, measurement: Measurement, rig: Rig, settings: Settings, former: Track | None
) -> Track | None:
    """Start a track from a frame that the cold chain measured; None where none can be.

    What is remembered of a ``former`` track, of the frames just before, stays.
    """
    match, made = measurement.match, measurement.reconstruction
    if match is None or made is None or not isinstance(made.surface, SplineSurface):
        return None
    if settings.dots.method != "band-pass" or rig.pattern.marker is None:
        return None
    bed, pool = Bed.of(rig, made.surface.basis, settings.fit), None
    if former is not None and bed.at.shape == former.bed.at.shape:
        bed, pool = former.bed, _moved_to(former, match, made)
    if pool is None:
        former = None
        pool = met(bed, made.surface.coefficients, bed.landing_mm, 4)
    witness = match.witness[tuple(bed.at.T)]
    told = witness != 0
    surface = SplineSurface(bed.basis, pool.coefficients)
    level = find_level(surface, bed.landing_mm[told, :2], witness[told], bed.spacing_mm)
    past = np.empty((0, len(pool.coefficients))) if former is None else former.past[1 - MEMORY :]
    return Track(
        bed=bed,
        exposure=Exposure.of(image, settings.dots.band_pass),
        match=match,
        residual_mm=_rms(made.residual_mm),
        pool=pool,
        lit=witness > 0,
        boundary=made.boundary,
        level=level,
        past=np.vstack([past, pool.coefficients]),
        open_mm=level.sigma_mm,
        free_mm=np.full(len(bed.at), np.nan),
    )


def _moved_to(former: Track, match: Match, made: Reconstruction) -> WarmPool | None:
    """The surface of a cold fit in the splines of a former track; None if they have no place."""
    bed = former.bed
    number = {(i, j): k for k, (i, j) in enumerate((bed.at + 1).tolist())}
    rays = [number.get((i, j)) for i, j in match.ray.tolist()]
    if None in rays:
        return None
    ray = np.array(rays, np.int64)
    points = bed.landing_mm.copy()
    points[ray] = made.points_mm
    start = replace(former.pool, points_mm=points)
    slopes = Slopes.of(bed, ray, match.plane_mm, match.plane_covariance_mm2)
    try:
        pool, _, moved = fit_slopes_to(bed, start, slopes)
    except CannotMeasure:
        return None
    lower_by = float(np.mean(made.points_mm[:, 2] - pool.points_mm[ray, 2]))
    pool = met(bed, pool.coefficients + lower_by, pool.points_mm, 4)
    return pool if moved < UNSETTLED_MM else None


def _rms(residual: FloatArray) -> float:
    return float(np.sqrt(np.mean(np.sum(residual**2, axis=-1))))


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
    Broken
        If the track does not lead here.
    CannotMeasure
        If there are no dots, or no surface.
    """
    bed = track.bed
    if image.shape != track.exposure.noise.shape:
        raise Broken("the frame has another size than the one before")
    dots = quick_dots(image, track.exposure, settings.dots.band_pass)
    passed("dots")
    scene = Scene.of(dots, bed.rig, calibration, (image.shape[0], image.shape[1]))
    pool, labels, foreseen = _found_again(track, scene)
    passed("match")
    pool, labels, lower = _fitted(bed, scene, pool, labels)
    passed("fit")
    heard = testimony(bed, scene, pool, labels)
    level, open_mm = _level(track, pool, heard.witness)
    outside = beyond(bed, _shifted(pool, level), level, labels)
    if len(outside) or abs(level.shift_mm) > RAISED_MM:
        labels[outside] = UNLABELLED
        pool, labels, lower = _fitted(bed, scene, _shifted(pool, level), labels, widen=False)
        heard = testimony(bed, scene, pool, labels)
        level, open_mm = _level(track, pool, heard.witness)
    pool = met(bed, pool.coefficients + level.shift_mm, pool.points_mm, 1)
    passed("level")
    ray = np.flatnonzero(labels != UNLABELLED)
    dot = labels[ray]
    residual = pool.plane_mm[ray] - scene.plane_mm[dot]
    limits = settings.match
    if heard.stray > limits.stray[0] + limits.stray[1] * len(dots):
        raise Broken(f"{heard.stray} dots have no ray")
    if heard.missed > limits.missed[0] + limits.missed[1] * len(ray):
        raise Broken(f"{heard.missed} rays amid the others have no dot")
    if not _rms(residual) < WORSE * track.residual_mm:
        raise Broken("the surface no longer has the dots")
    unseen = 0 if _datum_seen(bed, scene, pool, labels, foreseen) else track.unseen + 1
    if unseen > HELD:
        raise Broken("the dots beside the absent one have not been seen for long")
    match = _match(track, scene, heard.witness, ray, dot, _rms(residual))
    track = _with_uncertainty(track, pool, ray, lower)
    reconstruction, size = _sized(track, pool, level, lower, match, residual, ray)
    after = replace(
        track,
        pool=pool,
        lit=labels != UNLABELLED,
        boundary=reconstruction.boundary,
        level=level,
        past=np.vstack([track.past[1 - MEMORY :], pool.coefficients]),
        open_mm=open_mm,
        unseen=unseen,
        count=track.count + 1,
    )
    lattice = _lattice(match, bed.rig, len(dots))
    told = Measurement("ok", "", "fit", dots, lattice, match, reconstruction, size)
    passed("measures")
    return told, after


def _shifted(pool: WarmPool, level: Level) -> WarmPool:
    return replace(pool, coefficients=pool.coefficients + level.shift_mm)


def _predictions(track: Track) -> Iterator[FloatArray]:
    """Spline coefficients that the next frame may have, the likeliest first.

    A pool that swings goes on as it did: a linear recurrence, learnt from the frames before on the
    heights where lit rays land, carries any few oscillations on.
    """
    past = track.past
    if len(past) > 3 * ORDER:
        own = np.flatnonzero(track.lit)
        value, splines = track.bed.values[0, own], track.bed.splines[own]
        heights = np.einsum("rs,frs->fr", value, past[:, splines])
        heights = heights - heights.mean(axis=0)
        count = len(past) - ORDER
        steps = np.stack([heights[ORDER - k - 1 :][:count].ravel() for k in range(ORDER)])
        gram = steps @ steps.T
        gram[np.diag_indices(ORDER)] += 1e-4 * np.trace(gram)
        ratio = np.linalg.solve(gram, steps @ heights[ORDER:].ravel())
        mean = past.mean(axis=0)
        yield mean + ratio @ (past[: -ORDER - 1 : -1] - mean)
    if len(past) > 1:
        yield 2 * past[-1] - past[-2]
    yield past[-1]


def _found_again(track: Track, scene: Scene) -> tuple[WarmPool, IntArray, bool]:
    """A surface that finds the dots again, the rays that gives them, and whether it was foreseen.

    Where none that is foreseen does, one is grown from the last, and from those before it.
    """
    bed, count = track.bed, int(track.lit.sum())
    looked_for = around(bed, track.lit, 2)
    for coefficients in _predictions(track):
        pool = met(bed, coefficients, track.pool.points_mm, 1)
        labels, off = tracked(scene, pool, track.lit, looked_for)
        if len(off) >= FOUND * count and np.median(off) < STEADY:
            return pool, labels, True
    found = 0
    for coefficients in track.past[: -GROWN_FROM - 1 : -1]:
        pool, labels = _grown(track, scene, coefficients)
        found = max(found, int(np.sum(labels != UNLABELLED)))
        if found >= max(FOUND * count, LEAST_DOTS):
            return pool, labels, False
    raise Broken(f"{found} of {count} dots were found again")


def _grown(track: Track, scene: Scene, start: FloatArray) -> tuple[WarmPool, IntArray]:
    """Find the dots again from the absent one outwards, ring by ring.

    Dots in the middle move least from frame to frame; how they moved tells how those around do.
    """
    bed = track.bed
    pool = met(bed, start, track.pool.points_mm)
    ring = np.abs(bed.at + 1 - np.array(bed.rig.pattern.marker)).max(axis=1)
    looked_for = around(bed, track.lit, 2)
    labels = np.full(len(ring), UNLABELLED)
    for reach in range(FIRST_RING, int(ring[track.lit].max()) + 2):
        labels, _ = tracked(scene, pool, track.lit & (ring <= reach), looked_for)
        ray = np.flatnonzero(labels != UNLABELLED)
        if len(ray) < LEAST_DOTS:
            break
        dot = labels[ray]
        slopes = Slopes.of(bed, ray, scene.plane_mm[dot], scene.covariance_mm2[dot])
        pool, _, _ = fit_slopes_to(bed, pool, slopes, GROWING_ROUNDS, start)
    return pool, labels


def _fitted(
    bed: Bed, scene: Scene, pool: WarmPool, labels: IntArray, *, widen: bool = True
) -> tuple[WarmPool, IntArray, FloatArray]:
    """Fit the surface, and once more with the labels that it bears out."""
    for last in (not widen, True):
        ray = np.flatnonzero(labels != UNLABELLED)
        if len(ray) < LEAST_DOTS:
            raise Broken("hardly a dot is left that has a ray")
        dot = labels[ray]
        slopes = Slopes.of(bed, ray, scene.plane_mm[dot], scene.covariance_mm2[dot])
        pool, lower, moved = fit_slopes_to(bed, pool, slopes)
        if not moved < UNSETTLED_MM:
            raise Broken("the surface does not settle")
        if last:
            break
        wider = widened(bed, scene, pool, lower, labels)
        if np.array_equal(wider, labels):
            break
        labels = wider
    return pool, labels, lower


def _level(track: Track, pool: WarmPool, witness: IntArray) -> tuple[Level, float]:
    """Where z = 0 lies on the fitted surface, and how far that was open when the rear was free.

    How deep the rear lies is not asked every time; in between the level is known no better.
    """
    told = witness != 0
    if not (witness < 0).any():
        raise Broken("no ray that would show stayed away")
    bed, before = track.bed, track.level
    height, slope = lay(bed, pool.coefficients)
    free = track.count % SINKS_EVERY == SINKS_EVERY - 1
    drop = None if free else before.rear.drop_mm
    y, about = bed.landing_mm[told, 1], (0.0, before.sign)
    level = place_level(height[told], slope[told], y, witness[told], bed.spacing_mm, drop, about)
    open_mm = level.sigma_mm if free else track.open_mm
    return replace(level, sigma_mm=max(level.sigma_mm, open_mm)), open_mm


def _datum_seen(bed: Bed, scene: Scene, pool: WarmPool, labels: IntArray, foreseen: bool) -> bool:
    """Whether all four neighbours of the absent ray are lit.

    Raises
    ------
    Broken
        If the absent ray's place is lit, or so many of its neighbours are dark that no hole tells
        the rows (`lattice.find_holes`): two; three where the dots are where they were foreseen.
    """
    marker = np.array(bed.rig.pattern.marker) - 1
    place = [
        np.flatnonzero((bed.at == marker + step).all(axis=1))
        for step in ((0, 0), (0, -1), (0, 1), (-1, 0), (1, 0))
    ]
    if any(len(one) == 0 for one in place):
        raise Broken("the absent ray is at the pool's edge")
    hole, *beside = (int(one[0]) for one in place)
    lit = labels[beside] != UNLABELLED
    reach = min(
        float(np.linalg.norm(pool.plane_mm[a] - pool.plane_mm[b])) / 2
        for a, b in (beside[:2], beside[2:])
    )
    if not np.linalg.norm(scene.plane_mm - pool.plane_mm[hole], axis=-1).min() > reach / 2:
        raise Broken("a dot is where the absent one should be dark")
    if lit.sum() < (2 if foreseen else 3):
        raise Broken("the dots beside the absent one are not seen")
    return bool(lit.all())


# --- what is told of it -------------------------------------------------------------------------


def _match(
    track: Track,
    scene: Scene,
    witness: IntArray,
    ray: IntArray,
    dot: IntArray,
    residual_mm: float,
) -> Match:
    bed, first = track.bed, track.match
    marker = np.array(bed.rig.pattern.marker)
    numbers = (bed.at[ray] + 1 - marker) * ways(first.orientation)
    said = np.zeros((bed.rig.pattern.rows, bed.rig.pattern.columns), np.int64)
    said[tuple(bed.at.T)] = witness
    others = tuple(t for t in first.trials if t.orientation != first.orientation)
    return Match(
        orientation=first.orientation,
        dot=dot,
        ray=bed.at[ray] + 1,
        reflected=numbers + 1 - numbers.min(axis=0),
        plane_mm=scene.plane_mm[dot],
        plane_covariance_mm2=scene.covariance_mm2[dot],
        witness=said,
        trials=(Trial(first.orientation, residual_mm), *others),
    )


def _lattice(match: Match, rig: Rig, count: int) -> Lattice:
    """Rows and columns of all dots (`correspondence.indexed_lattice`)."""
    way = ways(match.orientation)
    k, t = np.array(rig.pattern.marker) * way + (match.reflected - match.ray * way)[0]
    row, column = np.zeros((2, count), np.int64)
    row[match.dot], column[match.dot] = match.reflected.T
    at = np.lexsort(match.reflected.T[::-1])
    step = np.diff(match.reflected[at], axis=0)
    gaps = match.reflected[at][1:, 0][(step[:, 0] == 0) & (step[:, 1] > 2)]
    site = (int(k), int(t))
    return Lattice(row, column, site, (site,), frozenset(np.unique(gaps).tolist()))


def _with_uncertainty(track: Track, pool: WarmPool, ray: IntArray, lower: FloatArray) -> Track:
    """Work out how uncertain reflection points are, every now and then or where it is not known."""
    if track.count % POINTS_EVERY and np.isfinite(track.free_mm[ray]).all():
        return track
    splines, values = spline_values(track.bed.basis, pool.points_mm[ray, :2])
    at_points = np.zeros((len(ray), len(pool.coefficients)))
    np.put_along_axis(at_points, splines, values[0], axis=1)
    free = track.free_mm.copy()
    free[ray] = sigma_of(lower, at_points, at_points.mean(axis=0), 0.0)
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
    bed, coefficients = track.bed, pool.coefficients
    points = pool.points_mm[ray]
    center = (points[:, :2].min(axis=0) + points[:, :2].max(axis=0)) / 2
    rim = follow_rim(bed, coefficients, level, center, track.boundary)
    sizes = sizes_of(bed, coefficients, level, rim)
    if not sizes.holds:
        raise Broken("the surface comes down to the work piece within its boundary")
    splines, values = spline_values(bed.basis, points[:, :2])
    level_at = np.bincount(splines.ravel(), values[0].ravel(), len(coefficients)) / len(ray)
    made = Reconstruction(
        scheme="fit",
        surface=SplineSurface(bed.basis, coefficients),
        boundary=rim.boundary,
        ray=match.ray,
        points_mm=points,
        residual_mm=residual,
        sigma_mm=np.hypot(track.free_mm[ray], level.sigma_mm),
    )
    sigma = sigma_of(lower, sizes.gradient, level_at, level.sigma_mm)
    errors = reflection_errors(made, match, bed.rig)
    return made, measures.measures_of(errors, sizes.size, sizes.peak_mm, center, sigma)
