"""A smooth pool surface in splines, and the one that best has given slopes.

The basis holds a dent under the torch and an oscillating pool; the penalty on the change of
curvature keeps it from running away where no ray came back (there it goes on as a quadric).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from labapp.core.values import BoolArray, FloatArray, IntArray, freeze

DEGREE = 3

# The four cubic splines over one cell, as polynomials of the place t in it, 0 … 1: row k holds the
# coefficients of tᵏ. The next tables are their derivatives by t.
_CUBICS = np.array([[1, 4, 1, 0], [-3, 0, 3, 0], [3, -6, 3, 0], [-1, 3, -3, 1]]) / 6
_PIECES = [_CUBICS]
for _ in range(DEGREE):
    _PIECES.append(np.vstack([_PIECES[-1][1:] * [[1], [2], [3]], np.zeros((1, 4))]))


@dataclass(frozen=True)
class Cells:
    """The cells of a `SplineBasis` that n points lie in.

    Parameters
    ----------
    splines
        The 4 × 4 splines that are not zero in each, as columns of `SplineBasis.matrix`, x first,
        shape (n, 16).
    power
        Powers 0 … 3 of the place in the cell along x and along y, shape (2, n, 4).
    step_mm
        Size of a cell along x and along y, shape (2,), mm.
    """

    splines: IntArray
    power: FloatArray
    step_mm: FloatArray

    def values(self, dx: int = 0, dy: int = 0) -> FloatArray:
        """Value (or derivative) of those splines, shape (n, 16)."""
        along_x = self.power[0] @ (_PIECES[dx] / self.step_mm[0] ** dx)
        along_y = self.power[1] @ (_PIECES[dy] / self.step_mm[1] ** dy)
        product = along_x[:, :, None] * along_y[:, None, :]
        return np.asarray(product.reshape(-1, (DEGREE + 1) ** 2))

    def value_and_slopes(self) -> FloatArray:
        """Value and derivatives by x and by y of those splines at once, shape (3, n, 16)."""
        side, count = DEGREE + 1, len(self.splines)
        x, y = self.power @ _values_and_slopes(*self.step_mm.tolist())
        product = np.empty((3, count, side, side))
        np.multiply(x[:, :side, None], y[:, None, :side], out=product[0])
        np.multiply(x[:, side:, None], y[:, None, :side], out=product[1])
        np.multiply(x[:, :side, None], y[:, None, side:], out=product[2])
        return product.reshape(3, count, side**2)


@lru_cache(maxsize=16)
def _values_and_slopes(*step_mm: float) -> FloatArray:
    """Pieces of the splines and, beside them, of their derivatives, a cell's size each, (2, 4, 8).

    Kept, as a basis is asked thousands of times.
    """
    pieces = np.stack([np.hstack([_PIECES[0], _PIECES[1] / step]) for step in step_mm])
    pieces.flags.writeable = False
    return pieces


@lru_cache(maxsize=16)
def _roughness(nx: int, ny: int, *step_mm: float) -> FloatArray:
    """`SplineBasis.roughness`; kept, as a search lays the same splines again and again."""
    grams = []
    node, weight = np.polynomial.legendre.leggauss(DEGREE + 1)
    power = ((node + 1) / 2)[:, None] ** np.arange(DEGREE + 1)
    for count, step in zip((nx, ny), step_mm, strict=True):
        gram = np.zeros((DEGREE + 1, count, count))
        for order, pieces in enumerate(_PIECES):
            part = power @ (pieces / step**order)
            within = (part * (weight * step / 2)[:, None]).T @ part
            for cell in range(count - DEGREE):
                own = slice(cell, cell + DEGREE + 1)
                gram[order, own, own] += within
        grams.append(gram)
    x, y = grams
    roughness = (
        np.kron(x[3], y[0])
        + 3 * np.kron(x[2], y[1])
        + 3 * np.kron(x[1], y[2])
        + np.kron(x[0], y[3])
    )
    roughness.flags.writeable = False
    return np.asarray(roughness)


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

    def __reduce__(self) -> tuple[Any, ...]:
        """Leave what is kept of earlier calls behind: it is many times larger."""
        return SplineBasis, (self.x_knots, self.y_knots)

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

    @cached_property
    def low_mm(self) -> FloatArray:
        """Lower corner of the rectangle, shape (2,), mm."""
        return np.array([self.x_knots[DEGREE], self.y_knots[DEGREE]])

    @cached_property
    def high_mm(self) -> FloatArray:
        """Upper corner of the rectangle, shape (2,), mm."""
        return np.array([self.x_knots[-DEGREE - 1], self.y_knots[-DEGREE - 1]])

    @cached_property
    def step_mm(self) -> FloatArray:
        """Distance between knots along x and along y, shape (2,), mm."""
        return np.array(
            [np.ptp(knots) / (len(knots) - 1) for knots in (self.x_knots, self.y_knots)]
        )

    @cached_property
    def grid(self) -> FloatArray:
        """Low and high end, step, mm, and number of cells along x and along y, shape (2, 4)."""
        cells = np.array(self.shape) - DEGREE
        return np.column_stack([self.low_mm, self.high_mm, self.step_mm, cells])

    def cells(self, x_mm: FloatArray, y_mm: FloatArray) -> Cells:
        """Find the cells of points, each shape (n,); the outermost go on beyond the rectangle."""
        nx, ny = self.shape
        place = (np.array([x_mm, y_mm]) - self.low_mm[:, None]) / self.step_mm[:, None]
        last = np.array([[nx - DEGREE - 1], [ny - DEGREE - 1]])
        first = np.minimum(np.maximum(place.astype(np.int64), 0), last)
        power = np.empty((*place.shape, DEGREE + 1))
        power[..., 0] = 1.0
        power[..., 1] = t = place - first
        np.multiply(t, t, out=power[..., 2])
        np.multiply(power[..., 2], t, out=power[..., 3])
        return Cells((first[0] * ny + first[1])[:, None] + self._corner, power, self.step_mm)

    @cached_property
    def _corner(self) -> IntArray:
        """Columns of a cell's splines over that of its first one, shape (16,)."""
        side = np.arange(DEGREE + 1)
        return (side[:, None] * self.shape[1] + side).ravel()

    def matrix(self, x_mm: FloatArray, y_mm: FloatArray, dx: int = 0, dy: int = 0) -> FloatArray:
        """Value (or derivative) of every spline at n points, shape (n, splines)."""
        cells = self.cells(np.asarray(x_mm, float), np.asarray(y_mm, float))
        matrix = np.zeros((len(cells.splines), self.shape[0] * self.shape[1]))
        np.put_along_axis(matrix, cells.splines, cells.values(dx, dy), axis=1)
        return matrix

    def contains(self, x_mm: FloatArray, y_mm: FloatArray) -> BoolArray:
        """Whether points lie in the rectangle, of their shape."""
        (x_low, y_low), (x_high, y_high) = self.low_mm, self.high_mm
        x, y = np.asarray(x_mm), np.asarray(y_mm)
        return np.asarray((x >= x_low) & (x <= x_high) & (y >= y_low) & (y <= y_high))

    @property
    def roughness(self) -> FloatArray:
        """Matrix P of ∫∫ z_xxx² + 3 z_xxy² + 3 z_xyy² + z_yyy² = cᵀPc, shape (splines, splines)."""
        return _roughness(*self.shape, *self.step_mm)


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

    def height(self, x_mm: FloatArray, y_mm: FloatArray) -> FloatArray:
        """Height z at (x, y), arrays of one shape, mm."""
        x, y = np.asarray(x_mm, float), np.asarray(y_mm, float)
        inside = self.basis.contains(x, y)
        cells = self.basis.cells(x[inside], y[inside])
        height = np.full(x.shape, np.nan)
        height[inside] = np.vecdot(cells.values(), self.coefficients[cells.splines])
        return height

    def height_and_gradient(
        self, x_mm: FloatArray, y_mm: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Both at once, in little more time than either takes."""
        x, y = np.asarray(x_mm, float), np.asarray(y_mm, float)
        inside = self.basis.contains(x, y)
        cells = self.basis.cells(x[inside], y[inside])
        every = np.full((*x.shape, 3), np.nan)
        every[inside] = np.vecdot(cells.value_and_slopes(), self.coefficients[cells.splines]).T
        return every[..., 0], every[..., 1:]

    def gradient(self, x_mm: FloatArray, y_mm: FloatArray) -> FloatArray:
        """(∂z/∂x, ∂z/∂y) at (x, y), shape (…, 2)."""
        return self.height_and_gradient(x_mm, y_mm)[1]

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
    factor
        Upper triangular factor U, UᵀU the normal matrix, shape (splines, splines), mm⁻².
    level
        Mean value of each spline over the points, shape (splines,).
    """

    surface: SplineSurface
    factor: FloatArray
    level: FloatArray

    @cached_property
    def covariance(self) -> FloatArray:
        """Covariance of the coefficients, the level left out, shape (splines, splines), mm²."""
        level, ones = self.level, np.ones(len(self.level))
        covariance = cho_solve((self.factor, False), np.eye(len(ones)), check_finite=False)
        # What the held level seems to know about itself is taken out again.
        held = covariance - np.outer(ones, level @ covariance) - np.outer(covariance @ level, ones)
        return np.asarray(held + (level @ covariance @ level) * np.outer(ones, ones))


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
        Where the slopes are known, (x, y), shape (n, 2), mm; held to the basis's rectangle.
    slopes
        (∂z/∂x, ∂z/∂y) there, shape (n, 2).
    weights
        Inverse of each slope's covariance, shape (n, 2, 2).
    stiffness
        Weight of the roughness, mm⁶: the area over which the third derivatives go together, over
        their expected variance.
    """
    from labapp.core import kernels

    count = basis.shape[0] * basis.shape[1]
    splines, (value, *slope) = kernels.splines_at(basis.grid, points_mm)
    pull = np.einsum("nas,na->ns", weights @ np.stack(slope, axis=1), slopes)
    target = np.bincount(splines.ravel(), pull.ravel(), count)
    normal = stiffness * basis.roughness
    kernels.add_gram(basis.grid, points_mm, weights, normal.reshape(-1), count)
    # Slopes say nothing of the level: hold the mean height at 0, as firmly as the slopes hold.
    level = np.bincount(splines.ravel(), value.ravel(), count) / len(points_mm)
    scale = np.trace(normal) / count
    normal += scale * np.outer(level, level)
    normal[np.diag_indices(count)] += 1e-11 * scale
    factor, _ = cho_factor(normal)
    coefficients = cho_solve((factor, False), target, check_finite=False)
    surface = SplineSurface(basis, coefficients - level @ coefficients)
    return SlopeFit(surface, factor, level)
