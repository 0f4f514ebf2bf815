from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.special import jn_zeros, jv

from labapp.simulation.pools import (
    Dent,
    Footprint,
    LowRear,
    Pool,
    Wave,
    caps_8_3_1,
    egg,
    ellipsoidal_cap,
    spherical_cap,
)
from tests.oscillation import Oscillation

MODES = ((0, 1), (1, 1), (2, 1), (0, 2))

lengths = st.floats(2.0, 6.0)
waves = st.builds(
    lambda mode, amplitude, time, travelling, turned: Wave(
        mode, amplitude, 30.0, time, travelling and mode[0] > 0, turned, 20.0
    ),
    st.sampled_from(MODES),
    st.floats(0, 0.1),
    st.floats(0, 1),
    st.booleans(),
    st.floats(0, 90),
)
terms = st.lists(
    st.one_of(
        st.builds(Dent, st.floats(0, 0.2), st.floats(0.5, 2), st.just((0.3, 0.4))),
        st.builds(LowRear, st.floats(0, 0.2)),
        st.builds(Oscillation, st.floats(0, 0.1), st.just(30.0), st.floats(0, 1)),
        waves,
    ),
    max_size=3,
).map(tuple)
pools = st.builds(
    lambda width, head, tail, height, extra: egg(2 * width, head, tail, height, (0.2, -0.3), extra),
    lengths,
    lengths,
    lengths,
    st.floats(-0.8, 0.8),
    terms,
)


@settings(max_examples=60, deadline=None)
@given(pools, st.integers(0, 2**32 - 1))
def test_gradient_is_the_derivative_up_to_the_boundary(pool, seed):
    rng = np.random.default_rng(seed)
    rim = pool.boundary_mm(60)[:, :2]
    center = np.array(pool.footprint.center_mm)
    x, y = (center + np.sqrt(rng.uniform(0, 0.999, 60))[:, None] * (rim - center)).T
    step = 1e-5
    numeric = np.stack(
        [
            pool.height(x + step, y) - pool.height(x - step, y),
            pool.height(x, y + step) - pool.height(x, y - step),
        ],
        axis=-1,
    ) / (2 * step)
    known = np.isfinite(numeric)
    assert known.sum() > 60
    np.testing.assert_allclose(pool.gradient(x, y)[known], numeric[known], atol=2e-7)


@settings(max_examples=40, deadline=None)
@given(pools)
def test_gradient_is_continuous_up_to_the_boundary(pool):
    rim = pool.boundary_mm(90)[:, :2]
    center = np.array(pool.footprint.center_mm)
    at_boundary, near = (
        pool.gradient(*(center + f * (rim - center)).T) for f in (1 - 1e-11, 1 - 1e-6)
    )
    np.testing.assert_allclose(at_boundary, near, atol=2e-5)


@settings(max_examples=40, deadline=None)
@given(pools)
def test_boundary_is_on_the_work_piece_except_for_a_low_rear(pool):
    rim = pool.boundary_mm(360)
    drop = sum(term.drop_mm for term in pool.terms if isinstance(term, LowRear))
    ahead = rim[:, 1] >= pool.footprint.center_mm[1]
    np.testing.assert_allclose(rim[ahead, 2], 0, atol=1e-9)
    assert rim[:, 2].min() == pytest.approx(-drop, abs=1e-9)


@settings(max_examples=40, deadline=None)
@given(pools)
def test_size_is_the_extent_of_boundary_and_heights(pool):
    rim = pool.boundary_mm(7200)
    size = pool.size
    assert np.ptp(rim[:, 0]) == pytest.approx(size.width_mm, rel=1e-6)
    assert np.ptp(rim[:, 1]) == pytest.approx(size.length_mm, rel=1e-6)
    x, y = np.meshgrid(np.linspace(-7, 7, 301), np.linspace(-7, 7, 301))
    z = pool.height(x, y)
    assert size.height_mm >= np.nanmax(z) - 1e-12
    assert size.height_mm == pytest.approx(max(np.nanmax(z), rim[:, 2].max()), abs=1e-3)
    assert size.depth_mm == pytest.approx(min(np.nanmin(z), rim[:, 2].min()), abs=1e-3)
    at_peak = pool.height(*(np.array([c]) for c in size.peak_mm))
    assert at_peak == pytest.approx(size.height_mm, abs=1e-12)


@pytest.mark.parametrize("peak", [0.3, -0.3, 1.5])
def test_spherical_cap_is_part_of_a_sphere(peak):
    pool = spherical_cap(6.0, peak, (0.5, -0.25))
    radius = (9 + peak**2) / (2 * abs(peak))
    middle = np.array([0.5, -0.25, peak - np.sign(peak) * radius])
    x, y = np.random.default_rng(1).uniform(-1.6, 1.6, (2, 200))
    points = np.stack([x, y, pool.height(x, y)], axis=-1)
    np.testing.assert_allclose(np.linalg.norm(points - middle, axis=-1), radius, rtol=1e-12)


def test_ellipsoidal_cap_is_part_of_an_ellipsoid():
    pool = ellipsoidal_cap(6.0, 9.0, 0.4)
    x, y = np.random.default_rng(1).uniform(-2, 2, (2, 50))
    # Scaling Y to the width gives the sphere of that width.
    sphere = spherical_cap(6.0, 0.4)
    np.testing.assert_allclose(pool.height(x, 1.5 * y), sphere.height(x, y), rtol=1e-12)


def test_egg_has_head_and_tail_and_a_smooth_outline():
    pool = egg(6.0, 2.5, 4.5, 0.3, (0.0, 1.0))
    on_axis = np.zeros(4)
    y = np.array([1.0 + 2.5, 1.0 - 4.5, 1.0 + 2.5, 1.0 - 4.5])
    y += np.array([-1e-9, 1e-9, 1e-9, -1e-9])
    assert pool.inside(on_axis, y).tolist() == [True, True, False, False]
    # The curvature along Y is continuous where head and tail meet.
    step = 1e-3
    just = 1.0 + np.array([-step, 0.0, step])
    slope = pool.gradient(np.zeros(3), just)[:, 1]
    ahead, behind = (slope[2] - slope[1]) / step, (slope[1] - slope[0]) / step
    assert ahead == pytest.approx(behind, rel=2e-3)


def test_height_outside_the_pool_is_nan():
    pool = egg(6.0, 2.5, 4.5, 0.3)
    far = np.array([0.0, 0.0, 3.1, 100.0]), np.array([2.6, -4.6, 0.0, 100.0])
    assert not pool.inside(*far).any()
    assert np.isnan(pool.height(*far)).all()
    assert np.isnan(pool.gradient(*far)).all()


def test_dent_lowers_the_centre_but_not_the_boundary():
    plain, dented = egg(7, 3, 4, 0.3), egg(7, 3, 4, 0.3, terms=(Dent(0.1, 0.7),))
    zero = np.zeros(1)
    assert dented.height(zero, zero) == pytest.approx(plain.height(zero, zero) - 0.1)
    assert dented.size.height_mm < plain.size.height_mm
    assert np.hypot(*dented.size.peak_mm) > 0.5


def test_oscillation_is_periodic():
    start, half_period, full_period = (
        egg(7, 3, 4, 0.3, terms=(Oscillation(0.03, 40.0, t / 40.0),)) for t in (0.0, 0.5, 1.0)
    )
    x, y = np.random.default_rng(2).uniform(-2, 2, (2, 40))
    still = egg(7, 3, 4, 0.3).height(x, y)
    np.testing.assert_allclose(full_period.height(x, y), start.height(x, y), atol=1e-12)
    np.testing.assert_allclose(
        half_period.height(x, y) - still, still - start.height(x, y), atol=1e-12
    )
    assert np.abs(start.height(x, y) - still).max() > 0.005


def flat(*waves, width=7.0):
    """Return a round pool which is flat except for its waves."""
    return Pool(Footprint(width, width / 2, width / 2, (0.2, -0.3)), 0.0, waves, fullness=0.5)


def polar(radius, angle, width=7.0):
    return 0.2 + radius * width / 2 * np.cos(angle), -0.3 + radius * width / 2 * np.sin(angle)


@pytest.mark.parametrize("mode", MODES)
def test_waves_are_the_modes_of_a_membrane(mode):
    m, n = mode
    radius, angle = np.random.default_rng(3).uniform([[0], [-3]], [[0.999], [3]], (2, 100))
    mode_shape = jv(m, jn_zeros(m, n)[-1] * radius) * np.cos(m * (angle - np.radians(25)))
    height = flat(Wave(mode, 0.02, turned_deg=25.0)).height(*polar(radius, angle))
    ratio = height[np.abs(mode_shape) > 1e-3] / mode_shape[np.abs(mode_shape) > 1e-3]
    np.testing.assert_allclose(ratio, ratio[0], rtol=1e-9)
    size = flat(Wave(mode, 0.02)).size
    assert max(size.height_mm, -size.depth_mm) == pytest.approx(0.02, rel=1e-6)


@pytest.mark.parametrize("mode", MODES)
def test_waves_obey_the_wave_equation(mode):
    """∇²z = (1/c²)·∂²z/∂t², with c constant over the pool and given by the mode's zero."""
    step, hertz = 1e-3, 30.0
    wave = Wave(mode, 0.02, hertz, travelling=mode[0] > 0, phase_deg=40.0)
    x, y = polar(*np.random.default_rng(4).uniform([[0], [-3]], [[0.95], [3]], (2, 60)))

    def height(dx=0.0, dy=0.0, seconds=0.0):
        return flat(wave).after(seconds).height(x + dx, y + dy)

    still = height()
    laplacian = (height(step) + height(-step) + height(0, step) + height(0, -step) - 4 * still) / (
        step**2
    )
    later = 1e-5
    faster = (height(seconds=later) + height(seconds=-later) - 2 * still) / later**2
    speed = 2 * np.pi * hertz * 3.5 / jn_zeros(*mode)[-1]
    np.testing.assert_allclose(laplacian, faster / speed**2, atol=2e-6)


def test_travelling_wave_turns_and_standing_wave_does_not():
    angle = np.linspace(-3, 3, 50)
    quarter = 1 / 4 / 30.0
    for mode in ((1, 1), (2, 1)):
        turning = flat(Wave(mode, 0.02, 30.0, travelling=True))
        turned = polar(0.5, angle + np.pi / 2 / mode[0])
        np.testing.assert_allclose(
            turning.after(quarter).height(*turned),
            turning.height(*polar(0.5, angle)),
            atol=1e-12,
        )
        standing = flat(Wave(mode, 0.02, 30.0))
        assert np.abs(standing.after(quarter).height(*turned)).max() < 1e-15
        assert np.abs(standing.height(*turned)).max() > 0.01


def test_pool_without_oscillation_is_unchanged_later():
    still = egg(7, 3, 4, 0.3, terms=(Dent(0.1, 0.7), LowRear(0.1)))
    assert still.after(0.1) is still
    moved = egg(7, 3, 4, 0.3, terms=(Dent(0.1, 0.7), Oscillation(0.03, 40.0))).after(0.005)
    assert moved.terms == (Dent(0.1, 0.7), Oscillation(0.03, 40.0, 0.005))


@pytest.mark.parametrize(
    ("mode", "travelling", "words"),
    [((-1, 1), False, "m ≥ 0"), ((1, 0), False, "n ≥ 1"), ((0, 2), True, "cannot travel")],
)
def test_impossible_waves_are_rejected(mode, travelling, words):
    with pytest.raises(ValueError, match=words):
        Wave(mode, 0.1, travelling=travelling)


def test_28_caps_of_8_3_1_have_the_stated_sizes():
    caps = caps_8_3_1()
    ratio = [cap.footprint.width_mm / cap.peak_mm for cap in caps]
    assert len(caps) == 28
    assert sorted({round(r) for r in ratio}) == [-20, -10, 10, 20]
    assert sorted({cap.footprint.width_mm for cap in caps}) == [5, 5.5, 6, 6.5, 7, 7.5, 8]


@pytest.mark.parametrize(
    ("width", "head", "peak", "fullness", "words"),
    [
        (0.0, 3.0, 0.3, None, "positive"),
        (6.0, -1.0, 0.3, None, "positive"),
        (6.0, 3.0, -3.0, None, "overhang"),
        (6.0, 3.0, 0.3, 1.0, "fullness"),
    ],
)
def test_impossible_pools_are_rejected(width, head, peak, fullness, words):
    with pytest.raises(ValueError, match=words):
        Pool(Footprint(width, head, 3.0), peak, fullness=fullness)
