"""Frames whose rows are a row off the others' are not answered."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from labapp.core.images.dots import Dots
from labapp.core.pipeline import Measurement, Settings
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
    vote = RowVote(BENCH_RIG, SETTINGS)
    ballots = [vote.add(each) for each in measured]
    return [vote.judged(each).status for each in ballots]


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
