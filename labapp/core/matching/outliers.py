"""Labels that a fitted surface does not support, whichever chain gave them."""

from __future__ import annotations

import cv2
import numpy as np

from labapp.core.matching.observation import UNLABELLED, Observation
from labapp.core.values import FloatArray, IntArray, median

WIDE = 1.45
"""A dot so many times as wide as the median of those around it is two in one. Of 15,000 dots of
rendered frames 17 were as wide: 13 of them were more than 1 px, four at most 0.8 px, off."""

OUTLIER_SIGMA, MEDIAN_SIGMA = 6.0, 1.18
"""A residual of so many of its own σ is an outlier's; and the median of the right ones, in σ."""

LEAST_FREE = 0.01
"""Where less than this share of a dot's uncertainty, as an area, is left to its residual, the
surface goes through any dot, and the residual does not tell."""


def unsupported(
    observed: Observation,
    labels: IntArray,
    residual_mm: FloatArray,
    covariance_mm2: FloatArray,
    floor_mm: float,
) -> IntArray:
    """Return the labelled dots that are false ones in the place of a ray's own, or merged with it.

    Either the dot is wider than those around it, or its studentised residual is an outlier's, and
    larger than its neighbours', which a false dot takes along. In units of σ these residuals are
    those to the surface without the dot. Where all are larger than what is known of dots explains,
    σ is as well.

    Parameters
    ----------
    observed
        The dots.
    labels
        Index of each ray's dot or `UNLABELLED`, shape (rows, columns).
    residual_mm, covariance_mm2
        Computed minus captured dot of the n labelled rays, row by row, shape (n, 2), mm, and the
        covariance of the computed one, shape (n, 2, 2).
    floor_mm
        Least uncertainty of a dot in the fit (`FitSettings`), mm.

    Returns
    -------
    IntArray
        Indices of dots.
    """
    from labapp.core.matching import match_kernels

    lit = labels != UNLABELLED
    dot = labels[lit]
    size, off = np.full(lit.shape, np.nan), np.zeros(lit.shape)
    size[lit] = observed.size_mm[dot]
    off[lit] = _studentised(
        residual_mm, observed.covariance_mm2[dot] + floor_mm**2 * np.eye(2), covariance_mm2
    )
    beside = cv2.dilate(off, np.array([[1, 1, 1], [1, 0, 1], [1, 1, 1]], np.uint8))
    sigma = max(1.0, median(off[lit]) / MEDIAN_SIGMA)
    wide = size > WIDE * match_kernels.medians_around(size)
    return np.asarray(labels[lit & (wide | ((off > OUTLIER_SIGMA * sigma) & (off > beside)))])


def _studentised(residual: FloatArray, dot: FloatArray, computed: FloatArray) -> FloatArray:
    """Length of residuals, shape (n, 2), in their own σ, from both covariances, shape (n, 2, 2).

    A dot draws the surface: what the surface's covariance takes of the dot's is not in a residual.
    """
    (x, y), rest = residual.T, dot - computed
    xx, xy, yy = rest[:, 0, 0], rest[:, 0, 1], rest[:, 1, 1]
    area = xx * yy - xy * xy
    known = dot[:, 0, 0] * dot[:, 1, 1] - dot[:, 0, 1] ** 2
    free = (xx > 0.0) & (area > LEAST_FREE * known)
    chi2 = (yy * x * x - 2.0 * xy * x * y + xx * y * y) / np.where(free, area, np.inf)
    return np.asarray(np.sqrt(chi2))
