"""Atomic writing of files: a reader sees either the old file or the complete new one."""

from __future__ import annotations

import errno
import hashlib
import json
import os
import secrets
import shutil
import stat
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

from labapp.errors import InputError, os_errors_as_input

if TYPE_CHECKING:
    from filelock import FileLock


def as_bytes(text: str) -> bytes:
    r"""Encode as UTF-8; undecodable bytes of file names are written as ``\udcXX``, as in JSON."""
    return text.encode("utf-8", "backslashreplace")


def as_json(value: object) -> bytes:
    """Encode as indented JSON, for files that people read."""
    return as_bytes(json.dumps(value, indent=2, ensure_ascii=False) + "\n")


def beside(path: Path) -> Path:
    """Return a hidden, unpredictable path in the folder of ``path``, safe from planted links.

    The file or folder must still be created as new (``xb``, `mkdir`), never opened.
    """
    return path.with_name(f".{path.name}.{secrets.token_hex(8)}.part")


@contextmanager
def atomic_file(path: Path) -> Iterator[Path]:
    """Yield a temporary file, which replaces ``path`` unless the block raises.

    Raises
    ------
    OSError
        If it cannot be created or renamed.
    """
    part = beside(path)
    part.open("xb").close()
    try:
        yield part
        part.replace(path)
    finally:
        part.unlink(missing_ok=True)


def write_atomically(path: Path, content: bytes) -> None:
    """Write a temporary file and rename it to ``path``, so that readers never see a partial file.

    Permissions of an existing file are preserved, and links are followed, not replaced. A device or
    a pipe (``/dev/stdout``, ``/dev/null``) is written to, not replaced.

    Raises
    ------
    OSError
        If it cannot be written; an existing file is unchanged and no temporary file remains.
    """
    if path.exists() and not path.is_file():
        with path.open("wb", buffering=0) as device:
            write_all(device, content)
        return
    path = Path(os.path.realpath(path))  # `resolve` raises RuntimeError for a loop of links
    with atomic_file(path) as part:
        with part.open("wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        if path.exists():
            shutil.copymode(path, part)


class ByteFile(Protocol):
    """An unbuffered binary file."""

    def write(self, content: memoryview, /) -> int:
        """Write all or a part, and return the number of bytes; or raise OSError."""
        ...

    def close(self) -> None:
        """Close the file."""
        ...


def write_all(file: ByteFile, content: bytes | memoryview) -> None:
    """Write all of ``content``; partial writes are continued, so that a full disk raises."""
    rest = memoryview(content)
    while rest:
        rest = rest[file.write(rest) :]


def regular_size(path: Path) -> int:
    """Return the size of a regular file, bytes; devices and pipes would block.

    Raises
    ------
    OSError
        If it is not regular, or does not exist.
    """
    try:
        found = path.stat()
    except ValueError as error:  # a NUL byte in the name
        raise OSError(errno.EINVAL, "has a NUL byte in its name") from error
    if stat.S_ISDIR(found.st_mode):
        raise IsADirectoryError(errno.EISDIR, "is a folder")
    if not stat.S_ISREG(found.st_mode):
        raise OSError(errno.EINVAL, "a device or a pipe, not a file")
    return found.st_size


def read_limited(path: Path, largest: int, wanted: str) -> bytes:
    """Read a file of at most ``largest`` bytes; a device or a pipe cannot fill the memory.

    Raises
    ------
    InputError
        If it cannot be read or is larger; ``wanted`` is what is expected.
    """
    if Path(os.path.realpath(path)).is_fifo():  # not /dev/stdin or /dev/fd/N, which have a writer
        raise InputError(path, "file", "a named pipe", wanted)
    with os_errors_as_input(path, "file", wanted), path.open("rb") as file:
        content = file.read(largest + 1)
    if len(content) > largest:
        raise InputError(path, "size", f"more than {largest} bytes", f"{wanted}, at most {largest}")
    return content


def sha256_of(path: Path) -> str:
    """Return the SHA-256 of a file, hexadecimal."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def is_of_labapp(path: Path) -> bool:
    """Whether a file is JSON that names labapp as its program."""
    try:
        content = json.loads(path.read_bytes())
    except (OSError, ValueError, RecursionError):
        return False
    return isinstance(content, dict) and content.get("program") == "labapp"


def acquire(lock: FileLock) -> None:
    """Acquire a lock without waiting.

    Raises
    ------
    filelock.Timeout
        If another program has it.
    OSError
        If there can be no such file; the library calls that a lock of another program.
    """
    from filelock import Timeout

    try:
        lock.acquire(blocking=False)
    except Timeout:
        if os.path.lexists(lock.lock_file):
            raise
        raise OSError(errno.EROFS, "no file can be made in it") from None


@contextmanager
def only_writer(target: Path) -> Iterator[bool]:
    """Exclude other programs from writing to a file or folder, by a lock file beside it.

    Yields whether it is locked: some network drives do not support locks.

    Raises
    ------
    InputError
        If another program has locked it.
    """
    from filelock import FileLock, Timeout

    path = target.parent / f".{target.name}.lock"  # "/" has no name
    lock = FileLock(path)
    try:
        acquire(lock)
    except Timeout as error:
        raise InputError(
            target, "folder", "is being written by another program", "to wait for it"
        ) from error
    except (OSError, NotImplementedError):
        pass
    try:
        yield lock.is_locked
    finally:
        if lock.is_locked:
            # Before the release, so that the next writer creates a new file. Windows deletes it at
            # the release.
            with suppress(OSError):
                path.unlink()
            lock.release()


def write_file(path: Path, content: bytes) -> Path:
    """Write a file with `write_atomically` and return its path.

    Raises
    ------
    InputError
        If it cannot be written.
    """
    with os_errors_as_input(path, "file", "one that can be written"):
        write_atomically(path, content)
    return path


def relative_path(path: Path, folder: Path) -> str:
    """Return a path relative to a folder, with ``/``; absolute if there is no relative path."""
    try:
        return Path(os.path.relpath(path, folder)).as_posix()
    except ValueError:  # on another drive
        return path.absolute().as_posix()
