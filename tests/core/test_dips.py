"""Pools with a dip under the torch, where labels shifted by a row fit nearly as well."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from labapp.core.geometry.bench import Bench
from labapp.core.images.peaks import DetectorTuning
from labapp.core.matching import decision
from labapp.core.matching.checks import unexplained
from labapp.core.matching.decision import decide
from labapp.core.matching.hypothesis import Hypothesis, evaluate
from labapp.core.matching.match_settings import MatchSettings
from labapp.core.matching.observation import UNLABELLED, Observation
from labapp.core.matching.relabelling import shifted_labels
from labapp.core.schemes import fit
from labapp.core.schemes.fit import FitSettings
from labapp.core.sequence.prior import Prior
from labapp.core.sequence.tracking import track
from labapp.core.surface.measures import measure_surface
from labapp.core.values import CannotMeasure, IntArray
from labapp.simulation.forward import trace
from labapp.simulation.pools import Dent, egg
from tests.benchmarks.dips import draw, matched, measure_pool
from tests.scenes import BENCH_RIG, BENCH_VIEW, FRAME_SHAPE, SeenDots, see, true_labels

SHIFTED = 37
"""A pool that was once matched with every ray a row off."""

ROWS_OMITTED = (7246, 7690, 7841)
"""Pools once matched with the first of several hypotheses, which omitted a row."""

ROW_LEFT_OVER = 60361
"""A pool once matched without its last row, whose rays counted as dark: 22 % too low."""

UNEXPLAINED_DOT = 16
"""A pool once matched with every ray a row off: two dots without a ray merge on that surface, and
did not count as stray."""

COLUMN_SKIPPED = 60352
"""A pool that was once not measured: a hypothesis from a cap had skipped a column."""

CROSSED = (7004, 7008, 7148)
"""Pools in whose dip two rows cross: growth swaps some of their dots."""


EXCHANGED = 52867
"""A pool in whose dip the dots of two rays were once exchanged."""


BEYOND_VIEW = 61099
"""A pool whose last row left the view farther than was predicted: once 10 % too low, by 5.5 σ."""


def observation_of(seen: SeenDots) -> tuple[Observation, IntArray]:
    """Return the observation, and the true labels."""
    bench = Bench(BENCH_RIG, BENCH_VIEW)
    return Observation.of(seen.dots, bench, FRAME_SHAPE), true_labels(seen)


def evaluated(observed: Observation, labels: IntArray) -> Hypothesis:
    hypothesis = evaluate(observed, labels)
    assert hypothesis is not None
    return hypothesis


NO_ROWS = (7005, 7016)
"""Pools whose dots form no rows, and no quadric around the absent one."""


@pytest.mark.slow
@pytest.mark.parametrize(
    "seed",
    [SHIFTED, UNEXPLAINED_DOT, 2, *CROSSED, *NO_ROWS, ROW_LEFT_OVER, COLUMN_SKIPPED],
)
def test_pool_with_a_dip_gets_the_right_rows(seed: int) -> None:
    got = measure_pool(*draw(seed))
    assert (got.status, got.wrong) == ("ok", 0)
    assert got.right >= 0.95 * got.shown
    assert abs(got.height) < 0.03


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 2, 7, 8])
def test_rows_crossing_at_the_absent_dot_are_not_shifted(seed: int) -> None:
    """The usual knots cannot follow this dip. The rows were once one off."""
    pool = egg(6.0, 2.73, 4.46, 0.18, (-0.08, -0.37), (Dent(0.065, 0.68, (-0.215, 1.29)),))
    got = measure_pool(pool, see(pool, np.random.default_rng(seed), sigma_px=0.06))
    assert got.wrong == 0
    assert got.status in {"ambiguous-rows", "ok"}


def test_rows_are_ambiguous_if_dots_beside_the_absent_one_have_no_ray() -> None:
    """Three of the four have none; a dot near them had the ray of one."""
    assert measure_pool(*draw(7397)).status == "ambiguous-rows"


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 3, 4])
def test_dot_beside_crossing_rows_is_not_given_the_ray_of_another(seed: int) -> None:
    pool = egg(6.17, 3.35, 4.07, 0.361, (-0.112, 0.121), (Dent(0.062, 0.642, (-1.353, 0.924)),))
    got = measure_pool(pool, see(pool, np.random.default_rng(seed), sigma_px=0.06))
    assert (got.status, got.wrong) == ("ok", 0)
    assert got.right >= 0.9 * got.shown


def test_dots_that_fit_each_others_rays_get_none() -> None:
    """Rows cross there: the surface through exchanged dots costs as much."""
    got = measure_pool(*draw(EXCHANGED))
    assert (got.status, got.wrong) == ("ok", 0)
    assert got.right >= 0.85 * got.shown


def test_rays_of_a_row_that_may_be_out_of_view_are_not_dark() -> None:
    """Two of the row's dots were predicted in view, the others out of it."""
    pool, seen = draw(BEYOND_VIEW, missing=4, false=12)
    match = matched(seen)
    hit = trace(pool, BENCH_RIG).hit
    row, columns = 12, slice(8, 12)
    assert hit[row, columns].all()
    assert (match.ray_states[row, columns] == 0).all()


def test_dots_in_doubt_are_not_exchanged_in_the_next_frame() -> None:
    """A narrow dip: the surface through the other dots predicts the crossed ones exchanged."""
    rng = np.random.default_rng(40)
    dip = Dent(rng.uniform(0.004, 0.02), rng.uniform(0.25, 0.5), tuple(rng.uniform(-1.2, 1.2, 2)))
    pool = egg(7.0, 3.5, 4.0, rng.uniform(0.07, 0.15), (0.0, 0.0), (dip,))
    seen, bench = see(pool, rng, sigma_px=0.06), Bench(BENCH_RIG, BENCH_VIEW)
    match = matched(seen)
    fitted = fit.fit_surface(match, BENCH_RIG, FitSettings())
    found = fit.bound_and_measure(match, fitted, BENCH_RIG)
    tuning = DetectorTuning(2.0, np.ones(FRAME_SHAPE, np.float32), 1.0, 1.0)
    prior = Prior.of(bench, tuning, match, fitted, *found)
    observed, _ = observation_of(seen)
    followed = track(prior, observed, MatchSettings()).match
    assert (seen.ray[followed.dot] == followed.ray).all()
    assert len(followed.dot) >= 0.9 * len(seen.ray)


@pytest.mark.slow
def test_row_beyond_shifted_labels_is_searched(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(unexplained, "ROW", 1000)  # or the labels without it would be rejected
    got = measure_pool(*draw(ROW_LEFT_OVER))
    assert (got.status, got.wrong, got.right) == ("ok", 0, got.shown)


def test_labels_that_miss_a_row_of_dots_are_rejected() -> None:
    observed, labels = observation_of(draw(ROW_LEFT_OVER)[1])
    rows = np.flatnonzero((labels != UNLABELLED).any(axis=1))
    labels[rows[-1]] = UNLABELLED
    lacking = evaluated(observed, labels)
    assert (lacking.stray_count, lacking.missed_count, lacking.marker) == (9, 0, "empty")
    with pytest.raises(CannotMeasure) as error:
        decide(observed, [lacking], MatchSettings())
    assert error.value.status == "no-match"


@pytest.mark.slow
@pytest.mark.parametrize("seed", [60031, 60151, *ROWS_OMITTED])
def test_rows_crossing_in_a_narrow_dip_are_matched(seed: int) -> None:
    """Finer knots are needed: stiff ones led back to three swapped labels, and no match."""
    got = measure_pool(*draw(seed))
    assert (got.status, got.wrong) == ("ok", 0)
    assert got.right >= 0.9 * got.shown


def test_caps_do_not_replace_a_better_match() -> None:
    """When caps were always tried as well, this pool had five wrong labels at its rim."""
    got = measure_pool(*draw(7306))
    assert (got.status, got.wrong) == ("ok", 0)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("seed", "missing", "false"),
    [(20011, 0, 2), (22036, 6, 3), (22099, 6, 3), (30009, 9, 0), (30013, 9, 0)],
)
def test_missing_and_false_dots_give_no_wrong_rows(seed: int, missing: int, false: int) -> None:
    """Once these were matched a row off, two rows off, and with a row skipped."""
    assert measure_pool(*draw(seed, missing, false)).wrong == 0


@pytest.mark.slow
def test_boundary_alone_does_not_reject_rows() -> None:
    """Without a bound on its likelihood, the right rows lost to others."""
    got = measure_pool(*draw(9007, missing=6, false=3))
    assert (got.status, got.wrong) == ("ok", 0)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("seed", "missing", "false"),
    [(30005, 9, 0), (30010, 9, 0), (30015, 9, 0), (9064, 6, 3), (9070, 6, 3)],
)
def test_many_isolated_rays_without_a_dot_are_tolerated(
    seed: int, missing: int, false: int
) -> None:
    """As are dots without a ray. Outlying labels at the rim are removed (9070: three)."""
    got = measure_pool(*draw(seed, missing, false))
    assert (got.status, got.wrong) == ("ok", 0)
    assert got.right >= 0.94 * got.shown


@pytest.mark.slow
@pytest.mark.parametrize("seed", [52009, 52023, 52030, 52031, 52072])
def test_dip_with_missing_dots_beside_it_is_matched(seed: int) -> None:
    """Rows and quadric fail, and the cap that explains most dots has wrong rays."""
    got = measure_pool(*draw(seed, missing=6, false=3))
    assert (got.status, got.wrong) == ("ok", 0)
    assert got.right >= 0.9 * got.shown


@pytest.mark.slow
@pytest.mark.parametrize("seed", [52014, 52094, 61008])
def test_smoother_surface_identifies_the_marker_of_two_holes(seed: int) -> None:
    """Missing dots make a second hole; the rows it implies fit too, but need a rougher surface."""
    got = measure_pool(*draw(seed, missing=6, false=3))
    assert (got.status, got.wrong) == ("ok", 0)
    assert got.right >= 0.9 * got.shown


def test_false_dot_near_a_predicted_dot_at_the_rim_gets_no_ray() -> None:
    """It is 0.5 mm from the predicted dot of a ray that did not come back."""
    got = measure_pool(*draw(71011, missing=6, false=3))
    assert (got.status, got.wrong) == ("ok", 0)
    assert got.right >= 0.95 * got.shown


def test_three_missing_dots_at_a_corner_are_no_row() -> None:
    got = measure_pool(*draw(52040, missing=6, false=3))
    assert (got.status, got.wrong) == ("ok", 0)


def test_rows_are_beyond_doubt_only_if_the_surface_fits_the_dots() -> None:
    seen = see(egg(5.8, 2.6, 3.2, 0.28), np.random.default_rng(1))
    observed, labels = observation_of(seen)
    fits, margin = evaluated(observed, labels), MatchSettings().margin
    assert (fits.label_count, fits.missed_count) == (len(observed.plane_mm), 0)
    assert decision._beyond_doubt(observed, fits, margin)
    noise_mm = np.random.default_rng(2).normal(0.0, 0.15, observed.plane_mm.shape)
    moved = replace(observed, plane_mm=observed.plane_mm + noise_mm)
    doubtful = evaluated(moved, labels)
    assert (doubtful.missed_count, doubtful.marker) == (0, "empty")
    assert not decision._beyond_doubt(moved, doubtful, margin)


def test_wrong_rows_need_a_rougher_surface() -> None:
    observed, labels = observation_of(draw(SHIFTED)[1])
    shifted = [evaluated(observed, other) for other in shifted_labels(observed, labels)]
    assert evaluated(observed, labels).roughness < min(other.roughness for other in shifted)


def test_true_rows_cost_less_than_rows_with_a_dot_on_the_marker() -> None:
    observed, labels = observation_of(draw(SHIFTED)[1])
    true = evaluated(observed, labels)
    shifted = [evaluated(observed, other) for other in shifted_labels(observed, labels)]
    assert (true.marker, true.stray_count, true.missed_count) == ("empty", 0, 0)
    assert {other.marker for other in shifted} == {"lit"}
    assert true.cost < min(other.cost for other in shifted) - 50


def test_marker_not_amid_labelled_rays_is_unknown() -> None:
    observed, labels = observation_of(draw(SHIFTED)[1])
    assert BENCH_RIG.pattern.marker is not None
    partial_labels = labels.copy()
    partial_labels[: BENCH_RIG.pattern.marker[0]] = UNLABELLED
    partial_labels[:, : BENCH_RIG.pattern.marker[1]] = UNLABELLED
    assert evaluated(observed, partial_labels).marker == "unknown"


OUT_OF_VIEW = 41110
"""A pool whose next row after the last visible one lies just beyond the imaging plane."""


def test_row_possibly_out_of_view_is_not_dark() -> None:
    """Counted as dark, its rays lowered the surface by 27 µm, six times its uncertainty."""
    pool, seen = draw(OUT_OF_VIEW)
    row = slice(8, 12)
    match = matched(seen)
    assert (match.ray_states[12, row] == 0).all()
    assert (match.ray_states[10, [3, 16]] == -1).all()  # dark, and far within the view
    size = measure_surface(fit.reconstruct(match, BENCH_RIG, FitSettings()), match, BENCH_RIG)
    assert abs(size.height_mm - pool.size.height_mm) < 2 * size.height_sigma_mm


@pytest.mark.slow
@pytest.mark.parametrize("seed", [51000, 51009, 51018])
def test_missing_dot_at_the_rim_does_not_bias_the_height(seed: int) -> None:
    """A dark ray beside the boundary may be a missing dot, as likely as dots are elsewhere."""
    pool, seen = draw(seed, missing=6)
    match = matched(seen, BENCH_RIG)
    error = [
        measure_surface(fit.reconstruct(each, BENCH_RIG, FitSettings()), each, BENCH_RIG).height_mm
        / pool.size.height_mm
        - 1
        for each in (match, replace(match, missing=0.0))
    ]
    assert abs(error[0]) < 0.03
    assert error[1] < -0.05
