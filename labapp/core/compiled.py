"""Compilation of functions for the processor, with a cache on the disk (docs/adr/0018).

Modules with compiled functions are imported inside the functions that use them: the import takes
half a second, which would delay the start of the app.
"""

from __future__ import annotations

import logging
import re
import shutil
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, nullcontext, suppress
from functools import cache
from hashlib import sha256
from pathlib import Path
from threading import Event, Lock
from typing import Any, TypeVar

import numba
import platformdirs
from filelock import FileLock
from numba import types
from numba.core.caching import _CacheLocator
from numba.core.codegen import JITCodeLibrary
from numba.core.registry import cpu_target

F = TypeVar("F", bound=Callable[..., object])

_njit: Any = numba.njit
_config: Any = numba.config

HOW: dict[str, Any] = {
    "nogil": True,
    "error_model": "numpy",
    "fastmath": {"reassoc", "contract", "nsz"},
}
"""Compiler options: sums may be reordered; division by zero gives infinity or NaN, as in NumPy."""

NOTICES = "labapp.notices"
"""Logger of notices for a waiting user; `labapp.log` shows them on stderr."""

MAY_COMPILE = Event()
"""Cleared while another process compiles, since waiting for it would block all threads of this
process."""

MAY_COMPILE.set()

_numba_is_set = Lock()
"""Lock for the time that numba's process-wide settings are changed for a compilation."""

FORMAT = 2
"""Version of the cache; increased when functions are compiled in a different way."""

OLD_S = 60 * 86400.0
"""Cache entries older than this are deleted, s."""


def compiled(*signature: types.Type) -> Callable[[F], F]:
    """Compile for arguments of these types, or load the compiled function from the cache.

    The cache entry is invalid if the function's file changes, or a ``_kernels`` module that it
    imports at the top, as it may call that module's compiled functions.
    """
    return lambda function: _kept(function, signature)


def compiled_for(*signatures: tuple[types.Type, ...]) -> Callable[[F], F]:
    """Compile as `compiled` does, for each of several signatures."""
    return lambda function: _kept(function, list(signatures))


def inner(function: F) -> F:
    """Compile a function that is called by compiled functions only."""
    return _kept(function)


class BySource(_CacheLocator):
    """Cache locator by module name and digest of the sources, independent of the file's path.

    Different checkouts and environments of a user share their cache entries.
    """

    def __init__(self, function: Any, file: str) -> None:
        self._source = _digest(function.__module__, Path(file))
        self._line: int = function.__code__.co_firstlineno

    @classmethod
    def from_function(cls, function: Any, file: str) -> BySource | None:
        """Return the locator of a function; None if its folder cannot be written to."""
        try:
            place = cls(function, file)
            is_new = not Path(place.get_cache_path()).exists()
            place.ensure_cache_path()  # type: ignore[no-untyped-call]
        except OSError:
            return None
        if is_new:
            _announce()
            _delete_old(_folder())
        return place

    def get_cache_path(self) -> str:
        """Return the cache folder of the function's file."""
        return str(_folder() / self._source)

    def get_source_stamp(self) -> str:
        """Return the digest of the sources."""
        return self._source

    def get_disambiguator(self) -> str:
        """Return the line number, which distinguishes functions of the same name."""
        return str(self._line)


class OwnCopies(JITCodeLibrary):
    """Compiled code that calls only its own copies of other functions, for reproducible results.

    The machine code of a function contains a copy of each function that it calls. By default the
    linker uses one copy in the whole process: the first, which depends on whether functions were
    compiled or loaded from the cache, and in which order. Copies are optimised in different
    contexts, so that their sums differ in the last digits.
    """

    def _optimize_final_module(self) -> None:
        for function in self._final_module.functions:
            if function.linkage.name == "linkonce_odr":
                function.linkage = "internal"
        super()._optimize_final_module()  # type: ignore[no-untyped-call]


def is_kept(module: str, file: Path) -> bool:
    """Whether the cache has an entry for a module's file."""
    return (_folder() / _digest(module, file)).exists()


def _digest(module: str, file: Path) -> str:
    # Cached code contains the name of its module.
    whole = sha256(f"{FORMAT} {module}\0".encode())
    for source in sorted(set(_sources(module, file))):
        whole.update(source)
    return whole.hexdigest()[:24]


def _sources(module: str, file: Path) -> Iterator[bytes]:
    """Yield the contents of a file and, recursively, of the kernel modules imported at its top."""
    source = file.read_bytes()
    yield source
    package, depth = module.partition(".")[0], module.count(".")
    root = file.parents[depth - 1] if depth else file.parent
    for name in re.findall(rf"^from {package}\.(\S+_kernels) import ", source.decode(), re.M):
        path = name.split(".")
        yield from _sources(f"{package}.{name}", root.joinpath(*path[:-1], f"{path[-1]}.py"))


def _folder() -> Path:
    own = _config.CACHE_DIR or platformdirs.user_cache_dir("labapp", appauthor=False)
    return Path(own) / "loops"


@cache
def _announce() -> None:
    # Once per process, for any number of compiled files.
    logging.getLogger(NOTICES).warning(
        "First use of this version: labapp is being compiled for this computer's processor. "
        "This takes one to two minutes and is done once."
    )


def _delete_old(folder: Path) -> None:
    with suppress(OSError):
        for each in folder.iterdir():
            if each.stat().st_mtime < time.time() - OLD_S:
                shutil.rmtree(each, ignore_errors=True)


def _one_at_a_time(function: Any) -> AbstractContextManager[object]:
    """Lock that lets one process compile a function while the others wait and then load it."""
    place = BySource.from_function(function, function.__code__.co_filename)
    return nullcontext() if place is None else FileLock(Path(place.get_cache_path()) / "lock")


def _kept(function: F, *signature: Any) -> F:
    MAY_COMPILE.wait()
    # Versions of numba without this setting use their default cache.
    usual = getattr(_config, "CACHE_LOCATOR_CLASSES", "")
    codegen: Any = cpu_target.target_context.codegen()
    with _numba_is_set:
        _config.CACHE_LOCATOR_CLASSES = f"{__name__}.{BySource.__name__}"
        codegen._library_class = OwnCopies
        try:
            with _one_at_a_time(function) if signature else nullcontext():
                result: F = _njit(*signature, cache=True, **HOW)(function)
        except RuntimeError:  # no cache folder is writable
            result = _njit(*signature, **HOW)(function)
        finally:
            _config.CACHE_LOCATOR_CLASSES = usual
            del codegen._library_class
    return result
