"""Apply a correction to the next frame, by tracking its dots.

From frame to frame the dots of a pool move together, with small differences as the pool changes.
A smooth motion is estimated, and each dot is matched near its predicted position; distances are in
units of the local steps along rows and columns. Since adjacent rows look alike, the motion must
also match more dots than motions that differ from it by one row or column.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from labapp.core.images.dots import Dots
from labapp.core.rows.correction import Correction, set_reference
from labapp.core.rows.lattice import Lattice
from labapp.core.values import BoolArray, FloatArray, IntArray

LOST = -1

Motion = Callable[[FloatArray], FloatArray]
"""Maps positions in one frame, shape (n, 2), to positions in the next, px."""

LEAST_FOUND = 0.85
"""Least share of the dots with a row that must be matched. Manual dots that are not matched are not
counted, since the detector may not find them."""

GATE, CLEAR = 0.3, 0.5
"""A dot is matched within the first distance from its predicted position if no other lies within
the second, in steps."""

REACH = 0.5
"""Largest common motion of the dots, in steps."""

AHEAD = 0.04
"""Motions that differ by a row or a column must match fewer dots, by this share of all."""


def carry_on(correction: Correction, dots: Dots) -> Correction | None:
    """Apply the rows of a correction to the dots of the next frame.

    Parameters
    ----------
    correction
        Correction of the previous frame. With the rows of its measurement (`Measurement.lattice`),
        new dots are tracked too.
    dots
        The dots found in the next frame.

    Returns
    -------
    Correction or None
        Correction of the next frame. Matched dots have the row, column and manual flag of the
        previous frame's dot, other dots have none; reference and blocked rows are unchanged. None
        if the correction no longer fits: too few dots are matched, a dot is at the reference, or
        a motion by one more row or column is about as likely.
    """
    lattice = correction.lattice
    steps = _steps(correction)
    if steps is None or len(dots) == 0:
        return None
    before, after = correction.dots.image_px, dots.image_px
    motion = _likeliest_motion(before, after, steps, correction.sited)
    if motion is None:
        return None
    found = _found(motion(before), after, steps)
    numbered = (lattice.row > 0) | (lattice.column > 0)
    wanted = numbered & ~(correction.manual & (found == LOST))
    if np.sum(found[wanted] != LOST) < LEAST_FOUND * wanted.sum():
        return None
    if _reference_lit(correction, motion, after):
        return None
    row, column, manual = (np.zeros(len(dots), kind) for kind in (np.int64, np.int64, bool))
    old = np.flatnonzero(found != LOST)
    row[found[old]], column[found[old]] = lattice.row[old], lattice.column[old]
    manual[found[old]] = correction.manual[old]
    moved = Lattice(row, column, lattice.reference, (), lattice.blocked_rows)
    return set_reference(Correction(dots, moved, manual), lattice.reference)


def _steps(correction: Correction) -> FloatArray | None:
    """Local steps along and across rows at each dot, shape (n, 2, 2), px; None without rows.

    ``steps[n, :, 0]`` is the step to the next column, ``steps[n, :, 1]`` that to the next row.
    """
    lattice, place = correction.lattice, correction.dots.image_px
    sited = np.flatnonzero(correction.sited)
    dot_at = {(int(lattice.row[n]), int(lattice.column[n])): int(n) for n in sited}
    steps = np.full((len(place), 2, 2), np.nan)
    for (k, t), n in dot_at.items():
        for axis, (dk, dt) in enumerate(((0, 1), (1, 0))):
            ahead, behind = dot_at.get((k + dk, t + dt)), dot_at.get((k - dk, t - dt))
            ways = [place[ahead] - place[n]] if ahead is not None else []
            ways += [place[n] - place[behind]] if behind is not None else []
            if ways:
                steps[n, :, axis] = np.mean(ways, axis=0)
    for axis in range(2):
        known = np.isfinite(steps[:, 0, axis])
        if not known.any():
            return None
        steps[~known, :, axis] = np.median(steps[known, :, axis], axis=0)
    median_step = np.median(steps, axis=0)
    size = np.linalg.norm(steps, axis=1)
    steps[np.abs(np.linalg.det(steps)) < 0.2 * size[:, 0] * size[:, 1]] = median_step
    return steps if np.abs(np.linalg.det(steps)).min() > 0 else None


def _likeliest_motion(
    before: FloatArray, after: FloatArray, steps: FloatArray, sited: BoolArray
) -> Motion | None:
    """The motion that matches most dots; None if one shifted by a row or column is as good."""
    median_step = np.median(steps[sited], axis=0)
    share = np.linspace(-REACH, REACH, 7)
    near = [median_step @ np.array([t, k]) for k in share for t in share]
    first = max(near, key=lambda shift: _count(before + shift, after, steps, sited))
    motion = _refined_motion(before, after, steps, first)
    found = _found(motion(before), after, steps)
    count = int(np.sum(found[sited] != LOST))
    for cell in np.array([(1, 0), (-1, 0), (0, 1), (0, -1), (1, 1), (-1, -1), (1, -1), (-1, 1)]):
        # The shift by a row or column differs from dot to dot.
        start = motion(before) + steps @ cell
        further = _refined_motion(before, after, steps, start - before)
        other = _found(further(before), after, steps)
        if np.mean(other[sited] == found[sited]) > 0.5:
            continue
        if np.sum(other[sited] != LOST) > count - AHEAD * sited.sum():
            return None
    return motion


def _refined_motion(
    before: FloatArray, after: FloatArray, steps: FloatArray, shift: FloatArray
) -> Motion:
    """Refine a motion from a shift, shape (2,) or (n, 2), by polynomials fitted to matched dots."""
    center, scale = before.mean(axis=0), max(float(np.ptp(before)), 1.0)

    def terms(place: FloatArray, degree: int) -> FloatArray:
        x, y = ((place - center) / scale).T
        return np.stack([x**a * y**b for a in range(3) for b in range(3) if a + b <= degree], -1)

    moved, degree = before + shift, 0
    weights = np.linalg.lstsq(terms(before, 0), moved - before, rcond=None)[0]
    for degree in (1, 1, 1, 2, 2, 2, 2):
        found = _found(moved, after, steps)
        matched = np.flatnonzero(found != LOST)
        if len(matched) < 12:
            break
        way = after[found[matched]] - before[matched]
        weights = np.linalg.lstsq(terms(before[matched], degree), way, rcond=None)[0]
        moved = before + terms(before, degree) @ weights
    last = next(d for d in range(3) if len(weights) == (d + 1) * (d + 2) // 2)
    return lambda place: place + terms(place, last) @ weights


def _found(moved: FloatArray, after: FloatArray, steps: FloatArray) -> IntArray:
    """Match predicted positions to dots one to one, shape (n,); `LOST` where there is no match."""
    away = np.linalg.norm(
        np.einsum("nab,nmb->nma", np.linalg.inv(steps), after - moved[:, None]), axis=-1
    )
    nearest = np.argmin(away, axis=1)
    index = np.arange(len(moved))
    sure = (away[index, nearest] < GATE) & (np.argmin(away, axis=0)[nearest] == index)
    sure &= np.sum(away < CLEAR, axis=1) == 1
    return np.where(sure, nearest, LOST)


def _count(moved: FloatArray, after: FloatArray, steps: FloatArray, sited: BoolArray) -> int:
    return int(np.sum(_found(moved, after, steps)[sited] != LOST))


def _reference_lit(correction: Correction, motion: Motion, after: FloatArray) -> bool:
    """Whether a dot is at the reference, which had no dot between two neighbours in its row."""
    lattice = correction.lattice
    if lattice.reference is None:
        return False
    k, t = lattice.reference
    row = lattice.row == k
    beside = [np.flatnonzero(row & (lattice.column == column)) for column in (t - 1, t, t + 1)]
    if not (len(beside[0]) == len(beside[2]) == 1 and len(beside[1]) == 0):
        return False
    left, right = motion(correction.dots.image_px[[beside[0][0], beside[2][0]]])
    away = np.linalg.norm(after - (left + right) / 2, axis=1).min()
    return bool(away < GATE * np.linalg.norm(right - left) / 2)
