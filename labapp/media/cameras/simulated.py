"""Simulated camera: any pictures at any frame rate, with the faults of real cameras.

`SimulatedDevice` is the hardware, which exists while cameras are opened and closed.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np

from labapp.media.base import GreyImage
from labapp.media.cameras.base import (
    BrokenFrame,
    Camera,
    CameraError,
    CameraFrame,
    CameraInfo,
    CameraLost,
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


@dataclass(frozen=True)
class Faults:
    """Simulated faults, random with a seed."""

    garbage: float = 0.0
    """Fraction of frames that are truncated, of another size or of another type, 0 … 1."""
    dropped: float = 0.0
    """Fraction of frames that never arrive, 0 … 1."""
    unplug_every: int = 0
    unplugged_s: float = 0.2
    """Number of frames between disconnections, and their duration, s; 0: never."""
    stall_every: int = 0
    stalled_s: float = 0.5
    """Number of frames between stalls, and their duration, s; 0: never."""
    seed: int = 0


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
        faults: Faults | None = None,
    ) -> None:
        self.info = CameraInfo(f"simulated:{name}", f"simulated {Path(name).name}", "simulated")
        self.picture = picture
        self.bit_depth = bit_depth
        self.faults = faults or Faults()
        rows, columns = picture(0).shape
        self.sensor = (columns, rows)
        self.settings = CameraSettings(rate_hz=rate_hz, region=(0, 0, columns, rows))
        self.taken = 0
        """Number of frames exposed, which with the seed determines the random numbers."""
        self.disconnects = 0
        self._unplugged_until_s = 0.0
        self._stalled_until_s = 0.0

    def open(self) -> SimulatedCamera:
        """Open it as a camera.

        Raises
        ------
        CameraLost
            If it is unplugged.
        """
        if not self.plugged:
            raise CameraLost(f"{self.info.name} is not connected")
        return SimulatedCamera(self)

    @property
    def plugged(self) -> bool:
        """Whether it is connected."""
        return time.monotonic() >= self._unplugged_until_s

    @property
    def stalled_s(self) -> float:
        """Remaining duration of a stall, s."""
        return max(0.0, self._stalled_until_s - time.monotonic())

    def unplug(self, seconds: float = float("inf")) -> None:
        """Disconnect it for a time."""
        self.disconnects += 1
        self._unplugged_until_s = time.monotonic() + seconds

    def plug(self) -> None:
        """Connect it again."""
        self._unplugged_until_s = 0.0

    def stall(self, seconds: float) -> None:
        """Deliver no frames for a time."""
        self._stalled_until_s = time.monotonic() + seconds

    def expose(self) -> tuple[GreyImage, Literal["", "lost", "cut off"]]:
        """Expose the next frame; returns it with its fate in transfer."""
        number, faults = self.taken, self.faults
        self.taken += 1
        u, v, width, height = self.settings.region or (0, 0, *self.sensor)
        image = self.picture(number)[v : v + height, u : u + width]
        if faults.unplug_every and self.taken % faults.unplug_every == 0:
            self.unplug(faults.unplugged_s)
        if faults.stall_every and self.taken % faults.stall_every == 0:
            self.stall(faults.stalled_s)
        if not (faults.garbage or faults.dropped):
            return image, ""
        lot, form = np.random.default_rng([faults.seed, number]).uniform(size=2)
        if lot < faults.dropped:
            return image, "lost"
        if lot < faults.dropped + faults.garbage:
            if form < 1 / 3:
                return image, "cut off"
            return (image[: height // 2] if form < 2 / 3 else image.astype(np.float32)), ""
        return image, ""


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
        self._disconnects = device.disconnects
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
        until_s = time.monotonic() + timeout_s
        while True:
            number = self._await(until_s)
            # Also if it was disconnected and connected again.
            if not self._device.plugged or self._device.disconnects > self._disconnects:
                self._begun_s = None
                raise CameraLost(f"{self.info.name} was unplugged")
            if number is None:
                return None
            image, fate = self._device.expose()
            if fate == "cut off":
                raise BrokenFrame("it was truncated in transfer")
            if fate != "lost":
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
        if (stalled_s := self._device.stalled_s) > 0:
            time.sleep(max(0.0, min(stalled_s, until_s - now_s)))
            # Frames are not counted during a stall.
            self._begun_s += time.monotonic() - now_s
            return None
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
