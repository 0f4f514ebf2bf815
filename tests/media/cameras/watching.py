"""What tests of cameras share: pictures that tell their number, and waiting for what is to come."""

from __future__ import annotations

import numpy as np

from labapp.media.base import GreyImage
from labapp.media.events import Event

SHAPE = (24, 32)


def numbered(k: int) -> GreyImage:
    """Frame k of a camera: k in its first pixels, four bytes, over a pattern."""
    image = np.add.outer(np.arange(24), np.arange(32)).astype(np.uint8) * 3
    image[0, :4] = np.frombuffer(np.uint32(k).tobytes(), np.uint8)
    return image


def number_in(image: GreyImage) -> int:
    """The number that `numbered` wrote."""
    return int(np.frombuffer(image[0, :4].astype(np.uint8).tobytes(), np.uint32)[0])


class Heard(list[Event]):
    """Events, as they are said."""

    def words(self) -> str:
        """All of them, a line each."""
        return "\n".join(f"{event.kind}: {event}" for event in self)
