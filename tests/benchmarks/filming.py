"""A camera, a disk and their faults, of which everything is known: what the live window is held to.

`compare` holds a recording against what the camera gave, frame by frame.
"""

from __future__ import annotations

import re
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from labapp.media import GreyImage, open_source
from labapp.media.cameras import (
    BrokenFrame,
    CameraFrame,
    CameraLost,
    Faults,
    SimulatedDevice,
)
from labapp.media.cameras.simulated import SimulatedCamera

BITS = 32
"""A frame's number is in the lowest bits of so many pixels of its first row: nobody sees it."""

NOISES = 4

SOON_S = 0.5
"""Frames that arrive within so long of the trigger, or of the end, may be recorded or not."""


def numbered(image: GreyImage, number: int) -> GreyImage:
    """A copy of a picture with a number in it."""
    told = image.copy()
    bits = number >> np.arange(BITS) & 1
    told[0, :BITS] = told[0, :BITS] & ~np.array(1, told.dtype) | bits.astype(told.dtype)
    return told


def number_in(image: GreyImage) -> int:
    """The number that `numbered` wrote."""
    return int(((image[0, :BITS].astype(np.int64) & 1) << np.arange(BITS)).sum())


class Truth:
    """What a camera gave to whoever reads it.

    Attributes
    ----------
    frames
        How many that were whole.
    numbers, time_s, arrived_s, connection
        Of each: its number in the film, the camera's clock, when it was read, and how often the
        camera was opened by then.
    broken, lost
        How many were not whole, and how often the camera told that it is gone.
    """

    def __init__(self, most: int) -> None:
        self.frames = self.broken = self.lost = self.opened = 0
        # Of ones: it is all there from the beginning, and memory that grows is somebody else's.
        self.numbers = np.ones(most, np.int64)
        self.time_s, self.arrived_s = np.ones(most), np.ones(most)
        self.connection = np.ones(most, np.int64)

    def add(self, frame: CameraFrame) -> None:
        k = self.frames
        self.numbers[k] = number_in(frame.image)
        self.time_s[k], self.arrived_s[k] = frame.time_s, frame.arrived_s
        self.connection[k] = self.opened
        self.frames += 1


class FilmedDevice(SimulatedDevice):
    """A simulated camera whose frames have numbers and are kept account of.

    Parameters
    ----------
    film
        Frame k before it has its number.
    rate_hz
        Frames a second at first.
    most
        It is not read more often.
    """

    def __init__(self, film: Callable[[int], GreyImage], rate_hz: float, most: int) -> None:
        self.truth = Truth(most)
        self._film = film
        self.is_noise = np.zeros(most, bool)
        self._noises: list[GreyImage] = []
        super().__init__("pool", self._numbered, rate_hz=rate_hz)

    def spoil(self, faults: Faults, noise: float) -> None:
        """Let things go wrong from now on; part of the frames be whole, but nothing but noise."""
        random = np.random.default_rng([faults.seed, 7])
        shape = self._film(0).shape
        self._noises = [random.integers(0, 256, shape, np.uint8) for _ in range(NOISES)]
        first = self.taken + 10
        self.is_noise[first:] = random.uniform(size=len(self.is_noise))[first:] < noise
        self.faults = faults

    def _numbered(self, k: int) -> GreyImage:
        noisy = self.is_noise[k]
        return numbered(self._noises[k % NOISES] if noisy else self._film(k), k)

    def open(self) -> SimulatedCamera:
        super().open()  # is it there?
        self.truth.opened += 1
        return _FilmedCamera(self, self.truth)


class _FilmedCamera(SimulatedCamera):
    def __init__(self, device: FilmedDevice, truth: Truth) -> None:
        super().__init__(device)
        self._truth, self._shape = truth, device.sensor[::-1]

    def read(self, timeout_s: float) -> CameraFrame | None:
        try:
            frame = super().read(timeout_s)
        except BrokenFrame:
            self._truth.broken += 1
            raise
        except CameraLost:
            self._truth.lost += 1
            raise
        if frame is None:
            return None
        if frame.image.shape != self._shape or frame.image.dtype != np.uint8:
            self._truth.broken += 1
        else:
            self._truth.add(frame)
        return frame


class Disk:
    """A file that can be stalled."""

    def __init__(self, path: Path, goes: threading.Event) -> None:
        self._file, self._goes = path.open("xb", buffering=0), goes

    def write(self, content: memoryview) -> int:
        self._goes.wait()
        return self._file.write(content)

    def close(self) -> None:
        self._file.close()


def moments(seconds: float, count: int, random: np.random.Generator) -> list[float]:
    """So many moments within some seconds, one in each equal part, none at its end."""
    step_s = seconds / count
    return [step_s * (k + each) for k, each in enumerate(random.uniform(0.05, 0.6, count))]


class Agenda:
    """What is done at its time, by a thread of its own; used in a ``with``."""

    def __init__(self, what: Sequence[tuple[float, Callable[[], object]]]) -> None:
        self._what = sorted(what, key=lambda each: each[0])
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._do, name="agenda", daemon=True)

    def _do(self) -> None:
        begun_s = time.monotonic()
        for at_s, do in self._what:
            if self._ended.wait(max(0.0, begun_s + at_s - time.monotonic())):
                return
            do()

    def __enter__(self) -> Agenda:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ended.set()
        self._thread.join()


@dataclass(frozen=True)
class Compared:
    """What a recording has of what a camera gave.

    Parameters
    ----------
    frames
        In the file.
    missing
        That were given between trigger and end, and are not in it.
    strange
        That were never given, are there twice or in another order.
    wrong
        With another content.
    off_us
        By how much the time from a frame to the next is another than the camera's clock tells, at
        most, µs; over a time without the camera only that it does not go back.
    """

    frames: int
    missing: int
    strange: int
    wrong: int
    off_us: float

    @property
    def right(self) -> bool:
        """Whether it has all of it, once, and right: its times are kept to the microsecond."""
        return not (self.missing or self.strange or self.wrong) and self.off_us <= 2


def compare(path: Path, device: FilmedDevice, begun_s: float, ended_s: float) -> Compared:
    """Hold a recording against what the camera gave from its trigger to its end.

    Parameters
    ----------
    path
        The recording.
    begun_s, ended_s
        `time.monotonic` of its trigger and of its end.
    """
    truth = device.truth
    given = truth.numbers[: truth.frames]
    place = np.full(device.taken + 1, -1)
    place[given] = np.arange(truth.frames)
    numbers, times, wrong = [], [], 0
    with open_source(path) as video:
        for frame in video:
            number = number_in(frame.image)
            known = number <= device.taken
            wrong += not (known and np.array_equal(frame.image, device.picture(number)))
            numbers.append(number if known else -1)
            times.append(frame.time_s or 0.0)
    places = np.array([place[number] if number >= 0 else -1 for number in numbers])
    arrived_s = truth.arrived_s[: truth.frames]
    due = (arrived_s > begun_s + SOON_S) & (arrived_s < ended_s - SOON_S)
    due[places[places >= 0].min(initial=len(due)) : places.max(initial=-1)] = True
    missing = np.setdiff1d(np.nonzero(due)[0], places)
    strange = int((places < 0).sum() + (np.diff(places) <= 0).sum())
    steps_s, clock_s = np.diff(times), np.diff(truth.time_s[places])
    same = np.diff(truth.connection[places]) == 0
    off_s = np.where(same, np.abs(steps_s - clock_s), np.where(steps_s > 0, 0.0, np.inf))
    most_us = 1e6 * off_s.max() if len(off_s) else 0.0
    return Compared(len(numbers), len(missing), strange, int(wrong), float(most_us))


def times_told(lines: Sequence[str]) -> list[str]:
    """The messages, those that were said several times in a row as often."""
    told = []
    for each in lines:
        found = re.search(r" \((\d+) times since [\d:]+\)$", each)
        told += [each] * (int(found[1]) if found else 1)
    return told


def how_many(told: Sequence[str], words: str) -> int:
    """How often it is said, or of how many frames."""
    found = [re.search(rf"(\d+) frames? {words}|{words}", each) for each in told]
    return sum(int(each[1] or 1) for each in found if each)
