"""A simulated camera with the faults of real ones: for tests and benchmarks."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np

from labapp.media.base import GreyImage
from labapp.media.cameras import BrokenFrame, CameraFrame, CameraLost, SimulatedDevice
from labapp.media.cameras.simulated import SimulatedCamera


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


class FaultyDevice(SimulatedDevice):
    """A device that can be unplugged and stalled, and that has faults of its own."""

    def __init__(
        self,
        name: str,
        picture: Callable[[int], GreyImage],
        *,
        rate_hz: float = 60.0,
        faults: Faults | None = None,
    ) -> None:
        super().__init__(name, picture, rate_hz=rate_hz)
        self.faults = faults or Faults()
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
        return FaultyCamera(self)

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

    def transfer(self) -> tuple[GreyImage, Literal["", "lost", "cut off"]]:
        """Expose the next frame; returns it with its fate in transfer."""
        number, faults = self.taken, self.faults
        image = self.expose()
        height = len(image)
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


class FaultyCamera(SimulatedCamera):
    """An open `FaultyDevice`."""

    def __init__(self, device: FaultyDevice) -> None:
        super().__init__(device)
        self._faulty = device
        self._disconnects = device.disconnects

    def read(self, timeout_s: float) -> CameraFrame | None:
        until_s = time.monotonic() + timeout_s
        while True:
            number = self._await(until_s)
            # Also if it was disconnected and connected again.
            if not self._faulty.plugged or self._faulty.disconnects > self._disconnects:
                self._begun_s = None
                raise CameraLost(f"{self.info.name} was unplugged")
            if number is None:
                return None
            image, fate = self._faulty.transfer()
            if fate == "cut off":
                raise BrokenFrame("it was truncated in transfer")
            if fate != "lost":
                return self._arrived(number, image)

    def _await_due(self, until_s: float) -> int | None:
        if (stalled_s := self._faulty.stalled_s) == 0:
            return super()._await_due(until_s)
        assert self._begun_s is not None
        now_s = time.monotonic()
        time.sleep(max(0.0, min(stalled_s, until_s - now_s)))
        # Frames are not counted during a stall.
        self._begun_s += time.monotonic() - now_s
        return None
