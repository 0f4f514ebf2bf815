"""Boundary of a surface that is near the one of the frame before."""

from __future__ import annotations

import numpy as np

from labapp.core import kernels
from labapp.core.boundary import Boundary
from labapp.core.fit import contour
from labapp.core.pool_fit import Level
from labapp.core.spline import SplineSurface
from labapp.core.values import FloatArray
from labapp.core.warm_fit import Bed

STEPS = 4
"""Newton steps from the boundary of the frame before, at most."""

LAST_MM = 3e-3
"""After a step of no more the next one would be of some nanometres."""

ON_RIM_MM = 1e-3
"""Before the last step boundary points are on the rim's height to within this, or the boundary is
looked for anew."""


def follow_rim(
    bed: Bed, coefficients: FloatArray, level: Level, center_mm: FloatArray, before: Boundary
) -> tuple[Boundary, FloatArray]:
    """Move a boundary onto a surface that is near its own.

    Returns
    -------
    boundary, climb
        The boundary of m points, and the gradient there of the surface's height over the rim's,
        shape (m, 2).

    Raises
    ------
    CannotMeasure
        ``open-boundary`` if there is none.
    """
    radius = np.linalg.norm(before.points_mm[:, :2] - before.center_mm, axis=-1)
    theta = np.radians(before.theta_deg)
    way = np.stack([np.cos(theta), np.sin(theta)], axis=-1)
    for attempt in range(2):
        radius, climb, over = kernels.follow_rim(
            bed.basis.grid,
            coefficients,
            level.rear.numbers,
            center_mm,
            way,
            radius,
            STEPS,
            LAST_MM,
        )
        place = center_mm + radius[:, None] * way
        inside = bool(bed.basis.contains(*place.T).all() and (radius > 0).all())
        if inside and np.abs(over).max() < ON_RIM_MM:
            break
        found = contour(SplineSurface(bed.basis, coefficients), center_mm, level)
        if attempt:
            break
        radius = np.linalg.norm(found.points_mm[:, :2] - center_mm, axis=-1)
    height = level.rear.height(place[:, 1])
    return Boundary(center_mm, before.theta_deg, np.column_stack([place, height])), climb
