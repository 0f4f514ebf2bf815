"""Selection of the pattern's lines in a frame, excluding diffraction fringes (Fig. 3-9).

The total light of a line varies little from line to line, however the pool spreads it. A
diffraction fringe has a fraction of it. The visible lines are consecutive, as a shrinking pool
loses the outer lines first (Fig. 3-14).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from labapp.core.lines.detection.chains import is_upright
from labapp.core.lines.detection.find_lines import LightLine
from labapp.core.values import FloatArray, IntArray

FRINGE_LIGHT, FRINGE_TOTAL = 0.45, 0.4
"""A fringe is fainter than this share of its inner neighbour: per length, and in total."""

FAINTEST_TOTAL = 0.02
"""A line with less than this share of the brightest line's total light is ignored."""

LEG_PX, PART_WIDTHS = 30.0, 2.5
"""Longest leg of a nearly folded line, px; longer legs are upright. Short parts within this many
widths of each other belong to one such line."""

LEAST_TOTAL = 0.06
"""A line of the pattern has at least this share of its inner neighbour's total light."""

NEAREST, FARTHEST, FRINGE_LENGTH = 0.3, 1.6, 0.5
"""Range of a fringe's distance from the adjacent line, in units of the line spacing, and its least
length, as a share of that line's. Beyond a line that is missing, the fringe is twice as far; pieces
of a line that is not found as a whole are shorter."""

WIDE = 1.6
"""A line may be missing between neighbours that are farther apart than this multiple of what the
distances beside theirs, on a straight line, predict."""


@dataclass(frozen=True)
class LinesSeen:
    """The pattern's lines in a frame.

    Parameters
    ----------
    lines
        The lines, from the lowest in the picture up.
    fringe_below, fringe_above
        Whether a diffraction fringe is seen beside the lowest or the highest line: no line of the
        pattern is missing on that side.
    left_out
        Number of bright lines that do not belong to the pattern: fringes, scratches, reflections.
    """

    lines: tuple[LightLine, ...]
    fringe_below: bool
    fringe_above: bool
    left_out: int

    def steps(self, count: int) -> list[IntArray]:
        """Possible distances of the lines from the lowest in a pattern of ``count``, each (k,).

        They are 0, 1, … unless a line may be missing where two are far apart.
        """
        steps = np.arange(len(self.lines))
        if not 3 < len(steps) < count:
            return [steps]
        apart = np.diff(heights(self.lines))
        wide = [k for k in range(len(apart)) if apart[k] > WIDE * _predicted(apart, k)]
        return [steps, *(steps + (steps > k) for k in wide)]

    def first_numbers(self, count: int, span: int, same_order: bool) -> range:
        """Possible numbers of the lowest line in a pattern of ``count`` lines.

        ``span`` of them are from the lowest to the highest line. With ``same_order`` numbers
        increase upwards, as for a flat or convex pool, otherwise downwards. A fringe on one side
        determines the number; on both sides of too few lines, one of them is no fringe.
        """
        missing = count - span
        low = missing if self.fringe_above and not self.fringe_below else 0
        high = 0 if self.fringe_below and not self.fringe_above else missing
        if same_order:
            return range(1 + low, 2 + high)
        return range(count - high, count - low + 1)


def _predicted(apart: FloatArray, k: int) -> float:
    """Distance of line k from the next as predicted from the nearest others, at most three, px."""
    others = sorted(set(range(len(apart))) - {k}, key=lambda j: abs(j - k))[:3]
    straight = np.polyfit(others, apart[others], min(1, len(others) - 1))
    return float(max(np.polyval(straight, k), apart[others].min()))


def number_lines(lines: tuple[LightLine, ...], count: int) -> LinesSeen:
    """Select the pattern's lines, at most ``count``, from all lines of a frame."""
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
        _is_fringe(ordered, height, real, -1),
        _is_fringe(ordered, height, real, 1),
        len(lines) - len(real),
    )


def _are_legs(one: LightLine, other: LightLine) -> bool:
    """Whether two lines are parts of one nearly folded line: its legs, or a leg and its top."""
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
    """−v of each line where it is nearest to the median column of the lines' ends, px."""
    middle = np.median([np.mean(one.ends_px[:, 0]) for one in lines])
    nearest = [int(np.argmin(np.abs(one.image_px[:, 0] - middle))) for one in lines]
    return np.array([-one.image_px[k, 1] for one, k in zip(lines, nearest, strict=True)])


def _from_below(lines: list[LightLine]) -> list[LightLine]:
    return [lines[k] for k in np.argsort(heights(lines))]


def _pattern_lines(light: FloatArray, total: FloatArray, brightest: int) -> list[int]:
    """Indices of lines about as bright as their inner neighbour, outwards from the brightest."""
    real = [brightest]
    for way in (range(brightest - 1, -1, -1), range(brightest + 1, len(light))):
        inner = brightest
        for k in way:
            alike = light[k] > FRINGE_LIGHT * light[inner]
            if total[k] > (LEAST_TOTAL if alike else FRINGE_TOTAL) * total[inner]:
                real.append(k)
                inner = k
    return sorted(real)


def _is_fringe(lines: list[LightLine], height: FloatArray, real: list[int], side: int) -> bool:
    """Whether the neighbour of the outermost line has a fringe's distance from it and length."""
    outer, inner = (real[0], real[1:2]) if side < 0 else (real[-1], real[-2:-1])
    beside = outer + side
    if not 0 <= beside < len(height):
        return False
    if lines[beside].length_px < FRINGE_LENGTH * lines[outer].length_px:
        return False
    if not inner:
        return True
    spacing = abs(height[outer] - height[inner[0]])
    return bool(NEAREST * spacing < abs(height[beside] - height[outer]) < FARTHEST * spacing)
