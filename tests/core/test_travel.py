"""Welding towards −Y: head and rear of the pool are exchanged."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from labapp.core.geometry.rig import DotPattern, Electrode, ImagingPlane, Laser, Rig
from labapp.core.pipeline import Settings, reconstruct
from labapp.core.schemes import ers
from labapp.core.surface.boundary import EdgePoints, piecewise
from labapp.core.surface.measures import measure_surface
from labapp.simulation.forward import exact_match, trace
from labapp.simulation.pools import Footprint, LowRear, Pool, egg
from tests.levels import find_level

RIG = Rig(Laser(31.14, 31.48), DotPattern(), Electrode(5.0), ImagingPlane.vertical(50, 45, 3))
BACK = replace(RIG, travel="-y")


def test_simulation_mirrors_a_low_rear():
    forward = egg(7, 3, 4.4, 0.3, terms=(LowRear(0.08),))
    backward = Pool(Footprint(7, 4.4, 3), 0.3, (LowRear(0.08, towards=1),))
    rng = np.random.default_rng(1)
    x, y = rng.uniform(-3, 3, 200), rng.uniform(-4, 4, 200)
    np.testing.assert_allclose(backward.height(x, -y), forward.height(x, y), atol=1e-12)
    mirrored = forward.gradient(x, y) * [1, -1]
    np.testing.assert_allclose(backward.gradient(x, -y), mirrored, atol=1e-12)


def test_level_of_a_mirrored_pool_is_mirrored():
    rng = np.random.default_rng(2)
    x, y = (part.ravel() for part in np.meshgrid(np.arange(-4, 4.1, 0.4), np.arange(-6, 6.1, 0.8)))
    height = 0.3 - 0.02 * (x**2 + y**2)
    slope = -0.04 * np.stack([x, y], axis=-1)
    # The boundary is 0.08 mm lower at the rear end, y = −4.5.
    rim = -0.08 * np.maximum(-y / 4.5, 0) ** 2
    ray_states = np.where(height + rng.normal(0, 1e-3, len(x)) > rim, 1, -1)
    spacing = np.array([0.4, 0.8])
    exact = np.stack([height, 0 * height])
    forward = find_level(exact, slope, y, ray_states, spacing)
    backward = find_level(exact, slope * [1, -1], -y, ray_states, spacing, (-1, None))
    assert forward.rear.drop_mm > 0.03
    assert backward.shift_mm == pytest.approx(forward.shift_mm)
    assert backward.rear.drop_mm == pytest.approx(forward.rear.drop_mm)
    assert (backward.rear.start_mm, backward.rear.end_mm) == pytest.approx(
        (-forward.rear.start_mm, -forward.rear.end_mm)
    )
    np.testing.assert_allclose(backward.rear.height(-y), forward.rear.height(y), atol=1e-12)


def test_boundary_model_of_mirrored_rows_is_mirrored():
    y = np.linspace(-3.6, 2.6, 11)
    half = 3.0 * np.sqrt(1 - (y / np.where(y > 0, 3.0, 4.2)) ** 2)
    right = np.stack([half, y], axis=-1)
    steps = np.rint(half / 0.4).astype(int) * 2
    forward = piecewise(EdgePoints(right * [-0.9, 1], right, steps))
    backward = piecewise(EdgePoints(right * [-0.9, -1], right * [1, -1], steps), head_sign=-1)
    np.testing.assert_allclose(backward.center_mm, forward.center_mm * [1, -1], atol=1e-12)
    mirrored = np.roll(forward.points_mm[::-1], 1, axis=0) * [1, -1, 1]
    np.testing.assert_allclose(backward.points_mm, mirrored, atol=1e-9)


def test_base_point_of_ers_is_at_the_head():
    match = exact_match(trace(egg(6.5, 3.0, 4.2, 0.3), RIG))
    rays = match.ray
    front, back = rays[ers.head_left(rays, 1)], rays[ers.head_left(rays, -1)]
    assert front[0] == rays[:, 0].max()
    assert back[0] == rays[:, 0].min()
    for base in (front, back):
        assert base[1] == rays[rays[:, 0] == base[0], 1].min()


def test_low_rear_towards_the_laser_is_measured():
    pool = Pool(Footprint(6.6, 4.2, 3.0), 0.3, (LowRear(0.1, towards=1),))
    match = exact_match(trace(pool, BACK))
    measures = {}
    for rig in (BACK, RIG):
        reconstruction = reconstruct(match, rig, Settings())
        measures[rig.travel] = measure_surface(reconstruction, match, rig)
    true = pool.size
    error = {travel: abs(measures[travel].length_mm - true.length_mm) for travel in measures}
    assert error["-y"] < 0.35
    assert abs(measures["-y"].height_mm - true.height_mm) < 0.02
    assert measures["-y"].depth_mm < -0.02 < measures["+y"].depth_mm
    assert np.isnan(measures["-y"].depth_sigma_mm)  # the shape of the rear is assumed
    assert measures["-y"].height_sigma_mm > 0.0
