"""A simulated pinhole camera that views the imaging plane from any position."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from labapp.core.values import FloatArray, ReadOnlyArrays
from labapp.simulation.camera import Lens


@dataclass(frozen=True)
class PosedView(ReadOnlyArrays):
    """A pinhole camera with a lens that views the imaging plane from any position."""

    matrix: FloatArray
    """Shape (3, 3): (X′, Z′, 1), mm, to homogeneous (u, v, 1), px, of the undistorted picture."""
    width_px: int = 480
    height_px: int = 640
    lens: Lens | None = None
    """Lens that distorts the picture. None: no distortion."""
    axis_px: tuple[float, float] | None = None
    """(u, v) of the lens's axis. None: the centre of the picture."""

    @classmethod
    def at(
        cls,
        center_mm: tuple[float, float],
        px_per_mm: float,
        focal_px: float = 1500.0,
        turned_deg: tuple[float, float, float] = (0.0, 0.0, 0.0),
        size_px: tuple[int, int] = (480, 640),
        lens: Lens | None = None,
        axis_px: tuple[float, float] | None = None,
    ) -> PosedView:
        """Build the view of a camera with a given point of the plane at the centre of its picture.

        Parameters
        ----------
        center_mm
            (X′, Z′) of that point.
        px_per_mm
            Scale at that point.
        focal_px
            Focal length in pixels.
        turned_deg
            Rotation of the plane about X′, about Z′, and about the camera's axis.
        size_px, lens, axis_px
            Width and height of the picture, and the lens.
        """
        about_x, about_z, roll = np.radians(turned_deg)
        tilt = np.array(
            [
                [1, 0, 0],
                [0, np.cos(about_x), -np.sin(about_x)],
                [0, np.sin(about_x), np.cos(about_x)],
            ]
        )
        turn = np.array(
            [
                [np.cos(about_z), 0, np.sin(about_z)],
                [0, 1, 0],
                [-np.sin(about_z), 0, np.cos(about_z)],
            ]
        )
        spin = np.array(
            [[np.cos(roll), -np.sin(roll), 0], [np.sin(roll), np.cos(roll), 0], [0, 0, 1]]
        )
        # The camera's x points right and its y down: Z′ points the other way.
        plane = spin @ turn @ tilt @ np.array([[1.0, 0.0], [0.0, -1.0], [0.0, 0.0]])
        place = np.array([0.0, 0.0, focal_px / px_per_mm]) - plane @ np.array(center_mm)
        middle = (np.array(size_px) - 1) / 2
        camera = np.array([[focal_px, 0, middle[0]], [0, focal_px, middle[1]], [0, 0, 1]])
        return cls(camera @ np.column_stack([plane, place]), *size_px, lens, axis_px)

    @property
    def _axis_px(self) -> FloatArray:
        middle = ((self.width_px - 1) / 2, (self.height_px - 1) / 2)
        return np.array(self.axis_px or middle)

    def to_image(self, plane_mm: FloatArray) -> FloatArray:
        """IPCS (X′, Z′), shape (…, 2), mm, to (u, v), shape (…, 2), px; NaN if never seen."""
        straight = _projected(self.matrix, plane_mm)
        if self.lens is None:
            return straight
        return self._axis_px + self.lens.distort(straight - self._axis_px)

    def to_plane(self, image_px: FloatArray) -> FloatArray:
        """(u, v), shape (…, 2), px, to IPCS (X′, Z′), shape (…, 2), mm."""
        if self.lens is not None:
            image_px = self._axis_px + self.lens.straighten(image_px - self._axis_px)
        return _projected(np.asarray(np.linalg.inv(self.matrix), np.float64), image_px)


def _projected(matrix: FloatArray, points: FloatArray) -> FloatArray:
    # Coordinate by coordinate: NumPy is slow along an axis of length 2.
    first, second = np.moveaxis(points, -1, 0)
    seen = [by_first * first + by_second * second + by for by_first, by_second, by in matrix]
    return np.stack([seen[0] / seen[2], seen[1] / seen[2]], axis=-1)
