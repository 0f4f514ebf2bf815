"""A new session with the bench of another: what is copied, and that the other is unchanged."""

from __future__ import annotations

import hashlib
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from labapp.core.pipeline import Settings
from labapp.errors import InputError
from labapp.session.copies import next_session
from labapp.session.record import LaserEntries
from labapp.session.session import Session

SAMPLES = Path(__file__).parents[2] / "sample_sessions"


@pytest.fixture
def first(tmp_path: Path) -> Path:
    folder = tmp_path / "first"
    shutil.copytree(SAMPLES / "thumb_tack", folder)
    path = folder / "thumb_tack.labsession"
    with Session.open(path) as session:
        ticked = (("Laser goggles are worn", "2026-11-21T19:00:00+01:00"),)
        session.set_record(replace(session.record, operator="A. Welder", safety=ticked))
        setup = session.setup_text
        session.calibrate_laser([4.65], [6.23], [2.75], picture=np.eye(30, dtype=np.uint8))
        session.set_entries("laser", LaserEntries((("4.6", "", ""),), 10.0, 0.1, 0.05))
        session.set_setup(setup)  # the set-up of the sample, with which the recording was made
        session.set_settings(replace(session.settings, scheme="ers"))
    return path


def digest(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


def test_next_session_has_the_bench_without_the_recording(first: Path, tmp_path: Path) -> None:
    with Session.open(first) as session:
        before = digest(first)
        assert len(session.frames)
        with next_session(session, tmp_path / "second.labsession") as second:
            assert second.setup_text == session.setup_text
            assert second.settings == session.settings != Settings()
            assert second.record == replace(session.record, safety=())
            assert second.record.operator == "A. Welder"
            laser = second.laser_calibration
            assert laser == session.laser_calibration
            assert laser is not None
            assert laser.picture_sha256 is not None
            picture = second.picture(laser.picture_sha256)
            assert np.array_equal(picture, np.eye(30, dtype=np.uint8))
            assert second.laser_entries == session.laser_entries is not None
            assert second.plane_calibration == session.plane_calibration
            assert second.recording is None
            assert len(second.frames) == 0
            assert second.corrected_frames().tolist() == []
            assert second.signals is None
            assert second.problems() == []
            assert [change.label for change in second.history] == ["as in thumb_tack"]
        assert digest(first) == before
        # Another recording can be imported and measured.
        with Session.open(tmp_path / "second.labsession") as reopened:
            reopened.import_recording(first.parent / "recording.tif")
            reopened.set_settings(Settings())
            for _ in reopened.measure([0]):
                pass
            result = reopened.result(0)
            assert result is not None
            assert result.measurement.status == "ok"


def test_next_session_of_an_empty_session_is_empty(tmp_path: Path) -> None:
    with (
        Session.create(tmp_path / "a.labsession") as session,
        next_session(session, tmp_path / "b.labsession") as second,
    ):
        assert second.setup_text == ""
        assert second.history == ()


def test_next_session_overwrites_no_file_and_leaves_no_partial_file(
    first: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with Session.open(first) as session:
        existing = tmp_path / "taken.labsession"
        existing.write_text("mine")
        with pytest.raises(InputError, match=r"taken\.labsession"):
            next_session(session, existing)
        assert existing.read_text() == "mine"

        def fail(*_: object) -> None:
            raise InputError(first, "picture", "damaged", "what was kept there")

        monkeypatch.setattr(
            "labapp.session.calibration_pictures.CalibrationPictures.copy_from", fail
        )
        with pytest.raises(InputError, match="damaged"):
            next_session(session, tmp_path / "half.labsession")
    assert not (tmp_path / "half.labsession").exists()
