"""Dots and rays that a hypothesis leaves unexplained, and the search that they end or prolong."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from labapp.core.geometry.bench import Bench
from labapp.core.matching import decision, match_rays, repair
from labapp.core.matching.checks import unexplained
from labapp.core.matching.checks.unexplained import explains, suffices
from labapp.core.matching.hypothesis import Hypothesis, evaluate
from labapp.core.matching.match_settings import MatchSettings
from labapp.core.matching.observation import UNLABELLED, Observation
from labapp.core.matching.repair import with_repaired
from labapp.core.rows.lattice_growth import GrowSettings, grow_lattice
from labapp.core.values import CannotMeasure, IntArray
from labapp.simulation.pools import egg
from tests.benchmarks.dips import draw, matched
from tests.scenes import BENCH_RIG, BENCH_VIEW, FRAME_SHAPE, SeenDots, see, true_labels

BENCH = Bench(BENCH_RIG, BENCH_VIEW)
POOL = egg(5.4, 2.6, 3.0, 0.27)
ISOLATED = 15
"""Seed of ten false dots of which no three continue the rows side by side."""


def seen_with(false: int, missing: int = 0, sigma_px: float = 0.05, seed: int = 6) -> SeenDots:
    rng = np.random.default_rng(seed)
    return see(POOL, rng, sigma_px=sigma_px, missing=missing, false=false)


def hypothesis(seen: SeenDots, labels: IntArray | None = None) -> tuple[Observation, Hypothesis]:
    """Return the observation, and the hypothesis of labels, by default of the true ones."""
    observed = Observation.of(seen.dots, BENCH, FRAME_SHAPE)
    found = evaluate(observed, true_labels(seen) if labels is None else labels)
    assert found is not None
    return observed, found


def test_isolated_false_dots_leave_a_hypothesis_that_suffices() -> None:
    observed, found = hypothesis(seen_with(false=10, seed=ISOLATED))
    assert (found.stray_count, found.missed_count) == (10, 0)
    assert not explains(observed, found)
    assert suffices(observed, found)


@pytest.mark.parametrize("kept", ["all but a row", "half"])
def test_dots_without_a_ray_that_are_adjacent_do_not_suffice(kept: str) -> None:
    labels = true_labels(seen_with(false=0))
    rows = np.flatnonzero((labels != UNLABELLED).any(axis=1))
    labels[rows[-1] if kept == "all but a row" else rows[len(rows) // 2 + 2 :]] = UNLABELLED
    observed, found = hypothesis(seen_with(false=0), labels)
    assert not suffices(observed, found)


def test_many_isolated_dots_do_not_suffice() -> None:
    observed, found = hypothesis(seen_with(false=30))
    assert not suffices(observed, found)


def test_dots_far_from_their_predictions_do_not_suffice() -> None:
    observed, found = hypothesis(seen_with(false=10, sigma_px=0.7))
    assert found.stray_count == 10
    assert not suffices(observed, found)


def searched_with(seen: SeenDots, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Match a frame; return the kinds of initial labels that were tried."""
    tried: list[str] = []

    def noted(name: str) -> None:
        search = getattr(match_rays, name)

        def run(*given: object) -> list[Hypothesis]:
            tried.append(name)
            made: list[Hypothesis] = search(*given)
            return made

        monkeypatch.setattr(match_rays, name, run)

    for name in ("_by_lattice", "_by_empty_sites", "_by_quadrics", "_by_caps"):
        noted(name)
    lattice = grow_lattice(seen.dots, GrowSettings())
    observed = Observation.of(seen.dots, BENCH, FRAME_SHAPE)
    match, _ = match_rays.match_rays(observed, lattice, MatchSettings())
    assert (seen.ray[match.dot] == match.ray).all()
    return tried


def test_isolated_false_dots_do_not_prolong_the_search(monkeypatch: pytest.MonkeyPatch) -> None:
    assert searched_with(seen_with(false=10, seed=ISOLATED), monkeypatch) == ["_by_lattice"]


def test_a_cluttered_frame_is_searched_in_other_ways(monkeypatch: pytest.MonkeyPatch) -> None:
    assert len(searched_with(seen_with(false=24), monkeypatch)) > 1


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 2, 5])
def test_false_dots_apart_from_the_rows_are_accepted(seed: int) -> None:
    """Once a frame with four false dots for ten labelled ones was refused."""
    seen = see(POOL, np.random.default_rng(seed), sigma_px=0.05, missing=2, false=30)
    match = matched(seen)
    assert (seen.ray[match.dot] == match.ray).all()
    assert len(match.dot) > 0.9 * np.sum(seen.ray[:, 0] > 0)


def test_dots_between_labelled_rows_are_a_row() -> None:
    seen = seen_with(false=0)
    labels = true_labels(seen)
    row = np.flatnonzero((labels != UNLABELLED).any(axis=1))[2]
    labels[row:-1], labels[-1] = labels[row + 1 :], UNLABELLED
    observed, found = hypothesis(seen, labels)
    assert unexplained._strays_in_line(observed, found.labels, found.stray_dots) >= unexplained.ROW


def test_dots_beside_and_between_the_same_labels_are_a_row() -> None:
    """The two dots of the first row have the rays of the second, whose dots have none."""
    _, seen = draw(7246)
    labels = true_labels(seen)
    first, second = np.flatnonzero((labels != UNLABELLED).any(axis=1))[:2]
    dots = np.sum(labels[second] != UNLABELLED)
    labels[second], labels[first] = labels[first], UNLABELLED
    observed, found = hypothesis(seen, labels)
    in_line = unexplained._strays_in_line(observed, found.labels, found.stray_dots)
    assert found.stray_count == in_line == dots
    assert not suffices(observed, found)


@pytest.fixture
def grown(monkeypatch: pytest.MonkeyPatch) -> list[IntArray]:
    """Labels that were grown during a test."""
    labels: list[IntArray] = []
    grow = repair.grow_and_evaluate

    def run(observed: Observation, own: IntArray, **given: float) -> Hypothesis | None:
        labels.append(own)
        return grow(observed, own, **given)

    monkeypatch.setattr(repair, "grow_and_evaluate", run)
    return labels


def test_only_a_new_cheapest_hypothesis_is_repaired(grown: list[IntArray]) -> None:
    seen = seen_with(false=0, missing=3)
    labels = true_labels(seen)
    lit = np.argwhere(labels != UNLABELLED)
    labels[tuple(lit[len(lit) // 3])] = UNLABELLED
    observed, lacking = hypothesis(seen, labels)
    _, whole = hypothesis(seen)
    assert whole.missed_count > 0
    assert with_repaired(observed, [whole], [lacking]) == [whole, lacking]
    assert not grown
    repaired = with_repaired(observed, [], [lacking])
    assert grown
    assert repaired[-1].label_count == whole.label_count


def test_fine_knots_are_not_tried_if_the_usual_ones_confirm_the_labels(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    observed, found = hypothesis(seen_with(false=0, missing=3))
    assert found.missed_count > 0
    knots: list[float | None] = []
    grow = repair.grow_and_evaluate

    def run(*labels: Any, knot_mm: float | None = None, **given: Any) -> Hypothesis | None:
        knots.append(knot_mm)
        return grow(*labels, knot_mm=knot_mm, **given)

    monkeypatch.setattr(repair, "grow_and_evaluate", run)
    with_repaired(observed, [], [found])
    assert set(knots) == {None}


def test_nothing_is_repaired_if_only_isolated_dots_are_left(grown: list[IntArray]) -> None:
    observed, found = hypothesis(seen_with(false=10, seed=ISOLATED))
    assert with_repaired(observed, [], [found]) == [found]
    assert not grown


def test_rows_are_ambiguous_if_the_marker_between_dark_rays_has_no_place(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    seen = seen_with(false=0)
    labels = true_labels(seen)
    i, j = np.array(BENCH_RIG.pattern.marker) - 1
    labels[[i - 1, i + 1, i], [j, j, j - 1]] = UNLABELLED
    observed, found = hypothesis(seen, labels)
    decision._refuse_hidden_marker(observed, found)
    paths = decision.paths_of(observed, found.pool)
    nowhere = replace(paths, plane_mm=np.full_like(paths.plane_mm, np.nan))
    monkeypatch.setattr(decision, "paths_of", lambda *_: nowhere)
    with pytest.raises(CannotMeasure) as caught:
        decision._refuse_hidden_marker(observed, found)
    assert caught.value.status == "ambiguous-rows"


def without_middle(rows: int) -> Hypothesis:
    """Return the hypothesis of the true labels but those of five columns and some rows."""
    seen = seen_with(false=0)
    labels = true_labels(seen)
    top, left = np.argwhere(labels != UNLABELLED).min(axis=0)
    labels[top + 2 : top + 2 + rows, left + 1 : left + 6] = UNLABELLED
    return hypothesis(seen, labels)[1]


def test_missed_rays_of_removed_labels_are_accepted_only_if_few() -> None:
    few, many = without_middle(rows=2), without_middle(rows=4)
    unexplained.refuse_much_in_doubt(few, few.labels)
    with pytest.raises(CannotMeasure) as caught:
        unexplained.refuse_much_in_doubt(many, many.labels)
    assert caught.value.status == "no-match"


def test_surface_is_refused_if_a_fifth_of_the_labels_was_removed() -> None:
    seen = seen_with(false=0)
    labels = true_labels(seen)
    for columns, is_refused in ((1, False), (4, True)):
        fewer = labels.copy()
        fewer[:, np.flatnonzero((labels != UNLABELLED).any(axis=0))[:columns]] = UNLABELLED
        found = hypothesis(seen, fewer)[1]
        assert found.missed_count == 0
        if is_refused:
            with pytest.raises(CannotMeasure):
                unexplained.refuse_much_in_doubt(found, labels)
        else:
            unexplained.refuse_much_in_doubt(found, labels)


def test_surface_with_many_labels_removed_as_doubtful_is_refused(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(decision, "supported", lambda *_: without_middle(rows=4))
    with pytest.raises(CannotMeasure) as caught:
        matched(seen_with(false=0))
    assert caught.value.status == "no-match"
