"""Edges of the pool from straight lines on the solid metal (§3.2.1, Fig. 3-10 b)."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from labapp.config.line_setup import read_line_setup
from labapp.core.geometry.coordinates import ImageCalibration
from labapp.core.geometry.line_pattern import line_directions
from labapp.core.geometry.optics import intersect_level
from labapp.core.lines.frame import measure_lines
from labapp.core.lines.metal import pool_edges
from labapp.simulation.camera import CameraView
from labapp.simulation.pools import egg
from tests.line_truth.frames import LineLook, render_lines
from tests.setups import FIVE_LINES

VIEW = CameraView((2.0, 638.0), (452.0, 638.0), 60.0, (2.0, 188.0), 60.0)
HOLLOW = egg(5.9, 2.9, 3.2, -0.25)


@pytest.fixture
def bench(tmp_path):
    (tmp_path / "setup.toml").write_text(FIVE_LINES, "utf-8")
    return read_line_setup(tmp_path / "setup.toml")


def true_edges(rig, pool) -> dict[tuple[int, int], np.ndarray]:
    """Return where the middle of each line crosses the boundary at z = 0, by line and side."""
    fan = np.linspace(-rig.pattern.half_fan, rig.pattern.half_fan, 4001)
    number = np.arange(1.0, rig.pattern.count + 1)[:, None]
    ray = line_directions(rig.laser, rig.pattern, number, fan)
    point = intersect_level(rig.laser.position_mm, ray)[..., :2]
    inside = np.isfinite(pool.height(point[..., 0], point[..., 1]))
    return {
        (k + 1, side): point[k][np.flatnonzero(inside[k])[0 if side < 0 else -1]]
        for k in range(rig.pattern.count)
        for side in (-1, 1)
    }


def test_lines_on_stainless_steel_end_at_the_pool(bench):
    rig, rng = bench.line_rig, np.random.default_rng(3)
    image = render_lines(HOLLOW, rig, VIEW, LineLook(metal=0.4), rng).image
    result = measure_lines(image, rig, bench.calibration)
    edges, true = result.edges, true_edges(rig, HOLLOW)
    assert edges is not None
    ends = zip(edges.line.tolist(), edges.side.tolist(), edges.point_mm, strict=True)
    error = [np.linalg.norm(place - true[line, side]) for line, side, place in ends]
    assert len(error) == 10
    assert np.median(error) < 0.12
    assert max(error) < 0.3
    # Short pieces reflected by the metal are not lines of the pattern.
    assert len(result.seen.lines) in (4, 5)
    assert all(one.length_px > 40 for one in result.seen.lines)


def test_mild_steel_gives_no_edges(bench):
    image = render_lines(HOLLOW, bench.line_rig, VIEW, LineLook(), np.random.default_rng(3)).image
    assert pool_edges(image, bench.line_rig, bench.calibration) is None


def test_crossing_lines_of_a_convex_pool_give_no_edges(bench):
    pool = egg(6.6, 3.0, 3.4, 0.2)
    rng = np.random.default_rng(0)
    image = render_lines(pool, bench.line_rig, VIEW, LineLook(metal=0.4), rng).image
    assert pool_edges(image, bench.line_rig, bench.calibration) is None


def test_too_few_lines_give_no_edges(bench):
    rig = replace(bench.line_rig, pattern=replace(bench.line_rig.pattern, count=3))
    look, rng = LineLook(metal=0.4), np.random.default_rng(3)
    image = render_lines(HOLLOW, rig, VIEW, look, rng).image
    assert pool_edges(image, rig, bench.calibration) is None


def test_lines_much_farther_apart_than_the_picture_give_no_edges(bench):
    image = np.full((640, 480), 9.0)
    far = ImageCalibration.from_three_points((2.0, 638.0), (452.0, 638.0), 60.0, (2.0, 188.0), 1e-6)
    assert pool_edges(image, bench.line_rig, far) is None
