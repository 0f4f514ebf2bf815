from __future__ import annotations

import itertools
import threading
import time
from dataclasses import replace

import numpy as np
import pytest

from labapp.errors import InputError
from labapp.media.cameras import (
    CameraError,
    CameraFrame,
    CameraLost,
    CameraSettings,
    Faults,
    Feed,
    SimulatedDevice,
    feed,
)
from tests.media.cameras.watching import Heard, number_in, numbered
from tests.waiting import PATIENCE_S, wait_until

LONG_AGO_S = 0.05
"""In place of seconds: a camera is silent for so long before it is said."""


@pytest.fixture
def hasty(monkeypatch: pytest.MonkeyPatch) -> None:
    """Retry and notice at once."""
    monkeypatch.setattr(feed, "RETRY_S", (0.01,))
    monkeypatch.setattr(feed, "SILENT_S", LONG_AGO_S)
    monkeypatch.setattr(feed, "HOPELESS_S", 0.2)
    monkeypatch.setattr(feed, "WAIT_S", 0.01)


def test_every_frame_is_handed_on_with_its_number_and_time() -> None:
    device = SimulatedDevice("test", numbered, rate_hz=1000)
    frames: list[CameraFrame] = []
    with Feed("test", device.open, frames.append) as running:
        wait_until(lambda: len(frames) >= 100)
        assert running.state == "running"
    assert running.state == "ended"
    assert [number_in(frame.image) for frame in frames] == list(range(len(frames)))
    assert [frame.number for frame in frames] == list(range(len(frames)))
    assert frames[0].time_s == 0
    assert np.diff([frame.time_s for frame in frames]) == pytest.approx(1e-3)
    assert running.counts == feed.Counts(len(frames), 0, 0, 0)


def test_what_cannot_be_opened_or_set_at_first_is_refused() -> None:
    device = SimulatedDevice("test", numbered)
    with pytest.raises(InputError, match="rate_hz"):
        Feed("test", device.open, print, settings=CameraSettings(rate_hz=-1))
    device.unplug()
    with pytest.raises(CameraLost, match="not connected"):
        Feed("test", device.open, print)


@pytest.mark.usefixtures("hasty")
def test_it_survives_fifty_disconnects_and_garbage_and_says_all_of_it() -> None:
    faults = Faults(garbage=0.05, dropped=0.02, unplug_every=40, unplugged_s=0.01, seed=3)
    device = SimulatedDevice("test", numbered, rate_hz=2000, faults=faults)
    frames: list[CameraFrame] = []
    heard = Heard()
    wanted = CameraSettings(region=(0, 0, 32, 16))
    with Feed("test", device.open, frames.append, heard.append, wanted) as running:
        wait_until(lambda: device.disconnects >= 50)
    counts = running.counts
    taken = device.taken
    assert counts.lost >= 49
    assert counts.frames == len(frames)
    # Nothing is made up and nothing is mixed up: each frame once, in order, whole, as it was set.
    told = [number_in(frame.image) for frame in frames]
    assert told == sorted(set(told))
    assert {frame.image.shape for frame in frames} == {(16, 32)}
    for frame in frames[::50]:
        assert np.array_equal(frame.image, numbered(number_in(frame.image))[:16])
    assert 0 < counts.broken < 0.08 * taken
    # What was lost just before the cable came out no camera can tell of.
    assert 0 <= taken - (counts.frames + counts.broken + counts.dropped) <= 60
    assert (np.diff([frame.time_s for frame in frames]) > 0).all()
    assert (np.diff([frame.number for frame in frames]) > 0).all()
    said = heard.words()
    assert said.count("was unplugged. Trying to get it back") == counts.lost
    assert said.count("it is back after") >= counts.lost - 1
    assert "incomplete, discarded" in said
    assert "lost in transfer" in said


def test_a_camera_that_stalls_is_said_to_and_goes_on(
    hasty: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(feed, "HOPELESS_S", 3600)
    device = SimulatedDevice("test", numbered, rate_hz=1000)
    frames: list[CameraFrame] = []
    heard = Heard()
    with Feed("test", device.open, frames.append, heard.append) as running:
        wait_until(lambda: bool(frames))
        device.stall(3600)
        wait_until(lambda: running.state == "stalled")
        device.stall(0)
        seen = len(frames)
        wait_until(lambda: len(frames) > seen)
        assert running.counts.lost == 0
    assert "still connected" in heard.words()
    assert "frames come again" in heard.words()


@pytest.mark.usefixtures("hasty")
def test_one_that_stalls_for_ever_is_opened_anew() -> None:
    device = SimulatedDevice("test", numbered, rate_hz=1000)
    frames: list[CameraFrame] = []
    heard = Heard()
    with Feed("test", device.open, frames.append, heard.append) as running:
        wait_until(lambda: bool(frames))
        device.stall(3600)
        wait_until(lambda: running.counts.lost > 0)
        device.stall(0)
        seen = len(frames)
        wait_until(lambda: len(frames) > seen)
    assert "no frame came for" in heard.words()


@pytest.mark.usefixtures("hasty")
def test_a_camera_that_waits_for_a_trigger_does_not_stall() -> None:
    device = SimulatedDevice("test", numbered)
    frames: list[CameraFrame] = []
    heard = Heard()
    wanted = CameraSettings(trigger="software")
    with Feed("test", device.open, frames.append, heard.append, wanted) as running:
        time.sleep(5 * LONG_AGO_S)
        assert running.state == "running"
        for count in range(1, 4):
            running.trigger()
            wait_until(lambda count=count: len(frames) == count)
        # By itself it takes none on being told: what was told meanwhile is not made up for.
        running.apply(CameraSettings(trigger="free")).result(PATIENCE_S)
        running.trigger()
        wait_until(lambda: len(frames) > 5)
        running.apply(CameraSettings(trigger="software")).result(PATIENCE_S)
        time.sleep(LONG_AGO_S)
        seen = len(frames)
        time.sleep(LONG_AGO_S)
        assert len(frames) == seen
    assert "no frame came" not in heard.words()


@pytest.mark.usefixtures("hasty")
def test_frames_that_were_asked_for_while_a_camera_was_away_are_not_taken_later() -> None:
    device = SimulatedDevice("test", numbered)
    frames: list[CameraFrame] = []
    wanted = CameraSettings(trigger="software")
    with Feed("test", device.open, frames.append, settings=wanted) as running:
        wait_until(lambda: running.state == "running")
        device.unplug()
        wait_until(lambda: running.state == "lost")
        for _ in range(5):
            running.trigger()
        device.plug()
        wait_until(lambda: running.state == "running")
        time.sleep(LONG_AGO_S)
        assert frames == []
        running.trigger()
        wait_until(lambda: len(frames) == 1)


@pytest.mark.usefixtures("hasty")
def test_a_camera_that_was_left_waiting_for_a_trigger_gives_frames() -> None:
    device = SimulatedDevice("test", numbered, rate_hz=1000)
    device.settings = replace(device.settings, trigger="software")
    frames: list[CameraFrame] = []
    with Feed("test", device.open, frames.append, settings=CameraSettings(rate_hz=500)) as running:
        wait_until(lambda: len(frames) > 10)
        assert running.settings.trigger == "free"
        assert running.settings.rate_hz == 500


def test_it_is_set_between_two_frames_and_stays_so_when_it_comes_back(hasty: None) -> None:
    device = SimulatedDevice("test", numbered, rate_hz=1000)
    frames: list[CameraFrame] = []
    with Feed("test", device.open, frames.append) as running:
        wait_until(lambda: len(frames) > 10)
        found = running.apply(CameraSettings(region=(0, 0, 20, 16))).result(PATIENCE_S)
        assert found == running.settings
        assert found.region == (0, 0, 20, 16)
        with pytest.raises(InputError, match="rate_hz"):
            running.apply(CameraSettings(rate_hz=-1)).result(PATIENCE_S)
        wait_until(lambda: frames[-1].image.shape == (16, 20))
        device.settings = CameraSettings(rate_hz=500, region=(0, 0, 32, 24))
        device.unplug(0.02)
        wait_until(lambda: running.counts.lost == 1 and running.state == "running")
        assert running.settings.region == (0, 0, 20, 16)
        seen = len(frames)
        wait_until(lambda: len(frames) > seen + 10)
    shapes = [frame.image.shape for frame in frames]
    assert shapes == sorted(shapes, reverse=True)
    assert set(shapes) == {(24, 32), (16, 20)}
    assert (np.diff([frame.time_s for frame in frames]) > 0).all()


def test_frames_that_do_not_come_while_it_is_set_are_said_and_numbered() -> None:
    device = SimulatedDevice("test", numbered, rate_hz=100)
    frames: list[CameraFrame] = []
    heard = Heard()

    def opened():
        camera = device.open()
        quick = camera.apply

        def slow(wanted: CameraSettings) -> CameraSettings:
            time.sleep(0.1)
            return quick(wanted)

        camera.apply = slow
        return camera

    with Feed("test", opened, frames.append, heard.append) as running:
        for count, wanted in (
            (1, CameraSettings(region=(0, 0, 20, 16), rate_hz=50)),
            (2, CameraSettings(rate_hz=-1)),
        ):
            seen = len(frames)
            wait_until(lambda seen=seen: len(frames) > seen + 5)
            running.apply(wanted).exception(PATIENCE_S)
            wait_until(lambda count=count: len(heard) == count)
        running.apply(CameraSettings(trigger="software")).result(PATIENCE_S)
        wait_until(lambda: len(heard) == 3)
        assert running.counts.dropped == 0
    pauses = [(a, b) for a, b in itertools.pairwise(frames) if b.number - a.number > 1]
    gaps_s = [b.arrived_s - a.arrived_s for a, b in pauses]
    assert [b.number - a.number for a, b in pauses] == [
        round(gap_s * rate_hz) for gap_s, rate_hz in zip(gaps_s, (100, 50), strict=True)
    ]
    assert min(gaps_s) >= 0.1
    assert [event.words for event in heard] == [
        f"set to rate 50 frames/s, region (0, 0, 20, 16); {gaps_s[0]:.2f} s without frames",
        f"it could not be set, and goes on as it was; {gaps_s[1]:.2f} s without frames",
        "set to trigger software",
    ]


@pytest.mark.usefixtures("hasty")
def test_what_keeps_it_from_being_opened_again_is_said_once() -> None:
    device = SimulatedDevice("test", numbered, rate_hz=1000)
    taken = False
    heard = Heard()
    refused = 0

    def opened():
        nonlocal refused
        if taken:
            refused += 1
            raise CameraError("it is used by another program")
        return device.open()

    with Feed("test", opened, lambda _: None, heard.append) as running:
        taken = True
        device.unplug(0.05)
        wait_until(lambda: refused >= 3)
        taken = False
        wait_until(lambda: running.state == "running")
    assert heard.words().count("used by another program") == 1


@pytest.mark.usefixtures("hasty")
def test_it_ends_while_its_camera_is_away() -> None:
    device = SimulatedDevice("test", numbered)
    running = Feed("test", device.open, lambda _: None)
    device.unplug()
    wait_until(lambda: running.state == "lost")
    running.stop()
    running.stop()
    assert running.state == "ended"


def test_one_that_has_ended_refuses_to_be_set() -> None:
    running = Feed("test", SimulatedDevice("test", numbered).open, lambda _: None)
    running.stop()
    with pytest.raises(CameraError, match="test is closed"):
        running.apply(CameraSettings(rate_hz=10)).result(PATIENCE_S)


def test_a_fault_of_whoever_takes_frames_is_said_and_lets_go_of_the_camera() -> None:
    device = SimulatedDevice("test", numbered)
    heard = Heard()
    closed = threading.Event()

    def opened():
        camera = device.open()
        camera.close = closed.set
        return camera

    def refuse(_: CameraFrame) -> None:
        raise RuntimeError("a fault")

    with Feed("test", opened, refuse, heard.append) as running:
        wait_until(lambda: running.state == "ended")
    assert closed.is_set()
    assert "a fault in the program ended its pictures" in heard.words()
