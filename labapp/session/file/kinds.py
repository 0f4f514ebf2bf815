"""Run-time checks of values against the type hints and array shapes of their class."""

from __future__ import annotations

import dataclasses
import functools
import types
import typing
from collections.abc import Collection, Mapping
from typing import Any, Never

import numpy as np
import numpy.typing as npt

from labapp.core.surface.reconstruction import BoundedSurface
from labapp.core.surface.surface import Surface

ARRAYS = {np.float64: "fiu", np.int64: "iu", np.bool_: "b"}


def check_fields(value: Any, shapes: Mapping[str, str]) -> None:
    """Check types and shapes of the fields of a dataclass instance.

    Parameters
    ----------
    shapes
        Shape of every array, such as ``"n 3"``; equal letters are equal lengths.

    Raises
    ------
    TypeError
        If one has another type or shape.
    """
    kind: Any = type(value)
    for name, hint in _hints(kind).items():
        if not is_a(getattr(value, name), hint):
            raise TypeError(f"{kind.__name__}.{name} is {_shown(getattr(value, name))}")
    lengths: dict[str, int] = {}
    for name, shape in shapes.items():
        array = getattr(value, name)
        letters = shape.split()
        fits = array.ndim == len(letters) and all(
            length == (int(letter) if letter.isdigit() else lengths.setdefault(letter, length))
            for letter, length in zip(letters, array.shape, strict=True)
        )
        if not fits:
            raise TypeError(f"{kind.__name__}.{name} has the shape {array.shape}")


def is_a(value: object, hint: Any) -> bool:
    """Whether a value conforms to a type hint; integers count as ``float``.

    An integer of more than 64 bits, which NumPy could not hold, conforms to none.
    """
    origin, parts = typing.get_origin(hint), typing.get_args(hint)
    if origin in (typing.Union, types.UnionType):
        return any(is_a(value, part) for part in parts)
    if origin is typing.Literal:
        return isinstance(value, str) and value in parts
    if origin in (np.ndarray, npt.NDArray):
        return _is_array(value, parts[-1])
    if origin in (tuple, list, frozenset):
        return isinstance(value, origin) and _holds(value, parts)
    if hint in (int, float):
        allowed = (int, float) if hint is float else int
        is_long = isinstance(value, int) and abs(value) >= 1 << 63
        return isinstance(value, allowed) and not (isinstance(value, bool) or is_long)
    if hint in (Any, Never):
        return hint is Any
    if hint is Surface:
        made = value.unbounded if isinstance(value, BoundedSurface) else value
        return hasattr(made, "height") and hasattr(made, "gradient")
    return value is None if hint is None else isinstance(value, hint)


def _holds(value: Collection[object], parts: tuple[Any, ...]) -> bool:
    if isinstance(value, tuple) and parts[-1] is not Ellipsis:
        return len(value) == len(parts) and all(map(is_a, value, parts))
    return all(is_a(item, parts[0]) for item in value)


def _is_array(value: object, of: Any) -> bool:
    # NDArray[T] is ndarray[..., dtype[T]]; under Python 3.12, NumPy 2.5 leaves it as it is.
    (scalar,) = typing.get_args(of) or (of,)
    return isinstance(value, np.ndarray) and (scalar is Any or value.dtype.kind in ARRAYS[scalar])


@functools.cache
def _hints(kind: Any) -> dict[str, Any]:
    hints = typing.get_type_hints(kind)
    return {field.name: hints[field.name] for field in dataclasses.fields(kind)}


def _shown(value: object) -> str:
    if isinstance(value, np.ndarray):
        return f"an array of {value.dtype}"
    return f"a {type(value).__name__}" if value is not None else "missing"
