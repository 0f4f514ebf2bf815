"""What a measured frame leaves to the next, and how the next one's dots are found with it.

A pool that swings is carried on as it swung (`predictions`). Where that does not find the dots, as
at the start, they are followed from the absent one outwards, ring by ring.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numba import types

from labapp.core.compiled import compiled
from labapp.core.geometry.rig import Rig
from labapp.core.images.band_pass import DetectorTuning
from labapp.core.images.dots import Image
from labapp.core.match import Match
from labapp.core.matching.observation import UNLABELLED, Observation
from labapp.core.pipeline import Measurement, Settings
from labapp.core.schemes.fit import LEAST_DOTS, UNSETTLED_MM
from labapp.core.sequence.warm_fit import (
    SequenceGeometry,
    Slopes,
    WarmPool,
    fit_slopes_to,
    intersect_and_reflect,
)
from labapp.core.sequence.warm_match import around, filled, tracked
from labapp.core.surface.boundary import Boundary
from labapp.core.surface.level import Level, find_level
from labapp.core.surface.reconstruction import Reconstruction
from labapp.core.surface.spline import SplineSurface
from labapp.core.values import BoolArray, CannotMeasure, FloatArray, IntArray, median

FOUND = 0.85
"""Share of the dots of the frame before that must be found again."""

STEADY = 0.2
"""… and half of them within this share of the way to the next dot of where they were predicted."""

FIRST_RING, GROWING_ROUNDS, GROWN_FROM = 2, 3, 12
"""Where no prediction finds the dots, they are first looked for so near the absent one, in so many
rounds a ring, from so many surfaces of the past."""

MEMORY, ORDER, TEACHERS = 32, 8, 3
"""Frames that predictions are learnt from, and from how many of them, at most, one is made; every
so-many-th lit ray tells as much as all."""


class TrackLost(Exception):
    """A track does not lead to this frame; says why in a sentence."""


@dataclass(frozen=True)
class Track:
    """What a frame leaves to the next.

    Parameters
    ----------
    geometry
        Splines and rays.
    tuning
        Size of dots and noise.
    match
        Of the cold chain, where the track began.
    residual_mm
        Root mean square residual there, mm.
    pool, lit, boundary, level
        The last surface, the rays that had dots, where the pool ends, and z = 0.
    past, slopes
        Spline coefficients of the last frames, the newest last, shape (frames, p), mm, and the
        slopes of those surfaces where rays met them, shape (frames, R, 2).
    open_mm
        How far the level was left open when it was last asked how deep the rear lies, mm.
    free_mm
        Uncertainty of the height where each ray meets the surface, its level apart, as it was last
        worked out, shape (R,), mm; NaN where it never was. It changes slowly.
    size_sigma_setup
        Uncertainty of the sizes by the set-up (`Reconstruction`), as it was last worked out.
    unseen
        Frames since the absent ray's place was last seen dark amid four lit ones.
    count
        Frames that were followed.
    """

    geometry: SequenceGeometry
    tuning: DetectorTuning
    match: Match
    residual_mm: float
    pool: WarmPool
    lit: BoolArray
    boundary: Boundary
    level: Level
    past: FloatArray
    slopes: FloatArray
    open_mm: float
    free_mm: FloatArray
    size_sigma_setup: FloatArray
    unseen: int = 0
    count: int = 0


def begin(
    image: Image, measurement: Measurement, rig: Rig, settings: Settings, former: Track | None
) -> Track | None:
    """Start a track from a frame that the cold chain measured; None where none can be.

    What is remembered of a ``former`` track, of the frames just before, stays.
    """
    match, made = measurement.match, measurement.reconstruction
    if match is None or made is None or not isinstance(made.unbounded, SplineSurface):
        return None
    if made.scheme != "fit":
        return None
    if settings.dots.method != "band-pass" or rig.pattern.marker is None:
        return None
    own, pool = SequenceGeometry.of(rig, made.unbounded.basis, settings.fit), None
    if former is not None and np.array_equal(own.at, former.geometry.at):
        geometry, pool = former.geometry, _moved_to(former, match, made)
    if pool is None:
        former, geometry = None, own
        pool = intersect_and_reflect(geometry, made.unbounded.coefficients, geometry.landing_mm, 4)
    witness = match.witness[tuple(geometry.at.T)]
    witnesses = witness != 0
    surface = SplineSurface(geometry.basis, pool.coefficients)
    x, y = geometry.landing_mm[witnesses, :2].T
    height, slope = surface.height_and_gradient(x, y)
    seen = height, slope, y, witness[witnesses], geometry.spacing_mm
    level = find_level(*seen, (geometry.rig.head_sign, None), missing=match.missing)
    if former is None:
        past, before = np.empty((0, len(pool.coefficients))), np.empty((0, *pool.slopes.shape))
    else:
        past, before = former.past[1 - MEMORY :], former.slopes[1 - MEMORY :]
    return Track(
        geometry=geometry,
        tuning=DetectorTuning.of(image, settings.dots.band_pass),
        match=match,
        residual_mm=rms(made.residual_mm),
        pool=pool,
        lit=witness > 0,
        boundary=made.boundary,
        level=level,
        past=np.vstack([past, pool.coefficients]),
        slopes=np.concatenate([before, pool.slopes[None]]),
        open_mm=level.sigma_mm,
        free_mm=np.full(len(geometry.at), np.nan),
        size_sigma_setup=made.size_sigma_setup,
    )


def _moved_to(former: Track, match: Match, made: Reconstruction) -> WarmPool | None:
    """The surface of a cold fit in the splines of a former track; None if they have no place."""
    geometry = former.geometry
    number = {(i, j): k for k, (i, j) in enumerate((geometry.at + 1).tolist())}
    rays = [number.get((i, j)) for i, j in match.ray.tolist()]
    if None in rays:
        return None
    ray = np.array(rays, np.int64)
    points = geometry.landing_mm.copy()
    points[ray] = made.points_mm
    start = replace(former.pool, points_mm=points)
    slopes = Slopes.of(geometry, ray, match.plane_mm, match.plane_covariance_mm2)
    try:
        pool, _, moved = fit_slopes_to(geometry, start, slopes)
    except CannotMeasure:
        return None
    lower_by = float(np.mean(made.points_mm[:, 2] - pool.points_mm[ray, 2]))
    pool = intersect_and_reflect(geometry, pool.coefficients + lower_by, pool.points_mm, 4)
    return pool if moved < UNSETTLED_MM else None


def rms(residual: FloatArray) -> float:
    """Root mean square length of residuals, shape (n, 2)."""
    return float(np.sqrt(np.mean(np.sum(residual**2, axis=-1))))


def predictions(track: Track) -> Iterator[FloatArray]:
    """Spline coefficients that the next frame may have, the likeliest first.

    A pool that swings goes on as it did: a linear recurrence, learnt from the frames before on the
    slopes at lit rays, carries any few oscillations on.
    """
    past, order = track.past, min(ORDER, len(track.past) // 2)
    if order > 2:
        teachers = np.flatnonzero(track.lit)[::TEACHERS]
        gram, right = recurrence(track.slopes, teachers, order)
        gram.flat[:: order + 1] += 1e-4 * np.trace(gram)
        ratio = np.linalg.solve(gram, right)
        mean = past.mean(axis=0)
        yield mean + ratio @ (past[: -order - 1 : -1] - mean)
    if len(past) > 1:
        yield 2 * past[-1] - past[-2]
    yield past[-1]


@compiled(
    types.Array(types.float64, 3, "A", readonly=True),
    types.Array(types.int64, 1, "A", readonly=True),
    types.int64,
)
def recurrence(slopes: FloatArray, rays: IntArray, order: int) -> tuple[FloatArray, FloatArray]:
    """Normal equations of the linear recurrence by which frames follow on each other.

    Of the slopes of some rays in M frames, shape (M, R, 2), each over its mean: shapes
    (order, order) and (order,), the newest of the frames that are followed first.
    """
    gram, right = np.zeros((order, order)), np.zeros(order)
    own = np.empty(len(slopes))
    next_ones = own[order:]
    for ray in rays:
        for axis in range(2):
            mean = 0.0
            for m in range(len(slopes)):
                own[m] = slopes[m, ray, axis]
                mean += own[m] / len(slopes)
            for m in range(len(slopes)):
                own[m] -= mean
            for k in range(order):
                one, product = own[order - 1 - k :], 0.0
                for m in range(len(next_ones)):
                    product += one[m] * next_ones[m]
                right[k] += product
                for other in range(k + 1):
                    two, product = own[order - 1 - other :], 0.0
                    for m in range(len(next_ones)):
                        product += one[m] * two[m]
                    gram[k, other] += product
    for k in range(order):
        for other in range(k):
            gram[other, k] = gram[k, other]
    return gram, right


def found_again(track: Track, observed: Observation) -> tuple[WarmPool, IntArray, float]:
    """A surface that finds the dots again, the rays that gives them, and how far dots are off.

    That is the median share of the way to the next dot, from where they were foreseen. Where none
    that is foreseen finds them, one is grown from the last surface, and from those before it: then
    dots were nowhere foreseen, and it is infinite.
    """
    geometry, count = track.geometry, int(track.lit.sum())
    own, looked_for = filled(geometry, track.lit), around(geometry, track.lit, 2)
    for coefficients in predictions(track):
        pool = intersect_and_reflect(geometry, coefficients, track.pool.points_mm, 1)
        labels, off = tracked(observed, pool, own, looked_for)
        if len(off) >= FOUND * count and (half := median(off)) < STEADY:
            return pool, labels, half
    found = 0
    for coefficients in track.past[: -GROWN_FROM - 1 : -1]:
        pool, labels = _grown(track, observed, coefficients)
        found = max(found, int(np.sum(labels != UNLABELLED)))
        if found >= max(FOUND * count, LEAST_DOTS):
            return pool, labels, np.inf
    raise TrackLost(f"{found} of {count} dots were found again")


def _grown(track: Track, observed: Observation, start: FloatArray) -> tuple[WarmPool, IntArray]:
    """Find the dots again from the absent one outwards, ring by ring.

    Dots in the middle move least from frame to frame; how they moved tells how those around do.
    """
    geometry = track.geometry
    pool = intersect_and_reflect(geometry, start, track.pool.points_mm)
    ring = np.abs(geometry.at + 1 - np.array(geometry.rig.pattern.marker)).max(axis=1)
    looked_for = around(geometry, track.lit, 2)
    labels = np.full(len(ring), UNLABELLED)
    for reach in range(FIRST_RING, int(ring[track.lit].max()) + 2):
        labels, _ = tracked(observed, pool, track.lit & (ring <= reach), looked_for)
        ray = np.flatnonzero(labels != UNLABELLED)
        if len(ray) < LEAST_DOTS:
            break
        dot = labels[ray]
        slopes = Slopes.of(geometry, ray, observed.plane_mm[dot], observed.covariance_mm2[dot])
        pool, _, _ = fit_slopes_to(geometry, pool, slopes, GROWING_ROUNDS, start)
    return pool, labels
