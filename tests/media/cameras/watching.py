"""Helpers for tests of cameras: pictures that contain their number, and a list of events."""

from __future__ import annotations

import numpy as np

from labapp.media.base import GreyImage
from labapp.media.events import Event

SHAPE = (24, 32)


def numbered(k: int) -> GreyImage:
    """Frame k of a camera: a pattern, with k in the first four pixels."""
    image = np.add.outer(np.arange(24), np.arange(32)).astype(np.uint8) * 3
    image[0, :4] = np.frombuffer(np.uint32(k).tobytes(), np.uint8)
    return image


def number_in(image: GreyImage) -> int:
    """Return the number written by `numbered`."""
    return int(np.frombuffer(image[0, :4].astype(np.uint8).tobytes(), np.uint32)[0])


class Events(list[Event]):
    """The reported events."""

    def words(self) -> str:
        """All events, one line each."""
        return "\n".join(f"{event.kind}: {event}" for event in self)
