"""labapp measures the surface of a molten weld pool in 3-D from a reflected dot matrix.

`labapp.Session` is the way in for scripts (docs/python.md).
"""

from __future__ import annotations

import os
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from labapp.session.session import Session

MOST_PIXELS = 2**26
"""No picture has more (8192×8192): a file of 0.4 MB can hold one that unpacks to gigabytes."""

# OpenCV looks at it once, when it is loaded, and then before it decodes.
os.environ["OPENCV_IO_MAX_IMAGE_PIXELS"] = str(MOST_PIXELS)

__all__ = ["Session", "__version__"]
__version__ = "0.1.0"


def __getattr__(name: str) -> object:
    # Loaded when asked for: `labapp --version` needs no numpy.
    if name == "Session":
        from labapp.session.session import Session

        return Session
    raise AttributeError(f"module 'labapp' has no attribute {name!r}")
