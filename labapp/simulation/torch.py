"""Rays blocked by the torch: the dissertation's rule, and an electrode with a shape (§4.2.1)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from labapp.core.values import BoolArray, FloatArray

REACH_MM = 20.0
"""Length of a ray that is checked from the pool on: beyond the edge of the nozzle."""

STEP_MM = 0.02
"""Step along a ray, far below the width of the tip."""


class Torch(Protocol):
    """A torch that blocks rays."""

    def hides(
        self, point_mm: FloatArray, incident: FloatArray, reflected: FloatArray
    ) -> tuple[BoolArray, BoolArray]:
        """Whether the torch blocks the incident and the reflected rays at points.

        Parameters
        ----------
        point_mm
            Reflection points, UCS, shape (…, 3), mm; NaN for none, which is not blocked.
        incident, reflected
            Unit directions of the rays, shape (…, 3).
        """
        ...


@dataclass(frozen=True)
class YozTorch:
    """The dissertation's simplification: rays crossing y = 0 above the tip are blocked (§4.2.1.1).

    This applies at any distance to the side, to the incident ray of points at y < 0 and to the
    reflected ray of points at y > 0.
    """

    height_mm: float
    """Height of the tip."""

    def hides(
        self, point_mm: FloatArray, incident: FloatArray, reflected: FloatArray
    ) -> tuple[BoolArray, BoolArray]:
        """Whether the torch blocks the incident and the reflected rays at points."""
        y = point_mm[..., 1]
        return (
            (y < 0) & (_height_over_origin(point_mm, -incident) > self.height_mm),
            (y > 0) & (_height_over_origin(point_mm, reflected) > self.height_mm),
        )


@dataclass(frozen=True)
class ConeTorch:
    """An upright electrode with a conical tip that blocks the rays which meet it."""

    tip_mm: tuple[float, float, float]
    """Centre of the tip's flat end, (x, y, z) in the UCS."""
    tip_radius_mm: float = 0.25
    radius_mm: float = 1.2
    """Radius of the flat end and of the rod."""
    half_angle_deg: float = 12.0
    """Half angle of the cone."""

    def hides(
        self, point_mm: FloatArray, incident: FloatArray, reflected: FloatArray
    ) -> tuple[BoolArray, BoolArray]:
        """Whether the torch blocks the incident and the reflected rays at points."""
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
    """Z at which the rays cross y = 0, shape (…); NaN if they do not."""
    with np.errstate(divide="ignore", invalid="ignore"):
        along = -point[..., 1] / direction[..., 1]
        return np.asarray(np.where(along > 0, point[..., 2] + along * direction[..., 2], np.nan))
