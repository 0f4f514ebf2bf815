"""Mirrors of known shape for the bench check, as surfaces that the forward model traces."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from labapp.core.values import FloatArray
from labapp.simulation.pools import PoolSize


@dataclass(frozen=True)
class FlatMirror:
    """A square plate, flat or bent, level or tilted.

    Parameters
    ----------
    height_mm
        z at the origin.
    rise_x, rise_y
        Slopes along X and along Y.
    bend_per_mm
        Curvature along X and along Y, 1/mm: 0 is flat.
    side_mm
        Length of a side.
    """

    height_mm: float = 0.0
    rise_x: float = 0.0
    rise_y: float = 0.0
    bend_per_mm: tuple[float, float] = (0.0, 0.0)
    side_mm: float = 60.0

    def height(self, x_mm: FloatArray, y_mm: FloatArray) -> FloatArray:
        """Height z at (x, y), arrays of one shape, mm; NaN beyond the edges."""
        x, y = np.asarray(x_mm, float), np.asarray(y_mm, float)
        (bend_x, bend_y), reach = self.bend_per_mm, self.side_mm / 2
        z = self.height_mm + self.rise_x * x + self.rise_y * y
        z = z + (bend_x * x**2 + bend_y * y**2) / 2
        return np.where((np.abs(x) <= reach) & (np.abs(y) <= reach), z, np.nan)

    def gradient(self, x_mm: FloatArray, y_mm: FloatArray) -> FloatArray:
        """(∂z/∂x, ∂z/∂y) at (x, y), shape (…, 2)."""
        bend_x, bend_y = self.bend_per_mm
        slopes = self.rise_x + bend_x * np.asarray(x_mm), self.rise_y + bend_y * np.asarray(y_mm)
        return np.stack(np.broadcast_arrays(*slopes), axis=-1)

    @property
    def size(self) -> PoolSize:
        """Size with the highest and the lowest point, with a margin."""
        reach = self.side_mm / 2
        bent = sum(abs(bend) * reach**2 / 2 for bend in self.bend_per_mm)
        rise = (abs(self.rise_x) + abs(self.rise_y)) * reach + bent
        at = (0.0, 0.0)
        side = self.side_mm
        return PoolSize(side, side, self.height_mm + rise, self.height_mm - rise, at, at)


@dataclass(frozen=True)
class BallMirror:
    """The upper half of a ball.

    Parameters
    ----------
    diameter_mm, top_mm
        Diameter of the ball, and z of its highest point.
    center_mm
        (x, y) of the highest point.
    """

    diameter_mm: float
    top_mm: float
    center_mm: tuple[float, float] = (0.0, 0.0)

    def _from_center(self, x_mm: FloatArray, y_mm: FloatArray) -> tuple[FloatArray, ...]:
        x, y = np.asarray(x_mm) - self.center_mm[0], np.asarray(y_mm) - self.center_mm[1]
        square = self.diameter_mm**2 / 4 - x**2 - y**2
        with np.errstate(invalid="ignore"):
            return x, y, np.sqrt(square)

    def height(self, x_mm: FloatArray, y_mm: FloatArray) -> FloatArray:
        """Height z at (x, y), arrays of one shape, mm; NaN outside the ball and below z = 0."""
        z = self.top_mm - self.diameter_mm / 2 + self._from_center(x_mm, y_mm)[2]
        return np.where(z >= 0, z, np.nan)

    def gradient(self, x_mm: FloatArray, y_mm: FloatArray) -> FloatArray:
        """(∂z/∂x, ∂z/∂y) at (x, y), shape (…, 2)."""
        x, y, z = self._from_center(x_mm, y_mm)
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.stack([-x / z, -y / z], axis=-1)

    @property
    def size(self) -> PoolSize:
        """True size of the part above the work piece."""
        radius, top = self.diameter_mm / 2, self.top_mm
        width = 2 * radius if top > radius else 2 * np.sqrt(top * (2 * radius - top))
        return PoolSize(float(width), float(width), top, 0.0, self.center_mm, self.center_mm)
