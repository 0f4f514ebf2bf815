"""Whether a value that was read is what its class says: types, lengths and shapes."""

from __future__ import annotations

import dataclasses
import functools
import types
import typing
from collections.abc import Callable, Collection
from typing import Any, Never

import numpy as np
import numpy.typing as npt

from labapp.core.reconstruction import BoundedSurface
from labapp.core.surface import Surface

SHAPES: dict[str, dict[str, str]] = {
    "Boundary": {"center_mm": "2", "theta_deg": "m", "points_mm": "m 3"},
    "Dots": dict.fromkeys(
        ("u_px", "v_px", "u_sigma_px", "v_sigma_px", "size_px", "peak", "snr"), "n"
    ),
    "ImageCalibration": {"matrix": "3 3"},
    "ImagingPlane": {"origin_mm": "3", "x_axis": "3", "z_axis": "3"},
    "Lattice": {"row": "n", "column": "n"},
    "Match": {
        "dot": "n",
        "ray": "n 2",
        "reflected": "n 2",
        "plane_mm": "n 2",
        "plane_covariance_mm2": "n 2 2",
        "witness": "rows columns",
    },
    "Reconstruction": {
        "ray": "n 2",
        "points_mm": "n 3",
        "residual_mm": "n 2",
        "sigma_mm": "n",
        "size_sigma": "6",
    },
    "Signals": dict.fromkeys(("time_s", "current_a", "voltage_v"), "n"),
    "SplineBasis": {"x_knots": "x", "y_knots": "y"},
    "SplineSurface": {"coefficients": "n"},
}
"""Shape of every array of a class; equal letters are equal lengths."""


def _measurement_fits(value: Any) -> bool:
    count = 0 if value.dots is None else len(value.dots)
    return (value.lattice is None or len(value.lattice.row) == count) and (
        value.match is None or _all_within(value.match.dot, 0, count - 1)
    )


def _match_fits(value: Any) -> bool:
    return _all_within(value.ray[:, 0], 1, value.witness.shape[0]) and _all_within(
        value.ray[:, 1], 1, value.witness.shape[1]
    )


def _spline_fits(value: Any) -> bool:
    shape = value.basis.shape
    knots = (value.basis.x_knots, value.basis.y_knots)
    return (
        min(shape) > 0
        and len(value.coefficients) == shape[0] * shape[1]
        and all(np.isfinite(each).all() and (np.diff(each) > 0).all() for each in knots)
    )


def _all_within(numbers: Any, least: int, most: int) -> bool:
    return bool(((numbers >= least) & (numbers <= most)).all())


FITS: dict[str, Callable[[Any], bool]] = {
    "Match": _match_fits,
    "Measurement": _measurement_fits,
    "SplineSurface": _spline_fits,
}
"""What the fields of a class must be together."""

ARRAYS = {np.float64: "fiu", np.int64: "iu", np.bool_: "b"}


def check_fields(value: Any) -> None:
    """Hold the fields of a dataclass instance to what the class says of them.

    Raises
    ------
    TypeError
        If one is of another type or shape.
    """
    kind: Any = type(value)
    for name, hint in _hints(kind).items():
        if not is_a(getattr(value, name), hint):
            raise TypeError(f"{kind.__name__}.{name} is {_shown(getattr(value, name))}")
    lengths: dict[str, int] = {}
    for name, shape in SHAPES.get(kind.__name__, {}).items():
        array = getattr(value, name)
        letters = shape.split()
        fits = array.ndim == len(letters) and all(
            length == (int(letter) if letter.isdigit() else lengths.setdefault(letter, length))
            for letter, length in zip(letters, array.shape, strict=True)
        )
        if not fits:
            raise TypeError(f"{kind.__name__}.{name} has the shape {array.shape}")
    if kind.__name__ in FITS and not FITS[kind.__name__](value):
        raise TypeError(f"the fields of {kind.__name__} do not fit each other")


def is_a(value: object, hint: Any) -> bool:
    """Whether a value is what a type hint says; whole numbers count as ``float``."""
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
        return isinstance(value, allowed) and not isinstance(value, bool)
    if hint in (Any, Never):
        return hint is Any
    if hint is Surface:
        made = value.whole if isinstance(value, BoundedSurface) else value
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
