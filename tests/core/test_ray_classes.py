"""Classes of rays: returned, dark or unknown; rays and dots that a surface leaves unexplained."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from labapp.core.geometry.bench import Bench
from labapp.core.geometry.rig import Laser, Rig
from labapp.core.images.dots import Dots
from labapp.core.images.visibility import over_limit
from labapp.core.matching.hypothesis import USUAL_FIT, paths_of
from labapp.core.matching.match_rays import match_rays
from labapp.core.matching.match_settings import MatchSettings
from labapp.core.matching.observation import (
    RESOLVED_SIZES,
    UNLABELLED,
    Observation,
    try_fit,
    widened,
)
from labapp.core.matching.prediction import RayPaths
from labapp.core.matching.ray_classes import (
    NEAR_LIMIT,
    RayClasses,
    certain_states,
    classify_rays,
    too_faint,
)
from labapp.core.rows.find_lattice import LatticeSettings, find_lattice
from labapp.core.surface.level import boundary_is_seen
from labapp.core.values import BoolArray, FloatArray, IntArray
from labapp.simulation.forward import trace
from labapp.simulation.pools import egg, spherical_cap
from tests.scenes import BENCH_RIG, BENCH_VIEW, FRAME_SHAPE, see, true_labels

POOL = egg(5.4, 2.6, 3.0, 0.27)
SEEN = see(POOL, np.random.default_rng(3), sigma_px=0.05)


def observed_on(rig: Rig) -> tuple[Observation, IntArray]:
    """Return the dots of the pool on a rig, and their true labels."""
    return Observation.of(SEEN.dots, Bench(rig, BENCH_VIEW), FRAME_SHAPE), true_labels(SEEN)


def paths_for(observed: Observation, labels: IntArray) -> RayPaths:
    """Return the paths of the rays for the surface fitted to labels."""
    pool = try_fit(observed, labels, USUAL_FIT)
    assert pool is not None
    return paths_of(observed, pool)


def classes(observed: Observation, labels: IntArray) -> RayClasses:
    """Return the classes of rays for the surface fitted to the true labels."""
    return classify_rays(observed, labels, paths_for(observed, true_labels(SEEN)))


def inner(lit: BoolArray) -> BoolArray:
    """Mask of lit rays that have lit rays all round, and are not beside the marker."""
    return ~widened(~lit, 1)


@pytest.fixture(scope="module")
def frame() -> tuple[Observation, IntArray]:
    return observed_on(BENCH_RIG)


def test_true_labels_leave_nothing_unexplained(frame: tuple[Observation, IntArray]) -> None:
    observed, labels = frame
    found, lit = classes(observed, labels), labels != UNLABELLED
    assert (len(found.missed), len(found.stray)) == (0, 0)
    assert (found.ray_states[lit] == 1).all()
    assert not (found.ray_states[~lit] > 0).any()
    assert (found.ray_states[observed.rays.absent] == 0).all()
    # Rays that land well outside the pool have no dot, but some of them cross the view.
    assert (found.ray_states < 0).sum() > 20


def test_missing_dot_is_a_missed_ray(frame: tuple[Observation, IntArray]) -> None:
    observed, labels = frame
    ray = np.argwhere(inner(labels != UNLABELLED))[0]
    dot = labels[tuple(ray)]
    keep = np.arange(len(observed.plane_mm)) != dot
    fewer = replace(
        observed,
        plane_mm=observed.plane_mm[keep],
        covariance_mm2=observed.covariance_mm2[keep],
        size_mm=observed.size_mm[keep],
    )
    others = np.where(labels > dot, labels - 1, np.where(labels == dot, UNLABELLED, labels))
    pool = try_fit(fewer, others, USUAL_FIT)
    assert pool is not None
    found = classify_rays(fewer, others, paths_of(fewer, pool))
    assert found.missed.tolist() == [np.ravel_multi_index(tuple(ray), labels.shape)]
    assert len(found.stray) == 0
    assert found.ray_states[tuple(ray)] == 0


def test_dot_without_label_is_stray_and_its_ray_not_dark(
    frame: tuple[Observation, IntArray],
) -> None:
    observed, labels = frame
    lit = labels != UNLABELLED
    at_rim = np.argwhere(lit & ~inner(lit) & (np.cumsum(lit, axis=0) == 1))[0]
    for ray in np.argwhere(inner(lit))[0], at_rim:
        fewer = labels.copy()
        fewer[tuple(ray)] = UNLABELLED
        found = classes(observed, fewer)
        assert found.stray.tolist() == [labels[tuple(ray)]]
        assert found.ray_states[tuple(ray)] == 0


def test_merged_dots_are_neither_missed_nor_stray(frame: tuple[Observation, IntArray]) -> None:
    observed, labels = frame
    ray = tuple(np.argwhere(inner(labels != UNLABELLED))[0])
    fewer = labels.copy()
    fewer[ray] = UNLABELLED
    blurred = replace(observed, size_mm=np.full(len(observed.size_mm), 50.0))
    found = classes(blurred, fewer)
    assert (len(found.missed), len(found.stray)) == (0, 0)
    assert not (found.ray_states < 0).any()


def test_rays_behind_the_torch_are_not_dark() -> None:
    seen = classes(*observed_on(BENCH_RIG)).ray_states
    low = replace(BENCH_RIG.electrode, height_mm=-50.0)
    behind = classes(*observed_on(replace(BENCH_RIG, electrode=low))).ray_states
    assert (seen < 0).any()
    assert not (behind < 0).any()
    assert ((behind > 0) == (seen > 0)).all()


def test_rays_out_of_view_are_not_dark(frame: tuple[Observation, IntArray]) -> None:
    observed, labels = frame
    width, height = observed.plane_mm.max(axis=0)
    narrow = replace(observed.rig.imaging_plane, width_mm=width, height_mm=height)
    cropped, _ = observed_on(replace(BENCH_RIG, imaging_plane=narrow))
    wide, tight = classes(observed, labels).ray_states, classes(cropped, labels).ray_states
    assert (tight < 0).sum() < (wide < 0).sum()


@pytest.mark.parametrize("angle_deg", [24.0, 26.0])
def test_rays_that_the_far_side_of_a_deep_pool_stops_are_not_dark(angle_deg: float) -> None:
    rig = replace(BENCH_RIG, laser=Laser(angle_deg, 31.48))
    pool = spherical_cap(5.2, -0.55)
    seen, rays = see(pool, np.random.default_rng(3), sigma_px=0.05, rig=rig), trace(pool, rig)
    observed = Observation.of(seen.dots, Bench(rig, BENCH_VIEW), FRAME_SHAPE)
    labels = true_labels(seen)
    fitted = try_fit(observed, labels, USUAL_FIT)
    assert fitted is not None
    dark = classify_rays(observed, labels, paths_of(observed, fitted)).ray_states < 0
    assert (rays.hit & rays.hits_again).sum() >= 4
    assert not (dark & rays.hit).any()
    # Rays beside the pool still show where it ends.
    assert (dark & ~rays.hit & widened(rays.hit, 1)).sum() >= 10


def test_false_dot_beside_the_plane_does_not_widen_the_view(
    frame: tuple[Observation, IntArray],
) -> None:
    observed, labels = frame
    paths = paths_for(observed, labels)
    ray_states = classify_rays(observed, labels, paths).ray_states
    dark = np.flatnonzero((ray_states < 0) & widened(ray_states > 0, 1))
    right = paths.plane_mm[dark, 0].max()
    narrow = replace(observed.rig.imaging_plane, width_mm=observed.plane_mm[:, 0].max() + 1.0)
    assert right > narrow.width_mm
    cropped, _ = observed_on(replace(BENCH_RIG, imaging_plane=narrow))
    with_false = replace(
        cropped,
        plane_mm=np.vstack([cropped.plane_mm, [right + 2.0, 50.0], [45.0, -6.0]]),
        covariance_mm2=np.concatenate([cropped.covariance_mm2, cropped.covariance_mm2[-2:]]),
        size_mm=np.append(cropped.size_mm, cropped.size_mm[-2:]),
    )
    found, without = (classify_rays(one, labels, paths).ray_states for one in (with_false, cropped))
    np.testing.assert_array_equal(found, without)

    def exact(rays: IntArray) -> FloatArray:
        return np.zeros((len(rays), 2, 2))

    certain, expected = (
        certain_states(one, labels, found, paths, exact) for one in (with_false, cropped)
    )
    np.testing.assert_array_equal(certain, expected)
    # A labelled ray at the rim may leave the splines.
    plane = paths.plane_mm.copy()
    plane[np.flatnonzero(found > 0)[0]] = np.nan
    beyond = certain_states(with_false, labels, found, replace(paths, plane_mm=plane), exact)
    np.testing.assert_array_equal(beyond, certain)
    # Rows and columns whose predictions are uncertain by 2 mm may have left the view as well.
    rough, expected = (
        certain_states(one, labels, found, paths, lambda rays: exact(rays) + 4 * np.eye(2))
        for one in (with_false, cropped)
    )
    np.testing.assert_array_equal(rough, expected)
    assert (rough < 0).sum() < (certain < 0).sum()
    beside = paths.plane_mm[dark, 0] > narrow.width_mm
    assert (certain.flat[dark[beside]] == 0).all()
    assert (certain.flat[dark[~beside]] < 0).any()


def test_merged_dots_of_a_row_beyond_the_labels_are_not_stray() -> None:
    """A concave pool focuses its last row, of which no dot may be resolved."""
    seen = see(spherical_cap(5.4, -0.45), np.random.default_rng(3), sigma_px=0.05)
    observed = Observation.of(seen.dots, Bench(BENCH_RIG, BENCH_VIEW), FRAME_SHAPE)
    sharp, merging = (
        replace(observed, size_mm=np.full(len(seen.ray), size_mm))
        for size_mm in (0.1, 1.2 / RESOLVED_SIZES)
    )
    true = true_labels(seen)
    last = np.flatnonzero((true != UNLABELLED).any(axis=1))[-1]
    labels, dots = true.copy(), true[last][true[last] != UNLABELLED]
    labels[last] = UNLABELLED
    pool = try_fit(observed, labels, USUAL_FIT)
    assert pool is not None
    paths = paths_of(observed, pool)
    assert classify_rays(sharp, labels, paths).stray.tolist() == sorted(dots.tolist())
    assert len(classify_rays(merging, labels, paths).stray) == 0
    # Two rows are left over: the dots of the second one may come from elsewhere.
    labels[last - 1] = UNLABELLED
    assert set(classify_rays(merging, labels, paths).stray) >= set(dots.tolist())


def test_wide_dot_is_merged_from_those_of_the_rays_beside_it(
    frame: tuple[Observation, IntArray],
) -> None:
    observed, labels = frame
    paths = paths_for(observed, labels)
    ray = np.argwhere(inner(labels != UNLABELLED))[0]
    pair = np.array([labels[tuple(ray)], labels[ray[0], ray[1] + 1]])
    half_apart_mm = np.diff(observed.plane_mm[pair], axis=0)[0] / 2
    plane_mm, size_mm = observed.plane_mm.copy(), np.full(len(observed.plane_mm), 0.4)
    plane_mm[pair[0]] += half_apart_mm
    plane_mm[pair[1]] = [1.0, 1.0]  # a false dot
    others = np.where(np.isin(labels, pair), UNLABELLED, labels)
    usual = replace(observed, plane_mm=plane_mm, size_mm=size_mm)
    size_mm = size_mm.copy()
    size_mm[pair[0]] = np.hypot(0.4, np.linalg.norm(half_apart_mm))
    found = classify_rays(replace(usual, size_mm=size_mm), others, paths)
    assert found.stray.tolist() == [pair[1]]
    assert len(found.missed) == 0
    found = classify_rays(usual, others, paths)
    assert sorted(found.stray) == sorted(pair)
    assert len(found.missed) == 2
    # A false dot that is wide has no rays beside it.
    size_mm[pair[1]] = size_mm[pair[0]]
    assert classify_rays(replace(usual, size_mm=size_mm), others, paths).stray.tolist() == [pair[1]]


ROW, COLUMN = np.indices((19, 19)) - 9
DISC = ROW**2 + COLUMN**2 <= 5**2
"""Rays of the pattern that have a dot in the tests of faint dots."""


def faint_beside(brightness: FloatArray) -> tuple[BoolArray, BoolArray]:
    """Rays beside those of the disc, and those of them that are too faint, shape (rows, columns).

    ``brightness`` is that of all rays, which scatters by 0.2 in addition.
    """
    labels = np.where(DISC, np.cumsum(DISC).reshape(DISC.shape) - 1, UNLABELLED)
    scatter = np.random.default_rng(1).normal(0.0, 0.2, DISC.sum())
    faint = too_faint(np.maximum(brightness[DISC] + scatter, 0.0), labels)
    beside = widened(DISC, 1) & ~DISC
    assert not (faint & DISC).any()
    return beside, faint & beside


def test_dots_entered_where_no_light_is_do_not_count_as_faint() -> None:
    """Their peak is 0, and so is their signal-to-noise ratio."""
    peak = np.where(np.arange(len(SEEN.dots)) < 5, 0.0, 100.0)
    over = over_limit(replace(SEEN.dots, peak=peak, snr=peak))
    assert np.isnan(over[:5]).all()
    assert (over[5:] > NEAR_LIMIT).all()
    assert not too_faint(over, true_labels(SEEN)).any()


@pytest.mark.parametrize("brightness", [0.8, 1.5])
def test_dots_that_do_not_fade_are_not_too_faint(brightness: float) -> None:
    _, faint = faint_beside(np.full(DISC.shape, brightness))
    assert not faint.any()


def test_dots_that_fade_towards_the_rim_may_be_too_faint_beyond_it() -> None:
    beside, faint = faint_beside(1.8 - (ROW**2 + COLUMN**2) / 14.0)
    assert (faint == beside).all()


def test_dots_that_fade_to_one_side_may_be_too_faint_there() -> None:
    beside, faint = faint_beside(1.6 - COLUMN * 0.35)
    assert faint[beside & (COLUMN > 4)].all()
    assert not faint[beside & (COLUMN < 3)].any()


def test_boundary_is_not_seen_where_dots_fade() -> None:
    seen = see(spherical_cap(6.0, 0.25), np.random.default_rng(5), sigma_px=0.05)
    r2 = ((seen.ray - 10) ** 2).sum(axis=1)
    peak = 100.0 * np.exp(-r2 / (0.25 * r2.max()))
    found = peak > 9.0  # about the limit of the detector
    assert found.mean() < 0.9
    fading = Dots(*(values[found] for values in vars(replace(seen.dots, peak=peak)).values()))
    even = replace(fading, peak=np.full(len(fading), 100.0))
    bench = Bench(BENCH_RIG, BENCH_VIEW)
    lattice = find_lattice(fading, FRAME_SHAPE, LatticeSettings())
    for dots, is_seen in ((even, True), (fading, False)):
        observed = Observation.of(dots, bench, FRAME_SHAPE)
        match, _ = match_rays(observed, lattice, MatchSettings())
        assert boundary_is_seen(match.ray_states) == is_seen
