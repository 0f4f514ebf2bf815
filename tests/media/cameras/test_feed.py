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
    Feed,
    feed,
)
from tests.media.cameras.faulty import Faults, FaultyDevice
from tests.media.cameras.watching import Events, number_in, numbered
from tests.waiting import PATIENCE_S, wait_until

LONG_AGO_S = 0.05
"""Time of silence before a camera is reported, in place of seconds."""


@pytest.fixture
def hasty(monkeypatch: pytest.MonkeyPatch) -> None:
    """Shorten the times of retries and reports."""
    monkeypatch.setattr(feed, "RETRY_S", (0.01,))
    monkeypatch.setattr(feed, "SILENT_S", LONG_AGO_S)
    monkeypatch.setattr(feed, "HOPELESS_S", 0.2)
    monkeypatch.setattr(feed, "WAIT_S", 0.01)


def test_every_frame_is_passed_on_with_its_number_and_time() -> None:
    device = FaultyDevice("test", numbered, rate_hz=1000)
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


def test_failure_to_open_or_set_at_the_start_is_an_error() -> None:
    device = FaultyDevice("test", numbered)
    with pytest.raises(InputError, match="rate_hz"):
        Feed("test", device.open, print, settings=CameraSettings(rate_hz=-1))
    device.unplug()
    with pytest.raises(CameraLost, match="not connected"):
        Feed("test", device.open, print)


@pytest.mark.usefixtures("hasty")
def test_feed_survives_and_reports_fifty_disconnections() -> None:
    faults = Faults(garbage=0.05, dropped=0.02, unplug_every=40, unplugged_s=0.01, seed=3)
    device = FaultyDevice("test", numbered, rate_hz=2000, faults=faults)
    frames: list[CameraFrame] = []
    events = Events()
    settings = CameraSettings(region=(0, 0, 32, 16))
    with Feed("test", device.open, frames.append, events.append, settings) as running:
        wait_until(lambda: device.disconnects >= 50)
    counts = running.counts
    taken = device.taken
    assert counts.lost >= 49
    assert counts.frames == len(frames)
    # Each frame comes once, in order, complete, with the set region.
    numbers = [number_in(frame.image) for frame in frames]
    assert numbers == sorted(set(numbers))
    assert {frame.image.shape for frame in frames} == {(16, 32)}
    for frame in frames[::50]:
        assert np.array_equal(frame.image, numbered(number_in(frame.image))[:16])
    assert 0 < counts.broken < 0.08 * taken
    # Frames lost just before the disconnection cannot be counted.
    assert 0 <= taken - (counts.frames + counts.broken + counts.dropped) <= 60
    assert (np.diff([frame.time_s for frame in frames]) > 0).all()
    assert (np.diff([frame.number for frame in frames]) > 0).all()
    reported = events.words()
    assert reported.count("was unplugged. Trying to get it back") == counts.lost
    assert reported.count("it is back after") >= counts.lost - 1
    assert "incomplete, discarded" in reported
    assert "lost in transfer" in reported


def test_stalled_camera_is_reported_and_continues(
    hasty: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(feed, "HOPELESS_S", 3600)
    device = FaultyDevice("test", numbered, rate_hz=1000)
    frames: list[CameraFrame] = []
    events = Events()
    with Feed("test", device.open, frames.append, events.append) as running:
        wait_until(lambda: bool(frames))
        device.stall(3600)
        wait_until(lambda: running.state == "stalled")
        device.stall(0)
        count = len(frames)
        wait_until(lambda: len(frames) > count)
        assert running.counts.lost == 0
    assert "still connected" in events.words()
    assert "frames come again" in events.words()


@pytest.mark.usefixtures("hasty")
def test_camera_stalled_for_long_is_reopened() -> None:
    device = FaultyDevice("test", numbered, rate_hz=1000)
    frames: list[CameraFrame] = []
    events = Events()
    with Feed("test", device.open, frames.append, events.append) as running:
        wait_until(lambda: bool(frames))
        device.stall(3600)
        wait_until(lambda: running.counts.lost > 0)
        device.stall(0)
        count = len(frames)
        wait_until(lambda: len(frames) > count)
    assert "no frame came for" in events.words()


@pytest.mark.usefixtures("hasty")
def test_camera_waiting_for_a_trigger_is_not_stalled() -> None:
    device = FaultyDevice("test", numbered)
    frames: list[CameraFrame] = []
    events = Events()
    settings = CameraSettings(trigger="software")
    with Feed("test", device.open, frames.append, events.append, settings) as running:
        time.sleep(5 * LONG_AGO_S)
        assert running.state == "running"
        for count in range(1, 4):
            running.trigger()
            wait_until(lambda count=count: len(frames) == count)
        # A free-running camera ignores triggers, and they are not executed later.
        running.apply(CameraSettings(trigger="free")).result(PATIENCE_S)
        running.trigger()
        wait_until(lambda: len(frames) > 5)
        running.apply(CameraSettings(trigger="software")).result(PATIENCE_S)
        time.sleep(LONG_AGO_S)
        earlier = len(frames)
        time.sleep(LONG_AGO_S)
        assert len(frames) == earlier
    assert "no frame came" not in events.words()


@pytest.mark.usefixtures("hasty")
def test_triggers_of_a_lost_camera_are_not_executed_later() -> None:
    device = FaultyDevice("test", numbered)
    frames: list[CameraFrame] = []
    settings = CameraSettings(trigger="software")
    with Feed("test", device.open, frames.append, settings=settings) as running:
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
def test_trigger_mode_of_an_earlier_use_is_reset() -> None:
    device = FaultyDevice("test", numbered, rate_hz=1000)
    device.settings = replace(device.settings, trigger="software")
    frames: list[CameraFrame] = []
    with Feed("test", device.open, frames.append, settings=CameraSettings(rate_hz=500)) as running:
        wait_until(lambda: len(frames) > 10)
        assert running.settings.trigger == "free"
        assert running.settings.rate_hz == 500


def test_settings_are_applied_while_running_and_after_reconnection(hasty: None) -> None:
    device = FaultyDevice("test", numbered, rate_hz=1000)
    frames: list[CameraFrame] = []
    with Feed("test", device.open, frames.append) as running:
        wait_until(lambda: len(frames) > 10)
        applied = running.apply(CameraSettings(region=(0, 0, 20, 16))).result(PATIENCE_S)
        assert applied == running.settings
        assert applied.region == (0, 0, 20, 16)
        with pytest.raises(InputError, match="rate_hz"):
            running.apply(CameraSettings(rate_hz=-1)).result(PATIENCE_S)
        wait_until(lambda: frames[-1].image.shape == (16, 20))
        device.settings = CameraSettings(rate_hz=500, region=(0, 0, 32, 24))
        device.unplug(0.02)
        wait_until(lambda: running.counts.lost == 1 and running.state == "running")
        assert running.settings.region == (0, 0, 20, 16)
        count = len(frames)
        wait_until(lambda: len(frames) > count + 10)
    shapes = [frame.image.shape for frame in frames]
    assert shapes == sorted(shapes, reverse=True)
    assert set(shapes) == {(24, 32), (16, 20)}
    assert (np.diff([frame.time_s for frame in frames]) > 0).all()


def test_frames_missing_while_settings_change_are_reported() -> None:
    device = FaultyDevice("test", numbered, rate_hz=100)
    frames: list[CameraFrame] = []
    events = Events()

    def open_slow_camera():
        camera = device.open()
        apply = camera.apply

        def apply_slowly(settings: CameraSettings) -> CameraSettings:
            time.sleep(0.1)
            return apply(settings)

        camera.apply = apply_slowly
        return camera

    with Feed("test", open_slow_camera, frames.append, events.append) as running:
        for count, settings in (
            (1, CameraSettings(region=(0, 0, 20, 16), rate_hz=50)),
            (2, CameraSettings(rate_hz=-1)),
        ):
            earlier = len(frames)
            wait_until(lambda earlier=earlier: len(frames) > earlier + 5)
            running.apply(settings).exception(PATIENCE_S)
            wait_until(lambda count=count: len(events) == count)
        running.apply(CameraSettings(trigger="software")).result(PATIENCE_S)
        wait_until(lambda: len(events) == 3)
        assert running.counts.dropped == 0
    pauses = [(a, b) for a, b in itertools.pairwise(frames) if b.number - a.number > 1]
    gaps_s = [b.arrived_s - a.arrived_s for a, b in pauses]
    assert [b.number - a.number for a, b in pauses] == [
        round(gap_s * rate_hz) for gap_s, rate_hz in zip(gaps_s, (100, 50), strict=True)
    ]
    assert min(gaps_s) >= 0.1
    assert [event.words for event in events] == [
        f"set to rate 50 frames/s, region (0, 0, 20, 16); {gaps_s[0]:.2f} s without frames",
        f"it could not be set, and goes on as it was; {gaps_s[1]:.2f} s without frames",
        "set to trigger software",
    ]


@pytest.mark.usefixtures("hasty")
def test_reason_of_a_failed_reconnection_is_reported_once() -> None:
    device = FaultyDevice("test", numbered, rate_hz=1000)
    is_in_use = False
    events = Events()
    attempts = 0

    def open_camera():
        nonlocal attempts
        if is_in_use:
            attempts += 1
            raise CameraError("it is used by another program")
        return device.open()

    with Feed("test", open_camera, lambda _: None, events.append) as running:
        is_in_use = True
        device.unplug(0.05)
        wait_until(lambda: attempts >= 3)
        is_in_use = False
        wait_until(lambda: running.state == "running")
    assert events.words().count("used by another program") == 1


@pytest.mark.usefixtures("hasty")
def test_feed_can_be_stopped_while_its_camera_is_lost() -> None:
    device = FaultyDevice("test", numbered)
    running = Feed("test", device.open, lambda _: None)
    device.unplug()
    wait_until(lambda: running.state == "lost")
    running.stop()
    running.stop()
    assert running.state == "ended"


def test_stopped_feed_rejects_settings() -> None:
    running = Feed("test", FaultyDevice("test", numbered).open, lambda _: None)
    running.stop()
    with pytest.raises(CameraError, match="test is closed"):
        running.apply(CameraSettings(rate_hz=10)).result(PATIENCE_S)


def test_exception_of_a_frame_sink_is_reported_and_closes_the_camera() -> None:
    device = FaultyDevice("test", numbered)
    events = Events()
    closed = threading.Event()

    def open_camera():
        camera = device.open()
        camera.close = closed.set
        return camera

    def fail(_: CameraFrame) -> None:
        raise RuntimeError("a fault")

    with Feed("test", open_camera, fail, events.append) as running:
        wait_until(lambda: running.state == "ended")
    assert closed.is_set()
    assert "a fault in the program ended its pictures" in events.words()
