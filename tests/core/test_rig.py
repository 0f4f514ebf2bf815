"""The rig: position of the laser, absent rays, pose of the imaging plane."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from labapp.core.geometry.rig import DotPattern, ImagingPlane, Laser

angles = st.floats(-np.pi, np.pi)
lengths = st.floats(-100.0, 100.0)


@given(st.floats(5.0, 85.0), st.floats(10.0, 100.0))
def test_laser_position_has_its_distance_and_elevation(angle, distance):
    x, y, z = Laser(angle, distance).position_mm
    assert x == 0
    assert np.hypot(y, z) == pytest.approx(distance)
    assert np.degrees(np.arctan2(z, y)) == pytest.approx(angle)


def test_absent_ray_is_the_centre_unless_others_are_named():
    assert DotPattern().absent_rays == {(10, 10)}
    assert DotPattern(39, 39, 0.385).center_ray == (20, 20)
    named = DotPattern(absent=frozenset({(3, 4)}))
    assert named.absent_rays == {(3, 4)}
    assert named.center_ray == (10, 10)


@given(angles, angles, angles, st.tuples(lengths, lengths), st.tuples(lengths, lengths, lengths))
def test_coordinates_round_trip_for_any_plane_pose(yaw, pitch, roll, dot, origin):
    turn = np.eye(3)
    for axis, angle in enumerate((yaw, pitch, roll)):
        a, b = [k for k in range(3) if k != axis]
        step = np.eye(3)
        step[a, a] = step[b, b] = np.cos(angle)
        step[a, b], step[b, a] = -np.sin(angle), np.sin(angle)
        turn = turn @ step
    plane = ImagingPlane(np.array(origin), turn[:, 0], turn[:, 2])
    point = plane.to_universal(np.array(dot))
    np.testing.assert_allclose(plane.from_universal(point), dot, atol=1e-9)
    assert (point - plane.origin_mm) @ plane.normal == pytest.approx(0.0, abs=1e-9)


def test_vertical_plane_agrees_with_eq_4_5():
    plane = ImagingPlane.vertical(50.0, s_mm=45.0, h_mm=3.0)
    np.testing.assert_allclose(plane.to_universal(np.array([50.0, 20.0])), [5.0, -50.0, 23.0])
    np.testing.assert_allclose(plane.normal, [0.0, -1.0, 0.0])


@given(*[st.floats(-40.0, 40.0)] * 3)
def test_plane_angles_round_trip(pitch, yaw, roll):
    plane = ImagingPlane.of_angles(np.array([-45.0, -50.0, 3.0]), (pitch, yaw, roll))
    assert plane.angles_deg == pytest.approx((pitch, yaw, roll), abs=1e-9)
    assert plane.normal[1] < 0
    assert np.vecdot(plane.x_axis, plane.z_axis) == pytest.approx(0, abs=1e-12)


def test_sign_of_each_plane_angle():
    upright = np.zeros(3)
    assert ImagingPlane.of_angles(upright, (5.0, 0.0, 0.0)).z_axis[1] < 0
    assert ImagingPlane.of_angles(upright, (0.0, 5.0, 0.0)).x_axis[1] > 0
    assert ImagingPlane.of_angles(upright, (0.0, 0.0, 5.0)).x_axis[2] > 0


def test_laser_position_is_relative_to_its_aim():
    laser = Laser(30.0, 40.0, azimuth_deg=10.0, aim_x_mm=0.5, aim_y_mm=-0.25)
    x, y, z = laser.position_mm - [0.5, -0.25, 0.0]
    assert np.hypot(np.hypot(x, y), z) == pytest.approx(40.0)
    assert np.degrees(np.arctan2(z, np.hypot(x, y))) == pytest.approx(30.0)
    assert np.degrees(np.arctan2(-x, y)) == pytest.approx(10.0)
    np.testing.assert_allclose(laser.position_mm + 40.0 * laser.axes[0], [0.5, -0.25, 0.0])
