"""Shape of a pool's surface, from which work after the dissertation estimates penetration.

Width, length and convexity together predicted the width of the back-side bead best (W. J. Zhang et
al., "Characterization of Three-Dimensional Weld Pool Surface in GTAW", Weld. J. 91 (2012) 195-s).
Asymmetry and slope at the boundary indicate a torch beside the joint, undercut and wetting.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from labapp.core.surface.boundary import Boundary
from labapp.core.surface.level import Rear
from labapp.core.surface.spline import SplineBasis, SplineSurface
from labapp.core.surface.surface import Surface
from labapp.core.values import FloatArray

INSIDE = 0.99
"""Fraction of the way from centre to boundary at which interpolated surfaces have a slope."""


def shape_of(surface: Surface, boundary: Boundary) -> FloatArray:
    """Return convexity (mm), asymmetry and wetting slope (°) of a surface, shape (3,).

    The surface must be defined everywhere within the boundary.

    * Convexity: mean height of the longitudinal section through the middle of the boundary, its
      area over its length. Negative for a concave pool.
    * Asymmetry: volume between surface and work piece right of that section (+X) minus that left
      of it, over their sum; volumes below the work piece are positive too.
    * Wetting slope: mean angle along the boundary between the surface and the work piece; positive
      if the surface rises inwards. An interpolated surface has no slope at the boundary itself:
      that at `INSIDE` is used.
    """
    from labapp.core.surface.kernels import shape_kernels

    edge = 1.0 if isinstance(surface, SplineSurface) else INSIDE
    return shape_kernels.shape_parameters(
        *_samples(
            boundary, edge, lambda at: surface.height(*at.T), lambda at: surface.gradient(*at.T)
        )
    )


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
    from labapp.core.surface.kernels import shape_kernels, spline_kernels

    def at(place_mm: FloatArray) -> FloatArray:
        return spline_kernels.surface_at(basis.grid, coefficients, place_mm)

    spokes, rim = _samples(boundary, 1.0, lambda place: at(place)[0], lambda place: at(place)[1:].T)
    parameters = shape_kernels.shape_parameters(spokes, rim)
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


_Samples = tuple[FloatArray, FloatArray, FloatArray, FloatArray]


def _samples(
    boundary: Boundary,
    edge: float,
    height: Callable[[FloatArray], FloatArray],
    gradient: Callable[[FloatArray], FloatArray],
) -> tuple[_Samples, _Samples]:
    """Sample a surface on spokes from the middle of its boundary, and at or beside the boundary.

    ``edge`` is the fraction of the way there from the centre. The surface's height, shape (n,), and
    gradient, shape (n, 2), are functions of places, shape (n, 2), mm. Returns the ``spokes`` and
    the ``rim`` of `shape_kernels.shape_gradients`.
    """
    from labapp.core.surface.kernels import shape_kernels

    spokes, rim = shape_kernels.sample_places(boundary.points_mm, boundary.center_mm, edge)
    (_, _, place_mm), (_, inward, rim_mm) = spokes, rim
    height_mm = height(place_mm.reshape(-1, 2)).reshape(place_mm.shape[:2])
    return (*spokes, height_mm), (*rim, np.vecdot(gradient(rim_mm), inward))
