"""A smooth pool surface in splines, and the one that best has given slopes.

The basis holds a dent under the torch and an oscillating pool; the penalty on the change of
curvature keeps it from running away where no ray came back (there it goes on as a quadric).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.interpolate import BSpline
from scipy.linalg import cho_factor, cho_solve

from labapp.core.values import BoolArray, FloatArray, freeze

DEGREE = 3


@dataclass(frozen=True)
class SplineBasis:
    """Tensor product of uniform cubic B-splines over a rectangle.

    Parameters
    ----------
    x_knots, y_knots
        Knot vectors with `DEGREE` extra knots beyond each end of the rectangle, mm.
    """

    x_knots: FloatArray
    y_knots: FloatArray

    def __post_init__(self) -> None:
        freeze(self)

    @classmethod
    def over(cls, low_mm: FloatArray, high_mm: FloatArray, knot_mm: float) -> SplineBasis:
        """Build the basis on the rectangle from ``low_mm`` to ``high_mm``, each shape (2,)."""
        knots = []
        for low, high in zip(low_mm, high_mm, strict=True):
            cells = max(2, int(np.ceil((high - low) / knot_mm)))
            step = (high - low) / cells
            knots.append(low + step * np.arange(-DEGREE, cells + DEGREE + 1))
        return cls(*knots)

    @property
    def shape(self) -> tuple[int, int]:
        """Number of splines along x and along y."""
        return len(self.x_knots) - DEGREE - 1, len(self.y_knots) - DEGREE - 1

    @property
    def low_mm(self) -> FloatArray:
        """Lower corner of the rectangle, shape (2,), mm."""
        return np.array([self.x_knots[DEGREE], self.y_knots[DEGREE]])

    @property
    def high_mm(self) -> FloatArray:
        """Upper corner of the rectangle, shape (2,), mm."""
        return np.array([self.x_knots[-DEGREE - 1], self.y_knots[-DEGREE - 1]])

    @cached_property
    def _splines(self) -> tuple[BSpline, BSpline]:
        nx, ny = self.shape
        return (
            BSpline(self.x_knots, np.eye(nx), DEGREE),
            BSpline(self.y_knots, np.eye(ny), DEGREE),
        )

    def matrix(self, x_mm: FloatArray, y_mm: FloatArray, dx: int = 0, dy: int = 0) -> FloatArray:
        """Value (or derivative) of every spline at n points, shape (n, splines)."""
        along_x, along_y = self._splines
        product = along_x(x_mm, dx)[:, :, None] * along_y(y_mm, dy)[:, None, :]
        return np.asarray(product.reshape(len(product), product.shape[1] * product.shape[2]))

    def contains(self, x_mm: FloatArray, y_mm: FloatArray) -> BoolArray:
        """Whether points lie in the rectangle, of their shape."""
        point = np.stack([x_mm, y_mm], axis=-1)
        return np.asarray(((point >= self.low_mm) & (point <= self.high_mm)).all(axis=-1))

    @cached_property
    def roughness(self) -> FloatArray:
        """Matrix P of ∫∫ z_xxx² + 3 z_xxy² + 3 z_xyy² + z_yyy² = cᵀPc, shape (splines, splines)."""
        grams = []
        for spline, knots in zip(self._splines, (self.x_knots, self.y_knots), strict=True):
            node, weight = np.polynomial.legendre.leggauss(DEGREE + 1)
            start, step = knots[DEGREE : -DEGREE - 1], knots[1] - knots[0]
            at = (start[:, None] + (node + 1) / 2 * step).ravel()
            each = np.tile(weight * step / 2, len(start))
            parts = [spline(at, order) for order in range(DEGREE + 1)]
            grams.append([(part * each[:, None]).T @ part for part in parts])
        x, y = grams
        return np.asarray(
            np.kron(x[3], y[0])
            + 3 * np.kron(x[2], y[1])
            + 3 * np.kron(x[1], y[2])
            + np.kron(x[0], y[3])
        )


@dataclass(frozen=True)
class SplineSurface:
    """z = f(x, y) in a `SplineBasis`; NaN outside its rectangle.

    Parameters
    ----------
    basis
        The splines.
    coefficients
        Shape (splines,), mm.
    """

    basis: SplineBasis
    coefficients: FloatArray

    def __post_init__(self) -> None:
        freeze(self)

    def _evaluate(self, x_mm: FloatArray, y_mm: FloatArray, dx: int, dy: int) -> FloatArray:
        x, y = np.asarray(x_mm, float), np.asarray(y_mm, float)
        value = np.full(x.shape, np.nan)
        inside = self.basis.contains(x, y)
        value[inside] = self.basis.matrix(x[inside], y[inside], dx, dy) @ self.coefficients
        return value

    def height(self, x_mm: FloatArray, y_mm: FloatArray) -> FloatArray:
        """Height z at (x, y), arrays of one shape, mm."""
        return self._evaluate(x_mm, y_mm, 0, 0)

    def gradient(self, x_mm: FloatArray, y_mm: FloatArray) -> FloatArray:
        """(∂z/∂x, ∂z/∂y) at (x, y), shape (…, 2)."""
        return np.stack(
            [self._evaluate(x_mm, y_mm, 1, 0), self._evaluate(x_mm, y_mm, 0, 1)], axis=-1
        )

    def raised(self, by_mm: float) -> SplineSurface:
        """Shift the whole surface up."""
        return SplineSurface(self.basis, self.coefficients + by_mm)  # the splines add up to 1


@dataclass(frozen=True)
class SlopeFit:
    """The surface that best has given slopes, up to its level.

    Parameters
    ----------
    surface
        The surface, its mean height over the points 0.
    covariance
        Of its coefficients, the level left out, shape (splines, splines), mm².
    """

    surface: SplineSurface
    covariance: FloatArray


def fit_slopes(
    basis: SplineBasis,
    points_mm: FloatArray,
    slopes: FloatArray,
    weights: FloatArray,
    stiffness: float,
) -> SlopeFit:
    """Least-squares surface through slopes.

    Parameters
    ----------
    basis
        Splines to build it of.
    points_mm
        Where the slopes are known, (x, y), shape (n, 2), mm.
    slopes
        (∂z/∂x, ∂z/∂y) there, shape (n, 2).
    weights
        Inverse of each slope's covariance, shape (n, 2, 2).
    stiffness
        Weight of the roughness, mm⁶: the area over which the third derivatives go together, over
        their expected variance.
    """
    x, y = points_mm.T
    by = np.stack([basis.matrix(x, y, 1, 0), basis.matrix(x, y, 0, 1)], axis=1)
    factor = np.linalg.cholesky(weights)
    white = np.einsum("nba,nbs->nas", factor, by).reshape(-1, by.shape[-1])
    target = np.einsum("nba,nb->na", factor, slopes).ravel()
    normal = white.T @ white + stiffness * basis.roughness
    # Slopes say nothing of the level: hold the mean height at 0, as firmly as the slopes hold.
    level = basis.matrix(x, y).mean(axis=0)
    scale = np.trace(normal) / len(normal)
    normal += scale * np.outer(level, level) + 1e-11 * scale * np.eye(len(normal))
    solver = cho_factor(normal)
    coefficients = cho_solve(solver, white.T @ target)
    covariance = cho_solve(solver, np.eye(len(normal)))
    # What the held level seems to know about itself is taken out again.
    ones = np.ones(len(normal))
    held = covariance - np.outer(ones, level @ covariance) - np.outer(covariance @ level, ones)
    covariance = held + (level @ covariance @ level) * np.outer(ones, ones)
    return SlopeFit(SplineSurface(basis, coefficients - level @ coefficients), covariance)
