"""Files that a command writes into a folder: replaced only if unchanged since it wrote them.

The record ``COMMAND.json`` beside the files holds their checksums, so that a file of the user's, or
one that the user has edited, is never lost.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Collection, Mapping
from pathlib import Path

from labapp.errors import InputError, os_errors_as_input
from labapp.files import as_json, read_limited, sha256_of, write_file
from labapp.version import VERSION

LARGEST_RECORD = 1 << 28


def check_owned(folder: Path, command: str, names: Collection[str] = ()) -> None:
    """Check that a command may replace its earlier files in a folder, and write others.

    Parameters
    ----------
    folder
        The folder; it need not exist.
    command
        Name of the command: ``dynamics``.
    names
        Names of the files that it may write.

    Raises
    ------
    InputError
        If one of the names is a file that the command did not write, an earlier file has changed
        since, or either is a link.
    """
    check_added(folder, command, {*_recorded(folder, command), *names})


def check_added(folder: Path, command: str, names: Collection[str]) -> None:
    """Check that a command may write files beside its earlier ones; others are not looked at.

    Raises
    ------
    InputError
        As `check_owned`, for these names.
    """
    recorded = _recorded(folder, command)
    expected = "another folder, or this file moved out of it"
    for name in sorted({f"{command}.json", *names}):
        path = folder / name
        if path.is_symlink():
            raise InputError(folder, name, "is a link", expected)
        if name == f"{command}.json" or not path.exists():
            continue
        if name not in recorded:
            found = f"is there, and labapp {command} did not write it"
            raise InputError(folder, name, found, expected)
        with os_errors_as_input(path, "file", "one that can be read"):
            has_changed = sha256_of(path) != recorded[name]
        if has_changed:
            found = f"has changed since labapp {command} wrote it"
            raise InputError(folder, name, found, expected)


def write_owned(folder: Path, command: str, files: Mapping[str, bytes]) -> None:
    """Replace a command's earlier files in a folder by new ones, and record their checksums.

    Parameters
    ----------
    files
        File name → content.

    Raises
    ------
    InputError
        As `check_owned`, before anything is written; or if a file cannot be written.
    """
    check_owned(folder, command, files)
    recorded = _recorded(folder, command)
    with os_errors_as_input(folder, "folder", "one that can be written"):
        for name in recorded.keys() - files.keys():
            (folder / name).unlink(missing_ok=True)
    _write(folder, command, files, {})


def add_owned(folder: Path, command: str, files: Mapping[str, bytes]) -> None:
    """Write files beside a command's earlier ones, and record their checksums with those.

    Raises
    ------
    InputError
        As `check_added`, before anything is written; or if a file cannot be written.
    """
    check_added(folder, command, files)
    _write(folder, command, files, _recorded(folder, command))


def _write(
    folder: Path, command: str, files: Mapping[str, bytes], others: Mapping[str, str]
) -> None:
    """Write files, and the record of these and of others, checksums by name."""
    for name, content in files.items():
        write_file(folder / name, content)
    checksums = {name: hashlib.sha256(content).hexdigest() for name, content in files.items()}
    record = {
        "program": "labapp",
        "version": VERSION,
        "command": command,
        "files": {**others, **checksums},
    }
    write_file(folder / f"{command}.json", as_json(record))


def _recorded(folder: Path, command: str) -> dict[str, str]:
    """Names and checksums of the files that a command wrote into a folder earlier."""
    path = folder / f"{command}.json"
    if not path.is_file():
        return {}
    expected = f"the record of labapp {command}, unchanged"
    try:
        found = json.loads(read_limited(path, LARGEST_RECORD, expected))["files"]
        names = {name: str(checksum) for name, checksum in found.items()}
    except (ValueError, TypeError, KeyError, AttributeError, RecursionError) as error:
        raise InputError(path, "files", "cannot be read", expected) from error
    if any(Path(name).name != name for name in names):  # no path of a record is followed
        raise InputError(path, "files", "holds a path", expected)
    return names
