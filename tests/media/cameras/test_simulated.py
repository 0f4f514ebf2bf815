from __future__ import annotations

import time

import numpy as np
import pytest

from labapp.errors import InputError
from labapp.media.cameras import (
    BrokenFrame,
    CameraError,
    CameraFrame,
    CameraLost,
    CameraSettings,
    SimulatedDevice,
    base,
)
from tests.media.cameras.faulty import Faults, FaultyDevice
from tests.media.cameras.watching import number_in, numbered


def read(camera, count: int) -> list[CameraFrame]:
    frames = [camera.read(1.0) for _ in range(count)]
    assert None not in frames
    return frames


def test_frames_come_in_order_at_the_set_rate() -> None:
    device = SimulatedDevice("test", numbered, rate_hz=500)
    with device.open() as camera:
        start_s = time.monotonic()
        camera.start()
        frames = read(camera, 50)
        elapsed_s = time.monotonic() - start_s
    assert [number_in(frame.image) for frame in frames] == list(range(50))
    assert [frame.number for frame in frames] == list(range(50))
    assert np.diff([frame.time_s for frame in frames]) == pytest.approx(1 / 500)
    assert elapsed_s >= 49 / 500


def test_region_is_applied_and_reported() -> None:
    with SimulatedDevice("test", numbered).open() as camera:
        applied = camera.apply(CameraSettings(region=(2, 3, 20, 16), rate_hz=1000))
        assert (applied.region, applied.rate_hz) == ((2, 3, 20, 16), 1000)
        assert camera.settings == applied
        camera.start()
        (frame,) = read(camera, 1)
    assert np.array_equal(frame.image, numbered(0)[3:19, 2:22])


@pytest.mark.parametrize(
    ("wanted", "message"),
    [
        (CameraSettings(rate_hz=1e6), "rate_hz: 1000000.0; expected from 0.1 to 10000"),
        (CameraSettings(exposure_us=10), "exposure_us: 10; expected nothing"),
        (CameraSettings(region=(20, 0, 20, 16)), "within 32×24 px, at least 16×16 px"),
        (CameraSettings(trigger="line"), "trigger: line; expected one of free, software"),
    ],
)
def test_rejected_settings_change_nothing(wanted: CameraSettings, message: str) -> None:
    with SimulatedDevice("test", numbered).open() as camera:
        before = camera.settings
        with pytest.raises(InputError, match="simulated:test") as caught:
            camera.apply(wanted)
        assert message in str(caught.value)
        assert camera.settings == before


def test_software_trigger_takes_one_frame() -> None:
    with SimulatedDevice("test", numbered).open() as camera:
        camera.apply(CameraSettings(trigger="software"))
        camera.start()
        assert camera.read(0.02) is None
        camera.trigger()
        assert [frame.number for frame in read(camera, 1)] == [0]
        assert camera.read(0.02) is None


def test_wrong_order_of_start_set_and_read_is_an_error() -> None:
    with SimulatedDevice("test", numbered).open() as camera:
        with pytest.raises(CameraError, match="was not started"):
            camera.read(0.01)
        camera.start()
        with pytest.raises(CameraError, match="stop it"):
            camera.apply(CameraSettings(rate_hz=10))


def test_slow_reader_gets_all_buffered_frames() -> None:
    with SimulatedDevice("test", numbered, rate_hz=1000).open() as camera:
        camera.start()
        read(camera, 1)
        time.sleep(0.4)
        assert [frame.number for frame in read(camera, 400)] == list(range(1, 401))
        assert camera.dropped == 0


def test_too_slow_reader_loses_frames(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(base, "BUFFERED_S", 0.01)
    with SimulatedDevice("test", numbered, rate_hz=5000).open() as camera:
        camera.start()
        read(camera, 1)
        time.sleep(0.1)
        frame = read(camera, 1)[0]
        assert camera.dropped > 300
        assert frame.number == 1


def test_unplugged_camera_can_be_opened_after_plugging_in() -> None:
    device = FaultyDevice("test", numbered, rate_hz=1000)
    camera = device.open()
    camera.start()
    device.unplug()
    with pytest.raises(CameraLost, match="unplugged"):
        read(camera, 2)
    with pytest.raises(CameraLost, match="not connected"):
        device.open()
    device.plug()
    reopened = device.open()
    reopened.start()
    assert read(reopened, 2)[0].number == 0


def test_short_disconnection_is_detected() -> None:
    device = FaultyDevice("test", numbered, rate_hz=1000)
    with device.open() as camera:
        camera.start()
        device.unplug()
        device.plug()
        with pytest.raises(CameraLost, match="unplugged"):
            read(camera, 2)
        with device.open() as reopened:
            reopened.start()
            read(reopened, 2)


def test_faults_have_the_set_rates_and_are_reproducible() -> None:
    def fates(seed: int) -> list[str]:
        faults = Faults(garbage=0.2, dropped=0.1, seed=seed)
        device = FaultyDevice("test", numbered, faults=faults)
        results = []
        for _ in range(2000):
            image, fate = device.transfer()
            is_complete = image.shape == (24, 32) and image.dtype == np.uint8
            results.append(fate or ("whole" if is_complete else "garbage"))
        return results

    first = fates(1)
    # Three standard deviations of 2000 draws.
    assert first.count("lost") / 2000 == pytest.approx(0.1, abs=0.02)
    assert first.count("cut off") / 2000 == pytest.approx(0.2 / 3, abs=0.017)
    assert first.count("garbage") / 2000 == pytest.approx(0.4 / 3, abs=0.023)
    assert fates(1) == first
    assert fates(2) != first


def test_broken_frames_are_reported_and_lost_frames_leave_gaps() -> None:
    device = FaultyDevice("test", numbered, rate_hz=1000, faults=Faults(0.3, 0.3, seed=5))
    with device.open() as camera:
        camera.start()
        numbers, broken = [], 0
        while len(numbers) < 20:
            try:
                frame = camera.read(1.0)
            except BrokenFrame:
                broken += 1
                continue
            assert frame is not None
            numbers.append(frame.number)
    assert broken > 0
    assert np.diff(numbers).max() > 1
