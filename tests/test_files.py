from __future__ import annotations

import os
from pathlib import Path
from unittest import mock

import pytest

from labapp.errors import InputError
from labapp.files import atomic_file, only_writer, read_limited, write_all, write_atomically
from labapp.system import IS_WINDOWS


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


@pytest.mark.skipif(IS_WINDOWS, reason="no pipes in folders")
def test_pipe_is_written_to_and_not_replaced(tmp_path: Path):
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    reader = os.open(pipe, os.O_RDONLY | os.O_NONBLOCK)
    try:
        write_atomically(pipe, b"rows")
        assert os.read(reader, 10) == b"rows"
    finally:
        os.close(reader)
    assert pipe.is_fifo()
    assert list(tmp_path.iterdir()) == [pipe]


@pytest.mark.skipif(IS_WINDOWS, reason="no pipes in folders")
def test_only_pipes_with_a_writer_are_read(tmp_path: Path):
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(InputError, match="named pipe"):
        read_limited(tmp_path / "pipe", 10, "text")
    reader, writer = os.pipe()
    os.write(writer, b"text")
    os.close(writer)
    try:
        assert read_limited(Path(f"/dev/fd/{reader}"), 10, "text") == b"text"
    finally:
        os.close(reader)


def test_folder_is_not_replaced(tmp_path: Path):
    with pytest.raises((IsADirectoryError, PermissionError)):  # the latter on Windows
        write_atomically(tmp_path, b"rows")
    assert tmp_path.is_dir()


def test_loop_of_links_is_replaced_rather_than_a_fault(tmp_path: Path):
    (tmp_path / "loop").symlink_to("loop")
    write_atomically(tmp_path / "loop", b"rows")
    assert (tmp_path / "loop").read_bytes() == b"rows"


def test_only_the_permitted_size_is_read(tmp_path: Path):
    path = tmp_path / "a"
    path.write_bytes(b"12345")
    assert read_limited(path, 5, "digits") == b"12345"
    with pytest.raises(InputError, match="size: more than 4 bytes; expected digits"):
        read_limited(path, 4, "digits")
    with pytest.raises(InputError, match=r"file: .*; expected digits"):
        read_limited(tmp_path / "none", 4, "digits")


@pytest.mark.skipif(not Path("/proc/self").exists(), reason="no /proc here")
def test_folder_without_files_is_not_taken_for_a_locked_one():
    with only_writer(Path("/proc/self/out")) as locked:
        assert not locked


def test_second_writer_is_rejected_until_the_first_is_done(tmp_path: Path):
    target = tmp_path / "out"
    with only_writer(target):
        with pytest.raises(InputError, match="another program"), only_writer(target):
            pass
        assert [path.name for path in tmp_path.iterdir()] == [".out.lock"]
    with only_writer(target) as locked:
        assert locked
    assert list(tmp_path.iterdir()) == []


def test_partial_write_is_continued():
    file = mock.Mock()
    written: list[bytes] = []
    file.write = lambda content: written.append(content[:3]) or len(content[:3])
    write_all(file, "0,1,µm\n".encode())
    assert b"".join(written) == "0,1,µm\n".encode()
