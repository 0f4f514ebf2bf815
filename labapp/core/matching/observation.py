"""Input of the matching: the dots of a frame on the imaging plane, and the bench.

An array over the rays of the pattern has the shape (rows, columns): the *labels*, the index of each
ray's dot, and masks, such as the rays that are *lit* because they have a dot.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import cv2
import numpy as np
import scipy

from labapp.core.geometry.bench import Bench
from labapp.core.geometry.optics import ProjectedRays
from labapp.core.geometry.rig import Rig
from labapp.core.images.dots import Dots
from labapp.core.images.visibility import GLARE_CELL_PX, View, over_limit
from labapp.core.match import MatchedDots
from labapp.core.surface.pool_fit import FitSettings, FittedPool, fit_pool, misfits
from labapp.core.values import (
    BoolArray,
    CannotMeasure,
    FloatArray,
    IntArray,
    ReadOnlyArrays,
    median,
)

UNLABELLED = -1
"""Label of a ray without a dot."""

LEAST_LABELS = 6
"""Minimum number of labelled dots for a fit: the slopes of a quadric have three parameters along
each axis, and the six dots nearest to a hole give twice as many values."""

RESOLVED_SIZES = 2.2
"""Dots nearer to each other than this multiple of their standard deviation are not resolved: two
equal Gaussians have a single peak up to 2, and pixels and noise blur them further."""

MERGED_SIZES, MERGED_REACH = 1.45, 1.3
"""A dot wider than the usual one by the first factor may be merged from several. Two dots s apart
give a width of √(σ² + s²/4); the places of their rays are sought at up to s/2 times the second."""

KEPT_BYTES = 100_000_000
"""Limit for the factors of the cached fits of a frame, bytes, beside which the rest of a fit is
small. That is over a thousand fits of a usual pool."""

EDGE_MM, EDGE_PX = 0.5, 4.0
"""A dot nearer to the edge of the plane or of the frame may be cut off and does not count as in
view: about the radius of a dot."""

STIFF = FitSettings(rounds=5, jerk=0.05, floor_mm=0.03, settled_mm=2e-3)
SOFT = replace(STIFF, jerk=0.12)
"""Fit settings for labelling. Dots have a larger floor of their uncertainty than in the final fit,
so that the smoothness counts more and a wrong label has a large residual instead of bending the
surface. The stiffer surface extrapolates a shallow pool farther; a steep pool needs the softer one.
"""

QUICK = replace(SOFT, knot_mm=1.5, rounds=3)
"""Fit settings for ranking many sets of labels (`Observation.quick_misfits`): the correct one is
near the top of the ranking."""


@dataclass(frozen=True)
class Observation(ReadOnlyArrays):
    """The n dots of one frame on the imaging plane, and the bench.

    Parameters
    ----------
    plane_mm
        Dots, IPCS (X′, Z′), shape (n, 2), mm.
    covariance_mm2
        Their covariance, shape (n, 2, 2), mm².
    size_mm
        Standard deviation of the intensity profile of each, shape (n,), mm.
    bench
        The bench.
    frame_shape
        Height and width of the frame, px.
    hidden_rows
        Rows i of the pattern whose missing dots are hidden, as set by the operator.
    over_limit
        Logarithm of the brightness of each over that of the faintest dot that is found
        (`images.visibility`), shape (n,). None: all dots are bright.
    glare_px
        Undistorted places of the frame where glare hides dots (`images.visibility`), shape (k, 2).
        None: there are none.
    """

    plane_mm: FloatArray
    covariance_mm2: FloatArray
    size_mm: FloatArray
    bench: Bench
    frame_shape: tuple[int, int]
    hidden_rows: frozenset[int] = frozenset()
    over_limit: FloatArray | None = None
    glare_px: FloatArray | None = None

    @classmethod
    def of(
        cls,
        dots: Dots,
        bench: Bench,
        frame_shape: tuple[int, int],
        glare_px: FloatArray | None = None,
    ) -> Observation:
        """Map the dots of a frame to the imaging plane.

        Parameters
        ----------
        dots, bench
            The dots and the bench.
        frame_shape
            Height and width of the frame, px.
        glare_px
            Places of the frame where glare hides dots (`images.visibility.glare`), shape (k, 2).
        """
        from labapp.core.images import band_pass_kernels

        sigma = np.stack([dots.u_sigma_px, dots.v_sigma_px], axis=-1)
        image_px = bench.calibration.ideal_px(dots.image_px)
        plane, covariance, scale = band_pass_kernels.on_plane(
            bench.calibration.matrix, image_px, sigma
        )
        size_mm = dots.size_px * scale
        if glare_px is not None and len(glare_px):
            glare_px = bench.calibration.ideal_px(glare_px)
        return cls(
            plane,
            covariance,
            size_mm,
            bench,
            frame_shape,
            over_limit=over_limit(dots),
            glare_px=glare_px,
        )

    @cached_property
    def resolution_mm(self) -> float:
        """Distance below which two dots merge, mm."""
        return RESOLVED_SIZES * median(self.size_mm)

    @cached_property
    def merged_reach_mm(self) -> FloatArray:
        """How far from each dot those of which it may be merged are, by its width, shape (n,), mm.

        0 for dots of the usual width.
        """
        usual = median(self.size_mm)
        half_apart = np.sqrt(np.maximum(self.size_mm**2 - usual**2, 0.0))
        wide = self.size_mm > MERGED_SIZES * usual
        return np.where(wide, MERGED_REACH * half_apart + usual / 2, 0.0)

    @cached_property
    def spacing_mm(self) -> FloatArray:
        """Distance of each dot from the nearest other one, shape (n,), mm."""
        return np.asarray(scipy.spatial.cKDTree(self.plane_mm).query(self.plane_mm, k=2)[0][:, 1])

    @property
    def rig(self) -> Rig:
        """The rig of the bench."""
        return self.bench.rig

    @property
    def rays(self) -> ProjectedRays:
        """The rays of the pattern."""
        return self.bench.rays

    @property
    def frame_area_mm2(self) -> float:
        """Area of the imaging plane that the frame shows, mm²."""
        return self.bench.frame_area_mm2(self.frame_shape)

    @cached_property
    def without_dot(self) -> BoolArray:
        """Rays known to have no dot, absent ones and those of `hidden_rows`: (rows, columns)."""
        mask = self.rays.absent.copy()
        mask[[i - 1 for i in self.hidden_rows if 1 <= i <= len(mask)]] = True
        mask.flags.writeable = False
        return mask

    def fit(
        self,
        labels: IntArray,
        ray_states: IntArray,
        settings: FitSettings,
        initial: FittedPool | None = None,
    ) -> FittedPool:
        """Fit the surface to labelled dots, with a cache.

        Different hypotheses often lead to the same labels.

        Parameters
        ----------
        labels
            Index of each ray's dot or `UNLABELLED`, shape (rows, columns).
        ray_states
            See `Match.ray_states`. If it is 0 everywhere, the level is guessed from the outermost
            labels.
        settings
            See `FitSettings`.
        initial
            A fit to start from, whose surface is close; None: the flat work piece.

        Raises
        ------
        CannotMeasure
            ``no-surface``, as `fit_pool`.
        """
        key = labels.tobytes(), ray_states.tobytes(), settings
        if key not in self._fitted:
            at = (labels != UNLABELLED).nonzero()
            dot, ray = labels[at], np.transpose(at) + 1
            plane_mm, covariance = self.plane_mm.take(dot, 0), self.covariance_mm2.take(dot, 0)
            matched = MatchedDots(ray, plane_mm, covariance, ray_states)
            near = None if initial is None else initial.surface
            try:
                pool = fit_pool(matched, self.rig, settings, near)
                self._forget_oldest()
                self._fitted[key], self._sizes[key] = pool, pool.factor.nbytes
            except CannotMeasure as failure:  # its traceback would keep the arrays of the fit alive
                self._fitted[key] = (failure.status, failure.reason)
        found = self._fitted[key]
        if isinstance(found, tuple):
            raise CannotMeasure(*found)
        return found

    def quick_misfits(
        self, labelled: Sequence[IntArray], initial: FittedPool | None = None
    ) -> FloatArray:
        """Root mean square residuals of quick fits to k sets of labels, shape (k,), mm.

        The level is guessed. A residual is infinite if there are fewer than `LEAST_LABELS`, or no
        surface fits them. Parameters are those of `fit`.
        """
        if not labelled:
            return np.zeros(0)
        near = None if initial is None else initial.surface
        sets, dots = np.array(labelled), (self.plane_mm, self.covariance_mm2)
        return misfits(sets, *dots, self.rig, QUICK, near, least=LEAST_LABELS)

    def _forget_oldest(self) -> None:
        """Drop the oldest fits from the cache while all factors exceed `KEPT_BYTES`."""
        over = sum(self._sizes.values()) - KEPT_BYTES
        while over > 0:
            oldest = next(iter(self._sizes))
            over -= self._sizes.pop(oldest)
            del self._fitted[oldest]

    @cached_property
    def _fitted(self) -> dict[tuple[bytes, bytes, FitSettings], FittedPool | tuple[str, str]]:
        return {}

    @cached_property
    def _sizes(self) -> dict[tuple[bytes, bytes, FitSettings], int]:
        """Size of the factor of each cached fit, bytes, the oldest first."""
        return {}

    @cached_property
    def evaluated(self) -> dict[tuple[bytes, FitSettings], Any]:
        """The last results of `hypothesis.evaluate`, by the labels and settings of the fit."""
        return {}

    @cached_property
    def matched(self) -> dict[tuple[bytes, FitSettings], IntArray]:
        """Results of `label_growth.matched_labels`, by the labels and settings of the fit."""
        return {}

    def in_view(
        self,
        plane_mm: FloatArray,
        margin_mm: FloatArray | float = 0.0,
        view: View | None = None,
    ) -> BoolArray:
        """Whether dots at places on the plane, shape (…, 2), mm, would be visible.

        They must be in the view even if displaced by a margin, of their shape, mm, along either
        axis. The view is that of `view_with`. None: that of all observed dots.
        """
        from labapp.core.matching import match_kernels

        places = plane_mm.reshape(-1, 2)
        margin = np.full(plane_mm.shape, margin_mm).reshape(-1, 2)
        visible = match_kernels.within_view(places, margin, view or self.view)
        return visible.reshape(plane_mm.shape[:-1])

    @cached_property
    def view(self) -> View:
        """The view with all observed dots (`view_with`)."""
        return self.view_with(self.plane_mm)

    @cached_property
    def _glare(self) -> BoolArray:
        """Cells of `GLARE_CELL_PX` of the view that glare hides, from its first px; or empty."""
        if self.glare_px is None or len(self.glare_px) == 0:
            return np.zeros((0, 0), bool)
        first, last = (px.astype(float) for px in self.bench.frame_px(self.frame_shape))
        counts = np.ceil((last - first) / GLARE_CELL_PX).astype(int) + 1
        cells = ((self.glare_px - first - EDGE_PX) // GLARE_CELL_PX).astype(int)
        cells = cells[((cells >= 0) & (cells < counts)).all(axis=1)]
        hidden = np.zeros(counts[::-1], np.uint8)
        hidden[cells[:, 1], cells[:, 0]] = 1
        # The cells of the frame are not those of the view: without gaps between them.
        return cv2.dilate(hidden, np.ones((3, 3), np.uint8)).astype(bool)

    def view_with(self, dots_mm: FloatArray) -> View:
        """Limits of the view, given dots on the plane, shape (n, 2), n > 0, mm.

        The plane extends over its nominal size and over these dots, as O′ need not be exactly its
        corner.

        Returns
        -------
        from_plane, on_plane_mm, in_image_px, glare
            The homography from the plane to the image, shape (3, 3); the limits (low, high) of
            visible dots, `EDGE_MM` and `EDGE_PX` inside the edges, shapes (2, 2); cells of
            `GLARE_CELL_PX` of the image, from its lower limit, that glare hides, if any.
        """
        plane = self.rig.imaging_plane
        low = np.minimum(dots_mm.min(axis=0), 0.0) + EDGE_MM
        high = np.maximum(dots_mm.max(axis=0), [plane.width_mm, plane.height_mm]) - EDGE_MM
        first, last = self.bench.frame_px(self.frame_shape)
        in_image = np.array([first + EDGE_PX, last - EDGE_PX])
        return self.bench.calibration.from_plane, np.array([low, high]), in_image, self._glare


def try_fit(
    observed: Observation,
    labels: IntArray,
    settings: FitSettings = SOFT,
    initial: FittedPool | None = None,
) -> FittedPool | None:
    """Fit the surface to the labelled dots, with the level guessed from the outermost of them.

    None if there are fewer than `LEAST_LABELS`, or no surface fits them (`Observation.fit`).
    """
    if count_labels(labels) < LEAST_LABELS:
        return None
    try:
        return observed.fit(labels, np.zeros(labels.shape, np.int64), settings, initial)
    except CannotMeasure:
        return None


# --- masks over the rays -----------------------------------------------------------------------


def count_labels(labels: IntArray) -> int:
    """Number of rays with a dot."""
    return int(np.count_nonzero(labels != UNLABELLED))


def amid(lit: BoolArray) -> BoolArray:
    """Mask of rays that are lit or between lit ones in a row or column, shape (rows, columns)."""
    from labapp.core.matching import match_kernels

    return match_kernels.amid(lit)


def neighbours_of(lit: BoolArray) -> IntArray:
    """Number of lit rays among the eight neighbours of each, shape (rows, columns)."""
    ones, border = lit.astype(np.int32), cv2.BORDER_CONSTANT
    return np.asarray(cv2.boxFilter(ones, -1, (3, 3), normalize=False, borderType=border) - ones)


def within_rings(labels: IntArray, rings: int) -> BoolArray:
    """Mask of labelled rays and a number of rings of neighbours, shape (rows, columns)."""
    return widened(labels != UNLABELLED, rings)


def widened(mask: BoolArray, rings: int) -> BoolArray:
    """Dilate a mask over rays, shape (rows, columns), by a number of rings."""
    from labapp.core.matching import match_kernels

    return match_kernels.widened(mask, rings)
