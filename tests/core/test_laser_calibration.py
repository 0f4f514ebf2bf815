"""Appendix I: calibration of the laser from the cross-hair it draws."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from labapp.core.calibration import laser_calibration
from labapp.core.calibration.laser_calibration import LaserCalibrationSettings, calibrate_laser


def cross_hair(angle_deg: float, distance_mm: float, fan_deg: float = 10.0) -> np.ndarray:
    """Draw the cross by cutting the fan's outermost rays with the plane z = 0."""
    angle, half = np.radians(angle_deg), np.radians(fan_deg / 2)
    laser = distance_mm * np.array([0.0, np.cos(angle), np.sin(angle)])
    axis = -laser / distance_mm
    up = np.array([0.0, -np.sin(angle), np.cos(angle)])
    across = np.array([1.0, 0.0, 0.0])
    ends = []
    for side in (-up, up, across):
        ray = axis + np.tan(half) * side
        ends.append(np.linalg.norm(laser - laser[2] / ray[2] * ray))
    return np.array(ends)


def test_example_of_the_conventions() -> None:
    l1, l2, l3 = cross_hair(30.0, 90.0)
    assert (l3, l2) == pytest.approx((7.874, 18.561), abs=5e-4)
    calibration = calibrate_laser(2 * [l1], 2 * [18.561], 2 * [7.874])
    assert calibration.angle_deg == pytest.approx(30.0, abs=2e-3)
    assert calibration.distance_mm == pytest.approx(90.0, abs=2e-3)
    assert calibration.height_mm == pytest.approx(45.0, abs=4e-3)
    assert calibration.horizontal_mm == pytest.approx(90.0 * np.cos(np.pi / 6), abs=4e-3)
    assert calibration.warnings == ()
    assert calibration.laser.projection_angle_deg == calibration.angle_deg


@given(
    angle=st.floats(15.0, 80.0),
    distance=st.floats(20.0, 300.0),
    fan=st.floats(4.0, 20.0),
)
def test_calibration_recovers_any_laser(angle: float, distance: float, fan: float) -> None:
    l1, l2, l3 = cross_hair(angle, distance, fan)
    calibration = calibrate_laser(2 * [l1], 2 * [l2], 2 * [l3], fan)
    assert calibration.angle_deg == pytest.approx(angle, abs=1e-6)
    assert calibration.distance_mm == pytest.approx(distance, rel=1e-9)
    assert calibration.expected_l1_mm == pytest.approx(l1, rel=1e-9)
    assert calibration.warnings == ()


def test_perpendicular_beam_has_three_equal_lengths() -> None:
    assert cross_hair(90.0, 60.0) == pytest.approx(60.0 * np.tan(np.radians(5.0)))
    calibration = calibrate_laser(5.0, 5.0, 5.0)
    assert calibration.angle_deg == pytest.approx(90.0)
    assert calibration.distance_mm == pytest.approx(5.0 / np.tan(np.radians(5.0)))


@pytest.mark.parametrize("count", [3, 5, 10])
@pytest.mark.parametrize("fan_sigma", [0.0, 0.1])
def test_intervals_cover_the_laser_with_few_readings(
    count: int, fan_sigma: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(laser_calibration, "REFUSE_SIGMA", np.inf)
    rng = np.random.default_rng(7)
    settings = LaserCalibrationSettings(resolution_mm=0.01, fan_angle_sigma_deg=fan_sigma)
    truth = np.array([31.14, 31.48, 31.48 * np.sin(np.radians(31.14))])
    covered, errors = [], []
    for _ in range(1500):
        drawn = cross_hair(31.14, 31.48, 10.0 + fan_sigma * rng.normal())
        readings = np.round(drawn[:, None] + rng.normal(0.0, 0.1, (3, count)), 2)
        calibration = calibrate_laser(*readings, settings=settings)
        values = np.array([calibration.angle_deg, calibration.distance_mm, calibration.height_mm])
        sigma = [
            calibration.angle_sigma_deg,
            calibration.distance_sigma_mm,
            calibration.height_sigma_mm,
        ]
        covered.append(np.abs(values - truth) < 1.96 * np.array(sigma))
        errors.append(values - truth)
    share = np.mean(covered, axis=0)
    assert (share > 0.93).all(), share
    assert (share < 0.97).all(), share
    if not fan_sigma:
        correlation = np.corrcoef(np.array(errors)[:, :2].T)[0, 1]
        assert correlation > 0.85
        exact = calibrate_laser(*cross_hair(31.14, 31.48), settings=settings)
        assert exact.correlation == pytest.approx(correlation, abs=0.02)


def test_few_readings_use_students_factor() -> None:
    truth, deviations = cross_hair(31.14, 31.48), np.array([-0.1, 0.0, 0.1])
    settings = LaserCalibrationSettings(resolution_mm=1e-6, fan_angle_sigma_deg=0.0)
    calibration = calibrate_laser(*(truth[:, None] + deviations), settings=settings)
    # The distance depends only on l3: t for two degrees of freedom, 4.303, over 1.96.
    expected = 0.1 / np.sqrt(3) / np.tan(np.radians(5.0)) * 4.3027 / 1.95996
    assert calibration.distance_sigma_mm == pytest.approx(expected, rel=1e-4)


def test_equal_readings_are_uncertain_by_the_resolution() -> None:
    readings = np.tile(cross_hair(31.14, 31.48)[:, None], 50)
    settings = LaserCalibrationSettings(resolution_mm=0.05, fan_angle_sigma_deg=0.0)
    calibration = calibrate_laser(*readings, settings=settings)
    least = 0.05 / np.sqrt(12) / np.tan(np.radians(5.0))
    assert calibration.distance_sigma_mm == pytest.approx(least, rel=0.03)


def test_setup_keys_contain_values_sigmas_and_correlation() -> None:
    calibration = calibrate_laser(*cross_hair(31.14, 31.48))
    assert calibration.setup_keys == {
        "projection_angle_deg": calibration.angle_deg,
        "projection_angle_deg_sigma": calibration.angle_sigma_deg,
        "distance_mm": calibration.distance_mm,
        "distance_mm_sigma": calibration.distance_sigma_mm,
        "angle_distance_correlation": calibration.correlation,
    }


def test_resolution_contributes_for_a_single_reading() -> None:
    lengths = cross_hair(31.0, 60.0)
    coarse = calibrate_laser(*lengths, settings=LaserCalibrationSettings(1.0, 0.1, 0.0))
    expected = 1.0 / np.sqrt(12.0) / np.tan(np.radians(5.0))
    assert coarse.distance_sigma_mm == pytest.approx(expected)


def test_fan_angle_uncertainty_contributes() -> None:
    settings = LaserCalibrationSettings(1e-9, 1e-9, 0.1)
    lengths = cross_hair(31.0, 60.0)
    calibration = calibrate_laser(*lengths, settings=settings)
    wider = calibrate_laser(*lengths, fan_angle_deg=10.01)
    narrower = calibrate_laser(*lengths, fan_angle_deg=9.99)
    slope = abs(wider.distance_mm - narrower.distance_mm) / 0.02
    assert calibration.distance_sigma_mm == pytest.approx(0.1 * slope, rel=1e-3)
    slope = abs(wider.angle_deg - narrower.angle_deg) / 0.02
    assert calibration.angle_sigma_deg == pytest.approx(0.1 * slope, rel=1e-3)


@pytest.mark.parametrize(
    ("l1", "l2", "l3", "fan", "words"),
    [
        (18.561, 13.675, 7.874, 10.0, "l1_mm = 18.56 is longer than l2_mm"),
        (5.0, 6.0, 7.0, 10.0, "l3_mm = 7 is longer than l2_mm"),
        (16.0, 18.561, 7.874, 10.0, "l1_mm = 16 contradicts .* should be 13.6"),
        (-1.0, 18.561, 7.874, 10.0, "l1_mm = -1: a reading is a positive number"),
        (13.675, float("nan"), 7.874, 10.0, "l2_mm = nan"),
        (13.675, 18.561, [], 10.0, "l3_mm is empty"),
        (13.675, 18.561, 7.874, 0.0, "fan_angle_deg = 0"),
    ],
)
def test_contradictory_readings_are_rejected(
    l1: float, l2: float, l3: float, fan: float, words: str
) -> None:
    with pytest.raises(ValueError, match=words):
        calibrate_laser(l1, l2, l3, fan)


def test_mild_disagreement_is_a_warning() -> None:
    l1, l2, l3 = cross_hair(31.0, 60.0)
    settings = LaserCalibrationSettings(fan_angle_sigma_deg=0.0)
    readings = ([length - 0.01, length, length + 0.01] for length in (l1 + 0.25, l2, l3))
    (warning,) = calibrate_laser(*readings, settings=settings).warnings
    assert "l1_mm" in warning
    assert f"{l1:.4g}" in warning


def test_nearly_perpendicular_beam_gives_a_warning() -> None:
    calibration = calibrate_laser(5.0, 5.0, 5.03)
    assert calibration.angle_deg == pytest.approx(90.0)
    assert "l3_mm" in calibration.warnings[0]


@pytest.mark.parametrize(("apart_mm", "is_doubtful"), [(0.5, False), (2.0, True)])
def test_readings_far_apart_are_a_warning(apart_mm: float, is_doubtful: bool) -> None:
    """Their large ± would otherwise let any lengths agree."""
    l1, l2, l3 = 5.0, 5.6, 5.2
    l1_readings = [l1 - apart_mm / 2, l1, l1 + apart_mm / 2]
    warnings = calibrate_laser(l1_readings, [l2] * 3, [l3] * 3).warnings
    assert any("l1_mm" in words and f"{apart_mm:.2g} mm" in words for words in warnings) == (
        is_doubtful
    )
