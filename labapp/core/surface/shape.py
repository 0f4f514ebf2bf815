"""Shape parameters of a pool's surface, from which later work estimates penetration.

Width, length and convexity together predicted the width of the back-side bead best (W. J. Zhang et
al., "Characterization of Three-Dimensional Weld Pool Surface in GTAW", Weld. J. 91 (2012) 195-s).
Asymmetry and slope at the boundary indicate a torch beside the joint, undercut and wetting.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from labapp.core.surface.boundary import Boundary
from labapp.core.surface.level import Rear
from labapp.core.surface.spline import SplineBasis
from labapp.core.surface.surface import Surface
from labapp.core.values import FloatArray


def shape_of(surface: Surface, boundary: Boundary) -> FloatArray:
    """Return convexity (mm), asymmetry and wetting slope (°) of a surface, shape (3,).

    * Convexity: mean height of the longitudinal section through the middle of the boundary, its
      area over its length. Negative for a concave pool.
    * Asymmetry: volume between surface and work piece right of that section (+X) minus that left
      of it, over their sum; volumes below the work piece are positive too.
    * Wetting slope: mean angle along the boundary between the surface and the work piece; positive
      if the surface rises inwards.

    Parameters
    ----------
    surface
        Surface that is defined everywhere within the boundary.
    boundary
        The pool's boundary.
    """
    return _Samples.of(surface, boundary).shape


def shape_and_gradients(
    basis: SplineBasis,
    coefficients: FloatArray,
    rear: Rear,
    boundary: Boundary,
    boundary_slope: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """Return `shape_of` a spline surface, shape (3,), and its derivatives, shape (3, p + 1).

    Derivatives are by the spline coefficients and by the drop of the rear; the boundary moves with
    the surface.

    Parameters
    ----------
    basis, coefficients
        The surface: splines and their coefficients, shape (p,), mm.
    rear, boundary, boundary_slope
        The rear of the level, and the boundary traced with it (`trace_boundary`).
    """
    from labapp.core.surface.kernels import shape_kernels

    samples, outline = _Samples.of(_Evaluated(basis, coefficients), boundary), boundary.points_mm
    spokes = samples.middle_mm, samples.reach_mm, samples.place_mm, samples.height_mm
    rim = samples.length_mm, samples.inward, samples.rim_mm, samples.rise
    return samples.shape, shape_kernels.shape_gradients(
        basis.grid,
        coefficients,
        outline,
        boundary_slope,
        rear.as_array,
        spokes,
        rim,
        samples.shape,
    )


@dataclass(frozen=True)
class _Evaluated:
    """A spline surface within its rectangle, evaluated by the compiled kernels."""

    basis: SplineBasis
    coefficients: FloatArray

    def height(self, x_mm: FloatArray, y_mm: FloatArray) -> FloatArray:
        return np.asarray(self._at(x_mm, y_mm)[0].reshape(x_mm.shape))

    def gradient(self, x_mm: FloatArray, y_mm: FloatArray) -> FloatArray:
        return np.asarray(self._at(x_mm, y_mm)[1:].T.reshape(*x_mm.shape, 2))

    def _at(self, x_mm: FloatArray, y_mm: FloatArray) -> FloatArray:
        from labapp.core.surface.kernels import spline_kernels

        places = np.column_stack([x_mm.ravel(), y_mm.ravel()])
        return spline_kernels.surface_at(self.basis.grid, self.coefficients, places)


@dataclass(frozen=True)
class _Samples:
    """Samples of a surface on spokes from the middle of its boundary, and next to the boundary.

    Parameters
    ----------
    middle_mm, reach_mm
        Middle of the boundary, shape (2,); length of each spoke, shape (s,).
    place_mm, height_mm
        Shape (s, r, 2) and (s, r).
    length_mm, inward, rim_mm, rise
        At each of m boundary points: the length of boundary that it represents, shape (m,); the
        inward normal and the place where the slope is evaluated, shape (m, 2); the slope, shape
        (m,).
    """

    middle_mm: FloatArray
    reach_mm: FloatArray
    place_mm: FloatArray
    height_mm: FloatArray
    length_mm: FloatArray
    inward: FloatArray
    rim_mm: FloatArray
    rise: FloatArray

    @classmethod
    def of(cls, surface: Surface, boundary: Boundary) -> _Samples:
        from labapp.core.surface.kernels import shape_kernels

        spokes, beside = shape_kernels.sample_places(boundary.points_mm, boundary.center_mm)
        (middle, reach, place), (length, inward, rim) = spokes, beside
        rise = np.vecdot(surface.gradient(rim[:, 0], rim[:, 1]), inward)
        height = surface.height(place[..., 0], place[..., 1])
        return cls(middle, reach, place, height, length, inward, rim, rise)

    @cached_property
    def shape(self) -> FloatArray:
        """See `shape_of`."""
        from labapp.core.surface.kernels.shape_kernels import (
            ENDS,
            FRACTION,
            RIGHT,
            SPOKES,
            WEIGHT,
        )

        lengths = self.reach_mm[ENDS, None] * WEIGHT
        area = self.reach_mm[:, None] ** 2 * (WEIGHT * FRACTION) * (2 * np.pi / SPOKES)
        volume = np.sum(area * np.abs(self.height_mm), axis=1)
        right, left = RIGHT @ volume, (1 - RIGHT) @ volume
        return np.array(
            [
                np.sum(self.height_mm[ENDS] * lengths) / lengths.sum(),
                (right - left) / max(right + left, 1e-30),
                np.degrees(np.arctan(self.rise)) @ self.length_mm / self.length_mm.sum(),
            ]
        )
