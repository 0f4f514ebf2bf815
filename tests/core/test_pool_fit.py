"""The fit: the level from lit and dark rays, tilted planes, and bad dots."""

from __future__ import annotations

import tracemalloc
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import settings as examples
from hypothesis import strategies as st

from labapp.core.geometry.optics import (
    intersect_imaging_plane,
    project_rays,
    reflect,
    surface_normal,
)
from labapp.core.geometry.rig import ImagingPlane
from labapp.core.match import Match
from labapp.core.schemes import fit
from labapp.core.surface.level import KnownRays, Level, LevelSearch, Rear
from labapp.core.surface.measures import WITH_SIGMA
from labapp.core.surface.pool_fit import (
    REUSE_FLOORS,
    FitSettings,
    FittedPool,
    basis_around,
    fit_pool,
    misfits,
    normal_equations,
)
from labapp.core.surface.solver import Rounds
from labapp.core.surface.spline import SplineBasis, SplineSurface
from labapp.core.values import CannotMeasure, FloatArray, IntArray
from labapp.simulation.forward import exact_match, trace
from labapp.simulation.pools import Footprint, LowRear, Pool, egg, spherical_cap
from tests.benchmarks.clutter import draw_pool
from tests.levels import find_level
from tests.scenes import OPEN_RIG

RADIUS = 3.0
POOL = egg(6.6, 3.0, 3.9, 0.33)
STATUSES = {"no-surface", "open-boundary", "too-few-dots"}


def dome(sign: int = 1) -> SplineSurface:
    """Return a paraboloid with height 0 at `RADIUS`, raised by 0.5: the level must undo this."""
    basis = SplineBasis.over(np.array([-5.0, -5.0]), np.array([5.0, 5.0]), 1.0)
    x, y = (a.ravel() for a in np.meshgrid(*[np.linspace(-5, 5, 40)] * 2))
    z = sign * 0.05 * (RADIUS**2 - x**2 - y**2) + 0.5
    return SplineSurface(basis, np.linalg.lstsq(basis.matrix(x, y), z, rcond=None)[0])


def rays_landing(spacing: float, seed: int = 0) -> tuple[FloatArray, IntArray]:
    """Return landing points of a randomly shifted grid, and +1 for those inside the circle."""
    axis = np.arange(-4.5, 4.5, spacing)
    shift = np.random.default_rng(seed).uniform(-0.5, 0.5, 2) * spacing
    landing = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2) + shift
    return landing, np.where(np.linalg.norm(landing, axis=-1) < RADIUS, 1, -1)


def level_of(landing: FloatArray, ray_states: IntArray, spacing: float, sign: int = 1) -> Level:
    height, slope = dome(sign).height_and_gradient(*landing.T)
    seen = np.stack([height, 0 * height]), slope, landing[:, 1], ray_states
    return find_level(*seen, np.array([spacing, spacing]))


def fitted(match: Match, **changes: object) -> FittedPool:
    return fit_pool(replace(match, **changes), OPEN_RIG, FitSettings())


@pytest.fixture(scope="module")
def match() -> Match:
    return exact_match(trace(POOL, OPEN_RIG))


@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize("seed", range(4))
def test_contour_is_between_lit_and_dark_rays(sign: int, seed: int) -> None:
    landing, ray_states = rays_landing(0.45, seed)
    level = level_of(landing, ray_states, 0.45, sign)
    assert level.pool_sign == sign
    height = sign * (dome(sign).height(*landing.T) + level.shift_mm)
    assert height[ray_states > 0].min() > height[ray_states < 0].max()
    assert height[ray_states > 0].min() > -level.sigma_mm
    assert height[ray_states < 0].max() < level.sigma_mm
    assert abs(level.shift_mm + 0.5) < 4 * level.sigma_mm
    assert level.disagreement_bits < 0.15


def test_more_known_rays_reduce_the_level_uncertainty() -> None:
    sigmas, errors = [], []
    for spacing in (1.0, 0.5, 0.25):
        levels = [level_of(*rays_landing(spacing, seed), spacing) for seed in range(8)]
        sigmas.append(np.mean([level.sigma_mm for level in levels]))
        errors.append(np.sqrt(np.mean([(level.shift_mm + 0.5) ** 2 for level in levels])))
    assert sigmas[0] > 1.8 * sigmas[1] > 1.8**2 * sigmas[2]
    assert errors[0] > errors[2]
    # The stated uncertainty of the level is neither too small nor too large.
    assert 0.3 < np.sqrt(np.mean(np.square(np.divide(errors, sigmas)))) < 2.0


@pytest.mark.parametrize("lies", ["dark inside", "lit outside"])
def test_single_false_state_hardly_moves_the_level(lies: str) -> None:
    landing, ray_states = rays_landing(0.45)
    original = level_of(landing, ray_states, 0.45)
    radius = np.linalg.norm(landing, axis=-1)
    flipped = np.argmin(np.abs(radius - (RADIUS - 0.9 if lies == "dark inside" else RADIUS + 0.9)))
    ray_states = ray_states.copy()
    ray_states[flipped] *= -1
    level = level_of(landing, ray_states, 0.45)
    assert level.pool_sign == 1
    # A ray's spacing is 0.3 × 0.45 mm of height at the contour.
    assert abs(level.shift_mm - original.shift_mm) < 0.15 * 0.3 * 0.45
    assert level.sigma_mm > original.sigma_mm
    assert level.disagreement_bits > original.disagreement_bits


def test_boundary_contradicting_the_surface_is_less_certain() -> None:
    # A concave pool is used, as a convex one that seems too long may have a low rear.
    landing, ray_states = rays_landing(0.45)
    original = level_of(landing, ray_states, 0.45, -1)
    squeezed = np.where(np.linalg.norm(landing * [1.15, 0.87], axis=-1) < RADIUS, 1, -1)
    level = level_of(landing, squeezed, 0.45, -1)
    assert level.sigma_mm > 2 * original.sigma_mm
    assert abs(level.shift_mm + 0.5) < 3 * level.sigma_mm


def test_fitted_surface_reflects_the_rays_to_the_residuals(match: Match) -> None:
    pool = fitted(match)
    offset = pool.points_mm - OPEN_RIG.laser.position_mm
    rays = offset / np.linalg.norm(offset, axis=-1, keepdims=True)
    i, j = match.ray.T - 1
    np.testing.assert_allclose(rays, trace(POOL, OPEN_RIG).incident[i, j], atol=1e-12)
    x, y, z = pool.points_mm.T
    np.testing.assert_allclose(z, pool.surface.height(x, y), atol=1e-6)
    normal = surface_normal(pool.surface.gradient(x, y))
    dots = intersect_imaging_plane(pool.points_mm, reflect(rays, normal), OPEN_RIG.imaging_plane)
    np.testing.assert_allclose(pool.residual_mm, dots - match.plane_mm, atol=1e-6)


def test_nearby_start_converges_in_fewer_rounds(match: Match) -> None:
    pool, other = fitted(match), fitted(match, plane_mm=match.plane_mm + 0.3)
    settings = replace(FitSettings(), rounds=2)
    from_it, from_flat = (
        fit_pool(match, OPEN_RIG, settings, near) for near in (other.surface, None)
    )
    error = [np.abs(one.points_mm - pool.points_mm).max() for one in (from_it, from_flat)]
    assert error[0] < 0.002
    assert error[0] < error[1] / 10


def test_surface_is_independent_of_the_order_of_dots(match: Match) -> None:
    order = np.random.default_rng(0).permutation(len(match.ray))
    one = fitted(match)
    other = fitted(
        match,
        ray=match.ray[order],
        plane_mm=match.plane_mm[order],
        plane_covariance_mm2=match.plane_covariance_mm2[order],
    )
    np.testing.assert_allclose(other.points_mm, one.points_mm[order], atol=1e-7)


def test_less_certain_dot_has_less_influence(match: Match) -> None:
    plane = match.plane_mm.copy()
    plane[40] += [0.8, -0.8]
    covariance = match.plane_covariance_mm2.copy()
    trusted = fitted(match, plane_mm=plane)
    covariance[40] *= 1e6
    doubted = fitted(match, plane_mm=plane, plane_covariance_mm2=covariance)
    true = fitted(match)

    def max_error(pool: FittedPool) -> float:
        return float(np.abs(pool.points_mm[:, 2] - true.points_mm[:, 2]).max())

    assert max_error(doubted) < 0.1 * max_error(trusted)


def tilted_plane(roll_deg: float, lean_deg: float) -> ImagingPlane:
    """Return a plane tilted back about X′ and rolled, large enough for every dot."""
    roll, lean = np.radians([roll_deg, lean_deg])
    x = np.array([1.0, 0.0, 0.0])
    z = np.array([0.0, -np.sin(lean), np.cos(lean)])
    x_axis, z_axis = np.cos(roll) * x + np.sin(roll) * z, np.cos(roll) * z - np.sin(roll) * x
    middle = np.array([0.0, -55.0, 25.0])
    return ImagingPlane(middle - 500 * x_axis - 500 * z_axis, x_axis, z_axis, 1000.0, 1000.0)


@pytest.mark.parametrize(("roll_deg", "lean_deg"), [(0, 25), (12, -10), (180, 0), (90, 15)])
def test_surface_is_independent_of_the_plane_pose(
    match: Match, roll_deg: float, lean_deg: float
) -> None:
    rig = replace(OPEN_RIG, imaging_plane=tilted_plane(roll_deg, lean_deg))
    tilted = exact_match(trace(POOL, rig))
    np.testing.assert_array_equal(tilted.ray, match.ray)
    upright = fit.reconstruct(match, OPEN_RIG, FitSettings())
    from_tilted = fit.reconstruct(tilted, rig, FitSettings())
    # Weights differ with the pose, but have no influence with exact dots.
    np.testing.assert_allclose(from_tilted.points_mm, upright.points_mm, atol=1e-3)
    np.testing.assert_allclose(
        from_tilted.boundary.points_mm, upright.boundary.points_mm, atol=0.005
    )


def rejected_status(match: Match) -> str:
    """Return the status with which the fit rejects a match."""
    with pytest.raises(CannotMeasure) as error:
        fit.reconstruct(match, OPEN_RIG, FitSettings())
    assert error.value.reason
    return error.value.status


def part(match: Match, selected: FloatArray | IntArray) -> Match:
    """Return the match with only some of its dots."""
    return replace(
        match,
        dot=match.dot[selected],
        ray=match.ray[selected],
        reflected=match.reflected[selected],
        plane_mm=match.plane_mm[selected],
        plane_covariance_mm2=match.plane_covariance_mm2[selected],
    )


def test_boundary_is_open_without_dark_rays(match: Match) -> None:
    assert (
        rejected_status(replace(match, ray_states=np.maximum(match.ray_states, 0)))
        == "open-boundary"
    )


def test_boundary_is_open_with_two_dark_rays(match: Match) -> None:
    dark = np.flatnonzero(match.ray_states.ravel() < 0)
    ray_states = match.ray_states.copy()
    ray_states.flat[dark[2:]] = 0
    assert rejected_status(replace(match, ray_states=ray_states)) == "open-boundary"


def test_boundary_is_open_where_the_rear_is_not_visible(match: Match) -> None:
    ray_states = match.ray_states.copy()
    ray_states[:9] = 0
    head = part(match, np.flatnonzero(match.ray[:, 0] > 9))
    assert rejected_status(replace(head, ray_states=ray_states)) == "open-boundary"


@pytest.mark.parametrize("count", [0, 1, 5])
def test_too_few_dots_are_rejected(match: Match, count: int) -> None:
    assert rejected_status(part(match, np.arange(count))) == "too-few-dots"


def test_corner_of_the_pool_is_rejected(match: Match) -> None:
    corner = part(match, np.flatnonzero((match.ray[:, 1] > 10) & (match.ray[:, 0] > 8)))
    assert len(corner.ray) > fit.LEAST_DOTS
    assert rejected_status(corner) == "open-boundary"


@examples(max_examples=16)
@given(st.integers(0, 10_000), st.sampled_from([1.0, 8.0, 40.0, 400.0]))
def test_garbage_gives_a_surface_or_a_reason(seed: int, noise_mm: float) -> None:
    rng = np.random.default_rng(seed)
    pool: Pool = spherical_cap(6.0, float(rng.choice([0.4, -0.5])))
    good = exact_match(trace(pool, OPEN_RIG))
    garbage = replace(
        good,
        plane_mm=good.plane_mm + rng.normal(0.0, noise_mm, good.plane_mm.shape),
        ray_states=np.where(
            rng.random(good.ray_states.shape) < 0.1, -good.ray_states, good.ray_states
        ),
    )
    try:
        reconstruction = fit.reconstruct(garbage, OPEN_RIG, FitSettings())
    except CannotMeasure as error:
        assert error.status in STATUSES  # noqa: PT017 - or a surface
        assert error.reason  # noqa: PT017 - or a surface
    else:
        assert np.isfinite(reconstruction.points_mm).all()
        assert np.isfinite(reconstruction.boundary.points_mm).all()
        assert (reconstruction.sigma_mm > 0).all()
        assert noise_mm < 40.0


@pytest.mark.parametrize("seed", range(3))
def test_dots_with_wrong_rays_are_rejected(match: Match, seed: int) -> None:
    shuffled = np.random.default_rng(seed).permutation(len(match.ray))
    assert rejected_status(replace(match, plane_mm=match.plane_mm[shuffled])) in STATUSES


@pytest.mark.parametrize("off_mm", [0.02, -0.08, 0.3])
def test_level_is_found_wherever_the_search_begins(off_mm: float) -> None:
    landing, ray_states = rays_landing(0.45)
    height, slope = dome().height_and_gradient(*landing.T)
    seen = np.stack([height, 0 * height]), slope, landing[:, 1], ray_states
    known = find_level(*seen, np.array([0.45, 0.45]))
    about = known.shift_mm + off_mm, known.pool_sign, 0.3
    found = find_level(*seen, np.array([0.45, 0.45]), about=about)
    assert found.shift_mm == pytest.approx(known.shift_mm, abs=0.2 * known.sigma_mm)
    assert found.sigma_mm == pytest.approx(known.sigma_mm, rel=0.2)


def test_single_row_of_lit_rays_has_a_level() -> None:
    height, slope = np.array([0.1, 0.2, 0.1, -0.1, -0.1]), np.full((5, 2), 0.1)
    y, ray_states = np.array([1.0, 1.0, 1.0, 2.0, 0.0]), np.array([1, 1, 1, -1, -1])
    exact = np.stack([height, 0 * height])
    level = find_level(exact, slope, y, ray_states, np.array([0.4, 0.8]))
    assert np.isfinite([level.shift_mm, level.sigma_mm]).all()
    assert level.rear.drop_mm == 0.0


def test_rear_sinks_although_no_dark_ray_is_seen_there() -> None:
    """The lit rays at the rear land outside the boundary that the head determines."""
    for drop_mm in 0.0, 0.1:
        pool = egg(6.6, 3.0, 3.9, 0.33, terms=(LowRear(drop_mm),))
        match = exact_match(trace(pool, OPEN_RIG))
        ray_states = match.ray_states.copy()
        ray_states[(ray_states < 0) & (np.arange(1, 20)[:, None] < match.ray[:, 0].min() + 2)] = 0
        match = replace(match, ray_states=ray_states)
        fitted = fit.fit_surface(match, OPEN_RIG, FitSettings())
        made, found = fit.bound_and_measure(match, fitted, OPEN_RIG)
        assert (fitted.level.rear.drop_mm > 0.03) == (drop_mm > 0)
        assert abs(found.length_mm - pool.size.length_mm) < 2.5 * found.length_sigma_mm
        given = replace(fitted.level, drop_sigma_mm=0.0, drop_covariance_mm2=0.0)
        certain, _ = fit.bound_and_measure(match, replace(fitted, level=given), OPEN_RIG)
        less = certain.size_sigma_level < made.size_sigma_level
        assert less[WITH_SIGMA.index("length_mm")]
        assert not less[WITH_SIGMA.index("height_mm")]


@pytest.mark.parametrize("side", [1, -1])
def test_rays_pass_a_low_boundary_farther_from_the_laser(side: int) -> None:
    """If the boundary lies towards the laser, those that land outside meet the work piece."""
    rays, laser = project_rays(OPEN_RIG.laser, OPEN_RIG.pattern), OPEN_RIG.laser.position_mm
    landing = rays.landing_mm[9] * [1, side, 1]
    level = Level(0.0, 0.0, 1, Rear(0.05, 8.0 * side, -3.0 * side), 0.0)
    slope = np.tile([0.05, 0.25 * side], (len(landing), 1))
    passed = landing
    for _ in range(20):
        depth = -level.rear.height(passed[:, 1])[:, None]
        passed = landing + depth / laser[2] * (landing - laser) * (side > 0)
    over = passed[:, :2] @ slope[0] - level.rear.height(passed[:, 1])
    found = level.height_inside(landing[:, :2] @ slope[0], slope, landing, laser)
    np.testing.assert_allclose(found, over, atol=5e-4)


@pytest.mark.parametrize("travel", ["+y", "-y"])
def test_lengths_of_pools_with_a_low_rear_are_within_twice_their_uncertainty(travel: str) -> None:
    deviations = []
    for seed in range(20):
        rig, pool = draw_pool("lowrear", np.random.default_rng(seed))
        if travel == "-y":
            footprint, (low,) = pool.footprint, pool.terms
            x, y = footprint.center_mm
            back = Footprint(footprint.width_mm, footprint.tail_mm, footprint.head_mm, (x, -y))
            low = replace(low, towards=1)
            pool, rig = replace(pool, footprint=back, terms=(low,)), replace(rig, travel="-y")
        match = exact_match(trace(pool, rig))
        fitted = fit.fit_surface(match, rig, FitSettings())
        size = fit.bound_and_measure(match, fitted, rig)[1]
        deviations.append((size.length_mm - pool.size.length_mm) / size.length_sigma_mm)
    assert np.sqrt(np.mean(np.square(deviations))) < 2.2


def rounds_of(match: Match) -> Rounds:
    """Return rounds of a fit to a match that begin at z = 0."""
    rays, at = project_rays(OPEN_RIG.laser, OPEN_RIG.pattern), tuple(match.ray.T - 1)
    points, settings = rays.landing_mm[at], FitSettings()
    basis = basis_around(points[:, :2], rays, settings.knot_mm)
    seen = match.plane_mm, match.plane_covariance_mm2
    equations = normal_equations(basis, OPEN_RIG, points, *seen, settings)
    equations.reuse_mm = REUSE_FLOORS * settings.floor_mm
    return Rounds(equations, rays.directions[at], np.zeros(basis.count), points, np.inf)


def known_rays_of(match: Match, rounds: Rounds) -> KnownRays:
    return KnownRays.of(OPEN_RIG, match.ray_states, rounds.equations.basis, match.missing)


def test_fit_consists_of_rounds_with_their_level(match: Match) -> None:
    rounds, settings = rounds_of(match), FitSettings()
    search = LevelSearch(known_rays_of(match, rounds))
    level = rounds.run(settings.rounds, settings.settled_mm, search=search)
    pool = fitted(match)
    np.testing.assert_allclose(pool.surface.coefficients, rounds.coefficients, atol=1e-9)
    np.testing.assert_allclose(pool.factor, rounds.equations.factor, rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(pool.points_mm, rounds.points_mm, atol=1e-8)
    assert pool.level.shift_mm == pytest.approx(level.shift_mm, abs=1e-9)
    assert pool.level.sigma_mm == pytest.approx(level.sigma_mm, rel=1e-6)


def test_held_drop_keeps_its_uncertainty(match: Match) -> None:
    certain = replace(
        fitted(match).level, sigma_mm=0.05, drop_sigma_mm=0.0, drop_covariance_mm2=0.0
    )
    uncertain = replace(certain, drop_sigma_mm=0.03, drop_covariance_mm2=-3e-4)

    def found(held: Level, is_free: bool) -> Level:
        rounds = rounds_of(match)
        search = LevelSearch(known_rays_of(match, rounds), held, is_free)
        return rounds.run(3, 0.0, search=search)

    kept, of_rays = found(uncertain, False), found(certain, False).sigma_mm
    assert (kept.drop_sigma_mm, kept.drop_covariance_mm2) == (0.03, -3e-4)
    assert kept.sigma_mm == pytest.approx(np.hypot(of_rays, 3e-4 / 0.03), rel=0.01)
    assert of_rays < 0.02  # these rays show the level better than those of the frame before
    assert found(uncertain, True).drop_sigma_mm < 0.02


def test_uncertainty_of_shift_and_drop_agrees_with_samples() -> None:
    level = Level(0.0, 0.02, 1, Rear(), 0.0, drop_sigma_mm=0.03, drop_covariance_mm2=-3e-4)
    covariance = [[0.02**2, -3e-4], [-3e-4, 0.03**2]]
    samples = np.random.default_rng(4).multivariate_normal([0.0, 0.0], covariance, 100_000)
    by_shift, by_drop = np.array([1.0, 2.0, 0.0]), np.array([0.0, 1.0, -3.0])
    expected = np.std(samples @ [by_shift, by_drop], axis=0)
    np.testing.assert_allclose(level.sigma_of(by_shift, by_drop), expected, rtol=0.02)


def test_laser_ten_times_too_far_away_is_rejected() -> None:
    """The splines would take gigabytes."""
    match = exact_match(trace(POOL, OPEN_RIG))
    far = replace(OPEN_RIG.laser, distance_mm=10 * OPEN_RIG.laser.distance_mm)
    with pytest.raises(CannotMeasure) as caught:
        fit_pool(match, replace(OPEN_RIG, laser=far), FitSettings())
    assert caught.value.status == "no-surface"
    assert " mm" in caught.value.reason


def test_uncertain_heights_count_less_for_the_level() -> None:
    """Some rays land where the surface is off by a quarter of the rise, with a known σ."""
    exact, weighed = [], []
    for seed in range(40):
        rng = np.random.default_rng(seed)
        landing, ray_states = rays_landing(0.5, seed)
        height, slope = dome().height_and_gradient(*landing.T)
        sigma = np.where(landing[:, 0] > 1.5, 0.04, 1e-4)
        height += sigma * rng.normal(size=len(height))
        seen = slope, landing[:, 1], ray_states, np.array([0.5, 0.5])
        for levels, known in (exact, 0 * sigma), (weighed, sigma):
            level = find_level(np.stack([height, known]), *seen, rear=(1, 0.0))
            levels.append([level.shift_mm + 0.5, level.sigma_mm])
    (off, _), (off_weighed, stated_weighed) = np.transpose(exact), np.transpose(weighed)
    assert np.sqrt(np.mean(off_weighed**2)) < 0.7 * np.sqrt(np.mean(off**2))
    assert np.sqrt(np.mean((off_weighed / stated_weighed) ** 2)) < 1.2


def test_rays_that_land_kilometres_apart_take_no_memory(match: Match) -> None:
    """Labels that hardly fit with a likelier set-up took 15 GB for the knots of their splines."""
    far = replace(OPEN_RIG, laser=replace(OPEN_RIG.laser, distance_mm=3e8))
    labels = np.full((1, OPEN_RIG.pattern.rows, OPEN_RIG.pattern.columns), -1)
    labels[0][tuple(match.ray.T - 1)] = np.arange(len(match.ray))
    dots = match.plane_mm, match.plane_covariance_mm2
    assert misfits(labels, *dots, far, FitSettings(), least=6)[0] == np.inf
    assert misfits(labels, *dots, OPEN_RIG, FitSettings(), least=6)[0] < 0.1
    tracemalloc.start()
    try:
        with pytest.raises(CannotMeasure, match="no-surface"):
            fit_pool(match, far, FitSettings())
        assert tracemalloc.get_traced_memory()[1] < 10_000_000
    finally:
        tracemalloc.stop()
