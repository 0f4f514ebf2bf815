"""Limits of image sizes, also those of OpenCV; `labapp` imports this module first."""

from __future__ import annotations

import os

MOST_PIXELS = 2**26
"""Limit for a picture (8192×8192): a file of 0.4 MB can decompress to gigabytes."""

# OpenCV reads this once, when it is loaded.
os.environ["OPENCV_IO_MAX_IMAGE_PIXELS"] = str(MOST_PIXELS)


MOST_BYTES = 2**30
"""Memory limit for the frames that a video decoder holds."""

HELD_FRAMES, HELD_REORDERED = 2, 17
"""Frames that a decoder may hold; the same for codecs that reorder frames."""


def most_decoded(bits: int, reordered: bool) -> int:
    """Return the most pixels that a video frame may have, given the bits per pixel."""
    held = HELD_REORDERED if reordered else HELD_FRAMES
    return min(MOST_PIXELS, 8 * MOST_BYTES // (max(bits, 1) * held))
