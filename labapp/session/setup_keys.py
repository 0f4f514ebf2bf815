"""The keys of a setup file: which there are, and what each may hold."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeGuard

import numpy as np

LARGEST_MM = 10_000.0
"""Lengths above this are a slip of the unit, not of a bench."""

LARGEST = 1e9
"""Numbers of any kind above this are no measurement."""


@dataclass(frozen=True)
class Rule:
    """What a key may hold.

    Parameters
    ----------
    expected
        That in words, completing "expected …".
    accepts
        Whether a value as TOML gives it is right.
    required
        Whether the key must be there.
    """

    expected: str
    accepts: Callable[[object], bool]
    required: bool = True


def is_number(value: object) -> TypeGuard[float]:
    """Whether this is a finite number (true, false, nan and inf are not)."""
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) < LARGEST


def _between(low: float, high: float, unit: str, required: bool = True) -> Rule:
    return Rule(
        f"a number above {low:g} and below {high:g} ({unit})",
        lambda value: is_number(value) and low < value < high,
        required,
    )


_LENGTH = _between(0, LARGEST_MM, "mm")
_PLACE = _between(-LARGEST_MM, LARGEST_MM, "mm")
_COUNT = Rule(
    "an odd whole number from 3 to 99, so that there is a centre",
    lambda value: type(value) is int and 3 <= value <= 99 and value % 2 == 1,
)
_TILT = _between(-90, 90, "degrees", required=False)


def _is_pixel(value: object) -> bool:
    return isinstance(value, list) and len(value) == 2 and all(map(is_number, value))


def _is_rays(value: object) -> bool:
    return isinstance(value, list) and all(
        isinstance(ray, list) and len(ray) == 2 and all(type(index) is int for index in ray)
        for ray in value
    )


def _is_matrix(value: object) -> bool:
    return (
        isinstance(value, list)
        and len(value) == 3
        and all(
            isinstance(row, list) and len(row) == 3 and all(map(is_number, row)) for row in value
        )
        and bool(np.linalg.cond(np.array(value, float)) < 1e12)
    )


_PIXEL = Rule("[u, v], two numbers (px)", _is_pixel)
_ON_AXIS = Rule(
    f"a number from -{LARGEST_MM:g} to {LARGEST_MM:g} (mm) that is not 0",
    lambda value: is_number(value) and 0 < abs(value) <= LARGEST_MM,
)

THREE_POINTS = {
    "origin_px": _PIXEL,
    "x_axis_px": _PIXEL,
    "x_axis_mm": _ON_AXIS,
    "z_axis_px": _PIXEL,
    "z_axis_mm": _ON_AXIS,
}
HOMOGRAPHY = {
    "homography": Rule("3 rows of 3 numbers (px to mm) that can be inverted", _is_matrix),
}
SECTIONS = {
    "laser": {
        "projection_angle_deg": _between(0, 90, "degrees"),
        "distance_mm": _LENGTH,
    },
    "pattern": {
        "rows": _COUNT,
        "columns": _COUNT,
        "inter_beam_angle_deg": _between(0, 45, "degrees"),
        "absent": Rule(
            "a list of rays [row, column] within the pattern, counted from 1",
            _is_rays,
            required=False,
        ),
    },
    "electrode": {
        "height_mm": Rule(
            f"a number from 0 to {LARGEST_MM:g} (mm)",
            lambda value: is_number(value) and 0 <= value <= LARGEST_MM,
        ),
    },
    "imaging_plane": {
        "distance_mm": _LENGTH,
        "s_mm": _PLACE,
        "h_mm": _PLACE,
        "width_mm": _LENGTH,
        "height_mm": _LENGTH,
        "pitch_deg": _TILT,
        "yaw_deg": _TILT,
    },
    "image_calibration": {**THREE_POINTS, **HOMOGRAPHY},
}
"""Every section and key; `image_calibration` holds the keys of one of its two forms."""


def rules_for(section: str, keys: object) -> dict[str, Rule]:
    """Rules of a section, given the keys it holds: a homography replaces the three points."""
    if section != "image_calibration":
        return SECTIONS[section]
    return HOMOGRAPHY if isinstance(keys, dict) and "homography" in keys else THREE_POINTS
