"""A rim whose dots have no ray, as the pool is steeper there than its middle, or flat."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest

from labapp.core.geometry.bench import Bench
from labapp.core.geometry.coordinates import ImageCalibration
from labapp.core.matching.checks.rim_left_out import refuse_rim_left_out
from labapp.core.matching.free_setup import FreeHypothesis
from labapp.core.matching.hypothesis import evaluate
from labapp.core.matching.match_rays import match_of_hypothesis, open_candidates
from labapp.core.matching.observation import UNLABELLED, Observation, neighbours_of
from labapp.core.pipeline import Settings
from labapp.core.recording.chain import WarmChain
from labapp.core.values import CannotMeasure, FloatArray, IntArray
from labapp.simulation.forward import trace
from labapp.simulation.pools import Footprint, Place, Pool, egg
from labapp.simulation.render import Look, render
from tests.benchmarks.dips import measure_pool
from tests.benchmarks.rendered import draw_view
from tests.scenes import BENCH_RIG, BENCH_VIEW, FRAME_SHAPE, see, true_labels

SMOOTH = egg(5.4, 2.6, 3.0, 0.27)
BENCH = Bench(BENCH_RIG, BENCH_VIEW)


def frame(false: int = 0) -> tuple[Observation, IntArray]:
    """Return the dots of a smooth pool, some false, and the true labels."""
    seen = see(SMOOTH, np.random.default_rng(3), sigma_px=0.05, false=false)
    return Observation.of(seen.dots, BENCH, FRAME_SHAPE), true_labels(seen)


def without_ends(labels: IntArray, rows: int) -> IntArray:
    """Return labels without the first and the last dot of some rows, from the middle one on."""
    fewer = labels.copy()
    lit = np.flatnonzero((labels != UNLABELLED).sum(axis=1) > 4)
    for i in lit[len(lit) // 2 :][:rows]:
        ends = np.flatnonzero(labels[i] != UNLABELLED)[[0, -1]]
        fewer[i, ends] = UNLABELLED
    return fewer


@pytest.mark.parametrize(
    ("width", "peak", "fullness"),
    [
        (6.0, 0.28, 0.8),
        (5.4, 0.2, 0.85),
        (5.4, 0.2, 0.93),
        (5.2, 0.28, 0.95),
        (5.0, 0.2, 0.9),
        (5.0, 0.28, 0.75),
    ],
)
def test_pool_with_steep_sides_is_not_measured_too_low(
    width: float, peak: float, fullness: float
) -> None:
    pool = Pool(Footprint(width, 0.55 * width, 0.6 * width), peak, fullness=fullness)
    result = measure_pool(pool, see(pool, np.random.default_rng(1), sigma_px=0.05))
    assert result.status != "ok" or abs(result.height) < 0.05


@dataclass(frozen=True)
class Toe:
    """Makes the height of a paraboloid, peak · (1 − ρ²), that of a pool that becomes flat at its
    rim: peak · (1 − ρ²)ⁿ."""

    peak_mm: float
    power: float

    def height(self, place: Place) -> FloatArray:
        inside = np.maximum(1 - place.rho2, 0)
        return np.asarray(self.peak_mm * (inside**self.power - inside))

    def gradient(self, place: Place) -> FloatArray:
        inside = np.maximum(1 - place.rho2, 1e-9)
        by_rho2 = -self.peak_mm * (self.power * inside ** (self.power - 1) - 1)
        return place.gradient(2 * by_rho2 * place.p, 2 * by_rho2 * place.q)


@pytest.mark.parametrize(("width", "peak", "power"), [(5.0, 0.32, 1.3), (5.6, 0.2, 1.2)])
def test_pool_with_a_toe_is_not_measured_too_low(width: float, peak: float, power: float) -> None:
    pool = Pool(Footprint(width, 0.52 * width, 0.6 * width), peak, (Toe(peak, power),), fullness=0)
    result = measure_pool(pool, see(pool, np.random.default_rng(1), sigma_px=0.05))
    assert result.status != "ok" or abs(result.height) < 0.05


def test_dots_left_out_all_round_are_refused() -> None:
    observed, labels = frame()
    with pytest.raises(CannotMeasure) as refusal:
        refuse_rim_left_out(observed, without_ends(labels, rows=4))
    assert refusal.value.status == "no-match"


@pytest.mark.parametrize(("rows", "is_measured"), [(0, True), (4, False)])
def test_no_other_frame_decides_for_open_rows_without_the_rim(rows: int, is_measured: bool) -> None:
    observed, labels = frame()
    labels = without_ends(labels, rows)
    hypothesis = evaluate(observed, labels)
    assert hypothesis is not None
    own = match_of_hypothesis(observed, hypothesis, hypothesis.orientation(observed))
    holes = [FreeHypothesis(labels, cost=0.0), FreeHypothesis(labels, step=(0, 1), cost=5.0)]
    candidates = list(open_candidates(observed, own, holes))
    assert [each.match is not None for each in candidates] == [is_measured, is_measured]


@pytest.mark.parametrize("rows", [1, 2])
def test_few_dots_left_out_are_accepted(rows: int) -> None:
    observed, labels = frame()
    refuse_rim_left_out(observed, without_ends(labels, rows))


def test_followed_pool_is_not_measured_when_its_rim_becomes_steep() -> None:
    rng = np.random.default_rng(1)
    view = draw_view(rng)
    axes = (view.origin_px, view.x_axis_px, view.x_axis_mm, view.z_axis_px, view.z_axis_mm)
    chain = WarmChain(Bench(BENCH_RIG, ImageCalibration.from_three_points(*axes)), Settings())
    statuses = []
    for fullness in (0.7, 0.75, 0.85):
        pool = Pool(Footprint(5.8, 3.2, 3.5), 0.2, fullness=fullness)
        statuses.append(
            chain.measure(render(trace(pool, BENCH_RIG), view, Look(), rng).image).status
        )
    assert statuses == ["ok", "ok", "no-match"]


def test_false_dots_anywhere_are_accepted() -> None:
    observed, labels = frame(false=12)
    refuse_rim_left_out(observed, labels)


def test_dots_left_out_within_the_others_are_accepted() -> None:
    observed, labels = frame()
    inner = np.argwhere(neighbours_of(labels != UNLABELLED) == 8)[:8]
    labels[tuple(inner.T)] = UNLABELLED
    refuse_rim_left_out(observed, labels)


def test_dots_that_fill_the_frame_are_accepted() -> None:
    observed, labels = frame()
    cut = replace(observed, frame_shape=(1, 1))
    refuse_rim_left_out(cut, without_ends(labels, rows=4))
