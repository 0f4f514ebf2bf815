"""Intersections of rays and surfaces, and the two surfaces through scattered points."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from labapp.core.geometry.optics import intersect_level, ray_directions
from labapp.core.geometry.rig import DotPattern, Laser
from labapp.core.surface.boundary import Boundary
from labapp.core.surface.interpolation import CloughTocherSurface, ThinPlateSurface, whole_surface
from labapp.core.surface.surface import FlatSurface, intersect
from labapp.core.values import CannotMeasure
from labapp.simulation.pools import spherical_cap

LASER = Laser(31.14, 31.48)
RAYS = ray_directions(LASER, DotPattern()).reshape(-1, 3)


def scattered(seed: int = 3, count: int = 80) -> np.ndarray:
    """Return (x, y) of random points in a square of 6 mm."""
    return np.random.default_rng(seed).uniform(-3.0, 3.0, (count, 2))


@given(st.floats(-1.5, 1.5))
def test_intersection_with_a_level_agrees_with_the_formula(level):
    points = intersect(FlatSurface(level), LASER.position_mm, RAYS)
    np.testing.assert_allclose(points, intersect_level(LASER.position_mm, RAYS, level), atol=1e-8)


@given(st.floats(5.0, 8.0), st.floats(-0.12, 0.12))
def test_intersection_with_a_sphere_agrees_with_the_formula(diameter, share):
    if abs(share) < 0.01:
        return
    peak = diameter * share
    points = intersect(spherical_cap(diameter, peak), LASER.position_mm, RAYS)
    radius = (diameter**2 / 4 + peak**2) / (2 * abs(peak))
    centre = np.array([0.0, 0.0, peak - np.sign(peak) * radius])
    # |L + s·d − C| = R: the root on the pool's side.
    b = RAYS @ (LASER.position_mm - centre)
    c = np.sum((LASER.position_mm - centre) ** 2) - radius**2
    root = np.sqrt(np.maximum(b * b - c, 0))
    exact = LASER.position_mm + (-b - np.sign(peak) * root)[:, None] * RAYS
    inside = np.hypot(exact[:, 0], exact[:, 1]) < diameter / 2 * (1 - 1e-9)
    inside &= b * b > c
    np.testing.assert_allclose(points[inside], exact[inside], atol=1e-6)
    outside = np.hypot(exact[:, 0], exact[:, 1]) > diameter / 2 * (1 + 1e-6)
    assert np.isnan(points[outside | (b * b < c)]).all()


def test_ray_landing_outside_the_domain_is_intersected_inside():
    # It lands outside the hull on z = 0, but meets the raised surface within it.
    x, y = np.meshgrid([-1.0, 0.0, 1.0], [-1.0, 0.0, 1.0])
    plateau = CloughTocherSurface(np.column_stack([x.ravel(), y.ravel(), np.full(9, 0.8)]))
    target = np.array([0.2, -0.5, 0.8])
    direction = target - LASER.position_mm
    landing = intersect_level(LASER.position_mm, direction)
    assert np.isnan(plateau.height(landing[0], landing[1]))
    np.testing.assert_allclose(
        intersect(plateau, LASER.position_mm, direction[None])[0], target, atol=1e-6
    )


def test_rays_that_miss_or_rise_give_nan_points():
    upward = np.array([[0.0, -1.0, 0.2], [0.0, -1.0, 0.0]])
    assert np.isnan(intersect(FlatSurface(), LASER.position_mm, upward)).all()
    assert np.isnan(intersect(FlatSurface(-5.0), LASER.position_mm, RAYS[:3])).all()
    beside = np.array([[1.0, -1.0, -1.0]])
    assert np.isnan(intersect(spherical_cap(6.0, 0.3), LASER.position_mm, beside)).all()
    assert intersect(FlatSurface(), LASER.position_mm, np.empty((0, 3))).shape == (0, 3)


@pytest.mark.parametrize("surface", [CloughTocherSurface, ThinPlateSurface])
def test_surfaces_interpolate_their_points(surface):
    xy = scattered()
    z = np.sin(xy[:, 0]) * np.cos(xy[:, 1])
    np.testing.assert_allclose(surface(np.column_stack([xy, z])).height(*xy.T), z, atol=1e-9)


@pytest.mark.parametrize("surface", [CloughTocherSurface, ThinPlateSurface])
def test_surfaces_reproduce_a_plane(surface):
    xy = scattered()
    plane = surface(np.column_stack([xy, 0.3 + xy @ [0.2, -0.1]]))
    points = 0.5 * scattered(seed=4)
    np.testing.assert_allclose(plane.height(*points.T), 0.3 + points @ [0.2, -0.1], atol=1e-6)
    np.testing.assert_allclose(
        plane.gradient(*points.T), np.tile([0.2, -0.1], (len(points), 1)), atol=1e-5
    )
    np.testing.assert_allclose(plane.point_gradient[:, 0], 0.2, atol=1e-5)


@pytest.mark.parametrize("surface", [CloughTocherSurface, ThinPlateSurface])
def test_gradient_agrees_with_central_differences(surface):
    xy = scattered()
    curved = surface(np.column_stack([xy, 0.05 * (xy**2).sum(axis=1)]))
    x, y = (0.5 * scattered(seed=5)).T
    h = 1e-5
    np.testing.assert_allclose(
        curved.gradient(x, y),
        np.stack(
            [
                (curved.height(x + h, y) - curved.height(x - h, y)) / (2 * h),
                (curved.height(x, y + h) - curved.height(x, y - h)) / (2 * h),
            ],
            axis=-1,
        ),
        atol=5e-4,
    )
    assert curved.gradient(x[:4].reshape(2, 2), y[:4].reshape(2, 2)).shape == (2, 2, 2)


def test_only_the_thin_plate_surface_extrapolates():
    xy = scattered()
    points = np.column_stack([xy, 0.05 * (xy**2).sum(axis=1)])
    assert np.isnan(CloughTocherSurface(points).height(np.array(5.0), np.array(0.0)))
    beyond = ThinPlateSurface(points).height(np.array(3.4), np.array(0.0))
    assert beyond == pytest.approx(0.05 * 3.4**2, rel=0.1)


@pytest.mark.parametrize("surface", [CloughTocherSurface, ThinPlateSurface])
def test_collinear_points_raise_no_surface(surface):
    line = np.column_stack([np.arange(9.0), np.arange(9.0), np.zeros(9)])
    with pytest.raises(CannotMeasure, match="no-surface"):
        surface(line)


def test_points_at_the_boundary_do_not_cause_a_cliff():
    boundary = Boundary.polar(np.zeros(2), np.full(360, 3.0))
    xy = np.array([[0.0, 0.0], [1.0, 0.5], [-1.0, 1.0], [0.5, -1.5], [2.99, 0.0], [3.2, 0.5]])
    z = np.array([0.3, 0.3, 0.3, 0.2, 5.0, 5.0])
    surface = whole_surface(np.column_stack([xy, z]), boundary)
    x, y = np.meshgrid(np.linspace(-2.9, 2.9, 60), np.linspace(-2.9, 2.9, 60))
    assert np.nanmax(surface.height(x, y)) < 0.5
    np.testing.assert_allclose(surface.height(*xy[:4].T), z[:4], atol=1e-9)
    with pytest.raises(CannotMeasure, match="no-surface"):
        whole_surface(np.column_stack([xy, z])[4:], boundary)
