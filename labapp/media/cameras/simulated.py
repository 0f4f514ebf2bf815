"""Simulated camera: any pictures at any frame rate.

`SimulatedDevice` is the hardware, which exists while cameras are opened and closed.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

from labapp.media.base import GreyImage
from labapp.media.cameras.base import (
    Camera,
    CameraError,
    CameraFrame,
    CameraInfo,
    CameraSettings,
    Limits,
    Range,
    buffered,
    check_settings,
)

LEAST_SIDE = 16

HIGHEST_HZ = 10_000.0


def there_and_back(images: Sequence[GreyImage]) -> Callable[[int], GreyImage]:
    """Return pictures of an endless film, forwards and backwards in turn, to avoid jumps."""
    last = len(images) - 1
    order = [*range(last), *range(last, 0, -1)] or [0]
    return lambda number: images[order[number % len(order)]]


class SimulatedDevice:
    """Simulated camera hardware.

    Parameters
    ----------
    name
        Name; the id is "simulated:" and the name.
    picture
        Returns frame k, shape (rows, columns), uint8 or uint16; called by the reading thread at the
        frame rate, with k = 0, 1, 2 …
    bit_depth
        Significant bits of a grey level.
    rate_hz
        Initial frame rate.
    """

    def __init__(
        self,
        name: str,
        picture: Callable[[int], GreyImage],
        *,
        bit_depth: int = 8,
        rate_hz: float = 60.0,
    ) -> None:
        self.info = CameraInfo(f"simulated:{name}", f"simulated {Path(name).name}", "simulated")
        self.picture = picture
        self.bit_depth = bit_depth
        rows, columns = picture(0).shape
        self.sensor = (columns, rows)
        self.settings = CameraSettings(rate_hz=rate_hz, region=(0, 0, columns, rows))
        self.taken = 0
        """Number of frames exposed."""

    def open(self) -> SimulatedCamera:
        """Open it as a camera."""
        return SimulatedCamera(self)

    def expose(self) -> GreyImage:
        """Expose the next frame."""
        u, v, width, height = self.settings.region or (0, 0, *self.sensor)
        self.taken += 1
        return self.picture(self.taken - 1)[v : v + height, u : u + width]


class SimulatedCamera(Camera):
    """An open `SimulatedDevice`; see `Camera`."""

    def __init__(self, device: SimulatedDevice) -> None:
        self.info = device.info
        self.bit_depth = device.bit_depth
        self.limits = Limits(
            rate_hz=Range(0.1, HIGHEST_HZ),
            sensor=device.sensor,
            least_region=(min(LEAST_SIDE, device.sensor[0]), min(LEAST_SIDE, device.sensor[1])),
            triggers=("free", "software"),
        )
        self._device = device
        self._begun_s: float | None = None
        self._next = 0
        self._pulled = threading.Semaphore(0)
        self._overrun = 0

    @property
    def settings(self) -> CameraSettings:
        """Present settings."""
        return replace(self._device.settings, trigger=self._device.settings.trigger or "free")

    def apply(self, wanted: CameraSettings) -> CameraSettings:
        """Apply settings; see `Camera.apply`."""
        if self._begun_s is not None:
            raise CameraError(f"{self.info.name} is running: stop it before it is set")
        check_settings(self.info, self.limits, wanted)
        for name in ("exposure_us", "gain_db"):
            assert getattr(wanted, name) is None  # checked above, as there are no limits
        self._device.settings = replace(self._device.settings, **wanted.specified())
        return self.settings

    def start(self) -> None:
        """Start acquisition."""
        self._begun_s = time.monotonic()
        self._next = self._overrun = 0
        columns, rows = (self.settings.region or (0, 0, *self.limits.sensor))[2:]
        frame_byte = columns * rows * (1 if self.bit_depth <= 8 else 2)
        self._buffered = buffered(frame_byte, self.settings.rate_hz)

    def read(self, timeout_s: float) -> CameraFrame | None:
        """Wait for the next frame; see `Camera.read`."""
        number = self._await(time.monotonic() + timeout_s)
        return None if number is None else self._arrived(number, self._device.expose())

    def _arrived(self, number: int, image: GreyImage) -> CameraFrame:
        now_s = time.monotonic()
        return CameraFrame(number, self._clock_s(number, now_s), now_s, image)

    def trigger(self) -> None:
        """Trigger a frame."""
        if self.settings.trigger != "software":
            raise CameraError(f'{self.info.name} is not set to the trigger "software"')
        self._pulled.release()

    @property
    def dropped(self) -> int:
        """Frames dropped because the reader was too slow."""
        return self._overrun

    def stop(self) -> None:
        """Stop acquisition."""
        self._begun_s = None

    def close(self) -> None:
        """Release the device."""
        self.stop()

    def _await(self, until_s: float) -> int | None:
        """Wait until the next frame is due, and return its number; None after ``until_s``."""
        if self._begun_s is None:
            raise CameraError(f"{self.info.name} was not started")
        if self.settings.trigger == "software":
            left_s = max(0.0, until_s - time.monotonic())
            number = self._next if self._pulled.acquire(timeout=left_s) else None
        else:
            number = self._await_due(until_s)
        if number is not None:
            self._next = number + 1
        return number

    def _await_due(self, until_s: float) -> int | None:
        assert self._begun_s is not None
        period_s = 1 / (self._device.settings.rate_hz or 1.0)
        now_s = time.monotonic()
        due_s = self._begun_s + self._next * period_s
        late = int((now_s - due_s) / period_s)
        if late > self._buffered:
            self._overrun += late
            self._device.taken += late
            self._begun_s += late * period_s
        elif due_s > until_s:
            time.sleep(max(0.0, until_s - now_s))
            return None
        elif due_s > now_s:
            time.sleep(due_s - now_s)
        return self._next

    def _clock_s(self, number: int, now_s: float) -> float:
        """Return the time of a frame, s."""
        if self.settings.trigger == "software" or self._begun_s is None:
            return now_s
        return self._begun_s + number / (self._device.settings.rate_hz or 1.0)
