from __future__ import annotations

import json
import sqlite3
import zlib
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import numpy.typing as npt
import pytest

from labapp.core.calibration.boards import Board, BoardCorners
from labapp.core.calibration.plane_calibration import PlaneCalibration
from labapp.core.pipeline import Settings
from labapp.core.values import FloatArray
from labapp.errors import InputError
from labapp.session.file.blobs import HEAD, MAGIC, Damaged, pack, unpack
from labapp.session.file.kinds import is_a
from labapp.session.record import Record
from labapp.session.session import Session
from tests.fuzz.originals import SETUP, keep, measurement_of


def blob_of(tree: object) -> bytes:
    text = json.dumps(tree).encode()
    body = zlib.compress(len(text).to_bytes(4, "little") + text)
    return HEAD.pack(MAGIC, zlib.crc32(body)) + body


@pytest.mark.parametrize(
    ("value", "hint", "fits"),
    [
        (1, float, True),
        (10**30, float, False),
        (-(10**30), int, False),
        (True, float, False),
        (1.0, int, False),
        (None, str | None, True),
        ("S/S", Literal["S/S", "I/I"], True),
        ("D/D", Literal["S/S", "I/I"], False),
        ((1, 2), tuple[int, int], True),
        ((1, 2, 3), tuple[int, int], False),
        ((1, 2, 3), tuple[int, ...], True),
        ((1, "2"), tuple[int, ...], False),
        (frozenset({1}), frozenset[int], True),
        (np.zeros(2), FloatArray, True),
        (np.array(["a"]), FloatArray, False),
        (np.zeros(2), npt.NDArray[np.bool_], False),
        (np.array(["a"]), npt.NDArray[Any], True),
        (None, FloatArray | None, True),
        (3, Any, True),
    ],
)
def test_values_are_checked_against_type_hints(value: object, hint: Any, fits: bool):
    assert is_a(value, hint) == fits


def test_inconsistent_measurement_is_damaged():
    measurement = measurement_of(0)
    assert measurement.match is not None
    assert measurement.reconstruction is not None
    last_first = measurement.match.ray[::-1]
    for wrong in (
        replace(measurement, match=replace(measurement.match, ray=last_first)),
        replace(measurement, match=replace(measurement.match, dot=measurement.match.dot + 1)),
        replace(measurement, match=replace(measurement.match, ray=measurement.match.ray + 90)),
        replace(measurement, match=replace(measurement.match, ray=measurement.match.ray[:-1])),
        replace(measurement, status=3),  # type: ignore[arg-type]
        replace(measurement, lattice=None, dots=None),
        replace(
            measurement,
            reconstruction=replace(measurement.reconstruction, sigma_mm=np.zeros((12, 2))),
        ),
    ):
        with pytest.raises(Damaged):
            unpack(pack(wrong))
    assert unpack(pack(measurement)).status == "ok"


@pytest.mark.parametrize("tree", [{"Record": {"title": 3}}, {"Settings": {}}, "text", None])
def test_value_of_an_unexpected_class_is_damaged(tree: object):
    with pytest.raises(Damaged):
        unpack(blob_of(tree), Record)


def test_highly_compressed_blob_is_rejected():
    packer = zlib.compressobj(1)
    body = b"".join(packer.compress(bytes(1 << 24)) for _ in range(10)) + packer.flush()
    with pytest.raises(Damaged, match="too large"):
        unpack(HEAD.pack(MAGIC, zlib.crc32(body)) + body)


@pytest.mark.parametrize(
    "marks",
    [
        ((0.0, float("inf"), 1.0, 1.0, 1.0),) * 5,
        ((0.0, 0.0, 1e300, 1.0, 1.0),) * 5,
        ((0.0, 0.0, 1.0, 1.0, 1.0),) * 3,
    ],
)
def test_marks_that_determine_no_map_are_damaged(marks: Any):
    points: Any = ((44.0, 590.0), (242.0, 588.0), 34.9, (43.0, 500.0), 15.9, (0.1, 0.1, 0.1), 90.0)
    assert unpack(pack(PlaneCalibration(*points)))
    with pytest.raises(Damaged):
        unpack(pack(PlaneCalibration(*points, marks, "affine")))


@pytest.mark.parametrize("factor", [np.nan, np.inf, 1e300, 0.0, (1.0, 0.0)])
def test_corners_that_determine_no_map_are_damaged(factor: Any):
    board = Board("a", "charuco", 9, 7, 10.0, "4X4_50", 0)
    index = np.arange(len(board.corners_mm))
    assert unpack(pack(BoardCorners(board, index, board.corners_mm * 8.0 + 50)))
    with pytest.raises(Damaged):
        unpack(pack(BoardCorners(board, index, (board.corners_mm * 8.0 + 50) * factor)))


@pytest.fixture
def path(tmp_path: Path) -> Path:
    np.save(tmp_path / "stack.npy", np.zeros((3, 20, 30), np.uint8))
    with Session.create(tmp_path / "a.labsession") as session:
        session.set_setup(SETUP.read_text("utf-8"))
        session.import_recording(tmp_path / "stack.npy", frame_rate_hz=50)
        keep(session, 0, measurement_of(0), "fit")
        keep(session, 1, measurement_of(1, "ers"), "ers")
    return tmp_path / "a.labsession"


@pytest.mark.parametrize(
    "edit",
    [
        "UPDATE result SET frame = 2 WHERE frame = 0",
        "UPDATE result SET inputs = 2 WHERE frame = 0",
        "UPDATE result SET correction = 'x' WHERE frame = 0",
        "UPDATE inputs SET version = '99' WHERE id = 1",
        "UPDATE frame SET time_s = 7 WHERE number = 1",
        "UPDATE frame SET checksum = NULL WHERE number = 1",
        "DELETE FROM recording",
    ],
)
def test_edited_columns_of_a_result_are_detected(path: Path, edit: str):
    with Session.open(path, read_only=True) as session:
        assert session.problems() == []
    connection = sqlite3.connect(path, isolation_level=None)
    connection.execute(edit)
    connection.close()
    with Session.open(path, read_only=True) as session:
        assert len(session.problems()) == 1


def edit(path: Path, statement: str) -> None:
    """Edit a session as another program could, without its constraints."""
    connection = sqlite3.connect(path, isolation_level=None)
    connection.execute("PRAGMA ignore_check_constraints = ON")
    connection.execute(statement)
    connection.close()


@pytest.mark.parametrize(
    "statement", ["UPDATE frame SET time_s = 7 WHERE number = 1", "DELETE FROM recording"]
)
def test_changed_times_are_not_exported(path: Path, statement: str):
    edit(path, statement)
    with Session.open(path, read_only=True) as session:
        with pytest.raises(InputError, match="frames"):
            session.export(path.with_name("out"))
        with pytest.raises(InputError, match="frames"):
            list(session.frame_results())
    assert not path.with_name("out").exists()


@pytest.mark.parametrize(
    "statement",
    ["UPDATE result SET inputs = x''", "DELETE FROM detail", "UPDATE detail SET result = -result"],
)
def test_incomplete_result_is_damaged(path: Path, statement: str):
    edit(path, statement)
    with Session.open(path) as session:
        for use in (
            lambda: session.result(0, "fit"),
            lambda: session.export(path.with_name("out")),
        ):
            with pytest.raises(InputError):
                use()
        # Damaged results have no part in the check of the set-up.
        assert [found.status for _, found in session.measure([2])] == ["no-dots"]


def test_name_of_a_scheme_that_is_no_text_is_damage(path: Path):
    edit(path, "UPDATE result SET scheme = x'00ff'")
    with Session.open(path) as session:
        with pytest.raises(InputError, match="results"):
            _ = session.measured_by
        assert session.measure([2])


def test_overview_works_with_damaged_inputs(path: Path):
    with Session.open(path) as session, session._database.transaction() as connection:
        connection.execute("UPDATE inputs SET settings = 'text' WHERE id = 1")
    with Session.open(path) as session:
        overview = session.overview("fit")
        assert (overview.status[0], bool(overview.stale[0])) == ("ok", True)
        assert session.result(1, "ers") is not None
        with pytest.raises(InputError, match="inputs"):
            session.result(0, "fit")


def test_undo_reports_a_damaged_history(path: Path):
    with Session.open(path) as session:
        session.set_settings(Settings(scheme="ers"))
        session.set_settings(Settings(scheme="irs"))
        with session._database.transaction() as connection:
            connection.execute("UPDATE change_part SET before = x'00' WHERE kind = 'settings'")
        with pytest.raises(InputError, match="settings in the history"):
            session.undo()
        assert session.settings.scheme == "irs"
        assert session.problems() != []


def test_other_journal_mode_is_rejected_without_new_files(path: Path):
    content = bytearray(path.read_bytes())
    content[18:20] = b"\x02\x02"
    path.write_bytes(content)
    for read_only in (True, False):
        with pytest.raises(InputError, match="journal"):
            Session.open(path, read_only=read_only)
    files = {file.name for file in path.parent.iterdir()} - {f".{path.name}.lock"}
    assert files == {path.name, "stack.npy"}
    assert path.read_bytes() == content
