"""The reflection law, the rays of the pattern, and their intersections with planes."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from labapp.core.geometry.optics import (
    bisecting_gradient,
    intersect_imaging_plane,
    intersect_level,
    ray_directions,
    reflect,
    surface_normal,
)
from labapp.core.geometry.rig import DotPattern, ImagingPlane, Laser

slopes = st.tuples(st.floats(-1.0, 1.0), st.floats(-1.0, 1.0)).map(np.array)
elevations = st.floats(10.0, 80.0)
sideways = st.floats(-30.0, 30.0)


def falling(elevation_deg: float, side_deg: float) -> np.ndarray:
    """Return the direction of a ray falling from +Y."""
    down, side = np.radians([elevation_deg, side_deg])
    return np.array([np.cos(down) * np.sin(side), -np.cos(down) * np.cos(side), -np.sin(down)])


@given(elevations, sideways, slopes)
def test_reflecting_twice_is_the_identity(elevation, side, gradient):
    ray, normal = falling(elevation, side), surface_normal(gradient)
    reflected = reflect(ray, normal)
    assert np.linalg.norm(reflected) == pytest.approx(1.0)
    assert reflected @ normal == pytest.approx(-(ray @ normal))
    np.testing.assert_allclose(reflect(reflected, normal), ray, atol=1e-12)


@given(elevations, sideways, slopes)
def test_bisecting_gradient_is_that_of_the_mirror(elevation, side, gradient):
    ray, normal = falling(elevation, side), surface_normal(gradient)
    if ray @ normal > -0.05:  # the ray does not meet the upper side of the mirror
        return
    reflected = 3.7 * reflect(ray, normal)  # its length must not matter
    np.testing.assert_allclose(bisecting_gradient(ray, reflected), gradient, atol=1e-9)


def test_flat_mirror_reverses_only_z():
    ray = falling(30.0, 10.0)
    np.testing.assert_allclose(reflect(ray, np.array([0.0, 0.0, 1.0])), ray * [1, 1, -1])


def test_beam_axis_meets_the_origin_and_rays_are_beta_apart():
    laser = Laser(31.14, 31.48)
    direction = ray_directions(laser, DotPattern())
    np.testing.assert_allclose(np.linalg.norm(direction, axis=-1), 1.0)
    np.testing.assert_allclose(intersect_level(laser.position_mm, direction[9, 9]), 0.0, atol=1e-12)
    for neighbour in (direction[9, 10], direction[10, 9]):
        angle = np.degrees(np.arccos(direction[9, 9] @ neighbour))
        assert angle == pytest.approx(0.77, abs=1e-6)


def test_rows_grow_towards_the_head_and_columns_with_x():
    laser = Laser(31.14, 31.48)
    landing = intersect_level(laser.position_mm, ray_directions(laser, DotPattern()))
    assert (np.diff(landing[..., 1], axis=0) > 0).all()
    assert (np.diff(landing[..., 0], axis=1) > 0).all()


def test_reflected_ray_meets_the_plane_at_the_expected_dot():
    # From (0, 0, 0) at 30° elevation towards −Y: after 50 mm it is 50·tan 30° high.
    plane = ImagingPlane.vertical(50.0, s_mm=45.0, h_mm=3.0)
    direction = np.array([0.0, -np.cos(np.radians(30)), np.sin(np.radians(30))])
    dot = intersect_imaging_plane(np.zeros(3), direction, plane)
    np.testing.assert_allclose(dot, [45.0, 50 * np.tan(np.radians(30)) - 3.0])


def test_ray_away_from_or_along_the_plane_never_meets_it():
    plane = ImagingPlane.vertical(50.0, s_mm=45.0, h_mm=3.0)
    for direction in ([0.0, 1.0, 1.0], [1.0, 0.0, 1.0]):
        assert np.isnan(intersect_imaging_plane(np.zeros(3), np.array(direction), plane)).all()


@given(st.floats(-2.0, 2.0), elevations, sideways)
def test_intersection_with_a_level_is_at_that_level(level, elevation, side):
    point = intersect_level(np.array([1.0, 20.0, 30.0]), falling(elevation, side), level)
    assert point[2] == pytest.approx(level)
