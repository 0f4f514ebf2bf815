"""The imaging plane's glass: forward, backward, and a pool measured through it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from labapp.core.geometry.optics import direction_to_dots, intersect_imaging_plane
from labapp.core.geometry.rig import DotPattern, Electrode, ImagingPlane, Laser, Rig
from labapp.core.pipeline import Settings, reconstruct
from labapp.core.surface.kernels import solver_kernels
from labapp.core.surface.measures import measure_surface
from labapp.core.surface.spline import SplineBasis
from labapp.simulation.forward import exact_match, trace
from labapp.simulation.pools import egg

GLASS = {"glass_mm": 3.0, "glass_index": 1.52}
UPRIGHT = ImagingPlane.vertical(50.0, 45.0, 3.0)
TILTED = ImagingPlane.of_angles(UPRIGHT.origin_mm, (8.0, -5.0, 3.0))
RIG = Rig(Laser(31.14, 31.48), DotPattern(), Electrode(5.0), replace(UPRIGHT, **GLASS))
POOL = egg(6.6, 3.0, 4.2, 0.3)


@pytest.mark.parametrize("plane", [UPRIGHT, TILTED])
def test_glass_shift_agrees_with_the_simulation(plane):
    rig = replace(RIG, imaging_plane=replace(plane, **GLASS))
    reflections = trace(POOL, rig)
    points, directions = (
        reflections.point_mm[reflections.hit],
        reflections.reflected[reflections.hit],
    )
    dots = intersect_imaging_plane(points, directions, rig.imaging_plane)
    np.testing.assert_allclose(dots, reflections.plane_mm[reflections.hit], atol=1e-9)
    bare_dots = intersect_imaging_plane(points, directions, plane)
    shift = np.linalg.norm(dots - bare_dots, axis=-1)
    assert 0.2 < np.nanmedian(shift) < 1.5


def test_ray_at_31_degrees_is_shifted_by_0_7_mm():
    way = np.array([[0.0, -np.cos(np.radians(31.0)), np.sin(np.radians(31.0))]])
    shifted, bare = (
        intersect_imaging_plane(np.zeros((1, 3)), way, plane)
        for plane in (RIG.imaging_plane, UPRIGHT)
    )
    sin_refracted = np.sin(np.radians(31.0)) / 1.52
    expected = 3.0 * (np.tan(np.radians(31.0)) - np.tan(np.arcsin(sin_refracted)))
    np.testing.assert_allclose(bare - shifted, [[0.0, expected]], atol=1e-12)
    assert expected == pytest.approx(0.7, abs=0.05)


@pytest.mark.parametrize("glass_mm", [0.0, 3.0, 10.0])
@pytest.mark.parametrize("plane", [UPRIGHT, TILTED])
def test_direction_to_dots_inverts_the_intersection(plane, glass_mm):
    plane = replace(plane, glass_mm=glass_mm, glass_index=1.52)
    rng = np.random.default_rng(3)
    points = rng.uniform([-3, -4, -0.3], [3, 4, 0.3], (50, 3))
    dots = rng.uniform(0.0, 100.0, (50, 2))
    directions = direction_to_dots(points, dots, plane)
    np.testing.assert_allclose(intersect_imaging_plane(points, directions, plane), dots, atol=1e-9)


def test_direction_to_the_foot_point_is_the_normal():
    plane = RIG.imaging_plane
    foot = plane.from_universal(np.array([0.0, -50.0, 10.0]))
    way = direction_to_dots(np.array([0.0, 0.0, 10.0]), foot, plane)
    np.testing.assert_allclose(way, [0.0, -50.0, 0.0], atol=1e-9)


def test_kernels_agree_with_numpy():
    plane = replace(TILTED, **GLASS)
    reflections = trace(POOL, replace(RIG, imaging_plane=plane))
    points, incident = (
        reflections.point_mm[reflections.visible],
        reflections.incident[reflections.visible],
    )
    slopes = POOL.gradient(*points[:, :2].T)
    weights = np.tile(np.eye(2), (len(points), 1, 1))
    basis = SplineBasis.over(np.full(2, -6.0), np.full(2, 6.0), 1.0)
    dots_mm = (plane.to_universal(reflections.plane_mm[reflections.visible]),)
    # The slopes that the dots imply are those of the pool.
    right_side = solver_kernels.gradient_rhs(
        basis.grid, np.zeros(225), points, weights, RIG.laser.position_mm, plane.pose_mm, *dots_mm
    )
    cells = basis.cells(*points[:, :2].T)
    _, *by_slope = cells.value_and_slopes()
    expected = np.zeros(225)
    for spline, by_x, by_y, (x, y) in zip(cells.splines, *by_slope, slopes, strict=True):
        np.add.at(expected, spline, by_x * x + by_y * y)
    np.testing.assert_allclose(right_side, expected, atol=1e-8)
    assert len(incident) > 50


@pytest.mark.parametrize("scheme", ["fit", "ers"])
def test_pool_is_measured_through_glass_as_without(scheme):
    settings = Settings(scheme=scheme)

    def height(true: Rig, believed: Rig) -> float:
        match = exact_match(trace(POOL, true))
        return measure_surface(reconstruct(match, believed, settings), match, believed).height_mm

    bare = replace(RIG, imaging_plane=UPRIGHT)
    without_glass, with_glass = height(bare, bare), height(RIG, RIG)
    assert with_glass == pytest.approx(without_glass, rel=0.01)
    assert abs(height(RIG, bare) / without_glass - 1) > 3 * abs(with_glass / without_glass - 1)
