"""A rim whose dots have no ray, as the pool is steeper there than its middle, or flat."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import pytest

from labapp.core.geometry.bench import Bench
from labapp.core.geometry.coordinates import ImageCalibration
from labapp.core.images.dots import Dots
from labapp.core.matching import repair
from labapp.core.matching.checks.rim_left_out import is_rim_left_out
from labapp.core.matching.free_setup import FreeHypothesis
from labapp.core.matching.hypothesis import evaluate
from labapp.core.matching.match_rays import match_of_hypothesis, open_candidates
from labapp.core.matching.observation import UNLABELLED, Observation, neighbours_of
from labapp.core.matching.row_ends import continued_labels
from labapp.core.pipeline import Measurement, Settings
from labapp.core.recording.chain import WarmChain
from labapp.core.schemes import fit
from labapp.core.schemes.fit import FitSettings
from labapp.core.surface.measures import measure_surface
from labapp.core.values import FloatArray, IntArray
from labapp.simulation.forward import trace
from labapp.simulation.pools import Footprint, Place, Pool, egg
from labapp.simulation.render import Look, render
from tests.benchmarks.dips import matched, measure_pool
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


@pytest.mark.parametrize(
    ("width", "peak", "fullness"),
    [(5.0, 0.2, 0.8), (5.4, 0.2, 0.85), (5.8, 0.2, 0.8), (6.2, 0.28, 0.85), (6.6, 0.2, 0.9)],
)
def test_dots_of_steep_sides_get_their_rays(width: float, peak: float, fullness: float) -> None:
    pool = Pool(Footprint(width, 0.55 * width, 0.6 * width), peak, fullness=fullness)
    seen = see(pool, np.random.default_rng(int(width * 10)), sigma_px=0.08)
    match = matched(seen)
    assert (seen.ray[match.dot] == match.ray).all()
    assert len(match.dot) == (true_labels(seen) != UNLABELLED).sum()
    size = measure_surface(fit.reconstruct(match, BENCH_RIG, FitSettings()), match, BENCH_RIG)
    assert abs(size.height_mm - peak) < 2.5 * size.height_sigma_mm


def test_false_dots_beyond_a_row_get_no_ray(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(repair, "RIM_POSSIBLE", -np.inf)  # their cost decides, whatever their place
    observed, labels = frame(false=40)
    best = evaluate(observed, labels)
    assert best is not None
    assert (continued_labels(observed, labels) != labels).any()
    assert (repair.with_rim(observed, best).labels == labels).all()


def test_rim_is_not_labelled_if_many_dots_would_still_have_no_ray(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(repair, "rim_evidence", lambda *_: 1000.0)
    pool = Pool(Footprint(5.8, 3.2, 3.5), 0.2, fullness=0.8)
    seen = see(pool, np.random.default_rng(1), sigma_px=0.05, false=12)
    observed, labels = Observation.of(seen.dots, BENCH, FRAME_SHAPE), true_labels(seen)
    best = evaluate(observed, without_ends(labels, rows=6))
    assert best is not None
    given = repair.with_rim(observed, best).labels
    assert ((given == labels) | (given == UNLABELLED)).all()


def test_ray_of_a_doubtful_label_is_not_dark_beside_a_continued_rim() -> None:
    pool = Pool(Footprint(5.8, 3.2, 3.5), 0.2, fullness=0.8)
    seen = see(pool, np.random.default_rng(1), sigma_px=0.05)
    observed, labels = Observation.of(seen.dots, BENCH, FRAME_SHAPE), true_labels(seen)
    best = evaluate(observed, without_ends(labels, rows=4))
    assert best is not None
    wider = repair.with_rim(observed, best)
    assert (wider.labels == labels).all()
    ray = tuple(np.argwhere(wider.ray_states < 0)[0])
    states = best.ray_states.copy()
    states[ray] = 0
    assert repair.with_rim(observed, replace(best, ray_states=states)).ray_states[ray] == 0


def test_rows_are_continued_over_several_dots() -> None:
    pool = Pool(Footprint(5.8, 3.2, 3.5), 0.2, fullness=0.85)
    seen = see(pool, np.random.default_rng(1), sigma_px=0.05)
    observed, labels = Observation.of(seen.dots, BENCH, FRAME_SHAPE), true_labels(seen)
    middle = labels.shape[0] // 2
    fewer = labels.copy()
    fewer[middle, np.flatnonzero(labels[middle] != UNLABELLED)[-2:]] = UNLABELLED
    assert (continued_labels(observed, fewer) == labels).all()


def test_dot_beyond_a_missing_one_does_not_get_its_ray() -> None:
    """The last dot but one of a row is missing: the last seems to continue the row in its place."""
    seen = see(SMOOTH, np.random.default_rng(3), sigma_px=0.05)
    labels = true_labels(seen)
    row = labels.shape[0] // 2
    ends = np.flatnonzero(labels[row] != UNLABELLED)[-3:]
    fewer = labels.copy()
    fewer[row, ends[1:]] = UNLABELLED
    dots = np.delete(np.arange(len(seen.dots)), labels[row, ends[1]])
    kept = Dots(*(values[dots] for values in vars(seen.dots).values()))
    moved = np.searchsorted(dots, fewer)
    fewer = np.where(fewer == UNLABELLED, UNLABELLED, moved)
    observed = Observation.of(kept, BENCH, FRAME_SHAPE)
    best = evaluate(observed, fewer)
    assert best is not None
    wider = evaluate(observed, continued_labels(observed, fewer))
    assert wider is not None
    new = (wider.labels != UNLABELLED) & (fewer == UNLABELLED)
    given = repair._with_missing(observed, wider, new).labels
    true = np.where(np.isin(labels, dots), np.searchsorted(dots, labels), UNLABELLED)
    assert ((given == true) | (given == UNLABELLED)).all()


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


@pytest.mark.parametrize(("width", "peak", "power"), [(5.6, 0.26, 1.2), (6.2, 0.2, 1.3)])
def test_surface_follows_a_toe(width: float, peak: float, power: float) -> None:
    pool = Pool(Footprint(width, 0.52 * width, 0.6 * width), peak, (Toe(peak, power),), fullness=0)
    seen = see(pool, np.random.default_rng(1), sigma_px=0.05)
    observed = Observation.of(seen.dots, BENCH, FRAME_SHAPE)
    hypothesis = evaluate(observed, true_labels(seen))
    assert hypothesis is not None
    match = match_of_hypothesis(observed, hypothesis, hypothesis.orientation(observed))
    size = measure_surface(fit.reconstruct(match, BENCH_RIG, FitSettings()), match, BENCH_RIG)
    assert abs(size.height_mm / pool.size.height_mm - 1) < 0.04
    assert abs(size.width_mm - pool.size.width_mm) < 3 * size.width_sigma_mm


def test_dots_left_out_all_round_are_noticed() -> None:
    observed, labels = frame()
    assert is_rim_left_out(observed, without_ends(labels, rows=4))


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
    assert not is_rim_left_out(observed, without_ends(labels, rows))


def followed(*fullness: float) -> Iterator[tuple[Measurement, bool]]:
    """Measure frames of pools of a recording; yield the result and whether it was followed."""
    rng = np.random.default_rng(1)
    view = draw_view(rng)
    axes = (view.origin_px, view.x_axis_px, view.x_axis_mm, view.z_axis_px, view.z_axis_mm)
    chain = WarmChain(Bench(BENCH_RIG, ImageCalibration.from_three_points(*axes)), Settings())
    for each in fullness:
        pool = Pool(Footprint(5.8, 3.2, 3.5), 0.2, fullness=each)
        result = chain.measure(render(trace(pool, BENCH_RIG), view, Look(), rng).image)
        yield result, chain.track_lost is None


def test_followed_pool_is_not_measured_when_its_rim_becomes_steep() -> None:
    statuses = [result.status for result, _ in followed(0.7, 0.75, 0.85)]
    assert statuses == ["ok", "ok", "no-match"]


def test_steep_pool_is_followed_as_it_was_fitted() -> None:
    (first, _), (second, is_followed) = followed(0.75, 0.75)
    assert is_followed
    assert first.measures is not None
    assert second.measures is not None
    assert second.measures.height_sigma_mm > 0.5 * first.measures.height_sigma_mm
    assert abs(second.measures.height_mm - 0.2) < 3 * second.measures.height_sigma_mm


def test_false_dots_anywhere_are_accepted() -> None:
    observed, labels = frame(false=12)
    assert not is_rim_left_out(observed, labels)


def test_dots_left_out_within_the_others_are_accepted() -> None:
    observed, labels = frame()
    inner = np.argwhere(neighbours_of(labels != UNLABELLED) == 8)[:8]
    labels[tuple(inner.T)] = UNLABELLED
    assert not is_rim_left_out(observed, labels)


def test_dots_that_fill_the_frame_are_accepted() -> None:
    observed, labels = frame()
    cut = replace(observed, frame_shape=(1, 1))
    assert not is_rim_left_out(cut, without_ends(labels, rows=4))
