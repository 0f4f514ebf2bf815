"""Pools with a dip under the torch, where a shift by a row explains the dots nearly as well."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from labapp.core.geometry.bench import Bench
from labapp.core.matching import decision
from labapp.core.matching.hypothesis import Hypothesis, evaluate, shifted_labels
from labapp.core.matching.observation import UNLABELLED, Observation
from labapp.core.schemes import fit
from labapp.core.schemes.fit import FitSettings
from labapp.core.surface.measures import measure_surface
from labapp.core.values import CannotMeasure, IntArray
from tests.benchmarks.dips import answer, draw, matched
from tests.scenes import BENCH_RIG, BENCH_VIEW, FRAME_SHAPE, SeenDots

SHIFTED = 37
"""A pool that was once answered with every ray a row off."""

ROW_LEFT_OVER = 60361
"""A pool that was once answered without its last row, whose rays counted as dark: 22 % too low."""

CROSSED = (7004, 7008, 7148)
"""Pools in whose dip rows cross: growth swaps some dots of two rows."""


def observation_of(seen: SeenDots) -> tuple[Observation, IntArray]:
    """The observation, and the true labels."""
    labels = np.full((BENCH_RIG.pattern.rows, BENCH_RIG.pattern.columns), UNLABELLED, np.int64)
    dot = np.flatnonzero(seen.ray[:, 0] > 0)
    labels[seen.ray[dot, 0] - 1, seen.ray[dot, 1] - 1] = dot
    return Observation.of(seen.dots, Bench(BENCH_RIG, BENCH_VIEW), FRAME_SHAPE), labels


def weighed(observed: Observation, labels: IntArray) -> Hypothesis:
    hypothesis = evaluate(observed, labels)
    assert hypothesis is not None
    return hypothesis


NO_ROWS = (7005, 7016)
"""Pools whose dots form no rows, and show no quadric round the absent one."""


@pytest.mark.slow
@pytest.mark.parametrize("seed", [SHIFTED, 2, *CROSSED, *NO_ROWS, ROW_LEFT_OVER])
def test_a_pool_with_a_dip_has_its_rows_told_right(seed: int) -> None:
    got = answer(*draw(seed))
    assert (got.status, got.wrong) == ("ok", 0)
    assert got.right >= 0.95 * got.shown
    assert abs(got.height) < 0.03


@pytest.mark.slow
def test_a_row_beyond_shifted_labels_is_sought(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(decision, "ROW", 1000)  # else the labels without it would be refused
    got = answer(*draw(ROW_LEFT_OVER))
    assert (got.status, got.wrong, got.right) == ("ok", 0, got.shown)


def test_labels_without_a_row_of_dots_explain_too_little() -> None:
    observed, labels = observation_of(draw(ROW_LEFT_OVER)[1])
    rows = np.flatnonzero((labels != UNLABELLED).any(axis=1))
    labels[rows[-1]] = UNLABELLED
    lacking = weighed(observed, labels)
    assert (lacking.stray_count, lacking.missed_count, lacking.marker) == (9, 0, "dark")
    with pytest.raises(CannotMeasure) as refused:
        decision.decide(observed, [lacking], decision.MatchSettings())
    assert refused.value.status == "no-match"


@pytest.mark.slow
@pytest.mark.parametrize("seed", [60031, 60151])
def test_rows_that_cross_in_a_narrow_dip_are_found_with_finer_knots(seed: int) -> None:
    """Stiff knots led back to the swapped labels: three wrong ones, and no answer."""
    got = answer(*draw(seed))
    assert (got.status, got.wrong) == ("ok", 0)
    assert got.right >= 0.9 * got.shown


def test_a_cap_takes_no_answer_s_place() -> None:
    """Begun with caps beside all else, this pool had five wrong labels at its rim."""
    got = answer(*draw(7306))
    assert (got.status, got.wrong) == ("ok", 0)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("seed", "missing", "false"),
    [(20011, 0, 2), (22036, 6, 3), (22099, 6, 3), (30009, 9, 0), (30013, 9, 0)],
)
def test_with_dots_missing_and_false_no_row_is_wrong(seed: int, missing: int, false: int) -> None:
    """Answered a row off, two rows off, and with a row jumped, before."""
    assert answer(*draw(seed, missing, false)).wrong == 0


@pytest.mark.slow
def test_the_boundary_alone_speaks_against_no_rows() -> None:
    """Its likelihood, unbounded, had rows that are right lose to others."""
    got = answer(*draw(9007, missing=6, false=3))
    assert (got.status, got.wrong) == ("ok", 0)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("seed", "missing", "false"),
    [(30005, 9, 0), (30010, 9, 0), (30015, 9, 0), (9064, 6, 3), (9070, 6, 3)],
)
def test_many_rays_without_a_dot_are_put_up_with_where_they_lie_apart(
    seed: int, missing: int, false: int
) -> None:
    """So do dots without a ray. Labels at the rim that lie off are given up (9070: three)."""
    got = answer(*draw(seed, missing, false))
    assert (got.status, got.wrong) == ("ok", 0)
    assert got.right >= 0.94 * got.shown


@pytest.mark.slow
@pytest.mark.parametrize("seed", [52009, 52023, 52030, 52031, 52072])
def test_a_dip_with_dots_missing_beside_it_is_found(seed: int) -> None:
    """No rows, no quadric, and the cap that finds most dots has wrong rays."""
    got = answer(*draw(seed, missing=6, false=3))
    assert (got.status, got.wrong) == ("ok", 0)
    assert got.right >= 0.9 * got.shown


@pytest.mark.slow
@pytest.mark.parametrize("seed", [52014, 52094, 61008])
def test_of_two_holes_the_smoother_surface_tells_the_marker(seed: int) -> None:
    """Missing dots make a second hole; with its rows all dots fit as well, by a rough surface."""
    got = answer(*draw(seed, missing=6, false=3))
    assert (got.status, got.wrong) == ("ok", 0)
    assert got.right >= 0.9 * got.shown


def test_a_false_dot_near_a_rays_prediction_at_the_rim_gets_no_ray() -> None:
    """It lay 0.5 mm from where a ray that did not come back was predicted."""
    got = answer(*draw(71011, missing=6, false=3))
    assert (got.status, got.wrong) == ("ok", 0)
    assert got.right >= 0.95 * got.shown


def test_three_rays_round_a_corner_that_have_no_dot_are_no_row() -> None:
    got = answer(*draw(52040, missing=6, false=3))
    assert (got.status, got.wrong) == ("ok", 0)


def test_wrong_rows_need_a_rougher_surface() -> None:
    observed, labels = observation_of(draw(SHIFTED)[1])
    shifted = [weighed(observed, other) for other in shifted_labels(observed, labels)]
    assert weighed(observed, labels).roughness < min(other.roughness for other in shifted)


def test_the_true_rows_cost_less_than_those_that_put_a_dot_on_the_absent_ray() -> None:
    observed, labels = observation_of(draw(SHIFTED)[1])
    true = weighed(observed, labels)
    shifted = [weighed(observed, other) for other in shifted_labels(observed, labels)]
    assert (true.marker, true.stray_count, true.missed_count) == ("dark", 0, 0)
    assert {other.marker for other in shifted} == {"lit"}
    assert true.cost < min(other.cost for other in shifted) - 50


def test_a_marker_that_is_not_amid_labelled_rays_is_unknown() -> None:
    observed, labels = observation_of(draw(SHIFTED)[1])
    assert BENCH_RIG.pattern.marker is not None
    apart = labels.copy()
    apart[: BENCH_RIG.pattern.marker[0]] = UNLABELLED
    apart[:, : BENCH_RIG.pattern.marker[1]] = UNLABELLED
    assert weighed(observed, apart).marker == "unknown"


OUT_OF_VIEW = 41110
"""A pool whose row beside the last one that is seen has its dots just beyond the imaging plane."""


def test_a_row_that_may_have_left_the_view_is_not_called_dark() -> None:
    """Called dark, its rays had the surface 27 µm too low, six times what was said to be sure."""
    pool, seen = draw(OUT_OF_VIEW)
    row = slice(8, 12)
    match = matched(seen)
    assert (match.witness[12, row] == 0).all()
    assert (match.witness[10, [3, 16]] == -1).all()  # dark, and far within the view
    size = measure_surface(fit.reconstruct(match, BENCH_RIG, FitSettings()), match, BENCH_RIG)
    assert abs(size.height_mm - pool.size.height_mm) < 2 * size.height_sigma_mm


@pytest.mark.slow
@pytest.mark.parametrize("seed", [51000, 51009, 51018])
def test_a_dot_that_is_missing_at_the_rim_does_not_lower_the_pool(seed: int) -> None:
    """A dark ray beside the boundary may have come back, as often as dots are missing elsewhere."""
    pool, seen = draw(seed, missing=6)
    match = matched(seen, BENCH_RIG)
    off = [
        measure_surface(fit.reconstruct(each, BENCH_RIG, FitSettings()), each, BENCH_RIG).height_mm
        / pool.size.height_mm
        - 1
        for each in (match, replace(match, missing=0.0))
    ]
    assert abs(off[0]) < 0.03
    assert off[1] < -0.05
