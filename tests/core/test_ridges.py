"""Ridges and lines in drawn frames: subpixel position, gaps, ends and numbers."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from labapp.core.lines.detection.find_lines import find_lines
from labapp.core.lines.detection.numbering import number_lines
from labapp.core.lines.detection.ridges import find_ridges
from labapp.core.lines.detection.smooth_path import SmoothPath
from labapp.core.values import FloatArray

SHAPE = (200, 260)


def arc(center: tuple[float, float], radius: float, half: float) -> FloatArray:
    """Return points of an arch, from left to right, shape (n, 2), px."""
    angle = np.linspace(-half, half, 4000)
    return np.stack(
        [center[0] + radius * np.sin(angle), center[1] - radius * np.cos(angle)], axis=-1
    )


def drawn(
    *lines: tuple[FloatArray, float], width: float = 2.0, noise: float = 1.0, seed: int = 0
) -> FloatArray:
    """Return a frame of lines with the given peaks, grey levels."""
    light = np.zeros(SHAPE)
    for points, peak in lines:
        length = np.linalg.norm(np.diff(points, axis=0), axis=-1).sum()
        corner = np.floor(points).astype(int)
        share = points - corner
        for du in (0, 1):
            for dv in (0, 1):
                part = np.abs(1 - du - share[:, 0]) * np.abs(1 - dv - share[:, 1])
                place = corner[:, 1] + dv, corner[:, 0] + du
                np.add.at(light, place, peak * part * length / len(points))
    light = gaussian_filter(light, width) * width * np.sqrt(2 * np.pi)
    return light + 20.0 + noise * np.random.default_rng(seed).normal(size=SHAPE)


def test_ridge_points_are_on_a_slanted_line():
    share = np.linspace(0, 1, 4000)[:, None]
    frame = drawn((np.array([30.3, 60.7]) + share * np.array([190.0, 61.0]), 60.0), noise=0.2)
    ridges = find_ridges(frame)
    main = slice(*ridges.starts[:2]) if len(ridges.starts) == 2 else slice(None)
    points = ridges.image_px[main]
    inner = (points[:, 0] > 45) & (points[:, 0] < 205)
    across = np.array([-61.0, 190.0]) / np.hypot(61.0, 190.0)
    error = (points[inner] - [30.3, 60.7]) @ across
    assert inner.sum() > 140
    assert np.sqrt(np.mean(error**2)) < 0.05


def test_bent_line_is_not_biased_inwards():
    """Smoothing moves the ridge of a bent line inwards by more than its noise."""
    path = arc((130.4, 140.2), 45.0, 1.2)
    frame = drawn((path, 60.0), width=2.5, noise=0.5)
    line = max(find_lines(frame), key=lambda one: one.light * one.length_px)
    radius = np.linalg.norm(line.image_px - [130.4, 140.2], axis=-1)
    assert abs(np.mean(radius) - 45.0) < 0.05
    assert np.sqrt(np.mean((radius - 45.0) ** 2)) < 0.1
    assert np.median(line.curvature) == pytest.approx(1 / 45.0, rel=0.1)
    assert line.width_px == pytest.approx(2.5, rel=0.15)


@pytest.mark.parametrize("seed", [0, 2, 4])
def test_wide_faint_line_is_found_in_one_piece(seed: int):
    """As the top line of a small convex pool, which is wider than the others and has speckle."""
    path = arc((130.0, 120.0), 80.0, 1.1)
    grains = gaussian_filter(np.random.default_rng(seed).normal(size=SHAPE), 1.0)
    light = drawn((path, 14.0), width=6.0, noise=0.0) - 20.0
    frame = light * (1 + 0.25 * grains / grains.std())
    frame += drawn((arc((130.0, 190.0), 70.0, 0.6), 50.0), width=2.2, seed=seed)
    line = max(find_lines(frame), key=lambda one: one.length_px)
    assert line.width_px == pytest.approx(6.0, rel=0.1)
    assert np.abs(line.ends_px - path[[0, -1]]).max() < 2.6
    assert np.abs(np.linalg.norm(line.image_px - [130.0, 120.0], axis=-1) - 80.0).mean() < 0.3


def test_narrow_lines_side_by_side_are_no_wide_line():
    frame = drawn(*((arc((130.0, 150.0 + k), 90.0, 0.7), 40.0) for k in (0.0, 8.0)))
    assert sum(one.length_px > 90.0 for one in find_lines(frame)) == 2


def test_sharp_turn_is_followed():
    """A line of a concave pool near its focus: straight legs joined with a radius of 10 px."""
    across = np.linspace(-40.0, 40.0, 4000)
    path = np.stack([130.4 + across, 50.3 + 1.5 * np.hypot(across, 15.0)], axis=-1)
    line = max(find_lines(drawn((path, 60.0), noise=0.5)), key=lambda one: one.length_px)
    distance = np.linalg.norm(line.image_px[:, None] - path, axis=-1).min(axis=-1)
    turn = np.abs(line.image_px[:, 0] - 130.4) < 12.0
    assert turn.sum() > 20
    assert np.sqrt(np.mean(distance[turn] ** 2)) < 0.17


def test_ends_are_where_the_light_ends():
    path = arc((130.4, 180.2), 80.0, 0.9)
    (line,) = find_lines(drawn((path, 60.0), noise=0.5))
    assert np.abs(line.ends_px - path[[0, -1]]).max() < 0.8
    assert not line.cut.any()


def test_line_that_leaves_the_picture_is_cut():
    share = np.linspace(0, 1, 4000)[:, None]
    frame = drawn((np.array([40.0, 90.0]) + share * np.array([218.0, 20.0]), 60.0))
    (line,) = find_lines(frame)
    assert line.cut.tolist() == [False, True]


def test_gaps_are_bridged_and_reported():
    path = arc((130.0, 180.0), 90.0, 1.0)
    first, second = path[path[:, 0] < 144.5], path[path[:, 0] > 155.5]
    frame = drawn((first, 60.0), (second, 60.0))
    (line,) = find_lines(frame)
    assert 6 < line.gap_px < 30
    assert np.abs(line.ends_px - path[[0, -1]]).max() < 1.0


def five(*bright: float, spacing: float = 22.0) -> list[tuple[FloatArray, float]]:
    """Return arches above one another, from the lowest up, each with its peak."""
    return [(arc((130.0, 240.0 - spacing * k), 90.0, 0.7), peak) for k, peak in enumerate(bright)]


def test_fringes_are_excluded_and_determine_the_numbers():
    frame = drawn(*five(9.0, 50.0, 55.0, 60.0, 10.0))
    numbered = number_lines(find_lines(frame), 3)
    assert len(numbered.lines) == 3
    assert numbered.fringe_below
    assert numbered.fringe_above
    assert numbered.left_out == 2
    assert list(numbered.first_numbers(3, 3, same_order=True)) == [1]
    assert list(numbered.first_numbers(3, 3, same_order=False)) == [3]


def test_missing_lines_make_numbers_ambiguous_without_a_fringe():
    alone = number_lines(find_lines(drawn(*five(50.0, 55.0, 60.0))), 5)
    assert list(alone.first_numbers(5, 3, same_order=True)) == [1, 2, 3]
    assert list(alone.first_numbers(5, 3, same_order=False)) == [3, 4, 5]
    above = number_lines(find_lines(drawn(*five(50.0, 55.0, 60.0, 10.0))), 5)
    assert list(above.first_numbers(5, 3, same_order=True)) == [3]
    below = number_lines(find_lines(drawn(*five(9.0, 55.0, 60.0, 50.0))), 5)
    assert list(below.first_numbers(5, 3, same_order=True)) == [1]
    assert list(below.first_numbers(5, 3, same_order=False)) == [5]


def test_empty_frame_has_no_line():
    frame = 20.0 + np.random.default_rng(1).normal(size=SHAPE)
    numbered = number_lines(find_lines(frame), 5)
    assert numbered.lines == ()


def test_path_through_coinciding_points_is_finite():
    """As of a short piece of a line that a pool focuses to a spot."""
    path = SmoothPath.through(np.full((8, 2), 5.0), 3.0)
    assert np.isfinite(path.tangent).all()
    assert np.isfinite(path.curvature).all()
