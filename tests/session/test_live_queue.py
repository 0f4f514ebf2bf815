"""Frames that wait: measured at even steps, as many as can be, and never far behind for long."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest

from labapp.media.cameras import CameraFrame
from labapp.session.live_queue import MOST, SHARE, SWING_S, FrameQueue

RATE_HZ = 200.0
IMAGE = np.zeros((1, 1), np.uint8)


@dataclass(frozen=True)
class Measured:
    """A frame that was measured, and when that was begun, s."""

    number: int
    began_s: float

    @property
    def age_s(self) -> float:
        return self.began_s - self.number / RATE_HZ


def measure(
    queue: FrameQueue, frames: range, took_s: float, cold: frozenset[int] = frozenset()
) -> list[Measured]:
    """Have a camera give frames while they are measured, each in a time; by itself in 1.5 s."""
    done, free_s = [], 0.0
    for number in frames:
        now_s = number / RATE_HZ
        free_s = max(free_s, frames[0] / RATE_HZ)
        while free_s <= now_s and (frame := queue.next()) is not None:
            done.append(Measured(frame.number, max(free_s, frame.number / RATE_HZ)))
            followed = len(done) not in cold
            own_s = took_s if followed else 1.5
            free_s = done[-1].began_s + own_s
            queue.done(followed, own_s)
        queue.put(CameraFrame(number, now_s, now_s, IMAGE))
    return done


@pytest.mark.parametrize("took_s", [0.002, 0.006, 0.011, 0.03])
def test_steps_are_even_and_as_small_as_measuring_allows(took_s: float) -> None:
    queue = FrameQueue()
    done = measure(queue, range(2000), took_s)
    settled = [one.number for one in done if one.number > 1000]
    every = int(np.ceil(took_s / SHARE * RATE_HZ - 1e-6))
    assert set(np.diff(settled)) == {every}
    assert queue.every == every
    assert max(one.age_s for one in done if one.number > 1000) < 0.02


def test_at_first_steps_are_large_enough_for_a_swing() -> None:
    done = measure(FrameQueue(), range(400), 0.002)
    steps = np.diff([one.number for one in done[2 : 2 * MOST]])
    assert steps.min() >= SWING_S * RATE_HZ


def test_after_a_frame_measured_by_itself_come_those_right_after_it_and_then_the_newest() -> None:
    done = measure(FrameQueue(), range(4000), 0.006, cold=frozenset({101}))
    at = done[100].number
    after = [one.number for one in done[100 : 101 + MOST]]
    assert np.diff(after).max() <= 4
    jumped = done[101 + MOST]
    assert jumped.number > at + 100
    assert jumped.age_s < 0.05
    assert set(np.diff([one.number for one in done if one.number > jumped.number + 700])) == {2}


def test_where_measuring_becomes_slow_it_is_never_behind_for_long() -> None:
    queue = FrameQueue()
    measure(queue, range(1000), 0.005)
    done = measure(queue, range(1000, 5000), 0.05)
    assert max(one.age_s for one in done if one.number > 3000) < 0.1
    done = measure(queue, range(5000, 9000), 0.005)
    assert set(np.diff([one.number for one in done if one.number > 8000])) == {2}


def test_a_camera_that_counts_from_the_start_again_goes_on() -> None:
    queue = FrameQueue()
    measure(queue, range(1000), 0.005)
    queue.put(CameraFrame(0, 9.0, 9.0, IMAGE))
    numbers = []
    while (frame := queue.next()) is not None:
        numbers.append(frame.number)
    assert numbers[-1] == 0
