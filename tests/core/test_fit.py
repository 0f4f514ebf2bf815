"""The fit on exact and noisy reflections, and its stated uncertainty."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg.lapack import dtbtrs

from labapp.core.geometry.rig import DotPattern
from labapp.core.match import Match
from labapp.core.schemes import ers, fit
from labapp.core.surface.boundary_trace import trace_boundary
from labapp.core.surface.measures import Measures, measure_surface, reflection_errors, surface_sizes
from labapp.core.surface.pool_fit import FitSettings, fit_pool
from labapp.core.surface.reconstruction import Reconstruction
from labapp.core.surface.shape import shape_of
from labapp.core.surface.spline import SplineSurface
from labapp.core.values import FloatArray
from labapp.simulation.forward import exact_match, trace
from labapp.simulation.pools import (
    Dent,
    Pool,
    Term,
    caps_8_3_1,
    egg,
    ellipsoidal_cap,
    spherical_cap,
)
from labapp.studies.image_error import BENCH
from tests.oscillation import Oscillation
from tests.scenes import OPEN_RIG

NOISE_MM = 0.053
"""0.3 px in the bench's view."""


def fitted(
    pool: Pool, sigma_mm: float = 0.0, rng: np.random.Generator | None = None
) -> tuple[Reconstruction, Match]:
    match = exact_match(trace(pool, OPEN_RIG), sigma_mm=sigma_mm, rng=rng)
    return fit.reconstruct(match, OPEN_RIG, FitSettings()), match


def measured(pool: Pool) -> Measures:
    return measure_surface(*fitted(pool), OPEN_RIG)


def extreme(pool: Pool, measures: Measures) -> float:
    """Height of a convex pool, depth of a concave one, both positive, mm."""
    return measures.height_mm if pool.peak_mm > 0 else -measures.depth_mm


def inside(pool: Pool) -> FloatArray:
    """Points all over a pool, up to a fiftieth of the way from its boundary, shape (n, 2)."""
    center = np.array(pool.footprint.center_mm)
    spokes = pool.boundary_mm(180)[:, :2] - center
    return (center + np.linspace(0.02, 0.98, 25)[:, None, None] * spokes).reshape(-1, 2)


@pytest.mark.parametrize(("width_mm", "depth_mm"), [(6.1, -0.72), (5.5, -0.6)])
def test_pool_is_measured_where_head_and_rear_miss_the_plane(
    width_mm: float, depth_mm: float
) -> None:
    # Even with a dense pattern only the middle third of the pool is visible.
    rig = replace(BENCH, pattern=DotPattern(37, 37, 0.385))
    pool = spherical_cap(width_mm, depth_mm)
    match = exact_match(trace(pool, rig))
    reconstruction = fit.reconstruct(match, rig, FitSettings())
    sizes = measure_surface(reconstruction, match, rig)
    assert np.ptp(reconstruction.points_mm[:, 1]) < 0.75 * width_mm
    assert sizes.depth_mm == pytest.approx(depth_mm, rel=0.02)
    assert sizes.length_mm == pytest.approx(width_mm, rel=0.02)


@pytest.mark.slow
def test_28_caps_of_8_3_1() -> None:
    depth, width, length, ratio = [], [], [], []
    for cap in caps_8_3_1():
        reconstruction, match = fitted(cap)
        measures = measure_surface(reconstruction, match, OPEN_RIG)
        depth.append(abs(extreme(cap, measures) / abs(cap.peak_mm) - 1))
        width.append(abs(measures.width_mm / cap.footprint.width_mm - 1))
        length.append(abs(measures.length_mm / cap.footprint.width_mm - 1))
        ers_result = ers.reconstruct(match, OPEN_RIG, ers.ErsSettings(boundary="circle"))
        error = reflection_errors(ers_result, match, OPEN_RIG)["are_mm"]
        ratio.append(error / measures.are_mm)
    assert len(depth) == 28
    assert np.mean(depth) <= 0.01
    assert np.max(depth) <= 0.04
    assert np.max(width) <= 0.02
    assert np.max(length) <= 0.02
    # The requirement is 5; with exact dots the least ratio of any cap was 600.
    assert np.min(ratio) >= 100


@pytest.mark.parametrize(
    ("term", "rms_mm"),
    [
        (Dent(0.1, 1.2), 0.0015),
        (Dent(0.08, 1.5, (0.2, 0.3)), 0.0015),
        (Oscillation(0.1, 30.0, 0.0), 0.0015),
        (Oscillation(0.1, 30.0, 0.008), 0.0015),
        (Oscillation(0.15, 30.0, 0.004), 0.0015),
    ],
)
def test_dent_and_oscillation_are_reconstructed(term: Term, rms_mm: float) -> None:
    pool = egg(6.6, 3.2, 4.2, 0.3, terms=(term,))
    reconstruction, match = fitted(pool)
    xy = inside(pool)
    error = reconstruction.unbounded.height(*xy.T) - pool.height(*xy.T)
    assert np.sqrt(np.mean(error**2)) < rms_mm
    measures = measure_surface(reconstruction, match, OPEN_RIG)
    assert measures.height_mm == pytest.approx(pool.size.height_mm, abs=0.01)
    assert measures.width_mm == pytest.approx(pool.size.width_mm, rel=0.02)
    assert measures.length_mm == pytest.approx(pool.size.length_mm, rel=0.02)


def test_points_residuals_and_boundary_belong_to_the_surface() -> None:
    pool = ellipsoidal_cap(6.4, 7.4, 0.35, (0.3, -0.2))
    reconstruction, match = fitted(pool)
    assert reconstruction.scheme == "fit"
    np.testing.assert_array_equal(reconstruction.ray, match.ray)
    x, y, z = reconstruction.points_mm.T
    np.testing.assert_allclose(z, reconstruction.unbounded.height(x, y), atol=1e-6)
    true = trace(pool, OPEN_RIG).point_mm[tuple(match.ray.T - 1)]
    np.testing.assert_allclose(reconstruction.points_mm, true, atol=0.02)
    assert np.linalg.norm(reconstruction.residual_mm, axis=-1).max() < 0.02
    outline = reconstruction.boundary.points_mm
    np.testing.assert_allclose(outline[:, 2], 0.0, atol=1e-12)
    np.testing.assert_allclose(reconstruction.surface.height(*outline[:, :2].T), 0.0, atol=1e-6)
    assert reconstruction.boundary.contains(x, y).mean() > 0.97
    # Beyond the boundary there is no surface, though its splines continue.
    beyond = outline[:, :2] + 1e-3 * (outline[:, :2] - reconstruction.boundary.center_mm)
    assert np.isfinite(reconstruction.unbounded.height(*beyond.T)).all()
    assert np.isnan(reconstruction.surface.height(*beyond.T)).all()
    assert np.isnan(reconstruction.surface.gradient(*beyond.T)).all()


@pytest.mark.slow
@pytest.mark.parametrize("seen", [spherical_cap(6.0, 0.35), egg(6.6, 3.2, 4.2, 0.3)])
def test_size_uncertainty_is_the_spread_over_the_posterior(seen: Pool) -> None:
    # Surfaces drawn from the covariance of the fit, each measured.
    rng = np.random.default_rng(0)
    reflections = trace(seen, OPEN_RIG)
    match = exact_match(reflections, sigma_mm=NOISE_MM, rng=rng)
    reconstruction = fit.reconstruct(match, OPEN_RIG, FitSettings())
    pool = fit_pool(match, OPEN_RIG, FitSettings())
    level, sizes = pool.level, []
    both = level.drop_covariance_mm2
    covariance = [[level.sigma_mm**2, both], [both, level.drop_sigma_mm**2]]
    for _ in range(300):
        half = rng.normal(size=pool.surface.basis.count)
        change = dtbtrs(pool.factor, half, uplo="L", trans="T")[0]
        shift, deeper = rng.multivariate_normal([0.0, 0.0], covariance)
        change += shift - pool.mean_splines @ change
        surface = SplineSurface(pool.surface.basis, pool.surface.coefficients + change)
        center = reconstruction.boundary.center_mm
        moved = replace(level, rear=replace(level.rear, drop_mm=level.rear.drop_mm + deeper))
        boundary, _ = trace_boundary(surface.basis, surface.coefficients, moved, center)
        sizes.append(np.append(surface_sizes(surface, boundary)[0], shape_of(surface, boundary)))
    np.testing.assert_allclose(np.std(sizes, axis=0)[:3], reconstruction.size_sigma[:3], rtol=0.2)
    np.testing.assert_allclose(np.std(sizes, axis=0)[4:], reconstruction.size_sigma[4:], rtol=0.2)
    assert np.isnan(reconstruction.size_sigma[3])  # the lowest point is on the rim


def test_wetting_slope_of_a_cap_is_that_at_its_boundary() -> None:
    """One per cent inside, it would be smaller by one per cent, which is 2.5 σ here."""
    pool = spherical_cap(5.6, 0.25)
    match = exact_match(trace(pool, OPEN_RIG))
    surface = fit.fit_surface(match, OPEN_RIG, FitSettings())
    found = fit.bound_and_measure(match, surface, OPEN_RIG)[1]
    # A sphere's cap of height h over a circle of radius a ends at the angle 2 atan(h/a).
    expected = np.degrees(2 * np.arctan(0.25 / 2.8))
    assert abs(found.wetting_slope_deg - expected) < 0.5 * found.wetting_slope_sigma_deg


def random_pool(rng: np.random.Generator, kind: int) -> Pool:
    """Return a cap, ellipse, egg or concave cap, up to 0.5 mm off the origin in X and Y."""
    width = rng.uniform(4.5, 8.0)
    peak = width * rng.uniform(0.03, 0.1)
    center = (rng.uniform(-0.5, 0.5), rng.uniform(-0.5, 0.5))
    if kind == 0:
        return spherical_cap(width, peak, center)
    if kind == 1:
        return ellipsoidal_cap(width, width * rng.uniform(0.9, 1.3), peak, center)
    if kind == 2:
        return egg(
            width, width * rng.uniform(0.4, 0.5), width * rng.uniform(0.5, 0.7), peak, center
        )
    return spherical_cap(width, -peak, center)


def area(pool: Pool) -> float:
    x, y = pool.boundary_mm()[:, :2].T
    return float(np.abs(np.sum(x * np.roll(y, -1) - y * np.roll(x, -1)))) / 2


def volume(pool: Pool) -> float:
    """Return the volume by the midpoint rule on a fine grid, mm³."""
    center, reach = pool.footprint.center_mm, 6.0
    axis = (np.arange(240) + 0.5) / 240 * 2 * reach - reach
    z = pool.height(*np.meshgrid(center[0] + axis, center[1] + axis))
    return float(np.nansum(z)) * (2 * reach / 240) ** 2


@pytest.mark.slow
def test_uncertainties_cover_the_errors() -> None:
    # With 240 pools, 97.5 % of heights were within ±1.96 σ, and the RMS of error/σ was 0.75 to
    # 0.80 for width, length, height and area.
    rng = np.random.default_rng(0)
    within, normalized_errors = [], []
    for k in range(40):
        pool = random_pool(rng, k % 4)
        reconstruction, match = fitted(pool, NOISE_MM, rng)
        error = reconstruction.points_mm[:, 2] - pool.height(*reconstruction.points_mm[:, :2].T)
        known = np.isfinite(error)
        assert known.mean() > 0.9
        within.append(np.abs(error[known]) < 1.96 * reconstruction.sigma_mm[known])
        measures, true = measure_surface(reconstruction, match, OPEN_RIG), pool.size
        convex = pool.peak_mm > 0
        sigma = measures.height_sigma_mm if convex else measures.depth_sigma_mm
        normalized_errors.append(
            [
                (measures.width_mm - true.width_mm) / measures.width_sigma_mm,
                (measures.length_mm - true.length_mm) / measures.length_sigma_mm,
                (extreme(pool, measures) - max(true.height_mm, -true.depth_mm)) / sigma,
                (measures.area_mm2 - area(pool)) / measures.area_sigma_mm2,
                (measures.volume_mm3 - volume(pool)) / measures.volume_sigma_mm3,
            ]
        )
    assert 0.87 < np.mean(np.concatenate(within)) < 0.995
    rms = np.sqrt(np.mean(np.square(normalized_errors), axis=0))
    assert rms.min() > 0.5
    assert rms.max() < 1.6


def test_uncertainty_grows_with_the_noise() -> None:
    pool = spherical_cap(6.3, 0.35)
    sigma = [
        np.median(fitted(pool, noise, np.random.default_rng(1))[0].sigma_mm)
        for noise in (0.02, 0.2, 0.8)
    ]
    assert sigma[0] < sigma[1] < sigma[2]
    assert sigma[2] > 1.25 * sigma[0]


def test_fit_is_reproducible() -> None:
    one, other = (
        fitted(egg(6.6, 3.0, 4.0, 0.3), NOISE_MM, np.random.default_rng(4))[0] for _ in range(2)
    )
    np.testing.assert_array_equal(one.points_mm, other.points_mm)
    np.testing.assert_array_equal(one.boundary.points_mm, other.boundary.points_mm)


def test_sizes_have_uncertainties_where_last_rows_are_hidden() -> None:
    # The torch hides the last two rows: the fitted rectangle ends just beyond the pool's end,
    # which would be outside if it were one σ farther out.
    rng = np.random.default_rng(1)
    pool = egg(7.16, 3.78, 4.62, 0.131)
    match = exact_match(trace(pool, OPEN_RIG), sigma_mm=0.12, rng=rng)
    hidden = match.ray[:, 0] < match.ray[:, 0].min() + 2
    ray_states = match.ray_states.copy()
    ray_states[tuple(match.ray[hidden].T - 1)] = 0
    match = replace(
        match,
        dot=match.dot[~hidden],
        ray=match.ray[~hidden],
        reflected=match.reflected[~hidden],
        plane_mm=match.plane_mm[~hidden],
        plane_covariance_mm2=match.plane_covariance_mm2[~hidden],
        ray_states=ray_states,
    )
    reconstruction = fit.reconstruct(match, OPEN_RIG, FitSettings())
    size = measure_surface(reconstruction, match, OPEN_RIG)
    sigmas = {name: value for name, value in vars(size).items() if "_sigma_" in name}
    # The depth has none: the lowest point is on the boundary.
    assert all(np.isfinite(sigmas[name]) for name in sigmas if not name.startswith("depth"))
    assert 0 < size.volume_sigma_mm3 < 0.2 * size.volume_mm3


def test_setup_part_is_that_of_the_nearest_sizes_within_10_percent() -> None:
    sizes = np.array([6.0, 7.0, 0.3, -0.01, 30.0, 5.0])
    parts = tuple(fit.SetupPart(np.full(9, factor), factor * sizes) for factor in (1.0, 1.08, 1.3))
    assert fit.nearest_part((), sizes) is None
    for factor, expected in ((1.0, 0), (1.05, 1), (1.25, 2)):
        assert fit.nearest_part(parts, factor * sizes) == expected
    assert fit.nearest_part(parts, 0.85 * sizes) is None
    depth = np.eye(6)[3]  # depth is compared on the scale of the height
    assert fit.nearest_part(parts[:1], sizes - 0.02 * depth) == 0
    assert fit.nearest_part(parts[:1], sizes - 0.04 * depth) is None


def test_setup_part_becomes_the_mean_variance_of_ever_rarer_frames() -> None:
    sizes, other = np.full(6, 2.0), np.full(6, 3.0)
    computed = [np.array([one, *np.ones(8)]) for one in (1.0, 3.0, 2.0)]
    computed[1][3], computed[2][4] = np.nan, np.nan
    parts = fit.parts_after((), computed[0], sizes)
    parts = fit.parts_after(parts, computed[0], other)
    gaps = []
    for fresh in computed[1:]:
        gap = 0
        while not parts[0].is_due:
            gap += 1
            parts = fit.parts_after(parts, parts[0].sigma, sizes)
        gaps.append(gap)
        parts = fit.parts_after(parts, parts[0].sigma_with(fresh), sizes)
    assert gaps == [fit.SETUP_EVERY, 2 * fit.SETUP_EVERY]
    np.testing.assert_allclose(parts[0].sigma, [np.sqrt(14 / 3), *np.ones(8)])
    assert (parts[0].averaged, parts[0].used) == (3, 0)
    assert (parts[1].averaged, parts[1].used) == (1, 0)  # for other sizes
    for _ in range(2 * fit.MOST_AVERAGED):
        parts = fit.parts_after((replace(parts[0], used=10**6),), np.ones(9), sizes)
    assert parts[0].averaged == fit.MOST_AVERAGED


@pytest.mark.parametrize(
    ("used", "expected"), [(fit.SETUP_EVERY - 1, 3.0), (fit.SETUP_EVERY, np.sqrt(4.5))]
)
def test_setup_part_of_a_frame_is_the_kept_one_or_the_mean_with_its_own(
    used: int, expected: float
) -> None:
    """With an exact set-up the frame's own is 0."""
    pool = spherical_cap(5.6, 0.25)
    match = exact_match(trace(pool, OPEN_RIG))
    surface = fit.fit_surface(match, OPEN_RIG, FitSettings())
    made, sizes = fit.bound_and_measure(match, surface, OPEN_RIG)
    part = fit.SetupPart(np.full(9, 3.0), sizes.sizes, used=used)
    previous = fit.FromPrevious(made.boundary, (part,))
    again, _ = fit.bound_and_measure(match, surface, OPEN_RIG, previous)
    np.testing.assert_allclose(again.size_sigma_setup, np.full(9, expected))
