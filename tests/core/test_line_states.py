"""States of a run from its series, pulses from brightness, oscillation from a tracked line."""

from __future__ import annotations

import tracemalloc
from dataclasses import replace

import numpy as np
import pytest
import scipy

from labapp.core.geometry.line_pattern import LinePattern, LineRig
from labapp.core.geometry.rig import Electrode, ImagingPlane, Laser
from labapp.core.lines.pulses import classify_pulses, pulse_frequency
from labapp.core.lines.states import LineSeries, line_changes, line_states
from labapp.core.lines.track import oscillation_frequency, track_line
from labapp.simulation.camera import CameraView
from tests.line_truth.runs import PHASES, GmawLook, gmaw_run


def run_series(seed: int, noise: float = 0.004) -> tuple[LineSeries, list[str]]:
    """Simulate the measured series of a run like Fig. 3-11, with gaps, and its true states."""
    rng = np.random.default_rng(seed)
    ends = (15, 55, 110, 150, 200)
    truth = [PHASES[int(np.searchsorted(ends, k, side="right"))] for k in range(200)]
    frame = np.arange(200.0)
    width = np.interp(frame, ends[:4], [2.2, 6.2, 6.2, 4.4])
    bend = np.interp(frame, ends[:4], [-0.06, -0.06, -0.06, 0.08])
    count = np.where(width > 5, 5, np.where(width > 3, 4, 3))
    lit = frame >= ends[0]
    width = np.where(lit, width + 0.05 * rng.normal(size=200), np.nan)
    bend = np.where(lit, bend + noise * rng.normal(size=200), np.nan)
    unknown = rng.random(200) < 0.15
    bend[unknown], width[unknown] = np.nan, np.nan
    bend[::37] = 0.2  # a wrong surface now and then
    return LineSeries(np.where(lit, count, 0), width, bend * width), truth


@pytest.mark.parametrize("seed", range(3))
def test_change_starts_where_a_steady_value_becomes_unknown(seed: int):
    series, _ = run_series(seed)
    turn = series.turn.copy()
    part = (np.arange(110, 150) - 109.5) / 40  # accelerating, so that a straight ramp starts late
    low, high = np.nanmedian(turn[60:105]), np.nanmedian(turn[155:])
    turn[110:150] = low + (high - low) * part * (0.7 + 0.3 * part)
    turn[110:129] = np.nan  # a caustic as soon as the pool flattens
    states = line_states(replace(series, turn=turn))
    assert abs(states.index("flattening") - 110) <= 2


@pytest.mark.parametrize("seed", range(3))
def test_states_of_a_run(seed: int):
    series, truth = run_series(seed)
    states = line_states(series)
    assert np.mean([a == b for a, b in zip(states, truth, strict=True)]) >= 0.96
    assert [s for k, s in enumerate(states) if k in (5, 35, 80, 130, 180)] == list(PHASES)


@pytest.mark.parametrize("seed", range(3))
def test_pool_grows_from_its_first_lines_though_too_few(seed: int):
    series, truth = run_series(seed)
    width, turn = series.width_mm.copy(), series.turn.copy()
    width[15:26], turn[15:26] = np.nan, np.nan
    width[26:34] = width[34]  # the growth is visible only 15 frames after the first lines
    states = line_states(replace(series, width_mm=width, turn=turn))
    assert set(states[15:50]) == {"growing"} == set(truth[15:50])


def test_a_steady_pool_neither_grows_nor_flattens():
    rng = np.random.default_rng(4)
    turn = -0.36 + 0.024 * rng.normal(size=120)
    series = LineSeries(np.full(120, 5), 6.0 + 0.05 * rng.normal(size=120), turn)
    assert set(line_states(series)) == {"concave"}


def test_convex_pool_that_bulges_further_is_not_flattening():
    rng = np.random.default_rng(5)
    turn = np.interp(np.arange(120), [60, 80], [0.2, 0.5]) + 0.01 * rng.normal(size=120)
    series = LineSeries(np.full(120, 4), 4.5 + 0.02 * rng.normal(size=120), turn)
    assert set(line_states(series)) == {"convex"}


def test_frames_without_a_surface_keep_the_previous_state():
    turn = np.concatenate([np.full(100, -0.3), np.full(40, np.nan)])
    width = np.where(np.isfinite(turn), 6.0, np.nan)
    assert set(line_states(LineSeries(np.full(140, 5), width, turn))) == {"concave"}


def test_lasting_changes_of_the_number_of_lines():
    count = np.array([5] * 10 + [4] + [5] * 10 + [4] * 10)
    series = LineSeries(count, np.full(31, np.nan), np.full(31, np.nan))
    assert line_changes(series) == [(21, 5, 4)]


def test_pulses_from_brightness():
    rng = np.random.default_rng(5)
    on = (np.arange(900) / 1500 * 120 + 0.3) % 1.0 < 0.4
    light = np.where(on, 120.0, 15.0) * (1 + 0.1 * rng.normal(size=900))
    pulses = classify_pulses(light, 1500.0)
    assert np.array_equal(pulses.on, on)
    assert pulse_frequency(pulses.on, 1500.0) == pytest.approx(120.0, abs=0.3)


def test_steady_light_has_no_pulses():
    light = 20.0 * (1 + 0.05 * np.random.default_rng(6).normal(size=400))
    pulses = classify_pulses(light, 1500.0)
    assert not pulses.on.any()
    assert np.isnan(pulse_frequency(pulses.on, 1500.0))


@pytest.mark.parametrize("on", [False, True])
def test_frames_that_are_all_alike_have_no_frequency_of_pulses(on):
    assert np.isnan(pulse_frequency(np.full(100, on), 1500.0))


def test_period_decides_frames_of_medium_brightness():
    """At half the brightness of a pulse, the phase decides."""
    phase = (np.arange(1500) / 1500 * 120.0) % 1.0
    on = phase < 0.4
    light = np.where(on, 100.0, 10.0)
    odd = np.flatnonzero((phase > 0.1) & (phase < 0.3))[7]
    light[odd] = 54.0
    assert classify_pulses(light, 1500.0).on[odd]
    assert not classify_pulses(light).on[odd]


def test_frequency_through_missing_frames():
    rng = np.random.default_rng(7)
    time_s = np.arange(3000) / 1500
    known = (time_s * 120) % 1.0 > 0.4
    values = np.sin(2 * np.pi * 37.3 * time_s) + 2 * time_s + 0.5 * rng.normal(size=3000)
    frequency, share = oscillation_frequency(time_s[known], values[known])
    assert frequency == pytest.approx(37.3, abs=0.1)
    assert share > 0.5


def test_share_of_the_variance_is_that_of_the_periodogram_with_a_free_mean():
    rng = np.random.default_rng(11)
    time_s = np.sort(rng.uniform(0.0, 0.4, 240))
    values = np.sin(2 * np.pi * 41.0 * time_s) + 0.3 * rng.normal(size=240)
    frequency, share = oscillation_frequency(time_s, values)
    drift = np.polynomial.Polynomial.fit(time_s, values, 3)(time_s)
    rates = np.arange(5.0, 100.0, 1 / (8 * np.ptp(time_s)))  # eight per inverse of the duration
    expected = scipy.signal.lombscargle(
        time_s, values - drift, 2 * np.pi * rates, normalize=True, floating_mean=True
    )
    assert frequency == pytest.approx(41.0, abs=0.1)
    assert share == pytest.approx(expected.max(), rel=1e-9)


def test_a_line_at_rest_has_no_frequency():
    frequency, share = oscillation_frequency(np.arange(100) / 1500, np.zeros(100))
    assert np.isnan(frequency)
    assert share == 0.0


def test_frequency_of_a_long_recording_needs_little_memory():
    time_s = np.arange(3000) / 1500
    tracemalloc.start()
    frequency, _ = oscillation_frequency(time_s, np.sin(2 * np.pi * 37.3 * time_s))
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert frequency == pytest.approx(37.3, abs=0.01)
    assert peak < 50e6


@pytest.mark.slow
def test_line_is_tracked_through_pulses_spatter_and_glare():
    rig = LineRig(
        Laser(70.0, 60.0, aim_y_mm=-2.4),
        LinePattern(1, 0.23, 4.0),
        Electrode(15.0),
        ImagingPlane.vertical(20.0, 32.0, -4.0, 64.0, 48.0),
    )
    view = CameraView((0.0, 239.0), (300.0, 239.0), 60.0, (0.0, 39.0), 40.0, 320, 240)
    rng = np.random.default_rng(8)
    run = list(gmaw_run(300, rig, view, rng, oscillation_hz=36.0, look=GmawLook(spatter=1.0)))
    pulses, lines = track_line((one.image for one in run), 1500.0)
    truth = np.array([one.on for one in run])
    assert np.mean(pulses.on == truth) >= 0.99
    off_frames = np.flatnonzero(~truth)
    errors = []
    for k in off_frames:
        line = lines[k]
        if line is not None:
            u, v = run[k].line_px[np.argsort(run[k].line_px[:, 0])].T
            errors.append(np.abs(line.v_px - np.interp(line.u_px, u, v))[3:-3].max())
    assert len(errors) >= 0.95 * len(off_frames)
    assert np.median(errors) < 0.6
    shifts = [(k / 1500.0, line.shift_px) for k, line in enumerate(lines) if line is not None]
    frequency, _ = oscillation_frequency(*np.array(shifts).T)
    assert frequency == pytest.approx(36.0, abs=1.0)


def test_a_tracked_line_ends_where_its_light_ends():
    rng = np.random.default_rng(3)
    v, u = np.mgrid[:120, :320].astype(float)
    film = []
    for k in range(12):
        arch = 50.0 + 2.0 * np.sin(k) + (u - 150) ** 2 / 400
        light = 90 * np.exp(-((v - arch) ** 2) / 9) * (np.abs(u - 150) < 70)
        if k == 0:  # light of something else continues the line in the first frame
            light += 90 * np.exp(-((v - 62.0) ** 2) / 9) * (np.abs(u - 240) < 20)
        film.append(np.clip(20 + light + rng.normal(size=v.shape), 0, 255).astype(np.uint8))
    _, tracked = track_line(film, None)
    first, others = tracked[0], tracked[1:]
    assert first is not None
    assert first.u_px[-1] > 235
    for line in others:
        assert line is not None
        assert abs(line.u_px[0] - 80) < 9
        assert abs(line.u_px[-1] - 220) < 9


def test_current_identifies_pulses_where_light_does_not():
    rng = np.random.default_rng(12)
    on = np.arange(600) * 120 / 1500 % 1.0 < 0.4
    dim = 20 + 0.3 * on + rng.normal(size=600)  # a very dense filter
    assert not classify_pulses(dim, 1500.0).on.any()
    current = np.where(on, 300.0, 80.0) + 10 * rng.normal(size=600)
    current[200:260] = np.nan  # the logger paused: the period decides
    pulses = classify_pulses(dim, 1500.0, current)
    assert np.mean(pulses.on == on) > 0.99
    assert pulse_frequency(pulses.on, 1500.0) == pytest.approx(120.0, abs=0.5)
    light = np.where(on, 190.0, 22.0) * np.exp(0.08 * rng.normal(size=600))
    light[::50] = 100.0  # spatter or glare, which the current distinguishes from a pulse
    assert (classify_pulses(light, None, current).on == on)[::50].mean() > 0.8
    steady = np.full(600, 150.0)
    assert np.array_equal(
        classify_pulses(light, 1500.0, steady).on, classify_pulses(light, 1500.0).on
    )
