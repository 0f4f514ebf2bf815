from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from labapp.errors import InputError
from labapp.media.cameras import (
    BrokenFrame,
    CameraError,
    CameraInfo,
    CameraLost,
    CameraSettings,
    Range,
    open_camera,
    uvc,
)

INFO = CameraInfo("uvc:2", "A webcam", "USB video")

GREY = cv2.VideoWriter.fourcc(*"GREY")
YUYV = cv2.VideoWriter.fourcc(*"YUYV")


class Driver:
    """Replacement for `cv2.VideoCapture` on Video4Linux, with the behaviour of its source."""

    def __init__(self, *, grey: bool = True, opens: bool = True, automatic: bool = True) -> None:
        self.values = {
            cv2.CAP_PROP_FRAME_WIDTH: 640.0,
            cv2.CAP_PROP_FRAME_HEIGHT: 480.0,
            cv2.CAP_PROP_FPS: 30.0,
            cv2.CAP_PROP_EXPOSURE: 156.0,
            cv2.CAP_PROP_GAIN: 4.0,
            cv2.CAP_PROP_FOURCC: float(YUYV),
        }
        self.grey, self.opens, self.automatic = grey, opens, automatic
        self.plugged = self.whole = True
        self.silent = False

    def isOpened(self) -> bool:  # noqa: N802 - the name in OpenCV
        return self.opens

    def get(self, name: int) -> float:
        return self.values.get(name, 0.0)

    def set(self, name: int, value: float) -> bool:
        if name == cv2.CAP_PROP_FOURCC and not (self.grey and value == GREY):
            return False
        if name == cv2.CAP_PROP_AUTO_EXPOSURE and not self.automatic:
            return False
        if name == cv2.CAP_PROP_FPS:
            value = min((10, 30, 60), key=lambda rate: abs(rate - value))
        self.values[name] = float(value)
        return True

    def grab(self) -> bool:
        self.values[cv2.CAP_PROP_POS_MSEC] = self.get(cv2.CAP_PROP_POS_MSEC) + 1000 / 30
        return self.plugged and not self.silent

    def retrieve(self):
        if not self.whole:
            return False, None
        colour = self.get(cv2.CAP_PROP_CONVERT_RGB) == 0 and self.grey
        return True, np.full((480, 640) if colour else (480, 640, 3), 7, np.uint8)

    def release(self) -> None:
        self.opens = False


def open_uvc(driver: Driver, **controls: Range) -> uvc.UvcCamera:
    ranges = {uvc.EXPOSURE: controls.get("exposure"), uvc.GAIN: controls.get("gain")}
    return uvc.UvcCamera(
        INFO,
        capture=lambda number: driver if number == 2 else None,
        query=lambda number, control: ranges[control],
        present=lambda number: driver.plugged,
    )


def test_limits_come_from_the_driver() -> None:
    driver = Driver()
    with open_uvc(driver, exposure=Range(3, 2047), gain=Range(0, 100)) as camera:
        assert camera.limits.exposure_us == Range(300, 204700)
        assert camera.limits.gain_db == Range(0, 100)
        assert camera.limits.gain_unit == ""  # in steps of the driver
        assert camera.limits.sensor == (640, 480)
        assert driver.values[cv2.CAP_PROP_AUTO_EXPOSURE] == uvc.MANUAL
        applied = camera.apply(CameraSettings(exposure_us=2040, gain_db=7.6, rate_hz=50))
    # The driver uses units of 100 µs, integer gains and the nearest rate.
    assert (applied.exposure_us, applied.gain_db, applied.rate_hz) == (2000, 8, 60)
    assert applied.region == (0, 0, 640, 480)


def test_camera_without_automatic_exposure_can_be_set() -> None:
    with open_uvc(Driver(automatic=False), exposure=Range(3, 2047)) as camera:
        assert camera.apply(CameraSettings(exposure_us=2000)).exposure_us == 2000


def test_camera_without_controls_rejects_settings() -> None:
    with open_uvc(Driver()) as camera:
        assert (camera.limits.exposure_us, camera.limits.gain_db) == (None, None)
        with pytest.raises(InputError, match="exposure_us: 100; expected nothing: A webcam"):
            camera.apply(CameraSettings(exposure_us=100))
        with pytest.raises(InputError, match="region"):
            camera.apply(CameraSettings(region=(0, 0, 320, 240)))
        camera.apply(CameraSettings(region=(0, 0, 640, 480)))


@pytest.mark.parametrize("grey", [True, False])
def test_frames_are_grey_with_the_time_of_the_driver(grey: bool) -> None:
    with open_uvc(Driver(grey=grey)) as camera:
        assert camera.bit_depth == 8
        camera.start()
        frames = [camera.read(0.1) for _ in range(3)]
    assert all(frame is not None for frame in frames)
    assert [frame.number for frame in frames if frame] == [0, 1, 2]
    assert np.diff([frame.time_s for frame in frames if frame]) == pytest.approx(1 / 30)
    for frame in frames:
        assert frame is not None
        assert (frame.image.shape, frame.image.dtype) == ((480, 640), np.uint8)
        assert (frame.image == 7).all()


def test_silence_broken_frames_and_unplugging_are_distinguished() -> None:
    driver = Driver()
    with open_uvc(driver) as camera:
        with pytest.raises(CameraError, match="was not started"):
            camera.read(0.01)
        camera.start()
        driver.silent = True
        assert camera.read(0.01) is None
        driver.silent, driver.whole = False, False
        with pytest.raises(BrokenFrame):
            camera.read(0.01)
        driver.plugged = False
        with pytest.raises(CameraLost, match="A webcam was unplugged"):
            camera.read(0.01)


def test_reason_why_a_camera_cannot_be_opened() -> None:
    driver = Driver(opens=False)
    driver.plugged = False
    with pytest.raises(CameraLost, match="not connected"):
        open_uvc(driver)
    with pytest.raises(CameraLost, match="is not connected"):
        open_camera("uvc:77")


@pytest.mark.parametrize("id", ["uvc:x", "webcam", "uvc:"])
def test_invalid_id_is_rejected(id: str) -> None:
    with pytest.raises(InputError, match="as labapp cameras lists them"):
        open_camera(id)


def test_each_camera_is_listed_once(tmp_path: Path) -> None:
    for name, index, title in (
        ("video0", "0", "Webcam"),
        ("video1", "1", "Webcam"),
        ("video10", "0", "Microscope"),
        ("video2", "0", "Another"),
    ):
        (tmp_path / name).mkdir()
        (tmp_path / name / "index").write_text(f"{index}\n")
        (tmp_path / name / "name").write_text(f"{title}\n")
    (tmp_path / "video3").mkdir()  # just being unplugged
    cameras = uvc.find_uvc(tmp_path)
    assert [(info.id, info.name) for info in cameras] == [
        ("uvc:0", "Webcam"),
        ("uvc:2", "Another"),
        ("uvc:10", "Microscope"),
    ]
    assert uvc.find_uvc(tmp_path / "nothing") == []


def test_query_of_the_driver_has_the_layout_of_the_kernel() -> None:
    # linux/videodev2.h: VIDIOC_QUERYCTRL is _IOWR('V', 36, struct v4l2_queryctrl), of 17 words.
    assert uvc.QUERY.size == 4 * 17
    number = 3 << 30 | 4 * 17 << 16 | ord("V") << 8 | 36
    assert number == uvc.QUERY_CONTROL
    assert uvc.query_control(77, uvc.GAIN) is None


def test_missing_permission_names_the_group_to_join(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("os.access", lambda *_: False)
    with pytest.raises(CameraLost, match="usermod -aG video"):
        open_uvc(Driver(opens=False))
