"""Whether the frames of a session have the size of the picture that calibrated its set-up."""

from __future__ import annotations

from labapp.config.setup_text import frame_px_of, three_points
from labapp.errors import InputError
from labapp.session.calibrations import calibrations_in_use
from labapp.session.record import Recording
from labapp.session.session import Session


def calibrated_px(session: Session) -> tuple[int, int] | None:
    """(rows, columns) of the picture used to calibrate the imaging plane; None if unknown.

    Sessions of earlier versions have it in the stored picture only.
    """
    if size := frame_px_of(session.setup_text):
        return size[1], size[0]
    kept = session.plane_calibration
    if kept is None or not calibrations_in_use(session)[1]:
        return None
    try:
        rows, columns = session.picture(kept.picture_sha256).shape
    except InputError:
        return None
    return rows, columns


def size_warning(session: Session, recording: Recording) -> str:
    """Warning if a set-up does not match the size of the frames, else ""."""
    shape, calibrated = (recording.rows, recording.columns), calibrated_px(session)
    points = three_points(session.setup_text)
    if calibrated is None and points is not None and (points > shape[::-1]).any():
        u, v = points.max(axis=0)
        return (
            f"The set-up's image calibration has points up to ({u:.0f}, {v:.0f}) px, and frames "
            f"have {recording.columns}×{recording.rows} px: was it made with larger pictures? "
            "Calibrate with a picture of the same size"
        )
    return other_size(calibrated, shape)


def other_size(calibrated: tuple[int, int] | None, shape: tuple[int, int]) -> str:
    """Warning if frames of shape (rows, columns) differ from the calibration picture, else ""."""
    if calibrated is None or calibrated == shape:
        return ""
    (rows, columns), (height, width) = calibrated, shape
    return (
        f"The imaging plane was calibrated with a picture of {columns}×{rows} px, and frames have "
        f"{width}×{height} px: sizes are wrong. Calibrate with a picture of the same region"
    )
