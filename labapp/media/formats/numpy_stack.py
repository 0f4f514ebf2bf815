"""Frames from NumPy files: a stack in a .npy, or in a .npz with times."""

from __future__ import annotations

import math
import mmap
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import IO, Any

import numpy as np
import numpy.typing as npt

from labapp.core.values import FloatArray
from labapp.errors import InputError, os_errors_as_input
from labapp.media.base import GreyImage, to_grey
from labapp.media.formats.stored import (
    READABLE,
    StoredFrames,
    ends_early,
    file_size,
    finite,
    increasing,
    plausible_rate,
    rate_of,
)

NPY_MAGIC = np.lib.format.MAGIC_PREFIX
ZIP_MAGIC = b"PK\x03\x04"

A_STACK = "an array of shape (frames, rows, columns) or (frames, rows, columns, 3 or 4)"
A_NPZ = f"a .npz with {A_STACK} named frames"

BIT_DEPTHS = {"bool": 8, "uint8": 8, "uint16": 16}

NUMBERS = "an array of numbers (uint8, uint16, float32 …), no Python objects"

MOST_HELD = 2**30
"""Largest compressed array, which is decompressed in memory, bytes."""

NOT_HELD = f"at most {MOST_HELD} bytes, or an uncompressed array (numpy.savez)"

A_DEFLATED = "an array as numpy.savez or numpy.savez_compressed writes it"

READ_BYTES = 2**20

AS_NUMPY_DOES = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
"""Supported compressions. For others zipfile decompresses without a limit."""

DEFLATE_RATIO = 1032
"""Largest compression ratio of Deflate."""


class NumpyStack(StoredFrames):
    """An array (frames, rows, columns), grey, or (frames, rows, columns, 3 or 4), R, G, B, alpha.

    An uncompressed array (.npy, and .npz by `numpy.savez`) is memory-mapped; a compressed one is
    loaded. Booleans become 0 and 255; types other than uint8 and uint16 become float32. A .npz may
    contain ``time_s`` or ``frame_rate_hz``.

    Raises
    ------
    InputError
        If it has no such array, Python objects, or no complete frame.
    """

    def __init__(self, path: Path, *, archive: bool) -> None:
        time_s, rate, claimed = None, None, 0
        with os_errors_as_input(path, "file", READABLE):
            if archive:
                self._frames, time_s, rate = _from_archive(path)
            else:
                with path.open("rb") as file:
                    self._frames, claimed = _map_array(path, file, 0, file_size(path))
        count, rows, columns = self._frames.shape[:3]
        self.warnings = ends_early(path.name, claimed, count)
        kind = self._frames.dtype
        super().__init__(
            path,
            "NumPy archive" if archive else "NumPy stack",
            count,
            (rows, columns),
            BIT_DEPTHS.get(kind.newbyteorder("=").name, 32),
            colour=self._frames.ndim == 4,
            frame_rate_hz=rate,
            time_s=time_s,
        )

    def close(self) -> None:
        """Release the file, which is mapped while its array exists."""
        self._frames = self._frames[:0].copy()

    def _grey(self, index: int) -> GreyImage:
        image = np.asarray(self._frames[index])
        if image.dtype == bool:
            image = image.astype(np.uint8) * np.uint8(255)
        else:
            image = image.astype(image.dtype.newbyteorder("="))
        return finite(self._path, to_grey(image if image.ndim == 2 else image[..., 2::-1]))


def _header(path: Path, file: IO[bytes]) -> tuple[tuple[int, ...], bool, np.dtype[Any]]:
    """Read shape, Fortran order and type of the array at the position of ``file``."""
    try:
        is_first = np.lib.format.read_magic(file) == (1, 0)
        read = np.lib.format.read_array_header_1_0
        read = read if is_first else np.lib.format.read_array_header_2_0
        shape, columns_first, kind = read(file)
    except Exception as error:
        # The header is the text of a Python dict: damage raises nearly every kind of error.
        raise InputError(
            path,
            "header",
            error if isinstance(error, zipfile.BadZipFile) else "is damaged",
            "that of a NumPy array",
        ) from error
    if kind.kind not in "buif" or kind.itemsize > 8:
        raise InputError(path, "type", f"'{kind.str}'", NUMBERS)
    return shape, columns_first, kind


def _is_stack(path: Path, shape: tuple[int, ...]) -> None:
    if not (len(shape) == 3 or (len(shape) == 4 and shape[3] in (3, 4))) or min(shape) < 1:
        raise InputError(path, "shape", shape, A_STACK)


def _map_array(path: Path, file: IO[bytes], start: int, end: int) -> tuple[npt.NDArray[Any], int]:
    """Map the complete frames of the array at bytes ``start`` … ``end``; returns the claim, too."""
    file.seek(start)
    shape, columns_first, kind = _header(path, file)
    _is_stack(path, shape)
    room = end - file.tell()
    frame_bytes = math.prod(shape[1:]) * kind.itemsize
    whole = min(shape[0], max(room, 0) // frame_bytes)
    if whole < 1 or (columns_first and whole < shape[0]):
        needed = frame_bytes * (shape[0] if columns_first else 1)
        raise InputError(path, "size", f"{room} bytes of levels", f"{needed} bytes or more")
    mapped = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
    frames = np.ndarray(
        (whole, *shape[1:]), kind, mapped, file.tell(), order="F" if columns_first else "C"
    )
    return frames, shape[0]


def _from_archive(
    path: Path,
) -> tuple[npt.NDArray[Any], FloatArray | None, float | None]:
    """Read frames, times and frame rate of a .npz."""
    with path.open("rb") as file:
        try:
            archive = zipfile.ZipFile(file)
        except (zipfile.BadZipFile, ValueError, OSError, NotImplementedError) as error:
            raise InputError(path, "content", error, A_NPZ) from error
        members: dict[str, zipfile.ZipInfo] = {}
        for entry in archive.infolist():
            name = entry.filename.removesuffix(".npy")
            if name in members:
                raise InputError(path, "arrays", f"{name} twice", A_NPZ)
            if name != entry.filename:
                members[name] = entry
        for entry in members.values():
            if entry.compress_type not in AS_NUMPY_DOES:
                raise InputError(path, entry.filename, "packed by another program", A_DEFLATED)
        frames = _archived_frames(path, file, archive, members)
        time_s = rate = None
        if "time_s" in members:
            time_s = _load(
                path,
                archive,
                members["time_s"],
                lambda at, shape: _is_times(at, shape, len(frames)),
            )
            if not increasing(time_s.astype(np.float64)):
                raise InputError(path, "time_s", "not increasing", _times_of(len(frames)))
            time_s = time_s.astype(np.float64) - float(time_s[0])
            if len(frames) > 1:
                rate = rate_of(time_s)
        if "frame_rate_hz" in members:
            rate_array = _load(path, archive, members["frame_rate_hz"], _is_one)
            rate = plausible_rate(float(rate_array.ravel()[0]))
            if rate is None:
                raise InputError(path, "frame_rate_hz", rate_array, "frames a second, above 0")
        return frames, time_s, rate


def _archived_frames(
    path: Path, file: IO[bytes], archive: zipfile.ZipFile, members: dict[str, zipfile.ZipInfo]
) -> npt.NDArray[Any]:
    entry = members.get("frames")
    if entry is None:
        stacks = [name for name in members if name not in ("time_s", "frame_rate_hz")]
        if len(stacks) != 1:
            raise InputError(path, "arrays", ", ".join(sorted(members)) or "none", A_NPZ)
        entry = members[stacks[0]]
    if entry.compress_type == zipfile.ZIP_STORED and not entry.flag_bits & 1:
        # The array follows the member's local header, with name and extra field of variable length.
        file.seek(entry.header_offset)
        head = file.read(30)
        if len(head) == 30 and head[:4] == ZIP_MAGIC:
            _check_sum(path, archive, entry)
            lengths = int.from_bytes(head[26:28], "little") + int.from_bytes(head[28:], "little")
            start = entry.header_offset + 30 + lengths
            frames, claimed = _map_array(
                path, file, start, min(start + entry.file_size, file_size(path))
            )
            if len(frames) == claimed:
                return frames
        raise InputError(path, entry.filename, "cut off", A_NPZ)
    return _load(path, archive, entry, _is_stack)


def _check_sum(path: Path, archive: zipfile.ZipFile, entry: zipfile.ZipInfo) -> None:
    """Read all of a member, by which zipfile verifies its checksum."""
    try:
        with archive.open(entry) as file:
            while file.read(READ_BYTES):
                pass
    except Exception as error:  # as in `_load`
        raise InputError(path, entry.filename, error, "a complete array") from error


def _is_times(path: Path, shape: tuple[int, ...], count: int) -> None:
    if shape != (count,):
        raise InputError(path, "time_s", f"shape {shape}", _times_of(count))


def _times_of(count: int) -> str:
    return f"{count} increasing times, one for every frame, s"


def _is_one(path: Path, shape: tuple[int, ...]) -> None:
    if math.prod(shape) != 1:
        raise InputError(path, "frame_rate_hz", f"shape {shape}", "one number")


def _load(
    path: Path,
    archive: zipfile.ZipFile,
    entry: zipfile.ZipInfo,
    check: Callable[[Path, tuple[int, ...]], None],
) -> npt.NDArray[Any]:
    """Read a member whose shape passes ``check``, if its size is plausible."""
    try:
        with archive.open(entry) as file:
            shape, columns_first, kind = _header(path, file)
            check(path, shape)
            needed = math.prod(shape) * kind.itemsize
            if needed > min(entry.file_size, entry.compress_size * DEFLATE_RATIO + 1024):
                raise InputError(
                    path, entry.filename, f"{entry.file_size} bytes", f"{needed} bytes"
                )
            if needed > MOST_HELD:
                raise InputError(path, entry.filename, f"{needed} bytes, compressed", NOT_HELD)
            content = file.read(needed)
            done = len(content) + len(file.read(1))  # up to the end, where the checksum is verified
    except InputError:
        raise
    except Exception as error:
        # Damage, a password or an unsupported compression raise different errors.
        raise InputError(path, entry.filename, error, "a complete array") from error
    if done != needed:
        raise InputError(path, entry.filename, f"{done} bytes", f"{needed} bytes")
    return np.ndarray(shape, kind, content, order="F" if columns_first else "C")
