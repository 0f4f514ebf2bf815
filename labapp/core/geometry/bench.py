"""The bench on which frames are recorded, and quantities derived from it for all frames."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np

from labapp.core.geometry.coordinates import ImageCalibration
from labapp.core.geometry.optics import ProjectedRays, project_rays
from labapp.core.geometry.rig import Rig
from labapp.core.values import FloatArray


@dataclass(frozen=True)
class Bench:
    """A rig and the image calibration of its imaging plane."""

    rig: Rig
    calibration: ImageCalibration

    @cached_property
    def rays(self) -> ProjectedRays:
        """The rays of the pattern and their landing points on the work piece."""
        return project_rays(self.rig.laser, self.rig.pattern)

    def frame_px(self, frame_shape: tuple[int, int]) -> tuple[FloatArray, FloatArray]:
        """Undistorted first and last pixel (u, v) of a frame, shapes (2,).

        With lens distortion the frame's edges are curved: the result is the rectangle within them.
        """
        if frame_shape not in self._frames_px:
            height, width = frame_shape
            corner, share = np.array([width - 1.0, height - 1.0]), np.array([0.0, 0.5, 1.0])
            left, right, top, bottom = (
                self.calibration.ideal_px(np.stack(np.broadcast_arrays(*at), axis=-1) * corner)
                for at in ((0.0, share), (1.0, share), (share, 0.0), (share, 1.0))
            )
            first = np.array([left[:, 0].max(), top[:, 1].max()])
            last = np.array([right[:, 0].min(), bottom[:, 1].min()])
            self._frames_px[frame_shape] = first, last
        return self._frames_px[frame_shape]

    def frame_area_mm2(self, frame_shape: tuple[int, int]) -> float:
        """Area of the imaging plane that a frame shows, mm²."""
        if frame_shape not in self._areas_mm2:
            height, width = frame_shape
            corners = np.array([[0, 0], [width, 0], [width, height], [0, height]], float)
            seen = self.calibration.to_plane(corners).astype(np.float32)
            self._areas_mm2[frame_shape] = float(cv2.contourArea(seen))
        return self._areas_mm2[frame_shape]

    @cached_property
    def _areas_mm2(self) -> dict[tuple[int, int], float]:
        return {}

    @cached_property
    def _frames_px(self) -> dict[tuple[int, int], tuple[FloatArray, FloatArray]]:
        return {}
