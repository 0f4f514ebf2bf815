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
    Faults,
    SimulatedDevice,
    base,
)
from tests.media.cameras.watching import number_in, numbered


def read(camera, count: int) -> list[CameraFrame]:
    frames = [camera.read(1.0) for _ in range(count)]
    assert None not in frames
    return frames


def test_it_gives_its_pictures_in_order_at_its_rate() -> None:
    device = SimulatedDevice("test", numbered, rate_hz=500)
    with device.open() as camera:
        begun_s = time.monotonic()
        camera.start()
        frames = read(camera, 50)
        took_s = time.monotonic() - begun_s
    assert [number_in(frame.image) for frame in frames] == list(range(50))
    assert [frame.number for frame in frames] == list(range(50))
    assert np.diff([frame.time_s for frame in frames]) == pytest.approx(1 / 500)
    assert took_s >= 49 / 500


def test_a_region_is_cut_out_and_said() -> None:
    with SimulatedDevice("test", numbered).open() as camera:
        found = camera.apply(CameraSettings(region=(2, 3, 20, 16), rate_hz=1000))
        assert (found.region, found.rate_hz) == ((2, 3, 20, 16), 1000)
        assert camera.settings == found
        camera.start()
        (frame,) = read(camera, 1)
    assert np.array_equal(frame.image, numbered(0)[3:19, 2:22])


@pytest.mark.parametrize(
    ("wanted", "named"),
    [
        (CameraSettings(rate_hz=1e6), "rate_hz: 1000000.0; expected from 0.1 to 10000"),
        (CameraSettings(exposure_us=10), "exposure_us: 10; expected nothing"),
        (CameraSettings(region=(20, 0, 20, 16)), "within 32×24 px, at least 16×16 px"),
        (CameraSettings(trigger="line"), "trigger: line; expected one of free, software"),
    ],
)
def test_what_cannot_be_set_is_refused_and_nothing_is_changed(
    wanted: CameraSettings, named: str
) -> None:
    with SimulatedDevice("test", numbered).open() as camera:
        before = camera.settings
        with pytest.raises(InputError, match="simulated:test") as refused:
            camera.apply(wanted)
        assert named in str(refused.value)
        assert camera.settings == before


def test_a_software_trigger_takes_one_frame() -> None:
    with SimulatedDevice("test", numbered).open() as camera:
        camera.apply(CameraSettings(trigger="software"))
        camera.start()
        assert camera.read(0.02) is None
        camera.trigger()
        assert [frame.number for frame in read(camera, 1)] == [0]
        assert camera.read(0.02) is None


def test_it_is_not_set_while_it_runs_nor_read_before() -> None:
    with SimulatedDevice("test", numbered).open() as camera:
        with pytest.raises(CameraError, match="was not started"):
            camera.read(0.01)
        camera.start()
        with pytest.raises(CameraError, match="stop it"):
            camera.apply(CameraSettings(rate_hz=10))


def test_a_reader_that_comes_late_finds_all_frames() -> None:
    with SimulatedDevice("test", numbered, rate_hz=1000).open() as camera:
        camera.start()
        read(camera, 1)
        time.sleep(0.4)
        assert [frame.number for frame in read(camera, 400)] == list(range(1, 401))
        assert camera.dropped == 0


def test_a_reader_that_comes_too_late_finds_frames_dropped(
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


def test_unplugged_it_is_lost_and_cannot_be_opened_until_it_is_plugged_in() -> None:
    device = SimulatedDevice("test", numbered, rate_hz=1000)
    camera = device.open()
    camera.start()
    device.unplug()
    with pytest.raises(CameraLost, match="unplugged"):
        read(camera, 2)
    with pytest.raises(CameraLost, match="not connected"):
        device.open()
    device.plug()
    again = device.open()
    again.start()
    assert read(again, 2)[0].number == 0


def test_it_is_lost_though_its_cable_was_put_back_before_anybody_looked() -> None:
    device = SimulatedDevice("test", numbered, rate_hz=1000)
    with device.open() as camera:
        camera.start()
        device.unplug()
        device.plug()
        with pytest.raises(CameraLost, match="unplugged"):
            read(camera, 2)
        with device.open() as again:
            again.start()
            read(again, 2)


def test_faults_come_as_often_as_they_are_asked_for_and_the_same_each_time() -> None:
    def fates(seed: int) -> list[str]:
        faults = Faults(garbage=0.2, dropped=0.1, seed=seed)
        device = SimulatedDevice("test", numbered, faults=faults)
        found = []
        for _ in range(2000):
            image, fate = device.expose()
            whole = image.shape == (24, 32) and image.dtype == np.uint8
            found.append(fate or ("whole" if whole else "garbage"))
        return found

    first = fates(1)
    # Three standard deviations of 2000 draws.
    assert first.count("lost") / 2000 == pytest.approx(0.1, abs=0.02)
    assert first.count("cut off") / 2000 == pytest.approx(0.2 / 3, abs=0.017)
    assert first.count("garbage") / 2000 == pytest.approx(0.4 / 3, abs=0.023)
    assert fates(1) == first
    assert fates(2) != first


def test_what_is_cut_off_is_told_and_what_is_lost_leaves_a_gap() -> None:
    device = SimulatedDevice("test", numbered, rate_hz=1000, faults=Faults(0.3, 0.3, seed=5))
    with device.open() as camera:
        camera.start()
        numbers, cut = [], 0
        while len(numbers) < 20:
            try:
                frame = camera.read(1.0)
            except BrokenFrame:
                cut += 1
                continue
            assert frame is not None
            numbers.append(frame.number)
    assert cut > 0
    assert np.diff(numbers).max() > 1
