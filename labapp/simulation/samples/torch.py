"""A torch that has a shape: which rays its electrode hides, dot by dot (§4.2.1)."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from labapp.core.values import BoolArray, FloatArray
from labapp.simulation.forward import Reflections

REACH_MM = 20.0
"""How far a ray is followed from the pool: beyond the nozzle's edge."""

STEP_MM = 0.02
"""Step along a ray, far below the width of the tip."""


@dataclass(frozen=True)
class Torch:
    """An electrode with a conical tip, upright.

    The rig's `Electrode` is the text's simplification: all that passes above the tip is hidden,
    however far to the side. This one hides what it stands in the way of.

    Parameters
    ----------
    tip_mm
        Where the middle of the tip's flat end is, (x, y, z) in the UCS.
    tip_radius_mm, radius_mm
        Radius of the flat end and of the rod.
    half_angle_deg
        Of the cone.
    """

    tip_mm: tuple[float, float, float]
    tip_radius_mm: float = 0.25
    radius_mm: float = 1.2
    half_angle_deg: float = 12.0

    def hides(self, point_mm: FloatArray, direction: FloatArray) -> BoolArray:
        """Whether it is in the way of rays from points along unit vectors, shapes (…, 3)."""
        along = np.arange(0.0, REACH_MM, STEP_MM)[:, None]
        way = point_mm[..., None, :] + along * direction[..., None, :] - self.tip_mm
        above = way[..., 2]
        radius = self.tip_radius_mm + above * np.tan(np.radians(self.half_angle_deg))
        within = np.hypot(way[..., 0], way[..., 1]) < np.minimum(radius, self.radius_mm)
        return np.asarray((within & (above >= 0)).any(axis=-1))

    def shade(self, reflections: Reflections) -> Reflections:
        """Put the torch in the way of rays that were traced without one."""
        return replace(
            reflections,
            incident_blocked=self.hides(reflections.point_mm, -reflections.incident),
            reflected_blocked=self.hides(reflections.point_mm, reflections.reflected),
        )
