"""Calibration pictures → image calibration, whatever they show: the text's target or a board."""

from __future__ import annotations

from collections.abc import Sequence

from labapp.core.calibration.board_calibration import BoardCalibration, calibrate_board
from labapp.core.calibration.boards import Board, is_charuco
from labapp.core.calibration.plane_calibration import (
    PlaneCalibration,
    PlaneCalibrationSettings,
    calibrate_plane,
)
from labapp.core.calibration.target_marks import Image
from labapp.core.geometry.coordinates import Lens
from labapp.core.values import CannotMeasure

Calibration = PlaneCalibration | BoardCalibration


def calibrate_imaging_plane(
    images: Sequence[Image],
    settings: PlaneCalibrationSettings | None = None,
    board: Board | None = None,
    lens: Lens | None = None,
) -> Calibration:
    """Calibrate the camera by what the first picture shows in the imaging plane.

    Parameters
    ----------
    images
        Pictures; more than one are of a board (`calibrate_board`).
    settings
        Of the target (`calibrate_plane`); None for the defaults.
    board
        The board, where it is one that is not printed by labapp, or the pictures show several.
    lens
        The camera's lens, where it is known: a board gives it, a target does not.

    Raises
    ------
    ValueError
        If there is no picture, or one is none.
    CannotMeasure
        ``no-target``, ``no-board`` or ``wrong-board``; the reason says what is missing.
    """
    if board is not None or len(images) != 1 or is_charuco(images[0]):
        return calibrate_board(images, board)
    try:
        return calibrate_plane(images[0], settings, lens)
    except CannotMeasure as why:
        try:
            return calibrate_board(images)
        except CannotMeasure as no_board:
            if no_board.status == "wrong-board":
                raise
            raise why from None
