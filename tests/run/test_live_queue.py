"""Frames that wait: measured at even steps, as many as can be, and never far behind for long."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest

from labapp.media.cameras import CameraFrame
from labapp.run.live_queue import CATCH_UP_S, MOST, SHARE, SWING_S, FrameQueue

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


COLD_S, REACH_S = 1.5, 0.12


def measure(
    queue: FrameQueue,
    frames: range,
    took_s: float,
    cold: frozenset[int] = frozenset(),
    slow: frozenset[int] = frozenset(),
) -> list[Measured]:
    """Have a camera give frames while they are measured, each in a time.

    Measured by itself, in 1.5 s, is the how-many-th one as told, and any that is far from the one
    before where no 16 were followed until then. Slow ones take 10 s.
    """
    done: list[Measured] = []
    free_s, learnt = frames[0] / RATE_HZ, MOST
    busy: tuple[bool, float] | None = None
    for number in frames:
        now_s = number / RATE_HZ
        while free_s <= now_s:
            if busy is not None:
                queue.done(*busy)
            busy, frame = None, queue.next()
            if frame is None:
                break
            done.append(Measured(frame.number, max(free_s, frame.number / RATE_HZ)))
            far = len(done) > 1 and done[-1].number - done[-2].number > REACH_S * RATE_HZ
            followed = len(done) not in cold and (not far or learnt >= MOST // 2)
            learnt = learnt + 1 if followed else 0
            own_s = COLD_S if not followed else 10.0 if len(done) in slow else took_s
            busy, free_s = (followed, own_s), done[-1].began_s + own_s
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


@pytest.mark.parametrize("lost", [1, 4, 20])
def test_figures_never_grow_older_than_one_search_makes_them(lost: int) -> None:
    """Frames that come after one that was searched for have to be searched for, too."""
    cold = frozenset(range(101, 102 + lost))
    done = measure(FrameQueue(), range(10_000), 0.006, cold=cold)
    assert max(one.age_s for one in done) < COLD_S + 0.05
    assert max(one.age_s for one in done[-1000:]) < 0.05


def test_where_measuring_becomes_slow_it_is_never_behind_for_long() -> None:
    queue = FrameQueue()
    measure(queue, range(1000), 0.005)
    done = measure(queue, range(1000, 5000), 0.05)
    assert max(one.age_s for one in done if one.number > 3000) < 0.1
    done = measure(queue, range(5000, 9000), 0.005)
    assert set(np.diff([one.number for one in done if one.number > 8000])) == {2}


@pytest.mark.parametrize("took_s", [0.12, 0.4, 2.3])
def test_without_processor_time_old_frames_are_dropped_and_counted(took_s: float) -> None:
    """Frames after one that was measured without tracking would be 32 times ``took_s`` old."""
    queue = FrameQueue()
    done = measure(queue, range(20_000), took_s, cold=frozenset({1}))
    assert max(one.age_s for one in done) < max(COLD_S, took_s) + CATCH_UP_S + took_s
    passed = done[-1].number - done[0].number + 1 - len(done)
    assert 0 < queue.skipped <= passed


def test_no_frame_is_skipped_at_a_constant_step() -> None:
    queue = FrameQueue()
    measure(queue, range(1000), 0.002)
    assert queue.skipped == 0


def test_after_a_long_wait_frames_are_followed_again() -> None:
    queue = FrameQueue()
    done = measure(queue, range(16000), 0.006, cold=frozenset({200, 201}), slow=frozenset({199}))
    assert max(one.age_s for one in done if one.number > 9000) < 0.1
    assert set(np.diff([one.number for one in done if one.number > 12000])) == {2}


def test_a_camera_whose_clock_is_set_back_is_measured_as_before() -> None:
    queue, numbers = FrameQueue(), []
    for number in range(2000):
        time_s = number / RATE_HZ if number < 500 else 2.5 + 1e-6 * number
        queue.put(CameraFrame(number, time_s, number / RATE_HZ, IMAGE))
        while (frame := queue.next()) is not None:
            numbers.append(frame.number)
            queue.done(True, 0.006)
    assert np.diff(numbers).max() <= 3


def test_a_camera_that_counts_from_the_start_again_goes_on() -> None:
    queue = FrameQueue()
    measure(queue, range(1000), 0.005)
    queue.put(CameraFrame(0, 9.0, 9.0, IMAGE))
    numbers = []
    while (frame := queue.next()) is not None:
        numbers.append(frame.number)
    assert numbers[-1] == 0
