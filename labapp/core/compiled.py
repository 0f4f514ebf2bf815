"""How functions are compiled for the processor (docs/adr/0018).

Modules that compile are imported where they are used: that takes half a second, which belongs to
a measurement and not to the app's start.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

from numba import njit, types

F = TypeVar("F", bound=Callable[..., object])

HOW: dict[str, Any] = {
    "nogil": True,
    "error_model": "numpy",
    "fastmath": {"reassoc", "contract", "nsz"},
}
"""Sums may be taken in any order and division by zero gives infinity or NaN, as in NumPy."""


def compiled(*signature: types.Type) -> Callable[[F], F]:
    """Compile for arguments of these types, or take what was compiled before from the disk.

    What is kept there is compiled anew when the function's own file changes, and only then: it must
    not call compiled functions of other files.
    """
    return lambda function: _kept(function, signature)


def compiled_for(*signatures: tuple[types.Type, ...]) -> Callable[[F], F]:
    """Do what `compiled` does for each of several kinds of arguments."""
    return lambda function: _kept(function, list(signatures))


def part(function: F) -> F:
    """Compile as a part of the functions of its file that call it."""
    return _kept(function)


def _kept(function: F, *signature: Any) -> F:
    compile_it: Any = njit
    try:
        made: F = compile_it(*signature, cache=True, **HOW)(function)
    except RuntimeError:  # neither beside the file nor in the user's own cache can be written
        made = compile_it(*signature, **HOW)(function)
    return made
