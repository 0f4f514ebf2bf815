"""Calibrations store the picture from which they were read."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from labapp.session.record import CrossPicture, LaserEntries
from labapp.session.session import Session

PICTURE = Path(__file__).parents[2] / "sample_sessions" / "gtaw" / "calibration.png"


@pytest.fixture
def session(tmp_path: Path) -> Iterator[Session]:
    with Session.create(tmp_path / "run.labsession") as session:
        yield session


def plane_in_use(session: Session) -> object:
    stored = session.plane_calibration
    assert stored is not None
    return stored.found


def test_imaging_plane_placed_by_hand_is_used(session: Session):
    calibration = session.calibrate_plane(PICTURE, 6.35)
    u, v = calibration.origin_px
    moved = replace(calibration, origin_px=(u + 1.5, v), marks=(), model="three points")
    image = cv2.imread(str(PICTURE), cv2.IMREAD_UNCHANGED)
    session.use_plane(moved, 6.35, image)
    assert plane_in_use(session) == moved
    assert f"{u + 1.5}" in session.setup_text
    degenerate = replace(moved, z_axis_px=calibration.x_axis_px)
    with pytest.raises(ValueError, match="one line"):
        session.use_plane(degenerate, 6.35, image)
    session.undo()
    assert plane_in_use(session) == calibration


def test_laser_calibration_stores_its_picture(session: Session):
    picture = np.arange(150, dtype=np.uint8).reshape(10, 15)
    session.calibrate_laser([13.676], [18.561], [7.874], picture=picture)
    stored = session.laser_calibration
    assert stored is not None
    assert stored.picture_sha256 is not None
    np.testing.assert_array_equal(session.picture(stored.picture_sha256), picture)


def test_deleted_pictures_are_reported(session: Session):
    session.calibrate_plane(PICTURE, 6.35)
    session.calibrate_laser([13.676], [18.561], [7.874], picture=np.zeros((10, 15), np.uint8))
    sha256 = session.keep_picture("cross", np.ones((10, 15), np.uint8))
    cross = CrossPicture(sha256, ((1.0, 2.0),) * 6, 10.0)
    session.set_entries("laser", LaserEntries((), 10.0, 0.1, 0.01, cross=cross))
    assert session.problems() == []
    with session._database.transaction() as connection:
        connection.execute("DELETE FROM picture")
    reported = " ".join(session.problems())
    assert "laser-calibration is missing" in reported
    assert "plane-calibration is missing" in reported
    assert "laser-entries is missing" in reported
