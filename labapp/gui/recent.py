"""Summary of a session on the welcome page."""

from __future__ import annotations

import datetime
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from labapp.errors import InputError
from labapp.gui.drafts import is_draft
from labapp.session.results.statuses import PULSE, is_failed, is_measured
from labapp.text import pluralize

if TYPE_CHECKING:
    from labapp.media import GreyImage
    from labapp.session.session import Session

THUMBNAIL_PX = (128, 96)


@dataclass(frozen=True)
class Recent:
    """A recently opened session."""

    path: Path
    title: str
    """Title of the experiment, or the name of the file."""
    about: str
    """Date, numbers of frames and of measured ones; or why it cannot be opened."""
    thumbnail: GreyImage | None = None
    """Small picture of its first frame; None if it cannot be read."""
    there: bool = True
    """Whether it can be opened."""


def look_at(path: Path) -> Recent:
    """Read the summary of a session file without changing anything."""
    from labapp.session.session import Session

    try:
        changed = datetime.datetime.fromtimestamp(path.stat().st_mtime)
        with Session.open(path, read_only=True) as session:
            title = session.record.title or path.stem
            frames = session.frames
            draft = "draft · " if is_draft(path) else ""
            about = f"{draft}{changed:%Y-%m-%d %H:%M} · {_counted(session.overview().status)}"
            return Recent(path, title, about, _thumbnail(session, frames))
    except InputError as error:
        return Recent(path, path.stem, f"{error.field}: {error.value}", there=False)
    except OSError as error:
        return Recent(path, path.stem, str(error.strerror), there=False)


def _counted(statuses: Sequence[str]) -> str:
    if not statuses:
        return "no recording yet"
    measured, failed = sum(map(is_measured, statuses)), sum(map(is_failed, statuses))
    pulses = statuses.count(PULSE)
    some = "all" if measured == len(statuses) else measured or "none"
    message = f"{pluralize(len(statuses), 'frame')}, {some} measured"
    message += f", {pluralize(pulses, 'pulse')}" if pulses else ""
    return f"{message}, {failed} failed" if failed else message


def _thumbnail(session: Session, frames: np.ndarray) -> GreyImage | None:
    import cv2

    if not len(frames):
        return None
    try:
        image = session.frame(int(frames[0])).image
    except InputError:  # the recording is elsewhere; the session can be used without it
        return None
    rows, columns = image.shape
    scale = min(THUMBNAIL_PX[0] / columns, THUMBNAIL_PX[1] / rows)
    size = (max(1, round(columns * scale)), max(1, round(rows * scale)))
    small = cv2.resize(np.asarray(image, np.float32), size, interpolation=cv2.INTER_AREA)
    low, high = float(small.min()), float(small.max())
    grey = np.asarray((small - low) * (255 / max(high - low, 1e-9)), np.uint8)
    return grey
