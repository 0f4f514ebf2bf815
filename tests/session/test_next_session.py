"""A session like another, for the next recording: what it takes along, and that the other stays."""

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
        session.set_setup(setup)  # that of the sample, which its recording was made with
        session.set_settings(replace(session.settings, scheme="ers"))
    return path


def digest(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


def test_it_has_the_bench_and_nothing_that_was_filmed(first: Path, tmp_path: Path) -> None:
    with Session.open(first) as session:
        before = digest(first)
        assert len(session.frames)
        with next_session(session, tmp_path / "second.labsession") as made:
            assert made.setup_text == session.setup_text
            assert made.settings == session.settings != Settings()
            assert made.record == replace(session.record, safety=())
            assert made.record.operator == "A. Welder"
            laser = made.laser_calibration
            assert laser == session.laser_calibration
            assert laser is not None
            assert laser.picture_sha256 is not None
            picture = made.picture(laser.picture_sha256)
            assert np.array_equal(picture, np.eye(30, dtype=np.uint8))
            assert made.plane_calibration == session.plane_calibration
            assert made.recording is None
            assert len(made.frames) == 0
            assert made.corrected_frames().tolist() == []
            assert made.signals is None
            assert made.problems() == []
            assert [change.label for change in made.history] == ["as in thumb_tack"]
        assert digest(first) == before
        # Another recording goes in, and is measured there.
        with Session.open(tmp_path / "second.labsession") as again:
            again.import_recording(first.parent / "recording.tif")
            again.set_settings(Settings())
            for _ in again.measure([0]):
                pass
            result = again.result(0)
            assert result is not None
            assert result.measurement.status == "ok"


def test_of_an_empty_session_it_is_empty(tmp_path: Path) -> None:
    with (
        Session.create(tmp_path / "a.labsession") as session,
        next_session(session, tmp_path / "b.labsession") as made,
    ):
        assert made.setup_text == ""
        assert made.history == ()


def test_nothing_is_written_over_and_nothing_half_made_is_left(
    first: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with Session.open(first) as session:
        taken = tmp_path / "taken.labsession"
        taken.write_text("mine")
        with pytest.raises(InputError, match=r"taken\.labsession"):
            next_session(session, taken)
        assert taken.read_text() == "mine"

        def fail(*_: object) -> None:
            raise InputError(first, "picture", "damaged", "what was kept there")

        monkeypatch.setattr(
            "labapp.session.calibration_pictures.CalibrationPictures.copy_from", fail
        )
        with pytest.raises(InputError, match="damaged"):
            next_session(session, tmp_path / "half.labsession")
    assert not (tmp_path / "half.labsession").exists()
