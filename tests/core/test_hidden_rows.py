"""Frames in which an object hides a row of dots between the others, or all beyond a line."""

from __future__ import annotations

from dataclasses import fields, replace

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from labapp.core.geometry.bench import Bench
from labapp.core.geometry.coordinates import ImageCalibration
from labapp.core.images.dots import Dots
from labapp.core.matching.checks.hidden_rows import lines_before, rays_beside_hidden_rows
from labapp.core.matching.hypothesis import USUAL_FIT, evaluate
from labapp.core.matching.observation import UNLABELLED, Observation
from labapp.core.pipeline import Settings
from labapp.core.recording.chain import WarmChain
from labapp.core.values import BoolArray, CannotMeasure, IntArray
from labapp.simulation.forward import trace
from labapp.simulation.pools import egg
from labapp.simulation.render import render
from tests.benchmarks import faults
from tests.benchmarks.clutter import KINDS, as_entered, draw_pool
from tests.benchmarks.dips import matched
from tests.benchmarks.rendered import draw_look, draw_view
from tests.scenes import BENCH_RIG, BENCH_VIEW, FRAME_SHAPE, SeenDots, see, true_labels


def part_of(seen: SeenDots, shown: BoolArray) -> SeenDots:
    dots = Dots(*(getattr(seen.dots, each.name)[shown] for each in fields(Dots)))
    return SeenDots(dots, seen.ray[shown])


def without(seen: SeenDots, axis: int, line: int) -> SeenDots:
    """Hide a row (axis 0) or column: the n-th that has dots."""
    return part_of(seen, seen.ray[:, axis] != np.unique(seen.ray[:, axis])[line])


@pytest.mark.parametrize(
    ("kind", "seed"),
    [
        ("egg", 0),
        ("egg", 4),
        ("egg", 6),
        ("ellipse", 4),
        ("ellipse", 7),
        ("rippled", 5),
        ("lowrear", 13),  # three dots are beyond the gap
    ],
)
def test_few_dots_beyond_a_hidden_row_get_no_rays(kind: str, seed: int) -> None:
    """Each was once measured with its last row one off, and too short by up to 13 σ."""
    rig, pool = draw_pool(kind, np.random.default_rng([seed, 3]))
    everything = see(pool, np.random.default_rng(seed), rig=rig)
    seen = without(everything, axis=0, line=1)
    match = matched(seen, rig)
    assert_array_equal(match.ray, seen.ray[match.dot])
    last, hidden = np.unique(everything.ray[:, 0])[:2]
    assert (match.ray_states[hidden - 1] == 0).all()
    beyond = everything.ray[everything.ray[:, 0] == last] - 1
    assert (match.ray_states[tuple(beyond.T)] == 0).all()


def test_many_dots_beyond_a_hidden_row_are_ambiguous() -> None:
    """It was once measured with its last row one off."""
    rig, pool = draw_pool("egg", np.random.default_rng([2, 3]))
    seen = without(see(pool, np.random.default_rng(2), rig=rig), axis=0, line=1)
    with pytest.raises(CannotMeasure) as caught:
        matched(seen, rig)
    assert caught.value.status == "ambiguous-rows"


@pytest.mark.parametrize(
    ("fault", "kind", "seed"),
    [
        ("first-row-but-1", "lowrear", 300),  # five labels were one row off
        ("first-row-but-1", "rippled", 311),  # also these, in a gap hardly wider than the others
        ("last-row-but-1", "egg", 200),  # too low by 3.3 σ
        ("first-column-but-1", "concave", 303),  # too shallow by 3.1 σ
    ],
)
def test_pool_with_a_hidden_row_is_measured_from_the_others(
    fault: str, kind: str, seed: int
) -> None:
    found = faults.measured(fault, kind, seed)
    assert found.status == "ok"
    assert found.wrong == 0
    assert abs(found.sigmas) < 2


def test_lines_before_doubtful_dots_may_be_hidden() -> None:
    lit = np.zeros((7, 8), dtype=bool)
    lit[2:5, 3:6] = True
    lost = np.zeros_like(lit)
    lost[3, 1] = lost[0, 4] = lost[5, 5] = True  # the last is next to a lit ray
    hidden = np.zeros_like(lit)
    hidden[:, 2] = hidden[1] = True
    assert_array_equal(lines_before(lost, lit), hidden)
    assert not lines_before(lit & False, lit).any()


def test_dots_beyond_the_outermost_labels_tell_of_a_hidden_row() -> None:
    """It was once measured with five wrong labels, while growth left the row beyond out."""
    rig, pool = draw_pool("rippled", np.random.default_rng([15, 3]))
    seen = without(see(pool, np.random.default_rng(15), rig=rig), axis=0, line=2)
    with pytest.raises(CannotMeasure):
        matched(seen, rig)


@pytest.mark.parametrize(("kind", "seed"), [("egg", 2), ("cap", 3), ("ellipse", 5)])
def test_pool_with_a_hidden_row_at_the_head_is_not_measured(kind: str, seed: int) -> None:
    """Each was once measured 17 to 21 % too low: rays of the hidden row seemed to miss the pool."""
    rig, pool = draw_pool(kind, np.random.default_rng([seed, 3]))
    seen = without(see(pool, np.random.default_rng(seed), rig=rig), axis=0, line=-2)
    with pytest.raises(CannotMeasure) as caught:
        matched(seen, rig)
    assert caught.value.status == "no-match"


@pytest.mark.parametrize(
    ("axis", "side", "marker"),
    [(0, 1, (10, 10)), (0, -1, (10, 10)), (1, 1, (10, 10)), (1, -1, (10, 10)), (0, -1, (13, 10))],
)
def test_labels_that_close_a_gap_are_in_doubt(
    axis: int, side: int, marker: tuple[int, int]
) -> None:
    rig = replace(BENCH_RIG, pattern=replace(BENCH_RIG.pattern, absent=frozenset({marker})))
    everything = see(egg(6.6, 3.0, 3.9, 0.3), np.random.default_rng(3), rig=rig)
    seen = without(everything, axis, 1 if side < 0 else -2)
    observed = Observation.of(seen.dots, Bench(rig, BENCH_VIEW), FRAME_SHAPE)
    right = true_labels(seen)
    lines = right if axis == 0 else right.T
    lines = lines[::side].copy()
    last = int(np.flatnonzero((lines != UNLABELLED).any(axis=1)).max())
    lines[last - 1], lines[last] = lines[last], UNLABELLED
    lines = lines[::side]
    wrong = np.ascontiguousarray(lines if axis == 0 else lines.T)
    assert not in_doubt(observed, right).any()
    assert in_doubt(observed, wrong)[right != wrong].all()


def in_doubt(observed: Observation, labels: IntArray) -> BoolArray:
    """Rays in doubt because of a hidden row; all if it makes the frame ambiguous."""
    found = evaluate(observed, labels)
    assert found is not None
    try:
        return rays_beside_hidden_rows(observed, found, USUAL_FIT)
    except CannotMeasure:
        return np.ones(labels.shape, dtype=bool)


@pytest.mark.parametrize(
    ("fault", "kind", "seed"),
    [
        ("beyond-a-line", "concave", 207),
        ("beyond-a-line", "lowrear", 211),
        ("beyond-a-line", "rippled", 201),
        ("last-row-but-1", "rippled", 107),
    ],
)
def test_lit_rays_outside_the_boundary_tell_of_hidden_dots(
    fault: str, kind: str, seed: int
) -> None:
    """Each was once measured 18 to 23 % too low, off by 3.3 to 4.1 σ."""
    assert faults.measured(fault, kind, seed).status == "no-match"


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "seed"), [("cap", 1), ("dented", 0), ("lowrear", 0)])
def test_tracked_pool_is_not_measured_while_something_covers_it(kind: str, seed: int) -> None:
    """An object moves in front of up to a third of the dots. Errors once grew to 5 σ."""
    rng = np.random.default_rng([seed, list(KINDS).index(kind), 7])
    rig, pool = draw_pool(kind, rng)
    view, look = draw_view(rng), replace(draw_look(rng), missing=0.0, false_dots=0)
    axes = (view.origin_px, view.x_axis_px, view.x_axis_mm, view.z_axis_px, view.z_axis_mm)
    calibration = ImageCalibration.from_three_points(*axes)
    chain = WarmChain(Bench(as_entered(rig, calibration), calibration), Settings())
    rays, angle = trace(pool, rig), rng.uniform(0.0, 2 * np.pi)
    along = rays.plane_mm @ np.array([np.cos(angle), np.sin(angle)])
    statuses = []
    for shown in [1.0, 1.0, *np.linspace(0.98, 0.68, 8)]:
        visible = along <= np.quantile(along[rays.visible], shown)
        covered = replace(rays, on_plane=rays.on_plane & visible)
        found = chain.measure(render(covered, view, look, rng).image)
        statuses.append(found.status)
        if found.measures is not None:
            error_mm = found.measures.height_mm - pool.size.height_mm
            assert abs(error_mm) < 3 * found.measures.height_sigma_mm
    assert statuses[:2] == ["ok", "ok"]
    assert "ok" not in statuses[-3:]


@pytest.mark.parametrize("kind", ["egg", "ellipse"])
def test_pool_is_not_measured_if_dots_beyond_a_line_are_hidden(kind: str) -> None:
    """Both were once measured about 30 % too low, as if the hidden dots' rays missed the pool."""
    rig, pool = draw_pool(kind, np.random.default_rng([3, 3]))
    seen = see(pool, np.random.default_rng(3), rig=rig)
    assert len(matched(seen, rig).ray) > 0.9 * len(seen.ray)
    u_px = seen.dots.image_px[:, 0]
    with pytest.raises(CannotMeasure) as caught:
        matched(part_of(seen, u_px < np.quantile(u_px, 0.75)), rig)
    assert caught.value.status == "no-match"
