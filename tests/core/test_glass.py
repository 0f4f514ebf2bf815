"""The imaging plane's glass: forward, backward, and a pool measured through it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from labapp.core.geometry.optics import direction_to_dots, intersect_imaging_plane
from labapp.core.geometry.rig import DotPattern, Electrode, ImagingPlane, Laser, Rig
from labapp.core.pipeline import Settings, reconstruct
from labapp.core.surface.kernels import solver_kernels, spline_kernels
from labapp.core.surface.measures import measure_surface
from labapp.simulation.forward import exact_match, trace
from labapp.simulation.pools import egg

GLASS = {"glass_mm": 3.0, "glass_index": 1.52}
UPRIGHT = ImagingPlane.vertical(50.0, 45.0, 3.0)
TILTED = ImagingPlane.of_angles(UPRIGHT.origin_mm, (8.0, -5.0, 3.0))
RIG = Rig(Laser(31.14, 31.48), DotPattern(), Electrode(5.0), replace(UPRIGHT, **GLASS))
POOL = egg(6.6, 3.0, 4.2, 0.3)


@pytest.mark.parametrize("plane", [UPRIGHT, TILTED])
def test_glass_shifts_dots_as_the_twin_has_it(plane):
    rig = replace(RIG, imaging_plane=replace(plane, **GLASS))
    seen = trace(POOL, rig)
    points, ways = seen.point_mm[seen.hit], seen.reflected[seen.hit]
    made = intersect_imaging_plane(points, ways, rig.imaging_plane)
    np.testing.assert_allclose(made, seen.plane_mm[seen.hit], atol=1e-9)
    bare = intersect_imaging_plane(points, ways, plane)
    shift = np.linalg.norm(made - bare, axis=-1)
    assert 0.2 < np.nanmedian(shift) < 1.5


def test_a_ray_at_31_degrees_is_shifted_by_seven_tenths_of_a_millimetre():
    way = np.array([[0.0, -np.cos(np.radians(31.0)), np.sin(np.radians(31.0))]])
    made, bare = (
        intersect_imaging_plane(np.zeros((1, 3)), way, plane)
        for plane in (RIG.imaging_plane, UPRIGHT)
    )
    down = np.sin(np.radians(31.0)) / 1.52
    expected = 3.0 * (np.tan(np.radians(31.0)) - np.tan(np.arcsin(down)))
    np.testing.assert_allclose(bare - made, [[0.0, expected]], atol=1e-12)
    assert expected == pytest.approx(0.7, abs=0.05)


@pytest.mark.parametrize("glass_mm", [0.0, 3.0, 10.0])
@pytest.mark.parametrize("plane", [UPRIGHT, TILTED])
def test_the_direction_to_a_dot_leads_to_it(plane, glass_mm):
    plane = replace(plane, glass_mm=glass_mm, glass_index=1.52)
    rng = np.random.default_rng(3)
    points = rng.uniform([-3, -4, -0.3], [3, 4, 0.3], (50, 3))
    dots = rng.uniform(0.0, 100.0, (50, 2))
    ways = direction_to_dots(points, dots, plane)
    np.testing.assert_allclose(intersect_imaging_plane(points, ways, plane), dots, atol=1e-9)


def test_the_direction_straight_to_the_foot_is_the_normal():
    plane = RIG.imaging_plane
    foot = plane.from_universal(np.array([0.0, -50.0, 10.0]))
    way = direction_to_dots(np.array([0.0, 0.0, 10.0]), foot, plane)
    np.testing.assert_allclose(way, [0.0, -50.0, 0.0], atol=1e-9)


def test_the_loops_agree_with_the_vectors():
    plane = replace(TILTED, **GLASS)
    seen = trace(POOL, replace(RIG, imaging_plane=plane))
    points, ways = seen.point_mm[seen.visible], seen.incident[seen.visible]
    slopes = POOL.gradient(*points[:, :2].T)
    weights = np.tile(np.eye(2), (len(points), 1, 1))
    grid = np.array([[-6.0, 6.0, 1.0, 12.0], [-6.0, 6.0, 1.0, 12.0]])
    asked = (plane.to_universal(seen.plane_mm[seen.visible]),)
    # The slopes that the dots ask for are the pool's own: nothing is left to ask for.
    right = solver_kernels.gradient_rhs(
        grid, np.zeros(225), points, weights, RIG.laser.position_mm, plane.pose_mm, *asked
    )
    flat = spline_kernels.splines_at(grid, points)
    expected = np.zeros(225)
    for own, by_x, by_y, (x, y) in zip(flat[0], flat[1][1], flat[1][2], slopes, strict=True):
        np.add.at(expected, own, by_x * x + by_y * y)
    np.testing.assert_allclose(right, expected, atol=1e-8)
    assert len(ways) > 50


@pytest.mark.parametrize("scheme", ["fit", "ers"])
def test_a_pool_behind_glass_is_measured_as_without(scheme):
    settings = Settings(scheme=scheme)

    def height(true: Rig, believed: Rig) -> float:
        match = exact_match(trace(POOL, true), true)
        return measure_surface(reconstruct(match, believed, settings), match, believed).height_mm

    bare = replace(RIG, imaging_plane=UPRIGHT)
    plain, through = height(bare, bare), height(RIG, RIG)
    assert through == pytest.approx(plain, rel=0.01)
    assert abs(height(RIG, bare) / plain - 1) > 3 * abs(through / plain - 1)
