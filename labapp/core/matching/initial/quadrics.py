"""Initial labels from a local model of the pool: quadrics that explain the dots around a hole.

Where rows bend so much that no lattice can be grown in the image, the surface can still be found
from the few dots around the hole: near its centre a pool is a quadric. The hole determines its
slope, the two dots beside the hole the transverse curvature; several longitudinal curvatures are
tried.
Quadrics whose predictions lie near the dots around the hole are fitted to these and then compared
with more dots.
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
"""Rows and columns on either side of the reference whose dots a quadric is compared with."""

LOOSE_GATE, TIGHT_GATE = 0.5, 0.33
"""A dot matches a ray within this fraction of the spacing of the predicted dots: at first, and
once the quadric is fitted."""

_LIFTS = np.array([0.0, 0.2, -0.2, 0.4, -0.4])
"""Offsets of the hole along Z′ from the midpoint of the two dots beside it, in their distance."""

_RATIOS = np.geomspace(0.35, 2.2, 12)
"""Ratios of longitudinal to transverse curvature that are tried."""

_FLATTEST, _STEEPEST = 0.004, 0.6
"""Curvature below which dots could not be resolved, and upper limit for pools, mm⁻¹."""


ROW_SLOPE, REGULAR, LEAST_GAP = 0.6, 0.42, 0.3
"""A hole is searched for between two dots of a row whose slope is at most the first. As one dot is
missing between them, the next dot of the row is expected at half their distance, on one side at
least, with a tolerance of the second. No dot may be nearer to the hole than the third. The latter
two are fractions of the distance of the two dots."""

CORE_LOOSE, CORE_TIGHT = 5, 6
"""How many of the eight rays around the reference must have a dot: at first, with `LOOSE_GATE`, and
once the quadric is fitted."""

SILENT_COST, NEARNESS_GAIN = 3.0, 4.0
"""Penalty in the score for each ray next to the reference that should have a dot and has none, and
gain for dots exactly at their predictions; a ray with a dot counts 1."""

MOST_QUADRICS = 8
"""Number of quadrics whose labels are grown."""


@dataclass(frozen=True)
class QuadricLabels:
    """Labels that follow from a quadric.

    Parameters
    ----------
    labels
        Index of the dot of each ray next to the reference or `UNLABELLED`, shape (rows, columns).
    score
        Number of rays with a dot, minus a penalty for those that should have one, plus a gain for
        dots near their predictions.
    """

    labels: IntArray
    score: float


def search_quadrics(observed: Observation) -> list[QuadricLabels]:
    """Find the `MOST_QUADRICS` that best explain the dots around a hole, best first.

    Their labels are all different.

    Parameters
    ----------
    observed
        The dots and the rig.
    """
    marker = observed.rig.pattern.marker
    if marker is None or min(marker) < 2 or np.any(np.array(marker) >= observed.rays.absent.shape):
        return []  # without rays on all sides a hole cannot be recognised
    window = _Window(observed, marker)
    found: dict[bytes, QuadricLabels] = {}
    for one in window.scored(window.fitted(_quadrics(window, *_holes(observed, window.tree)))):
        key = one.labels.tobytes()
        if key not in found or found[key].score < one.score:
            found[key] = one
    return sorted(found.values(), key=lambda one: -one.score)[:MOST_QUADRICS]


def _holes(observed: Observation, tree: scipy.spatial.cKDTree) -> tuple[FloatArray, FloatArray]:
    """Empty places between two dots, IPCS, and half the distance of these along X′, mm.

    Shapes (h, 2) and (h,).
    """
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
    pair, lift = np.nonzero(tree.query(holes)[0] > LEAST_GAP * length[:, None])
    return holes[pair, lift], step[pair, 0] / 2


def _quadrics(window: _Window, holes: FloatArray, half_widths: FloatArray) -> FloatArray:
    """Quadrics that reflect the reference into a hole and roughly explain the dots around it.

    z = g·x + ½(κ_x x² + 2κ_xy xy + κ_y y²), x and y relative to where the reference would land on
    the work piece: (g_x, g_y, κ_x, κ_xy, κ_y) of each, shape (m, 5), curvatures in mm⁻¹. All
    longitudinal curvatures are tried, and both signs of the transverse curvature that reproduces
    the neighbouring dots. Parameters are those that `_holes` returns.
    """
    observed, landing, middle = window.observed, window.landing_mm, window.middle
    laser, plane = observed.rig.laser.position_mm, observed.rig.imaging_plane
    slope = bisecting_gradient(landing - laser, direction_to_dots(landing, holes, plane))
    # The dot beside the hole moves almost linearly with κ_x: two trials give both solutions.
    trials = np.zeros((len(holes), 2, 5))
    trials[..., :2] = slope[:, None]
    trials[..., 2] = trials[..., 4] = -0.02, 0.02
    beside = window.rays[middle[0], middle[1] + 1][None]
    moved = window.intersect(trials.reshape(-1, 5), beside)[1][:, 0, 0].reshape(-1, 2)
    moved -= holes[:, :1]
    per_curvature = (moved[:, 1:] - moved[:, :1]) / 0.04
    across = half_widths[:, None] * [1, -1] - moved.mean(axis=1, keepdims=True)
    across /= per_curvature
    hole, side = np.nonzero((np.abs(across) > _FLATTEST) & (np.abs(across) < _STEEPEST))
    curvature = np.repeat(across[hole, side], len(_RATIOS))
    quadrics = np.zeros((len(curvature), 5))
    quadrics[:, :2] = np.repeat(slope[hole], len(_RATIOS), axis=0)
    quadrics[:, 2] = curvature
    quadrics[:, 4] = curvature * np.tile(_RATIOS, len(hole))
    return window.with_core(quadrics, LOOSE_GATE, CORE_LOOSE)


class _Window:
    """The rays around the reference, and the dots that may be theirs."""

    def __init__(self, observed: Observation, marker: tuple[int, int]) -> None:
        i, j = (n - 1 for n in marker)
        rows, columns = observed.rays.absent.shape
        reach = min(WINDOW_REACH, i, j, rows - 1 - i, columns - 1 - j)
        self.observed = observed
        self.tree, self.plane = (
            scipy.spatial.cKDTree(observed.plane_mm),
            observed.rig.imaging_plane.pose_mm,
        )
        self.part = slice(i - reach, i + reach + 1), slice(j - reach, j + reach + 1)
        self.rays = observed.rays.directions[self.part]
        self.landing_mm = observed.rays.landing_mm[i, j]
        self.absent = observed.rays.absent[self.part]
        self.middle = (reach, reach)
        self.core = slice(reach - 1, reach + 2), slice(reach - 1, reach + 2)
        rim = max(reach - 2, 0)  # the core, and the ring around it if there is one
        self.near = slice(rim, 2 * reach + 1 - rim), slice(rim, 2 * reach + 1 - rim)
        core_of_near = tuple(slice(reach - 1 - rim, reach + 2 - rim) for _ in range(2))
        self.not_core_of_near = np.ones(self.rays[self.near].shape[:2], bool)
        self.not_core_of_near[core_of_near] = self.absent[self.core]

    def intersect(self, quadrics: FloatArray, rays: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Reflection points of n rays on m quadrics, and their dots.

        Shapes (m, n, 3), mm, and IPCS, (m, n, 2), mm (`quadric_kernels.reflect_off_quadrics`).
        """
        from labapp.core.matching.initial import quadric_kernels

        laser = self.observed.rig.laser.position_mm
        return quadric_kernels.reflect_off_quadrics(
            self.landing_mm[:2], quadrics, rays, laser, self.plane
        )

    def hits(
        self, pattern: FloatArray, gate: float, absent: BoolArray
    ) -> tuple[BoolArray, IntArray, FloatArray]:
        """Match predicted dots, shape (m, rows, columns, 2), with the observed ones.

        See `quadric_kernels.match_predicted_dots`.
        """
        from labapp.core.matching.initial import quadric_kernels

        return quadric_kernels.match_predicted_dots(pattern, self.observed.plane_mm, absent, gate)

    def with_core(self, quadrics: FloatArray, gate: float, least: int) -> FloatArray:
        """Quadrics with which at least so many of the rays next to the reference have a dot."""
        rays = self.rays[self.near]
        patterns = self.intersect(quadrics, rays.reshape(-1, 3))[1]
        hit = self.hits(patterns.reshape(-1, *rays.shape[:2], 2), gate, self.not_core_of_near)[0]
        return np.asarray(quadrics[hit.sum(axis=(1, 2)) >= least])

    def fitted(self, quadrics: FloatArray) -> FloatArray:
        """Fit quadrics to the dots that match their rays next to the reference."""
        from labapp.core.matching.initial import quadric_kernels

        laser, places = self.observed.rig.laser.position_mm, self.observed.plane_mm
        center = self.landing_mm[:2]
        rays, others = self.rays[self.near], self.not_core_of_near
        return quadric_kernels.fit_quadrics(
            center, quadrics, rays, laser, self.plane, places, others, LOOSE_GATE
        )

    def scored(self, quadrics: FloatArray) -> Iterator[QuadricLabels]:
        """Yield the labels of each quadric that explains the dots around the hole."""
        quadrics = self.with_core(quadrics, TIGHT_GATE, CORE_TIGHT)
        patterns = self.intersect(quadrics, self.rays.reshape(-1, 3))[1]
        patterns = patterns.reshape(-1, *self.rays.shape[:2], 2)
        hit, dot, off = self.hits(patterns, TIGHT_GATE, self.absent)
        core = (slice(None), *self.core)
        seen = self.observed.in_view(np.nan_to_num(patterns[core], nan=1e6))
        # A ray next to the hole that should have a dot but has none is evidence against the
        # quadric.
        silent = seen & ~self.absent[self.core] & ~hit[core]
        for k, count in enumerate(silent.sum(axis=(1, 2)).tolist()):
            yield self._labels(hit[k], dot[k], off[k], count)

    def _labels(self, hit: BoolArray, dot: IntArray, off: FloatArray, silent: int) -> QuadricLabels:
        is_shared = np.bincount(dot[hit])[np.where(hit, dot, dot[hit][0])] > 1
        matched = np.where(hit & ~is_shared, dot, UNLABELLED)
        nearness = 1 - np.mean(off[hit])
        # Farther out the pool is not a quadric, and dots of the next row may be matched instead.
        core = (self.core[0], slice(self.core[1].start - 1, self.core[1].stop + 1))
        near = np.full(matched.shape, UNLABELLED)
        near[core] = matched[core]
        labels = np.full(self.observed.rays.absent.shape, UNLABELLED, np.int64)
        labels[self.part] = near
        score = np.sum(matched != UNLABELLED) - SILENT_COST * silent + NEARNESS_GAIN * nearness
        return QuadricLabels(labels, float(score))
