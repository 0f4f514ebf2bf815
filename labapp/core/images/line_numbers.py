"""Which of a frame's lines the pattern made, from the lowest up; the others are fringes (Fig. 3-9).

All light of a line over its length changes little from line to line, however the pool spreads them:
a diffraction fringe has a fraction of it. What is seen of the pattern is a run of neighbours, as a
pool that shrinks loses outer lines first (Fig. 3-14).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from labapp.core.images.light_lines import LightLine
from labapp.core.values import FloatArray

FRINGE_LIGHT, FRINGE_TOTAL = 0.45, 0.35
"""A fringe is fainter than this share of its neighbour further in: per length, and in all."""

FAINTEST_TOTAL = 0.02
"""What has less light in all than this share of the brightest line is no line."""

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
    kept = [lines[k] for k in np.flatnonzero(total > FAINTEST_TOTAL * total.max())]
    ordered = _from_below(kept)
    total = np.array([one.light * one.length_px for one in ordered])
    light = np.array([one.light for one in ordered])
    brightest = int(np.argmax(total))
    first = _outermost(light[brightest::-1], total[brightest::-1])
    last = _outermost(light[brightest:], total[brightest:])
    first, last = brightest - first, brightest + last
    if last - first + 1 > count:
        runs = np.convolve(total[first : last + 1], np.ones(count), "valid")
        first += int(np.argmax(runs))
        last = first + count - 1
    heights = _heights(ordered)
    return LinesSeen(
        tuple(ordered[first : last + 1]),
        _is_fringe(heights, first, -1),
        _is_fringe(heights, last, 1),
        len(lines) - (last - first + 1),
    )


def _heights(lines: list[LightLine]) -> FloatArray:
    """−v of each line where it is nearest to the column that most of them cross, px."""
    middle = np.median([np.mean(one.ends_px[:, 0]) for one in lines])
    nearest = [int(np.argmin(np.abs(one.image_px[:, 0] - middle))) for one in lines]
    return np.array([-one.image_px[k, 1] for one, k in zip(lines, nearest, strict=True)])


def _from_below(lines: list[LightLine]) -> list[LightLine]:
    return [lines[k] for k in np.argsort(_heights(lines))]


def _outermost(light: FloatArray, total: FloatArray) -> int:
    """How far out from the brightest line, entry 0, the pattern's lines go on."""
    for k in range(1, len(light)):
        if light[k] < FRINGE_LIGHT * light[k - 1] and total[k] < FRINGE_TOTAL * total[k - 1]:
            return k - 1
    return len(light) - 1


def _is_fringe(heights: FloatArray, outer: int, step: int) -> bool:
    """Whether what is beside the outermost line has a fringe's distance from it."""
    beside, inner = outer + step, outer - step
    if not 0 <= beside < len(heights):
        return False
    if not 0 <= inner < len(heights):
        return True
    spacing = abs(heights[outer] - heights[inner])
    return bool(NEAREST * spacing < abs(heights[beside] - heights[outer]) < FARTHEST * spacing)
