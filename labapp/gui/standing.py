"""How each frame of a session stands: what its tick in the timeline shows."""

from __future__ import annotations

from enum import IntEnum
from typing import TYPE_CHECKING

import numpy as np

from labapp.core.values import BoolArray, IntArray

if TYPE_CHECKING:
    from labapp.session.measured import Overview


class Standing(IntEnum):
    """How a frame stands; where several share a pixel, the greatest shows."""

    NOT_MEASURED = 0
    MEASURED = 1
    CORRECTED = 2
    DOUBTFUL = 3
    NOT_MEASURABLE = 4

    @property
    def words(self) -> str:
        """For the operator."""
        return WORDS[self]


WORDS = {
    Standing.NOT_MEASURED: "not measured",
    Standing.MEASURED: "measured",
    Standing.CORRECTED: "corrected by hand",
    Standing.DOUBTFUL: "in doubt: stands out, or changed since it was measured",
    Standing.NOT_MEASURABLE: "could not be measured",
}

DOUBTFUL = (Standing.DOUBTFUL, Standing.NOT_MEASURABLE)
"""What an operator has to look at."""


def standings(seen: Overview) -> IntArray:
    """How every frame stands, values of `Standing`, shape (n,)."""
    from labapp.session.trends import doubtful_frames

    status = np.array(seen.status, dtype=object)
    measured, fine = status != "", status == "ok"
    found = np.where(measured, Standing.MEASURED, Standing.NOT_MEASURED)
    found = np.where(seen.corrected & (fine | ~measured), Standing.CORRECTED, found)
    found = np.where(measured & ~fine, Standing.NOT_MEASURABLE, found)
    doubtful = (measured & seen.stale) | (fine & doubtful_frames(seen))
    return np.asarray(np.where(doubtful, Standing.DOUBTFUL, found), np.int64)


def next_frame(
    frames: IntArray, wanted: BoolArray, current: int, forward: bool = True
) -> int | None:
    """The nearest wanted frame after the current one, or before it; None if there is none.

    Parameters
    ----------
    frames
        Numbers of the frames, ascending, shape (n,).
    wanted
        Which of them are wanted, shape (n,), of bool.
    current
        A frame's number.
    forward
        Whether to look after it.
    """
    chosen = frames[wanted]
    chosen = chosen[chosen > current] if forward else chosen[chosen < current][::-1]
    return int(chosen[0]) if len(chosen) else None
