"""Sessions that earlier versions wrote: opened, whole, and what they held still there."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from labapp.session.measured import CORRECTION_CHANGED, SETTINGS_CHANGED
from labapp.session.schema import VERSION
from labapp.session.session import Session

WRITTEN = sorted((Path(__file__).parent / "data").glob("version_*.labsession"))


def test_every_version_is_kept():
    assert [path.stem for path in WRITTEN] == [f"version_{n}" for n in range(1, VERSION + 1)]


@pytest.mark.parametrize("read_only", [True, False])
@pytest.mark.parametrize("path", WRITTEN, ids=lambda path: path.stem)
def test_what_a_version_wrote_is_read(path: Path, tmp_path: Path, read_only: bool):
    copy = tmp_path / "old.labsession"
    shutil.copyfile(path, copy)
    with Session.open(copy, read_only=read_only) as session:
        assert session.problems() == []
        assert (session.record.operator, session.record.notes) == ("A. Weld", "µ")
        assert session.setup.rig.laser.distance_mm > 0
        assert session.frame(0).image.shape == (480, 460)
        assert session.frame(0).time_s == 0
        for scheme in ("fit", "ers"):
            result = session.result(0, scheme)
            assert result is not None
            assert result.measurement.measures is not None
            assert result.measurement.measures.height_mm == pytest.approx(0.91, rel=0.1)
            assert result.measurement.reconstruction is not None
            # It was measured with the defaults of its time, which are others now.
            assert result.stale == (SETTINGS_CHANGED, CORRECTION_CHANGED)
        correction = session.correction(0)
        assert correction is not None
        assert correction.lattice.reference is None
        labels = [change.label for change in session.history]
        assert labels == ["experiment record", "setup", "correction"]
    if read_only:
        assert copy.read_bytes() == path.read_bytes()
