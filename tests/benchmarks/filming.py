"""A camera, a disk and their faults as known truth for the tests of the live window.

`compare` compares a recording with the frames that the camera delivered.
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
)
from labapp.media.cameras.simulated import SimulatedCamera
from tests.media.cameras.faulty import Faults, FaultyCamera, FaultyDevice

BITS = 32
"""A frame's number is in the lowest bits of as many pixels of its first row, invisibly."""

NOISES = 4

SOON_S = 0.5
"""Frames that arrive within this time of the trigger, or of the end, may be recorded or not."""


def numbered(image: GreyImage, number: int) -> GreyImage:
    """Return a copy of a picture with a number in it."""
    copy = image.copy()
    bits = number >> np.arange(BITS) & 1
    copy[0, :BITS] = copy[0, :BITS] & ~np.array(1, copy.dtype) | bits.astype(copy.dtype)
    return copy


def number_in(image: GreyImage) -> int:
    """Return the number written by `numbered`."""
    return int(((image[0, :BITS].astype(np.int64) & 1) << np.arange(BITS)).sum())


class Truth:
    """The frames that a camera delivered to its reader.

    Attributes
    ----------
    frames
        Number of complete frames.
    numbers, time_s, arrived_s, connection
        Of each: its number in the film, the camera's clock, the time of reading, and how often the
        camera had been opened by then.
    broken, lost
        Number of incomplete frames, and how often the camera reported its loss.
    """

    def __init__(self, most: int) -> None:
        self.frames = self.broken = self.lost = self.opened = 0
        # Ones, so that the memory is allocated at once: later growth is not caused here.
        self.numbers = np.ones(most, np.int64)
        self.time_s, self.arrived_s = np.ones(most), np.ones(most)
        self.connection = np.ones(most, np.int64)

    def add(self, frame: CameraFrame) -> None:
        k = self.frames
        self.numbers[k] = number_in(frame.image)
        self.time_s[k], self.arrived_s[k] = frame.time_s, frame.arrived_s
        self.connection[k] = self.opened
        self.frames += 1


class FilmedDevice(FaultyDevice):
    """A simulated camera with numbered frames and a record of them.

    Parameters
    ----------
    film
        Frame k without its number.
    rate_hz
        Initial frame rate.
    most
        Largest number of frames.
    """

    def __init__(self, film: Callable[[int], GreyImage], rate_hz: float, most: int) -> None:
        self.truth = Truth(most)
        self._film = film
        self.is_noise = np.zeros(most, bool)
        self._noises: list[GreyImage] = []
        super().__init__("pool", self._numbered, rate_hz=rate_hz)

    def spoil(self, faults: Faults, noise: float) -> None:
        """Start the faults; a share of the frames contains only noise."""
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
        super().open()  # raises if it is absent
        self.truth.opened += 1
        return _FilmedCamera(self, self.truth)


class _FilmedCamera(FaultyCamera):
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
    """Return random times, one in each of ``count`` equal parts, none at the end of a part."""
    step_s = seconds / count
    return [step_s * (k + fraction) for k, fraction in enumerate(random.uniform(0.05, 0.6, count))]


class Agenda:
    """Actions at given times, executed by a thread; a context manager."""

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
    """Comparison of a recording with the frames delivered by a camera.

    Parameters
    ----------
    frames
        Number of frames in the file.
    missing
        Frames delivered between trigger and end which are not in it.
    strange
        Frames never delivered, duplicated or in the wrong order.
    wrong
        Frames with wrong content.
    off_us
        Largest deviation of a frame interval from the camera's clock, µs; across a disconnection
        only decreasing times count.
    """

    frames: int
    missing: int
    strange: int
    wrong: int
    off_us: float

    @property
    def right(self) -> bool:
        """Whether all frames are there, once and correct; times are stored in microseconds."""
        return not (self.missing or self.strange or self.wrong) and self.off_us <= 2


def compare(path: Path, device: FilmedDevice, begun_s: float, ended_s: float) -> Compared:
    """Compare a recording with the frames delivered from its trigger to its end.

    Parameters
    ----------
    path
        The recording.
    begun_s, ended_s
        `time.monotonic` of its trigger and of its end.
    """
    truth = device.truth
    given_numbers = truth.numbers[: truth.frames]
    index_of = np.full(device.taken + 1, -1)
    index_of[given_numbers] = np.arange(truth.frames)
    numbers, times, wrong = [], [], 0
    with open_source(path) as video:
        for frame in video:
            number = number_in(frame.image)
            known = number <= device.taken
            wrong += not (known and np.array_equal(frame.image, device.picture(number)))
            numbers.append(number if known else -1)
            times.append(frame.time_s or 0.0)
    places = np.array([index_of[number] if number >= 0 else -1 for number in numbers])
    arrived_s = truth.arrived_s[: truth.frames]
    expected = (arrived_s > begun_s + SOON_S) & (arrived_s < ended_s - SOON_S)
    expected[places[places >= 0].min(initial=len(expected)) : places.max(initial=-1)] = True
    missing = np.setdiff1d(np.nonzero(expected)[0], places)
    strange = int((places < 0).sum() + (np.diff(places) <= 0).sum())
    steps_s, clock_s = np.diff(times), np.diff(truth.time_s[places])
    same = np.diff(truth.connection[places]) == 0
    error_s = np.where(same, np.abs(steps_s - clock_s), np.where(steps_s > 0, 0.0, np.inf))
    most_us = 1e6 * error_s.max() if len(error_s) else 0.0
    return Compared(len(numbers), len(missing), strange, int(wrong), float(most_us))


def times_told(lines: Sequence[str]) -> list[str]:
    """Return the messages; a message repeated in succession appears as often."""
    messages = []
    for each in lines:
        repeats = re.search(r" \((\d+) times since [\d:]+\)$", each)
        messages += [each] * (int(repeats[1]) if repeats else 1)
    return messages


def how_many(messages: Sequence[str], words: str) -> int:
    """Return how often the words occur, or the number of frames they state."""
    matches = [re.search(rf"(\d+) frames? {words}|{words}", message) for message in messages]
    return sum(int(message[1] or 1) for message in matches if message)
