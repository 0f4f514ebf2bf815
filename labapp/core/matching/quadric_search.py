"""Hypotheses from the optics: quadrics whose rays round the absent centre fall on dots.

Where rows bow so far that no grid grows on the picture, the surface can still be found from the
few dots round the hole: near its middle a pool is a quadric. The hole fixes its slope, the two
dots beside it the curvature across, and the curvature along is tried out. What then falls near
the dots round the hole is fitted to them and held against more of them.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import scipy

from labapp.core.geometry.optics import bisecting_gradient, direction_to_dots
from labapp.core.matching.observation import UNLABELLED, Observation
from labapp.core.values import BoolArray, FloatArray, IntArray

WINDOW_REACH = 3
"""Rows and columns each way from the reference whose dots a quadric is held against."""

LOOSE_GATE, TIGHT_GATE = 0.5, 0.33
"""A ray finds its dot within this fraction of the spacing of the predicted dots: at first, and
once the quadric is fitted."""

_LIFTS = np.array([0.0, 0.2, -0.2, 0.4, -0.4])
"""How far the hole may lie off the middle of the two dots beside it, in their distance."""

_RATIOS = np.geomspace(0.35, 2.2, 12)
"""Curvature along over curvature across that is tried."""

_FLATTEST, _STEEPEST = 0.004, 0.6
"""Curvature below which no dots could be told apart, and above which no pool is, mm⁻¹."""


ROW_SLOPE, REGULAR, LEAST_GAP = 0.6, 0.42, 0.3
"""A hole is looked for between two dots of a row no steeper than the first. As one dot is missing
between them, the next one on should lie half as far off as they are apart, on one side at least: it
does within the second. No dot is in the hole: none is nearer to it than the third. The latter two
are shares of the distance of the two dots."""

CORE_LOOSE, CORE_TIGHT = 5, 6
"""So many of the eight rays round the reference must find their dots: loosely, at first, and once
the quadric is fitted."""

SILENT_COST, NEARNESS_GAIN = 3.0, 4.0
"""What a ray beside the reference that should have a dot and has none takes off a guess's score,
and what dots exactly where they are predicted add to it; a ray with a dot counts 1."""


@dataclass(frozen=True)
class QuadricGuess:
    """The dots that a quadric's rays fall on.

    Parameters
    ----------
    labels
        Index of the dot of each ray next to the reference or `UNLABELLED`, shape (rows, columns).
    score
        How many rays found their dot, less for those that should have and did not, and more for
        dots near their predictions.
    """

    labels: IntArray
    score: float


def search_quadrics(observed: Observation, most: int = 8) -> list[QuadricGuess]:
    """Find the quadrics that explain the dots round some hole best, the best first.

    Parameters
    ----------
    observed
        The dots and the rig.
    most
        How many to return at most; no two with the same labels.
    """
    marker = observed.rig.pattern.marker
    if marker is None or min(marker) < 2 or np.any(np.array(marker) >= observed.rays.shape[:2]):
        return []  # without rays all round it, a hole cannot be recognised
    window = _Window(observed, marker)
    found: dict[bytes, QuadricGuess] = {}
    quadrics = [_quadrics(window, *hole) for hole in _holes(observed, window.tree)]
    for guess in window.scored(window.fitted(np.concatenate([np.empty((0, 5)), *quadrics]))):
        key = guess.labels.tobytes()
        if key not in found or found[key].score < guess.score:
            found[key] = guess
    return sorted(found.values(), key=lambda guess: -guess.score)[:most]


def _holes(
    observed: Observation, tree: scipy.spatial.cKDTree
) -> Iterator[tuple[FloatArray, float]]:
    """Empty places between two dots, IPCS, and half the dots' distance along X′, mm."""
    dots = observed.plane_mm
    near = tree.query(dots, k=min(10, len(dots)))[1][:, 1:]
    one, other = dots[np.repeat(np.arange(len(dots)), near.shape[1])], dots[near.ravel()]
    step = other - one
    beside = (step[:, 0] > 0) & (np.abs(step[:, 1]) <= ROW_SLOPE * step[:, 0])
    one, other, step = one[beside], other[beside], step[beside]
    length = np.linalg.norm(step, axis=-1)
    beyond = tree.query(np.stack([one - step / 2, other + step / 2]))[0].min(axis=0)
    regular = beyond <= REGULAR * length
    one, other, step, length = one[regular], other[regular], step[regular], length[regular]
    lifts = length[:, None, None] * _LIFTS[:, None] * [0.0, 1.0]
    holes = ((one + other) / 2)[:, None] + lifts
    for k, lift in np.argwhere(tree.query(holes)[0] > LEAST_GAP * length[:, None]):
        yield holes[k, lift], step[k, 0] / 2


def _quadrics(window: _Window, hole: FloatArray, half_width: float) -> FloatArray:
    """Quadrics that put the reference into the hole, and loosely the dots round it in place.

    z = g·x + ½(κ_x x² + 2κ_xy xy + κ_y y²), x and y from where the reference would land on the
    work piece: (g_x, g_y, κ_x, κ_xy, κ_y) of each, shape (m, 5), mm⁻¹. Every curvature along is
    tried, and both signs of the curvature across that put the neighbouring dots where they are.
    """
    observed = window.observed
    laser, plane = observed.rig.laser.position_mm, observed.rig.imaging_plane
    landing = window.landing_mm
    slope = bisecting_gradient(landing - laser, direction_to_dots(landing, hole, plane))
    middle = window.middle
    beside = window.rays[middle[0], middle[1] + 1][None]
    # The dot beside the hole moves almost linearly with κ_x: two trials give both solutions.
    trial = np.array([[*slope, -0.02, 0.0, -0.02], [*slope, 0.02, 0.0, 0.02]])
    moved = window.intersect(trial, beside)[1][:, 0, 0] - hole[0]
    across = (np.array([1, -1]) * half_width - moved.mean()) / ((moved[1] - moved[0]) / 0.04)
    across = across[(np.abs(across) > _FLATTEST) & (np.abs(across) < _STEEPEST)]
    quadrics = np.zeros((len(across) * len(_RATIOS), 5))
    quadrics[:, :2] = slope
    quadrics[:, 2] = np.repeat(across, len(_RATIOS))
    quadrics[:, 4] = np.outer(across, _RATIOS).ravel()
    rays = window.rays[window.near]
    patterns = window.intersect(quadrics, rays.reshape(-1, 3))[1].reshape(-1, *rays.shape[:2], 2)
    hit = window.hits(patterns, LOOSE_GATE, window.absent[window.near])[0]
    hit = hit[(slice(None), *window.core_of_near)]
    return np.asarray(quadrics[hit.sum(axis=(1, 2)) >= CORE_LOOSE])


class _Window:
    """The rays round the reference, and the dots they may fall on."""

    def __init__(self, observed: Observation, marker: tuple[int, int]) -> None:
        i, j = (n - 1 for n in marker)
        rows, columns = observed.rays.shape[:2]
        reach = min(WINDOW_REACH, i, j, rows - 1 - i, columns - 1 - j)
        self.observed = observed
        self.tree, self.plane = (
            scipy.spatial.cKDTree(observed.plane_mm),
            observed.rig.imaging_plane.pose_mm,
        )
        self.part = slice(i - reach, i + reach + 1), slice(j - reach, j + reach + 1)
        self.rays = observed.rays[self.part]
        self.landing_mm = observed.landing_mm[i, j]
        self.absent = observed.absent[self.part]
        self.middle = (reach, reach)
        self.core = slice(reach - 1, reach + 2), slice(reach - 1, reach + 2)
        rim = max(reach - 2, 0)  # the core, and where there is one a ring round it
        self.near = slice(rim, 2 * reach + 1 - rim), slice(rim, 2 * reach + 1 - rim)
        self.core_of_near = tuple(slice(reach - 1 - rim, reach + 2 - rim) for _ in range(2))

    def intersect(self, quadrics: FloatArray, rays: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Reflection points of rays, shape (n, 3), on quadrics, shape (m, 5), and their dots.

        Shapes (m, n, 3), mm, and IPCS, (m, n, 2), mm (`quadric_kernels.reflect_off_quadrics`).
        """
        from labapp.core.matching import quadric_kernels

        laser = self.observed.rig.laser.position_mm
        return quadric_kernels.reflect_off_quadrics(
            self.landing_mm[:2], quadrics, rays, laser, self.plane
        )

    def hits(
        self, pattern: FloatArray, gate: float, absent: BoolArray
    ) -> tuple[BoolArray, IntArray, FloatArray]:
        """Which predicted dots, shape (m, rows, columns, 2), fall on a dot, on which, how far off.

        The last is in units of the gate: a share of the way to the next predicted dot in the row
        or the column.
        """
        from labapp.core.matching import quadric_kernels

        return quadric_kernels.match_predicted_dots(pattern, self.observed.plane_mm, absent, gate)

    def fitted(self, quadrics: FloatArray) -> FloatArray:
        """Fit quadrics to the dots that their rays next to the reference fall near."""
        from labapp.core.matching import quadric_kernels

        laser, places = self.observed.rig.laser.position_mm, self.observed.plane_mm
        center, plane = self.landing_mm[:2], self.plane
        bench = self.rays, laser, plane, places, self.absent
        return quadric_kernels.fit_quadrics(center, quadrics, *bench, LOOSE_GATE)

    def scored(self, quadrics: FloatArray) -> Iterator[QuadricGuess]:
        """Hold quadrics against the dots; yield those that explain the dots round the hole."""
        patterns = self.intersect(quadrics, self.rays.reshape(-1, 3))[1]
        patterns = patterns.reshape(-1, *self.rays.shape[:2], 2)
        hit, dot, off = self.hits(patterns, TIGHT_GATE, self.absent)
        core = (slice(None), *self.core)
        explains = np.flatnonzero(hit[core].sum(axis=(1, 2)) >= CORE_TIGHT)
        seen = self.observed.in_view(np.nan_to_num(patterns[core][explains], nan=1e6))
        # A ray next to the hole that should show its dot and does not speaks against the quadric.
        silent = seen & ~self.absent[self.core] & ~hit[core][explains]
        for k, count in zip(explains, silent.sum(axis=(1, 2)).tolist(), strict=True):
            yield self._guess(hit[k], dot[k], off[k], count)

    def _guess(self, hit: BoolArray, dot: IntArray, off: FloatArray, silent: int) -> QuadricGuess:
        own = np.where(hit, dot, UNLABELLED)
        chosen, count = np.unique(own[hit], return_counts=True)
        own[np.isin(own, chosen[count > 1])] = UNLABELLED
        nearness = 1 - np.mean(off[hit])
        # Farther out the pool is no quadric, and the next row's dots may be hit instead.
        core = (self.core[0], slice(self.core[1].start - 1, self.core[1].stop + 1))
        near = np.full(own.shape, UNLABELLED)
        near[core] = own[core]
        labels = np.full(self.observed.rays.shape[:2], UNLABELLED, np.int64)
        labels[self.part] = near
        score = np.sum(own != UNLABELLED) - SILENT_COST * silent + NEARNESS_GAIN * nearness
        return QuadricGuess(labels, float(score))
