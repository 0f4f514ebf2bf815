"""First use of a version: its loops are compiled in a separate process."""

from __future__ import annotations

import importlib
import multiprocessing
from importlib.util import find_spec
from pathlib import Path

from labapp.gui.tasks import Control

TITLE = "First use: compiling for this computer, two to four minutes"

POLL_S = 0.2

_PACKAGE = Path(__file__).parents[1]

COMPILED = (
    *(
        ".".join(("labapp", *file.relative_to(_PACKAGE).with_suffix("").parts))
        for file in sorted(_PACKAGE.glob("core/**/*_kernels.py"))
    ),
    "labapp.core.sequence.prior",
    "labapp.export.fixed_point",
)
"""Modules that compile (docs/adr/0018); those for the dots of a frame come first."""


def not_compiled() -> list[str]:
    """Names of the modules whose compiled code is not on disk."""
    from labapp.core.compiled import is_kept

    specs = [(name, find_spec(name)) for name in COMPILED]
    files = [(name, Path(spec.origin)) for name, spec in specs if spec and spec.origin]
    return [name for name, file in files if file.is_file() and not is_kept(name, file)]


def compile_aside(modules: list[str], control: Control) -> None:
    """Compile modules in another process; code that needs them waits, the window does not."""
    import cv2  # noqa: F401 - changes sys.path meanwhile, which the process would get

    from labapp.core.compiled import MAY_COMPILE

    MAY_COMPILE.clear()
    spawn = multiprocessing.get_context("spawn")
    process = spawn.Process(target=_import, args=(modules,), daemon=True)
    process.start()
    try:
        while process.is_alive():
            process.join(POLL_S)
            control.check()
    finally:
        process.kill()
        MAY_COMPILE.set()


def _import(modules: list[str]) -> None:
    for name in modules:
        importlib.import_module(name)
