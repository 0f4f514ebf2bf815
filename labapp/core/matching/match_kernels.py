"""Inner loops of matching dots with rays, compiled (docs/adr/0018)."""

from __future__ import annotations

import numpy as np
from numba import types

from labapp.core.compiled import compiled
from labapp.core.values import BoolArray, FloatArray, IntArray

_f2, _f3 = (types.Array(types.float64, n, "A", readonly=True) for n in (2, 3))


@compiled(_f2, _f3, _f2, _f3)
def pair_deviances(
    places: FloatArray, covariance: FloatArray, predicted: FloatArray, uncertain: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """How far n places are from m predictions, and how unlikely that makes each pair.

    Places and predictions have shapes (n, 2) and (m, 2), their covariances (n, 2, 2) and (m, 2, 2).

    Returns
    -------
    distance, deviance
        Squared distances in σ², and −2 log likelihoods but for a constant, both of shape (n, m).
    """
    distance = np.empty((len(places), len(predicted)))
    deviance = np.empty((len(places), len(predicted)))
    for n in range(len(places)):
        for m in range(len(predicted)):
            x, y = places[n, 0] - predicted[m, 0], places[n, 1] - predicted[m, 1]
            xx = covariance[n, 0, 0] + uncertain[m, 0, 0]
            xy = covariance[n, 0, 1] + uncertain[m, 0, 1]
            yy = covariance[n, 1, 1] + uncertain[m, 1, 1]
            area = xx * yy - xy * xy
            distance[n, m] = (yy * x * x - 2.0 * xy * x * y + xx * y * y) / area
            deviance[n, m] = area
    deviance[:] = distance + np.log(deviance)
    return distance, deviance


@compiled(_f2, _f3, _f3, types.float64, types.float64)
def left_out(
    residual: FloatArray, dot: FloatArray, computed: FloatArray, unsettled: float, most: float
) -> tuple[FloatArray, FloatArray]:
    """Residuals of n dots to fits without each of them, and the covariance of these predictions.

    Residuals to the fit with all have shape (n, 2), covariances of dots and of what the fit
    computes for them (n, 2, 2). Residuals are off by ``unsettled``, a standard deviation, where the
    fit has not converged. A dot draws the fit to itself by no larger a share than ``most``.
    """
    off, spread = np.empty((len(residual), 2)), np.empty((len(residual), 2, 2))
    for n in range(len(residual)):
        a, b, c = dot[n, 0, 0], dot[n, 0, 1], dot[n, 1, 1]
        share = most
        for _ in range(100):  # what the fit computes may be of a round before
            xx, xy = a - share * computed[n, 0, 0], b - share * computed[n, 0, 1]
            yy = c - share * computed[n, 1, 1]
            area = xx * yy - xy * xy
            if xx > 0.0 and area > (1.0 - most) ** 2 * (a * c - b * b):
                break
            share *= 0.98
        # What the dot's covariance is times the inverse of that of its residual.
        p, q = (a * yy - b * xy) / area, (b * xx - a * xy) / area
        r, s = (b * yy - c * xy) / area, (c * xx - b * xy) / area
        x, y = residual[n, 0], residual[n, 1]
        off[n, 0], off[n, 1] = p * x + q * y, r * x + s * y
        rest = unsettled * unsettled
        spread[n, 0, 0] = p * a + q * b - a + rest * (p * p + q * q)
        spread[n, 1, 1] = r * b + s * c - c + rest * (r * r + s * s)
        spread[n, 0, 1] = spread[n, 1, 0] = p * b + q * c - b + rest * (p * r + q * s)
    return off, spread


@compiled(_f2, _f2, _f2, _f2, _f2)
def within_view(
    places: FloatArray,
    margin: FloatArray,
    to_image: FloatArray,
    plane: FloatArray,
    image: FloatArray,
) -> BoolArray:
    """Which of n places on the plane are in view, also where they are off by margins.

    Places and margins along either axis have shape (n, 2), mm; the homography from there to the
    image shape (3, 3); the least and the largest places and pixels in view shape (2, 2), the least
    first.
    """
    made = np.ones(len(places), np.bool_)
    for k in range(len(places)):
        for corner in range(4):
            x = places[k, 0] + (1.0 if corner < 2 else -1.0) * margin[k, 0]
            z = places[k, 1] + (1.0 if corner % 2 else -1.0) * margin[k, 1]
            w = to_image[2, 0] * x + to_image[2, 1] * z + to_image[2, 2]
            u = (to_image[0, 0] * x + to_image[0, 1] * z + to_image[0, 2]) / w
            v = (to_image[1, 0] * x + to_image[1, 1] * z + to_image[1, 2]) / w
            made[k] &= plane[0, 0] < x < plane[1, 0] and plane[0, 1] < z < plane[1, 1]
            made[k] &= image[0, 0] < u < image[1, 0] and image[0, 1] < v < image[1, 1]
    return made


@compiled(types.Array(types.boolean, 2, "A", readonly=True))
def amid(lit: BoolArray) -> BoolArray:
    """Rays between lit ones in their row or in their column, shape (rows, columns)."""
    rows, columns = lit.shape
    made = np.zeros((rows, columns), np.bool_)
    for i in range(rows):
        some = np.flatnonzero(lit[i])
        if len(some):
            made[i, some[0] : some[-1] + 1] = True
    for j in range(columns):
        some = np.flatnonzero(lit[:, j])
        if len(some):
            made[some[0] : some[-1] + 1, j] = True
    return made


@compiled(_f2)
def two_least(values: FloatArray) -> tuple[IntArray, FloatArray, IntArray, FloatArray]:
    """Where each row's least value is and its second least; the same of each column.

    Values have shape (n, m), m > 0; where there is no second it is infinite.
    """
    rows, columns = values.shape
    column, next_in_row = np.zeros(rows, np.int64), np.full(rows, np.inf)
    row, next_in_column = np.zeros(columns, np.int64), np.full(columns, np.inf)
    in_row, in_column = np.full(rows, np.inf), np.full(columns, np.inf)
    for n in range(rows):
        for m in range(columns):
            value = values[n, m]
            if value < in_row[n]:
                in_row[n], next_in_row[n], column[n] = value, in_row[n], m
            elif value < next_in_row[n]:
                next_in_row[n] = value
            if value < in_column[m]:
                in_column[m], next_in_column[m], row[m] = value, in_column[m], n
            elif value < next_in_column[m]:
                next_in_column[m] = value
    return column, next_in_row, row, next_in_column


@compiled(_f2)
def medians_around(values: FloatArray) -> FloatArray:
    """Median of those within two rows and columns of each value, without it; NaN stands for none.

    Values have shape (rows, columns), medians the same: NaN where there is no value, too.
    """
    rows, columns = values.shape
    medians, around = np.full((rows, columns), np.nan), np.empty(24)
    for i in range(rows):
        for j in range(columns):
            if np.isnan(values[i, j]):
                continue
            count = 0
            for k in range(max(i - 2, 0), min(i + 3, rows)):
                for m in range(max(j - 2, 0), min(j + 3, columns)):
                    if (k != i or m != j) and not np.isnan(values[k, m]):
                        around[count] = values[k, m]
                        count += 1
            if count:
                medians[i, j] = np.median(around[:count])
    return medians
