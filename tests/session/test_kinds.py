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
def test_values_are_held_to_type_hints(value: object, hint: Any, fits: bool):
    assert is_a(value, hint) == fits


def test_a_measurement_whose_parts_do_not_fit_is_damaged():
    whole = measurement_of(0)
    assert whole.match is not None
    assert whole.reconstruction is not None
    for wrong in (
        replace(whole, match=replace(whole.match, dot=whole.match.dot + 1)),
        replace(whole, match=replace(whole.match, ray=whole.match.ray + 90)),
        replace(whole, match=replace(whole.match, ray=whole.match.ray[:-1])),
        replace(whole, status=3),  # type: ignore[arg-type]
        replace(whole, lattice=None, dots=None),
        replace(whole, reconstruction=replace(whole.reconstruction, sigma_mm=np.zeros((12, 2)))),
    ):
        with pytest.raises(Damaged):
            unpack(pack(wrong))
    assert unpack(pack(whole)).status == "ok"


@pytest.mark.parametrize("tree", [{"Record": {"title": 3}}, {"Settings": {}}, "text", None])
def test_another_value_than_was_asked_for_is_damaged(tree: object):
    with pytest.raises(Damaged):
        unpack(blob_of(tree), Record)


def test_a_few_bytes_do_not_fill_the_memory():
    packer = zlib.compressobj(1)
    body = b"".join(packer.compress(bytes(1 << 24)) for _ in range(10)) + packer.flush()
    with pytest.raises(Damaged, match="too large"):
        unpack(HEAD.pack(MAGIC, zlib.crc32(body)) + body)


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
def test_what_stands_beside_a_result_is_vouched_for(path: Path, edit: str):
    with Session.open(path, read_only=True) as session:
        assert session.problems() == []
    connection = sqlite3.connect(path, isolation_level=None)
    connection.execute(edit)
    connection.close()
    with Session.open(path, read_only=True) as session:
        assert len(session.problems()) == 1


def test_damaged_inputs_leave_the_overview(path: Path):
    with Session.open(path) as session, session._database.transaction() as connection:
        connection.execute("UPDATE inputs SET settings = 'text' WHERE id = 1")
    with Session.open(path) as session:
        seen = session.overview("fit")
        assert (seen.status[0], bool(seen.stale[0])) == ("ok", True)
        assert session.result(1, "ers") is not None
        with pytest.raises(InputError, match="inputs"):
            session.result(0, "fit")


def test_damage_in_the_history_stops_undo_with_a_sentence(path: Path):
    with Session.open(path) as session:
        session.set_settings(Settings(scheme="ers"))
        session.set_settings(Settings(scheme="irs"))
        with session._database.transaction() as connection:
            connection.execute("UPDATE change_part SET before = x'00' WHERE kind = 'settings'")
        with pytest.raises(InputError, match="settings in the history"):
            session.undo()
        assert session.settings.scheme == "irs"


def test_another_kind_of_journal_is_refused_and_nothing_is_left(path: Path):
    content = bytearray(path.read_bytes())
    content[18:20] = b"\x02\x02"
    path.write_bytes(content)
    for read_only in (True, False):
        with pytest.raises(InputError, match="journal"):
            Session.open(path, read_only=read_only)
    left = {each.name for each in path.parent.iterdir()} - {f".{path.name}.lock"}
    assert left == {path.name, "stack.npy"}
    assert path.read_bytes() == content
