"""Compile functions for the processor and cache the machine code (docs/adr/0018).

Modules with compiled functions are imported where they are used: their import takes half a second,
which would otherwise delay the start of the app.
"""

from __future__ import annotations

import logging
import re
import shutil
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext, suppress
from functools import cache
from hashlib import sha256
from pathlib import Path
from threading import Event, Lock
from typing import Any, TypeVar

import llvmlite.binding
import numba
import platformdirs
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
"""Sums may be reordered; division by zero gives infinity or NaN, as in NumPy."""

FLOAT, INT = types.float64, types.int64
FLOATS_1, FLOATS_2, FLOATS_3 = (types.Array(FLOAT, n, "A", readonly=True) for n in (1, 2, 3))
INTS_1 = types.Array(INT, 1, "A", readonly=True)
BOOLS_1 = types.Array(types.boolean, 1, "A", readonly=True)
BAND = types.Array(FLOAT, 2, "F", readonly=True)
"""Types of arguments for `compiled`: arrays of so many dimensions that are only read, of any layout
but for `BAND`, whose columns follow on each other in memory."""

NOTICES = "labapp.notices"
"""Logger of messages for a waiting user; `labapp.log` shows them on stderr."""

MAY_COMPILE = Event()
"""Cleared while another process compiles: compiling here would block all threads meanwhile."""

MAY_COMPILE.set()

_numba_is_set = Lock()
"""Held while numba's settings are changed, which are global to the process."""

FORMAT = 2
"""Version of the cache; increased when functions are compiled differently."""

OLD_S = 60 * 86400.0
"""Age at which unused cache entries are deleted, s."""


def compiled(*signature: types.Type) -> Callable[[F], F]:
    """Compile for arguments of these types, or load the machine code from the cache on disk.

    A function is recompiled when its file changes, or a kernel module that the file imports at its
    top, whose compiled functions it may call.
    """
    return lambda function: _compile_cached(function, signature)


def compiled_for(*signatures: tuple[types.Type, ...]) -> Callable[[F], F]:
    """Compile as `compiled` does for several signatures."""
    return lambda function: _compile_cached(function, list(signatures))


def inner(function: F) -> F:
    """Compile a function that is called only by compiled functions."""
    return _compile_cached(function)


class BySource(_CacheLocator):
    """Cache entry keyed by the module's name and its sources, independent of the file's path.

    A second checkout or environment of a user thus shares the cache of the first.
    """

    def __init__(self, function: Any, file: str) -> None:
        self._folder = _folder_of(function.__module__, Path(file))
        self._line: int = function.__code__.co_firstlineno

    @classmethod
    def from_function(cls, function: Any, file: str) -> BySource | None:
        """Return the cache entry of a function; None if it is not writable."""
        try:
            place = cls(function, file)
            is_new = not place._folder.exists()
            place.ensure_cache_path()  # type: ignore[no-untyped-call]
        except OSError:
            return None
        if is_new:
            _announce()
            _delete_old(_folder())
        return place

    def get_cache_path(self) -> str:
        """Return the cache folder of the function's file."""
        return str(self._folder)

    def mark_of(self, function: Any) -> Path:
        """Return the file that marks a function as compiled by this version of Python."""
        name = f"{function.__name__}-{self._line}.{sys.implementation.cache_tag}.compiled"
        return self._folder / name

    def get_source_stamp(self) -> str:
        """Return the digest of the sources."""
        return self._folder.name

    def get_disambiguator(self) -> str:
        """Return the line number, which distinguishes functions of the same name."""
        return str(self._line)


class OwnCopies(JITCodeLibrary):
    """Compiled code that calls only its own copies of other functions.

    The machine code of a function contains a copy of each function that it calls. numba lets the
    linker use one copy for the whole process: the first one. This is the function's own copy if it
    was just compiled, but that of the caller loaded first if all were loaded from disk. Copies are
    optimised in different contexts, so that their sums differ in the last digits.

    The cache also has the LLVM code of a function, from which its callers are compiled. numba reads
    it along with the machine code, which takes as long as all else; here it is read when needed.
    """

    _unread = b""

    def _optimize_final_module(self) -> None:
        for function in self._final_module.functions:
            if function.linkage.name == "linkonce_odr":
                function.linkage = "internal"
        super()._optimize_final_module()  # type: ignore[no-untyped-call]

    @classmethod
    def _unserialize(cls, codegen: Any, state: Any) -> Any:
        name, kind, (machine_code, llvm_code) = state
        empty = llvmlite.binding.parse_assembly("").as_bitcode()
        made = super()._unserialize(codegen, (name, kind, (machine_code, empty)))  # type: ignore[no-untyped-call]
        made._shared_module, made._unread = None, llvm_code
        return made

    def get_pointer_to_function(self, name: str) -> int:
        """Return the address of a function in this code."""
        if self._unread:  # numba looks for its name in the LLVM code
            address: int = self._codegen._engine.get_function_address(name)
            return address
        return int(super().get_pointer_to_function(name))  # type: ignore[no-untyped-call]

    def _get_module_for_linking(self) -> Any:
        if self._unread:
            self._shared_module = llvmlite.binding.parse_bitcode(self._unread)
            self._unread = b""
        return super()._get_module_for_linking()  # type: ignore[no-untyped-call]


def is_kept(module: str, file: Path) -> bool:
    """Whether the cache has an entry for a module's file."""
    return (_folder() / _digest(module, file)).exists()


def _digest(module: str, file: Path) -> str:
    # Cached code also refers to its module by name. numba empties the cache of another version:
    # two environments with different ones would compile in turns.
    whole = sha256(f"{FORMAT} {numba.__version__} {module}\0".encode())
    for source in sorted(set(_sources(module, file))):
        whole.update(source)
    return whole.hexdigest()[:24]


def _sources(module: str, file: Path) -> Iterator[bytes]:
    """Yield the source of a file and of the kernel modules that it imports at its top."""
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
def _folder_of(module: str, file: Path) -> Path:
    """Return the cache folder of a module that is being loaded, for each of its functions."""
    return _folder() / _digest(module, file)


@cache
def _announce() -> None:
    # Once per process, however many files it compiles.
    logging.getLogger(NOTICES).warning(
        "First use of this version: labapp is being compiled for this computer's processor. "
        "This takes two to four minutes and is done once."
    )


def _delete_old(folder: Path) -> None:
    with suppress(OSError):
        for each in folder.iterdir():
            if each.stat().st_mtime < time.time() - OLD_S:
                shutil.rmtree(each, ignore_errors=True)


@contextmanager
def _one_at_a_time(function: Any) -> Iterator[None]:
    """Lock the cache entry: one process compiles a function, the others then load it.

    Processes that start together would wait for each other's locks. So none is needed once the
    function has a mark that it was compiled.
    """
    place = BySource.from_function(function, function.__code__.co_filename)
    if place is None or place.mark_of(function).exists():
        yield
        return
    from filelock import FileLock

    with FileLock(Path(place.get_cache_path()) / "lock"):
        yield
        with suppress(OSError):  # without a mark, the next process takes the lock, too
            place.mark_of(function).touch()


def _compile_cached(function: F, *signature: Any) -> F:
    """Compile a function, or load its machine code from the cache."""
    MAY_COMPILE.wait()
    # A numba version without this setting uses its default cache.
    usual = getattr(_config, "CACHE_LOCATOR_CLASSES", "")
    codegen: Any = cpu_target.target_context.codegen()
    with _numba_is_set:
        _config.CACHE_LOCATOR_CLASSES = f"{__name__}.{BySource.__name__}"
        codegen._library_class = OwnCopies
        try:
            with _one_at_a_time(function) if signature else nullcontext():
                made: F = _njit(*signature, cache=True, **HOW)(function)
        except RuntimeError:  # no writable cache
            made = _njit(*signature, **HOW)(function)
        finally:
            _config.CACHE_LOCATOR_CLASSES = usual
            del codegen._library_class
    return made
