"""From a few labelled dots to all of them: fit the surface, predict every ray's dot, match, again.

Predicted by the surface rather than by neighbours on the picture, dots are told apart where rows
bow, fan out or cross; a dot that two predictions could claim is given to neither.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import cv2
import numpy as np
import scipy

from labapp.core.geometry.coordinates import ImageCalibration
from labapp.core.geometry.optics import meet_level, ray_directions
from labapp.core.geometry.rig import Rig
from labapp.core.images.dots import Dots
from labapp.core.surface.pool_fit import FitSettings, FittedPool, fit_pool, landing_spacing
from labapp.core.values import BoolArray, CannotMeasure, FloatArray, IntArray, freeze, median

UNLABELLED = -1

NEAR, CLEAR = 20.0, 6.0
"""A dot is a ray's if its squared distance, in σ², is below the one and every rival is less likely
by the other, in −2 log likelihood."""

RESOLVED = 2.2
"""Dots nearer to each other than this many of their standard deviations are one."""

FEW_LEFT = 0.06
"""Share of the dots that may be false or hidden: with more than that left over, more is tried."""

CAUTION = 1.4
"""By how much the surface's own uncertainty is enlarged while dots are labelled: beyond the last
labelled row it rests on how smooth pools are expected to be."""

FALSE_PER_MM2 = 5e-4
"""False dots to be expected on the imaging plane: a few in a frame. Where a prediction is vague,
one of them is as likely a cause of a dot as the ray."""


def as_likely_false(false_per_mm2: float) -> float:
    """−2 log likelihood, less the same constant as `surprises`, of a false dot."""
    return -2 * float(np.log(2 * np.pi * false_per_mm2))


AS_LIKELY_FALSE = as_likely_false(FALSE_PER_MM2)

SURE, LEAST_LINE = 2.5, 3
"""A row of rays beside the last lit one may have left the view where so many of its dots are
predicted in view by less than so many σ: that they are not seen does not make them dark."""

NEAR_EDGE_MM = 8.0
"""Only so near the edge of the view it is worked out how uncertain predictions are."""

MODEL_MM = 0.06
"""How far the right surface's dots may be off for no fault of theirs, mm."""

LEAST_LABELS = 6
"""A quadric wants three slopes each way; the six dots nearest a hole give twice that."""

# While dots are being labelled the surface is kept stiffer than in the final fit: a wrong label
# must stand out rather than be bent to. Shallow pools are followed farther by a stiff surface,
# steep ones only by a soft one. Only knots as fine as the final fit's follow a dent; a few labels
# lead farther with wider ones.
_FINE = FitSettings(rounds=5, jerk=0.05, floor_mm=0.03, settled_mm=2e-3)
_WIDE = replace(_FINE, knot_mm=1.2, jerk=0.036)
SOFT, _WIDE_SOFT = replace(_FINE, jerk=0.12), replace(_WIDE, jerk=0.12)
# Of the surface by which many labellings are sorted: the right one is not far from the first.
QUICK = replace(SOFT, knot_mm=1.5, rounds=3)

FEW_LABELS = 25
"""A whole grid labels more dots than this, a quadric round a hole fewer."""


@dataclass(frozen=True)
class Scene:
    """Dots on the imaging plane, and the rig they were made with.

    Parameters
    ----------
    plane_mm
        Dots, IPCS (X′, Z′), shape (n, 2), mm.
    covariance_mm2
        Their covariance, shape (n, 2, 2), mm².
    resolution_mm
        How near another dot may be before the two run into each other, mm.
    rig, calibration
        The bench, and how the camera sees the plane.
    frame_shape
        Height and width of the frame, px.
    hidden_rows
        Rows i of the pattern whose missing dots the operator says are hidden.
    """

    plane_mm: FloatArray
    covariance_mm2: FloatArray
    resolution_mm: float
    rig: Rig
    calibration: ImageCalibration
    frame_shape: tuple[int, int]
    hidden_rows: frozenset[int] = frozenset()

    def __post_init__(self) -> None:
        freeze(self)

    @classmethod
    def of(
        cls, dots: Dots, rig: Rig, calibration: ImageCalibration, frame_shape: tuple[int, int]
    ) -> Scene:
        """Put the dots of a frame on the imaging plane."""
        from labapp.core.images import dot_kernels

        sigma = np.stack([dots.u_sigma_px, dots.v_sigma_px], axis=-1)
        plane, covariance, scale = dot_kernels.on_plane(calibration.matrix, dots.image_px, sigma)
        resolution = RESOLVED * median(dots.size_px * scale)
        return cls(plane, covariance, resolution, rig, calibration, frame_shape)

    @cached_property
    def rays(self) -> FloatArray:
        """Directions of the rays, shape (rows, columns, 3)."""
        return ray_directions(self.rig.laser, self.rig.pattern)

    @cached_property
    def landing_mm(self) -> FloatArray:
        """Where the rays would land on z = 0, shape (rows, columns, 3), mm."""
        return meet_level(self.rig.laser.position_mm, self.rays)

    @cached_property
    def spacing_mm(self) -> FloatArray:
        """Distance between neighbouring landing points along X and along Y, shape (2,), mm."""
        return landing_spacing(self.landing_mm)

    @cached_property
    def view_mm2(self) -> float:
        """Area of the imaging plane that the frame shows, mm²."""
        height, width = self.frame_shape
        corners = np.array([[0, 0], [width, 0], [width, height], [0, height]], float)
        seen = self.calibration.to_plane(corners).astype(np.float32)
        return float(cv2.contourArea(seen))

    @cached_property
    def absent(self) -> BoolArray:
        """Rays that the lens does not make, shape (rows, columns)."""
        mask = np.zeros(self.rays.shape[:2], bool)
        for i, j in self.rig.pattern.absent_rays:
            mask[i - 1, j - 1] = True
        mask.flags.writeable = False
        return mask

    @cached_property
    def hidden(self) -> BoolArray:
        """Rays of `hidden_rows`, shape (rows, columns)."""
        mask = np.zeros(self.rays.shape[:2], bool)
        mask[[i - 1 for i in self.hidden_rows if 1 <= i <= len(mask)]] = True
        mask.flags.writeable = False
        return mask

    def fit(
        self,
        labels: IntArray,
        witness: IntArray,
        settings: FitSettings,
        near: FittedPool | None = None,
    ) -> FittedPool:
        """Fit the surface to labelled dots (see `fit_pool`), from one that may be near.

        Hypotheses lead to the same labels again and again: what was fitted once is kept.
        """
        key = labels.tobytes(), witness.tobytes(), settings
        if key not in self._fitted:
            at = np.argwhere(labels != UNLABELLED)
            dot = labels[tuple(at.T)]
            dots = self.plane_mm[dot], self.covariance_mm2[dot]
            surface = None if near is None else near.surface
            try:
                made = fit_pool(at + 1, *dots, witness, self.rig, settings, surface)
                self._fitted[key] = made
            except CannotMeasure as reason:
                self._fitted[key] = reason
        found = self._fitted[key]
        if isinstance(found, CannotMeasure):
            raise found
        return found

    @cached_property
    def _fitted(self) -> dict[tuple[bytes, bytes, FitSettings], FittedPool | CannotMeasure]:
        return {}

    def in_view(self, plane_mm: FloatArray, margin_mm: FloatArray | float = 0.0) -> BoolArray:
        """Whether places on the plane, shape (…, 2), are on it and in the frame, with a rim.

        The plane reaches as far as its size says, and as far as dots are seen on it: O′ need not
        be its very corner. Places are as far inside as a margin along either axis, of their shape.
        """
        rim_mm, rim_px = 0.5, 4.0
        plane = self.rig.imaging_plane
        low = np.minimum(self.plane_mm.min(axis=0), 0.0) + rim_mm
        high = np.maximum(self.plane_mm.max(axis=0), [plane.width_mm, plane.height_mm]) - rim_mm
        limit = np.array(self.frame_shape[::-1]) - 1 - rim_px
        ways = np.array([[1, 1], [1, -1], [-1, 1], [-1, -1]] if np.any(margin_mm) else [[0, 0]])
        corners = np.stack([plane_mm + way * margin_mm for way in ways])
        image = self.calibration.to_image(corners)
        on_plane = (corners > low) & (corners < high)
        in_frame = (image > rim_px) & (image < limit)
        return np.asarray((on_plane & in_frame).all(axis=(0, -1)))


@dataclass(frozen=True)
class Prediction:
    """Where the surface puts the dots of some rays, m of them.

    Parameters
    ----------
    at
        Rows and columns of the rays in the pattern's arrays, counted from 0, shape (m, 2).
    points_mm, slopes
        Reflection points, shape (m, 3), mm, and the surface's slopes there, shape (m, 2).
    plane_mm
        Dots, IPCS, shape (m, 2), mm.
    spacing_mm
        Distance from each to the next predicted dot, shape (m,), mm.
    """

    at: IntArray
    points_mm: FloatArray
    slopes: FloatArray
    plane_mm: FloatArray
    spacing_mm: FloatArray

    def part(self, which: BoolArray) -> Prediction:
        """Only some of the rays, by a mask of shape (m,)."""
        return Prediction(
            self.at[which],
            self.points_mm[which],
            self.slopes[which],
            self.plane_mm[which],
            self.spacing_mm[which],
        )

    def covariance_mm2(self, pool: FittedPool, rig: Rig) -> FloatArray:
        """Covariance of the dots, as far as the surface is uncertain, shape (m, 2, 2), mm²."""
        from labapp.core.surface import kernels

        laser, axes = rig.laser.position_mm, rig.imaging_plane.pose_mm[1:3]
        dots = rig.imaging_plane.to_universal(self.plane_mm)
        grid = pool.surface.basis.grid
        return kernels.covariance_of_dots(grid, pool.factor, laser, axes, self.points_mm, dots)

    def blocked(self, scene: Scene) -> BoolArray:
        """Whether the torch may hide the dots, shape (m,) (`kernels.behind_torch`)."""
        from labapp.core.surface import kernels

        rays, tip = scene.rays[tuple(self.at.T)], scene.rig.electrode.height_mm
        return kernels.behind_torch(self.points_mm, rays, self.slopes, tip)


def grow_labels(scene: Scene, labels: IntArray) -> IntArray | None:
    """Follow the surface from the labels given until nothing changes.

    Parameters
    ----------
    scene
        The dots and the rig.
    labels
        Index of each ray's dot or `UNLABELLED`, shape (rows, columns).

    Returns
    -------
    IntArray or None
        The labels, of the same shape; None if they lead nowhere.
    """
    best: IntArray | None = None
    enough = (1 - FEW_LEFT) * len(scene.plane_mm)
    few = _count(labels) < FEW_LABELS
    course = (_WIDE, _WIDE_SOFT, _WIDE) if few else (_FINE, SOFT, _FINE)
    for attempt in range(2):
        for settings in course:
            grown = _settled(scene, labels, settings)
            if grown is not None and (best is None or _count(grown) > _count(best)):
                best = grown
            labels = labels if best is None else best
            if best is not None and _count(best) == len(scene.plane_mm):
                return best  # there is no more to be had
        if best is None or _count(best) >= enough or attempt:
            break
        # A wrong label at the rim bars the way and holds itself up: take the rim off once.
        labels = _without_rim(best)
    return best


def _without_rim(labels: IntArray) -> IntArray:
    """Only labels with most of their neighbours labelled."""
    return np.where(neighbours_of(labels != UNLABELLED) >= 4, labels, UNLABELLED)


def neighbours_of(lit: BoolArray) -> IntArray:
    """How many of the eight rays round each are lit, shape (rows, columns)."""
    ones, border = lit.astype(np.int32), cv2.BORDER_CONSTANT
    return np.asarray(cv2.boxFilter(ones, -1, (3, 3), normalize=False, borderType=border) - ones)


def _settled(scene: Scene, labels: IntArray, settings: FitSettings) -> IntArray | None:
    """Predict and match until the labels no longer change, or come round again."""
    before: list[bytes] = []
    pool: FittedPool | None = None
    while len(before) < 15:
        pool = try_fit(scene, labels, settings, pool)
        if pool is None:
            return None
        labels = _matched(scene, pool, labels)
        state = labels.tobytes()
        if state in before:
            break
        before.append(state)
    labels = _without_outliers(scene, labels, settings)
    return labels if _count(labels) >= LEAST_LABELS else None


def _count(labels: IntArray) -> int:
    return int(np.sum(labels != UNLABELLED))


def try_fit(
    scene: Scene, labels: IntArray, settings: FitSettings = SOFT, near: FittedPool | None = None
) -> FittedPool | None:
    """Fit the surface to the dots labelled so far, its level guessed from their rim."""
    if _count(labels) < LEAST_LABELS:
        return None
    try:
        return scene.fit(labels, np.zeros(labels.shape, np.int64), settings, near)
    except CannotMeasure:
        return None


def predict(scene: Scene, pool: FittedPool, where: BoolArray) -> Prediction:
    """Predict the dots of the rays in a mask, shape (rows, columns)."""
    from labapp.core.images import dot_kernels
    from labapp.core.surface import kernels

    at = np.argwhere(where)
    index, surface, pose = tuple(at.T), pool.surface, scene.rig.imaging_plane.pose_mm
    points, slopes, plane = kernels.meet(
        surface.basis.grid,
        surface.coefficients,
        scene.rays[index],
        scene.landing_mm[index],
        4,
        pose,
    )
    sane = np.isfinite(plane[:, 0])
    at, points, slopes, plane = at[sane], points[sane], slopes[sane], plane[sane]
    spacing = np.full(len(plane), np.inf)
    if len(plane) > 1:
        spacing = dot_kernels.two_nearest(plane, plane)[0][:, 1]
    return Prediction(at, points, slopes, plane, spacing)


def lines_out_of_view(
    scene: Scene,
    at: IntArray,
    plane_mm: FloatArray,
    covariance_of: Callable[[BoolArray], FloatArray],
) -> BoolArray:
    """Rays of rows or columns that may have left the view, a mask of shape (rows, columns).

    Parameters
    ----------
    scene
        The dots and the rig.
    at, plane_mm
        Dark rays beside the lit ones, as in `Prediction`, shapes (m, 2), mm.
    covariance_of
        Covariance of the dots of some of them, by a mask of shape (m,), shape (…, 2, 2), mm².
    """
    unsure = ~scene.in_view(plane_mm, NEAR_EDGE_MM)
    lines = _lines_of(at[unsure], scene.absent.shape)
    if lines.any():
        variance = covariance_of(unsure)[:, [0, 1], [0, 1]]
        unsure[unsure] = ~scene.in_view(plane_mm[unsure], SURE * np.sqrt(variance))
        lines = _lines_of(at[unsure], scene.absent.shape)
    return lines


def _lines_of(at: IntArray, shape: tuple[int, ...]) -> BoolArray:
    """Rays, shape (m, 2), of which `LEAST_LINE` are in a row or a column, as a mask of a shape."""
    mask = np.zeros(shape, bool)
    mask[tuple(at.T)] = True
    rows, columns = mask.sum(axis=1, keepdims=True), mask.sum(axis=0, keepdims=True)
    return np.asarray(mask & ((rows >= LEAST_LINE) | (columns >= LEAST_LINE)))


def amid(lit: BoolArray) -> BoolArray:
    """Rays between lit ones in their row or in their column, shape (rows, columns)."""
    between = np.zeros_like(lit)
    for rays, among in ((lit, between), (lit.T, between.T)):
        before = np.logical_or.accumulate(rays)
        after = np.logical_or.accumulate(rays[::-1])[::-1]
        np.logical_or(among, before & after, out=among)
    return between


def within_rings(labels: IntArray, rings: int) -> BoolArray:
    """Labelled rays and their neighbours, so many rings of them."""
    return widened(labels != UNLABELLED, rings)


def widened(mask: BoolArray, rings: int) -> BoolArray:
    """A mask over rays, shape (rows, columns), and the neighbours, so many rings of them."""
    lit = np.ascontiguousarray(mask).view(np.uint8)
    return cv2.dilate(lit, np.ones((3, 3), np.uint8), iterations=rings).view(bool)


def surprises(
    scene: Scene, pool: FittedPool, predicted: Prediction, dots: IntArray
) -> tuple[FloatArray, FloatArray]:
    """How far off dots, n of them, are from m predictions, and how unlikely that makes each pair.

    Squared distances in σ², and −2 log likelihoods but for a constant, both of shape (n, m).
    """
    from labapp.core.matching import match_kernels

    uncertain = CAUTION**2 * predicted.covariance_mm2(pool, scene.rig) + MODEL_MM**2 * np.eye(2)
    return match_kernels.surprises(
        scene.plane_mm[dots], scene.covariance_mm2[dots], predicted.plane_mm, uncertain
    )


def _matched(scene: Scene, pool: FittedPool, labels: IntArray) -> IntArray:
    """Labels for dots that one ray alone can have made, and rays that made one dot alone.

    Likelihoods follow from what dot and prediction are uncertain by. Rays a ring farther out
    than any that is given a dot stand as rivals: where the prediction is so uncertain that the
    dots of the next row but one come into question, nobody gets them.
    """
    from labapp.core.matching import match_kernels

    matched = np.full(labels.shape, UNLABELLED, np.int64)
    far = predict(scene, pool, within_rings(labels, 2))
    if len(far.at) == 0:
        return matched
    distance, surprise = surprises(scene, pool, far, np.arange(len(scene.plane_mm)))
    ray, next_ray, best_dot, next_dot = match_kernels.two_least(surprise)
    dot = np.arange(len(ray))
    least = surprise[dot, ray]
    taken = (best_dot[ray] == dot) & (distance[dot, ray] < NEAR)
    taken &= least + CLEAR < np.minimum(next_ray, next_dot[ray])
    taken &= least + CLEAR < AS_LIKELY_FALSE
    at = far.at[ray]
    taken &= within_rings(labels, 1)[at[:, 0], at[:, 1]] & ~scene.absent[at[:, 0], at[:, 1]]
    # Dots that run into each other have no place of their own.
    taken &= far.spacing_mm[ray] > scene.resolution_mm
    matched[at[taken, 0], at[taken, 1]] = dot[taken]
    return matched


def _without_outliers(scene: Scene, labels: IntArray, settings: FitSettings) -> IntArray:
    """Drop labels far from where the surface through all of them puts their dot."""
    if len(scene.plane_mm) < 2:
        return labels
    spacing = scipy.spatial.cKDTree(scene.plane_mm).query(scene.plane_mm, k=2)[0][:, 1]
    for _ in range(3):
        pool = try_fit(scene, labels, settings)
        if pool is None:
            return labels
        at = np.argwhere(labels != UNLABELLED)
        off = np.linalg.norm(pool.residual_mm, axis=-1)
        allowed = 0.25 * spacing[labels[at[:, 0], at[:, 1]]]
        bad = off > np.maximum(6.0 * median(off), allowed)
        if not bad.any():
            return labels
        labels = labels.copy()
        labels[at[bad, 0], at[bad, 1]] = UNLABELLED
    return labels
