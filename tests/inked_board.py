"""The ink of a printed board, by points: for pictures of it, and to compare with its drawings."""

from __future__ import annotations

import numpy as np

from labapp.core.values import BoolArray, FloatArray
from labapp.simulation.calibration.board import MARKER_CELLS, PrintedBoard


class InkedBoard(PrintedBoard):
    """A printed board that `render_target` can draw."""

    def inked(self, plane_mm: FloatArray) -> BoolArray:
        """Whether points (X′, Z′), shape (…, 2), mm, are black, shape (…)."""
        board = self.board
        place_x, place_z = (plane_mm[..., k] / board.square_mm for k in (0, 1))
        left, low = np.floor(place_x), np.floor(place_z)
        column, row = left.astype(int) + 1, board.rows - 2 - low.astype(int)
        on = (column >= 0) & (column < board.columns) & (row >= 0) & (row < board.rows)
        odd = (row + column) % 2 == 1
        ink = on & ~odd
        if board.kind == "chessboard":
            return np.asarray(ink)
        white = on & odd
        # Cell of a point in its square, from the upper left corner of the square's marker.
        rim = (1.0 - board.marker_mm / board.square_mm) / 2.0
        at_x, at_y = (
            np.floor((along[white] - rim) / (1.0 - 2.0 * rim) * MARKER_CELLS).astype(int)
            for along in (place_x - left, 1.0 - (place_z - low))
        )
        inside = (np.minimum(at_x, at_y) >= 0) & (np.maximum(at_x, at_y) < MARKER_CELLS)
        number = self._numbers[row[white][inside], column[white][inside]]
        inside[inside] = self._markers[number, at_y[inside], at_x[inside]]
        ink[white] = inside
        return np.asarray(ink)
