"""How functions are compiled for the processor (docs/adr/0018).

Modules that compile are imported where they are used: that takes half a second, which belongs to
a measurement and not to the app's start.
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
"""Sums may be taken in any order and division by zero gives infinity or NaN, as in NumPy."""

NOTICES = "labapp.notices"
"""Logger of what the user should read while waiting; `labapp.log` shows it on stderr."""

MAY_COMPILE = Event()
"""Cleared while another process compiles: meanwhile it would stop all threads of this one."""

MAY_COMPILE.set()

_numba_is_set = Lock()
"""Held while numba is set to compile as it is done here: its settings are the process's."""

FORMAT = 2
"""Of what is kept on the disk; raised when it is compiled in another way than before."""

OLD_S = 60 * 86400.0
"""What was compiled for a source that nobody has is deleted after so long, s."""


def compiled(*signature: types.Type) -> Callable[[F], F]:
    """Compile for arguments of these types, or take what was compiled before from the disk.

    What is kept there is compiled anew when the function's file changes, or one that compiles and
    that it imports at its top: it may call the compiled functions of these.
    """
    return lambda function: _kept(function, signature)


def compiled_for(*signatures: tuple[types.Type, ...]) -> Callable[[F], F]:
    """Do what `compiled` does for each of several kinds of arguments."""
    return lambda function: _kept(function, list(signatures))


def inner(function: F) -> F:
    """Compile a function that only compiled functions call."""
    return _kept(function)


class BySource(_CacheLocator):
    """Keeps what is compiled by its module's name and its sources, wherever its file is.

    A second checkout or environment of a user finds what the first one compiled.
    """

    def __init__(self, function: Any, file: str) -> None:
        self._source = _digest(function.__module__, Path(file))
        self._line: int = function.__code__.co_firstlineno

    @classmethod
    def from_function(cls, function: Any, file: str) -> BySource | None:
        """Return the place of a function; None where it cannot be written to."""
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
        """Return the folder of the function's file."""
        return str(_folder() / self._source)

    def get_source_stamp(self) -> str:
        """Return the digest of the sources."""
        return self._source

    def get_disambiguator(self) -> str:
        """Return what tells functions of one name apart."""
        return str(self._line)


class OwnCopies(JITCodeLibrary):
    """Compiled code that calls its own copies of other functions, and nobody else's.

    The machine code of a function has a copy of each function that it calls. numba lets the linker
    take one copy for all of a process: the first one, which is the function's own where it was
    compiled, and that of the caller loaded first where all came from the disk. Copies are
    optimised among other code each, so that their sums differ in the last digits.
    """

    def _optimize_final_module(self) -> None:
        for function in self._final_module.functions:
            if function.linkage.name == "linkonce_odr":
                function.linkage = "internal"
        super()._optimize_final_module()  # type: ignore[no-untyped-call]


def is_kept(module: str, file: Path) -> bool:
    """Whether anything that a module's file compiles is kept on the disk."""
    return (_folder() / _digest(module, file)).exists()


def _digest(module: str, file: Path) -> str:
    # What is kept names its module, too.
    whole = sha256(f"{FORMAT} {module}\0".encode())
    for source in sorted(set(_sources(module, file))):
        whole.update(source)
    return whole.hexdigest()[:24]


def _sources(module: str, file: Path) -> Iterator[bytes]:
    """Yield what a file says, and what those say that compile and that it imports at its top."""
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
    # Once in a process, however many files it compiles.
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
    """Have one process at a time compile a function, which the others then load."""
    place = BySource.from_function(function, function.__code__.co_filename)
    return nullcontext() if place is None else FileLock(Path(place.get_cache_path()) / "lock")


def _kept(function: F, *signature: Any) -> F:
    MAY_COMPILE.wait()
    # A numba that does not know the setting keeps what it compiles where it always does.
    usual = getattr(_config, "CACHE_LOCATOR_CLASSES", "")
    codegen: Any = cpu_target.target_context.codegen()
    with _numba_is_set:
        _config.CACHE_LOCATOR_CLASSES = f"{__name__}.{BySource.__name__}"
        codegen._library_class = OwnCopies
        try:
            with _one_at_a_time(function) if signature else nullcontext():
                made: F = _njit(*signature, cache=True, **HOW)(function)
        except RuntimeError:  # nowhere to keep it
            made = _njit(*signature, **HOW)(function)
        finally:
            _config.CACHE_LOCATOR_CLASSES = usual
            del codegen._library_class
    return made
