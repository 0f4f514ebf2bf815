"""The state of each frame of a session, which its tick in the timeline shows."""

from __future__ import annotations

from enum import IntEnum
from typing import TYPE_CHECKING

import numpy as np

from labapp.core.values import BoolArray, IntArray
from labapp.gui.widgets.scrubber import Tick
from labapp.session.results.statuses import PULSE, is_failed, is_measured

if TYPE_CHECKING:
    from labapp.session.results.measured import Overview


class FrameStatus(IntEnum):
    """State of a frame; if several frames share a pixel, the greatest is shown."""

    NOT_MEASURED = 0
    PULSE = 1
    MEASURED = 2
    CORRECTED = 3
    OUT_OF_DATE = 4
    DOUBTFUL = 5
    NOT_MEASURABLE = 6


TICKS = (
    Tick("not measured", "to do", "", "", ((0.0, 0.12),)),
    Tick("dimmer than a current pulse", "pulse", "#7a4fb5", "#b08ae6", ((0.0, 0.3),)),
    Tick("measured", "done", "#1d7f45", "#3fae6b", ((0.0, 0.62),)),
    Tick("corrected by hand", "by hand", "#0a6fc2", "#59aef0", ((0.0, 1.0),)),
    Tick(
        "out of date: set-up, settings or dots changed since it was measured",
        *("out of date", "#8a5a2e", "#c79a6b", ((0.0, 0.16), (0.24, 0.4), (0.48, 0.62))),
    ),
    Tick("in doubt: stands out", "doubtful", "#c77700", "#e8a23a", ((0.0, 0.3), (0.5, 0.8))),
    Tick("could not be measured", "failed", "#b8321f", "#f0705a", ((0.0, 0.22), (0.78, 1.0))),
)
"""Ticks by `FrameStatus`, with the texts for the operator."""

TO_CHECK = (FrameStatus.OUT_OF_DATE, FrameStatus.DOUBTFUL, FrameStatus.NOT_MEASURABLE)
"""States that the operator has to check."""


def frame_statuses(seen: Overview) -> IntArray:
    """State of every frame, values of `FrameStatus`, shape (n,)."""
    from labapp.session.results.trends import outlying_frames

    status = np.array(seen.status, dtype=object)
    done = status != ""
    measured = np.array([is_measured(each) for each in seen.status], bool)
    failed = np.array([is_failed(each) for each in seen.status], bool)
    found = np.where(done, FrameStatus.MEASURED, FrameStatus.NOT_MEASURED)
    found = np.where(seen.corrected & (measured | ~done), FrameStatus.CORRECTED, found)
    found = np.where(failed, FrameStatus.NOT_MEASURABLE, found)
    found = np.where(status == PULSE, FrameStatus.PULSE, found)
    found = np.where(measured & outlying_frames(seen), FrameStatus.DOUBTFUL, found)
    return np.asarray(np.where(done & seen.stale, FrameStatus.OUT_OF_DATE, found), np.int64)


def next_frame(
    frames: IntArray, wanted: BoolArray, current: int, forward: bool = True
) -> int | None:
    """Nearest wanted frame after or before the current one; None if there is none.

    ``frames`` ascend; they and ``wanted`` have shape (n,).
    """
    chosen = frames[wanted]
    chosen = chosen[chosen > current] if forward else chosen[chosen < current][::-1]
    return int(chosen[0]) if len(chosen) else None
