"""Smooth pool surface represented by splines.

The basis can represent a dent under the torch and an oscillating pool. The penalty on the change of
curvature makes the surface continue as a quadric where no ray came back.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache, cached_property, lru_cache
from typing import Any

import numpy as np
import scipy

from labapp.core.values import BoolArray, FloatArray, IntArray, ReadOnlyArrays

DEGREE = 3

AT_ONCE = 1000
"""Points at which a surface is evaluated at once: their arrays fit in the processor's cache."""

# The four cubic splines over one cell, as polynomials of the local coordinate t, 0 … 1: row k holds
# the coefficients of tᵏ. The next tables are their derivatives by t.
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
        Powers 0 … 3 of the local coordinate along x and along y, shape (2, n, 4).
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
    """Polynomials of the splines and of their derivatives for each cell size, shape (2, 4, 8)."""
    pieces = np.stack([np.hstack([_PIECES[0], _PIECES[1] / step]) for step in step_mm])
    pieces.flags.writeable = False
    return pieces


@cache
def cell_products() -> FloatArray:
    """Integrals over a cell of size 1 of products of its four splines, and of their derivatives.

    For the orders 0 … 3 of the derivatives, shape (4, 4, 4).
    """
    node, weight = np.polynomial.legendre.leggauss(DEGREE + 1)
    parts = (((node + 1) / 2)[:, None] ** np.arange(DEGREE + 1)) @ np.stack(_PIECES)
    products = np.swapaxes(parts * (weight / 2)[:, None], 1, 2) @ parts
    products.flags.writeable = False
    return np.asarray(products)


@lru_cache(maxsize=16)
def _roughness_matrix(*grid: tuple[float, ...]) -> FloatArray:
    """`SplineBasis.roughness_matrix`; not kept by the basis, of which a hard frame has hundreds."""
    from labapp.core.surface.kernels import solver_kernels

    band = solver_kernels.roughness_band(cell_products(), np.array(grid))
    band.flags.writeable = False
    return np.asarray(band)


@dataclass(frozen=True)
class SplineBasis(ReadOnlyArrays):
    """Tensor product of uniform cubic B-splines over a rectangle.

    Parameters
    ----------
    x_knots, y_knots
        Knot vectors with `DEGREE` extra knots beyond each end of the rectangle, mm.
    """

    x_knots: FloatArray
    y_knots: FloatArray

    def __reduce__(self) -> tuple[Any, ...]:
        """Exclude cached results from pickling, as they are many times larger."""
        return SplineBasis, (self.x_knots, self.y_knots)

    @classmethod
    def over(cls, low_mm: FloatArray, high_mm: FloatArray, knot_mm: float) -> SplineBasis:
        """Build the basis on the rectangle from ``low_mm`` to ``high_mm``, each shape (2,)."""
        ends = zip(low_mm.tolist(), high_mm.tolist(), strict=True)
        return _basis_over(*ends, knot_mm)

    @cached_property
    def shape(self) -> tuple[int, int]:
        """Number of splines along x and along y."""
        return len(self.x_knots) - DEGREE - 1, len(self.y_knots) - DEGREE - 1

    @property
    def count(self) -> int:
        """Number of splines."""
        return self.shape[0] * self.shape[1]

    @property
    def low_mm(self) -> FloatArray:
        """Lower corner of the rectangle, shape (2,), mm."""
        return self.grid[:, 0]

    @property
    def high_mm(self) -> FloatArray:
        """Upper corner of the rectangle, shape (2,), mm."""
        return self.grid[:, 1]

    @property
    def step_mm(self) -> FloatArray:
        """Distance between knots along x and along y, shape (2,), mm."""
        return self.grid[:, 2]

    @cached_property
    def grid(self) -> FloatArray:
        """Low and high end, step, mm, and number of cells along x and along y, shape (2, 4)."""
        axes = self.x_knots.tolist(), self.y_knots.tolist()
        ends = [(axis[DEGREE], axis[-DEGREE - 1]) for axis in axes]
        steps = [(axis[-1] - axis[0]) / (len(axis) - 1) for axis in axes]
        cells = [len(axis) - 2 * DEGREE - 1 for axis in axes]
        return np.array([(*end, *by) for end, *by in zip(ends, steps, cells, strict=True)])

    def cells(self, x_mm: FloatArray, y_mm: FloatArray) -> Cells:
        """Find the cells of points, each shape (n,); the outermost extend beyond the rectangle."""
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
        """Columns of a cell's splines relative to that of its first one, shape (16,)."""
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
    def roughness_matrix(self) -> FloatArray:
        """Matrix P of ∫∫ z_xxx² + 3 z_xxy² + 3 z_xyy² + z_yyy² = cᵀPc, read-only.

        Lower band, shape (width + 1, splines), in LAPACK's storage.
        """
        return _roughness_matrix(*map(tuple, self.grid.tolist()))

    def roughness_products(self, coefficients: FloatArray) -> FloatArray:
        """Products Pc of the matrix with coefficients, shape (splines,) or (splines, m)."""
        band = self.roughness_matrix
        columns = coefficients.reshape(self.count, -1).T
        products = [
            scipy.linalg.blas.dsbmv(len(band) - 1, 1.0, band, one, lower=1) for one in columns
        ]
        return np.reshape(np.transpose(products), coefficients.shape)


@lru_cache(maxsize=64)
def _basis_over(
    along_x: tuple[float, float], along_y: tuple[float, float], knot_mm: float
) -> SplineBasis:
    """`SplineBasis.over`; kept, as many fits of a frame have the same outermost rays."""
    knots: list[FloatArray] = []
    for low, high in (along_x, along_y):
        cells = max(2, math.ceil((high - low) / knot_mm))
        step = (high - low) / cells
        knots.append(low + step * np.arange(-DEGREE, cells + DEGREE + 1.0))
    return SplineBasis(*knots)


@dataclass(frozen=True)
class SplineSurface(ReadOnlyArrays):
    """z = f(x, y) in a `SplineBasis`; NaN outside its rectangle.

    Parameters
    ----------
    coefficients
        Shape (splines,), mm.
    """

    basis: SplineBasis
    coefficients: FloatArray

    def height(self, x_mm: FloatArray, y_mm: FloatArray) -> FloatArray:
        """Height z at (x, y), arrays of one shape, mm."""
        x, y = np.asarray(x_mm, float), np.asarray(y_mm, float)
        height, inside = np.full(x.shape, np.nan), self.basis.contains(x, y)
        x, y = x[inside], y[inside]
        found = np.empty(len(x))
        for first in range(0, len(x), AT_ONCE):
            some = slice(first, first + AT_ONCE)
            cells = self.basis.cells(x[some], y[some])
            found[some] = np.vecdot(cells.values(), self.coefficients[cells.splines])
        height[inside] = found
        return height

    def height_and_gradient(
        self, x_mm: FloatArray, y_mm: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Height and gradient at once, in little more time than either alone."""
        x, y = np.asarray(x_mm, float), np.asarray(y_mm, float)
        inside = self.basis.contains(x, y)
        cells = self.basis.cells(x[inside], y[inside])
        every = np.full((*x.shape, 3), np.nan)
        every[inside] = np.vecdot(cells.value_and_slopes(), self.coefficients[cells.splines]).T
        return every[..., 0], every[..., 1:]

    def gradient(self, x_mm: FloatArray, y_mm: FloatArray) -> FloatArray:
        """(∂z/∂x, ∂z/∂y) at (x, y), shape (…, 2)."""
        return self.height_and_gradient(x_mm, y_mm)[1]

    def roughness(self) -> float:
        """∫∫ z_xxx² + 3 z_xxy² + 3 z_xyy² + z_yyy² over the rectangle, mm⁻²."""
        return float(self.coefficients @ self.basis.roughness_products(self.coefficients))
