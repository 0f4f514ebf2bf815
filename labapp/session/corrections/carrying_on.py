"""Application of a frame's corrected dots and rows to the frames after it."""

from __future__ import annotations

from collections.abc import Callable

from labapp.core.images.find_dots import find_dots
from labapp.core.rows.carry_on import carry_on
from labapp.core.rows.correction import Correction
from labapp.core.values import CannotMeasure
from labapp.errors import InputError
from labapp.session.contents import SessionContents
from labapp.text import pluralize


def carried_on(
    session: SessionContents,
    frame: int,
    correction: Correction,
    most: int | None = None,
    proceed: Callable[[int, int], bool] = lambda done, total: True,
) -> tuple[dict[int, Correction], str]:
    """Apply the correction of a frame to at most so many following frames, as long as it fits.

    ``proceed`` is called with the number of frames done and the total; False stops.

    Returns
    -------
    corrections, words
        By frame, without the initial one; their number, and where and why it stopped, a sentence.
    """
    later = session.frames[session.frames > frame].tolist()[:most]
    carried: dict[int, Correction] = {}
    stopped = "there is no frame after it"
    for done, number in enumerate(later):
        why, following = "it was cancelled", None
        try:
            if proceed(done, len(later)):
                dots = find_dots(session.frame(number).image, session.settings.dots)
                why, following = "it no longer fits there", carry_on(correction, dots)
        except (CannotMeasure, InputError) as answer:
            why = str(answer)
        if following is None:
            stopped = f"stopped before frame {number}: {why}"
            break
        carried[number] = correction = following
        stopped = f"up to frame {number}"
    return carried, f"Carried on over {pluralize(len(carried), 'frame')}, {stopped}"
