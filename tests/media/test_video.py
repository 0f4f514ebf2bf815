from __future__ import annotations

import contextlib
import gc
import os
import re
import shutil
import subprocess
import sys
import weakref
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest import mock

import av
import cv2
import imageio_ffmpeg
import numpy as np
import numpy.typing as npt
import pytest

from labapp.errors import InputError
from labapp.media import open_source
from labapp.media.formats.packets import Packets
from labapp.media.formats.video import VideoSource

Pictures = list[npt.NDArray[Any]]
WriteVideo = Callable[[Path, Pictures, str], Path]
Encode = Callable[..., Path]

H264 = Path(__file__).parent / "data" / "h264.mp4"
SAMPLE = Path(__file__).parents[2] / "sample_sessions" / "gtaw" / "recording.avi"
VARYING = Path(__file__).parent / "data" / "varying_rate.mkv"
GREY_16 = Path(__file__).parent / "data" / "grey16.mkv"

COUNT = 40

FFV1 = "-c:v ffv1"
FFV1_CRC = "-c:v ffv1 -level 3 -slices 4 -slicecrc 1 -g 6"
MJPG = "-c:v mjpeg -q:v 2 -pix_fmt yuvj420p"
X264 = "-c:v libx264 -pix_fmt yuv420p -qp 8 -bf 3 -b_strategy 0 -g 15"
MPEG4 = "-c:v mpeg4 -q:v 2 -pix_fmt yuv420p"

EXACT = [
    ("a.avi", 8, FFV1, "AVI, FFV1, 64×48 px, 8 bit grey, 60 frames/s"),
    ("a.mkv", 8, FFV1, "MKV, FFV1, 64×48 px, 8 bit grey, 60 frames/s"),
    ("a.mp4", 8, FFV1 + " -strict -2", "MP4, FFV1, 64×48 px, 8 bit grey, 60 frames/s"),
    ("a.mkv", 10, FFV1 + "", "MKV, FFV1, 64×48 px, 10 bit grey, 60 frames/s"),
    ("a.avi", 12, FFV1 + "", "AVI, FFV1, 64×48 px, 12 bit grey, 60 frames/s"),
    ("a.avi", 16, FFV1, "AVI, FFV1, 64×48 px, 16 bit grey, 60 frames/s"),
    ("a.mkv", 8, FFV1 + " -pix_fmt bgr0", "MKV, FFV1, 64×48 px, 8 bit colour, 60 frames/s"),
    ("a.mkv", 16, FFV1 + " -pix_fmt gbrp16le", "MKV, FFV1, 64×48 px, 16 bit colour, 60 frames/s"),
    ("a.avi", 8, "-c:v rawvideo", "AVI, raw frames, 64×48 px, 8 bit grey, 60 frames/s"),
    ("a.mkv", 8, "-c:v rawvideo", "MKV, raw frames, 64×48 px, 8 bit grey, 60 frames/s"),
    ("a.mov", 8, "-c:v rawvideo", "MP4, raw frames, 64×48 px, 8 bit colour, 60 frames/s"),
    ("a.nut", 16, "-c:v rawvideo", "NUT, raw frames, 64×48 px, 16 bit grey, 60 frames/s"),
    ("a.avi", 8, "-c:v png", "AVI, PNG, 64×48 px, 8 bit grey, 60 frames/s"),
    ("a.avi", 16, "-c:v png -pix_fmt gray16be", "AVI, PNG, 64×48 px, 16 bit grey, 60 frames/s"),
]
NEARLY = [
    ("a.avi", MJPG, "AVI, MJPG, 64×48 px, 8 bit colour, 60 frames/s"),
    ("a.mkv", MJPG, "MKV, MJPG, 64×48 px, 8 bit colour, 60 frames/s"),
    ("a.mp4", MJPG, "MP4, MJPG, 64×48 px, 8 bit colour, 60 frames/s"),
    ("a.mkv", FFV1 + " -pix_fmt yuv420p", "MKV, FFV1, 64×48 px, 8 bit colour, 60 frames/s"),
    ("a.mp4", X264, "MP4, H.264, 64×48 px, 8 bit colour, 60 frames/s"),
    ("a.mkv", X264, "MKV, H.264, 64×48 px, 8 bit colour, 60 frames/s"),
    ("a.avi", X264, "AVI, H.264, 64×48 px, 8 bit colour, 60 frames/s"),
    ("a.mkv", X264 + " -flags -cgop -x264-params open-gop=1:scenecut=0", None),
    ("a.mp4", X264 + " -color_range pc -vf scale=out_range=pc", None),
    ("a.ts", X264, "MPEG-TS, H.264, 64×48 px, 8 bit colour, 60 frames/s"),
    ("a.avi", MPEG4, "AVI, MPEG-4, 64×48 px, 8 bit colour, 60 frames/s"),
    ("a.avi", MPEG4 + " -bf 2", "AVI, MPEG-4, 64×48 px, 8 bit colour, 60 frames/s"),
    ("a.mp4", MPEG4 + " -bf 2", "MP4, MPEG-4, 64×48 px, 8 bit colour, 60 frames/s"),
    (
        "a.mpg",
        "-c:v mpeg2video -q:v 2 -bf 2",
        "MPEG, MPEG2VIDEO, 64×48 px, 8 bit colour, 60 frames/s",
    ),
]


def pictures_of(bits: int) -> Pictures:
    """Noise with every level; no two frames are equal."""
    rng = np.random.default_rng(bits)
    top = 2**bits
    levels = [rng.integers(0, top, (48, 64), np.uint16) for _ in range(COUNT)]
    return [x.astype(np.uint8) if bits == 8 else x for x in levels]


def numbered() -> Pictures:
    """Frame k shows k in six blocks, black for 0, white for 1, over a noisy ramp."""
    frames = []
    rng = np.random.default_rng(0)
    for k in range(COUNT):
        ramp = np.linspace(20, 235, 64) + rng.integers(-20, 20, (48, 64))
        picture = ramp.astype(np.uint8)
        for bit in range(6):
            picture[8:24, 8 * bit : 8 * bit + 8] = 255 * (k >> bit & 1)
        frames.append(picture)
    return frames


def number_in(image: npt.NDArray[Any]) -> int:
    full = np.iinfo(image.dtype).max if image.dtype == np.uint8 else 1023
    return sum(
        int(image[10:22, 8 * bit + 2 : 8 * bit + 6].mean() > full / 2) << bit for bit in range(6)
    )


def orders() -> list[int]:
    rng = np.random.default_rng(3)
    return [*range(COUNT - 1, -1, -3), *rng.integers(0, COUNT, 20).tolist(), 7, 8, 9, 20, 19, 19]


@pytest.mark.parametrize(("name", "bits", "options", "description"), EXACT)
def test_lossless_recordings_of_ffmpeg_are_read_exactly(
    tmp_path: Path, encode: Encode, name: str, bits: int, options: str, description: str
) -> None:
    pictures = pictures_of(bits)
    levels = "gray" if bits == 8 else f"gray{bits}le"
    path = encode(tmp_path / name, pictures, *options.split(), levels=levels)
    with VideoSource(path) as source:
        assert source.description == description
        assert source.bit_depth == bits
        assert source.warnings == ()
        for frame, picture in zip(source, pictures, strict=True):
            assert frame.image.dtype == picture.dtype
            np.testing.assert_array_equal(frame.image, picture)
            assert frame.time_s == pytest.approx(frame.index / 60)
    with VideoSource(path, source.index) as reopened:
        for index in orders():
            np.testing.assert_array_equal(reopened.frame(index).image, pictures[index])


@pytest.mark.parametrize(("name", "options", "description"), NEARLY)
def test_lossy_recordings_of_ffmpeg_are_read_in_order(
    tmp_path: Path, encode: Encode, name: str, options: str, description: str | None
) -> None:
    pictures = numbered()
    path = encode(tmp_path / name, pictures, *options.split())
    with VideoSource(path) as source:
        assert description in (source.description, None)
        assert len(source) == COUNT
        frames = list(source)
    for frame, picture in zip(frames, pictures, strict=True):
        assert number_in(frame.image) == frame.index
        assert np.abs(frame.image.astype(float) - picture).mean() < 3
        assert frame.time_s == pytest.approx(frame.index / 60)
    with VideoSource(path, source.index) as reopened:
        for index in orders():
            np.testing.assert_array_equal(reopened.frame(index).image, frames[index].image)


def test_limited_luminance_is_expanded_to_the_full_range(tmp_path: Path, encode: Encode) -> None:
    """Rounding to 219 levels and back causes an error of one level."""
    ramp = [np.tile(np.arange(256, dtype=np.uint8), (48, 1))]
    eight = encode(tmp_path / "8.mkv", ramp, *(FFV1 + " -pix_fmt yuv422p").split())
    with VideoSource(eight) as source:
        assert np.abs(source.frame(0).image.astype(int) - ramp[0]).max() == 1
    ten = encode(tmp_path / "10.mkv", ramp, *(FFV1 + " -pix_fmt yuv420p10le").split())
    with VideoSource(ten) as source:
        assert (source.bit_depth, source.frame(0).image.dtype) == (10, np.uint16)
        assert np.abs(source.frame(0).image / 1023 - ramp[0] / 255).max() < 0.005


def test_rotation_of_a_recording_is_applied(tmp_path: Path, encode: Encode) -> None:
    pictures = numbered()[:3]
    flat = encode(tmp_path / "flat.mp4", pictures, *X264.split())
    turned = tmp_path / "turned.mp4"
    subprocess.run(
        [
            *(imageio_ffmpeg.get_ffmpeg_exe(), "-v", "error", "-display_rotation", "90"),
            *("-i", str(flat), "-c", "copy", str(turned)),
        ],
        check=True,
    )
    with VideoSource(flat) as source, VideoSource(turned) as other:
        assert other.shape == (64, 48)
        np.testing.assert_array_equal(other.frame(1).image, np.rot90(source.frame(1).image))


@pytest.mark.parametrize(
    ("name", "options"), [("v.mkv", X264), ("v.mp4", X264), ("v.mkv", FFV1), ("v.mp4", MJPG)]
)
def test_pause_in_a_recording_is_preserved(
    tmp_path: Path, encode: Encode, name: str, options: str
) -> None:
    """The camera stops for five intervals after frame 5, then runs at half its rate."""
    interval = [k if k <= 5 else 2 * k + 5 for k in range(COUNT)]
    stamps = "setpts='if(lte(N,5),N,2*N+5)/60/TB'"
    path = encode(tmp_path / name, numbered(), *options.split(), "-vf", stamps, "-fps_mode", "vfr")
    with VideoSource(path) as source:
        assert source.warnings == ()
        frames = list(source)
    assert [number_in(frame.image) for frame in frames] == list(range(COUNT))
    # Matroska stores times in milliseconds.
    assert [frame.time_s for frame in frames] == pytest.approx([k / 60 for k in interval], abs=6e-4)


def test_frames_skipped_by_a_camera_are_not_missing(tmp_path: Path, encode: Encode) -> None:
    """A pause of three intervals after every fifth frame is a variable rate, not damage."""
    stamps = ("-vf", "setpts='(N+floor(N/5)*3)/60/TB'", "-fps_mode", "vfr")
    path = encode(tmp_path / "v.mkv", numbered(), *FFV1.split(), *stamps)
    with VideoSource(path) as source:
        frames = list(source)
    assert [number_in(frame.image) for frame in frames] == list(range(COUNT))
    elapsed_s = [(k + k // 5 * 3) / 60 for k in range(COUNT)]
    assert [frame.time_s for frame in frames] == pytest.approx(elapsed_s, abs=6e-4)


@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("v.avi", X264),
        ("v.mkv", X264),
        ("v.mp4", X264 + " -movflags +faststart"),
        ("v.avi", FFV1_CRC),
        ("v.mkv", FFV1_CRC),
        ("v.avi", MPEG4),
        ("v.mov", "-c:v rawvideo -movflags +faststart"),
    ],
)
@pytest.mark.parametrize("share", [0.5, 0.8, 0.99])
def test_remaining_frames_of_a_truncated_recording_are_read(
    tmp_path: Path, encode: Encode, name: str, options: str, share: float
) -> None:
    path = encode(tmp_path / name, numbered(), *options.split())
    with VideoSource(path) as source:
        expected = [frame.image for frame in source]
    content = path.read_bytes()
    path.write_bytes(content[: int(len(content) * share)])
    with VideoSource(path) as source:
        assert 0 < len(source) <= COUNT
        images = read_all(source)
        # H.264 stores some frames before earlier ones, so the last remaining frames have gaps.
        for index in range(len(images) - (4 if options.startswith(X264) else 0)):
            np.testing.assert_array_equal(images[index], expected[index])
        for index in (len(images) - 1, 0, len(images) // 2):
            np.testing.assert_array_equal(source.frame(index).image, images[index])


def read_all(source: VideoSource) -> list[npt.NDArray[Any] | None]:
    images: list[npt.NDArray[Any] | None] = []
    for index in range(len(source)):
        try:
            images.append(source.frame(index).image)
        except InputError:
            images.append(None)
    return images


@pytest.mark.parametrize(
    ("name", "options"),
    [("v.avi", FFV1_CRC), ("v.mkv", FFV1_CRC), ("v.avi", "-c:v png"), ("v.mkv", "-c:v png")],
)
def test_damaged_frames_are_lost_but_never_changed(
    tmp_path: Path, encode: Encode, name: str, options: str
) -> None:
    """These codecs have checksums: a frame is either unchanged or unreadable."""
    pictures = pictures_of(8)
    path = encode(tmp_path / name, pictures, *options.split())
    content = path.read_bytes()
    rng = np.random.default_rng(4)
    lost = []
    for _ in range(8):
        offset = int(rng.integers(len(content) // 5, len(content) * 4 // 5))
        path.write_bytes(content[:offset] + rng.bytes(300) + content[offset + 300 :])
        with VideoSource(path) as source:
            assert len(source) == COUNT
            images = read_all(source)
            for index in orders():
                if images[index] is not None:
                    np.testing.assert_array_equal(source.frame(index).image, images[index])
        for image, picture in zip(images, pictures, strict=True):
            if image is not None:
                np.testing.assert_array_equal(image, picture)
        lost.append(sum(image is None for image in images))
    assert 0 < max(lost) <= 8


def test_frames_after_a_damaged_group_of_pictures_are_unchanged(
    tmp_path: Path, encode: Encode
) -> None:
    path = encode(tmp_path / "v.mp4", numbered(), *X264.split())
    with VideoSource(path) as source:
        expected = [frame.image for frame in source]
    content = bytearray(path.read_bytes())
    with av.open(path) as container:
        places = [packet.pos for packet in container.demux(video=0)]
    packet_15 = [place for place in places if place is not None][15]
    content[packet_15 + 4 : packet_15 + 64] = bytes(60)
    path.write_bytes(content)
    with VideoSource(path) as source:
        images = read_all(source)
    assert images[15] is None
    for index in (*range(10), *range(30, COUNT)):
        np.testing.assert_array_equal(images[index], expected[index])


@pytest.mark.parametrize(("name", "options"), [("v.avi", X264), ("v.mkv", FFV1), ("v.mp4", MJPG)])
def test_recording_with_its_index_is_not_scanned_again(
    tmp_path: Path, encode: Encode, name: str, options: str
) -> None:
    path = encode(tmp_path / name, numbered(), *options.split())
    with VideoSource(path) as source:
        index = source.index
        properties = (source.shape, source.frame_rate_hz, source.bit_depth, source.description)
        expected = [frame.image for frame in source]
    with mock.patch.object(Packets, "read") as read, VideoSource(path, index) as source:
        assert properties == (
            source.shape,
            source.frame_rate_hz,
            source.bit_depth,
            source.description,
        )
        assert (len(source), source.index) == (COUNT, index)
        np.testing.assert_array_equal(source.frame(33).image, expected[33])
        with source.reopen() as other:
            np.testing.assert_array_equal(other.frame(12).image, expected[12])
    read.assert_not_called()


@pytest.mark.parametrize("options", [X264, FFV1, MJPG])
def test_avi_with_a_valid_index_is_not_scanned(
    tmp_path: Path, encode: Encode, options: str
) -> None:
    path = encode(tmp_path / "v.avi", numbered(), *options.split())
    with mock.patch.object(Packets, "listed", return_value=None), VideoSource(path) as source:
        index = source.index
    with mock.patch.object(Packets, "read") as read, VideoSource(path) as source:
        assert source.index == index
    read.assert_not_called()


def test_avi_with_an_invalid_index_is_scanned(tmp_path: Path, encode: Encode) -> None:
    path = encode(tmp_path / "v.avi", numbered(), *FFV1.split())
    content = path.read_bytes()
    index = content.rindex(b"idx1")
    chunk = content.index(b"00dc", content.index(b"movi"))
    second = content.index(b"00dc", chunk + 8)
    entry = index + 8 + 16 * 3  # of the fourth frame
    total_frames, stream_length = content.index(b"avih") + 8 + 16, content.index(b"strh") + 8 + 32
    one_less, size = ((k * (COUNT - 1)).to_bytes(4, "little") for k in (1, 16))
    fewer = {total_frames: one_less, stream_length: one_less}
    extra_frames = content[chunk:second] * 3
    beyond = b"RIFF" + (len(extra_frames) + 16).to_bytes(4, "little") + b"AVIXLIST"
    beyond += (len(extra_frames) + 4).to_bytes(4, "little") + b"movi" + extra_frames
    for changes in (
        {len(content): beyond},  # more frames after the index
        fewer,  # fewer frames in the header
        {second: b"01dc"},  # a packet of another stream
        {second + 4: b"\x07"},  # shorter than in the index
        {entry + 8: b"\xff\xff\xff\x7f"},  # beyond the file
        {**fewer, index + 4: size},  # the last frame is missing in header and index
        {
            **fewer,
            index + 4: size + content[index + 8 : entry] + content[entry + 16 :],
        },  # the fourth
    ):
        changed = bytearray(content)
        for offset, value in changes.items():
            changed[offset : offset + len(value)] = value
        path.write_bytes(changed)
        with mock.patch.object(Packets, "listed", return_value=None):
            expected = index_of(path)
        with mock.patch.object(Packets, "read", side_effect=Packets.read) as read:
            assert index_of(path) == expected
        read.assert_called_once()


def index_of(path: Path) -> bytes | None:
    """Return the index of a recording, or None if it is rejected."""
    with contextlib.suppress(InputError), VideoSource(path) as source:
        return source.index
    return None


def test_index_of_an_unreadable_file_is_none(tmp_path: Path) -> None:
    entry = SimpleNamespace(pos=0, size=1, timestamp=0, is_keyframe=True)
    assert Packets.listed([entry], 0, 1, tmp_path / "gone.avi") is None


def test_index_of_another_file_is_ignored(tmp_path: Path, encode: Encode) -> None:
    path = encode(tmp_path / "v.avi", numbered(), *FFV1.split())
    with VideoSource(path) as source:
        index = source.index
    assert index is not None
    damaged = bytearray(index)
    damaged[len(index) // 2] ^= 1
    other = encode(tmp_path / "w.avi", numbered()[:20], *FFV1.split())
    for file, stored_index, count in [
        (path, bytes(damaged), COUNT),
        (path, index[:50], COUNT),
        (path, b"", COUNT),
        (other, index, 20),
    ]:
        with VideoSource(file, stored_index) as source:
            assert len(source) == count
            assert number_in(source.frame(count - 1).image) == count - 1


ENCODE_BLACK = """
import sys
import av

path, codec, levels = sys.argv[1:]
with av.open(path, "w") as container:
    stream = container.add_stream(codec, rate=10)
    stream.width, stream.height, stream.pix_fmt = 6496, 6496, levels
    frame = av.VideoFrame(6496, 6496, levels)
    for plane in frame.planes:
        plane.update(bytes(plane.buffer_size))
    container.mux(stream.encode(frame))
    container.mux(stream.encode(None))
"""
"""Writes a video of one frame of 42 million pixels: (path, codec, levels); needs 1.5 GB."""


def test_codec_that_buffers_many_large_frames_is_rejected(tmp_path: Path) -> None:
    """The limit is higher for codecs that decode one frame at a time."""
    for codec, is_rejected in (("mpeg4", True), ("ffv1", False)):
        path = tmp_path / f"{codec}.avi"
        levels = "yuv420p" if is_rejected else "gray"
        subprocess.run([sys.executable, "-c", ENCODE_BLACK, path, codec, levels], check=True)
        assert path.stat().st_size < 2e6
        if is_rejected:
            with pytest.raises(InputError, match="frame size: 6496×6496 px"):
                open_source(path)
        else:
            with open_source(path) as source:
                assert source.shape == (6496, 6496)


def test_impossible_frame_size_is_rejected(tmp_path: Path, encode: Encode) -> None:
    path = encode(tmp_path / "v.avi", numbered(), *FFV1.split())
    content = bytearray(path.read_bytes())
    for start in (content.index(b"avih") + 40, content.index(b"strf") + 12):
        content[start : start + 8] = (12000).to_bytes(4, "little") * 2
    path.write_bytes(content)
    with pytest.raises(InputError, match="frame size: 12000×12000 px; expected at most"):
        VideoSource(path)


@pytest.mark.parametrize(
    ("name", "options"), [("v.avi", X264), ("v.mkv", FFV1), ("v.mp4", X264), ("v.avi", MJPG)]
)
def test_mutated_recordings_are_read_or_rejected(
    tmp_path: Path, encode: Encode, name: str, options: str, capfd: pytest.CaptureFixture[str]
) -> None:
    """Only InputError is raised, and no file is changed."""
    path = encode(tmp_path / name, numbered(), *options.split())
    content = path.read_bytes()
    rng = np.random.default_rng(7)
    readable = 0
    for _ in range(25):
        mutated = bytearray(content)
        # Headers are changed as often as the rest of the file.
        for span in (600, len(content)):
            for offset in rng.integers(0, span, 3):
                mutated[offset] = rng.integers(256)
        path.write_bytes(mutated)
        with contextlib.suppress(InputError), VideoSource(path) as source:
            readable += 1
            for index in (0, len(source) - 1, len(source) // 2):
                with contextlib.suppress(InputError):
                    assert source.frame(index).image.shape == source.shape
        assert path.read_bytes() == mutated
    assert readable > 0
    assert capfd.readouterr() == ("", "")


def test_playlists_and_texts_are_rejected(tmp_path: Path, encode: Encode) -> None:
    encode(tmp_path / "v.mkv", numbered(), *FFV1.split())
    playlist = tmp_path / "list.avi"
    playlist.write_text("ffconcat version 1.0\nfile v.mkv\n")
    text = tmp_path / "notes.txt"
    text.write_text("current 125 A\n" * 200)
    for path in (playlist, text):
        with pytest.raises(InputError, match="not a video"):
            VideoSource(path)


LOSSLESS = [("ffv1.avi", "FFV1"), ("ffv1.mkv", "FFV1"), ("raw.avi", "Y800"), ("png.avi", "MPNG")]
LOSSY = [("mjpg.avi", "MJPG"), ("mpeg4.mp4", "mp4v")]


@pytest.mark.parametrize(("name", "codec"), LOSSLESS)
def test_lossless_video_is_read_exactly(
    tmp_path: Path, pictures: Pictures, write_video: WriteVideo, name: str, codec: str
) -> None:
    with open_source(write_video(tmp_path / name, pictures, codec)) as source:
        assert len(source) == len(pictures)
        assert source.frame_rate_hz == pytest.approx(60)
        assert source.shape == (48, 64)
        assert source.warnings == ()
        for frame, picture in zip(source, pictures, strict=True):
            np.testing.assert_array_equal(frame.image, picture)
            assert frame.time_s == pytest.approx(frame.index / 60)


@pytest.mark.parametrize(("name", "codec"), LOSSY)
def test_lossy_video_is_read_approximately(
    tmp_path: Path, pictures: Pictures, write_video: WriteVideo, name: str, codec: str
) -> None:
    smooth = [cv2.GaussianBlur(picture, (0, 0), 3) for picture in pictures]
    with open_source(write_video(tmp_path / name, smooth, codec)) as source:
        assert len(source) == len(pictures)
        for frame, picture in zip(source, smooth, strict=True):
            assert frame.image.dtype == np.uint8
            assert np.abs(frame.image.astype(float) - picture).mean() < 3


def test_frames_of_h264_are_read_in_any_order() -> None:
    """Long groups of pictures with B-frames; frame k has its blob at u = 10 + 3k."""
    with open_source(H264) as source:
        assert len(source) == 40
        in_order = [frame.image for frame in source]
        assert [int(image[60].argmax()) for image in in_order] == pytest.approx(
            [10 + 3 * k for k in range(40)], abs=1
        )
        for index in (39, 0, 20, 3, 38, 37, 37, 12):
            np.testing.assert_array_equal(source.frame(index).image, in_order[index])


def test_times_of_a_variable_frame_rate_are_preserved() -> None:
    """Frame k is 10·k everywhere; the frame rate varies."""
    time_s = [0, 0.017, 0.033, 0.05, 0.25, 0.26, 0.3, 0.317, 0.333, 0.35, 0.367, 0.383]
    with open_source(VARYING) as source:
        assert source.warnings == ()
        frames = [*source, source.frame(2), source.frame(10), source.frame(4)]
    expected = [*range(12), 2, 10, 4]
    assert [int(frame.image[0, 0]) for frame in frames] == [10 * k for k in expected]
    assert [frame.time_s for frame in frames] == pytest.approx([time_s[k] for k in expected])


def test_16_bit_levels_are_preserved() -> None:
    """Frame k is 1000·k plus a ramp of 0 … 159 along u."""
    with open_source(GREY_16) as source:
        for frame in source:
            assert frame.image.dtype == np.uint16
            np.testing.assert_array_equal(frame.image[5], 1000 * frame.index + np.arange(160))
        assert frame.index == 4


@pytest.mark.parametrize(("name", "codec"), LOSSLESS)
def test_any_order_gives_the_same_frames(
    tmp_path: Path, pictures: Pictures, write_video: WriteVideo, name: str, codec: str
) -> None:
    with open_source(write_video(tmp_path / name, pictures, codec)) as source:
        for index in np.random.default_rng(1).integers(0, len(pictures), 25).tolist():
            np.testing.assert_array_equal(source.frame(index).image, pictures[index])


def test_reading_in_order_does_not_seek(
    tmp_path: Path, pictures: Pictures, write_video: WriteVideo
) -> None:
    with VideoSource(write_video(tmp_path / "v.avi", pictures, "FFV1")) as source:
        with mock.patch.object(VideoSource, "_seek") as seek:
            images = [source.frame(index).image for index in (0, 1, 2, 2, 3, 7, 15)]
        seek.assert_not_called()
    np.testing.assert_array_equal(images[-1], pictures[15])


@pytest.mark.parametrize(("name", "codec"), [*LOSSLESS, LOSSY[0]])
@pytest.mark.parametrize("share", [0.4, 0.75, 0.97])
def test_truncated_video_has_its_complete_frames(
    tmp_path: Path,
    pictures: Pictures,
    write_video: WriteVideo,
    name: str,
    codec: str,
    share: float,
    capfd: pytest.CaptureFixture[str],
) -> None:
    path = write_video(tmp_path / name, pictures, codec)
    with open_source(path) as source:
        expected = [frame.image for frame in source]
    content = path.read_bytes()
    path.write_bytes(content[: int(len(content) * share)])
    with open_source(path) as source:
        images = [frame.image for frame in source]
        assert 0 < len(images) == len(source) < 16
        assert source.warnings == (
            f"{name} ends early: its header says 16 frames, {len(source)} of them complete",
        )
    # No complete frame is missing: one more would need more bytes (the AVI header has 5.6 kB).
    for image, picture in zip(images, expected, strict=False):
        np.testing.assert_array_equal(image, picture)
    assert capfd.readouterr() == ("", "")


def test_overwritten_frame_does_not_shift_the_others(
    tmp_path: Path, pictures: Pictures, write_video: WriteVideo
) -> None:
    path = write_video(tmp_path / "v.avi", pictures, "MJPG")
    with open_source(path) as source:
        expected = [frame.image for frame in source]
    content = path.read_bytes()
    seventh = [match.start() for match in re.finditer(b"\xff\xd8\xff", content)][7]
    path.write_bytes(content[:seventh] + bytes(400) + content[seventh + 400 :])
    with open_source(path) as source:
        assert len(source) == 16
        for index in (*range(7), *range(8, 16), 8, 6):
            np.testing.assert_array_equal(source.frame(index).image, expected[index])
        with pytest.raises(InputError, match="frame 7: cannot be decoded"):
            source.frame(7)
        np.testing.assert_array_equal(source.frame(8).image, expected[8])


@pytest.mark.parametrize(
    "content", [b"frame 1\nframe 2\n" * 100, bytes(5000), b"RIFF\x00\x00\x00\x00AVI LIST"]
)
def test_invalid_video_is_rejected(
    tmp_path: Path, content: bytes, capfd: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "recording_001.avi"
    path.write_bytes(content)
    with pytest.raises(InputError, match=r"recording_001\.avi: .*expected a video that FFmpeg"):
        open_source(path)
    assert capfd.readouterr() == ("", "")


def test_video_that_is_overwritten_while_it_is_read_is_reported(tmp_path: Path) -> None:
    path = tmp_path / "v.avi"
    shutil.copyfile(SAMPLE, path)
    with open_source(path) as source:
        source.frame(0)
        path.write_text("another file\n" * 10_000)
        for index in (1, 20, 3, 3):
            with pytest.raises(InputError):
                source.frame(index)


def test_video_without_a_complete_frame_is_rejected(
    tmp_path: Path, pictures: Pictures, write_video: WriteVideo
) -> None:
    path = write_video(tmp_path / "v.avi", pictures, "Y800")
    path.write_bytes(path.read_bytes()[:6500])
    with pytest.raises(InputError, match="no complete one"):
        open_source(path)


@pytest.mark.skipif(not Path("/proc/self/fd").exists(), reason="needs Linux's /proc")
def test_no_file_stays_open(tmp_path: Path, pictures: Pictures, write_video: WriteVideo) -> None:
    path = write_video(tmp_path / "v.avi", pictures, "FFV1")
    broken = tmp_path / "broken.avi"
    broken.write_bytes(path.read_bytes()[:5800])

    def open_files() -> int:
        return sum(
            os.readlink(entry).startswith(str(tmp_path))
            for entry in Path("/proc/self/fd").iterdir()
            if entry.is_symlink()
        )

    with open_source(path) as source:
        source.frame(12)
        source.frame(3)
        assert open_files() == 1
    assert open_files() == 0
    with pytest.raises(InputError):
        open_source(broken)
    assert open_files() == 0


def test_closed_video_is_freed_without_the_garbage_collector() -> None:
    gc.disable()
    try:
        with open_source(VARYING) as source:
            source.frame(3)
        closed = weakref.ref(source)
        del source
        assert closed() is None
    finally:
        gc.enable()
