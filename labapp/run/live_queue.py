"""Which frames of a live camera are measured: as many as can be, at even steps.

Each frame is measured from those before. What comes next is foreseen where steps are even, and has
to be searched for after a jump, which takes ten times as long: a frame in three, say, is measured
rather than whichever is the newest.
"""

from __future__ import annotations

import math
import threading
from collections import deque

from labapp.media.cameras import CameraFrame

MOST = 32
"""So many frames wait at most; and so many right after one that was measured by itself are measured
in their order, however old: the present one would be too far from it. Where one of those has to be
measured by itself, too, the newest is next, or figures would become older and older."""

SWING_S = 0.0125
"""Until twice as many have followed each other steps are no smaller: they then cover a full swing,
from which what comes next is found again after a jump."""

FAR_S = 0.1
"""Steps are no larger: frames farther from each other are hardly measured from each other."""

SHARE, EASE, WEIGHT = 0.8, 0.85, 0.05
"""Measuring takes this share of a step at most, by its running mean, in which the newest weighs so
much; steps are made smaller only where this part of the smaller one would do."""


class FrameQueue:
    """The frames that wait to be measured. `put` never waits; call the rest from one thread."""

    def __init__(self) -> None:
        self._turn = threading.Lock()
        self._waiting: deque[CameraFrame] = deque()
        self._every, self._due = 1, 0
        """Steps between frames, and the number from which the next frame is taken."""
        self._last: CameraFrame | None = None
        self._interval_s = self._took_s = 0.0
        """Running means of the time between frames, and of the time that measuring takes."""
        self._given_s = 0.0
        """When the frame that is measured now arrived."""
        self._in_order = self._followed = 0
        """How many of those that wait come next in any case, and how many followed recently."""
        self._is_behind = self._is_old = False
        """Whether a frame found no room, and whether the one measured now came in its order."""

    @property
    def every(self) -> int:
        """Step between frames that are measured."""
        return self._every

    def put(self, frame: CameraFrame) -> None:
        """Take a frame of the camera, if it is its turn."""
        with self._turn:
            last, self._last = self._last, frame
            if last is not None and frame.number > last.number:
                # By our own clock: a camera's may be set back.
                since_s = frame.arrived_s - last.arrived_s
                self._interval_s = _mean(self._interval_s, since_s / (frame.number - last.number))
            if self._due - self._every < frame.number < self._due:
                return
            if len(self._waiting) < MOST:
                self._waiting.append(frame)
                self._due = frame.number + self._every
            else:
                self._is_behind = True

    def next(self) -> CameraFrame | None:
        """The next frame to be measured; None while there is none."""
        with self._turn:
            if not self._waiting:
                self._in_order, self._is_behind = 0, False
                return None
            self._is_old = self._in_order > 0
            if self._is_old or not self._is_behind:
                self._in_order = max(self._in_order - 1, 0)
                frame = self._waiting.popleft()
            else:
                self._is_behind = False
                frame = self._waiting.pop()
                self._waiting.clear()
            self._given_s = frame.arrived_s
            return frame

    def done(self, followed: bool, took_s: float) -> None:
        """Report whether the frame was measured from those before, and how long it took, s."""
        with self._turn:
            if not followed:
                self._followed = 0
                far = self._waiting and self._waiting[0].arrived_s - self._given_s > FAR_S
                if far or self._is_old:
                    # None that waits can be measured from this one, or all are older still than
                    # this one was; those after the next can be.
                    self._waiting.clear()
                    self._every, self._due, self._took_s = self._steps(SWING_S), 0, 0.0
                self._in_order = len(self._waiting)
                return
            self._followed += 1
            self._took_s = _mean(self._took_s, min(took_s, FAR_S))
            least_s = self._took_s / SHARE
            if self._followed < 2 * MOST:
                least_s = max(least_s, SWING_S)
            wanted = self._steps(least_s)
            grown_s = EASE * self._interval_s * (self._every - 1)
            if wanted > self._every or (wanted < self._every and least_s < grown_s):
                self._every = wanted

    def _steps(self, least_s: float) -> int:
        """How many frames a step takes that is no shorter, s; or one of `FAR_S`."""
        if not self._interval_s > 0:
            return 1
        return max(1, math.ceil(min(least_s, FAR_S) / self._interval_s - 1e-6))


def _mean(former: float, newest: float) -> float:
    """A running mean; of nothing before, the newest."""
    return former + WEIGHT * (newest - former) if former else newest


def newest_of(frames: deque[CameraFrame]) -> CameraFrame | None:
    """Take the newest frame; those before it are left out."""
    while len(frames) > 1:
        frames.popleft()
    return frames.popleft() if frames else None
