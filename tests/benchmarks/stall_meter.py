"""Stalls of the GUI thread: time away from the event loop, and the functions executed."""

from __future__ import annotations

import sys
import threading
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from types import FrameType

from PySide6.QtCore import QEventLoop, QObject, Qt, QTimer

BEAT_MS = 1
SAMPLE_S = 0.004
LONG_MS = 12.0
"""Shorter stalls are ignored."""


@dataclass(frozen=True)
class Stall:
    """Uninterrupted time between two beats of a timer of the GUI thread.

    Parameters
    ----------
    wall_ms, cpu_ms
        Wall time and processor time: the difference was spent waiting for a lock, the disk, or
        other programs.
    calls
        labapp's functions on the thread's stack, the innermost last.
    """

    wall_ms: float
    cpu_ms: float
    calls: str


@dataclass
class StallMeter:
    """Context manager with a timer in the GUI thread, watched by another thread.

    Attributes
    ----------
    stalls
        The long ones, in order.
    beats
        Number of beats.
    """

    stalls: list[Stall] = field(default_factory=list)
    beats: int = 0

    def __enter__(self) -> StallMeter:
        self._gui = threading.get_ident()
        self._seen: Counter[str] = Counter()
        self._last, self._cpu = time.perf_counter(), time.thread_time()
        self._ended = threading.Event()
        self._owner = QObject()
        self._timer = QTimer(self._owner)
        self._timer.setTimerType(Qt.TimerType.PreciseTimer)
        self._timer.timeout.connect(self._beat)
        self._timer.start(BEAT_MS)
        self._watcher = threading.Thread(target=self._watch, daemon=True)
        self._watcher.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._beat()
        self._timer.stop()
        self._ended.set()
        self._watcher.join()

    @property
    def longest(self) -> list[Stall]:
        """The stalls, the longest first."""
        return sorted(self.stalls, key=lambda stall: -stall.wall_ms)

    def _beat(self) -> None:
        now, cpu = time.perf_counter(), time.thread_time()
        gap, busy = (now - self._last) * 1000, (cpu - self._cpu) * 1000
        self.beats += 1
        if gap > LONG_MS:
            calls = self._seen.most_common(1)
            self.stalls.append(Stall(gap, busy, calls[0][0] if calls else "?"))
        self._seen.clear()
        self._last, self._cpu = now, cpu

    def _watch(self) -> None:
        while not self._ended.wait(SAMPLE_S):
            if (time.perf_counter() - self._last) * 1000 > LONG_MS / 2:
                self._seen[calls_of(sys._current_frames().get(self._gui))] += 1


def calls_of(frame: FrameType | None) -> str:
    """Return labapp's functions on a stack, the innermost last, and the current library function.

    Quick, and without references to frames: a painter kept alive is an error in Qt.
    """
    names: list[str] = []
    while frame is not None and len(names) < 6:
        code = frame.f_code
        file = code.co_filename
        if "/labapp/" in file and "site-packages" not in file:
            names.append(f"{file.rpartition('/')[2].removesuffix('.py')}.{code.co_name}")
        elif not names and "benchmarks" not in file:
            names.append(f"[{file.rpartition('/')[2]}:{code.co_name}]")
        frame = frame.f_back
    return " > ".join(reversed(names))


def run_until(done: Callable[[], bool], timeout_s: float = 60.0) -> None:
    """Run the event loop until a condition holds."""
    loop, timer = QEventLoop(), QTimer()
    ends = time.perf_counter() + timeout_s

    def look() -> None:
        if done() or time.perf_counter() > ends:
            loop.quit()

    timer.setTimerType(Qt.TimerType.PreciseTimer)
    timer.timeout.connect(look)
    timer.start(BEAT_MS)
    loop.exec()
    timer.stop()
    if not done():
        raise TimeoutError("it did not come to its end")


def run_for(seconds: float) -> None:
    """Run the event loop for a while."""
    loop = QEventLoop()
    QTimer.singleShot(round(seconds * 1000), loop.quit)
    loop.exec()
