"""Static maps from filtered features to penetration: linear function and Gaussian process.

They map standardised regressors to penetration minus its mean.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy import linalg

from labapp.core.values import FloatArray, IntArray, ReadOnlyArrays

MOST_POINTS, SEARCHED_POINTS = 600, 200
"""Largest numbers of sections of a Gaussian process: kept, and used to fit its parameters."""


@dataclass(frozen=True)
class LinearMap(ReadOnlyArrays):
    """B(q) and c: weights, the constant last, shape (d + 1,), and their covariance matrix."""

    weights: FloatArray
    covariance: FloatArray

    def evaluate(self, x: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return value, variance and gradient at ``x``, shapes (n,), (n,), (n, d)."""
        columns = np.column_stack([x, np.ones(len(x))])
        variance = np.einsum("ni,ij,nj->n", columns, self.covariance, columns)
        return columns @ self.weights, variance, np.tile(self.weights[:-1], (len(x), 1))


@dataclass(frozen=True)
class GaussianMap(ReadOnlyArrays):
    """A Gaussian process conditioned on m sections.

    Parameters
    ----------
    points, values, variances
        Regressors, shape (m, d); penetration minus its mean, mm, and the variance of each, mm²,
        shape (m,).
    lengths, signal
        ℓ, shape (d,), and σ², mm².
    """

    points: FloatArray
    values: FloatArray
    variances: FloatArray
    lengths: FloatArray
    signal: float

    def covariance(self, x: FloatArray) -> FloatArray:
        """Covariance of the process at x with that at the points, shape (n, m), mm²."""
        a, b = x / self.lengths, self.points / self.lengths
        square = (a**2).sum(1)[:, None] + (b**2).sum(1) - 2 * a @ b.T
        return np.asarray(self.signal * np.exp(-np.maximum(square, 0) / 2))

    @cached_property
    def factor(self) -> FloatArray:
        """Lower Cholesky factor of the covariance of the values, shape (m, m)."""
        covariance = self.covariance(self.points) + np.diag(self.variances)
        return np.asarray(linalg.cholesky(covariance, lower=True))

    @cached_property
    def weights(self) -> FloatArray:
        """Weight of each point in the mean, shape (m,)."""
        return np.asarray(linalg.cho_solve((self.factor, True), self.values))

    def evaluate(self, x: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """As `LinearMap.evaluate`."""
        cross = self.covariance(x)
        part = linalg.solve_triangular(self.factor, cross.T, lower=True)
        weighted = cross * self.weights
        gradient = (weighted @ self.points - weighted.sum(1)[:, None] * x) / self.lengths**2
        variance = np.maximum(self.signal - (part**2).sum(axis=0), 0.0)
        return weighted.sum(axis=1), variance, gradient


@dataclass(frozen=True)
class Sections:
    """Sections of all welds.

    Parameters
    ----------
    x, noise, level
        Regressors and the parts of their standard uncertainty, shape (n, d).
    y, y_sigma
        Measured penetration and its standard uncertainty, shape (n,), mm.
    """

    x: FloatArray
    noise: FloatArray
    level: FloatArray
    y: FloatArray
    y_sigma: FloatArray


def fit_linear(rows: Sections) -> tuple[LinearMap, float]:
    """Fit weights by least squares; also return the variance not due to sections and features."""
    columns = np.column_stack([rows.x, np.ones(len(rows.y))])
    inverse = np.linalg.pinv(columns.T @ columns)
    weights = inverse @ columns.T @ rows.y
    residual = rows.y - columns @ weights
    variance = float(residual @ residual) / max(len(rows.y) - len(weights), 1)
    known = rows.y_sigma**2 + (rows.noise**2 + rows.level**2) @ weights[:-1] ** 2
    return LinearMap(weights, inverse * variance), max(variance - float(known.mean()), 0.0)


def fit_gaussian(rows: Sections, like: LinearMap | GaussianMap | None) -> tuple[GaussianMap, float]:
    """Fit a Gaussian process by maximum likelihood; also return the unexplained variance, mm²."""
    from sklearn.gaussian_process import GaussianProcessRegressor
    from sklearn.gaussian_process.kernels import RBF, ConstantKernel, WhiteKernel

    size = max(float(rows.y.var()), 1e-12)
    lengths = like.lengths if isinstance(like, GaussianMap) else np.full(rows.x.shape[1], 2.0)
    kernel = ConstantKernel(1.0, (1e-2, 1e3)) * RBF(lengths, (0.1, 100.0))
    kernel += WhiteKernel(0.05, (1e-6, 2.0))
    searched, kept = (_spread(len(rows.y), most) for most in (SEARCHED_POINTS, MOST_POINTS))
    variances = rows.y_sigma**2
    for _ in range(2):  # first without the features' ±, then with it, using the gradients found
        regressor = GaussianProcessRegressor(kernel, alpha=variances[searched] / size + 1e-8)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # a parameter at its bound
            regressor.fit(rows.x[searched], rows.y[searched] / np.sqrt(size))
        kernel = regressor.kernel_
        white = float(kernel.k2.noise_level) * size
        found = GaussianMap(
            rows.x[kept],
            rows.y[kept],
            variances[kept] + white + 1e-8 * size,
            np.atleast_1d(kernel.k1.k2.length_scale),
            float(kernel.k1.k1.constant_value) * size,
        )
        gradient = found.evaluate(rows.x)[2]
        by_features = (gradient**2 * (rows.noise**2 + rows.level**2)).sum(axis=1)
        variances = rows.y_sigma**2 + by_features
    return found, white


def _spread(count: int, most: int) -> IntArray:
    """At most ``most`` evenly spaced integers below ``count``."""
    return np.unique(np.linspace(0, count - 1, min(count, most)).round().astype(int))
