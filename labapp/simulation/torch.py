"""What the torch hides: the text's rule, and an electrode that has a shape (§4.2.1)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from labapp.core.values import BoolArray, FloatArray

REACH_MM = 20.0
"""How far a ray is followed from the pool: beyond the nozzle's edge."""

STEP_MM = 0.02
"""Step along a ray, far below the width of the tip."""


class Torch(Protocol):
    """What stands in the way of rays."""

    def hides(
        self, point_mm: FloatArray, incident: FloatArray, reflected: FloatArray
    ) -> tuple[BoolArray, BoolArray]:
        """Whether it is in the way of the rays to points and of those from them.

        Parameters
        ----------
        point_mm
            Reflection points, UCS, shape (…, 3), mm; NaN where there is none: not hidden.
        incident, reflected
            Unit directions of the rays, shape (…, 3).
        """
        ...


@dataclass(frozen=True)
class YozTorch:
    """The text's simplification: all that crosses y = 0 above the tip is hidden (§4.2.1.1).

    However far to the side: the incident ray of points at y < 0, the reflected one of points at
    y > 0.
    """

    height_mm: float
    """Of the tip."""

    def hides(
        self, point_mm: FloatArray, incident: FloatArray, reflected: FloatArray
    ) -> tuple[BoolArray, BoolArray]:
        """Whether it is in the way of the rays to points and of those from them."""
        y = point_mm[..., 1]
        return (
            (y < 0) & (_height_over_origin(point_mm, -incident) > self.height_mm),
            (y > 0) & (_height_over_origin(point_mm, reflected) > self.height_mm),
        )


@dataclass(frozen=True)
class ConeTorch:
    """An electrode with a conical tip, upright: it hides what it stands in the way of."""

    tip_mm: tuple[float, float, float]
    """Where the middle of the tip's flat end is, (x, y, z) in the UCS."""
    tip_radius_mm: float = 0.25
    radius_mm: float = 1.2
    """Radius of the flat end and of the rod."""
    half_angle_deg: float = 12.0
    """Of the cone."""

    def hides(
        self, point_mm: FloatArray, incident: FloatArray, reflected: FloatArray
    ) -> tuple[BoolArray, BoolArray]:
        """Whether it is in the way of the rays to points and of those from them."""
        return self._stands_in(point_mm, -incident), self._stands_in(point_mm, reflected)

    def _stands_in(self, point_mm: FloatArray, direction: FloatArray) -> BoolArray:
        """Whether rays from points along unit vectors, shapes (…, 3), meet the electrode."""
        along = np.arange(0.0, REACH_MM, STEP_MM)[:, None]
        way = point_mm[..., None, :] + along * direction[..., None, :] - self.tip_mm
        above = way[..., 2]
        radius = self.tip_radius_mm + above * np.tan(np.radians(self.half_angle_deg))
        within = np.hypot(way[..., 0], way[..., 1]) < np.minimum(radius, self.radius_mm)
        return np.asarray((within & (above >= 0)).any(axis=-1))


def _height_over_origin(point: FloatArray, direction: FloatArray) -> FloatArray:
    """Z at which the rays cross y = 0, shape (…); NaN where never."""
    with np.errstate(divide="ignore", invalid="ignore"):
        along = -point[..., 1] / direction[..., 1]
        return np.asarray(np.where(along > 0, point[..., 2] + along * direction[..., 2], np.nan))
