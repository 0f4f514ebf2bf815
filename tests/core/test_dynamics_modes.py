import math

import numpy as np
import pytest
from scipy.special import jn_zeros, jnp_zeros, jv

from labapp.core.dynamics.modes import MODES, bessel_modes, pod_modes
from labapp.core.dynamics.oscillation import fit_oscillations
from labapp.simulation.pools import Footprint, Wave
from tests.core.dynamics_truth import pool_with, series_of

ELLIPSE = Footprint(6.6, 3.7, 3.7, (0.0, -0.5))


@pytest.mark.parametrize("mode", MODES)
def test_single_mode_on_an_ellipse_is_recovered_exactly(mode):
    turned = 20.0 if mode[0] else 0.0
    wave = Wave(mode, 0.02, 40.0, phase_deg=30.0, turned_deg=turned, damping_per_s=3.0)
    modes = bessel_modes(series_of(pool_with(ELLIPSE, wave), 200))
    one = modes[MODES.index(mode)]
    assert one.share == pytest.approx(1, abs=1e-6)
    value = {name: figure[0] for name, figure in one.figures.items()}
    assert value["frequency_hz"] == pytest.approx(40, abs=1e-6)
    assert value["damping_per_s"] == pytest.approx(3, abs=1e-5)
    assert value["amplitude_mm"] == pytest.approx(0.02, rel=1e-5)
    assert value["phase_deg"] == pytest.approx(30, abs=1e-3)
    if mode[0]:
        assert value["direction_deg"] == pytest.approx(turned, abs=1e-3)
        assert value["turning"] == pytest.approx(0, abs=1e-5)


def test_travelling_mode_turns():
    wave = Wave((2, 1), 0.02, 40.0, travelling=True)
    figures = bessel_modes(series_of(pool_with(ELLIPSE, wave), 200))[2].figures
    assert figures["turning"][0] == pytest.approx(1, abs=1e-5)


def test_area_is_that_of_the_outline():
    series = series_of(pool_with(ELLIPSE), 200, seconds=0.1)
    assert series.area_mm2.sum() == pytest.approx(math.pi * 3.3 * 3.7, rel=0.01)


def test_pod_finds_the_two_mode_shapes():
    waves = Wave((0, 1), 0.03, 40.0), Wave((1, 1), 0.01, 63.0)
    first, second, third, _ = pod_modes(series_of(pool_with(ELLIPSE, *waves), 500))
    # ∫J_0²(j_01 ρ) ρ dρ = J_1²(j_01)/2, ∫J_1²(j_11 ρ) ρ dρ = J_2²(j_11)/2, twice of cos² and sin².
    parts = [0.03**2 * jv(1, jn_zeros(0, 1)[0]) ** 2]
    parts += [0.01**2 * jv(2, jn_zeros(1, 1)[0]) ** 2 / 2 / jv(1, jnp_zeros(1, 1)[0]) ** 2]
    assert first.share == pytest.approx(parts[0] / sum(parts), abs=2e-3)
    assert second.share == pytest.approx(parts[1] / sum(parts), abs=2e-3)
    assert third.share < 1e-4
    assert first.figures["frequency_hz"][0] == pytest.approx(40, abs=0.01)
    assert second.figures["frequency_hz"][0] == pytest.approx(63, abs=0.01)


def two_modes(rng):
    """Return the amplitudes of two simultaneous damped modes with random phases, and the pool."""
    amplitude, phase = (0.02, 0.012), rng.uniform(0, 360, 2)
    return amplitude, pool_with(
        ELLIPSE,
        Wave((0, 1), amplitude[0], 37.3, phase_deg=phase[0], damping_per_s=3.0),
        Wave((1, 1), amplitude[1], 61.8, phase_deg=phase[1], turned_deg=50, damping_per_s=4.0),
    )


@pytest.mark.slow
@pytest.mark.parametrize("rate_hz", [200, 1000])
def test_two_modes_at_once_with_noise_and_lost_frames(rate_hz):
    rng = np.random.default_rng(7)
    amplitude, pool = two_modes(rng)
    series = series_of(pool, rate_hz, rng=rng, noise_mm=6e-4, lost=0.05)
    modes = bessel_modes(series)
    for one, hertz, size, gamma in zip(modes, (37.3, 61.8), amplitude, (3.0, 4.0), strict=False):
        figures = one.figures
        at_first = size * math.exp(-gamma * series.time_s[0])
        assert figures["frequency_hz"][0] == pytest.approx(hertz, abs=0.1)
        assert figures["amplitude_mm"][0] == pytest.approx(at_first, rel=0.05)
        assert figures["damping_per_s"][0] == pytest.approx(gamma, rel=0.1)
    assert not modes[3].oscillations


def test_modes_are_separated_despite_lost_frames():
    amplitude, pool = two_modes(np.random.default_rng(7))
    series = series_of(pool, 200, rng=np.random.default_rng(8), lost=0.05)
    for one, size, gamma in zip(bessel_modes(series), amplitude, (3.0, 4.0), strict=False):
        at_first = size * math.exp(-gamma * series.time_s[0])
        assert one.figures["amplitude_mm"][0] == pytest.approx(at_first, rel=1e-6)


def test_amplitude_scatter_reaches_the_cramer_rao_bound():
    """For white noise."""
    rng, time, noise = np.random.default_rng(5), np.arange(200) / 200, 0.05
    wave = np.exp((2j * np.pi * 61.8 - 4) * time)
    amplitudes = [
        abs(fit_oscillations(time, wave.real + noise * rng.normal(size=200), 1)[0].amplitude[0])
        for _ in range(60)
    ]
    # Joint fit of amplitude, phase, frequency and decay; the trend adds almost nothing.
    turned = np.column_stack([wave, 1j * wave, 1j * time * wave, time * wave]).real
    bound = noise * np.sqrt(np.linalg.inv(turned.T @ turned)[0, 0])
    assert np.std(amplitudes) == pytest.approx(bound, rel=0.3)  # 9 % standard deviation of 60
    assert np.mean(amplitudes) == pytest.approx(1, abs=4 * bound / np.sqrt(60))


@pytest.mark.slow
def test_standard_uncertainties_cover_the_truth():
    rng, scores = np.random.default_rng(11), []
    for _ in range(150):
        time = np.flatnonzero(rng.random(200) > 0.05) / 200
        phase = rng.uniform(0, 2 * np.pi)
        value = 20 * np.exp(-3 * time) * np.cos(2 * np.pi * 37.3 * time + phase)
        value += 8 * np.exp(-2 * time) * np.cos(2 * np.pi * 61 * time) + 5 * time
        value += rng.normal(0, 2, len(time))
        oscillation = fit_oscillations(time, value, 2)[0]
        size, sigma = oscillation.quantities(np.abs)
        scores.append(
            [
                (oscillation.frequency_hz - 37.3) / oscillation.frequency_sigma_hz,
                (oscillation.damping_per_s - 3) / oscillation.damping_sigma_per_s,
                (size[0] - 20 * np.exp(-3 * time[0])) / sigma[0],
            ]
        )
    # 150 of 95 %: 1.8 % standard deviation.
    assert ((np.abs(scores) < 1.96).mean(axis=0) > 0.90).all()
    assert (np.sqrt(np.mean(np.square(scores), axis=0)) > 0.8).all()


@pytest.mark.parametrize("hertz", [22.0, 35.2])
def test_frequency_is_not_doubled_if_the_crests_are_missing(hertz):
    rng, time = np.random.default_rng(8), np.arange(60) / 200
    value = 0.02 * np.cos(2 * np.pi * hertz * time + 1.0)
    kept = value < 0.008
    (found,) = fit_oscillations(time[kept], (value + rng.normal(0, 2e-4, 60))[kept], 1)
    assert abs(found.frequency_hz - hertz) < 5 * found.frequency_sigma_hz
    assert abs(abs(found.amplitude[0]) - 0.02) < 0.001


def test_noise_alone_has_no_oscillation():
    rng = np.random.default_rng(3)
    time = np.arange(200) / 200
    counts = [len(fit_oscillations(time, rng.normal(size=200))) for _ in range(30)]
    assert sum(counts) <= 1


@pytest.mark.parametrize("hertz", [29.9, 30.0])
def test_no_alias_beyond_half_the_frame_rate_is_found(hertz):
    rng = np.random.default_rng(1)
    time = np.arange(120) / 60
    value = np.cos(2 * np.pi * hertz * time + 0.7) + rng.normal(0, 0.05, 120)
    found = [one.frequency_hz for one in fit_oscillations(time, value, 1, (5.0, 500.0))]
    assert found == pytest.approx([hertz] if hertz < 30 else [], abs=0.02)
    for nothing in ((30.0, 500.0), (10.03, 10.12)):  # narrower than the frequencies searched
        assert fit_oscillations(time, value, 1, nothing) == ()
