"""Shape of a pool's surface, from which work after the dissertation estimates penetration.

Width, length and convexity together predicted the width of the back-side bead best (W. J. Zhang et
al., "Characterization of Three-Dimensional Weld Pool Surface in GTAW", Weld. J. 91 (2012) 195-s).
Asymmetry and slope at the boundary indicate a torch beside the joint, undercut and wetting.
"""

from __future__ import annotations

from dataclasses import dataclass

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
    return _shape_parameters(*_samples(surface, boundary))


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

    spokes, rim = _samples(_Evaluated(basis, coefficients), boundary)
    parameters = _shape_parameters(spokes, rim)
    return parameters, shape_kernels.shape_gradients(
        basis.grid,
        coefficients,
        boundary.points_mm,
        boundary_slope,
        rear.as_array,
        spokes,
        rim,
        parameters,
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


_Samples = tuple[FloatArray, FloatArray, FloatArray, FloatArray]


def _samples(surface: Surface, boundary: Boundary) -> tuple[_Samples, _Samples]:
    """Sample a surface on spokes from the middle of its boundary, and next to the boundary.

    Returns the ``spokes`` and the ``rim`` of `shape_kernels.shape_gradients`.
    """
    from labapp.core.surface.kernels import shape_kernels

    spokes, rim = shape_kernels.sample_places(boundary.points_mm, boundary.center_mm)
    (_, _, place_mm), (_, inward, rim_mm) = spokes, rim
    height_mm = surface.height(place_mm[..., 0], place_mm[..., 1])
    rise = np.vecdot(surface.gradient(rim_mm[:, 0], rim_mm[:, 1]), inward)
    return (*spokes, height_mm), (*rim, rise)


def _shape_parameters(spokes: _Samples, rim: _Samples) -> FloatArray:
    """`shape_of` the samples of a surface (`_samples`)."""
    from labapp.core.surface.kernels.shape_kernels import (
        ENDS,
        FRACTION,
        HALVED_WEIGHT,
        RIGHT,
        SPOKES,
    )

    (_, reach_mm, _, height_mm), (length_mm, _, _, rise) = spokes, rim
    lengths = reach_mm[ENDS, None] * HALVED_WEIGHT
    area = reach_mm[:, None] ** 2 * (HALVED_WEIGHT * FRACTION) * (2 * np.pi / SPOKES)
    volume = np.sum(area * np.abs(height_mm), axis=1)
    right, left = RIGHT @ volume, (1 - RIGHT) @ volume
    return np.array(
        [
            np.sum(height_mm[ENDS] * lengths) / lengths.sum(),
            (right - left) / max(right + left, 1e-30),
            np.degrees(np.arctan(rise)) @ length_mm / length_mm.sum(),
        ]
    )
