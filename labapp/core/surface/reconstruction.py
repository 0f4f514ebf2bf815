"""Result of a reconstruction scheme."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from labapp.core.surface.boundary import Boundary
from labapp.core.surface.surface import Surface
from labapp.core.values import BoolArray, FloatArray, IntArray, ReadOnlyArrays

ROUNDING = 1e-9
"""Relative tolerance of the distance from the centre for a point on the boundary."""


@dataclass(frozen=True)
class BoundedSurface:
    """A surface that ends at the pool's boundary: NaN outside it."""

    unbounded: Surface
    boundary: Boundary

    def height(self, x_mm: FloatArray, y_mm: FloatArray) -> FloatArray:
        """Height z at (x, y), arrays of one shape, mm."""
        return np.where(self._within(x_mm, y_mm), self.unbounded.height(x_mm, y_mm), np.nan)

    def gradient(self, x_mm: FloatArray, y_mm: FloatArray) -> FloatArray:
        """(∂z/∂x, ∂z/∂y) at (x, y), shape (…, 2)."""
        within = self._within(x_mm, y_mm)[..., None]
        return np.where(within, self.unbounded.gradient(x_mm, y_mm), np.nan)

    def _within(self, x_mm: FloatArray, y_mm: FloatArray) -> BoolArray:
        x, y = self.boundary.center_mm
        place = np.array([np.subtract(x_mm, x), np.subtract(y_mm, y)]) * (1 - ROUNDING)
        return self.boundary.contains(x + place[0], y + place[1])


@dataclass(frozen=True, repr=False)
class Reconstruction(ReadOnlyArrays):
    """A pool surface, and the residuals of the reflected dots.

    Parameters
    ----------
    scheme
        Name of the scheme.
    surface
        z = f(x, y); NaN outside the boundary. The surface that is passed may be unbounded.
    boundary
        The pool's boundary.
    ray
        Ray (i, j) of each reflection point, counted from 1, shape (n, 2).
    points_mm
        Reflection points, UCS, shape (n, 3), mm. For IRS and ERS they are those of the scheme;
        `surface`, which also interpolates the boundary, need not pass through them.
    residual_mm
        Computed minus captured reflected dot on the imaging plane (X′, Z′), shape (n, 2), mm,
        computed with `surface`; NaN if the ray does not meet it within the boundary.
    sigma_mm
        Standard uncertainty of each reflection point's height due to noise and level, shape (n,),
        mm; NaN if the scheme gives none.
    size_sigma
        Standard uncertainty of each of `measures.WITH_SIGMA`, shape (9,); NaN if the scheme gives
        none. Shape (6,), as in files of versions without the last three, is extended by NaN.
    size_sigma_level
        Part of the level, shape (9,). It is nearly the same error in consecutive frames
        (`core.sequence.mean`).
    size_sigma_setup
        Part of the set-up, shape (9,): the same error in all frames of a recording.
    own_are_mm
        ARE of the scheme's points with the surface through these alone (step 4 of §6.3.1 and §7.1),
        mm, as the dissertation defines it. NaN for fit, whose points lie on its surface.
    """

    scheme: str
    surface: Surface
    boundary: Boundary
    ray: IntArray
    points_mm: FloatArray
    residual_mm: FloatArray
    sigma_mm: FloatArray
    size_sigma: FloatArray = field(default_factory=lambda: np.full(9, np.nan))
    size_sigma_level: FloatArray = field(default_factory=lambda: np.full(9, np.nan))
    size_sigma_setup: FloatArray = field(default_factory=lambda: np.full(9, np.nan))
    own_are_mm: float = math.nan

    def __post_init__(self) -> None:
        for name in ("size_sigma", "size_sigma_level", "size_sigma_setup"):
            if np.shape(sigma := getattr(self, name)) == (6,):
                object.__setattr__(self, name, np.append(sigma, np.full(3, np.nan)))
        super().__post_init__()
        object.__setattr__(self, "surface", BoundedSurface(self.unbounded, self.boundary))

    @property
    def unbounded(self) -> Surface:
        """The surface of the scheme, which may continue beyond the boundary."""
        return self.surface.unbounded if isinstance(self.surface, BoundedSurface) else self.surface
