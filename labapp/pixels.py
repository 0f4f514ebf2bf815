"""How large a picture may be, set for OpenCV, too; `labapp` imports it before all else."""

from __future__ import annotations

import os

MOST_PIXELS = 2**26
"""No picture has more (8192×8192): a file of 0.4 MB can hold one that unpacks to gigabytes."""

# OpenCV looks at it once, when it is loaded, and then before it decodes.
os.environ["OPENCV_IO_MAX_IMAGE_PIXELS"] = str(MOST_PIXELS)


MOST_BYTES = 2**30
"""A video's decoder holds no more in frames than this."""

HELD_FRAMES, HELD_REORDERED = 2, 17
"""Frames that it may hold; of codecs that store them out of the order they are shown in."""


def most_decoded(bits: int, reordered: bool) -> int:
    """Pixels that a frame of a video may have, at the given bits of each."""
    held = HELD_REORDERED if reordered else HELD_FRAMES
    return min(MOST_PIXELS, 8 * MOST_BYTES // (max(bits, 1) * held))
