"""Queue of live frames: even steps, as many frames as possible, no long delays."""

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
    """A measured frame, and the time at which its measurement began, s."""

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
    """Simulate a camera whose frames are measured, each in ``took_s``.

    The n-th measured frames, n in ``cold``, are measured by themselves, in 1.5 s; so is a frame
    far from the one before, unless 16 were followed until then. Those in ``slow`` take 10 s.
    """
    measured: list[Measured] = []
    free_s, followed_count = frames[0] / RATE_HZ, MOST
    busy: tuple[bool, float] | None = None
    for number in frames:
        now_s = number / RATE_HZ
        while free_s <= now_s:
            if busy is not None:
                queue.done(*busy)
            busy, frame = None, queue.next()
            if frame is None:
                break
            measured.append(Measured(frame.number, max(free_s, frame.number / RATE_HZ)))
            far = (
                len(measured) > 1 and measured[-1].number - measured[-2].number > REACH_S * RATE_HZ
            )
            followed = len(measured) not in cold and (not far or followed_count >= MOST // 2)
            followed_count = followed_count + 1 if followed else 0
            duration_s = COLD_S if not followed else 10.0 if len(measured) in slow else took_s
            busy, free_s = (followed, duration_s), measured[-1].began_s + duration_s
        queue.put(CameraFrame(number, now_s, now_s, IMAGE))
    return measured


@pytest.mark.parametrize("took_s", [0.002, 0.006, 0.011, 0.03])
def test_steps_are_even_and_as_small_as_possible(took_s: float) -> None:
    queue = FrameQueue()
    measured = measure(queue, range(2000), took_s)
    settled = [frame.number for frame in measured if frame.number > 1000]
    every = int(np.ceil(took_s / SHARE * RATE_HZ - 1e-6))
    assert set(np.diff(settled)) == {every}
    assert queue.every == every
    assert max(frame.age_s for frame in measured if frame.number > 1000) < 0.02


def test_first_steps_cover_an_oscillation() -> None:
    measured = measure(FrameQueue(), range(400), 0.002)
    steps = np.diff([frame.number for frame in measured[2 : 2 * MOST]])
    assert steps.min() >= SWING_S * RATE_HZ


def test_frame_measured_alone_is_followed_by_the_next_then_the_newest() -> None:
    measured = measure(FrameQueue(), range(4000), 0.006, cold=frozenset({101}))
    cold_number = measured[100].number
    after = [frame.number for frame in measured[100 : 101 + MOST]]
    assert np.diff(after).max() <= 4
    jumped = measured[101 + MOST]
    assert jumped.number > cold_number + 100
    assert jumped.age_s < 0.05
    assert set(
        np.diff([frame.number for frame in measured if frame.number > jumped.number + 700])
    ) == {2}


@pytest.mark.parametrize("lost", [1, 4, 20])
def test_results_are_delayed_by_one_search_at_most(lost: int) -> None:
    """Frames after a searched frame have to be searched, too."""
    cold = frozenset(range(101, 102 + lost))
    measured = measure(FrameQueue(), range(10_000), 0.006, cold=cold)
    assert max(frame.age_s for frame in measured) < COLD_S + 0.05
    assert max(frame.age_s for frame in measured[-1000:]) < 0.05


def test_slower_measuring_causes_no_long_delay() -> None:
    queue = FrameQueue()
    measure(queue, range(1000), 0.005)
    measured = measure(queue, range(1000, 5000), 0.05)
    assert max(frame.age_s for frame in measured if frame.number > 3000) < 0.1
    measured = measure(queue, range(5000, 9000), 0.005)
    assert set(np.diff([frame.number for frame in measured if frame.number > 8000])) == {2}


@pytest.mark.parametrize("took_s", [0.12, 0.4, 2.3])
def test_old_frames_are_skipped_and_counted_without_processor_time(took_s: float) -> None:
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


def test_frames_are_followed_again_after_a_long_delay() -> None:
    queue = FrameQueue()
    measured = measure(
        queue, range(16000), 0.006, cold=frozenset({200, 201}), slow=frozenset({199})
    )
    assert max(frame.age_s for frame in measured if frame.number > 9000) < 0.1
    assert set(np.diff([frame.number for frame in measured if frame.number > 12000])) == {2}


def test_steps_do_not_change_if_the_camera_clock_is_set_back() -> None:
    queue, numbers = FrameQueue(), []
    for number in range(2000):
        time_s = number / RATE_HZ if number < 500 else 2.5 + 1e-6 * number
        queue.put(CameraFrame(number, time_s, number / RATE_HZ, IMAGE))
        while (frame := queue.next()) is not None:
            numbers.append(frame.number)
            queue.done(True, 0.006)
    assert np.diff(numbers).max() <= 3


def test_camera_may_restart_its_frame_numbers() -> None:
    queue = FrameQueue()
    measure(queue, range(1000), 0.005)
    queue.put(CameraFrame(0, 9.0, 9.0, IMAGE))
    numbers = []
    while (frame := queue.next()) is not None:
        numbers.append(frame.number)
    assert numbers[-1] == 0
