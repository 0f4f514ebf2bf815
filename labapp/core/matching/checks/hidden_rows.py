"""Check that no row or column of dots is hidden between the others.

A wire or the torch in front of the plane may hide all dots of a row. If the rows beyond it are
labelled as if none were hidden, their rays are one row off, and the surface bends to explain them.
As one object hides them all, its dots do not count as missed one by one.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from labapp.core.matching.hypothesis import MISSED_COST, Hypothesis, evaluate_averaged
from labapp.core.matching.label_growth import grow_labels
from labapp.core.matching.observation import UNLABELLED, Observation, try_fit
from labapp.core.surface.pool_fit import FitSettings
from labapp.core.values import BoolArray, CannotMeasure, FloatArray, IntArray, median

FEW, MOST_FREED = 4, 8
"""If at most the second number of dots are beyond a hidden row, they lose their rays; otherwise the
frame is refused. The first, or fewer, are weak evidence."""

WIDE_GAP, WIDE_GAP_FREED = 1.45, 1.35
"""A row may be hidden in a gap that exceeds by this factor what follows from the two gaps before
it, whose ratio changes little on a smooth surface; the second, if at most `MOST_FREED` dots are
beyond it."""

AHEAD, AHEAD_FREED, AHEAD_FEW = 11.0, 15.0, 25.0
"""Labels must cost less by the first than with a hidden row, whose dots do not count as missed, by
the second if at most `MOST_FREED` dots are beyond the gap, or by the last if at most `FEW`; in
units of χ². Of labels one row off, nine in ten led by less than the first, or cost more, and one
led by 13; of right labels, those of 7 in 1,000 pools with a dip, and of 2 in 84 of all kinds."""


def rays_beside_hidden_rows(
    observed: Observation, best: Hypothesis, fit_settings: FitSettings
) -> BoolArray:
    """Mask of the rays whose state depends on whether a row or column is hidden before the last.

    They are those of the row that may be hidden, and those that the dots beyond it have in either
    case. Shape (rows, columns).

    Raises
    ------
    CannotMeasure
        ``ambiguous-rows`` if more than `MOST_FREED` dots are beyond it.
    """
    in_doubt = np.zeros(best.labels.shape, dtype=bool)
    for axis, inner, outer, width in _wide_gaps(observed, best.labels):
        labels = _moved_outwards(best.labels, axis, inner, outer)
        own = evaluate_averaged(observed, best.labels, fit_settings, best.pool)
        if labels is None or own is None:
            continue
        moved = np.count_nonzero((labels != best.labels) & (labels != UNLABELLED))
        freed = moved <= MOST_FREED
        if not freed and width < WIDE_GAP:
            continue
        # Dots farther out may have a ray then.
        grown = grow_labels(observed, labels) if best.stray_count else None
        rivals = [labels] if grown is None else [labels, grown]
        cost = min(
            _cost_if_hidden(observed, each, best, axis, outer, fit_settings) for each in rivals
        )
        ahead = AHEAD_FEW if moved <= FEW else AHEAD_FREED if freed else AHEAD
        if cost >= own.cost + ahead:
            continue
        if not freed:
            line = "row" if axis == 0 else "column"
            raise CannotMeasure(
                "ambiguous-rows",
                f"a {line} of dots seems to be hidden beside {line} {inner + 1} of the rays: "
                "number rows and columns by hand",
            )
        for each in rivals:
            in_doubt |= each != best.labels
        lines = in_doubt if axis == 0 else in_doubt.T
        lines[outer] = True
    return in_doubt


def lines_before(lost: BoolArray, lit: BoolArray) -> BoolArray:
    """Mask of the rows and columns that are hidden if doubtful dots beyond them are not false.

    A ray that lost its label is beyond a row (or column) if, in its column (or row), the next ray
    has no dot and the one after it has one. All masks have shape (rows, columns).
    """
    hidden = np.zeros_like(lit)
    for axis in (0, 1):
        for step in (1, -1):
            across, doubtful, labelled = (
                each[::step] if axis == 0 else each.T[::step] for each in (hidden, lost, lit)
            )
            beyond = doubtful[:-2] & ~(doubtful | labelled)[1:-1] & labelled[2:]
            across[1:-1] |= np.any(beyond, axis=1, keepdims=True)
    return hidden


def _cost_if_hidden(
    observed: Observation,
    labels: IntArray,
    best: Hypothesis,
    axis: int,
    hidden: int,
    fit_settings: FitSettings,
) -> float:
    """Cost of labels, the missed rays of the hidden row or column excepted; infinite without a fit.

    If growth labelled a dot in that row or column, it is not hidden, and the cost is infinite.
    """
    pool = try_fit(observed, labels, initial=best.pool)
    if pool is None or (labels.take(hidden, axis) != UNLABELLED).any():
        return np.inf
    rival = evaluate_averaged(observed, labels, fit_settings, pool)
    if rival is None:
        return np.inf
    return rival.cost - MISSED_COST * np.count_nonzero(rival.missed_rays[:, axis] == hidden)


def _wide_gaps(observed: Observation, labels: IntArray) -> Iterator[tuple[int, int, int, float]]:
    """Gaps in which a row or column may be hidden, from the marker outwards.

    Axis, the rows (or columns) before and after the gap, counted from 0, and its width as a
    multiple of the expected one.
    """
    marker = observed.rig.pattern.marker
    assert marker is not None
    place = np.full((*labels.shape, 2), np.nan)
    lit = labels != UNLABELLED
    place[lit] = observed.plane_mm[labels[lit]]
    for axis, start in enumerate(np.subtract(marker, 1).tolist()):
        gaps = _gaps(place if axis == 0 else place.transpose(1, 0, 2))
        for step in (1, -1):
            along = gaps[::step]
            first = start if step > 0 else len(gaps) - start
            for k in range(max(first, 1), len(along)):
                before = along[k - 1]
                far = along[k - 2] if k > 1 and np.isfinite(along[k - 2]) else before
                width = float(along[k] * far / before**2)
                if width > WIDE_GAP_FREED:
                    inner = k if step > 0 else len(gaps) - k
                    yield axis, inner, inner + step, width


def _gaps(place: FloatArray) -> FloatArray:
    """Median distance of the dots of each row from those of the next one, NaN without any."""
    step = np.diff(place, axis=0)
    return np.array([median(row[np.isfinite(row)]) for row in np.hypot(step[..., 0], step[..., 1])])


def _moved_outwards(labels: IntArray, axis: int, inner: int, outer: int) -> IntArray | None:
    """Labels with all rows (or columns) from ``outer`` on moved by one away from ``inner``.

    None if there is no ray for the last of them.
    """
    lines = labels if axis == 0 else labels.T
    lines, first = (lines, outer) if outer > inner else (lines[::-1], len(lines) - 1 - outer)
    if (lines[-1] != UNLABELLED).any():
        return None
    empty = np.full((1, lines.shape[1]), UNLABELLED)
    moved = np.concatenate([lines[:first], empty, lines[first:-1]])
    moved = moved if outer > inner else moved[::-1]
    return np.ascontiguousarray(moved if axis == 0 else moved.T)
