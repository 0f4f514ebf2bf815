"""labapp measures the surface of a molten weld pool in 3-D from a reflected dot matrix.

`labapp.measure`, `labapp.Session` and `labapp.Study` are for scripts (docs/python.md).
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING

import labapp.pixels  # noqa: F401 (sets OpenCV's limits before anything loads it)
from labapp.version import VERSION

if TYPE_CHECKING:
    from labapp.api import Results, measure
    from labapp.core.pipeline import Settings
    from labapp.errors import InputError
    from labapp.export.folder import ExportChoice
    from labapp.export.formats import RunFormat, SurfaceFormat, add_export_format
    from labapp.run.study.study import Study
    from labapp.session.record import Record
    from labapp.session.session import Session

__all__ = [
    "ExportChoice",
    "InputError",
    "Record",
    "Results",
    "RunFormat",
    "Session",
    "Settings",
    "Study",
    "SurfaceFormat",
    "__version__",
    "add_export_format",
    "measure",
]
__version__ = VERSION

_MODULES = {
    "ExportChoice": "labapp.export.folder",
    "InputError": "labapp.errors",
    "Record": "labapp.session.record",
    "Results": "labapp.api",
    "RunFormat": "labapp.export.formats",
    "Session": "labapp.session.session",
    "Settings": "labapp.core.pipeline",
    "Study": "labapp.run.study.study",
    "SurfaceFormat": "labapp.export.formats",
    "add_export_format": "labapp.export.formats",
    "measure": "labapp.api",
}


def __getattr__(name: str) -> object:
    # Imported on first use: `labapp --version` does not need NumPy.
    if name not in _MODULES:
        raise AttributeError(f"module 'labapp' has no attribute {name!r}")
    found: object = getattr(importlib.import_module(_MODULES[name]), name)
    return found


def __dir__() -> list[str]:
    return sorted(__all__)
