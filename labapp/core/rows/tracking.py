"""Carry a correction on to the next frame: the same dots, a little further on.

From frame to frame the dots of a pool move together and, as the pool changes, a little apart. A
smooth motion is followed and each dot looked for where it leads, in units of the rows' and columns'
own steps. One row looks much like the next, so that motion must also find more dots again than any
that leads a row or a column further.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from labapp.core.images.dots import Dots
from labapp.core.rows.correction import Correction, set_reference
from labapp.core.rows.lattice import Lattice
from labapp.core.values import BoolArray, FloatArray, IntArray

LOST = -1

Motion = Callable[[FloatArray], FloatArray]
"""Places in one frame, shape (n, 2), to where they are in the next, px."""


@dataclass(frozen=True)
class CarrySettings:
    """When a correction still fits.

    Parameters
    ----------
    found
        Share of the dots with a row that must be found again. Dots placed by hand that are not
        found do not count: what no detector sees cannot be tracked.
    gate, clear
        A dot is found within this share of a step from where it is expected, if no other lies
        within the other.
    reach
        The dots together move by less than this share of a step.
    ahead
        A motion that leads a row or a column further must find this share of the dots fewer.
    """

    found: float = 0.85
    gate: float = 0.3
    clear: float = 0.5
    reach: float = 0.5
    ahead: float = 0.04


def carry_on(
    correction: Correction, dots: Dots, settings: CarrySettings | None = None
) -> Correction | None:
    """Apply the rows of a correction to the dots of the next frame.

    Parameters
    ----------
    correction
        Of the frame before. With the rows that its measurement has (`Measurement.lattice`) dots
        that came new are carried on too.
    dots
        What was found in the next frame.
    settings
        See `CarrySettings`.

    Returns
    -------
    Correction or None
        The dots of the next frame. Those found again have the row, the column and the mark of the
        dot before, the others none; reference and blocked rows stay. None where it no longer fits:
        too few dots are found again, a dot is where the reference should be dark, or the dots may
        as well have moved by a row or a column.
    """
    settings = settings or CarrySettings()
    lattice = correction.lattice
    steps = _steps(correction)
    if steps is None or len(dots) == 0:
        return None
    before, after = correction.dots.image_px, dots.image_px
    motion = _likeliest_motion(before, after, steps, correction.sited, settings)
    if motion is None:
        return None
    found = _found(motion(before), after, steps, settings)
    numbered = (lattice.row > 0) | (lattice.column > 0)
    wanted = numbered & ~(correction.manual & (found == LOST))
    if np.sum(found[wanted] != LOST) < settings.found * wanted.sum():
        return None
    if _reference_lit(correction, motion, after, settings):
        return None
    row, column, manual = (np.zeros(len(dots), kind) for kind in (np.int64, np.int64, bool))
    old = np.flatnonzero(found != LOST)
    row[found[old]], column[found[old]] = lattice.row[old], lattice.column[old]
    manual[found[old]] = correction.manual[old]
    moved = Lattice(row, column, lattice.reference, (), lattice.blocked_rows)
    return set_reference(Correction(dots, moved, manual), lattice.reference)


def _steps(correction: Correction) -> FloatArray | None:
    """Each dot's steps along its row and across rows, shape (n, 2, 2), px; None without rows.

    ``steps[n, :, 0]`` leads to the next column and ``steps[n, :, 1]`` to the next row.
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
    usual = np.median(steps, axis=0)
    size = np.linalg.norm(steps, axis=1)
    steps[np.abs(np.linalg.det(steps)) < 0.2 * size[:, 0] * size[:, 1]] = usual
    return steps if np.abs(np.linalg.det(steps)).min() > 0 else None


def _likeliest_motion(
    before: FloatArray,
    after: FloatArray,
    steps: FloatArray,
    sited: BoolArray,
    settings: CarrySettings,
) -> Motion | None:
    """The motion that finds most dots again; None if one a row or a column further is as good."""
    usual = np.median(steps[sited], axis=0)
    share = np.linspace(-settings.reach, settings.reach, 7)
    near = [usual @ np.array([t, k]) for k in share for t in share]
    first = max(near, key=lambda shift: _count(before + shift, after, steps, sited, settings))
    motion = _followed(before, after, steps, first, settings)
    found = _found(motion(before), after, steps, settings)
    count = int(np.sum(found[sited] != LOST))
    for cell in np.array([(1, 0), (-1, 0), (0, 1), (0, -1), (1, 1), (-1, -1), (1, -1), (-1, 1)]):
        # Not the same shift for all: a row further is another distance at each dot.
        start = motion(before) + steps @ cell
        further = _followed(before, after, steps, start - before, settings)
        other = _found(further(before), after, steps, settings)
        if np.mean(other[sited] == found[sited]) > 0.5:
            continue
        if np.sum(other[sited] != LOST) > count - settings.ahead * sited.sum():
            return None
    return motion


def _followed(
    before: FloatArray,
    after: FloatArray,
    steps: FloatArray,
    shift: FloatArray,
    settings: CarrySettings,
) -> Motion:
    """A motion that begins with a shift, shape (2,) or (n, 2), and bends to the dots it finds."""
    center, scale = before.mean(axis=0), max(float(np.ptp(before)), 1.0)

    def terms(place: FloatArray, degree: int) -> FloatArray:
        x, y = ((place - center) / scale).T
        return np.stack([x**a * y**b for a in range(3) for b in range(3) if a + b <= degree], -1)

    moved, degree = before + shift, 0
    weights = np.linalg.lstsq(terms(before, 0), moved - before, rcond=None)[0]
    for degree in (1, 1, 1, 2, 2, 2, 2):
        found = _found(moved, after, steps, settings)
        own = np.flatnonzero(found != LOST)
        if len(own) < 12:
            break
        way = after[found[own]] - before[own]
        weights = np.linalg.lstsq(terms(before[own], degree), way, rcond=None)[0]
        moved = before + terms(before, degree) @ weights
    last = next(d for d in range(3) if len(weights) == (d + 1) * (d + 2) // 2)
    return lambda place: place + terms(place, last) @ weights


def _found(
    moved: FloatArray, after: FloatArray, steps: FloatArray, settings: CarrySettings
) -> IntArray:
    """Which dot each one is, one to one, where its place is known; `LOST` where none is."""
    away = np.linalg.norm(
        np.einsum("nab,nmb->nma", np.linalg.inv(steps), after - moved[:, None]), axis=-1
    )
    nearest = np.argmin(away, axis=1)
    own = np.arange(len(moved))
    sure = (away[own, nearest] < settings.gate) & (np.argmin(away, axis=0)[nearest] == own)
    sure &= np.sum(away < settings.clear, axis=1) == 1
    return np.where(sure, nearest, LOST)


def _count(
    moved: FloatArray,
    after: FloatArray,
    steps: FloatArray,
    sited: BoolArray,
    settings: CarrySettings,
) -> int:
    return int(np.sum(_found(moved, after, steps, settings)[sited] != LOST))


def _reference_lit(
    correction: Correction, motion: Motion, after: FloatArray, settings: CarrySettings
) -> bool:
    """Whether a dot is where the reference was dark between two dots of its row."""
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
    return bool(away < settings.gate * np.linalg.norm(right - left) / 2)
