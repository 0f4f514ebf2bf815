"""Appendix I: the laser found again from the cross-hair it draws."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

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


def test_the_example_of_the_conventions() -> None:
    l1, l2, l3 = cross_hair(30.0, 90.0)
    assert (l3, l2) == pytest.approx((7.874, 18.561), abs=5e-4)
    found = calibrate_laser(l1, 18.561, 7.874)
    assert found.angle_deg == pytest.approx(30.0, abs=2e-3)
    assert found.distance_mm == pytest.approx(90.0, abs=2e-3)
    assert found.height_mm == pytest.approx(45.0, abs=4e-3)
    assert found.horizontal_mm == pytest.approx(90.0 * np.cos(np.pi / 6), abs=4e-3)
    assert found.warnings == ()
    assert found.laser.projection_angle_deg == found.angle_deg


@given(
    angle=st.floats(15.0, 80.0),
    distance=st.floats(20.0, 300.0),
    fan=st.floats(4.0, 20.0),
)
def test_any_laser_is_found_again(angle: float, distance: float, fan: float) -> None:
    l1, l2, l3 = cross_hair(angle, distance, fan)
    found = calibrate_laser(l1, l2, l3, fan)
    assert found.angle_deg == pytest.approx(angle, abs=1e-6)
    assert found.distance_mm == pytest.approx(distance, rel=1e-9)
    assert found.expected_l1_mm == pytest.approx(l1, rel=1e-9)
    assert found.warnings == ()


def test_a_square_beam_has_three_equal_lengths() -> None:
    assert cross_hair(90.0, 60.0) == pytest.approx(60.0 * np.tan(np.radians(5.0)))
    found = calibrate_laser(5.0, 5.0, 5.0)
    assert found.angle_deg == pytest.approx(90.0)
    assert found.distance_mm == pytest.approx(5.0 / np.tan(np.radians(5.0)))


def test_the_uncertainty_is_that_of_repeated_calibrations() -> None:
    rng = np.random.default_rng(7)
    truth = cross_hair(31.0, 60.0)
    settings = LaserCalibrationSettings(resolution_mm=1e-6)
    runs = [
        calibrate_laser(*(truth[:, None] + rng.normal(0.0, 0.08, (3, 8))), settings=settings)
        for _ in range(400)
    ]
    for value, sigma, true in [
        ("angle_deg", "angle_sigma_deg", 31.0),
        ("distance_mm", "distance_sigma_mm", 60.0),
        ("height_mm", "height_sigma_mm", 60.0 * np.sin(np.radians(31.0))),
        ("horizontal_mm", "horizontal_sigma_mm", 60.0 * np.cos(np.radians(31.0))),
    ]:
        errors = np.array([getattr(run, value) for run in runs]) - true
        published = np.array([getattr(run, sigma) for run in runs])
        assert errors.std() == pytest.approx(np.sqrt(np.mean(published**2)), rel=0.15)
        assert abs(errors.mean()) < 0.2 * errors.std()


def test_the_resolution_counts_for_a_single_reading() -> None:
    lengths = cross_hair(31.0, 60.0)
    coarse = calibrate_laser(*lengths, settings=LaserCalibrationSettings(resolution_mm=1.0))
    expected = 1.0 / np.sqrt(12.0) / np.tan(np.radians(5.0))
    assert coarse.distance_sigma_mm == pytest.approx(expected)


def test_the_fan_angle_counts() -> None:
    settings = LaserCalibrationSettings(resolution_mm=1e-9, fan_angle_sigma_deg=0.1)
    lengths = cross_hair(31.0, 60.0)
    found = calibrate_laser(*lengths, settings=settings)
    wider = calibrate_laser(*lengths, fan_angle_deg=10.01)
    narrower = calibrate_laser(*lengths, fan_angle_deg=9.99)
    slope = abs(wider.distance_mm - narrower.distance_mm) / 0.02
    assert found.distance_sigma_mm == pytest.approx(0.1 * slope, rel=1e-3)
    slope = abs(wider.angle_deg - narrower.angle_deg) / 0.02
    assert found.angle_sigma_deg == pytest.approx(0.1 * slope, rel=1e-3)


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
def test_contradictions_are_named(l1: float, l2: float, l3: float, fan: float, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        calibrate_laser(l1, l2, l3, fan)


def test_a_mild_disagreement_is_a_warning() -> None:
    l1, l2, l3 = cross_hair(31.0, 60.0)
    (warning,) = calibrate_laser(l1 + 0.25, l2, l3).warnings
    assert "l1_mm" in warning
    assert f"{l1:.4g}" in warning


def test_a_nearly_square_beam_is_measured_with_a_warning() -> None:
    found = calibrate_laser(5.0, 5.0, 5.03)
    assert found.angle_deg == pytest.approx(90.0)
    assert "l3_mm" in found.warnings[0]
