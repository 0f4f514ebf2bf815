"""A camera that sees the imaging plane from anywhere, and boards as it sees them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from labapp.core.values import BoolArray, FloatArray, ReadOnlyArrays
from labapp.simulation.board import MARKER_CELLS, PrintedBoard
from labapp.simulation.camera import Lens


class InkedBoard(PrintedBoard):
    """A printed board whose ink can be looked up."""

    def inked(self, plane_mm: FloatArray) -> BoolArray:
        """Whether points (X′, Z′), shape (…, 2), mm, are black, shape (…)."""
        board = self.board
        place = np.asarray(plane_mm, float) / board.square_mm
        column = np.floor(place[..., 0]).astype(int) + 1
        row = board.rows - 2 - np.floor(place[..., 1]).astype(int)
        on = (column >= 0) & (column < board.columns) & (row >= 0) & (row < board.rows)
        ink = on & ((row + column) % 2 == 0)
        if board.kind == "chessboard":
            return np.asarray(ink)
        # Where in its square a point is, from its upper left corner, in cells of the marker.
        x, y = np.mod(place[..., 0], 1.0), 1.0 - np.mod(place[..., 1], 1.0)
        rim = (1.0 - board.marker_mm / board.square_mm) / 2.0
        cell = [
            np.floor((along - rim) / (1.0 - 2.0 * rim) * MARKER_CELLS).astype(int)
            for along in (x, y)
        ]
        in_marker = on & ~ink & (np.minimum(*cell) >= 0) & (np.maximum(*cell) < MARKER_CELLS)
        number = self._numbers[
            np.clip(row, 0, board.rows - 1), np.clip(column, 0, board.columns - 1)
        ]
        safe = (np.clip(part, 0, MARKER_CELLS - 1) for part in cell)
        at_x, at_y = safe
        black = self._markers[np.maximum(number, 0), at_y, at_x]
        return np.asarray(ink | (in_marker & black))


@dataclass(frozen=True)
class PosedView(ReadOnlyArrays):
    """A pinhole camera, with a lens, that sees the imaging plane from anywhere."""

    matrix: FloatArray
    """Shape (3, 3): (X′, Z′, 1) in mm to homogeneous (u, v, 1) in px of the straight picture."""
    width_px: int = 480
    height_px: int = 640
    lens: Lens | None = None
    """What bends the picture. None: nothing."""
    axis_px: tuple[float, float] | None = None
    """(u, v) of the lens's axis. None: the middle of the picture."""

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
        """Build the view of a camera that has a place of the plane in the middle of its picture.

        Parameters
        ----------
        center_mm
            (X′, Z′) of that place.
        px_per_mm
            Scale there.
        focal_px
            Focal length over the size of a pixel.
        turned_deg
            By how much the plane is turned about X′, about Z′, and about the camera's axis.
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
        # The camera's x is to the right, its y down: Z′ counts the other way.
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
    seen = points @ matrix[:, :2].T + matrix[:, 2]
    return np.asarray(seen[..., :2] / seen[..., 2:])
