"""A smooth pool surface in splines, and the one that best has given slopes.

The basis holds a dent under the torch and an oscillating pool; the penalty on the change of
curvature keeps it from running away where no ray came back (there it goes on as a quadric).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any

import numpy as np
from scipy.linalg.lapack import dpbtrf, dpbtrs

from labapp.core.values import BoolArray, CannotMeasure, FloatArray, IntArray, freeze

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


@lru_cache(maxsize=64)
def _roughness(nx: int, ny: int, *step_mm: float) -> FloatArray:
    """`SplineBasis.roughness`; kept, as a search lays the same splines again and again."""
    node, weight = np.polynomial.legendre.leggauss(DEGREE + 1)
    power = ((node + 1) / 2)[:, None] ** np.arange(DEGREE + 1)
    x, y = grams = [np.zeros((DEGREE + 1, count, count)) for count in (nx, ny)]
    for gram, step in zip(grams, step_mm, strict=True):
        for order, pieces in enumerate(_PIECES):
            part = power @ (pieces / step**order)
            within = (part * (weight * step / 2)[:, None]).T @ part
            for cell in range(gram.shape[1] - DEGREE):
                own = slice(cell, cell + DEGREE + 1)
                gram[order, own, own] += within
    # Where splines i and i + a along x, j and j + b along y meet; columns together, as LAPACK
    # has them.
    band = np.zeros((nx, ny, DEGREE * (ny + 1) + 1))
    for a in range(DEGREE + 1):
        for b in range(-DEGREE if a else 0, DEGREE + 1):
            along, across = (np.diagonal(gram, k, 1, 2) for gram, k in ((x, a), (y, abs(b))))
            own = slice(max(-b, 0), ny - max(b, 0))
            band[: nx - a, own, a * ny + b] = np.einsum(
                "o,oi,oj->ij", [1.0, 3.0, 3.0, 1.0], along[::-1], across
            )
    band.flags.writeable = False
    return band.reshape(nx * ny, -1).T


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
        """Matrix P of ∫∫ z_xxx² + 3 z_xxy² + 3 z_xyy² + z_yyy² = cᵀPc.

        Its lower band, shape (width + 1, splines), as LAPACK has it.
        """
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
        inside = self._known(x, y)
        cells = self.basis.cells(x[inside], y[inside])
        height = np.full(x.shape, np.nan)
        height[inside] = np.vecdot(cells.values(), self.coefficients[cells.splines])
        return height

    def height_and_gradient(
        self, x_mm: FloatArray, y_mm: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Both at once, in little more time than either takes."""
        x, y = np.asarray(x_mm, float), np.asarray(y_mm, float)
        inside = self._known(x, y)
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

    def _known(self, x_mm: FloatArray, y_mm: FloatArray) -> BoolArray:
        return self.basis.contains(x_mm, y_mm)


class OpenSplineSurface(SplineSurface):
    """The same, which goes on beyond the rectangle as it is at its edge."""

    def _known(self, x_mm: FloatArray, y_mm: FloatArray) -> BoolArray:
        return np.ones(np.shape(x_mm), bool)


@dataclass(frozen=True)
class SlopeFit:
    """The surface that best has given slopes, up to its level.

    Parameters
    ----------
    surface
        The surface, its mean height over the points 0.
    factor
        Cholesky factor of the normal matrix with one spline held, lower band, shape
        (width + 1, splines).
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
        covariance = dpbtrs(self.factor, np.eye(len(ones), order="F"), lower=1, overwrite_b=1)[0]
        # What the held spline seems to know about the level is taken out again.
        held = covariance - np.outer(ones, level @ covariance) - np.outer(covariance @ level, ones)
        return np.asarray(held + (level @ covariance @ level) * np.outer(ones, ones))

    def covariance_of(self, splines: IntArray, parts: FloatArray) -> FloatArray:
        """Covariance of pairs of linear combinations of coefficients, blind to the level.

        Parameters
        ----------
        splines
            Numbers of the 16 splines of each pair, shape (n, 16).
        parts
            What each of these coefficients counts for in either, shape (n, 2, 16); either adds up
            to 0.

        Returns
        -------
        FloatArray
            Shape (n, 2, 2).
        """
        from labapp.core import kernels

        return kernels.covariance_of(self.factor, splines, parts)


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

    Raises
    ------
    CannotMeasure
        ``no-surface`` if the slopes do not settle the surface.
    """
    from labapp.core import kernels

    count = basis.shape[0] * basis.shape[1]
    splines, (value, *slope) = kernels.splines_at(basis.grid, points_mm)
    pull = np.einsum("nas,na->ns", weights @ np.stack(slope, axis=1), slopes)
    target = np.bincount(splines.ravel(), pull.ravel(), count)
    factor = normal_factor(basis, stiffness * basis.roughness, points_mm, weights)
    coefficients = dpbtrs(factor, target, lower=1)[0]
    level = np.bincount(splines.ravel(), value.ravel(), count) / len(points_mm)
    surface = SplineSurface(basis, coefficients - level @ coefficients)
    return SlopeFit(surface, factor, level)


def normal_factor(
    basis: SplineBasis, stiffness: FloatArray, points_mm: FloatArray, weights: FloatArray
) -> FloatArray:
    """Cholesky factor of the normal matrix of slopes at points, lower band, shape (width + 1, p).

    Slopes leave the level open; it is held by one spline in the middle, which moves nothing else.

    Parameters
    ----------
    basis
        The p splines.
    stiffness
        Weight of the roughness times its matrix, lower band, shape (width + 1, p).
    points_mm, weights
        See `fit_slopes`.

    Raises
    ------
    CannotMeasure
        ``no-surface`` if there is none.
    """
    from labapp.core import kernels

    columns, (height, count) = stiffness.flatten(order="F"), stiffness.shape
    kernels.add_gram(basis.grid, points_mm, weights, columns, height - 1)
    band = columns.reshape(count, height).T
    middle = kernels.splines_at(basis.grid, points_mm[len(points_mm) // 2, None])[0]
    band[0, middle[0, 5]] += band[0].mean()
    lower, info = dpbtrf(band, lower=1, overwrite_ab=1)
    if info:
        raise CannotMeasure("no-surface", "no surface has the slopes that the dots ask for")
    return np.asarray(lower)
