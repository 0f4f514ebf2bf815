"""Image calibration from pictures of either the dissertation's target or a board."""

from __future__ import annotations

from collections.abc import Sequence

from labapp.core.calibration.board_calibration import BoardCalibration, calibrate_board
from labapp.core.calibration.boards import Board, is_charuco
from labapp.core.calibration.plane_calibration import UNIT_MM, PlaneCalibration, calibrate_plane
from labapp.core.calibration.target_marks import ColourOrGrey
from labapp.core.geometry.coordinates import Lens
from labapp.core.values import CannotMeasure

Calibration = PlaneCalibration | BoardCalibration


def calibrate_imaging_plane(
    images: Sequence[ColourOrGrey],
    unit_mm: float = UNIT_MM,
    board: Board | None = None,
    lens: Lens | None = None,
) -> Calibration:
    """Calibrate the camera from pictures of the target or of a board in the imaging plane.

    Parameters
    ----------
    images
        Pictures; if there is more than one, they must show a board (`calibrate_board`).
    unit_mm
        Length of a unit of the target's axes, mm.
    board
        The board; needed if it is not one of labapp's, or if the pictures show several.
    lens
        The camera's lens, if known: a board determines it, the target does not.

    Raises
    ------
    ValueError
        If there are no pictures, or an image is not a valid picture.
    CannotMeasure
        ``no-target``, ``no-board`` or ``wrong-board``; the reason states what is missing.
    """
    if board is not None or len(images) != 1 or is_charuco(images[0]):
        return calibrate_board(images, board)
    try:
        return calibrate_plane(images[0], unit_mm, lens)
    except CannotMeasure as why:
        try:
            return calibrate_board(images)
        except CannotMeasure as no_board:
            if no_board.status == "wrong-board":
                raise
            raise why from None
