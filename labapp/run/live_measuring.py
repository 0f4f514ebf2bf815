"""Measuring the frames of a live camera in a separate process, by tracking."""

from __future__ import annotations

import math
import time
from concurrent.futures import CancelledError
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass

from labapp.config.setup import Setup
from labapp.core.pipeline import Measurement, Settings
from labapp.core.quality import Quality, judge_quality
from labapp.export.frame_result import FrameResult, without_surface
from labapp.export.rendering.scene import Scene, scene_of
from labapp.media.cameras import CameraFrame
from labapp.simulation.parallel import end_processes, held, hold, worker_pool

JUDGED_S = 0.2
"""Time for which the quality of a frame is reused for the following ones, s."""

SEARCH_AFTER_S = 1.0
"""Time after a measured frame for which frames that cannot be tracked are skipped, s: the pool may
return to its previous shape, and measuring a frame without tracking takes seconds."""


class LiveMeasuringEnded(Exception):
    """The measuring process has ended: it was closed, or it died."""


@dataclass(frozen=True, kw_only=True)
class LiveResult(FrameResult):
    """Result of a live frame: status, reason and measures, without dots, rays and surface."""

    time_s: float
    """By the camera's clock, s."""
    arrived_s: float
    """`time.monotonic` at its arrival, s."""
    quality: Quality
    """Image quality; of a tracked frame, that of a frame at most `JUDGED_S` before."""
    scene: Scene | None = None
    """Its surface for drawing, if requested; None if it could not be measured."""


ENDED = "the measuring process has ended"


class LiveMeasuring:
    """Measures frames in one process; each call waits for its frame."""

    def __init__(self, setup: Setup, settings: Settings, bit_depth: int) -> None:
        nice = 0  # normal priority: results are urgent
        self._pool = worker_pool(1, nice, hold, LiveChain, setup, settings, bit_depth)

    def measure(self, frame: CameraFrame, with_scene: bool = False) -> LiveResult | None:
        """Measure the next frame; None if it is skipped (`SEARCH_AFTER_S`).

        ``with_scene``: return its surface for drawing, too, which takes another millisecond.

        Raises
        ------
        LiveMeasuringEnded
            If the process has ended.
        """
        try:
            pending = self._pool.submit(_measured, frame, with_scene)
        except RuntimeError as error:  # also if it was closed; faults of the work come later
            raise LiveMeasuringEnded(ENDED) from error
        try:
            return pending.result()
        except (BrokenProcessPool, CancelledError) as error:
            raise LiveMeasuringEnded(ENDED) from error

    def close(self) -> None:
        """Terminate the process. May be called twice."""
        end_processes(self._pool)


class LiveChain:
    """Measures frames in this process; parameters as of `LiveMeasuring`."""

    def __init__(self, setup: Setup, settings: Settings, bit_depth: int) -> None:
        from labapp.core.recording.chain import WarmChain
        from labapp.core.recording.residual_check import ResidualRecord

        self._chain = WarmChain(setup.bench, settings)
        self._record = ResidualRecord(setup.rig)
        self._rays = setup.rig.pattern.rows * setup.rig.pattern.columns
        self._bit_depth = bit_depth
        self._measured_s = -math.inf
        self._judged: tuple[float, Quality] | None = None

    def measure(self, frame: CameraFrame, with_scene: bool) -> LiveResult | None:
        """Measure the next frame, or skip it: see `LiveMeasuring.measure`."""
        found = self._chain.track(frame.image)
        if found is None:
            if time.monotonic() < self._measured_s + SEARCH_AFTER_S:
                self._chain.skip()
                return None
            found = self._chain.search(frame.image)
        surface = None
        if found.status == "ok":
            self._measured_s, surface = time.monotonic(), found.reconstruction
        return LiveResult(
            frame=frame.number,
            time_s=frame.time_s,
            arrived_s=frame.arrived_s,
            measurement=without_surface(self._record.add_and_judge(found)),
            setup_doubt=self._record.doubt,
            track_lost=self._chain.track_lost,
            quality=self._quality(frame, found),
            scene=scene_of(surface) if with_scene and surface is not None else None,
        )

    def _quality(self, frame: CameraFrame, found: Measurement) -> Quality:
        """Return the quality of the frame, or a recent one: it takes half as long as measuring."""
        now_s, is_tracked = time.monotonic(), self._chain.track_lost is None
        if self._judged is not None and is_tracked and now_s < self._judged[0] + JUDGED_S:
            return self._judged[1]
        quality = judge_quality(frame.image, found, self._bit_depth, self._rays)
        self._judged = now_s, quality
        return quality


def _measured(frame: CameraFrame, with_scene: bool) -> LiveResult | None:
    """Measure a frame by the chain that this process holds."""
    found: LiveResult | None = held().measure(frame, with_scene)
    return found
