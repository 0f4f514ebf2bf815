"""Frames of a live camera measured in a process of their own, each from the one before."""

from __future__ import annotations

import math
import multiprocessing
import time
from collections.abc import Callable
from concurrent.futures import CancelledError, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from typing import NamedTuple

from labapp.config.setup import Setup
from labapp.core.pipeline import Settings
from labapp.core.quality import Quality, judge_quality
from labapp.core.surface.measures import Measures
from labapp.export.scene import Scene, scene_of
from labapp.media import GreyImage
from labapp.simulation.parallel import begin_worker, end_processes

JUDGED_S = 0.2
"""So long the verdict on a frame stands for those that are followed from it."""


SOUGHT_S = 1.0
"""So long after a frame that was measured those that are not followed are left out: the pool may
swing back to where it was, and a frame that is measured by itself takes seconds."""


class LiveMeasuringEnded(Exception):
    """The process has ended: it was closed, or something ended it."""


@dataclass(frozen=True)
class LiveMeasurement:
    """What a live frame gave.

    Parameters
    ----------
    status, reason
        As in `pipeline.Measurement`.
    quality
        How fit frames are to be measured; while each is followed, of one some times a second.
    measures
        Sizes; None where it could not be measured.
    followed
        Whether it was measured from the one before, in milliseconds; else by itself, in seconds.
    scene
        Its surface to be drawn, where that was asked for; None where it could not be measured.
    """

    status: str
    reason: str
    quality: Quality
    measures: Measures | None
    followed: bool
    scene: Scene | None = None


class LiveMeasuring:
    """Measures frames in one process; each call waits for its frame.

    Parameters
    ----------
    setup
        Rig and image calibration.
    settings
        Of the measurement.
    bit_depth
        Significant bits of a grey level.
    """

    def __init__(self, setup: Setup, settings: Settings, bit_depth: int) -> None:
        spawn = multiprocessing.get_context("spawn")
        given, nice = _Chain(setup, settings, bit_depth), 0  # its figures are looked at now
        self._pool = ProcessPoolExecutor(
            1, spawn, initializer=begin_worker, initargs=(nice, _begin, given)
        )

    def measure(self, image: GreyImage, drawn: bool = False) -> LiveMeasurement | None:
        """Measure the next frame; None where it is left out, for one after it may be followed.

        Parameters
        ----------
        image
            Grey levels, shape (rows, columns).
        drawn
            Whether its surface is to be drawn: that takes a millisecond more.

        Raises
        ------
        LiveMeasuringEnded
            If the process has ended.
        """
        try:
            return self._pool.submit(_measured, image, drawn).result()
        except (BrokenProcessPool, CancelledError, RuntimeError) as error:
            raise LiveMeasuringEnded(str(error)) from error

    def close(self) -> None:
        """End the process, whatever it is at. Twice does no harm."""
        end_processes(self._pool)


class _Chain(NamedTuple):
    """What the process measures by."""

    setup: Setup
    settings: Settings
    bit_depth: int


_measure: list[Callable[[GreyImage, bool], LiveMeasurement | None]] = []
"""In the process: what measures."""


def _begin(given: _Chain) -> None:
    setup, settings, depth = given
    from labapp.core.sequence.warm import WarmChain

    chain = WarmChain(setup.rig, setup.calibration, settings)
    rays = setup.rig.pattern.rows * setup.rig.pattern.columns
    verdict: list[tuple[float, Quality]] = []
    measured_s = -math.inf

    def measure(image: GreyImage, drawn: bool) -> LiveMeasurement | None:
        nonlocal measured_s
        found = chain.follow(image)
        if found is None and time.monotonic() < measured_s + SOUGHT_S:
            return None
        found = found or chain.measure(image)
        followed, ok, now_s = chain.broke is None, found.status == "ok", time.monotonic()
        if ok:
            measured_s = now_s
        if not (verdict and followed and ok and now_s < verdict[0][0] + JUDGED_S):
            # It takes nearly half as long as measuring.
            verdict[:] = [(now_s, judge_quality(image, found, depth, rays))]
        surface = found.reconstruction if drawn and ok else None
        return LiveMeasurement(
            found.status,
            found.reason,
            verdict[0][1],
            found.measures if ok else None,
            followed,
            None if surface is None else scene_of(surface),
        )

    _measure[:] = [measure]


def _measured(image: GreyImage, drawn: bool) -> LiveMeasurement | None:
    return _measure[0](image, drawn)
