"""A pool surface z = f(x, y), and where rays meet it (Eq. 4-1, 6-2)."""

from __future__ import annotations

from typing import Protocol

import numpy as np

from labapp.core.values import FloatArray


class Surface(Protocol):
    """A height over the work piece; NaN where it is not defined."""

    def height(self, x_mm: FloatArray, y_mm: FloatArray) -> FloatArray:
        """Height z at (x, y), arrays of one shape, mm."""
        ...

    def gradient(self, x_mm: FloatArray, y_mm: FloatArray) -> FloatArray:
        """(∂z/∂x, ∂z/∂y) at (x, y), shape (…, 2)."""
        ...


class FlatSurface:
    """The work piece itself, z = level: the first estimate of both schemes (step 0)."""

    def __init__(self, level_mm: float = 0.0) -> None:
        self.level_mm = level_mm

    def height(self, x_mm: FloatArray, y_mm: FloatArray) -> FloatArray:
        """Height z at (x, y), arrays of one shape, mm."""
        return np.full(np.shape(x_mm), self.level_mm)

    def gradient(self, x_mm: FloatArray, y_mm: FloatArray) -> FloatArray:
        """(∂z/∂x, ∂z/∂y) at (x, y), shape (…, 2)."""
        return np.zeros((*np.shape(x_mm), 2))
