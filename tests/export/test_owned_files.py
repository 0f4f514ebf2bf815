"""Files that a command wrote are replaced only if they are unchanged."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from labapp.errors import InputError
from labapp.export.owned_files import check_owned, write_owned


def refused(folder: Path, name: str) -> None:
    """Assert that a command refuses to write, names the file, and changes nothing."""
    before = {path.name: path.read_bytes() for path in folder.iterdir()}
    with pytest.raises(InputError) as caught:
        write_owned(folder, "advise", {"a.csv": b"3", "setup.toml": b"3"})
    assert caught.value.field == name
    with pytest.raises(InputError):
        check_owned(folder, "advise", ["a.csv", "setup.toml"])
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == before


def test_files_are_replaced_and_those_left_over_deleted(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_bytes(b"mine")
    write_owned(tmp_path, "advise", {"a.csv": b"1", "b.csv": b"1"})
    check_owned(tmp_path, "advise", ["a.csv", "c.csv"])
    write_owned(tmp_path, "advise", {"a.csv": b"2"})
    (tmp_path / "a.csv").unlink()
    write_owned(tmp_path, "advise", {"a.csv": b"2", "c.csv": b"2"})
    found = sorted(path.name for path in tmp_path.iterdir())
    assert found == ["a.csv", "advise.json", "c.csv", "notes.txt"]
    assert (tmp_path / "a.csv").read_bytes() == b"2"


def test_file_of_the_user_is_kept(tmp_path: Path) -> None:
    (tmp_path / "setup.toml").write_bytes(b"mine")
    refused(tmp_path, "setup.toml")
    write_owned(tmp_path, "dynamics", {"a.csv": b"1"})
    (tmp_path / "setup.toml").unlink()
    refused(tmp_path, "a.csv")  # of another command


def test_changed_file_is_kept(tmp_path: Path) -> None:
    write_owned(tmp_path, "advise", {"a.csv": b"1", "setup.toml": b"1", "old.csv": b"1"})
    (tmp_path / "setup.toml").write_bytes(b"calibrated")
    refused(tmp_path, "setup.toml")
    (tmp_path / "setup.toml").write_bytes(b"1")
    (tmp_path / "old.csv").write_bytes(b"edited, and not written again")
    refused(tmp_path, "old.csv")


@pytest.mark.parametrize("name", ["a.csv", "advise.json"])
def test_link_is_not_followed(tmp_path: Path, name: str) -> None:
    folder, target = tmp_path / "out", tmp_path / "precious.txt"
    folder.mkdir()
    write_owned(folder, "advise", {"a.csv": b"1"})
    target.write_bytes((folder / name).read_bytes())
    (folder / name).unlink()
    (folder / name).symlink_to(target)
    refused(folder, name)
    (folder / name).unlink()
    (folder / name).symlink_to(tmp_path / "new.txt")  # broken
    with pytest.raises(InputError):
        write_owned(folder, "advise", {"a.csv": b"1"})
    assert not (tmp_path / "new.txt").exists()


@pytest.mark.parametrize(
    "record",
    [
        "",
        "[]",
        "{}",
        '{"files": 3}',
        '{"files": {"../precious.txt": "0"}}',
        '{"files": {"/": "0"}}',
    ],
)
def test_forged_record_deletes_nothing(tmp_path: Path, record: str) -> None:
    folder, target = tmp_path / "out", tmp_path / "precious.txt"
    folder.mkdir()
    target.write_bytes(b"precious")
    (folder / "advise.json").write_text(record)
    with pytest.raises(InputError) as caught:
        write_owned(folder, "advise", {"a.csv": b"1"})
    assert caught.value.field == "files"
    assert [path.name for path in folder.iterdir()] == ["advise.json"]
    assert target.read_bytes() == b"precious"


def test_record_names_its_command(tmp_path: Path) -> None:
    write_owned(tmp_path, "lines", {"lines.csv": b"1"})
    record = json.loads((tmp_path / "lines.json").read_text("utf-8"))
    assert (record["program"], record["command"]) == ("labapp", "lines")
