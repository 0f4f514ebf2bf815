"""How large a picture may be, and OpenCV told of it; `labapp` imports it before all else."""

from __future__ import annotations

import os

MOST_PIXELS = 2**26
"""No picture has more (8192×8192): a file of 0.4 MB can hold one that unpacks to gigabytes."""

# OpenCV looks at it once, when it is loaded, and then before it decodes.
os.environ["OPENCV_IO_MAX_IMAGE_PIXELS"] = str(MOST_PIXELS)
