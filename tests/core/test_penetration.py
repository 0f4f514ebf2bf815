"""Penetration models compared with known laws and with scikit-learn."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from labapp.core.dynamics.penetration import (
    SURE_95,
    ModelSettings,
    fit_model,
    validated_model,
)
from labapp.core.dynamics.static_maps import GaussianMap
from labapp.core.dynamics.weld_series import (
    MOST_HELD,
    Orders,
    WeldSeries,
    find_transitions,
    impulse_response,
    in_steps,
    regressors,
)
from labapp.core.values import FloatArray
from labapp.simulation.penetration import (
    FEATURES,
    FULL_MM,
    SCAN_SIGMA_MM,
    SCATTER_MM,
    TARGET,
    first_order_lag,
    simulate_welds,
)

STEP_S = 0.1


def weld(
    value: FloatArray,
    target: FloatArray | float = np.nan,
    sigma: tuple[float, float] = (0.0, 0.0),
    rate_hz: float = 10.0,
    name: str = "weld",
) -> WeldSeries:
    """Return a weld with one feature."""
    count = len(value)
    noise, level = (np.full((count, 1), part) for part in sigma)
    time_s = (np.arange(count) + 0.5) / rate_hz
    known = np.broadcast_to(target, count).astype(float)
    return WeldSeries(name, time_s, value[:, None], noise, level, known, np.full(count, 0.1))


def pulses(rng: np.random.Generator, count: int) -> FloatArray:
    return np.repeat(rng.uniform(1, 3, count // 20 + 1), 20)[:count]


# --- steps --------------------------------------------------------------------------------------


def test_step_has_the_mean_of_its_frames_and_less_noise() -> None:
    series = weld(np.arange(8.0), np.array([1, 3, *[np.nan] * 6]), (0.2, 0.3), rate_hz=40.0)
    steps = in_steps(series, STEP_S)
    assert steps.time_s == pytest.approx([0.05, 0.15])
    assert steps.value[:, 0] == pytest.approx([1.5, 5.5])
    assert steps.noise[:, 0] == pytest.approx([0.1, 0.1])
    assert steps.level[:, 0] == pytest.approx([0.3, 0.3])
    assert steps.target[0] == 2
    assert steps.target_sigma[0] == pytest.approx(0.1 / np.sqrt(2))
    assert np.isnan(steps.target[1])


def test_missing_features_are_held_for_a_limited_time() -> None:
    value = np.arange(20.0)
    value[4:16] = np.nan
    steps = in_steps(weld(value), STEP_S)
    assert steps.value[: 4 + MOST_HELD, 0] == pytest.approx([0, 1, 2, *[3] * (1 + MOST_HELD)])
    assert np.isnan(steps.value[4 + MOST_HELD : 16]).all()
    assert steps.value[16:, 0] == pytest.approx([16, 17, 18, 19])


def test_in_steps_is_idempotent() -> None:
    once = in_steps(simulate_welds(1, 3)[0].series, STEP_S)
    twice = in_steps(once, STEP_S)
    for name in ("time_s", "value", "noise", "level", "target", "target_sigma"):
        np.testing.assert_allclose(getattr(twice, name), getattr(once, name), equal_nan=True)


def test_weld_without_frames_or_too_long_is_rejected() -> None:
    with pytest.raises(ValueError, match="no frame"):
        in_steps(weld(np.full(5, np.nan)), STEP_S)
    with pytest.raises(ValueError, match="steps"):
        in_steps(weld(np.ones(3), rate_hz=1e-6), STEP_S)


# --- dynamics -----------------------------------------------------------------------------------


def test_filter_is_a_first_order_lag_from_rest() -> None:
    value = np.repeat([2.0, 5.0], 60)
    filtered, _, _ = regressors(weld(value), impulse_response([0.4], STEP_S), Orders())
    expected = first_order_lag(value, 0.4, 1 / STEP_S)
    assert filtered[:, 0] == pytest.approx(expected, abs=2e-3)


def test_lags_and_delay_shift_the_features() -> None:
    value = np.arange(30.0)
    filtered, _, _ = regressors(weld(value), impulse_response([], STEP_S), Orders(0, 3, 2))
    assert filtered[10] == pytest.approx([8, 7, 6])
    assert filtered[0] == pytest.approx([0, 0, 0])


def test_filter_averages_noise_but_not_the_level() -> None:
    steps = weld(np.ones(200), sigma=(0.5, 0.2))
    _, noise, level = regressors(steps, impulse_response([0.4], STEP_S), Orders())
    pole = np.exp(-STEP_S / 0.4)
    assert noise[-1, 0] == pytest.approx(0.5 * np.sqrt((1 - pole) / (1 + pole)), rel=0.01)
    assert level[-1, 0] == pytest.approx(0.2)


def test_filter_restarts_after_a_gap() -> None:
    value = np.concatenate([np.full(20, 1.0), np.full(20, np.nan), np.full(20, 7.0)])
    steps = in_steps(weld(value), STEP_S)
    filtered, _, _ = regressors(steps, impulse_response([1.0], STEP_S), Orders())
    assert filtered[40:, 0] == pytest.approx(7.0)
    assert np.isnan(filtered[30, 0])


# --- models -------------------------------------------------------------------------------------


def linear_welds(count: int, seed: int) -> list[WeldSeries]:
    """Return welds with penetration 2 + 0.7·u after a lag of 0.5 s, without noise."""
    rng = np.random.default_rng(seed)
    welds = []
    for k in range(count):
        value = pulses(rng, 200)
        target = 2 + 0.7 * first_order_lag(value, 0.5, 1 / STEP_S)
        welds.append(weld(value, target, name=f"weld_{k}"))
    return welds


def test_arx_recovers_the_simulated_law() -> None:
    welds = linear_welds(4, 1)
    model = fit_model(welds[:3], "arx", ModelSettings(("width_mm",), TARGET))
    assert model.time_constants_s == pytest.approx((0.5,), rel=0.03)
    assert model.predict(welds[3]).value == pytest.approx(welds[3].target, abs=0.01)


def test_arx_recovers_the_law_from_few_sections() -> None:
    welds = [
        replace(one, target=np.where(np.arange(200) % 17 == 0, one.target, np.nan))
        for one in linear_welds(5, 2)
    ]
    model = fit_model(welds[:4], "arx", ModelSettings(("width_mm",), TARGET))
    assert model.time_constants_s == pytest.approx((0.5,), rel=0.1)


def test_gaussian_process_agrees_with_scikit_learn() -> None:
    from sklearn.gaussian_process import GaussianProcessRegressor
    from sklearn.gaussian_process.kernels import RBF, ConstantKernel

    rng = np.random.default_rng(5)
    x, y, variance = rng.normal(size=(40, 2)), rng.normal(size=40), rng.uniform(0.1, 0.3, 40)
    lengths, places = np.array([0.8, 2.5]), rng.normal(size=(9, 2))
    kernel = ConstantKernel(1.7) * RBF(lengths)
    reference = GaussianProcessRegressor(kernel, alpha=variance, optimizer=None).fit(x, y)
    mean, sigma = reference.predict(places, return_std=True)
    ours = GaussianMap(x, y, variance, lengths, 1.7)
    mean_found, found_variance, gradient = ours.evaluate(places)
    assert mean_found == pytest.approx(mean)
    assert np.sqrt(found_variance) == pytest.approx(sigma)
    for axis in range(2):
        aside = 1e-5 * np.eye(2)[axis]
        slope = (ours.evaluate(places + aside)[0] - ours.evaluate(places - aside)[0]) / 2e-5
        assert gradient[:, axis] == pytest.approx(slope, abs=1e-6)


@pytest.mark.parametrize("kind", ["arx", "gp"])
def test_feature_uncertainty_is_propagated(kind: str) -> None:
    welds = linear_welds(3, 4)
    model = fit_model(welds, kind, ModelSettings(("width_mm",), TARGET))  # type: ignore[arg-type]
    middle = np.full(60, 2.0)
    exact, uncertain = (model.predict(weld(middle, sigma=(0.0, s))).sigma[-1] for s in (0.0, 0.3))
    assert uncertain**2 - exact**2 == pytest.approx((0.7 * 0.3) ** 2, rel=0.1)


def test_features_outside_the_training_range_are_flagged() -> None:
    model = fit_model(linear_welds(3, 4), "arx", ModelSettings(("width_mm",), TARGET))
    assert not model.predict(weld(np.full(30, 2.0))).is_outside.any()
    assert model.predict(weld(np.full(30, 4.0))).is_outside.all()


def test_penetration_is_never_negative() -> None:
    model = fit_model(linear_welds(3, 4), "arx", ModelSettings(("width_mm",), TARGET))
    prediction = model.predict(weld(np.full(30, -9.0)))
    assert (prediction.value == 0).all()
    assert (prediction.low_95 == 0).all()
    assert (prediction.high_95 > 0).all()


def test_too_few_welds_or_sections_are_rejected() -> None:
    settings = ModelSettings(("width_mm",), TARGET)
    with pytest.raises(ValueError, match="welds"):
        validated_model(linear_welds(2, 1), "arx", settings)
    few = [replace(one, target=np.where(np.arange(200) == 9, 1.0, np.nan))
           for one in linear_welds(3, 1)]  # fmt: skip
    with pytest.raises(ValueError, match="sections"):
        validated_model(few, "arx", settings)


def test_features_are_held_no_longer_in_a_cross_validation() -> None:
    # A gap of this length is bridged if the features are held twice.
    settings = ModelSettings(("width_mm",), TARGET)
    in_gap = abs(np.arange(200) - 90)[:, None] < MOST_HELD
    welds = [replace(one, value=np.where(in_gap, np.nan, one.value)) for one in linear_welds(4, 1)]
    model, left_out = validated_model(welds, "arx", settings)
    steps = [in_steps(one, STEP_S) for one in welds]
    direct = fit_model(steps, "arx", settings)
    assert model.time_constants_s == direct.time_constants_s
    assert model.scatter_mm == direct.scatter_mm
    for one in steps:
        others = [each for each in steps if each is not one]
        expected = fit_model(others, "arx", settings, like=direct).predict_steps(one)
        of = np.array([name == one.name for name in left_out.weld])
        at = np.rint((left_out.time_s[of] - expected.time_s[0]) / STEP_S).astype(int)
        assert left_out.predicted[of] == pytest.approx(expected.value[at])


def test_unexplained_weld_to_weld_scatter_widens_the_interval() -> None:
    """Each weld is off by its own amount: sections of one weld are not independent."""
    rng = np.random.default_rng(8)
    welds = [
        replace(one, target=one.target + rng.normal(0, 0.3), target_sigma=0 * one.target)
        for one in linear_welds(12, 6)
    ]
    model, left_out = validated_model(welds, "arx", ModelSettings(("width_mm",), TARGET))
    assert left_out.sigma == pytest.approx(left_out.rmse_mm, rel=0.15)
    assert model.rmse_mm == left_out.rmse_mm


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "most"), [("arx", 1.6), ("gp", 1.4)])
def test_welds_left_out_are_predicted_within_their_intervals(kind: str, most: float) -> None:
    welds = [one.series for one in simulate_welds(10, 12)]
    settings = ModelSettings(FEATURES, TARGET, full_mm=FULL_MM)
    _, left_out = validated_model(welds, kind, settings)  # type: ignore[arg-type]
    bead = left_out.measured > 0
    noise = np.sqrt(np.mean(np.where(bead, SCAN_SIGMA_MM**2 + SCATTER_MM**2, 0.0)))
    assert noise < left_out.rmse_mm < most * noise
    assert abs(left_out.bias_mm) < 0.03
    assert 0.92 < left_out.cover < 0.98
    spread = np.hypot(left_out.sigma, left_out.measured_sigma)[bead]
    assert np.mean(np.abs(left_out.predicted - left_out.measured)[bead] < SURE_95 * spread) > 0.9
    known, predicted = left_out.transitions()
    assert len(known) > 10
    # Of 17 transitions; tests/benchmarks/penetration.py requires 90 % of 166.
    assert np.mean(np.abs(known - predicted) <= 0.2) >= 0.8


# --- transitions --------------------------------------------------------------------------------


def test_transition_is_where_the_limit_is_crossed_permanently() -> None:
    time_s = np.arange(0, 4, 0.1)
    value = np.where(time_s < 1.95, 0.2, 0.8)
    value[5] = 0.9  # a flicker is no transition
    value[30] = 0.1
    assert find_transitions(time_s, value, 0.5) == pytest.approx([1.95])
    assert find_transitions(time_s, value, 0.35) == pytest.approx([1.925])


def test_two_transitions_and_none() -> None:
    time_s = np.arange(0, 4, 0.5)
    value = np.array([0, 0, 1, 1, 0, 0, 1, 1.0])
    assert find_transitions(time_s, value, 0.5) == pytest.approx([0.75, 2.75])
    assert len(find_transitions(time_s, value + 1, 0.5)) == 0
    assert len(find_transitions(time_s, np.full(8, np.nan), 0.5)) == 0
