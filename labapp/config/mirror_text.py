"""Mirrors of a bench check as text: ``plate:0``, ``cap:9.75:0.91``, ``ball:10:1.2+-0.02``."""

from __future__ import annotations

import math
from collections.abc import Callable

from labapp.core.bench_check.mirrors import FREE_MM, Ball, Cap, Mirror, Plate
from labapp.errors import InputError

FORMS = (
    "plate:HEIGHT or plate:HEIGHT:LEVEL (mm, degrees), cap:DIAMETER:HEIGHT, ball:DIAMETER or "
    "ball:DIAMETER:TOP (mm)"
)
"""Forms of the text of a mirror."""

_LARGEST_MM = 1000.0
_LARGEST_TILT_DEG = 10.0
_SIZES = ("height_mm", "diameter_mm")


def parse_mirror(text: str) -> Mirror:
    """Parse the text of a mirror.

    Each size may be followed by its standard uncertainty after ``+-`` or ``±``. The height of a
    plate may be ``free``; its level is itself a standard uncertainty.

    Raises
    ------
    InputError
        If the text has none of the `FORMS`, or an impossible size.
    """
    kind, *numbers = text.strip().split(":")
    makers: dict[tuple[str, int], Callable[..., Mirror]] = {
        ("plate", 1): _plate,
        ("plate", 2): _plate,
        ("cap", 2): _cap,
        ("ball", 1): _ball,
        ("ball", 2): _ball,
    }
    maker = makers.get((kind, len(numbers)))
    try:
        if maker is None:
            raise ValueError
        return maker(*(_number(one) for one in numbers))
    except ValueError:
        raise InputError("--mirror", "mirror", text, f"one of {FORMS}") from None


def mirror_text(mirror: Mirror) -> str:
    """Write a mirror with the standard uncertainties of its sizes: inverse of `parse_mirror`."""
    known = dict(zip(mirror.parameters, zip(mirror.pose, mirror.sigma, strict=True), strict=True))
    sizes = [
        f"{value:.9g}+-{sigma:.9g}" for name, (value, sigma) in known.items() if name in _SIZES
    ]
    if isinstance(mirror, Plate) and mirror.tilt_sigma_deg != Plate.tilt_sigma_deg:
        sizes.insert(0, f"{mirror.tilt_sigma_deg:.9g}")
    return ":".join([type(mirror).__name__.lower(), *reversed(sizes)])


def _number(text: str) -> tuple[float, float | None]:
    """A number and its ±, which is None if missing."""
    if text == "free":
        return 0.0, FREE_MM
    value, _, sigma = text.replace("±", "+-").partition("+-")
    made = float(value), float(sigma) if sigma else None
    if not all(abs(one) <= _LARGEST_MM and math.isfinite(one) for one in made if one is not None):
        raise ValueError
    if made[1] is not None and made[1] <= 0:
        raise ValueError
    return made


def _plate(
    height: tuple[float, float | None],
    level: tuple[float, float | None] = (Plate.tilt_sigma_deg, None),
) -> Plate:
    if not 0 < level[0] <= _LARGEST_TILT_DEG or level[1] is not None:
        raise ValueError
    value, sigma = height
    return Plate(value, Plate.height_sigma_mm if sigma is None else sigma, level[0])


def _cap(diameter: tuple[float, float | None], height: tuple[float, float | None]) -> Cap:
    if not 0 < height[0] <= diameter[0] / 2:
        raise ValueError
    return Cap(
        diameter[0],
        height[0],
        diameter[1] or Cap.diameter_sigma_mm,
        height[1] or Cap.height_sigma_mm,
    )


def _ball(
    diameter: tuple[float, float | None], top: tuple[float, float | None] | None = None
) -> Ball:
    height, sigma = top or (diameter[0], None)
    if not 0 < height <= 2 * diameter[0]:
        raise ValueError
    return Ball(
        diameter[0], height, diameter[1] or Ball.diameter_sigma_mm, sigma or Ball.height_sigma_mm
    )
