"""Classification of rays as lit or dark; dots and rays that a surface leaves unexplained."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import scipy

from labapp.core.matching.observation import UNLABELLED, Observation, widened
from labapp.core.matching.prediction import RayPaths
from labapp.core.values import BoolArray, FloatArray, IntArray

OUT_OF_VIEW_SIGMA, LEAST_LINE = 2.5, 3
"""A row of rays next to the last lit row may have left the view if at least `LEAST_LINE` of its
dots are predicted in view by less than `OUT_OF_VIEW_SIGMA` σ. Its rays then are not known to be
dark."""

EXTRAPOLATED_MM = 1.0
"""Predictions of dots are extrapolated if their standard uncertainty is larger: beside labelled
dots it is 0.1 to 0.3 mm, beyond the last visible row of a pool that is steep there 2 to 3 mm."""

NEAR_EDGE_MM = 8.0
"""Dots predicted within this distance of the edge of the view may be out of it. The uncertainty of
predictions is computed only there."""


FAINT_SIGMA, NEAR_LIMIT = 1.0, 0.5
"""A dot may be too faint to be found if its brightness, as extrapolated from the others, is less
than so many σ above the limit of the detector. Dots do not fade out where the logarithm of the
brightness of each, over this limit, exceeds the second."""

MOST_FAINT = 0.25
"""If more of the dark rays beside lit ones may have such dots, no ray is known to be dark: the few
others would not show the boundary. In 48 frames whose dots do not fade, no such ray was found."""

FADING, SCATTER, LEAST_SCATTER, SCATTER_ROUNDS = 1.0, 0.3, 0.1, 3
"""Expected size of each term of the quadratic by which the logarithm of the brightness changes
from the middle of the labelled rays outwards; scatter from dot to dot at first, and at least; and
the number of rounds in which the scatter is found."""


@dataclass(frozen=True)
class RayClasses:
    """Classes of rays and dots for a given surface.

    Parameters
    ----------
    ray_states
        +1 lit, −1 dark, 0 unknown, shape (rows, columns) (see `Match.ray_states`).
    missed
        Flat indices of the rays between lit rays that have no dot, shape (m,).
    stray
        Indices of the dots that have no ray, shape (s,).
    """

    ray_states: IntArray
    missed: IntArray
    stray: IntArray


def classify_rays(observed: Observation, labels: IntArray, paths: RayPaths) -> RayClasses:
    """Classify every ray, for labels of shape (rows, columns) and a surface fitted to them.

    Where the surface predicts that dots merge, neither a dot nor a ray counts as unexplained. This
    includes the dots of rays next to labelled ones: a concave pool focuses its last rows. A wide
    dot without a ray is merged from those of the rays that are predicted within its width. Nor does
    a ray that the far side of such a pool may stop. Only labelled dots prove that dots are visible
    outside the nominal plane: others may come from elsewhere.
    """
    from labapp.core.matching import match_kernels

    view = observed.view_with(observed.plane_mm[labels[labels != UNLABELLED]])
    ray_states, missed, stray = match_kernels.classify_rays(
        labels,
        observed.without_dot,
        (paths.basis.grid, paths.coefficients),
        (paths.points_mm, paths.slopes, paths.plane_mm),
        observed.rays.directions.reshape(-1, 3),
        (observed.plane_mm, observed.merged_reach_mm),
        view,
        np.array([observed.rig.electrode.height_mm, observed.resolution_mm, NEAR_EDGE_MM]),
    )
    return RayClasses(ray_states.reshape(labels.shape), missed, stray)


def certain_states(
    observed: Observation,
    labels: IntArray,
    ray_states: IntArray,
    paths: RayPaths,
    covariance_of: Callable[[IntArray], FloatArray],
) -> IntArray:
    """Return the states of rays, with dark rays set to unknown if their dots may not be visible.

    They may be out of view: beyond the last visible row the fit extrapolates smoothly, whereas the
    pool gets steeper towards its edge, so that the dots of the next row may lie farther out than
    predicted. Or they may be too faint (`too_faint`).

    Parameters
    ----------
    observed, paths
        The frame's dots, and the ray paths for the surface.
    labels
        Index of each ray's dot or `UNLABELLED`, shape (rows, columns).
    ray_states
        Those of `classify_rays`.
    covariance_of
        Function of the flat indices of rays, shape (m,), that returns the covariance of their
        dots, shape (m, 2, 2), mm².
    """
    lit, certain = ray_states > 0, ray_states.copy()
    labelled = paths.plane_mm[lit.ravel()]
    view = observed.view_with(labelled[np.isfinite(labelled[:, 0])])
    known = np.isfinite(paths.plane_mm[:, 0]).reshape(lit.shape)
    rim = np.flatnonzero(known & (certain <= 0) & widened(lit, 1))
    near = rim[~observed.in_view(paths.plane_mm[rim], NEAR_EDGE_MM, view)]
    if _in_lines(near, ray_states.shape[1]).any():
        sigma_mm = np.sqrt(covariance_of(near)[:, [0, 1], [0, 1]])
        margin = OUT_OF_VIEW_SIGMA * sigma_mm
        beyond = ~observed.in_view(paths.plane_mm[near], margin, view)
        dark, rough = certain.flat[near] < 0, sigma_mm.max(axis=1) > EXTRAPOLATED_MM
        # In an extrapolated row, those that are predicted out of view count as well.
        for some in (beyond & dark, beyond & rough):
            certain.flat[near[some][_in_lines(near[some], ray_states.shape[1])]] = 0
    if observed.over_limit is not None:
        faint, beside = too_faint(observed.over_limit, labels), (certain < 0) & widened(lit, 1)
        if np.count_nonzero(faint & beside) > MOST_FAINT * np.count_nonzero(beside):
            faint[:] = True
        certain[faint & (certain < 0)] = 0
    return certain


def too_faint(over_limit: FloatArray, labels: IntArray) -> BoolArray:
    """Mask of the rays whose dots may be too faint to be found, shape (rows, columns).

    Where dots become fainter towards the rim, as under the profile of the laser's beam or in a
    vignette, the last ones are not found, and their rays seem to have missed the pool: caps were
    measured 30 % too low, by 14 σ. The logarithm of the brightness of the labelled dots is
    therefore fitted by a quadratic of row and column, and extrapolated by one ray: to the place
    beside the nearest labelled ray, on the way to the other.

    Parameters
    ----------
    over_limit
        See `Observation`, shape (n,).
    labels
        Index of each ray's dot or `UNLABELLED`, shape (rows, columns).
    """
    lit, faint = labels != UNLABELLED, np.zeros(labels.shape, bool)
    bright, labelled = over_limit[labels[lit]], np.argwhere(lit).astype(float)
    seen = np.isfinite(bright)
    bright, labelled = bright[seen], labelled[seen]
    if lit.all() or not seen.any() or bright.min() > NEAR_LIMIT:
        return faint
    other = np.argwhere(~lit).astype(float)
    nearest = labelled[scipy.spatial.cKDTree(labelled).query(other)[1]]
    way = other - nearest
    beside = nearest + way / np.abs(way).max(axis=1, keepdims=True)
    middle, radius = labelled.mean(axis=0), float(np.sqrt(2.0) * labelled.std()) + 1.0
    known, asked = (_quadratic((place - middle) / radius) for place in (labelled, beside))
    prior, variance = np.diag([0.0] + 5 * [1 / FADING**2]), SCATTER**2
    for _ in range(SCATTER_ROUNDS):
        normal = known.T @ known / variance + prior
        fitted = np.linalg.solve(normal, known.T @ bright / variance)
        variance = max(float(np.mean((bright - known @ fitted) ** 2)), LEAST_SCATTER**2)
    doubt = variance + np.einsum("ni,ni->n", asked @ np.linalg.inv(normal), asked)
    faint[~lit] = asked @ fitted < FAINT_SIGMA * np.sqrt(doubt)
    return faint


def _quadratic(place: FloatArray) -> FloatArray:
    """Terms of a quadratic at places, shape (n, 2): shape (n, 6)."""
    i, j = place.T
    return np.stack([np.ones(len(i)), i, j, i * i, i * j, j * j], axis=1)


def _in_lines(rays: IntArray, columns: int) -> BoolArray:
    """Mask of the rays, n flat indices, whose row or column holds `LEAST_LINE` or more of them."""
    row, column = np.divmod(rays, columns)
    in_row, in_column = np.bincount(row)[row], np.bincount(column)[column]
    return np.asarray((in_row >= LEAST_LINE) | (in_column >= LEAST_LINE))
