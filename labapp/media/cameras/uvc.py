"""USB cameras with standard drivers (UVC, Video4Linux), through OpenCV."""

from __future__ import annotations

import contextlib
import os
import struct
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2

from labapp.errors import InputError
from labapp.media.base import to_grey
from labapp.media.cameras.base import (
    BrokenFrame,
    Camera,
    CameraError,
    CameraFrame,
    CameraInfo,
    CameraKind,
    CameraLost,
    CameraSettings,
    Limits,
    Range,
    check_settings,
)
from labapp.media.quiet import quiet_opencv
from labapp.system import IS_LINUX

PREFIX = "uvc:"

LISTED = Path("/sys/class/video4linux")

EXPOSURE, GAIN = 0x009A0902, 0x00980913
"""Controls by Video4Linux's numbers (linux/v4l2-controls.h)."""

QUERY = struct.Struct("II32siiiiI8x")
"""v4l2_queryctrl: id, type, name, minimum, maximum, step, default, flags."""

QUERY_CONTROL = 0xC0445624
DISABLED = 0x0001

EXPOSURE_UNIT_US = 100.0

MANUAL = 1
"""Video4Linux's value for manual exposure."""

GREY_FORMATS = {"GREY": 8, "Y16 ": 16}
"""Greyscale formats and their bits; other formats are converted to luminance."""

HIGHEST_HZ = 1000.0

Capture = Callable[[int], Any]
"""Opens `cv2.VideoCapture` by a device number."""

Query = Callable[[int, int], Range | None]
"""Range of a control of a device: (device number, control)."""

Present = Callable[[int], bool]
"""Whether a device exists, by its number."""


def find_uvc(listed: Path = LISTED) -> list[CameraInfo]:
    """Return the cameras listed by the system, with the first device of each."""
    found = []
    for entry in sorted(listed.glob("video*"), key=lambda path: int(path.name[5:] or 0)):
        with contextlib.suppress(OSError):
            if (entry / "index").read_text().strip() == "0":
                name = (entry / "name").read_text(errors="replace").strip()
                found.append(CameraInfo(f"{PREFIX}{entry.name[5:]}", name, "USB video"))
    return found


def _captured(number: int) -> Any:
    return cv2.VideoCapture(number, cv2.CAP_V4L2)


def _is_present(number: int) -> bool:
    return os.path.exists(f"/dev/video{number}")


def query_control(number: int, control: int) -> Range | None:
    """Query the driver for the range of a control; None if there is no such control."""
    if not IS_LINUX:
        return None
    import fcntl

    query = QUERY.pack(control, 0, b"", 0, 0, 0, 0, 0)
    try:
        device = os.open(f"/dev/video{number}", os.O_RDWR | os.O_NONBLOCK)
    except OSError:
        return None
    try:
        fields = QUERY.unpack(fcntl.ioctl(device, QUERY_CONTROL, query))
    except OSError:
        return None
    finally:
        os.close(device)
    return None if fields[7] & DISABLED else Range(float(fields[3]), float(fields[4]))


class UvcCamera(Camera):
    """An open USB camera; see `Camera`.

    Its driver does not number frames, so that lost frames are not detected. OpenCV chooses the
    nearest size and rate that the camera supports.

    Raises
    ------
    CameraError
        If it is not connected or cannot be opened.
    """

    def __init__(
        self,
        info: CameraInfo,
        capture: Capture = _captured,
        query: Query = query_control,
        present: Present = _is_present,
    ) -> None:
        quiet_opencv()
        self.info = info
        self._number = int(info.id.removeprefix(PREFIX))
        self._present = present
        self._capture = capture(self._number)
        if not self._capture.isOpened():
            raise CameraLost(self._why_closed())
        self.bit_depth = self._choose_format()
        exposure, gain = query(self._number, EXPOSURE), query(self._number, GAIN)
        if exposure is not None:
            # Fails for cameras without automatic exposure.
            self._capture.set(cv2.CAP_PROP_AUTO_EXPOSURE, MANUAL)
            exposure = Range(
                exposure.lowest * EXPOSURE_UNIT_US, exposure.highest * EXPOSURE_UNIT_US
            )
        self.limits = Limits(
            exposure_us=exposure,
            gain_db=gain,
            gain_unit="",  # driver-specific steps
            rate_hz=Range(1.0, HIGHEST_HZ),
            sensor=(self._get(cv2.CAP_PROP_FRAME_WIDTH), self._get(cv2.CAP_PROP_FRAME_HEIGHT)),
        )
        self._count = 0
        self._running = False

    @property
    def settings(self) -> CameraSettings:
        """Present settings, as reported by the driver."""
        exposure = self._capture.get(cv2.CAP_PROP_EXPOSURE) * EXPOSURE_UNIT_US
        rate_hz = self._capture.get(cv2.CAP_PROP_FPS)
        return CameraSettings(
            exposure_us=exposure if self.limits.exposure_us else None,
            gain_db=self._capture.get(cv2.CAP_PROP_GAIN) if self.limits.gain_db else None,
            rate_hz=rate_hz if rate_hz > 0 else None,
            region=(0, 0, *self.limits.sensor),
            trigger="free",
        )

    def apply(self, wanted: CameraSettings) -> CameraSettings:
        """Apply settings; see `Camera.apply`."""
        if self._running:
            raise CameraError(f"{self.info.name} is running: stop it before it is set")
        check_settings(self.info, self.limits, wanted)
        if wanted.rate_hz is not None:
            self._set(cv2.CAP_PROP_FPS, wanted.rate_hz)
        if wanted.exposure_us is not None:
            self._set(cv2.CAP_PROP_EXPOSURE, round(wanted.exposure_us / EXPOSURE_UNIT_US))
        if wanted.gain_db is not None:
            self._set(cv2.CAP_PROP_GAIN, round(wanted.gain_db))
        return self.settings

    def start(self) -> None:
        """Start acquisition."""
        self._running, self._count = True, 0

    def read(self, timeout_s: float) -> CameraFrame | None:
        """Wait for the next frame; see `Camera.read`.

        OpenCV's own timeout of ten seconds cannot be changed.
        """
        if not self._running:
            raise CameraError(f"{self.info.name} was not started")
        begun_s = time.monotonic()
        if not self._capture.grab():
            if not self._present(self._number):
                raise CameraLost(f"{self.info.name} was unplugged")
            time.sleep(max(0.0, begun_s + timeout_s - time.monotonic()))
            return None
        arrived_s = time.monotonic()
        number, self._count = self._count, self._count + 1
        is_whole, image = self._capture.retrieve()
        if not is_whole or image is None or image.size == 0:
            raise BrokenFrame("it cannot be decoded")
        stamp_ms = self._capture.get(cv2.CAP_PROP_POS_MSEC)
        time_s = stamp_ms / 1000 if stamp_ms > 0 else arrived_s
        return CameraFrame(number, time_s, arrived_s, to_grey(image))

    def trigger(self) -> None:
        """Raise, as triggers are not supported."""
        raise CameraError(f"{self.info.name} is free-running only")

    def stop(self) -> None:
        """Stop acquisition."""
        self._running = False

    def close(self) -> None:
        """Release the camera."""
        self.stop()
        self._capture.release()

    def _get(self, name: int) -> int:
        return round(float(self._capture.get(name)))

    def _set(self, name: int, value: float) -> None:
        if not self._capture.set(name, value):
            raise CameraError(f"{self.info.name} rejects a setting within its range ({value})")

    def _choose_format(self) -> int:
        """Set a greyscale format if there is one; returns the bits of the format."""
        for name, bits in GREY_FORMATS.items():
            code = cv2.VideoWriter.fourcc(*name)
            self._capture.set(cv2.CAP_PROP_FOURCC, code)
            if self._get(cv2.CAP_PROP_FOURCC) == code:
                self._capture.set(cv2.CAP_PROP_CONVERT_RGB, 0)
                return bits
        return 8

    def _why_closed(self) -> str:
        device = f"/dev/video{self._number}"
        if not self._present(self._number):
            return f"{self.info.name} is not connected"
        if not os.access(device, os.R_OK | os.W_OK):
            join = "sudo usermod -aG video $USER"
            return f"no permission to read {device}: join its group ({join}) and log in again"
        return f"{self.info.name} is used by another program: close that"


def _open(id: str) -> Camera:
    if not id.removeprefix(PREFIX).isdecimal():
        raise InputError(id, "camera", id, f"{USB_VIDEO.form}, as labapp cameras lists them")
    known = (info for info in find_uvc() if info.id == id)
    return UvcCamera(next(known, CameraInfo(id, id, "USB video")))


USB_VIDEO = CameraKind(f"{PREFIX}NUMBER", find_uvc, _open)
