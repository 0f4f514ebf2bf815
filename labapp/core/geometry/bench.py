"""The bench that frames are measured on, and what follows from it for all of them."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

from labapp.core.geometry.coordinates import ImageCalibration
from labapp.core.geometry.optics import ProjectedRays, project_rays
from labapp.core.geometry.rig import Rig


@dataclass(frozen=True)
class Bench:
    """A rig, and how the camera sees its imaging plane.

    Parameters
    ----------
    rig
        Laser, pattern, electrode and imaging plane.
    calibration
        From the image to the imaging plane.
    """

    rig: Rig
    calibration: ImageCalibration

    @cached_property
    def rays(self) -> ProjectedRays:
        """The rays of the pattern, and where they would land."""
        return project_rays(self.rig.laser, self.rig.pattern)
