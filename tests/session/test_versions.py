"""Sessions written by earlier versions can be opened without loss or problems."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import shutil
import sqlite3
import zlib
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from labapp.core.calibration.plane_calibration import PlaneCalibration
from labapp.core.geometry.rig import Electrode
from labapp.session.file.blobs import HEAD, MAGIC, SURFACES, Damaged, pack, unpack
from labapp.session.file.schema import VERSION
from labapp.session.file.stored import NAMES, STORED, Stored
from labapp.session.results.measured import CORRECTION_CHANGED, SETTINGS_CHANGED
from labapp.session.session import Session

WRITTEN = sorted((Path(__file__).parent / "data").glob("version_*.labsession"))


def test_a_file_of_every_version_exists():
    assert [path.stem for path in WRITTEN] == [f"version_{n}" for n in range(1, VERSION + 1)]


@pytest.mark.parametrize("read_only", [True, False])
@pytest.mark.parametrize("path", WRITTEN, ids=lambda path: path.stem)
def test_files_of_every_version_are_read(path: Path, tmp_path: Path, read_only: bool):
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
            # It was measured with the former defaults; those of version 1 have changed since.
            former = (SETTINGS_CHANGED,) if path.stem == "version_1" else ()
            assert result.stale == (*former, CORRECTION_CHANGED)
        level = session.overview("fit").measures["height_sigma_level_mm"]
        assert np.isfinite(level).all() == (path.stem != "version_1")  # which did not store it
        correction = session.correction(0)
        assert correction is not None
        assert correction.lattice.reference is None
        labels = [change.label for change in session.history]
        assert labels == ["experiment record", "setup", "correction"]
    if read_only:
        assert copy.read_bytes() == path.read_bytes()


FOUND = PlaneCalibration(
    *((50.0, 400.0), (380.0, 400.0), 55.0, (50.0, 250.0), 25.0),
    sigma_px=(0.1, 0.2, 0.3),
    threshold=14.0,
)


def remove_fields(blob: bytes, *fields: str) -> bytes:
    """Return a plane calibration as written before it had the given fields."""
    plain = zlib.decompress(blob[HEAD.size :])
    length = int.from_bytes(plain[:4], "little")
    tree = json.loads(plain[4 : 4 + length])
    for field in fields:
        del tree["PlanePicture"]["found"]["PlaneCalibration"][field]
    text = json.dumps(tree, separators=(",", ":")).encode()
    body = zlib.compress(len(text).to_bytes(4, "little") + text + plain[4 + length :])
    return HEAD.pack(MAGIC, zlib.crc32(body)) + body


def test_plane_calibration_without_marks_is_read(tmp_path: Path):
    path = tmp_path / "old.labsession"
    shutil.copyfile(WRITTEN[-1], path)
    with Session.open(path) as session:
        session.use_plane(FOUND, 10.0, np.zeros((480, 640), np.uint8))
    with closing(sqlite3.connect(path)) as database, database:
        where = "kind = 'plane-calibration'"
        (blob,) = database.execute(f"SELECT content FROM document WHERE {where}").fetchone()
        older = remove_fields(blob, "marks", "model")
        content = hashlib.sha256(zlib.decompress(older[HEAD.size :])).hexdigest()
        database.execute(
            f"UPDATE document SET content = ?, sha256 = ? WHERE {where}", (older, content)
        )
        database.execute(f"UPDATE change_part SET after = ? WHERE {where}", (older,))
    with Session.open(path) as session:
        assert session.problems() == []
        readings = session.plane_calibration
        assert readings is not None
        assert readings.found == FOUND
        session.undo()
        assert session.plane_calibration is None
        session.redo()
        assert session.plane_calibration == readings
        assert session.problems() == []


# --- names --------------------------------------------------------------------------------------

EVER = json.loads((Path(__file__).parent / "data" / "stored_names.json").read_text("utf-8"))
"""Every class that was ever written, and the names of its fields in files."""


def test_every_name_ever_written_is_read():
    for name, fields in EVER.items():
        if name in SURFACES:
            continue
        stored = STORED[name]
        current = {field.name for field in dataclasses.fields(stored.kind)}
        for field in fields:
            assert field in stored.retired or stored.renamed.get(field, field) in current, field


def test_every_written_name_is_recorded():
    # Add new names to stored_names.json, and never remove a name from it.
    for name, stored in STORED.items():
        assert set(stored.names()) <= set(EVER[name]), name
    assert SURFACES.keys() <= EVER.keys()


@dataclass(frozen=True)
class Apparatus:
    """The class of a stored electrode under a new name, with a renamed field."""

    tip_mm: float = 5.0


def test_renamed_class_is_read_and_written_by_its_old_name(monkeypatch: pytest.MonkeyPatch):
    before = pack(Electrode(4.5))
    stored = Stored(Apparatus, renamed={"height_mm": "tip_mm"}, retired=("bent",))
    monkeypatch.setitem(STORED, "Electrode", stored)
    monkeypatch.setitem(NAMES, Apparatus, "Electrode")
    assert unpack(before, Apparatus) == Apparatus(4.5)
    assert pack(Apparatus(4.5)) == before


def test_retired_field_is_ignored():
    text = b'{"Electrode":{"height_mm":4.5,"bent":true}}'
    body = zlib.compress(len(text).to_bytes(4, "little") + text)
    blob = HEAD.pack(MAGIC, zlib.crc32(body)) + body
    with pytest.raises(Damaged):
        unpack(blob)
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(STORED, "Electrode", Stored(Electrode, retired=("bent",)))
        assert unpack(blob) == Electrode(4.5)
