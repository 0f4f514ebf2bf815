"""Boundary models on z = 0, from the ends of the rows."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from labapp.core.geometry.optics import intersect_level, ray_directions
from labapp.core.geometry.rig import DotPattern, Electrode, ImagingPlane, Laser, Rig
from labapp.core.surface.boundary import (
    Boundary,
    EdgePoints,
    boundary_on_work_piece,
    circle,
    edge_points,
    piecewise,
)
from labapp.core.values import CannotMeasure
from labapp.simulation.forward import exact_match, trace
from labapp.simulation.pools import egg, spherical_cap

RIG = Rig(
    Laser(31.14, 31.48),
    DotPattern(),
    Electrode(1e9),
    ImagingPlane.vertical(50.0, 1e4, -1e4, 2e4, 2e4),
)


def match_of(pool):
    return exact_match(trace(pool, RIG))


def edges_of(radius_at, rows, center=(0.0, 0.0)):
    """Return edge points where rows y = const cross a polar curve r(θ), θ from +X to +Y."""
    theta = np.radians(np.arange(0.0, 360.0, 0.01))
    radius = radius_at(theta)
    x, y = center[0] + radius * np.cos(theta), center[1] + radius * np.sin(theta)
    left, right = [], []
    for row in rows:
        for side, points in ((x < center[0], left), (x >= center[0], right)):
            nearest = np.argmin(np.where(side, np.abs(y - row), np.inf))
            points.append((x[nearest], y[nearest]))
    left, right = np.array(left), np.array(right)
    return EdgePoints(left, right, np.round((right - left)[:, 0] / 0.4).astype(int))


def radius_of(boundary):
    return np.linalg.norm(boundary.points_mm[:, :2] - boundary.center_mm, axis=-1)


def test_edge_points_are_midway_between_last_lit_ray_and_next():
    match = match_of(spherical_cap(6.5, 0.4))
    edges = edge_points(match, RIG)
    landing = intersect_level(RIG.laser.position_mm, ray_directions(RIG.laser, RIG.pattern))[
        ..., :2
    ]
    row = 10
    lit = match.ray[match.ray[:, 0] == row, 1]
    k = list(np.unique(match.ray[:, 0])).index(row)
    expected = (landing[row - 1, lit.max() - 1] + landing[row - 1, lit.max()]) / 2
    np.testing.assert_allclose(edges.right_mm[k], expected)
    expected = (landing[row - 1, lit.min() - 1] + landing[row - 1, lit.min() - 2]) / 2
    np.testing.assert_allclose(edges.left_mm[k], expected)


def test_pool_wider_than_the_pattern_ends_half_a_step_beyond_it():
    match = match_of(spherical_cap(14.0, 0.4))
    edges = edge_points(match, RIG)
    landing = intersect_level(RIG.laser.position_mm, ray_directions(RIG.laser, RIG.pattern))[
        ..., :2
    ]
    full_rows = [i for i in range(19) if (match.ray[:, 0] == i + 1).sum() == 19]
    assert full_rows
    step = landing[full_rows[0], 18] - landing[full_rows[0], 17]
    k = list(np.unique(match.ray[:, 0])).index(full_rows[0] + 1)
    np.testing.assert_allclose(edges.right_mm[k], landing[full_rows[0], 18] + step / 2, atol=0.01)


def test_rows_whose_end_ray_is_in_an_unknown_state_are_skipped():
    match = match_of(spherical_cap(6.5, 0.4))
    row = 11
    last = match.ray[match.ray[:, 0] == row, 1].max()
    ray_states = match.ray_states.copy()
    ray_states[row - 1, last] = 0
    y = edge_points(match, RIG).left_mm[:, 1]
    remaining = edge_points(replace(match, ray_states=ray_states), RIG).left_mm[:, 1]
    assert len(remaining) == len(y) - 1
    assert set(np.round(remaining, 9)) < set(np.round(y, 9))
    # They are used if no others are left.
    unknown = edge_points(replace(match, ray_states=np.zeros_like(ray_states)), RIG)
    assert len(unknown.left_mm) == len(y)


@given(st.floats(2.0, 5.0), st.tuples(st.floats(-0.5, 0.5), st.floats(-0.5, 0.5)), st.booleans())
def test_both_models_reproduce_a_circle(radius, center, by_pieces):
    rows = center[1] + np.array([-0.8, -0.6, -0.4, -0.2, 0.0, 0.2, 0.4, 0.6, 0.8]) * radius
    edges = edges_of(lambda theta: np.full(theta.shape, radius), rows, center)
    boundary = piecewise(edges) if by_pieces else circle(edges)
    np.testing.assert_allclose(boundary.center_mm, center, atol=1e-2)
    np.testing.assert_allclose(radius_of(boundary), radius, rtol=1e-2)
    assert (boundary.points_mm[:, 2] == 0).all()


def test_points_go_round_once_counter_clockwise():
    boundary = boundary_on_work_piece(match_of(egg(6.5, 2.8, 4.2, 0.4)), RIG, "piecewise")
    assert len(boundary.theta_deg) == len(boundary.points_mm) == 360
    assert boundary.theta_deg[0] == -180
    assert (np.diff(boundary.theta_deg) > 0).all()
    offset = boundary.points_mm[:, :2] - boundary.center_mm
    angle = np.degrees(np.arctan2(offset[:, 1], offset[:, 0]))
    np.testing.assert_allclose((angle - boundary.theta_deg + 180) % 360 - 180, 0, atol=1e-9)


def test_piecewise_model_follows_an_egg_without_steps():
    # The head at +Y is blunt, the rear at −Y is long; the ends of the pieces are difficult.
    def radius_at(theta):
        return 3.3 - 0.5 * np.sin(theta) + 0.1 * np.cos(2 * theta)

    rows = np.linspace(-3.2, 2.4, 9)
    boundary = piecewise(edges_of(radius_at, rows))
    offset = boundary.points_mm[:, :2]
    theta = np.arctan2(offset[:, 1], offset[:, 0])
    # The boundary's centre is the middle of the longest row: compare curves, not radii.
    error = np.abs(np.linalg.norm(offset, axis=-1) - radius_at(theta))
    between = (offset[:, 1] > rows[0]) & (offset[:, 1] < rows[-1])
    assert error[between].max() < 0.06
    assert error.max() < 0.15  # rear and head beyond the last rows are extrapolated
    step = np.abs(np.diff(radius_of(boundary), append=radius_of(boundary)[0]))
    assert step.max() < 0.06


def test_head_and_rear_are_not_mixed_up():
    boundary = boundary_on_work_piece(match_of(egg(6.5, 2.6, 4.6, 0.4)), RIG, "piecewise")
    head, rear = boundary.points_mm[:, 1].max(), boundary.points_mm[:, 1].min()
    assert head == pytest.approx(2.6, abs=0.5)
    assert rear == pytest.approx(-4.6, abs=0.5)


@pytest.mark.parametrize("rows", [2, 3, 4])
def test_few_rows_use_a_model_of_lower_order(rows):
    edges = edges_of(lambda theta: np.full(theta.shape, 3.0), np.linspace(-1.2, 1.2, rows))
    assert radius_of(piecewise(edges)).max() < 4.5
    assert radius_of(piecewise(edges)).min() > 2.0


def test_single_row_raises_no_boundary():
    match = match_of(spherical_cap(6.5, 0.4))
    one = match.ray[:, 0] == 10
    with pytest.raises(CannotMeasure, match="no-boundary"):
        boundary_on_work_piece(replace(match, ray=match.ray[one]), RIG, "circle")


def test_diverging_model_is_rejected():
    # Rows get ever wider towards a rear that is not visible.
    angle = np.radians([0.0, -10.0, -20.0, -30.0, -40.0, -45.0])
    radius = np.array([1.0, 1.02, 1.15, 1.5, 2.2, 2.8])
    right = np.column_stack([radius * np.cos(angle), radius * np.sin(angle)])
    with pytest.raises(CannotMeasure, match="no-boundary"):
        piecewise(EdgePoints(right * [-1, 1], right, np.array([9, 1, 1, 1, 1, 1])))


@given(st.floats(-5.0, 5.0), st.floats(-5.0, 5.0))
def test_contains_is_true_inside_only(x, y):
    boundary = Boundary.polar(np.array([0.5, -0.3]), np.full(360, 3.0))
    distance = np.hypot(x - 0.5, y + 0.3)
    if abs(distance - 3.0) > 0.001:
        assert bool(boundary.contains(x, y)) == (distance < 3.0)


def test_at_height_does_not_change_x_and_y():
    boundary = Boundary.polar(np.zeros(2), np.full(180, 3.0))
    raised = boundary.at_height(np.linspace(0, 1, 180))
    np.testing.assert_array_equal(raised.points_mm[:, :2], boundary.points_mm[:, :2])
    assert raised.points_mm[-1, 2] == 1.0
