"""Choice of the live frames to measure: as many as possible, at a constant step.

Frames are tracked from the previous ones. With a constant step the next frame can be predicted;
after a jump it must be searched for, which takes ten times as long. Therefore every third frame,
say, is measured rather than always the newest.
"""

from __future__ import annotations

import math
import threading
from collections import deque

from labapp.media.cameras import CameraFrame

MOST = 32
"""Length of the queue. After a frame that was measured without tracking, the queued frames are
measured in order, although they are old, as the newest would be too far from it. If one of these
also has to be measured without tracking, or if together they take longer than `CATCH_UP_S`, the
newest frame is next, so that the delay does not grow."""

CATCH_UP_S = 2.0
"""Longest time spent on frames in order, and largest delay of other queued frames, s. The frames
in order usually take 0.2 s; without enough processor time they would take minutes. A shorter limit
would leave too few tracked frames to recover the track from after the jump to the newest."""

SWING_S = 0.0125
"""Smallest step until ``2 * MOST`` frames in a row were tracked, s: these then cover a full
oscillation, from which the track is recovered after a jump."""

FAR_S = 0.1
"""Largest step, s: frames farther apart can hardly be tracked."""

SHARE, EASE, WEIGHT = 0.8, 0.85, 0.05
"""Largest ratio of the measuring time to the step; hysteresis factor for smaller steps; weight of
the newest value in the running means."""


class FrameQueue:
    """Frames to be measured. `put` never blocks; call the other methods from one thread."""

    def __init__(self) -> None:
        self._turn = threading.Lock()
        self._waiting: deque[CameraFrame] = deque()
        self.every, self._due = 1, 0
        """Step between measured frames, and the smallest number of the next frame."""
        self._last: CameraFrame | None = None
        self._interval_s = self._took_s = 0.0
        """Running means of the frame interval and of the measuring time."""
        self._given: CameraFrame | None = None
        """Frame being measured."""
        self._in_order = self._tracked = 0
        """Number of queued frames to be measured in order, and of frames tracked in a row."""
        self._is_behind = self._was_in_order = False
        """Whether the queue overflowed, and whether the frame being measured is one in order."""
        self._catching_up_s = 0.0
        """Measuring time of the frames in order so far."""
        self.skipped = 0
        """Number of frames passed over for a newer one, in addition to those between steps."""

    def put(self, frame: CameraFrame) -> None:
        """Queue a frame of the camera if it is due."""
        with self._turn:
            last, self._last = self._last, frame
            if last is not None and frame.number > last.number:
                # By the computer's clock, as a camera's may be reset.
                since_s = frame.arrived_s - last.arrived_s
                self._interval_s = _mean(self._interval_s, since_s / (frame.number - last.number))
            if self._due - self.every < frame.number < self._due:
                return
            if len(self._waiting) < MOST:
                self._waiting.append(frame)
                self._due = frame.number + self.every
            else:
                self._is_behind = True

    def next(self) -> CameraFrame | None:
        """Return the next frame to be measured; None if there is none."""
        with self._turn:
            if not self._waiting:
                self._in_order, self._is_behind = 0, False
                return None
            assert self._last is not None
            self._was_in_order = self._in_order > 0
            delay_s = self._last.arrived_s - self._waiting[0].arrived_s
            if self._was_in_order or not (self._is_behind or delay_s > CATCH_UP_S):
                self._in_order = max(self._in_order - 1, 0)
                frame = self._waiting.popleft()
            else:
                frame = self._last
                self._is_behind = False
                self._due = frame.number + self.every
                self._waiting.clear()
            given, self._given = self._given, frame
            if given is not None:
                self.skipped += max(frame.number - given.number - self.every, 0)
            return frame

    def done(self, tracked: bool, took_s: float) -> None:
        """Report whether the frame was tracked, and how long it took, s."""
        with self._turn:
            self._catching_up_s = self._catching_up_s + took_s if self._was_in_order else 0.0
            if not tracked:
                self._tracked = 0
                if self._was_in_order or self._is_far():
                    # The queued frames cannot be tracked from this one, or are older still.
                    self._waiting.clear()
                    self.every, self._due, self._took_s = self._steps(SWING_S), 0, 0.0
                self._in_order = len(self._waiting)
                return
            if self._catching_up_s > CATCH_UP_S:
                self._in_order = 0
            self._tracked += 1
            self._took_s = _mean(self._took_s, min(took_s, FAR_S))
            least_s = self._took_s / SHARE
            if self._tracked < 2 * MOST:
                least_s = max(least_s, SWING_S)
            wanted = self._steps(least_s)
            grown_s = EASE * self._interval_s * (self.every - 1)
            if wanted > self.every or (wanted < self.every and least_s < grown_s):
                self.every = wanted

    def _is_far(self) -> bool:
        """Whether the next queued frame is too far from the one that was measured."""
        given = self._given
        if given is None or not self._waiting:
            return False
        return self._waiting[0].arrived_s - given.arrived_s > FAR_S

    def _steps(self, least_s: float) -> int:
        """Return the step, in frames, that is at least ``least_s`` or `FAR_S`."""
        if not self._interval_s > 0:
            return 1
        return max(1, math.ceil(min(least_s, FAR_S) / self._interval_s - 1e-6))


def _mean(former: float, newest: float) -> float:
    """Return the updated running mean; the first value starts it."""
    return former + WEIGHT * (newest - former) if former else newest


def newest_of(frames: deque[CameraFrame]) -> CameraFrame | None:
    """Take the newest frame, and discard those before it."""
    while len(frames) > 1:
        frames.popleft()
    return frames.popleft() if frames else None
