"""Which of a frame's lines the pattern made, from the lowest up; the others are fringes (Fig. 3-9).

All light of a line over its length changes little from line to line, however the pool spreads them:
a diffraction fringe has a fraction of it. What is seen of the pattern is a run of neighbours, as a
pool that shrinks loses outer lines first (Fig. 3-14).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from labapp.core.lines.chains import is_upright
from labapp.core.lines.find_lines import LightLine
from labapp.core.values import FloatArray

FRINGE_LIGHT, FRINGE_TOTAL = 0.45, 0.4
"""A fringe is fainter than this share of its neighbour further in: per length, and in all."""

FAINTEST_TOTAL = 0.02
"""What has less light in all than this share of the brightest line is no line."""

LEG_PX, PART_WIDTHS = 30.0, 2.5
"""Longest leg of a line that is nearly folded, px; longer ones are upright. Short parts that are
nearer than so many of their widths are of one such line."""

LEAST_TOTAL = 0.06
"""What has less light in all than this share of its neighbour further in is not of the pattern."""

NEAREST, FARTHEST = 0.3, 2.5
"""A fringe is so many times as far from the line beside it as that from the next one."""


@dataclass(frozen=True)
class LinesSeen:
    """The pattern's lines in a frame.

    Parameters
    ----------
    lines
        From the lowest in the picture up.
    fringe_below, fringe_above
        Whether a diffraction fringe is seen beside the lowest, the highest: there, no line of the
        pattern is missing.
    left_out
        How many bright lines are not the pattern's: fringes, scratches, reflections.
    """

    lines: tuple[LightLine, ...]
    fringe_below: bool
    fringe_above: bool
    left_out: int

    def first_numbers(self, count: int, same_order: bool) -> range:
        """Numbers that the lowest line can have, of a pattern of ``count`` lines.

        With ``same_order`` numbers grow upwards, as a flat or convex pool reflects them, and
        otherwise downwards; the fringes settle them where they are seen.
        """
        missing = count - len(self.lines)
        low = 0 if self.fringe_below or not self.fringe_above else missing
        high = 0 if self.fringe_below else missing
        if same_order:
            return range(1 + low, 2 + high)
        return range(count - high, count - low + 1)


def number_lines(lines: tuple[LightLine, ...], count: int) -> LinesSeen:
    """Take the pattern's lines, ``count`` at most, out of all that a frame shows."""
    if not lines:
        return LinesSeen((), False, False, 0)
    total = np.array([one.light * one.length_px for one in lines])
    bright = [lines[k] for k in np.argsort(total)[::-1] if total[k] > FAINTEST_TOTAL * total.max()]
    kept: list[LightLine] = []
    for one in bright:
        if not any(_are_legs(one, other) for other in kept):
            kept.append(one)
    ordered = _from_below(kept)
    total = np.array([one.light * one.length_px for one in ordered])
    light = np.array([one.light for one in ordered])
    brightest = int(np.argmax(total))
    real = _pattern_lines(light, total, brightest)
    height = heights(ordered)
    if len(real) > count:
        runs = np.convolve(total[real], np.ones(count), "valid")
        start = int(np.argmax(runs))
        real = real[start : start + count]
    return LinesSeen(
        tuple(ordered[k] for k in real),
        _is_fringe(height, real, -1),
        _is_fringe(height, real, 1),
        len(lines) - len(real),
    )


def _are_legs(one: LightLine, other: LightLine) -> bool:
    """Whether two lines are parts of one that is nearly folded: its legs, or what is at its top."""
    if not all(each.length_px < LEG_PX or is_upright(each.image_px) for each in (one, other)):
        return False
    (low, high), (bottom, top) = (
        (float(v.min()), float(v.max())) for v in (one.image_px[:, 1], other.image_px[:, 1])
    )
    shared = min(high, top) - max(low, bottom)
    away = np.linalg.norm(one.image_px[:, None] - other.image_px, axis=-1).min()
    near = away < PART_WIDTHS * max(one.width_px, other.width_px)
    return bool(shared > min(high - low, top - bottom) / 2 or near)


def heights(lines: Sequence[LightLine]) -> FloatArray:
    """−v of each line where it is nearest to the column that most of them cross, px."""
    middle = np.median([np.mean(one.ends_px[:, 0]) for one in lines])
    nearest = [int(np.argmin(np.abs(one.image_px[:, 0] - middle))) for one in lines]
    return np.array([-one.image_px[k, 1] for one, k in zip(lines, nearest, strict=True)])


def _from_below(lines: list[LightLine]) -> list[LightLine]:
    return [lines[k] for k in np.argsort(heights(lines))]


def _pattern_lines(light: FloatArray, total: FloatArray, brightest: int) -> list[int]:
    """Which lines are as bright as the next of the pattern's nearer to the brightest one."""
    real = [brightest]
    for way in (range(brightest - 1, -1, -1), range(brightest + 1, len(light))):
        inner = brightest
        for k in way:
            alike = light[k] > FRINGE_LIGHT * light[inner]
            if total[k] > (LEAST_TOTAL if alike else FRINGE_TOTAL) * total[inner]:
                real.append(k)
                inner = k
    return sorted(real)


def _is_fringe(height: FloatArray, real: list[int], side: int) -> bool:
    """Whether what is beside the outermost line has a fringe's distance from it."""
    outer, inner = (real[0], real[1:2]) if side < 0 else (real[-1], real[-2:-1])
    beside = outer + side
    if not 0 <= beside < len(height):
        return False
    if not inner:
        return True
    spacing = abs(height[outer] - height[inner[0]])
    return bool(NEAREST * spacing < abs(height[beside] - height[outer]) < FARTHEST * spacing)
