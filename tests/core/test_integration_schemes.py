"""Zonal and modal integration of slopes: exact where theory says so, near the truth on pools."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from labapp.core.pipeline import Settings, reconstruct
from labapp.core.schemes import modal, zonal
from labapp.core.schemes.slopes import reflected_rays
from labapp.core.surface.measures import measure_surface
from labapp.core.values import CannotMeasure
from labapp.simulation.forward import exact_match, trace
from labapp.simulation.pools import egg, spherical_cap
from labapp.studies.correspondence_table import OPEN_BENCH

POOLS = [spherical_cap(6.0, 0.3, (0.1, 0.05)), egg(6.4, 2.9, 3.8, 0.3, (0.0, -0.3))]


def match_of(pool):
    return exact_match(trace(pool, OPEN_BENCH))


def test_zonal_heights_of_a_quadric_are_exact():
    # Between two points of a quadric the height changes by the mean of their slopes.
    rays = reflected_rays(match_of(POOLS[0]), OPEN_BENCH)
    x, y = xy = rays.points(rays.distance_at(0.0))[:, :2].T
    height = 0.03 * x - 0.05 * x**2 + 0.02 * x * y - 0.03 * y**2
    gradient = np.stack([0.03 - 0.1 * x + 0.02 * y, 0.02 * x - 0.06 * y], axis=-1)
    heights = zonal.heights(rays, xy.T, gradient)
    np.testing.assert_allclose(heights - heights.mean(), height - height.mean(), atol=1e-9)


@pytest.mark.parametrize("order", [3, 4, 6])
def test_modal_heights_of_a_polynomial_are_exact(order: int):
    rng = np.random.default_rng(2)
    x, y = xy = rng.uniform(-3, 3, (2, 80))
    height = 0.01 * x**3 - 0.02 * x * y**2 + 0.1 * y
    gradient = np.stack([0.03 * x**2 - 0.02 * y**2, -0.04 * x * y + 0.1], axis=-1)
    heights = modal.heights(xy.T, gradient, order)
    np.testing.assert_allclose(heights - heights.mean(), height - height.mean(), atol=1e-9)


def test_modal_order_is_lower_with_few_points():
    # Nine points allow six polynomials, those up to order 2. A cubic is not among them.
    xy = np.stack(np.meshgrid([-1.0, 0.0, 1.0], [-1.0, 0.0, 1.0]), axis=-1).reshape(-1, 2)
    gradient = np.stack([3 * xy[:, 0] ** 2, 0 * xy[:, 1]], axis=-1)
    heights = modal.heights(xy, gradient, 6)
    assert np.abs(heights - heights.mean() - xy[:, 0] ** 3).max() > 0.1


@pytest.mark.parametrize("pool", POOLS, ids=["cap", "egg"])
@pytest.mark.parametrize("scheme", ["zonal", "modal"])
def test_surfaces_are_near_the_true_ones(scheme: str, pool):
    match = match_of(pool)
    reconstruction = reconstruct(match, OPEN_BENCH, Settings(scheme=scheme))
    assert reconstruction.scheme == scheme
    measures = measure_surface(reconstruction, match, OPEN_BENCH)
    assert measures.height_mm == pytest.approx(pool.size.height_mm, rel=0.04)
    true = pool.height(*reconstruction.points_mm[:, :2].T)
    assert np.abs(reconstruction.points_mm[:, 2] - true).max() < 0.03


@pytest.mark.parametrize("scheme", ["zonal", "modal"])
def test_few_dots_are_rejected(scheme: str):
    match = match_of(POOLS[0])
    few = replace(
        match,
        **{name: getattr(match, name)[:5] for name in ("ray", "dot", "plane_mm", "reflected")},
    )
    with pytest.raises(CannotMeasure, match="too-few-dots"):
        reconstruct(few, OPEN_BENCH, Settings(scheme=scheme))


@pytest.mark.parametrize(
    "settings",
    [
        Settings(scheme="zonal", zonal=zonal.ZonalSettings(boundary="circle")),
        Settings(scheme="modal", modal=modal.ModalSettings(boundary="circle")),
    ],
    ids=["zonal", "modal"],
)
def test_both_schemes_accept_a_circular_boundary(settings: Settings):
    boundary = reconstruct(match_of(POOLS[1]), OPEN_BENCH, settings).boundary
    radius = np.linalg.norm(boundary.points_mm[:, :2] - boundary.center_mm, axis=-1)
    np.testing.assert_allclose(radius, radius[0], atol=1e-9)
