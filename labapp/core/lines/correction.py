"""Manual correction of the lines of a frame: cut, join, number, delete.

Each edit returns a new correction. An invalid edit raises `ValueError` with a message that says
what is valid. A frame is measured from the corrected lines instead of those detected.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from labapp.core.lines.detection.find_lines import LightLine
from labapp.core.lines.detection.numbering import LinesSeen, heights
from labapp.core.values import FloatArray, IntArray, ReadOnlyArrays

LEAST_POINTS = 8
"""Least number of points of a piece of a line."""

GAP_PX = 1.5
"""Neighbouring points of a line that are farther apart are separated by a gap, px."""


@dataclass(frozen=True)
class LineCorrection(ReadOnlyArrays):
    """The lines of a frame as corrected by the operator; k lines.

    Parameters
    ----------
    seen
        The lines, from the lowest in the picture up.
    number
        Number of each in the pattern if given by hand, otherwise 0, shape (k,). Pieces of one line
        have the same number.
    """

    seen: LinesSeen
    number: IntArray

    @classmethod
    def of(cls, seen: LinesSeen) -> LineCorrection:
        """Start from the detected lines."""
        return cls(seen, np.zeros(len(seen.lines), np.int64))


def nearest_line(lines: Sequence[LightLine], u_px: float, v_px: float) -> tuple[int, int, float]:
    """Indices of the line and of its point nearest to a position, and their distance, px.

    ``lines`` must not be empty.
    """
    away = [np.linalg.norm(one.image_px - (u_px, v_px), axis=-1) for one in lines]
    line = int(np.argmin([each.min() for each in away]))
    return line, int(np.argmin(away[line])), float(away[line].min())


def cut_line(correction: LineCorrection, line: int, point: int) -> LineCorrection:
    """Cut a line in two at one of its points; the new ends are not on the pool's boundary."""
    one = correction.seen.lines[line]
    if min(point, len(one.image_px) - point) < LEAST_POINTS:
        raise ValueError("that is too near to the line's end to cut it there")
    place = one.image_px[point]
    left = _part(one, slice(None, point), (one.ends_px[0], place), (one.cut[0], True))
    right = _part(one, slice(point, None), (place, one.ends_px[1]), (True, one.cut[1]))
    number = int(correction.number[line])
    return _with(correction, [line], [(left, number), (right, number)])


def join_lines(correction: LineCorrection, first: int, second: int) -> LineCorrection:
    """Join two lines at their nearest ends."""
    if first == second:
        raise ValueError("choose the two pieces of the line")
    numbers = {int(correction.number[k]) for k in (first, second)} - {0}
    if len(numbers) > 1:
        raise ValueError("the two have different numbers: take those away first")
    one, other = (correction.seen.lines[k] for k in (first, second))
    ends = [(e, f) for e in (0, 1) for f in (0, 1)]
    away = [float(np.linalg.norm(one.ends_px[e] - other.ends_px[f])) for e, f in ends]
    end, begin = ends[int(np.argmin(away))]
    one = one if end == 1 else _reversed(one)
    other = other if begin == 0 else _reversed(other)
    joined = _joined(one, other)
    if joined.ends_px[0, 0] > joined.ends_px[1, 0]:
        joined = _reversed(joined)
    return _with(correction, [first, second], [(joined, max(numbers, default=0))])


def number_line(correction: LineCorrection, line: int, number: int, count: int) -> LineCorrection:
    """Set the number of a line in a pattern of ``count`` lines; 0: determine it automatically."""
    if not 0 <= number <= count:
        raise ValueError(f"the pattern's lines are 1 to {count}, growing towards the head")
    numbers = correction.number.copy()
    numbers[line] = number
    return replace(correction, number=numbers)


def delete_line(correction: LineCorrection, line: int) -> LineCorrection:
    """Delete a line that is not part of the pattern."""
    seen = correction.seen
    outermost = line == 0, line == len(seen.lines) - 1
    changed = _with(correction, [line], [])
    # Whether a fringe lies beside the next line is now unknown.
    below, above = (
        fringe and not gone
        for fringe, gone in zip((seen.fringe_below, seen.fringe_above), outermost, strict=True)
    )
    seen = replace(changed.seen, fringe_below=below, fringe_above=above)
    return replace(changed, seen=replace(seen, left_out=seen.left_out + 1))


def _with(
    correction: LineCorrection, without: list[int], more: list[tuple[LightLine, int]]
) -> LineCorrection:
    """Replace some lines of a correction by others, from the lowest up."""
    kept = [
        (one, int(number))
        for k, (one, number) in enumerate(
            zip(correction.seen.lines, correction.number, strict=True)
        )
        if k not in without
    ]
    every = kept + more
    if every:
        order = np.argsort(heights([one for one, _ in every]), kind="stable")
        every = [every[k] for k in order]
    lines = tuple(one for one, _ in every)
    number = np.array([number for _, number in every], np.int64)
    return LineCorrection(replace(correction.seen, lines=lines), number)


def _part(
    line: LightLine,
    points: slice,
    ends_px: tuple[FloatArray, FloatArray],
    cut: tuple[bool, bool],
) -> LightLine:
    return replace(
        line,
        image_px=line.image_px[points],
        tangent=line.tangent[points],
        sigma_px=line.sigma_px[points],
        curvature=line.curvature[points],
        ends_px=np.array(ends_px),
        cut=np.array(cut, bool),
        gap_px=_longest_gap(line.image_px[points]),
    )


def _reversed(line: LightLine) -> LightLine:
    """Return a line with its direction reversed."""
    return replace(
        line,
        image_px=line.image_px[::-1],
        tangent=-line.tangent[::-1],
        sigma_px=line.sigma_px[::-1],
        curvature=-line.curvature[::-1],
        ends_px=line.ends_px[::-1],
        cut=line.cut[::-1],
    )


def _joined(one: LightLine, other: LightLine) -> LightLine:
    """Concatenate two lines."""
    image_px = np.concatenate([one.image_px, other.image_px])
    share = len(one.image_px) / len(image_px)

    def mean(name: str) -> float:
        return float(share * getattr(one, name) + (1 - share) * getattr(other, name))

    return LightLine(
        image_px=image_px,
        tangent=np.concatenate([one.tangent, other.tangent]),
        sigma_px=np.concatenate([one.sigma_px, other.sigma_px]),
        curvature=np.concatenate([one.curvature, other.curvature]),
        ends_px=np.array([one.ends_px[0], other.ends_px[1]]),
        cut=np.array([one.cut[0], other.cut[1]]),
        width_px=mean("width_px"),
        light=mean("light"),
        gap_px=_longest_gap(image_px),
        smoothed_px=mean("smoothed_px"),
    )


def _longest_gap(image_px: FloatArray) -> float:
    longest = float(np.linalg.norm(np.diff(image_px, axis=0), axis=-1).max(initial=0.0))
    return longest - 1 if longest > GAP_PX else 0.0
