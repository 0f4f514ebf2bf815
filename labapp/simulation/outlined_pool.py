"""A pool of any shape: z = f(x, y) within a closed polygon, from a function or a height map."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from matplotlib.path import Path as Polygon
from scipy.interpolate import RBFInterpolator, RectBivariateSpline
from scipy.ndimage import binary_dilation, distance_transform_edt

from labapp.core.values import BoolArray, FloatArray, ReadOnlyArrays
from labapp.simulation.pools import PoolSize, size_of

STEP = 1e-4
"""Step of the finite differences for a gradient, as a fraction of the pool's longer side."""

MARGIN = 3
"""Number of extrapolated nodes beyond the known ones; the spline does not reach farther."""

NEIGHBOURS = 24
"""Number of known nodes from which a node beyond them is extrapolated."""

Function = Callable[[FloatArray, FloatArray], FloatArray]


@dataclass(frozen=True)
class OutlinedPool(ReadOnlyArrays):
    """A pool given by any function of (x, y) within any closed polygon.

    Raises
    ------
    ValueError
        If the outline has fewer than three corners or no area.
    """

    function: Function
    """z at (x, y), arrays of one shape, mm; also defined slightly beyond the outline."""
    outline_mm: FloatArray
    """Corners of the boundary in order, shape (n, 2), mm."""
    slope: Function | None = None
    """(∂z/∂x, ∂z/∂y) at (x, y), shape (…, 2). None: fourth-order central differences of the
    function.
    """

    def __post_init__(self) -> None:
        super().__post_init__()
        x, y = np.asarray(self.outline_mm, float).reshape(-1, 2).T
        area = abs(np.sum(x * np.roll(y, -1) - y * np.roll(x, -1))) / 2
        if len(x) < 3 or not area > 0:
            raise ValueError("an outline requires at least three corners and an area")

    @cached_property
    def _polygon(self) -> Polygon:
        return Polygon(np.concatenate([self.outline_mm, self.outline_mm[:1]]), closed=True)

    @property
    def _extent(self) -> FloatArray:
        return np.asarray(np.ptp(self.outline_mm, axis=0))

    def inside(self, x_mm: FloatArray, y_mm: FloatArray) -> BoolArray:
        """Whether (x, y) is within the boundary."""
        x, y = np.broadcast_arrays(x_mm, y_mm)
        points = np.nan_to_num(np.stack([x.ravel(), y.ravel()], axis=-1), nan=np.inf)
        return np.asarray(self._polygon.contains_points(points).reshape(x.shape))

    def height(self, x_mm: FloatArray, y_mm: FloatArray) -> FloatArray:
        """Height z at (x, y), arrays of one shape, mm; NaN outside the boundary."""
        return self._within(self.function, x_mm, y_mm)

    def gradient(self, x_mm: FloatArray, y_mm: FloatArray) -> FloatArray:
        """(∂z/∂x, ∂z/∂y) at (x, y), shape (…, 2); NaN outside the boundary."""
        return self._within(self.slope or self._differences, x_mm, y_mm, (2,))

    def _within(
        self, function: Function, x_mm: FloatArray, y_mm: FloatArray, tail: tuple[int, ...] = ()
    ) -> FloatArray:
        x, y = (np.asarray(part, float) for part in np.broadcast_arrays(x_mm, y_mm))
        inside = self.inside(x, y)
        values = np.full((*x.shape, *tail), np.nan)
        values[inside] = function(x[inside], y[inside])
        return values

    def _differences(self, x: FloatArray, y: FloatArray) -> FloatArray:
        step = STEP * float(self._extent.max())

        def derivative(dx: float, dy: float) -> FloatArray:
            near, far = (
                self.function(x + n * dx, y + n * dy) - self.function(x - n * dx, y - n * dy)
                for n in (1, 2)
            )
            return (8 * near - far) / (12 * step)

        return np.stack([derivative(step, 0), derivative(0, step)], axis=-1)

    def boundary_mm(self) -> FloatArray:
        """Corners of the boundary, shape (n, 3), mm."""
        x, y = np.asarray(self.outline_mm, float).T
        return np.stack([x, y, self.function(x, y)], axis=-1)

    @cached_property
    def size(self) -> PoolSize:
        """True size; the peak is searched on successively finer grids, to about 1e-6 mm."""
        middle = np.asarray(self.outline_mm, float).min(axis=0) + self._extent / 2
        return size_of(self.height, self.boundary_mm(), middle, self._extent)

    def after(self, seconds: float) -> OutlinedPool:
        """The same pool ``seconds`` later: it does not move."""
        del seconds
        return self


def pool_from_heights(
    x_mm: FloatArray, y_mm: FloatArray, z_mm: FloatArray, outline_mm: FloatArray | None = None
) -> OutlinedPool:
    """Build a pool from heights on a grid: a bicubic spline through them, with its gradients.

    Parameters
    ----------
    x_mm, y_mm
        Positions of the grid's columns and rows, shapes (n,) and (m,), evenly increasing, mm.
    z_mm
        Heights, shape (m, n), mm; NaN where there is no pool. They are extrapolated smoothly
        beyond the known nodes, so that the surface is smooth up to its boundary.
    outline_mm
        Corners of the boundary, shape (k, 2), mm. None: halfway between the nodes with and those
        without a height.

    Raises
    ------
    ValueError
        If fewer than 4 × 4 nodes have a height.
    """
    known = np.isfinite(z_mm)
    if min(known.any(axis=0).sum(), known.any(axis=1).sum()) < 4:
        raise ValueError("at least 4 × 4 nodes must have a height")
    # Margin around the pool for its outline and for the spline.
    room = MARGIN + 1
    x, y = (_continued(np.asarray(line, float), room) for line in (x_mm, y_mm))
    z = np.pad(np.asarray(z_mm, float), room, constant_values=np.nan)
    known = np.isfinite(z)
    if outline_mm is None:
        outline_mm = _outline(x, y, known)
    heights = _Heights(RectBivariateSpline(y, x, _filled(x, y, z, known)))
    return OutlinedPool(heights, outline_mm, heights.slope)


@dataclass(frozen=True)
class _Heights:
    """A spline as a function of (x, y); unlike a lambda it can be pickled."""

    spline: RectBivariateSpline

    def __call__(self, x: FloatArray, y: FloatArray) -> FloatArray:
        return np.asarray(self.spline.ev(y, x))

    def slope(self, x: FloatArray, y: FloatArray) -> FloatArray:
        return np.stack([self.spline.ev(y, x, dy=1), self.spline.ev(y, x, dx=1)], axis=-1)


def _continued(line: FloatArray, count: int) -> FloatArray:
    """Evenly spaced positions with ``count`` more before and after them."""
    step = (line[-1] - line[0]) / (len(line) - 1)
    return np.asarray(line[0] + step * np.arange(-count, len(line) + count))


def _outline(x: FloatArray, y: FloatArray, known: BoolArray) -> FloatArray:
    """Smooth line halfway between known nodes and the others; the longest if there are several."""
    from contourpy import contour_generator
    from scipy.ndimage import gaussian_filter

    contours = contour_generator(x, y, gaussian_filter(known.astype(float), 0.8))
    lines = [np.asarray(line, float) for line in contours.lines(0.5)]
    longest = max(lines, key=lambda line: np.linalg.norm(np.diff(line, axis=0), axis=1).sum())
    return longest[:-1]


def _filled(x: FloatArray, y: FloatArray, z: FloatArray, known: BoolArray) -> FloatArray:
    """Heights at every node: extrapolated as a thin plate near known nodes, else the nearest."""
    nearest = distance_transform_edt(~known, return_distances=False, return_indices=True)
    filled = z[tuple(nearest)]
    near = binary_dilation(known, np.ones((3, 3), bool), MARGIN) & ~known
    nodes = np.stack(np.meshgrid(x, y), axis=-1)
    # Only nodes along the edge can be among the nearest.
    edge = known & binary_dilation(~known, np.ones((3, 3), bool), 6)
    plate = RBFInterpolator(nodes[edge], z[edge], neighbors=min(NEIGHBOURS, int(edge.sum())))
    filled[near] = plate(nodes[near])
    return np.asarray(filled)
