"""Matching of dots whose rows and columns the operator has set (§4.2.2, §7.1).

These are binding and determine the rays. The surface gives the rays of the other dots, and shows
whether the correction is consistent.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import scipy

from labapp.core.geometry.rig import Rig
from labapp.core.match import Match, Orientation, signs_of
from labapp.core.matching.checks.unexplained import is_scattered
from labapp.core.matching.hypothesis import WIDE_FIT, Hypothesis, evaluate, grow_and_evaluate
from labapp.core.matching.match_rays import lattice_of_match, match_of_hypothesis, match_rays
from labapp.core.matching.match_settings import MatchSettings
from labapp.core.matching.observation import LEAST_LABELS, UNLABELLED, Observation
from labapp.core.matching.relabelling import labels_from_lattice
from labapp.core.rows.lattice import Lattice, Site
from labapp.core.surface.spline import SplineSurface
from labapp.core.values import CannotMeasure, IntArray

AGREED = 0.8
"""Minimum share of the dots that must agree on the site of the reference."""

OFF_SPACINGS, FEW_OFF = 0.25, 0.04
"""A dot with a given row and column is off if its residual exceeds this fraction of the distance to
the nearest dot. If more than this share of the dots is off, and more than two, the correction does
not fit."""


def match_corrected(
    observed: Observation,
    lattice: Lattice,
    settings: MatchSettings,
) -> tuple[Match, SplineSurface]:
    """Determine the ray of every dot of a frame that the operator has corrected.

    With a reference, the row and the column of a dot determine its ray; without one, the rows and
    columns are matched as a block by `match_rays`. The rays of the other dots follow from the
    surface, but never contradict a given row or column. Reflected rows and columns keep the
    operator's numbers.

    Parameters
    ----------
    observed, lattice
        The corrected dots, and their rows and columns, 0 for none. Missing dots of blocked rows
        give no information about the boundary.
    settings
        See `match_rays`.

    Raises
    ------
    CannotMeasure
        As `match_rays`; also ``no-match`` if no surface fits the given rows and columns.
    """
    rows = _whole_sites(lattice)
    count = int((rows.row > 0).sum())
    orientations = settings.orientations
    reference = lattice.reference
    if reference is None:
        match, near = match_rays(observed, rows if count else None, settings)
        if count == 0:
            return match, near
        reference, orientations = _found_reference(match, rows, observed.rig), (match.orientation,)
    elif count < LEAST_LABELS:
        raise CannotMeasure(
            "too-few-dots",
            f"only {count} dots have a row and a column; at least {LEAST_LABELS} are needed",
        )
    tried = (_bound(observed, lattice, reference, orientation) for orientation in orientations)
    bound = [b for b in tried if b is not None]
    if not bound:
        raise CannotMeasure(
            "no-match",
            "the correction does not fit: counted from this reference, dots lie where the matrix "
            "has no rays, or no surface explains their places",
        )
    best = min(bound, key=lambda b: b.hypothesis.cost)
    _check_bound(best, rows, settings)
    for other in bound:
        if other is not best and other.hypothesis.cost < best.hypothesis.cost + settings.margin:
            raise CannotMeasure(
                "ambiguous-orientation",
                f"{best.orientation} and {other.orientation} explain the dots equally well",
            )
    # The states of the rays come from the same fit as for frames without a correction.
    usual = evaluate(best.observed, best.hypothesis.labels)
    final = (
        best.hypothesis if usual is None else replace(best.hypothesis, ray_states=usual.ray_states)
    )
    match = match_of_hypothesis(best.observed, final, best.orientation, reference)
    return match, final.pool.surface


def lattice_of_corrected(match: Match, rig: Rig, given: Lattice) -> Lattice:
    """Rows and columns from the rays (`lattice_of_match`), with the operator's blocked rows.

    Numbers are those of ``given`` unless dots lie below or left of its first row or column.
    """
    lattice = lattice_of_match(match, rig, len(given.row))
    sited = np.flatnonzero((given.row > 0) & (given.column > 0))
    up = int(lattice.row[sited[0]] - given.row[sited[0]]) if len(sited) else 0
    return replace(lattice, blocked_rows=frozenset(k + up for k in given.blocked_rows))


@dataclass(frozen=True)
class _Bound:
    """Hypothesis from the operator's sites with one orientation.

    ``contested`` holds the dots with a site where the grown labels contradict it: they assign its
    ray to another dot, or the dot to another ray. No dot without a site then has a ray.
    """

    observed: Observation
    orientation: Orientation
    hypothesis: Hypothesis
    contested: IntArray


def _whole_sites(lattice: Lattice) -> Lattice:
    """Remove from a lattice the dots that have only a row or only a column."""
    sited = (lattice.row > 0) & (lattice.column > 0)
    return replace(
        lattice, row=np.where(sited, lattice.row, 0), column=np.where(sited, lattice.column, 0)
    )


def _bound(
    observed: Observation, given: Lattice, reference: Site, orientation: Orientation
) -> _Bound | None:
    """Label dots by their sites, and the others by the surface; None if no surface fits them."""
    pattern, way, rows = observed.rig.pattern, signs_of(orientation), _whole_sites(given)
    marker = pattern.marker or pattern.center_ray
    hidden = (marker[0] + (k - reference[0]) * int(way[0]) for k in given.blocked_rows)
    observed = replace(observed, hidden_rows=frozenset(hidden))
    shape = (pattern.rows, pattern.columns)
    labels = labels_from_lattice(rows, reference, marker, orientation, shape)
    labels = np.where(observed.rays.absent, UNLABELLED, labels)
    lit = labels != UNLABELLED
    if lit.sum() < (rows.row > 0).sum():  # a site beyond the pattern, or where no ray is
        return None
    hypothesis = evaluate(observed, labels, WIDE_FIT)
    if hypothesis is None:
        return None
    wider = grow_and_evaluate(observed, labels)
    if wider is None:
        return _Bound(observed, orientation, hypothesis, np.zeros(0, np.int64))
    taken = (wider.labels != labels) & (wider.labels != UNLABELLED)
    contested = labels[lit & (taken | (np.isin(labels, wider.labels[taken])))]
    if len(contested) == 0:
        ray = np.argwhere(~lit & (wider.labels != UNLABELLED)) + 1
        dot = wider.labels[ray[:, 0] - 1, ray[:, 1] - 1]
        numbers = np.stack([given.row[dot], given.column[dot]], axis=-1)
        against = (numbers > 0) & (numbers != reference + (ray - marker) * way)
        more = ~against.any(axis=-1)
        labels = labels.copy()
        labels[ray[more, 0] - 1, ray[more, 1] - 1] = dot[more]
        further = evaluate(observed, labels, WIDE_FIT)
        if further is not None and further.cost < hypothesis.cost:
            hypothesis = further
    return _Bound(observed, orientation, hypothesis, contested)


def _found_reference(match: Match, rows: Lattice, rig: Rig) -> Site:
    """Site of the reference in the operator's rows, from the rays of a match."""
    pattern = rig.pattern
    site = np.stack([rows.row, rows.column], axis=-1)[match.dot]
    away = (match.ray - (pattern.marker or pattern.center_ray)) * signs_of(match.orientation)
    kinds, count = np.unique((site - away)[site[:, 0] > 0], axis=0, return_counts=True)
    if len(kinds) == 0 or count.max() < AGREED * count.sum():
        raise CannotMeasure(
            "no-match", "the correction does not fit: the dots' rays are in other rows"
        )
    k, t = kinds[np.argmax(count)].tolist()
    return k, t


def _check_bound(bound: _Bound, rows: Lattice, settings: MatchSettings) -> None:
    """Raise ``no-match`` if the surface contradicts the sites, and name the worst row.

    Isolated dots may remain without a ray, as in a frame without a correction: they are false.
    """
    observed, best = bound.observed, bound.hypothesis
    labels = best.labels
    dot = labels[labels != UNLABELLED]
    next_mm = scipy.spatial.cKDTree(observed.plane_mm).query(observed.plane_mm, k=2)[0][dot, 1]
    off = np.linalg.norm(best.pool.residual_mm, axis=-1) > OFF_SPACINGS * next_mm
    wrong, sited = dot[off & (rows.row[dot] > 0)], int((rows.row > 0).sum())
    if len(wrong) > max(2, FEW_OFF * sited):
        raise CannotMeasure(
            "no-match",
            f"the correction does not fit: {len(wrong)} of {sited} dots given a row and a column "
            f"are far from any surface's prediction, most in row {_most(rows.row[wrong])}",
        )
    isolated = is_scattered(observed, labels, best.missed_rays, best.stray_dots)
    left, count = best.stray_count, len(observed.plane_mm)
    if left > settings.most_strays(count) and (len(bound.contested) or not isolated):
        reason = f"the correction leaves {left} of {count} dots without a ray"
        if len(bound.contested):
            row = _most(rows.row[bound.contested])
            reason += f", as the surface contradicts dots that are given row {row}"
        raise CannotMeasure("no-match", reason)


def _most(rows: IntArray) -> int:
    return int(np.argmax(np.bincount(rows)))
