"""Frames whose rows are a row off the others' are not answered."""

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
    """A pool that swings, frame by frame, with its true rays."""
    rng = np.random.default_rng(seed)
    wave = Wave((1, 1), 0.015, frequency_hz=30.0, turned_deg=rng.uniform(0.0, 360.0))
    made = []
    for k in range(count):
        width = 6.0 * rng.normal(1.0, 0.01)
        pool = egg(width, 2.9, 3.7, 0.3, (0.1, -0.2), (replace(wave, time_s=k / 200),))
        match = exact_match(trace(pool, BENCH_RIG), BENCH_RIG, sigma_mm=0.02, rng=rng)
        surface = fit.reconstruct(match, BENCH_RIG, SETTINGS.fit)
        made.append(Measurement("ok", "", "fit", match=match, reconstruction=surface))
    return made


def slipped(right: Measurement, by: tuple[int, int]) -> Measurement:
    """What a frame gives whose rays are all so many rows and columns off."""
    assert right.match is not None
    witness = np.roll(right.match.witness, by, (0, 1))
    match = replace(right.match, ray=right.match.ray + by, witness=witness)
    surface = fit.reconstruct(match, BENCH_RIG, SETTINGS.fit)
    return replace(right, match=match, reconstruction=surface)


def statuses(measured: list[Measurement]) -> list[str]:
    return [each.status for each in judged_together(measured)]


def judged_together(measured: list[Measurement]) -> list[Measurement]:
    vote = RowVote(BENCH_RIG, SETTINGS)
    ballots = [vote.add(each) for each in measured]
    return [vote.judged(each) for each in ballots]


def left_open(right: Measurement, *, true_cost: float, by: tuple[int, int] = (1, 0)) -> Measurement:
    """The frame with its rows open; the right ones cost so much more than those by a step on."""
    wrong = slipped(right, by)
    assert right.match is not None
    dots = Dots(*np.zeros((7, right.match.dot.max() + 1)))
    candidates = Candidate(wrong.match, (0, 0), 0.0), Candidate(right.match, (-1, 0), true_cost)
    status = "ambiguous-rows", "two holes", "fit", dots
    return OpenMeasurement(*status, candidates=candidates)


def rows_are_right(measured: Measurement, right: Measurement) -> bool:
    assert measured.match is not None
    assert right.match is not None
    return np.array_equal(measured.match.ray, right.match.ray)


@pytest.mark.parametrize("index", [0, 1, 3])
@pytest.mark.parametrize("true_cost", [-8.0, -1.0])
def test_an_open_frame_gets_the_rows_of_those_beside_it(index: int, true_cost: float) -> None:
    right = frames(4)
    measured = list(right)
    measured[index] = left_open(right[index], true_cost=true_cost)
    judged = judged_together(measured)
    assert [each.status for each in judged] == ["ok"] * 4
    assert [rows_are_right(*each) for each in zip(judged, right, strict=True)] == [True] * 4
    assert judged[index].measures is not None
    assert judged[index].lattice is not None


def test_open_frames_can_follow_on_each_other() -> None:
    right = frames(8)
    measured = [left_open(each, true_cost=-3.0) if k > 1 else each for k, each in enumerate(right)]
    judged = judged_together(measured)
    assert [rows_are_right(*each) for each in zip(judged, right, strict=True)] == [True] * 8


def test_a_frame_that_speaks_against_its_neighbours_rows_needs_them_on_both_sides() -> None:
    """A pool that has gone on by a row looks like one whose rows slipped."""
    right = frames(4)
    measured = [*right[:3], left_open(right[3], true_cost=2.0)]
    assert statuses(measured) == ["ok"] * 3 + ["ambiguous-rows"]
    measured = [*right[:2], left_open(right[2], true_cost=2.0), right[3]]
    assert statuses(measured) == ["ok"] * 4


def test_an_open_frame_without_support_stays_refused() -> None:
    """One sure frame beside it is too few; so are frames that are open themselves."""
    first, second, third = frames(3)
    assert statuses([first, left_open(second, true_cost=-8.0)]) == ["ok", "ambiguous-rows"]
    measured = [left_open(each, true_cost=-8.0) for each in (first, second, third)]
    assert statuses(measured) == ["ambiguous-rows"] * 3


def test_open_frames_that_speak_for_a_rival_over_time_are_refused() -> None:
    right = frames(9)
    measured = [left_open(each, true_cost=12.0) if k % 2 else each for k, each in enumerate(right)]
    judged = [each.status for each in judged_together(measured)][1::2]
    assert judged == ["ok", "ok", "ok", "ambiguous-rows"]  # the last of which is too much


def test_between_frames_that_disagree_on_the_rows_an_open_one_stays_refused() -> None:
    right = frames(6)
    measured = [*right[:3], left_open(right[3], true_cost=-8.0), slipped(right[4], (1, 0))]
    assert statuses(measured)[3:] == ["ambiguous-rows"] * 2


def test_candidates_none_of_which_is_near_the_frames_beside_it_are_refused() -> None:
    right = frames(5)
    measured = [*right[:3], left_open(slipped(right[3], (-1, -1)), true_cost=-8.0), right[4]]
    judged = judged_together(measured)
    assert [each.status for each in judged] == ["ok"] * 3 + ["ambiguous-rows", "ok"]
    assert type(judged[3]) is Measurement


def test_frames_that_agree_are_told() -> None:
    assert statuses(frames(5)) == ["ok"] * 5


@pytest.mark.parametrize("by", [(1, 0), (-1, 0), (0, 1), (0, -1), (2, 0)])
@pytest.mark.parametrize("index", [0, 2, 4])
def test_a_frame_a_row_off_the_others_is_not(index: int, by: tuple[int, int]) -> None:
    measured = frames(5)
    measured[index] = slipped(measured[index], by)
    expected = ["ok"] * 5
    expected[index] = "ambiguous-rows"
    assert statuses(measured) == expected


def test_nothing_wrong_is_left_of_a_frame_that_is_not_told() -> None:
    first, second, third = frames(3)
    vote = RowVote(BENCH_RIG, SETTINGS)
    measured = [first, slipped(second, (1, 0)), third]
    ballots = [vote.add(each) for each in measured]
    told = vote.judged(ballots[1])
    assert told.match is told.reconstruction is told.measures is None
    assert "1 of 3" not in told.reason
    assert "2 of 3" in told.reason


def test_of_two_that_disagree_neither_is_told() -> None:
    first, second = frames(2)
    assert statuses([first, slipped(second, (1, 0))]) == ["ambiguous-rows"] * 2


def test_rows_that_an_operator_gave_are_binding() -> None:
    measured = frames(4)
    wrong = slipped(measured[2], (1, 0))
    measured[2] = replace(wrong, correction=Correction.of(Dots(*np.empty((7, 0))), None))
    assert statuses(measured) == ["ok"] * 4


def test_what_follows_a_frame_has_its_rows() -> None:
    """Followed frames have the rows of the one that they follow, and no vote of their own."""
    right = frames(8)
    measured = [slipped(each, (1, 0)) if 3 <= k < 7 else each for k, each in enumerate(right)]
    vote = RowVote(BENCH_RIG, SETTINGS)
    ballots = [vote.add(each, followed=k in {4, 5, 6}) for k, each in enumerate(measured)]
    assert [each.at for each in ballots] == [*[(0, 0)] * 3, *[(1, 0)] * 4, (0, 0)]
    told = [vote.judged(each).status for each in ballots]
    assert told == [*["ok"] * 3, *["ambiguous-rows"] * 4, "ok"]


def test_what_follows_a_corrected_frame_was_not_followed_from_it() -> None:
    right = frames(6)
    corrected = replace(
        slipped(right[3], (1, 0)), correction=Correction.of(Dots(*np.empty((7, 0))), None)
    )
    measured = [*right[:3], corrected, *right[4:]]
    vote = RowVote(BENCH_RIG, SETTINGS)
    ballots = [vote.add(each, followed=k > 3) for k, each in enumerate(measured)]
    assert [each.at for each in ballots] == [*[(0, 0)] * 3, (1, 0), *[(0, 0)] * 2]
    assert [vote.judged(each).status for each in ballots] == ["ok"] * 6
