"""Base class of readers whose frames are at known offsets in a file."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt

from labapp.core.values import FloatArray
from labapp.errors import InputError, os_errors_as_input
from labapp.files import regular_size
from labapp.media.base import Frame, FrameSource, GreyImage, check_index, format_frame_rate
from labapp.pixels import MOST_PIXELS

READABLE = "a file that may be read"

Read = TypeVar("Read")


class StoredFrames(FrameSource):
    """Source that reads frames by `_grey`, in any order and without state.

    Parameters
    ----------
    kind
        Start of the description: "Phantom cine".
    count
        Number of frames, at least 1.
    shape
        (rows, columns).
    bit_depth
        Significant bits of a grey level.
    frame_rate_hz
        Frame rate, Hz; None if unknown.
    time_s
        Time of every frame since the first, shape (count,), s; None: from the frame rate.

    Raises
    ------
    InputError
        If a frame has more than `MOST_PIXELS`.
    """

    warnings: tuple[str, ...] = ()

    def __init__(
        self,
        path: Path,
        kind: str,
        count: int,
        shape: tuple[int, int],
        bit_depth: int,
        *,
        colour: bool = False,
        frame_rate_hz: float | None = None,
        time_s: FloatArray | None = None,
    ) -> None:
        if math.prod(shape) > MOST_PIXELS:
            raise too_large(path, *shape)
        self.name = path.name or str(path)
        self.shape = shape
        self.bit_depth = bit_depth
        self.frame_rate_hz = frame_rate_hz
        rate = "" if frame_rate_hz is None else f", {format_frame_rate(frame_rate_hz)}"
        self.description = (
            f"{kind}, {shape[1]}×{shape[0]} px, {bit_depth} bit "
            f"{'colour' if colour else 'grey'}{rate}"
        )
        self._path = path
        self._count = count
        self._time_s = time_s

    def __len__(self) -> int:
        return self._count

    def frame(self, index: int) -> Frame:
        """Read frame ``index``; see `FrameSource.frame`."""
        check_index(self, index)
        return Frame(index, self._time(index), self._grey(index))

    def _time(self, index: int) -> float | None:
        if self._time_s is not None:
            return float(self._time_s[index])
        return None if self.frame_rate_hz is None else index / self.frame_rate_hz

    def _grey(self, index: int) -> GreyImage:
        """Grey levels of frame ``index``, shape `shape`."""
        raise NotImplementedError


def too_large(path: Path, rows: int, columns: int) -> InputError:
    """Return the error for a frame of more than `MOST_PIXELS` pixels."""
    size = f"{columns}×{rows} px"
    return InputError(path, "frame size", size, f"at most {MOST_PIXELS} px in a frame")


def ends_early(name: str, claimed: int, whole: int) -> tuple[str, ...]:
    """Return a warning if a recording has fewer complete frames than its header claims."""
    if whole >= claimed:
        return ()
    return (f"{name} ends early: its header says {claimed} frames, {whole} of them complete",)


def plausible_rate(value: float) -> float | None:
    """Return ``value`` as a frame rate, Hz; None if it is not plausible."""
    return float(value) if np.isfinite(value) and 0 < value < 1e12 else None


def rate_of(time_s: FloatArray) -> float | None:
    """Return the frame rate of two or more times by their median step, Hz; None if implausible."""
    return plausible_rate(float(1 / np.median(np.diff(time_s))))


def first_readable(read: Callable[[int], Read], count: int) -> Read:
    """Return the first of ``count`` pictures that can be read; raise the first error if none."""
    refused: list[InputError] = []
    for index in range(count):
        try:
            return read(index)
        except InputError as error:
            refused.append(error)
    raise refused[0]


def check_shape(
    path: Path, field: str, image: GreyImage, shape: tuple[int, int], others: str
) -> GreyImage:
    """Return ``image``; raise unless it has the shape (rows, columns) of the others before it."""
    if image.shape != shape:
        rows, columns = shape
        found = f"{image.shape[1]}×{image.shape[0]} px"
        raise InputError(path, field, found, f"{columns}×{rows} px like the {others} before it")
    return image


def increasing(time_s: FloatArray) -> bool:
    """Whether times are finite and strictly increasing."""
    return bool(np.isfinite(time_s).all() and (np.diff(time_s) > 0).all())


def finite(path: Path, image: GreyImage) -> GreyImage:
    """Return ``image``; raise if a level is NaN or infinite."""
    if image.dtype.kind == "f" and not np.isfinite(image).all():
        raise InputError(path, "grey levels", "NaN or infinity", "finite grey levels")
    return image


def file_size(path: Path) -> int:
    """Return the size of a regular file, bytes.

    Raises
    ------
    InputError
        If it is not regular, or does not exist.
    """
    with os_errors_as_input(path, "file", READABLE):
        return regular_size(path)


def read_bytes(path: Path, offset: int, size: int) -> bytes:
    """Read ``size`` bytes at ``offset``.

    Raises
    ------
    InputError
        If the file cannot be opened or is too short.
    """
    with os_errors_as_input(path, "file", READABLE), path.open("rb") as file:
        file.seek(offset)
        content = file.read(size)
    if len(content) != size:
        raise InputError(
            path, "size", f"{offset + len(content)} bytes", f"at least {offset + size} bytes"
        )
    return content


def unpack_bits(packed: bytes, bits: int) -> npt.NDArray[np.uint16]:
    """Unpack levels of ``bits`` bits, stored without gaps, the highest bit first.

    Parameters
    ----------
    packed
        n levels in n·bits/8 bytes; remaining bits are ignored.
    bits
        1 … 16.

    Returns
    -------
    Levels, shape (n,).
    """
    content = np.frombuffer(packed, np.uint8)
    if bits == 12:  # Fast path for the most frequent case: three bytes are two levels.
        triples = content[: len(content) // 3 * 3].reshape(-1, 3).astype(np.uint16)
        pairs: npt.NDArray[np.uint16] = np.empty((len(triples), 2), np.uint16)
        pairs[:, 0] = triples[:, 0] << 4 | triples[:, 1] >> 4
        pairs[:, 1] = (triples[:, 1] & 15) << 8 | triples[:, 2]
        last = content[len(triples) * 3 :].astype(np.uint16)
        odd = [last[0] << 4 | last[1] >> 4] if len(last) == 2 else []
        return np.append(pairs.ravel(), np.array(odd, np.uint16))
    count = len(content) * 8 // bits
    levels: npt.NDArray[Any] = np.zeros(count, np.uint16)
    each = np.unpackbits(content, count=count * bits).reshape(count, bits)
    for column in each.T:
        levels = levels << 1 | column
    return levels
