"""Spectra, peaks, events, step responses, shape and time offset against known truth."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import signal

from labapp.core.dynamics.alignment import find_offset
from labapp.core.dynamics.analysis import RESPONDING
from labapp.core.dynamics.spectra import spectrogram, track_peak
from labapp.core.dynamics.steps import find_events, step_response
from labapp.core.schemes import fit
from labapp.core.surface.pool_fit import FitSettings
from labapp.core.surface.shape import shape_of
from labapp.export.dynamics import dynamics_of
from labapp.simulation.forward import exact_match, trace
from labapp.simulation.pools import Footprint, Pool, Wave
from tests.core.dynamics_truth import boundary_of
from tests.scenes import OPEN_RIG


def test_evenly_spaced_frames_use_welch_with_chi_square_intervals():
    rng, covered = np.random.default_rng(5), []
    for _ in range(40):
        value = rng.normal(0, 1, 2000)
        spectrum = spectrogram(np.arange(2000) / 1000, value, 0.25)
        mean = spectrum.mean()
        covered.append((mean.low <= 2e-3) & (mean.high >= 2e-3))
    _, density = signal.welch(value, 1000, "hann", 250, 125, detrend="linear")
    assert spectrum.method == "Welch"
    np.testing.assert_allclose(mean.density, density[1:])
    assert 0.92 < np.mean(np.array(covered)[:, 3:-3]) < 0.98


def test_spectrum_with_missing_frames_has_the_same_density():
    rng = np.random.default_rng(6)
    time = np.arange(4000) / 1000
    value = rng.normal(0, 1, 4000) + np.cos(2 * np.pi * 100 * time)
    present = rng.random(4000) > 0.1
    spectrum = spectrogram(time[present], value[present], 0.25)
    mean = spectrum.mean()
    assert spectrum.method == "Lomb-Scargle"
    assert mean.frequency_hz[np.argmax(mean.density)] == pytest.approx(100, abs=4)
    beside = mean.frequency_hz > 150
    assert mean.density[beside].mean() == pytest.approx(2e-3, rel=0.1)


def test_peak_of_a_chirp_is_tracked():
    rng = np.random.default_rng(8)
    time = np.arange(4000) / 1000
    present = rng.random(4000) > 0.05
    value = np.cos(2 * np.pi * (60 * time + 5 * time**2)) + rng.normal(0, 0.3, 4000)
    peak = track_peak(time[present], value[present], 0.25)
    truth = 60 + 10 * peak.time_s  # the phase's derivative
    error = peak.frequency_hz - truth
    assert np.abs(error).max() < 0.5
    assert np.sqrt(np.mean((error / peak.frequency_sigma_hz) ** 2)) < 1.5


def test_amplitude_of_a_peak_is_that_at_the_middle_of_a_segment_without_its_first_frames():
    time = np.arange(384) / 200
    value = np.exp(-2 * time) * np.cos(2 * np.pi * 25 * time)
    every = track_peak(time, value, 0.64)
    np.testing.assert_allclose(every.amplitude, np.exp(-2 * every.time_s), rtol=1e-3)
    present = (time < 0.64) | (time > 0.90)
    peak = track_peak(time[present], value[present], 0.64)
    np.testing.assert_allclose(peak.time_s, every.time_s)
    np.testing.assert_allclose(peak.amplitude, every.amplitude, rtol=1e-3)


def test_time_of_a_segment_is_the_middle_of_its_frames_with_and_without_gaps():
    time = np.arange(640) / 100
    value = np.random.default_rng(7).normal(size=640)
    present = np.arange(640) != 100
    even = spectrogram(time, value, 0.64)
    gappy = spectrogram(time[present], value[present], 0.64)
    assert (even.method, gappy.method) == ("Welch", "Lomb-Scargle")
    assert even.time_s[0] == pytest.approx(time[:64].mean())
    np.testing.assert_allclose(even.time_s, gappy.time_s)
    np.testing.assert_allclose(even.time_s, track_peak(time, value, 0.64).time_s)


def test_too_short_segment_is_rejected():
    with pytest.raises(ValueError, match="fewer"):
        spectrogram(np.arange(100) / 100, np.zeros(100), 0.05)


def second_order(time, zeta, omega):
    """Return the step response from its two complex poles."""
    poles = omega * (-zeta + 1j * np.sqrt(1 - zeta**2) * np.array([1, -1]))
    late = np.maximum(time, 0)[:, None]
    parts = np.exp(poles * late) * poles[::-1] / (poles - poles[::-1])
    return 1 + parts.sum(axis=1).real


@pytest.mark.slow
@pytest.mark.parametrize("order", [1, 2])
def test_step_response_agrees_with_truth(order):
    rng, time = np.random.default_rng(order), np.arange(1000) / 200
    late = time - 1.6  # the step at 1.5 s, 0.1 s of delay
    fine = np.linspace(0, 5, 100_001)
    if order == 1:
        clean = -np.expm1(-np.maximum(late, 0) / 0.4)
        tau, overshoot, fine_response = 0.4, 0.0, -np.expm1(-fine / 0.4)
    else:
        clean, fine_response = second_order(late, 0.4, 8.0), second_order(fine, 0.4, 8.0)
        tau, overshoot = 1 / (0.4 * 8), fine_response.max() - 1
    rise = fine[np.argmax(fine_response > 0.9)] - fine[np.argmax(fine_response > 0.1)]
    truth = {"change": 0.5, "delay_s": 0.1, "time_constant_s": tau}
    truth |= {"rise_time_s": rise, "overshoot": overshoot}
    scores = []
    for _ in range(20):
        response = step_response(time, 5 + 0.5 * clean + rng.normal(0, 0.02, 1000), 1.5)
        assert response.order == order
        assert response.before == pytest.approx(5, abs=0.01)
        for name, value in truth.items():
            error = response.value[name] - value
            scores.append(error / response.sigma[name] if response.sigma[name] else 0)
            assert abs(error) < 5 * response.sigma[name] + 1e-12
    assert 0.88 < np.mean(np.abs(scores) < 1.96) <= 1


@pytest.mark.slow
def test_noise_has_no_step_response():
    rng, time = np.random.default_rng(9), np.arange(1000) / 200
    responses = [step_response(time, rng.normal(5, 0.02, 1000), 1.5) for _ in range(10)]
    assert sum(one is not None for one in responses) <= 1


def test_step_in_an_oscillating_series_is_an_event():
    rng, time = np.random.default_rng(10), np.arange(1000) / 200
    errors = []
    for _ in range(20):
        still = rng.normal(0, 0.02, 1000) + 0.05 * np.cos(2 * np.pi * 31 * time)
        assert not find_events(time, still, 1 / 31)
        (one, *more) = find_events(time, still + 0.08 * (time > 2.33), 1 / 31)
        assert len(more) <= 1
        errors.append((one.time_s - 2.33) / one.sigma_s)
    assert np.mean(np.abs(errors) < 1.96) >= 0.8


@pytest.mark.slow
@pytest.mark.parametrize("memory", [0.0, 0.5, 0.8])
def test_noise_has_less_than_one_event_in_1000_frames(memory):
    # Noise correlated between frames, as with a boundary that stands still.
    rng, time = np.random.default_rng(20), np.arange(1000) / 200
    still = signal.lfilter([0.01], [1, -memory], rng.normal(size=(60, 1000)))
    assert sum(len(find_events(time, one)) for one in still) < 60 / 4
    step = 4 * still.std() * (time > 2.33)
    assert np.mean([len(find_events(time, one + step)) >= 1 for one in still]) > 0.9


@pytest.mark.slow
def test_still_pool_has_no_events():
    # Noisy dots, some lost in each frame; the boundary stands still, the surface may oscillate.
    rng = np.random.default_rng(21)
    for waves in ((), (Wave((0, 1), 0.02, 31.0, damping_per_s=1.0),)):
        pool = Pool(Footprint(6.66, 3.0, 4.4, (0.0, -0.6)), 0.29, waves)
        dynamics = dynamics_of(fitted_frames(pool, 100, 200, rng))
        assert dynamics.events == dict.fromkeys(RESPONDING, ())


def fitted_frames(pool, count, rate_hz, rng):
    """Yield the fitted frames of a simulated pool; dots are noisy, and 1 in 100 is lost."""
    near = None
    still = None if pool.terms else trace(pool, OPEN_RIG)
    for k in range(count):
        traced = still or trace(pool.after(k / rate_hz), OPEN_RIG)
        match = exact_match(traced, None, 0.03, rng)
        present, ray_states = rng.random(len(match.ray)) > 0.01, match.ray_states.copy()
        ray_states[tuple(match.ray[~present].T - 1)] = 0
        per_dot = ("ray", "dot", "reflected", "plane_mm", "plane_covariance_mm2")
        remaining = {name: getattr(match, name)[present] for name in per_dot}
        match = replace(match, ray_states=ray_states, **remaining)
        fitted = fit.fit_surface(match, OPEN_RIG, FitSettings(), near)
        reconstruction, sizes = fit.bound_and_measure(match, fitted, OPEN_RIG)
        near = fitted.surface
        yield k, k / rate_hz, reconstruction.unbounded, reconstruction.boundary, vars(sizes)


def test_change_within_the_level_ambiguity_is_no_event():
    rng, time = np.random.default_rng(22), np.arange(400) / 200
    series = rng.normal(0, 0.002, 400) + 0.02 * (time > 1)
    assert len(find_events(time, series)) == 1
    assert len(find_events(time, series, least=0.015)) == 1
    assert not find_events(time, series, least=0.04)


def test_start_of_a_ramp_is_an_event():
    rng, time = np.random.default_rng(12), np.arange(2000) / 200
    (one,) = find_events(time, rng.normal(0, 0.01, 2000) + 0.1 * np.maximum(time - 4, 0))
    assert abs(one.time_s - 4) < 3 * one.sigma_s + 0.1
    assert one.slope_change_per_s == pytest.approx(0.1, rel=0.1)


def test_shape_of_a_paraboloid():
    pool = Pool(Footprint(6.0, 3.5, 3.5), 0.3, fullness=0.0)
    convexity_mm, asymmetry, wetting_slope_deg = shape_of(pool, boundary_of(pool))
    assert convexity_mm == pytest.approx(0.2, rel=1e-3)  # ∫(1 − q²) over the length
    assert asymmetry == pytest.approx(0, abs=1e-6)
    # |∇z| = 2·0.3/a on both axes, and between these values elsewhere.
    assert np.degrees(np.arctan(0.6 / 3.5)) < wetting_slope_deg
    assert wetting_slope_deg < np.degrees(np.arctan(0.6 / 3.0))
    hollow = Pool(Footprint(6.0, 3.5, 3.5), -0.3, fullness=0.0)
    assert shape_of(hollow, boundary_of(hollow))[0] == pytest.approx(-0.2, rel=1e-3)


def test_asymmetry_of_a_pool_that_leans_right():
    pool = Pool(Footprint(6.0, 3.0, 3.0), 0.3, (Wave((1, 1), 0.03),), fullness=0.0)
    x, y = np.meshgrid(np.linspace(-3, 3, 1201), np.linspace(-3, 3, 1201))
    height = np.abs(np.nan_to_num(pool.height(x, y)))
    truth = (height[x > 0].sum() - height[x < 0].sum()) / height.sum()
    asymmetry = shape_of(pool, boundary_of(pool))[1]
    assert truth > 0.05
    assert asymmetry == pytest.approx(truth, abs=0.002)


def test_logger_offset_is_found_from_the_light():
    rng, scores = np.random.default_rng(13), []
    for _ in range(20):
        true_s = rng.uniform(-2, 3)
        logged_s = np.arange(0, 12, 1 / 2000)
        swing = (logged_s * 1.3 + 0.15 * np.sin(logged_s * 2.1)) % 1 < 0.4
        current = 80 + 40 * swing + 20 * (logged_s > 5)
        frame_s = np.flatnonzero(rng.random(1000) > 0.05) / 200
        exposure = frame_s[:, None] - true_s + np.arange(20) / 20 / 200
        light = 10 + 0.5 * np.interp(exposure, logged_s, current).mean(axis=1)
        offset = find_offset(logged_s, current, frame_s, light + rng.normal(0, 4, len(light)))
        assert abs(offset.start_s - true_s) < 0.0025
        scores.append((offset.start_s - true_s) / offset.sigma_s)
    assert np.mean(np.abs(scores) < 1.96) >= 0.9


def test_logger_times_in_milliseconds_are_rejected():
    logged_s, frame_s = np.arange(0, 600_000, 100.0), np.arange(600) / 1000
    with pytest.raises(ValueError, match="frames/s"):
        find_offset(logged_s, np.sin(logged_s), frame_s, np.sin(frame_s))


def test_offset_is_ambiguous_for_regular_pulses_and_none_for_noise():
    logged_s, frame_s = np.arange(0, 12, 1 / 2000), np.arange(600) / 200
    pulses = np.where(logged_s % 0.5 < 0.2, 120.0, 60.0)
    light = np.interp(frame_s + 2, logged_s, pulses)
    assert find_offset(logged_s, pulses, frame_s, light).rival_s is not None
    noise = np.random.default_rng(14).normal(size=600)
    assert find_offset(logged_s, pulses, frame_s, noise) is None
