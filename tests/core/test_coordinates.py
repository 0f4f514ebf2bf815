"""Image ↔ imaging plane: the three-point calibration and the homography."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from labapp.core.geometry.coordinates import ImageCalibration, Lens

pixels = st.tuples(st.floats(0.0, 640.0), st.floats(0.0, 480.0)).map(np.array)


@st.composite
def calibrations(draw):
    """Draw calibrations with roll, unequal scales along the axes and slight perspective."""
    roll, scale_x, scale_z = (
        draw(st.floats(-0.3, 0.3)),
        *draw(st.tuples(st.floats(0.05, 0.5), st.floats(0.05, 0.5))),
    )
    tilt = draw(st.tuples(st.floats(-2e-4, 2e-4), st.floats(-2e-4, 2e-4)))
    matrix = np.array(
        [
            [scale_x * np.cos(roll), -scale_x * np.sin(roll), -5.0],
            [-scale_z * np.sin(roll), -scale_z * np.cos(roll), 90.0],
            [*tilt, 1.0],
        ]
    )
    return ImageCalibration(matrix)


@given(calibrations(), pixels)
def test_to_image_inverts_to_plane(calibration, pixel):
    plane_mm = calibration.to_plane(pixel)
    np.testing.assert_allclose(calibration.to_image(plane_mm), pixel, atol=1e-6)


@given(calibrations(), pixels)
def test_jacobian_agrees_with_central_differences(calibration, pixel):
    step = 1e-3
    quotient = np.stack(
        [
            (calibration.to_plane(pixel + d) - calibration.to_plane(pixel - d)) / (2 * step)
            for d in np.eye(2) * step
        ],
        axis=-1,
    )
    np.testing.assert_allclose(calibration.jacobian(pixel), quotient, rtol=1e-4, atol=1e-7)


def test_calibration_reproduces_its_three_points():
    calibration = ImageCalibration.from_three_points(
        (44.0, 590.0), (440.0, 585.0), 69.85, (50.0, 410.0), 31.75
    )
    points = np.array([[44.0, 590.0], [440.0, 585.0], [50.0, 410.0]])
    expected = [[0.0, 0.0], [69.85, 0.0], [0.0, 31.75]]
    np.testing.assert_allclose(calibration.to_plane(points), expected, atol=1e-9)


def test_skewed_axes_as_in_eq_4_7_to_4_13():
    # Skewed axes; P is 2 units of X' and 3 of Z' from O', by construction.
    origin, unit_x, unit_z = np.array([40.0, 590.0]), np.array([5.5, 0.2]), np.array([0.3, -5.7])
    calibration = ImageCalibration.from_three_points(
        tuple(origin), tuple(origin + 70 * unit_x), 70.0, tuple(origin + 30 * unit_z), 30.0
    )
    point = origin + 2 * unit_x + 3 * unit_z
    np.testing.assert_allclose(calibration.to_plane(point), [2.0, 3.0], atol=1e-9)


def test_degenerate_calibrations_are_rejected():
    with pytest.raises(ValueError, match="one line"):
        ImageCalibration.from_three_points((0, 0), (10, 10), 1.0, (20, 20), 2.0)
    with pytest.raises(ValueError, match="inverted"):
        ImageCalibration(np.ones((3, 3)))
    with pytest.raises(ValueError, match="3 × 3"):
        ImageCalibration(np.eye(2))


def test_calibration_is_read_only():
    with pytest.raises(ValueError, match="read-only"):
        ImageCalibration(np.eye(3)).matrix[0, 0] = 2.0


LENS = Lens((1500.0, 1490.0), (310.0, 250.0), (-0.12, 0.03, 1e-3, -2e-3, 0.01))


def test_lens_distortion_agrees_with_opencv():
    places = np.random.default_rng(3).uniform(0.0, 640.0, (50, 2))
    normalized = (places - LENS.center_px) / LENS.focal_px
    camera = np.array([[1500.0, 0.0, 310.0], [0.0, 1490.0, 250.0], [0.0, 0.0, 1.0]])
    points = np.column_stack([normalized, np.ones(50)])
    expected, _ = cv2.projectPoints(
        points, np.zeros(3), np.zeros(3), camera, np.array(LENS.distortion)
    )
    np.testing.assert_allclose(LENS.distorted(places), expected[:, 0], atol=1e-9)
    assert np.abs(LENS.distorted(places) - places).max() > 1.0
    np.testing.assert_allclose(LENS.ideal(LENS.distorted(places)), places, atol=1e-5)
    assert LENS.ideal(np.empty((0, 2))).shape == (0, 2)


def test_calibration_from_a_distorted_picture_is_correct():
    plane = np.random.default_rng(4).uniform(0.0, 100.0, (40, 2))
    ideal = ImageCalibration.from_three_points((44, 590), (440, 590), 69.85, (44, 410), 31.75)
    reference_px = LENS.distorted(ideal.to_image(np.array([[0, 0], [69.85, 0], [0, 31.75]])))
    calibration = ImageCalibration.from_three_points(
        reference_px[0], reference_px[1], 69.85, reference_px[2], 31.75, LENS
    )
    image_px = LENS.distorted(ideal.to_image(plane))
    np.testing.assert_allclose(calibration.to_plane(image_px), plane, atol=1e-5)
    np.testing.assert_allclose(calibration.to_image(plane), image_px, atol=1e-5)
