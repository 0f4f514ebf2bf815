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
from labapp.pixels import most_decoded

NEAR_PACKETS = 8
"""The next key frame is reached by decoding when it is no further than this, else by seeking."""

DAMAGED_READS = 50
"""More failures than this to read a packet, one after the other, are the end."""

READ_S = 8.0
"""No one step of opening or reading takes longer, s: a damaged table can send FFmpeg astray."""

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
"""What is opened besides MP4, by FFmpeg's names. No playlists (they name other files), no text."""

CODECS = {
    "mjpeg": "MJPG",
    "h264": "H.264",
    "hevc": "H.265",
    "mpeg4": "MPEG-4",
    "rawvideo": "raw frames",
}

A_VIDEO = "a video that FFmpeg can decode: AVI, MKV or MP4 with FFV1, MJPG, H.264 or raw frames"

SEEK_WARNING = (
    "{name} does not allow to seek exactly, so every frame is decoded from the start: right, but "
    "slow; re-encode it as FFV1 or MJPG to move through it quickly"
)


class VideoSource(FrameSource):
    """A video with an index of all packets, so that any frame is found exactly.

    The file is read through once without decoding, unless it is an AVI whose index fits it: where
    each packet is, which are key frames, and which frame, in the order they are shown, comes of
    each. A packet is given its place in that table as its time stamp before it is decoded; the
    frame that comes out carries it, so a frame is known for certain wherever reading began. Only
    where the container keeps neither the order frames are shown in nor which are key frames (H.264
    in AVI; an AVI cut before its index) is everything decoded once to learn them.

    A frame that cannot be decoded completely is refused, and so are those that build on it.

    Parameters
    ----------
    index
        `index` of an earlier source, to open the file without reading it through.

    Raises
    ------
    InputError
        If there is no complete frame in it.
    """

    _shown: tuple[int, VideoFrame] | None
    """Last frame read, with its number."""
    _ahead: tuple[int, VideoFrame] | None
    """A later frame, decoded while looking for one that cannot be decoded."""
    _next: int
    """Number of the next frame that the decoder can give."""
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
        self._continue_with(self._listed_packets())

    def __len__(self) -> int:
        return len(self._table.time_s)

    def close(self) -> None:
        """Close the file. Closing twice does no harm."""
        self._container.close()

    def reopen(self) -> Self:
        """Open the same video once more; see `FrameSource.reopen`."""
        return type(self)(self._path, self.index)

    @property
    def seekable(self) -> bool:
        """Whether frames are found by seeking; if not, by decoding from the start."""
        return self._table.seekable

    def decode_from_start(self) -> None:
        """Disable seeking; `index` and `warnings` are updated."""
        self._open()
        table = self._table.without_seeking()
        self._use(table, table.to_bytes(self._fingerprint))

    def frame(self, index: int) -> Frame:
        """Read frame ``index``; see `FrameSource.frame`. Reading in order never seeks."""
        check_index(self, index)
        if self._shown is None or self._shown[0] != index:
            self._shown = self._find(index)
        if self._shown is None:
            raise InputError(self._path, f"frame {index}", "cannot be decoded", "a whole frame")
        image = grey_of(self._shown[1])
        if image.shape != self.shape:
            rows, columns = self.shape
            raise InputError(
                self._path,
                f"frame {index}, size",
                f"{image.shape[1]}×{image.shape[0]} px",
                f"{columns}×{rows} px like the frames before it",
            )
        time_s = float(self._table.time_s[index])
        return Frame(index, None if math.isnan(time_s) else time_s, image)

    def _find(self, index: int) -> tuple[int, VideoFrame] | None:
        """Number and frame ``index``; None if it cannot be decoded."""
        before = np.flatnonzero(self._table.number[self._keys] <= index)
        key = int(self._keys[before[-1]]) if len(before) else 0
        far = self._table.seekable and key > self._fed + NEAR_PACKETS
        if index < self._next or far:
            self._seek(key)
        found = self._decode_to(index)
        if found is None and self._table.seekable:
            # Reading may have stuck at damage before it; or what follows a key frame may build on
            # what is before it (H.264's open groups). So get there the other way.
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
        """Open the file again, before its first frame."""
        self._open()
        self._continue_with(self._listed_packets())

    def _open(self) -> None:
        self._container.close()
        self._container, self._stream = _open(self._path)

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
            # A palette comes with the first packet only.
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
        """Packets from here on, each with its index in the table."""
        for packet in _packets(self._container, self._stream):
            ordinal = self._ordinal.get(getattr(packet, self._table.placed_by))
            if ordinal is not None:
                yield ordinal, packet

    def _decode(
        self, packets: Iterator[tuple[int, Packet[VideoStream]]]
    ) -> Iterator[tuple[int, VideoFrame]]:
        """Numbers and frames, in the decoder's order.

        After a packet that is missing or damaged nothing is decoded before the next key frame:
        decoders would continue with what they have, and only some would say so.
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
            # What is shown before the key frame it follows builds on what was not decoded.
            stray = ordinal > begun and number < self._table.number[begun]
            if number >= self._next and not stray and not frame.is_corrupt:
                yield number, frame

    def _table_of_file(self) -> PacketTable:
        """Index of the file, by its own index or by reading it through."""
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
            raise InputError(self._path, "frames", "not one that is whole", A_VIDEO)
        number = number_by_order(packets)
        if codec.reorder and timing.stamped and packets.stamps_differ():
            number = number_by_stamp(packets)
        elif codec.reorder:
            timing = dataclasses.replace(timing, stamped=False)
            key, number = self._decode_through(packets)
            packets = packets.with_keys(key & packets.key if indexed or not is_avi else key)
        elif is_avi and not indexed and not codec.intra_only:
            key, _ = self._decode_through(packets)
            packets = packets.with_keys(key)
        if not (number >= 0).any():
            raise InputError(self._path, "frames", "not one that is whole", A_VIDEO)
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
            + (f"{self.name} ends early: its last frame is cut off",) * is_cut,
            # MPEG program streams have stamps for some packets only; the others' are guessed.
            seekable=self._container.format.name != "mpeg",
        )

    def _all_packets(self, is_avi: bool, claimed: int) -> tuple[Packets, bool, bool]:
        """All packets, whether the file's index confirms them, and whether the last is cut off."""
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
        """Whether the last of packets is, if it can be decoded by itself; if not, it is taken for.

        Of FFV1 that has checksums, as the packet before it shows, they must be right.
        """
        if not last or not last[-1].is_keyframe:
            return True
        checked = self._stream.codec_context.name == "ffv1" and slices_whole(bytes(last[0]))
        if checked and not slices_whole(bytes(last[-1])):
            return False
        return _decode_as(self._stream, last[-1], 0) is not None

    def _decode_through(self, packets: Packets) -> tuple[BoolArray, IntArray]:
        """Key frames, and the frame of each packet in the order shown, by decoding everything."""
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
        """First complete frame, and the packet after which the decoder gave it."""
        last = None
        for packet in itertools.chain(_packets(self._container, self._stream), [None]):
            last = packet or last
            for frame in _decode_as(self._stream, packet, 0) or []:
                if last is not None and not frame.is_corrupt:
                    return frame, last
        raise InputError(self._path, "frames", "not one that is whole", A_VIDEO)

    def _rate(self) -> float | None:
        rate = float(self._stream.average_rate or 0)
        return rate if math.isfinite(rate) and rate > 0 else None

    def _claimed(self) -> int:
        """Number of frames in the header; 0 where unknown."""
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
    """Size, bytes, and checksum of both ends of a file, to see whether it is the same."""
    part = 1 << 16
    with os_errors_as_input(path, "file", "a file that may be read"), path.open("rb") as file:
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
            raise InputError(path, "content", "no pictures", A_VIDEO)
        context = stream.codec_context
        bits = 64 if context.format is None else context.format.padded_bits_per_pixel
        most = most_decoded(bits, context.codec.reorder)
        if context.width * context.height > most:
            size = f"{context.width}×{context.height} px"
            raise InputError(path, "frame size", size, f"at most {most} px in a frame of its kind")
        # Frame threads would hold back each requested frame until more are read.
        context.thread_type = "SLICE"
        context.options = {"max_pixels": str(most), "err_detect": "explode"}
    except BaseException:
        container.close()
        raise
    return container, stream


def _packets(container: InputContainer, stream: VideoStream) -> Iterator[Packet[VideoStream]]:
    """Complete packets in file order; unreadable ones are skipped."""
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
            # PyAV has no place for a stream that damage makes appear amid the file.
            failures += 1
        else:
            return


def _kept(
    packets: Iterable[Packet[VideoStream]], last: deque[Packet[VideoStream]]
) -> Iterator[Packet[VideoStream]]:
    """Pass packets through; the latest stay in ``last``."""
    for packet in packets:
        last.append(packet)
        yield packet


def _decode_as(
    stream: VideoStream, packet: Packet[VideoStream] | None, stamp: int
) -> list[VideoFrame] | None:
    """Frames of the decoder for ``packet`` with time stamp ``stamp``; None if it is damaged."""
    if packet is not None:
        packet.pts = packet.dts = stamp
    try:
        return stream.codec_context.decode(packet)
    except (FFmpegError, ValueError):  # PyAV raises the latter for a codec it does not know
        return None
