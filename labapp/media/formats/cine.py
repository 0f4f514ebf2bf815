"""Phantom .cine recordings, by the format published by Vision Research ("Cine File Format")."""

from __future__ import annotations

import struct
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
import numpy.typing as npt

from labapp.bundled import bundled
from labapp.core.values import FloatArray
from labapp.errors import InputError
from labapp.media.base import GreyImage, to_grey
from labapp.media.formats.stored import (
    StoredFrames,
    ends_early,
    file_size,
    increasing,
    plausible_rate,
    rate_of,
    read_bytes,
    unpack_bits,
)

CINE_MAGIC = b"CI\x2c\x00"
"""Type and Headersize, the first fields of CINEFILEHEADER."""

A_CINE = "a Phantom .cine recording, saved uncompressed or packed"

CINEFILEHEADER = struct.Struct("<2s3HiIiI3I2I")
BITMAPINFOHEADER = struct.Struct("<I2i2H2I2i2I")

# Fields of SETUP that are used: offset from its start, without alignment.
FRAME_RATE_16, MARK, LENGTH = 0, 140, 142
FLIP_H, FLIP_V, FRAME_RATE, CFA, ROTATE, REAL_BPP = 756, 760, 768, 808, 884, 896
SETUP_USED = 900

LEAD, UNINTERPOLATED = 1, 2
"""Compression in CINEFILEHEADER: lossy JPEG; raw levels of a colour filter array."""

PACKED_BITS = {256: 10, 1024: 12}
"""biCompression of packed levels: bits of each."""

TIME_ONLY = 1002
"""Type of the tagged block with a time stamp for every image."""

MAX_BLOCKS = 1000
"""Most tagged blocks that are searched; recordings have two or three."""


@dataclass(frozen=True)
class _Format:
    """Storage format of an image; `image_bytes` is without padding of the rows."""

    rows: int
    columns: int
    bit_count: int
    packed_bits: int | None
    top_down: bool

    @property
    def row_bits(self) -> int:
        return self.columns * (self.packed_bits or self.bit_count)

    @property
    def image_bytes(self) -> int:
        if self.packed_bits:  # Rows follow each other without a gap.
            return -(-self.rows * self.row_bits // 8)
        return self.rows * self.row_bits // 8


@dataclass(frozen=True)
class _Setup:
    """Fields of the structure SETUP that are used."""

    length: int
    frame_rate_hz: float | None
    real_bits: int | None
    filtered: bool
    shown_turned: bool


class CineSource(StoredFrames):
    """A Phantom recording: 8 and 16 bit, packed 10 and 12 bit, grey, colour or raw Bayer.

    Levels are those of the sensor, with its bits (RealBPP); packed 10 bit levels are converted to
    linear 12 bit levels by the published table. Times are the recorded time stamps (block 1002).

    Raises
    ------
    InputError
        If it is not such a recording, or has no complete frame.
    """

    def __init__(self, path: Path) -> None:
        size = file_size(path)
        if size < CINEFILEHEADER.size:
            raise InputError(path, "size", f"{size} bytes", A_CINE)
        (magic, header_size, compression, _, _, _, _, claimed, image_at, setup_at, table_at, *_) = (
            CINEFILEHEADER.unpack(read_bytes(path, 0, CINEFILEHEADER.size))
        )
        if magic + struct.pack("<H", header_size) != CINE_MAGIC:
            raise InputError(path, "Type", magic.decode("latin-1"), A_CINE)
        if compression == LEAD:
            raise InputError(path, "Compression", "JPEG", A_CINE)
        if compression not in (0, UNINTERPOLATED):
            raise InputError(path, "Compression", compression, A_CINE)
        self._format = _read_format(path, image_at, size)
        setup = _read_setup(path, setup_at, size)
        self._places = _read_places(path, table_at, claimed, size, self._format)
        count = len(self._places)
        time_s = _read_times(path, setup_at + setup.length, table_at, claimed)
        warnings = [*ends_early(path.name, claimed, count)]
        if time_s is not None and not increasing(time_s[:count]):
            time_s = None
            warnings.append(
                f"{path.name}: its time stamps do not increase; times follow from the frame rate"
            )
        rate = setup.frame_rate_hz
        if rate is None and time_s is not None and count > 1:
            rate = rate_of(time_s[:count])
        if compression == UNINTERPOLATED and setup.filtered:
            warnings.append(
                f"{path.name} is raw colour (Bayer): its levels are read as grey levels"
            )
        if setup.shown_turned:
            warnings.append(
                f"{path.name} is marked to be shown flipped or rotated: it is read as stored"
            )
        self.warnings = tuple(warnings)
        super().__init__(
            path,
            "Phantom cine",
            count,
            (self._format.rows, self._format.columns),
            _bit_depth(self._format, setup.real_bits),
            colour=self._format.bit_count in (24, 48),
            frame_rate_hz=rate,
            time_s=None if time_s is None else time_s[:count],
        )

    def _grey(self, index: int) -> GreyImage:
        form, place = self._format, int(self._places[index])
        size = file_size(self._path)
        if not 0 < place <= size - 8 - form.image_bytes:
            raise self._wrong(index, f"offset {place}", f"an offset within {size} bytes")
        (annotation,) = struct.unpack("<I", read_bytes(self._path, place, 4))
        if not 8 <= annotation <= size - place - form.image_bytes:
            raise self._wrong(index, f"annotation of {annotation} bytes", "8 bytes or more")
        (stored,) = struct.unpack("<I", read_bytes(self._path, place + annotation - 4, 4))
        stride = form.row_bits // 8
        padded = -(-stride // 4) * 4
        if not form.packed_bits and stored == form.rows * padded:
            stride = padded
        elif stored != form.image_bytes:
            raise self._wrong(index, f"{stored} bytes", f"{form.image_bytes} bytes")
        content = read_bytes(self._path, place + annotation, stored)
        return _decode(content, form, stride)

    def _wrong(self, index: int, value: str, expected: str) -> InputError:
        return InputError(self._path, f"frame {index}", value, expected)


@cache
def _linear_12_bit() -> npt.NDArray[np.uint16]:
    """Return the published linear 12 bit level of every 10 bit level, shape (1024,)."""
    return np.loadtxt(bundled("resources/formats/cine_10_to_12_bit.txt"), np.uint16)


def _decode(content: bytes, form: _Format, stride: int) -> GreyImage:
    """Decode grey levels, shape (rows, columns), the first row at the top."""
    if form.packed_bits:
        levels = unpack_bits(content, form.packed_bits)[: form.rows * form.columns]
        image: npt.NDArray[np.uint16] = levels.reshape(form.rows, form.columns)
        return _linear_12_bit()[image] if form.packed_bits == 10 else image
    kind = np.dtype("u1") if form.bit_count in (8, 24) else np.dtype("<u2")
    channels = 3 if form.bit_count in (24, 48) else 1
    used = form.row_bits // 8
    rows = np.frombuffer(content, np.uint8).reshape(form.rows, stride)[:, :used]
    pixels = np.ascontiguousarray(rows if form.top_down else rows[::-1]).view(kind)
    if channels == 3:  # Blue first, as in every BITMAPINFOHEADER picture.
        return to_grey(pixels.reshape(form.rows, form.columns, 3).astype(kind.newbyteorder("=")))
    return pixels.astype(kind.newbyteorder("="), copy=False)


def _bit_depth(form: _Format, real_bits: int | None) -> int:
    if form.packed_bits:
        return 12
    stored = 8 if form.bit_count in (8, 24) else 16
    return real_bits if real_bits is not None and 1 <= real_bits <= stored else stored


def _read_format(path: Path, at: int, size: int) -> _Format:
    if at + BITMAPINFOHEADER.size > size:
        raise InputError(path, "OffImageHeader", at, f"an offset within {size} bytes")
    content = read_bytes(path, at, BITMAPINFOHEADER.size)
    _, columns, rows, _, bit_count, compression, *_ = BITMAPINFOHEADER.unpack(content)
    if columns <= 0 or rows == 0:
        raise InputError(path, "biWidth × biHeight", f"{columns} × {rows}", "1 × 1 px or more")
    packed = PACKED_BITS.get(compression)
    if compression and packed is None:
        expected = "0, 256 (packed 10 bit) or 1024 (packed 12 bit)"
        raise InputError(path, "biCompression", compression, expected)
    if bit_count not in ((8, 16) if packed else (8, 16, 24, 48)):
        expected = "16" if packed else "8, 16, 24 or 48"
        raise InputError(path, "biBitCount", bit_count, expected)
    # Packed images are stored top-down; others if their height is negative.
    form = _Format(abs(rows), columns, bit_count, packed, packed is not None or rows < 0)
    if form.image_bytes > size:
        raise InputError(
            path, "biWidth × biHeight", f"{columns} × {rows}", f"frames that fit in {size} bytes"
        )
    return form


def _read_setup(path: Path, at: int, size: int) -> _Setup:
    used = min(SETUP_USED, size - at)
    if used < LENGTH + 2:
        raise InputError(path, "OffSetup", at, f"an offset within {size} bytes")
    content = read_bytes(path, at, used)
    if content[MARK : MARK + 2] != b"ST":
        raise InputError(path, "SETUP", "no mark ST", A_CINE)
    (length,) = struct.unpack_from("<H", content, LENGTH)

    def field(offset: int) -> int | None:
        # SETUP is shorter in older versions of the camera's software.
        if offset + 4 > min(length, used):
            return None
        return int(struct.unpack_from("<i", content, offset)[0])

    rate = field(FRAME_RATE)
    if rate is None:
        (rate,) = struct.unpack_from("<H", content, FRAME_RATE_16)
    return _Setup(
        length=length,
        frame_rate_hz=plausible_rate(rate & 0xFFFFFFFF),
        real_bits=field(REAL_BPP),
        # The high byte distinguishes the heads of cameras with several.
        filtered=bool((field(CFA) or 0) & 0xFFFFFF),
        shown_turned=any(field(offset) for offset in (FLIP_H, FLIP_V, ROTATE)),
    )


def _read_places(
    path: Path, at: int, claimed: int, size: int, form: _Format
) -> npt.NDArray[np.uint64]:
    """Return the offset of every complete image, shape (n,)."""
    if claimed == 0:
        raise InputError(path, "ImageCount", 0, "1 frame or more")
    possible = min(claimed, max(size - at, 0) // 8, size // (8 + form.image_bytes))
    places = np.frombuffer(read_bytes(path, at, 8 * possible) if possible else b"", "<u8")
    whole = np.flatnonzero((places > 0) & (places <= max(size - 8 - form.image_bytes, 0)))
    if not len(whole):
        raise InputError(path, "frames", "no complete one", A_CINE)
    # An invalid offset in the middle keeps its number; those after the last valid one are dropped.
    return places[: whole[-1] + 1]


def _read_times(path: Path, at: int, end: int, count: int) -> FloatArray | None:
    """Read the images' times since the first, s, from the tagged blocks at ``at`` … ``end``."""
    size = file_size(path)
    for _ in range(MAX_BLOCKS):
        if at + 8 > min(end, size):
            return None
        block, kind, _ = struct.unpack("<I2H", read_bytes(path, at, 8))
        if block < 8 or at + block > min(end, size):
            return None
        if kind == TIME_ONLY and block - 8 >= 8 * count:
            stamps = np.frombuffer(read_bytes(path, at + 8, 8 * count), "<u4").reshape(-1, 2)
            # TIME64: fraction in 2⁻³² s, whose two lowest bits are flags, and seconds.
            fraction = (stamps[:, 0] & 0xFFFFFFFC).astype(np.float64) / 2**32
            seconds = stamps[:, 1].astype(np.float64)
            elapsed: FloatArray = (seconds - seconds[0]) + (fraction - fraction[0])
            return elapsed
        at += block
    return None
