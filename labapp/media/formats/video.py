"""Frames from video files, decoded by FFmpeg through PyAV."""

from __future__ import annotations

import contextlib
import dataclasses
import itertools
import math
import zlib
from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Self

import av
import numpy as np
from av.container import InputContainer
from av.error import ExitError, FFmpegError
from av.packet import Packet
from av.video.frame import VideoFrame
from av.video.stream import VideoStream

from labapp.errors import InputError, os_errors_as_input
from labapp.media.base import Frame, FrameSource, check_index, format_frame_rate
from labapp.media.formats.boxes import mp4_formats
from labapp.media.formats.ffv1 import slices_whole
from labapp.media.formats.luminance import bit_depth_of, grey_of
from labapp.media.formats.packets import (
    BoolArray,
    IntArray,
    Packets,
    PacketTable,
    Timing,
    number_by_order,
    number_by_stamp,
)
from labapp.media.formats.stored import READABLE, check_shape
from labapp.pixels import most_decoded

NEAR_PACKETS = 8
"""Largest distance of a key frame that is reached by decoding rather than by seeking."""

DAMAGED_READS = 50
"""Number of consecutive failures to read a packet that counts as the end of the file."""

READ_S = 8.0
"""Timeout of each step of opening and reading, s, as FFmpeg can hang on a damaged table."""

CONTAINERS = {
    "avi": "AVI",
    "matroska": "MKV",
    "mpegts": "MPEG-TS",
    "mpeg": "MPEG",
    "asf": "WMV",
    "gif": "GIF",
    "nut": "NUT",
    "ogg": "Ogg",
    "flv": "FLV",
    "mxf": "MXF",
    "dv": "DV",
    "apng": "APNG",
    "ivf": "IVF",
    "yuv4mpegpipe": "Y4M",
}
"""Supported containers besides MP4, by FFmpeg's names; no playlists, which refer to other files."""

CODECS = {
    "mjpeg": "MJPG",
    "h264": "H.264",
    "hevc": "H.265",
    "mpeg4": "MPEG-4",
    "rawvideo": "raw frames",
}

A_VIDEO = "a video that FFmpeg can decode: AVI, MKV or MP4 with FFV1, MJPG, H.264 or raw frames"

SEEK_WARNING = (
    "{name} does not support exact seeking, so every frame is decoded from the start: correct, but "
    "slow; re-encode it as FFV1 or MJPG for fast access"
)


class VideoSource(FrameSource):
    """A video with an index of all packets, for exact random access.

    Unless it is an AVI with a matching index, the file is read once without decoding, to determine
    offset, key frame flag and frame number, in display order, of each packet. Before decoding, the
    time stamp of a packet is replaced by its index in the table; the decoded frame has the same
    stamp, so that its number is certain wherever reading began. Only if the container has neither
    display order nor key frame flags (H.264 in AVI; an AVI truncated before its index), everything
    is decoded once to determine them.

    Frames that cannot be decoded completely, and frames that depend on them, are errors.

    Parameters
    ----------
    index
        `index` of an earlier source, to open the file without reading all of it.

    Raises
    ------
    InputError
        If it has no complete frame.
    """

    _decoded: Iterator[tuple[int, VideoFrame]]
    """Frames from here on, with their numbers."""
    _shown: tuple[int, VideoFrame] | None
    """Last frame read, with its number."""
    _ahead: tuple[int, VideoFrame] | None
    """A later frame, decoded during the search for one that cannot be decoded."""
    _next: int
    """Number of the next frame that the decoder can return."""
    _fed: int
    """Index of the packet read last."""

    def __init__(self, path: Path, index: bytes | None = None) -> None:
        self._path = path
        self._fingerprint = _fingerprint(path)
        self.name = path.name
        self._container, self._stream = _open(path)
        try:
            table = None if index is None else PacketTable.from_bytes(index, self._fingerprint)
            if table is None:
                table, index = self._table_of_file(), None
            self._use(table, index or table.to_bytes(self._fingerprint))
        except BaseException:
            self.close()
            raise

    def _use(self, table: PacketTable, index: bytes) -> None:
        self.index = index
        self.shape = table.shape
        self.frame_rate_hz = table.frame_rate_hz
        self.bit_depth = table.bit_depth
        self.description = table.description
        self.warnings = table.warnings
        if not table.seekable:
            self.warnings += (SEEK_WARNING.format(name=self.name),)
        self._table = table
        self._ordinal = {place: k for k, place in enumerate(table.place.tolist())}
        self._keys = np.flatnonzero(table.key)
        # Ascending, for a binary search, even if frames are out of order.
        self._least_from = np.minimum.accumulate(table.number[self._keys][::-1])[::-1]
        self._continue_with(self._listed_packets())

    def __len__(self) -> int:
        return len(self._table.time_s)

    def close(self) -> None:
        """Close the file. May be called twice."""
        self._container.close()
        self._decoded = iter(())  # generators that would keep this source and its decoder in memory

    def reopen(self) -> Self:
        """Open the same video again; see `FrameSource.reopen`."""
        return type(self)(self._path, self.index)

    @property
    def seekable(self) -> bool:
        """Whether frames are found by seeking; if not, by decoding from the start."""
        return self._table.seekable

    def decode_from_start(self) -> None:
        """Disable seeking; `index` and `warnings` are updated."""
        self._open()
        table = dataclasses.replace(self._table, seekable=False)
        self._use(table, table.to_bytes(self._fingerprint))

    def frame(self, index: int) -> Frame:
        """Read frame ``index``; see `FrameSource.frame`. Reading in order never seeks."""
        check_index(self, index)
        if self._shown is None or self._shown[0] != index:
            self._shown = self._find(index)
        if self._shown is None:
            raise InputError(self._path, f"frame {index}", "cannot be decoded", "a complete frame")
        image = grey_of(self._shown[1])
        check_shape(self._path, f"frame {index}, size", image, self.shape, "frames")
        time_s = float(self._table.time_s[index])
        return Frame(index, None if math.isnan(time_s) else time_s, image)

    def _find(self, index: int) -> tuple[int, VideoFrame] | None:
        """Return frame ``index`` with its number; None if it cannot be decoded."""
        keys = int(np.searchsorted(self._least_from, index, "right"))
        key = int(self._keys[keys - 1]) if keys else 0
        far = self._table.seekable and key > self._fed + NEAR_PACKETS
        if index < self._next or far:
            self._seek(key)
        found = self._decode_to(index)
        if found is None and self._table.seekable:
            # Reading may have stopped at damage before it; or frames after a key frame depend on
            # frames before it (open GOP of H.264). So try the other way.
            if self._from_start:
                self._seek(key)
            else:
                self._restart()
            found = self._decode_to(index)
        return found

    def _decode_to(self, index: int) -> tuple[int, VideoFrame] | None:
        found = None
        while self._next <= index:
            found = self._ahead or next(self._decoded, None)
            if found is None or found[0] > index:
                self._ahead = found
                return None
            self._ahead = None
            self._next = found[0] + 1
        return found

    def _restart(self) -> None:
        """Open the file again, at its first frame."""
        self._open()
        self._continue_with(self._listed_packets())

    def _open(self) -> None:
        opened = _open(self._path)  # if it was replaced, the present one stays open
        self._container.close()
        self._container, self._stream = opened

    def _continue_with(
        self, packets: Iterator[tuple[int, Packet[VideoStream]]], *, from_start: bool = True
    ) -> None:
        """Reset the decoder state and continue with ``packets``."""
        self._decoded = self._decode(packets)
        self._from_start = from_start
        self._shown = None
        self._ahead = None
        self._next = 0
        self._fed = -1

    def _seek(self, key: int) -> None:
        """Seek to packet ``key`` or one before it, identified by the packet found there."""
        if self._fed < 0:
            # Only the first packet has the palette.
            next(self._decoded, None)
        for stamp in self._table.seek_stamps(key):
            with contextlib.suppress(FFmpegError):
                self._container.seek(stamp, stream=self._stream)
                packets = self._listed_packets()
                first = next(packets, None)
                if first is not None and first[0] <= key:
                    self._continue_with(itertools.chain([first], packets), from_start=first[0] == 0)
                    return
        self._restart()

    def _listed_packets(self) -> Iterator[tuple[int, Packet[VideoStream]]]:
        """Yield the packets from the present position, with their indices in the table."""
        for packet in _packets(self._container, self._stream):
            ordinal = self._ordinal.get(getattr(packet, self._table.placed_by))
            if ordinal is not None:
                yield ordinal, packet

    def _decode(
        self, packets: Iterator[tuple[int, Packet[VideoStream]]]
    ) -> Iterator[tuple[int, VideoFrame]]:
        """Yield numbers and frames, in the decoder's order.

        After a missing or damaged packet nothing is decoded until the next key frame, as decoders
        would continue with wrong data, mostly without an error.
        """
        sound, begun = False, 0
        for ordinal, packet in packets:
            sound = sound and ordinal == self._fed + 1
            self._fed = ordinal
            if not sound and self._table.key[ordinal]:
                sound, begun = True, ordinal
            if sound:
                whole = not self._table.slice_crc or slices_whole(bytes(packet))
                frames = _decode_as(self._stream, packet, ordinal) if whole else None
                sound = frames is not None
                yield from self._numbered(frames or [], begun)
        yield from self._numbered(_decode_as(self._stream, None, 0) or [], begun)

    def _numbered(self, frames: list[VideoFrame], begun: int) -> Iterator[tuple[int, VideoFrame]]:
        for frame in frames:
            ordinal = -1 if frame.pts is None else frame.pts
            number = int(self._table.number[ordinal]) if ordinal >= 0 else -1
            # A frame shown before its preceding key frame depends on frames that were not decoded.
            stray = ordinal > begun and number < self._table.number[begun]
            if number >= self._next and not stray and not frame.is_corrupt:
                yield number, frame

    def _table_of_file(self) -> PacketTable:
        """Build the index, from the file's own index or by reading all of it."""
        is_avi = self._container.format.name == "avi"
        codec = self._stream.codec_context.codec
        timing = Timing(
            float(self._stream.time_base or 0),
            self._rate(),
            self._claimed(),
            stamped=not (is_avi and codec.reorder),
            from_0=is_avi,
        )
        packets, indexed, is_cut = self._all_packets(is_avi, timing.claimed)
        if not len(packets):
            raise InputError(self._path, "frames", "no complete one", A_VIDEO)
        number = number_by_order(packets)
        if codec.reorder and timing.stamped and packets.stamps_differ():
            number = number_by_stamp(packets)
        elif codec.reorder:
            timing = dataclasses.replace(timing, stamped=False)
            key, number = self._decode_through(packets)
            packets = dataclasses.replace(
                packets, key=key & packets.key if indexed or not is_avi else key
            )
        elif is_avi and not indexed and not codec.intra_only:
            key, _ = self._decode_through(packets)
            packets = dataclasses.replace(packets, key=key)
        if not (number >= 0).any():
            raise InputError(self._path, "frames", "no complete one", A_VIDEO)
        table = PacketTable.build(packets, number, timing, self.name)
        self._open()
        first, packet = self._first_frame()
        rows, columns = grey_of(first).shape
        self._open()
        return dataclasses.replace(
            table,
            shape=(rows, columns),
            bit_depth=bit_depth_of(first),
            description=self._describe(first),
            slice_crc=codec.name == "ffv1" and slices_whole(bytes(packet)),
            warnings=table.warnings
            + (f"{self.name} ends early: its last frame is truncated",) * is_cut,
            # MPEG program streams have stamps for some packets only.
            seekable=self._container.format.name != "mpeg",
        )

    def _all_packets(self, is_avi: bool, claimed: int) -> tuple[Packets, bool, bool]:
        """Return all packets, whether an index confirms them, and whether the last is truncated."""
        entries = list(self._stream.index_entries) if is_avi else []
        listed = Packets.listed(entries, self._stream.index, claimed, self._path)
        if listed is not None:
            return listed, True, False
        last: deque[Packet[VideoStream]] = deque(maxlen=2)
        size = self._fingerprint[0]
        packets = Packets.read(_kept(_packets(self._container, self._stream), last), size)
        if len(entries) >= len(packets):
            return packets.completed(entries, size), True, False
        is_cut = self._container.format.name == "nut" and not self._is_whole(tuple(last))
        if is_cut and len(packets) > 1:
            packets = packets.without_last()
        return packets, False, is_cut

    def _is_whole(self, last: Sequence[Packet[VideoStream]]) -> bool:
        """Whether the last packet is complete, as far as a key frame shows it.

        The checksums of FFV1 must be right, if the packet before it has checksums.
        """
        if not last or not last[-1].is_keyframe:
            return True
        checked = self._stream.codec_context.name == "ffv1" and slices_whole(bytes(last[0]))
        if checked and not slices_whole(bytes(last[-1])):
            return False
        return _decode_as(self._stream, last[-1], 0) is not None

    def _decode_through(self, packets: Packets) -> tuple[BoolArray, IntArray]:
        """Decode everything to determine key frames, and display order of each packet."""
        self._open()
        key = np.zeros(len(packets), bool)
        number = np.full(len(packets), -1, np.int64)
        ordinals = {place: k for k, place in enumerate(packets.place.tolist())}
        shown = 0
        for packet in itertools.chain(_packets(self._container, self._stream), [None]):
            ordinal = 0 if packet is None else ordinals.get(getattr(packet, packets.placed_by))
            if ordinal is None:
                continue
            for frame in _decode_as(self._stream, packet, ordinal) or []:
                if frame.pts is not None and number[frame.pts] < 0:
                    key[frame.pts] = frame.key_frame
                    number[frame.pts] = shown
                    shown += 1
        return key, number

    def _first_frame(self) -> tuple[VideoFrame, Packet[VideoStream]]:
        """Return the first complete frame, and the packet after which it was decoded."""
        last = None
        for packet in itertools.chain(_packets(self._container, self._stream), [None]):
            last = packet or last
            for frame in _decode_as(self._stream, packet, 0) or []:
                if last is not None and not frame.is_corrupt:
                    return frame, last
        raise InputError(self._path, "frames", "no complete one", A_VIDEO)

    def _rate(self) -> float | None:
        rate = float(self._stream.average_rate or 0)
        return rate if math.isfinite(rate) and rate > 0 else None

    def _claimed(self) -> int:
        """Return the number of frames in the header; 0 if unknown."""
        if self._stream.frames:
            return self._stream.frames
        whole_file = self._container.format.name.startswith("matroska")
        if whole_file and len(self._container.streams) == 1 and self._container.duration:
            return round(self._container.duration / av.time_base * (self._rate() or 0))
        return 0

    def _describe(self, frame: VideoFrame) -> str:
        container = self._container.format.name.split(",")[0]
        codec = self._stream.codec_context.name
        rows, columns = grey_of(frame).shape
        colour = "grey" if frame.format.name.startswith("gray") else "colour"
        rate = self._rate()
        return ", ".join(
            [
                CONTAINERS.get(container, "MP4" if container == "mov" else container.upper()),
                CODECS.get(codec, codec.upper()),
                f"{columns}×{rows} px",
                f"{bit_depth_of(frame)} bit {colour}",
                *([] if rate is None else [format_frame_rate(rate)]),
            ]
        )


def _fingerprint(path: Path) -> tuple[int, int]:
    """Return the size, bytes, and a checksum of both ends of a file, which identify it."""
    part = 1 << 16
    with os_errors_as_input(path, "file", READABLE), path.open("rb") as file:
        ends = file.read(part)
        size = file.seek(0, 2)
        file.seek(max(0, size - part))
        ends += file.read(part)
    return size, zlib.crc32(ends)


def _open(path: Path) -> tuple[InputContainer, VideoStream]:
    try:
        container = av.open(
            f"file:{path}",
            options={
                "fflags": "discardcorrupt",
                "protocol_whitelist": "file",
                "format_whitelist": ",".join((*CONTAINERS, "webm", *mp4_formats(path))),
            },
            timeout=(READ_S, READ_S),
        )
    except (FFmpegError, ValueError) as error:
        raise InputError(
            path, "content", "not a video, or its index is missing", A_VIDEO
        ) from error
    try:
        stream = container.streams.best("video")
        if not isinstance(stream, VideoStream) or stream.codec_context is None:
            raise InputError(path, "content", "no video stream", A_VIDEO)
        context = stream.codec_context
        bits = 64 if context.format is None else context.format.padded_bits_per_pixel
        most = most_decoded(bits, context.codec.reorder)
        if context.width * context.height > most:
            size = f"{context.width}×{context.height} px"
            raise InputError(path, "frame size", size, f"at most {most} px for this format")
        # Frame threading would delay each frame until more are read.
        context.thread_type = "SLICE"
        context.options = {"max_pixels": str(most), "err_detect": "explode"}
    except BaseException:
        container.close()
        raise
    return container, stream


def _packets(container: InputContainer, stream: VideoStream) -> Iterator[Packet[VideoStream]]:
    """Yield complete packets in file order; unreadable ones are skipped."""
    failures = 0
    while failures < DAMAGED_READS:
        try:
            for packet in container.demux(stream):
                if packet.size:
                    failures = 0
                    yield packet
        except ExitError:
            return
        except (FFmpegError, IndexError):
            # PyAV raises IndexError for a spurious stream in a damaged file.
            failures += 1
        else:
            return


def _kept(
    packets: Iterable[Packet[VideoStream]], last: deque[Packet[VideoStream]]
) -> Iterator[Packet[VideoStream]]:
    """Yield packets, and store the latest in ``last``."""
    for packet in packets:
        last.append(packet)
        yield packet


def _decode_as(
    stream: VideoStream, packet: Packet[VideoStream] | None, stamp: int
) -> list[VideoFrame] | None:
    """Decode a packet with another time stamp; None if it is damaged."""
    if packet is not None:
        packet.pts = packet.dts = stamp
    try:
        return stream.codec_context.decode(packet)
    except (FFmpegError, ValueError):  # ValueError for an unknown codec
        return None
