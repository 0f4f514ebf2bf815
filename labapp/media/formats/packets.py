"""Index of a video's packets, built by reading the file, and stored for the next opening."""

from __future__ import annotations

import dataclasses
import io
import json
import zipfile
import zlib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO, Self

import numpy as np
import numpy.typing as npt
from av.index import IndexEntry
from av.packet import Packet

from labapp.core.values import FloatArray, ReadOnlyArrays
from labapp.media.formats.stored import ends_early

IntArray = npt.NDArray[np.int64]
BoolArray = npt.NDArray[np.bool_]

MAGIC = b"labapp video index 1\n"

MOST_HEADERS_BYTE = 256
"""Most bytes between two packets of a file with a single stream; more mean a missing packet."""

MOST_AHEAD = 16
"""Most frames by which a codec's decoding order differs from the display order."""

MOST_BYTES = 2**28
"""Largest unpacked index, bytes: six million frames."""

ARRAYS = {"place": "i8", "key": "?", "seek": "i8", "number": "i8", "time_s": "f8"}
"""Arrays of a stored `PacketTable`, and their types."""

UNKNOWN = np.iinfo(np.int64).min
"""Stamp of a packet that has none."""


@dataclass(frozen=True)
class Packets:
    """Packets of a video in file order; n packets."""

    placed_by: str
    """Identifier of packets: offset in the file ("pos") or a time stamp ("pts", "dts")."""
    place: IntArray
    """Identifier of each packet, shape (n,)."""
    pts: IntArray
    dts: IntArray
    """Presentation and decoding time stamps, shape (n,), ticks; or `UNKNOWN`."""
    key: BoolArray
    """Whether it is a key frame, shape (n,)."""
    shown: BoolArray
    """Whether it yields a frame, shape (n,); edited MP4s contain packets that are not shown."""
    holed: bool = True
    """Whether there are gaps from damaged packets. True if in doubt."""

    def __len__(self) -> int:
        return len(self.place)

    @classmethod
    def read(cls, packets: Iterable[Packet[Any]], file_byte: int) -> Self:
        """Create from packets as read, limited by the size of the file."""
        rows = []
        ends = []
        byte = 0
        for packet in packets:
            byte += packet.size
            if byte > file_byte:
                break
            rows.append(
                [
                    *(UNKNOWN if x is None else x for x in (packet.pos, packet.pts, packet.dts)),
                    packet.is_keyframe,
                    not packet.is_discard,
                ]
            )
            ends.append(packet.size)
        pos, pts, dts, key, shown = np.array(rows, np.int64).reshape(-1, 5).T
        placed_by, place = next(
            ((name, stamp) for name, stamp in (("pos", pos), ("pts", pts)) if _differ(stamp)),
            ("dts", dts),
        )
        between = np.sort(pos)[1:] - np.sort(pos + ends)[:-1]
        holed = placed_by != "pos" or bool((between > MOST_HEADERS_BYTE).any())
        return cls(placed_by, place, pts, dts, key > 0, shown > 0, holed)

    @classmethod
    def listed(
        cls, entries: Sequence[IndexEntry], stream: int, claimed: int, path: Path
    ) -> Self | None:
        """Create from the index at the end of an AVI, without reading the packets.

        All chunks of the index must be in the file, in order and without large gaps, followed by
        the index only; and their number must be that in the header.

        Returns
        -------
        Packets or None
            None if the index does not match the file, which must then be read.
        """
        if not entries or len(entries) != claimed:
            return None
        names = [b"%02d" % stream + kind for kind in (b"db", b"dc")]
        end = entries[0].pos
        try:
            with path.open("rb", buffering=0) as file:
                for entry in entries:
                    if not 0 <= entry.pos - end <= MOST_HEADERS_BYTE:
                        return None
                    name, size, end = _chunk(file, entry.pos)
                    if name not in names or size != entry.size:
                        return None
                name, _, end = _chunk(file, end + end % 2)
                if name != b"idx1" or not 0 <= file.seek(0, 2) - end <= MOST_HEADERS_BYTE:
                    return None
        except OSError:
            return None
        shown = [entry for entry in entries if entry.size]
        place, stamp, key = (
            np.array([getattr(entry, name) for entry in shown])
            for name in ("pos", "timestamp", "is_keyframe")
        )
        return cls("pos", place + 8, stamp, stamp, key, np.ones(len(shown), bool))

    def completed(self, entries: Iterable[IndexEntry], file_byte: int) -> Self:
        """Complete with the index at the end of an AVI; unchanged if it contradicts the packets.

        Reading may stop at a damaged packet; the index lists all of them.
        """
        # The index has the offset of a chunk, a packet that of its content.
        rows = [
            (entry.pos + 8, entry.timestamp, entry.is_keyframe)
            for entry in entries
            if entry.size and entry.pos + 8 + entry.size <= file_byte
        ]
        place, stamp, key = np.array(rows, np.int64).reshape(-1, 3).T
        if self.placed_by != "pos" or not np.isin(self.place, place).all() or not _differ(place):
            return self
        return type(self)("pos", place, stamp, stamp, key > 0, np.ones(len(place), bool))

    def without_last(self) -> Self:
        """Return the packets without the last one in the file."""
        names = ("place", "pts", "dts", "key", "shown")
        return dataclasses.replace(self, **{name: getattr(self, name)[:-1] for name in names})

    def stamps_differ(self) -> bool:
        """Whether every packet has a unique presentation time stamp."""
        return _differ(self.pts)


def _chunk(file: BinaryIO, at: int) -> tuple[bytes, int, int]:
    """Read name, size and end of the chunk at an offset of an AVI."""
    file.seek(at)
    head = file.read(8)
    size = int.from_bytes(head[4:], "little")
    return head[:4], size, at + 8 + size


def _differ(values: IntArray) -> bool:
    return len(np.unique(values)) == len(values) and not (values == UNKNOWN).any()


def number_by_order(packets: Packets) -> IntArray:
    """Return the frame number of each packet, shape (n,), without reordering; −1: none."""
    return np.where(packets.shown, np.cumsum(packets.shown) - 1, -1)


def number_by_stamp(packets: Packets) -> IntArray:
    """Return the frame number of each packet, shape (n,), in order of time stamps; −1: none."""
    number = np.full(len(packets), -1, np.int64)
    order = np.argsort(packets.pts)
    order = order[packets.shown[order]]
    number[order] = np.arange(len(order))
    return number


@dataclass(frozen=True)
class Timing:
    """Timing in a video's header."""

    tick_s: float
    """Unit of the time stamps, s."""
    rate_hz: float | None
    """Average frame rate; None if unknown."""
    claimed: int
    """Number of frames; 0 if unknown."""
    stamped: bool
    """Whether presentation time stamps are reliable."""
    from_0: bool
    """Whether time begins at stamp 0, else at the first stamp."""


@dataclass(frozen=True)
class PacketTable(ReadOnlyArrays):
    """Index for random access to the frames of a video."""

    placed_by: str
    place: IntArray
    key: BoolArray
    """As in `Packets`."""
    seek: IntArray
    """Time stamps to seek to for each key frame, shape (keys, 2), ticks."""
    number: IntArray
    """Frame number of each packet, shape (n,); −1: none."""
    time_s: FloatArray
    """Time of each frame since the first, shape (frames,), s; NaN without a time base."""
    frame_rate_hz: float | None
    shape: tuple[int, int] = (0, 0)
    bit_depth: int = 8
    description: str = ""
    warnings: tuple[str, ...] = ()
    """As in `FrameSource`."""
    seekable: bool = True
    """Whether seeking is reliable."""
    slice_crc: bool = False
    """Whether packets have checksums, as FFV1's may."""

    @classmethod
    def build(cls, packets: Packets, number: IntArray, timing: Timing, name: str) -> Self:
        """Build the index: frame number of every packet, and time of every frame.

        ``number`` is the frame number of each packet, shape (n,), if no packet were missing.
        """
        shown = number >= 0
        stamp_s = np.full(int(number.max(initial=-1)) + 1, np.nan)
        if timing.stamped and not (packets.pts[shown] == UNKNOWN).any():
            stamp_s[number[shown]] = packets.pts[shown] * timing.tick_s
        elapsed_s = stamp_s - (0 if timing.from_0 else stamp_s[0])
        if not (np.diff(elapsed_s) >= 0).all():
            elapsed_s[:] = np.nan
        place = _places(elapsed_s, timing, packets)
        number = np.where(shown, place[number], -1)
        time_s = _times(elapsed_s, place, timing)
        # Fewer frames over the whole duration mean a varying rate, not an early end.
        last = np.nan_to_num(elapsed_s[-1] * (timing.rate_hz or 0), nan=-1.0)
        early = max(len(time_s), round(last) + 1) < timing.claimed
        key = packets.key & (number >= 0)
        return cls(
            packets.placed_by,
            packets.place,
            key,
            np.stack([packets.pts[key], packets.dts[key]], axis=1),
            number,
            time_s,
            timing.rate_hz,
            warnings=ends_early(name, timing.claimed, len(elapsed_s)) if early else (),
        )

    def seek_stamps(self, packet: int) -> list[int]:
        """Return time stamps for seeking to a key packet, the best first; empty: read from 0."""
        if not self.seekable or packet == 0:
            return []
        stamps = self.seek[np.count_nonzero(self.key[:packet])].tolist()
        return [stamp for stamp in dict.fromkeys(stamps) if stamp != UNKNOWN]

    def to_bytes(self, fingerprint: tuple[int, int]) -> bytes:
        """Serialise for the file with this fingerprint."""
        buffer = io.BytesIO()
        values = {field.name: getattr(self, field.name) for field in dataclasses.fields(self)}
        arrays = {k: v for k, v in values.items() if isinstance(v, np.ndarray)}
        others = {k: v for k, v in values.items() if k not in arrays}
        np.savez(buffer, allow_pickle=False, **arrays)
        others["fingerprint"] = fingerprint
        text = json.dumps(others).encode()
        body = zlib.compress(len(text).to_bytes(4, "big") + text + buffer.getvalue(), 1)
        return MAGIC + zlib.crc32(body).to_bytes(4, "big") + body

    @classmethod
    def from_bytes(cls, content: bytes, fingerprint: tuple[int, int]) -> Self | None:
        """Deserialise the result of `to_bytes`; None if damaged, forged or of another file."""
        head = len(MAGIC)
        body = content[head + 4 :]
        if content[:head] != MAGIC or content[head : head + 4] != zlib.crc32(body).to_bytes(
            4, "big"
        ):
            return None
        try:
            table = cls._read(body, fingerprint)
            return table if table is not None and _is_as_built(table) else None
        except Exception:
            return None  # forged content can raise many errors in NumPy, zipfile and json

    @classmethod
    def _read(cls, body: bytes, fingerprint: tuple[int, int]) -> Self | None:
        content = zlib.decompressobj().decompress(body, MOST_BYTES)
        end = 4 + int.from_bytes(content[:4], "big")
        others = json.loads(content[4:end])
        if tuple(others.pop("fingerprint")) != fingerprint:
            return None
        others["shape"] = tuple(others["shape"])
        others["warnings"] = tuple(others["warnings"])
        with np.load(io.BytesIO(content[end:]), allow_pickle=False) as arrays:
            # Uncompressed members cannot exceed the available bytes.
            if any(entry.compress_type != zipfile.ZIP_STORED for entry in arrays.zip.infolist()):
                return None
            return cls(**others, **{name: arrays[name] for name in ARRAYS})


def _is_as_built(table: Any) -> bool:
    """Whether an index is valid, as that of a session may be forged."""
    packets, frames = table.place.shape, table.time_s.shape
    shapes = (packets, packets, (np.count_nonzero(table.key), 2), packets, frames)
    arrays = [getattr(table, name) for name in ARRAYS]
    size, rate = table.shape, table.frame_rate_hz
    return (
        [array.dtype for array in arrays] == list(ARRAYS.values())
        and all(array.shape == shape for array, shape in zip(arrays, shapes, strict=True))
        and len(packets) == len(frames) == 1
        and -1 <= table.number.min() <= table.number.max() < frames[0]
        and table.placed_by in ("pos", "pts", "dts")
        and (rate is None or (isinstance(rate, float) and 0 < rate < np.inf))
        and len(size) == 2
        and all(type(each) is int for each in (*size, table.bit_depth))
        and all(isinstance(each, str) for each in (table.description, *table.warnings))
        and all(isinstance(each, bool) for each in (table.seekable, table.slice_crc))
    )


def _places(elapsed_s: FloatArray, timing: Timing, packets: Packets) -> IntArray:
    """Return the number of each frame, shape (n,), counting missing frames shown by time stamps.

    Time stamps show them if all are multiples of the interval, and the last one is that claimed by
    the header. If the file has no gaps, and gaps in time are not near a truncated end, the camera
    omitted the frames, which are not counted.
    """
    plain = np.arange(len(elapsed_s))
    missing = len(plain) < timing.claimed <= 2 * len(plain)
    if not missing or timing.rate_hz is None or np.isnan(elapsed_s).any():
        return plain
    place = elapsed_s * timing.rate_hz
    number = np.rint(place).astype(np.int64)
    on_grid = np.abs(place - number).max() < 0.25 and (np.diff(number) > 0).all()
    gaps = np.flatnonzero(np.diff(number) > 1)
    lost = packets.holed or (gaps >= len(plain) - MOST_AHEAD).all()
    return number if lost and on_grid and number[-1] == timing.claimed - 1 else plain


def _times(elapsed_s: FloatArray, place: IntArray, timing: Timing) -> FloatArray:
    """Return the time of each frame since the first, shape (frames,), s."""
    if timing.rate_hz is None:
        since_first: FloatArray = elapsed_s - elapsed_s[0]
        return since_first
    regular: FloatArray = np.arange(place[-1] + 1) / timing.rate_hz
    # Containers round stamps to ticks (Matroska: 1 ms); larger deviations are real.
    if (np.abs(elapsed_s - regular[place]) > 1.5 * timing.tick_s).any():
        regular[place] = elapsed_s
    return regular
