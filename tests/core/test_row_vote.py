"""Frames whose rows are a row off those of the others are rejected."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from labapp.core.images.dots import Dots
from labapp.core.match import Candidate
from labapp.core.pipeline import Measurement, OpenMeasurement, Settings
from labapp.core.recording.row_vote import RowVote
from labapp.core.rows.correction import Correction
from labapp.core.schemes import fit
from labapp.simulation.forward import exact_match, trace
from labapp.simulation.pools import Wave, egg
from tests.scenes import BENCH_RIG

SETTINGS = Settings()


def frames(count: int, seed: int = 0) -> list[Measurement]:
    """Return the frames of an oscillating pool, with the true rays."""
    rng = np.random.default_rng(seed)
    wave = Wave((1, 1), 0.015, frequency_hz=30.0, turned_deg=rng.uniform(0.0, 360.0))
    measurements = []
    for k in range(count):
        width = 6.0 * rng.normal(1.0, 0.01)
        pool = egg(width, 2.9, 3.7, 0.3, (0.1, -0.2), (replace(wave, time_s=k / 200),))
        match = exact_match(trace(pool, BENCH_RIG), sigma_mm=0.02, rng=rng)
        surface = fit.reconstruct(match, BENCH_RIG, SETTINGS.fit)
        measurements.append(Measurement("ok", "", "fit", match=match, reconstruction=surface))
    return measurements


def slipped(right: Measurement, by: tuple[int, int]) -> Measurement:
    """Return the frame's measurement with all rays off by some rows and columns."""
    assert right.match is not None
    ray_states = np.roll(right.match.ray_states, by, (0, 1))
    match = replace(right.match, ray=right.match.ray + by, ray_states=ray_states)
    surface = fit.reconstruct(match, BENCH_RIG, SETTINGS.fit)
    return replace(right, match=match, reconstruction=surface)


def statuses(measured: list[Measurement]) -> list[str]:
    return [each.status for each in judged_together(measured)]


def judged_together(measured: list[Measurement]) -> list[Measurement]:
    vote = RowVote(BENCH_RIG, SETTINGS)
    ballots = [vote.add(each) for each in measured]
    return [vote.judged(each) for each in ballots]


def ambiguous(
    correct: Measurement, *, true_cost: float, by: tuple[int, int] = (1, 0)
) -> Measurement:
    """Return the frame with ambiguous rows; the true ones cost more than the shifted ones."""
    wrong = slipped(correct, by)
    assert correct.match is not None
    dots = Dots(*np.zeros((7, correct.match.dot.max() + 1)))
    candidates = Candidate(wrong.match, (0, 0), 0.0), Candidate(correct.match, (-1, 0), true_cost)
    status = "ambiguous-rows", "two holes", "fit", dots
    return OpenMeasurement(*status, candidates=candidates)


def rows_are_right(measured: Measurement, right: Measurement) -> bool:
    assert measured.match is not None
    assert right.match is not None
    return np.array_equal(measured.match.ray, right.match.ray)


@pytest.mark.parametrize("index", [0, 1, 3])
@pytest.mark.parametrize("true_cost", [-8.0, -1.0])
def test_ambiguous_frame_gets_the_rows_of_its_neighbours(index: int, true_cost: float) -> None:
    right = frames(4)
    measured = list(right)
    measured[index] = ambiguous(right[index], true_cost=true_cost)
    judged = judged_together(measured)
    assert [each.status for each in judged] == ["ok"] * 4
    assert [rows_are_right(*each) for each in zip(judged, right, strict=True)] == [True] * 4
    assert judged[index].measures is not None
    assert judged[index].lattice is not None


def test_consecutive_ambiguous_frames_are_resolved() -> None:
    right = frames(8)
    measured = [ambiguous(each, true_cost=-3.0) if k > 1 else each for k, each in enumerate(right)]
    judged = judged_together(measured)
    assert [rows_are_right(*each) for each in zip(judged, right, strict=True)] == [True] * 8


def test_frame_preferring_other_rows_needs_two_neighbours() -> None:
    """A pool that has moved by a row looks like one whose rows slipped."""
    right = frames(4)
    measured = [*right[:3], ambiguous(right[3], true_cost=2.0)]
    assert statuses(measured) == ["ok"] * 3 + ["ambiguous-rows"]
    measured = [*right[:2], ambiguous(right[2], true_cost=2.0), right[3]]
    assert statuses(measured) == ["ok"] * 4


def test_ambiguous_frame_without_support_stays_ambiguous() -> None:
    """A single certain neighbour is too few; ambiguous neighbours do not count."""
    first, second, third = frames(3)
    assert statuses([first, ambiguous(second, true_cost=-8.0)]) == ["ok", "ambiguous-rows"]
    measured = [ambiguous(each, true_cost=-8.0) for each in (first, second, third)]
    assert statuses(measured) == ["ambiguous-rows"] * 3


def test_frames_that_repeatedly_prefer_a_rival_are_rejected() -> None:
    right = frames(9)
    measured = [ambiguous(each, true_cost=12.0) if k % 2 else each for k, each in enumerate(right)]
    judged = [each.status for each in judged_together(measured)][1::2]
    assert judged == ["ok", "ok", "ok", "ambiguous-rows"]  # the last one exceeds the limit


def test_frame_between_disagreeing_neighbours_stays_ambiguous() -> None:
    right = frames(6)
    measured = [*right[:3], ambiguous(right[3], true_cost=-8.0), slipped(right[4], (1, 0))]
    assert statuses(measured)[3:] == ["ambiguous-rows"] * 2


def test_candidates_unlike_the_neighbours_are_rejected() -> None:
    right = frames(5)
    measured = [*right[:3], ambiguous(slipped(right[3], (-1, -1)), true_cost=-8.0), right[4]]
    judged = judged_together(measured)
    assert [each.status for each in judged] == ["ok"] * 3 + ["ambiguous-rows", "ok"]
    assert type(judged[3]) is Measurement


def test_frames_that_agree_are_accepted() -> None:
    assert statuses(frames(5)) == ["ok"] * 5


@pytest.mark.parametrize("by", [(1, 0), (-1, 0), (0, 1), (0, -1), (2, 0)])
@pytest.mark.parametrize("index", [0, 2, 4])
def test_frame_a_row_off_the_others_is_rejected(index: int, by: tuple[int, int]) -> None:
    measured = frames(5)
    measured[index] = slipped(measured[index], by)
    expected = ["ok"] * 5
    expected[index] = "ambiguous-rows"
    assert statuses(measured) == expected


def test_rejected_frame_contains_no_wrong_results() -> None:
    first, second, third = frames(3)
    vote = RowVote(BENCH_RIG, SETTINGS)
    measured = [first, slipped(second, (1, 0)), third]
    ballots = [vote.add(each) for each in measured]
    judged = vote.judged(ballots[1])
    assert judged.match is judged.reconstruction is judged.measures is None
    assert "1 of 3" not in judged.reason
    assert "2 of 3" in judged.reason


def test_two_disagreeing_frames_are_both_rejected() -> None:
    first, second = frames(2)
    assert statuses([first, slipped(second, (1, 0))]) == ["ambiguous-rows"] * 2


def test_corrected_rows_are_binding() -> None:
    measured = frames(4)
    wrong = slipped(measured[2], (1, 0))
    measured[2] = replace(wrong, correction=Correction.of(Dots(*np.empty((7, 0))), None))
    assert statuses(measured) == ["ok"] * 4


def test_tracked_frames_share_the_rows_of_the_first() -> None:
    """Tracked frames have no vote of their own."""
    right = frames(8)
    measured = [slipped(each, (1, 0)) if 3 <= k < 7 else each for k, each in enumerate(right)]
    vote = RowVote(BENCH_RIG, SETTINGS)
    ballots = [vote.add(each, tracked=k in {4, 5, 6}) for k, each in enumerate(measured)]
    assert [each.shift for each in ballots] == [*[(0, 0)] * 3, *[(1, 0)] * 4, (0, 0)]
    judged = [vote.judged(each).status for each in ballots]
    assert judged == [*["ok"] * 3, *["ambiguous-rows"] * 4, "ok"]


def test_frames_after_a_corrected_one_do_not_follow_it() -> None:
    right = frames(6)
    corrected = replace(
        slipped(right[3], (1, 0)), correction=Correction.of(Dots(*np.empty((7, 0))), None)
    )
    measured = [*right[:3], corrected, *right[4:]]
    vote = RowVote(BENCH_RIG, SETTINGS)
    ballots = [vote.add(each, tracked=k > 3) for k, each in enumerate(measured)]
    assert [each.shift for each in ballots] == [*[(0, 0)] * 3, (1, 0), *[(0, 0)] * 2]
    assert [vote.judged(each).status for each in ballots] == ["ok"] * 6
