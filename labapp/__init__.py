"""labapp measures the surface of a molten weld pool in 3-D from a reflected dot matrix.

`labapp.Session` and `labapp.Study` are the ways in for scripts (docs/python.md, docs/studies.md).
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import labapp.pixels  # noqa: F401 (sets OpenCV's limits before anything loads it)
from labapp.version import VERSION

if TYPE_CHECKING:
    from labapp.run.study.study import Study
    from labapp.session.session import Session

__all__ = ["Session", "Study", "__version__"]
__version__ = VERSION


def __getattr__(name: str) -> object:
    # Loaded on first use: `labapp --version` needs no numpy.
    if name == "Session":
        from labapp.session.session import Session

        return Session
    if name == "Study":
        from labapp.run.study.study import Study

        return Study
    raise AttributeError(f"module 'labapp' has no attribute {name!r}")
