"""Limits of a pool's sizes in a live measurement, and comparison of sizes with them."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np

from labapp.core.surface.measures import Measures
from labapp.core.values import BoolArray, FloatArray
from labapp.errors import InputError

CHANCE = 2.0
"""Number of σ (noise, level and set-up) by which a size may exceed a limit without an alarm."""

UNMEASURED = 3
"""Default number of consecutive unmeasured frames that raise an alarm."""

LARGEST_MM = 1000.0

Standing = Literal["", "unknown", "in order", "in doubt", "low", "high"]
"""A size relative to its limits: without limits; not measured; within them; beyond one, but not
significantly; significantly below the lower one; significantly above the upper one."""

NAMES = ("width", "length", "height")
"""Sizes with limits. For a concave pool, height means its depth, which is negative."""

Ends = tuple[float | None, float | None]


class Size(NamedTuple):
    """A size of a pool, mm.

    Parameters
    ----------
    name
        ``width``, ``length`` or ``height``; for a concave pool ``depth``.
    value_mm, sigma_mm
        Value and σ (noise, level and set-up); NaN if unknown.
    """

    name: str
    value_mm: float
    sigma_mm: float


@dataclass(frozen=True)
class Limits:
    """Lower and upper limits of a pool's sizes, mm; None: no limit.

    Raises
    ------
    InputError
        If a lower limit is not below the upper one, or one is out of range.
    """

    width_mm: Ends = (None, None)
    length_mm: Ends = (None, None)
    """Lower and upper limit."""
    height_mm: Ends = (None, None)
    """Lower and upper limit of the height, or of a concave pool's (negative) depth."""
    unmeasured: int = UNMEASURED
    """Number of consecutive unmeasured frames that raise an alarm."""

    def __post_init__(self) -> None:
        problems = []
        for name in NAMES:
            low, high = self.of(name)
            given = [end for end in (low, high) if end is not None]
            if not all(abs(end) <= LARGEST_MM for end in given):
                expected = f"-{LARGEST_MM:g} to {LARGEST_MM:g} (mm)"
                problems.append(InputError("limits", f"{name}_mm", given, expected))
            elif low is not None and high is not None and low >= high:
                expected = f"a minimum below the maximum, {high:g} mm"
                problems.append(InputError("limits", f"{name}_mm", f"{low:g} mm", expected))
        if self.unmeasured < 1:
            problems.append(InputError("limits", "unmeasured", self.unmeasured, "1 or more frames"))
        if problems:
            raise InputError.gather(problems)

    def of(self, name: str) -> Ends:
        """Return lower and upper limit of a size, mm; ``depth`` has those of ``height``."""
        ends: Ends = getattr(self, f"{'height' if name == 'depth' else name}_mm")
        return ends

    @property
    def are_set(self) -> bool:
        """Whether there is any limit."""
        return any(end is not None for name in NAMES for end in self.of(name))

    @property
    def words(self) -> str:
        """The limits as text: "width 6 to 6.9 mm, height from 0.2 mm"."""
        parts = []
        for name in NAMES:
            low, high = self.of(name)
            ends = [f"{'from ' * (high is None)}{low:g}"] if low is not None else []
            ends += [f"to {high:g}"] if high is not None else []
            parts += [f"{name} {' '.join(ends)} mm"] if ends else []
        return ", ".join(parts) or "none"


def sizes_of(measures: Measures | None) -> tuple[Size, Size, Size]:
    """Return width, length, and height or (if concave) depth; NaN if ``measures`` is None."""
    hollow = measures is not None and -measures.depth_mm > measures.height_mm
    width, length, height = (
        Size(name, *(getattr(measures, f"{name}{end}", math.nan) for end in ("_mm", "_sigma_mm")))
        for name in ("width", "length", "depth" if hollow else "height")
    )
    return width, length, height


def standing(size: Size, ends: Ends) -> Standing:
    """Compare a size with its limits; it is low or high if beyond by more than `CHANCE` σ.

    An unknown σ counts as 0.
    """
    low, high = ends
    if low is None and high is None:
        return ""
    if not math.isfinite(size.value_mm):
        return "unknown"
    below = 0.0 if low is None else low - size.value_mm
    above = 0.0 if high is None else size.value_mm - high
    beyond = max(below, above)
    if beyond <= 0:
        return "in order"
    chance = CHANCE * size.sigma_mm if math.isfinite(size.sigma_mm) else 0.0
    if beyond <= chance:
        return "in doubt"
    return "low" if below > above else "high"


def beyond(value_mm: FloatArray, sigma_mm: FloatArray, ends: Ends) -> BoolArray:
    """Return which of many sizes are ``low`` or ``high`` (`standing`), in their shape."""
    chance = CHANCE * np.where(np.isfinite(sigma_mm), sigma_mm, 0.0)
    low, high = (math.nan if end is None else end for end in ends)
    return np.asarray((low - value_mm > chance) | (value_mm - high > chance))
