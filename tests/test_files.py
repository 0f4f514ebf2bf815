from __future__ import annotations

from pathlib import Path
from unittest import mock

import pytest

from labapp.files import atomic_file, write_atomically


def test_link_beside_the_file_is_not_followed(tmp_path: Path):
    (tmp_path / "mine.txt").write_text("mine")
    (tmp_path / ".setup.toml.part").symlink_to("mine.txt")
    write_atomically(tmp_path / "setup.toml", b"new")
    assert (tmp_path / "setup.toml").read_bytes() == b"new"
    assert (tmp_path / "mine.txt").read_text() == "mine"


def test_link_in_place_of_the_temporary_file_is_an_error(tmp_path: Path):
    (tmp_path / "mine.txt").write_text("mine")
    with mock.patch("secrets.token_hex", return_value="known"):
        (tmp_path / ".setup.toml.known.part").symlink_to("mine.txt")
        with pytest.raises(FileExistsError):
            write_atomically(tmp_path / "setup.toml", b"new")
    assert (tmp_path / "mine.txt").read_text() == "mine"
    assert not (tmp_path / "setup.toml").exists()


def test_permissions_and_links_are_preserved(tmp_path: Path):
    (tmp_path / "real").write_text("old")
    (tmp_path / "real").chmod(0o640)
    (tmp_path / "link").symlink_to("real")
    write_atomically(tmp_path / "link", b"new")
    assert (tmp_path / "link").is_symlink()
    assert (tmp_path / "real").read_bytes() == b"new"
    assert (tmp_path / "real").stat().st_mode & 0o777 == 0o640


def test_new_file_has_the_default_permissions(tmp_path: Path):
    (tmp_path / "other").touch()
    write_atomically(tmp_path / "new", b"")
    assert (tmp_path / "new").stat().st_mode == (tmp_path / "other").stat().st_mode


def test_failed_write_leaves_the_old_file(tmp_path: Path):
    path = tmp_path / "a"
    path.write_text("old")
    with pytest.raises(RuntimeError), atomic_file(path) as part:  # noqa: PT012
        part.write_text("half")
        raise RuntimeError
    assert [(file.name, file.read_text()) for file in tmp_path.iterdir()] == [("a", "old")]
